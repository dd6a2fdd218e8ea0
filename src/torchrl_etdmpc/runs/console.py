"""What a command shows: plain lines with the time, above a progress bar where there is one."""

from __future__ import annotations

import contextlib
import logging
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TextIO

from torchrl import torchrl_logger

_PACKAGE = Path(__file__).resolve().parents[1]


@contextlib.contextmanager
def console() -> Iterator[None]:
    """For its duration, TorchRL's log and Python's warnings become lines such as ``12:03:05 compiled in 90 s``.

    No colours, no places in the source; notices of other libraries, of which a user can make nothing, are left out.

    >>> with console():
    ...     torchrl_logger.info("compiled in 90 s")  # doctest: +SKIP
    12:03:05 compiled in 90 s
    """
    handler = _Lines()
    handler.setFormatter(logging.Formatter("%(asctime)s %(message)s", "%H:%M:%S"))
    before, torchrl_logger.handlers = torchrl_logger.handlers, [handler]
    show, warnings.showwarning = warnings.showwarning, _show_warning
    try:
        yield
    finally:
        torchrl_logger.handlers = before
        warnings.showwarning = show


class _Lines(logging.Handler):
    def emit(self, record: logging.LogRecord) -> None:
        if record.levelno >= logging.WARNING or Path(record.pathname).resolve().is_relative_to(_PACKAGE):
            _write(self.format(record), sys.stdout)


def _show_warning(message: Any, category: Any, filename: str, lineno: int, file: Any = None, line: Any = None) -> None:
    time = logging.Formatter("%(asctime)s", "%H:%M:%S").format(logging.makeLogRecord({}))
    _write(f"{time} warning: {' '.join(str(message).split())}", file or sys.stderr)


def _write(line: str, stream: TextIO) -> None:
    try:
        from tqdm import tqdm
    except ImportError:
        stream.write(f"{line}\n")
    else:
        tqdm.write(line, file=stream)  # steps in front of a bar that is being shown
    stream.flush()
