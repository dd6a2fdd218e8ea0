"""What goes wrong outside of Python: processes that are killed, disks that are full, extensions that do not load."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 20 MB."""
    disk = tmp_path / "disk"
    disk.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=20m", "tmpfs", str(disk)]
    try:
        mounted = subprocess.run(command, capture_output=True, check=False).returncode == 0
    except FileNotFoundError:
        mounted = False
    if not mounted:
        pytest.skip("mounting needs root")
    yield disk
    subprocess.run(["umount", "-l", str(disk)], check=True)


@pytest.fixture(scope="session")
def leave_free() -> Callable[[Path, int | None], None]:
    """Fills a small disk up to so many bytes; ``None`` gives all the space back."""

    def fill(disk: Path, free: int | None) -> None:
        ballast = disk / "ballast"
        ballast.unlink(missing_ok=True)
        if free is None:
            return
        space = os.statvfs(disk)
        available = space.f_bavail * space.f_frsize
        with ballast.open("wb") as file:
            os.posix_fallocate(file.fileno(), 0, available - free)

    return fill


@pytest.fixture(scope="session")
def begin_in_copy() -> Callable[[Callable[[], Any]], int]:
    """Begins a function in a copy of this process, which needs no imports; returns the number of the process."""
    if not hasattr(os, "fork"):
        pytest.skip("needs fork")

    def begin(function: Callable[[], Any]) -> int:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of a fork beside PyTorch's threads
            child = os.fork()
        if child == 0:
            try:
                function()
            except BaseException:
                os._exit(1)
            os._exit(0)
        return child

    return begin


@pytest.fixture(scope="session")
def in_copy(begin_in_copy: Callable[[Callable[[], Any]], int]) -> Callable[[Callable[[], Any]], int]:
    """Runs a function in a copy of this process; returns its status as ``os.waitpid`` gives it, 0 if it returned."""
    return lambda function: os.waitpid(begin_in_copy(function), 0)[1]


@pytest.fixture(scope="session")
def killed_at(in_copy: Callable[[Callable[[], Any]], int]) -> Callable[[Callable[[], Any], int], bool]:
    """Runs a function in a copy of this process that is killed when it is about to change a file for the n-th time.

    Opening a file to write, writing it, moving, linking, removing and syncing are changes, and folders are files. A
    file that is being written has half of its content. Returns whether the process was killed before it was done.
    """

    def run(function: Callable[[], Any], moment: int) -> bool:
        def mortal() -> None:
            _die_at(moment)
            function()

        status = in_copy(mortal)
        assert os.WIFSIGNALED(status) or status == 0
        return os.WIFSIGNALED(status)

    return run


def _die_at(moment: int) -> None:
    calls = [0]

    def count() -> None:
        calls[0] += 1
        if calls[0] == moment:
            os.kill(os.getpid(), signal.SIGKILL)

    changes = {"os.rename", "os.link", "os.remove", "os.rmdir", "os.mkdir", "os.truncate"}

    def watch(event: str, arguments: tuple[Any, ...]) -> None:
        writes = event == "open" and arguments[2] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)
        if event in changes or writes:
            count()

    sys.addaudithook(watch)
    fsync, write_bytes = os.fsync, Path.write_bytes

    def counted_fsync(descriptor: int) -> None:
        count()
        fsync(descriptor)

    def in_halves(path: Path, data: Any) -> int:
        write_bytes(path, bytes(data)[: len(data) // 2])
        count()
        return write_bytes(path, data)

    os.fsync, Path.write_bytes = counted_fsync, in_halves


class _Tree:
    """A segment tree without the tree: the same answers, slowly."""

    def __init__(self, neutral: float, reduce: np.ufunc, capacity: int) -> None:
        self.values, self.reduce = np.full(capacity, neutral, dtype=np.float32), reduce

    def __getitem__(self, index):
        return self.values[np.asarray(index)]

    def __setitem__(self, index, value):
        self.values[np.asarray(index)] = np.asarray(value)

    def query(self, begin: int, end: int) -> float:
        return float(self.reduce.reduce(self.values[begin:end]))

    def scan_lower_bound(self, mass):
        return np.searchsorted(self.values.cumsum(dtype=np.float64), np.asarray(mass))


@pytest.fixture
def segment_trees(monkeypatch: pytest.MonkeyPatch) -> None:
    """What TorchRL's prioritised samplers need of its C++ extension: stand-ins where that does not load."""
    import torchrl.data.replay_buffers.samplers.prioritized as prioritized

    if prioritized.SumSegmentTreeFp32 is not None:
        return
    for kind, neutral, reduce in (("Sum", 0.0, np.add), ("Min", np.inf, np.minimum)):
        for dtype in ("Fp32", "Fp64"):
            monkeypatch.setattr(prioritized, f"{kind}SegmentTree{dtype}", partial(_Tree, neutral, reduce))
