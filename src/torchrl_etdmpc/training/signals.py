"""Signals that ask a run to stop: finish the step, save, leave."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from collections.abc import Callable
from types import FrameType, TracebackType
from typing import Any

from torchrl import torchrl_logger

from torchrl_etdmpc.envs.worker import STOP_SIGNALS

EXIT_CODE = 75
"""Of a run that was asked to stop and can go on (EX_TEMPFAIL of sysexits.h)."""


class RunInterrupted(Exception):
    """The run was asked to stop; the text says whether it is saved."""


class WorkLeftError(Exception):
    """A signal came during work that can be left as it is: nothing of it counts yet."""


class StopSignals:
    """Notes the first signal; a second one ends the process at once.

    While there is nothing to save, the first one raises SystemExit, wherever the program is. Only the main thread can
    handle signals; in another one this does nothing.

    SIGHUP, of a terminal that is closed, may come twice and beside SIGTERM: it is noted, but never one of the two that
    end the process at once. Where it is ignored, by ``nohup``, it stays so.

    Attributes:
        requested (bool): whether a signal has come.
        nothing_to_save (bool): Default: ``True``.
        at_once (callable): called before a second signal ends the process. Default: does nothing.

    >>> with StopSignals() as stop:
    ...     stop.requested
    False
    """

    def __init__(self) -> None:
        self.requested = False
        self.nothing_to_save = True
        self.at_once: Callable[[], None] = lambda: None
        self._asked = False
        self._before: dict[int, Any] = {}

    def __enter__(self) -> StopSignals:
        if threading.current_thread() is threading.main_thread():
            taken = [number for number in STOP_SIGNALS if not (_is_hangup(number) and _is_ignored(number))]
            self._before = {number: signal.signal(number, self._handle) for number in taken}
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        self._before = {}

    def leave_work(self) -> None:
        """Leaves work that may take long, if a signal has come.

        Raises:
            WorkLeftError: then.
        """
        if self.requested:
            raise WorkLeftError

    def _handle(self, number: int, frame: FrameType | None) -> None:
        name, hangup = signal.Signals(number).name, _is_hangup(number)
        if self._asked and not hangup:
            with contextlib.suppress(OSError):  # Ctrl-C has ended a `tee` that read it
                os.write(2, f"{name} again: stopping at once; the last checkpoint stays.\n".encode())
            with contextlib.suppress(Exception):
                self.at_once()
            os._exit(128 + number)
        self._asked |= not hangup
        if self.requested:
            return
        self.requested = True
        if self.nothing_to_save:
            raise SystemExit(EXIT_CODE)
        again = "" if hangup else "; send it again to stop at once"
        torchrl_logger.info(f"{name}: finishing this step, saving and stopping{again}")


def _is_hangup(number: int) -> bool:
    return number == getattr(signal, "SIGHUP", None)


def _is_ignored(number: int) -> bool:
    return signal.getsignal(number) == signal.SIG_IGN
