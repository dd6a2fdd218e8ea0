"""Files that are there whole or not at all, checked when they are read: the only place that writes such files."""

from __future__ import annotations

import hashlib
import io
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch


class DamagedFileError(RuntimeError):
    """A file that is missing or is not what was written."""


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Gives a temporary path beside ``path`` and moves it into place, on disk, if the block succeeds.

    The temporary name keeps the suffix (programs that write films choose their format by it).

    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp()) / "notes.txt"
    >>> with replacing(path) as partial:
    ...     _ = partial.write_text("whole")
    >>> path.read_text()
    'whole'
    """
    partial = path.with_name(f".{path.stem}.{os.getpid()}.partial{path.suffix}")
    try:
        yield partial
        sync(partial)
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def write_whole(path: Path, content: bytes | memoryview | str) -> str:
    """Writes a file that survives a power cut or is not there; returns its SHA-256."""
    data = content.encode() if isinstance(content, str) else content
    with replacing(path) as partial:
        partial.write_bytes(data)
    return hashlib.sha256(data).hexdigest()


def write_tensors(path: Path, content: Any) -> str:
    """Writes tensors and plain containers with :func:`write_whole`; returns the file's SHA-256."""
    memory = io.BytesIO()  # torch.save itself answers a full disk with an error that does not say so
    torch.save(content, memory)
    return write_whole(path, memory.getbuffer())


def read_tensors(path: Path, sha256: str) -> Any:
    """Reads a file of :func:`write_tensors` without running any code in it.

    Raises:
        DamagedFileError: if it is missing, has changed or holds something else.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise DamagedFileError(f"{path} cannot be read ({error.strerror}).") from error
    if hashlib.sha256(data).hexdigest() != sha256:
        raise DamagedFileError(f"{path} is not the file that was written: it is cut off or damaged.")
    try:
        return torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
    except Exception as error:  # the errors of hostile files advise to run their code
        raise DamagedFileError(f"{path} holds more than tensors and plain containers; it was not loaded.") from error


def link(source: Path, target: Path) -> None:
    """Makes ``target`` the same file as ``source``, or a copy where the file system has no links."""
    with replacing(target) as partial:
        try:
            os.link(source, partial)
        except OSError:
            shutil.copyfile(source, partial)


def sync(path: Path) -> None:
    """Waits until a file, or the names in a folder, are on disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def remove_partial_files(folder: Path) -> None:
    """Removes what killed processes left of :func:`replacing`."""
    for file in folder.glob(".*.partial*"):
        if file.is_file():
            file.unlink(missing_ok=True)
