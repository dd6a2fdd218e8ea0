"""A progress bar in the units of a training run."""

from __future__ import annotations

from types import TracebackType
from typing import Any


def progress_bar(total_env_steps: int, *, initial: int = 0) -> ProgressBar:
    """A bar on stderr: environment steps, last return, decisions per second, time left; silent off a terminal.

    Args:
        total_env_steps (int): length of the run in environment steps.

    Keyword Args:
        initial (int): environment steps already done, for a run that goes on from a checkpoint. Default: 0.

    Returns:
        ProgressBar: a context manager.

    Raises:
        ImportError: if tqdm is not installed.

    >>> with progress_bar(1000) as bar:
    ...     for env_steps in range(2, 1001, 2):
    ...         bar.update(env_steps=env_steps, decision_steps=env_steps // 2)
    """
    try:
        from tqdm import tqdm
    except ImportError as error:
        raise ImportError("progress_bar needs tqdm, which is not installed; run `pip install tqdm`.") from error
    return ProgressBar(
        tqdm(
            total=total_env_steps,
            initial=initial,
            disable=None,  # silent when stderr is not a terminal
            dynamic_ncols=True,
            bar_format="{percentage:3.0f}%|{bar}| {n_fmt}/{total_fmt} env steps [{elapsed}<{remaining}{postfix}]",
        )
    )


class ProgressBar:
    """Made by :func:`progress_bar`; takes absolute counters, so that a missed update costs nothing.

    Args:
        bar (tqdm): counts environment steps.
    """

    def __init__(self, bar: Any) -> None:
        self._bar = bar
        self._last_return: float | None = None

    def update(self, *, env_steps: int, decision_steps: int, last_return: float | None = None) -> None:
        """Moves the bar.

        Keyword Args:
            env_steps (int): environment steps so far.
            decision_steps (int): actions chosen so far.
            last_return (float, optional): of the last evaluation, if there is a new one; the bar keeps showing it.
        """
        if self._bar.disable:
            return
        if last_return is not None:
            self._last_return = last_return
        rate = self._bar.format_dict["rate"]  # environment steps per second, smoothed; None at the start
        fields = []
        if self._last_return is not None:
            fields.append(f"return {self._last_return:.1f}")
        if rate is not None and env_steps > 0:
            fields.append(f"{rate * decision_steps / env_steps:.1f} decisions/s")
        self._bar.set_postfix_str(", ".join(fields), refresh=False)
        self._bar.update(env_steps - self._bar.n)

    def close(self) -> None:
        """Leaves the bar as it stands and ends its line."""
        self._bar.close()

    def __enter__(self) -> ProgressBar:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
