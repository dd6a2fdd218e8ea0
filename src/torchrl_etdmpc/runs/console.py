"""What a command shows: plain lines with the time, above a progress bar where there is one."""

from __future__ import annotations

import contextlib
import logging
import shutil
import sys
import textwrap
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TextIO

from torchrl import torchrl_logger

_PACKAGE = Path(__file__).resolve().parents[1]


@contextlib.contextmanager
def console() -> Iterator[None]:
    """For its duration, TorchRL's log and Python's warnings become lines such as ``12:03:05 compiled in 90 s``.

    Without colours and places in the source. Of other libraries' logs only warnings and errors are shown.

    >>> with console():
    ...     torchrl_logger.info("compiled in 90 s")  # doctest: +SKIP
    12:03:05 compiled in 90 s
    """
    handler = _Lines()
    handler.setFormatter(logging.Formatter("%(asctime)s %(message)s", "%H:%M:%S"))
    before, torchrl_logger.handlers = torchrl_logger.handlers, list[logging.Handler]([handler])
    form, warnings.formatwarning = warnings.formatwarning, _format_warning
    try:
        yield
    finally:
        torchrl_logger.handlers = before
        warnings.formatwarning = form


class _Lines(logging.Handler):
    def emit(self, record: logging.LogRecord) -> None:
        if record.levelno >= logging.WARNING or Path(record.pathname).resolve().is_relative_to(_PACKAGE):
            # A full disk, a closed pipe, or a signal in the middle of a line does not end what it tells of.
            with contextlib.suppress(OSError, ValueError, RuntimeError):
                _write(self.format(record), sys.stdout)


def _format_warning(message: Any, category: Any, filename: str, lineno: int, line: Any = None) -> str:
    time = logging.Formatter("%(asctime)s", "%H:%M:%S").format(logging.makeLogRecord({}))
    text = f"{time} warning: {' '.join(str(message).split())}"
    if sys.stderr.isatty():  # over a bar, which is drawn anew below
        return f"\r{text.ljust(shutil.get_terminal_size().columns - 1)}\n"
    return f"{text}\n"


def _write(line: str, stream: TextIO) -> None:
    if stream.isatty():  # which would break words
        width = max(shutil.get_terminal_size().columns - 9, 20)
        # Paths stay whole, which have hyphens.
        line = "\n         ".join(textwrap.wrap(line, width, break_long_words=False, break_on_hyphens=False))
    try:
        from tqdm import tqdm
    except ImportError:
        stream.write(f"{line}\n")
    else:
        tqdm.write(line, file=stream)  # steps in front of a bar that is being shown
    stream.flush()
