"""One run in a process of its own: its command, its output, and what its end means."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any, BinaryIO, Literal

from torchrl_etdmpc.runs import RunDirectory
from torchrl_etdmpc.runs.directory import IN_USE
from torchrl_etdmpc.runs.dotted import flat
from torchrl_etdmpc.suites.experiment import Run
from torchrl_etdmpc.training import EXIT_CODE, preset
from torchrl_etdmpc.training.config import typed_name

End = Literal["finished", "stopped", "elsewhere", "failed"]
Verdict = Literal["failed", "pruned"]
BEGUN = "suite: begun"
BELOW_MEDIAN = "below the median of the trials before it"
FAILED = "suite: failed: "
_VERDICTS: dict[Verdict, str] = {"failed": FAILED, "pruned": "suite: pruned: "}
_TAIL_BYTES = 16_384


def command(run: Run, **more: Any) -> list[str]:
    """The command that trains a run from wherever it is; it names every setting that differs from the preset's.

    Args:
        run (Run): the run.
        **more: settings that may change on the way, e.g. ``threads``.
    """
    config = run.config
    usual = flat(preset(config.preset).to_dict())
    first = {"task": run.task, "preset": config.preset, "seed": run.seed, "total_env_steps": config.total_env_steps}
    settings = {name: value for name, value in flat(config.to_dict()).items() if name not in first}
    differing = {name: value for name, value in settings.items() if value != usual[name]}
    values = first | differing | {"run_dir": str(run.path), "resume": "auto"} | more
    typed = {typed_name(name): value for name, value in values.items()}
    words = [f"{name}={value if isinstance(value, str) else json.dumps(value)}" for name, value in typed.items()]
    # -P: -m alone would import a random.py of the folder that the suite was begun in.
    return [sys.executable, "-P", "-m", "torchrl_etdmpc.commands", "train", *words]


def log_file(run: Run) -> Path:
    """What the run's processes printed, one after the other."""
    return run.path / "suite.log"


def start(run: Run, *, threads: int | None = None, gpu: str | None = None) -> subprocess.Popen[bytes]:
    """Starts the run's process, in a session of its own: Ctrl-C in the terminal is for the suite, which passes it on.

    Args:
        run (Run): the run; its directory is made.

    Keyword Args:
        threads (int, optional): for a run whose settings leave them open.
        gpu (str, optional): the only one that it sees, as ``CUDA_VISIBLE_DEVICES`` calls it.

    Raises:
        OSError: if the directory cannot be written.
    """
    environment, more = dict(os.environ), {}
    if threads is not None and run.config.threads is None:
        more["threads"] = threads
        environment["OMP_NUM_THREADS"] = str(threads)
    if gpu is not None:
        environment["CUDA_VISIBLE_DEVICES"] = gpu
    run.path.mkdir(parents=True, exist_ok=True)
    with open(log_file(run), "a+b") as log:
        log.write(f"{_line_end(log)}{BEGUN}\n".encode())
        log.flush()
        return subprocess.Popen(
            command(run, **more),
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )


def end(run: Run, code: int) -> tuple[End, str]:
    """What the end of a run's process means, by its exit code, and why in a line.

    A process that was stopped by a signal, or asked to stop, has not failed; nor has one that found the directory in
    use.
    """
    directory = RunDirectory(run.path)
    last = _last_line(log_file(run))
    if directory.in_use or IN_USE in last:
        return "elsewhere", "another process trains it"
    if code == 0 and directory.finished:
        return "finished", ""
    if code == EXIT_CODE or code < 0 or code - 128 in set(signal.Signals):
        return "stopped", f"exit code {code}"
    return "failed", last.removeprefix("error: ") or f"exit code {code}"


def note(run: Run, verdict: Verdict, why: str) -> None:
    """Writes into the run's log what was decided about it, where :func:`last_verdict` finds it; not on a full disk."""
    with contextlib.suppress(OSError):
        run.path.mkdir(parents=True, exist_ok=True)
        with open(log_file(run), "a+b") as log:
            log.write(f"{_line_end(log)}{_VERDICTS[verdict]}{why}\n".encode())


def last_verdict(run: Run) -> tuple[Verdict, str] | None:
    """What was decided about a run, and why; ``None`` if it has been trained since.

    A process that the suite began writes into the log after the verdict. One that was begun by hand does not, but its
    tables are newer than the log.
    """
    directory = RunDirectory(run.path)
    if max(map(_changed_at, (directory.eval, directory.train))) > _changed_at(log_file(run)):
        return None
    last = _last_line(log_file(run))
    for verdict, beginning in _VERDICTS.items():
        if last.startswith(beginning):
            return verdict, last.removeprefix(beginning)
    return None


def _changed_at(file: Path) -> int:
    try:
        return file.stat().st_mtime_ns
    except OSError:
        return 0


def _line_end(log: BinaryIO) -> str:
    """What ends the last line of a log, which a process that was killed may have left open."""
    size = log.seek(0, os.SEEK_END)
    log.seek(max(size - 1, 0))
    return "" if log.read(1) in (b"\n", b"") else "\n"


def _last_line(file: Path) -> str:
    try:
        with open(file, "rb") as log:
            log.seek(max(log.seek(0, os.SEEK_END) - _TAIL_BYTES, 0))
            lines = log.read().decode(errors="replace").splitlines()
    except OSError:
        return ""
    return next((line.strip() for line in reversed(lines) if line.strip()), "")
