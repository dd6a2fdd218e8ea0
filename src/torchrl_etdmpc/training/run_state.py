"""Where a run is, and what it still owes: the part of a checkpoint that no other part owns."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Literal

Stage = Literal["random", "pretrain", "learn"]
Duty = Literal["evaluation", "checkpoint", "train_row"]


@dataclass
class RunState:
    """The place inside a run, as plain values.

    Attributes:
        stage (str): ``"random"`` phase, then ``"pretrain"``, then ``"learn"``.
        due (list of str): what the last step called for and is not done yet, in order. These names are stored.
        eval_returns (list of float): mean return of every evaluation so far; NaN for one that failed.
        learning_s (float): seconds of acting and updating, without random phase, pretraining and evaluations.
        wall_s (float): seconds of work before this process.
    """

    stage: Stage = "random"
    due: list[Duty] = field(default_factory=lambda: ["checkpoint", "evaluation"])
    eval_returns: list[float] = field(default_factory=list)
    learning_s: float = 0.0
    wall_s: float = 0.0

    def __post_init__(self) -> None:
        self._started = time.perf_counter()

    @property
    def wall_time_s(self) -> float:
        """Seconds of work so far, those before an interruption included."""
        return self.wall_s + time.perf_counter() - self._started

    def state_dict(self) -> dict[str, Any]:
        """The attributes as they are now."""
        values = {entry.name: getattr(self, entry.name) for entry in fields(self)} | {"wall_s": self.wall_time_s}
        return {name: list(value) if isinstance(value, list) else value for name, value in values.items()}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Restores :meth:`state_dict`."""
        for entry in fields(self):
            value = state_dict[entry.name]
            setattr(self, entry.name, list(value) if isinstance(value, list) else value)
        self._started = time.perf_counter()
