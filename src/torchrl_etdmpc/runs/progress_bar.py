"""A progress bar for one phase of a run."""

from __future__ import annotations

import time
from types import TracebackType
from typing import Any

from torchrl import torchrl_logger

_LINE_EVERY_S = 60.0


def progress_bar(
    phase: str,
    total: int,
    unit: str,
    *,
    initial: int = 0,
    passing: bool = False,
    time_left: bool = True,
    log_every_s: float = _LINE_EVERY_S,
) -> ProgressBar:
    """A bar on stderr: phase, share, steps, time left; where there is no terminal, a line in the log now and then.

    Args:
        phase (str): what is being done, e.g. ``"learning"``.
        total (int): how many steps it has.
        unit (str): what they are, e.g. ``"env steps"``.

    Keyword Args:
        initial (int): steps already done, for a phase that goes on. Default: 0.
        passing (bool): whether the bar disappears when its phase ends. Default: ``False``.
        time_left (bool): ``False`` where steps do not take about equally long, so that nothing follows from those that
            are done. Default: ``True``.
        log_every_s (float): seconds between two lines of the log. Default: 60.

    Returns:
        ProgressBar: a context manager.

    Raises:
        ImportError: if tqdm is not installed.

    >>> with progress_bar("learning", 1000, "env steps") as bar:
    ...     for env_steps in range(2, 1001, 2):
    ...         bar.update(env_steps)
    """
    try:
        from tqdm import tqdm
    except ImportError as error:
        raise ImportError("progress_bar needs tqdm, which is not installed; run `pip install tqdm`.") from error
    bar = tqdm(
        total=total,
        initial=initial,
        unit=unit,
        desc=f"{phase:12}",
        disable=None,  # silent when stderr is not a terminal
        leave=not passing,
        dynamic_ncols=True,
        smoothing=0,  # evaluations and checkpoints interrupt a phase; its average holds them in their share
        bar_format="{desc} {percentage:3.0f}%|{bar}| {n_fmt}/{total_fmt} {unit}"
        + (", {remaining} left{postfix}" if time_left else "{postfix}"),
    )
    return ProgressBar(bar, phase, total, unit, initial, time_left, log_every_s)


class ProgressBar:
    """Made by :func:`progress_bar`; takes absolute counters, so that a missed update costs nothing.

    Args:
        bar (tqdm): counts the steps; disabled where there is no terminal.
        phase (str): as are the next four, what :func:`progress_bar` was given.
        total (int): how many steps it has.
        unit (str): what they are.
        initial (int): steps already done.
        time_left (bool): whether it says how long the rest takes.
        log_every_s (float): seconds between two lines of the log, where the bar is disabled.

    >>> with progress_bar("pretraining", 10, "updates") as bar:
    ...     bar.update(10)
    """

    def __init__(
        self, bar: Any, phase: str, total: int, unit: str, initial: int, time_left: bool, log_every_s: float
    ) -> None:
        self._bar, self._phase, self._total, self._unit, self._time_left = bar, phase, total, unit, time_left
        self._log_every_s = log_every_s
        self._began = self._logged = time.monotonic()
        self._initial = self._done = initial
        self._note = ""

    def update(self, done: int, note: str | None = None) -> None:
        """Moves the bar.

        Args:
            done (int): steps so far.
            note (str, optional): what else there is to know, e.g. the last return. Default: the last one stays.
        """
        self._note = self._note if note is None else note
        if not self._bar.disable:
            if note is not None:
                self._bar.set_postfix_str(note, refresh=False)
            self._bar.update(done - self._bar.n)
        elif (now := time.monotonic()) - self._logged >= self._log_every_s:
            self._logged = now
            left = (now - self._began) * (self._total - done) / max(done - self._initial, 1)
            left = f"{_duration(left)} left" if self._time_left else ""
            parts = [f"{done} of {self._total} {self._unit}", left, self._note]
            torchrl_logger.info(f"{self._phase}: {', '.join(part for part in parts if part)}")

    def advance(self) -> None:
        """Moves the bar by one step."""
        self._done += 1
        self.update(self._done)

    def close(self) -> None:
        """Leaves the bar as it stands and ends its line."""
        self._bar.close()

    def __enter__(self) -> ProgressBar:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _duration(seconds: float) -> str:
    minutes, hours = seconds / 60, seconds / 3600
    return f"{hours:.1f} h" if hours >= 1 else f"{minutes:.0f} min" if minutes >= 1 else f"{seconds:.0f} s"
