"""How far a planning call is, and giving it up."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from torch import Tensor

from torchrl_etdmpc.inspector.settings import with_settings
from torchrl_etdmpc.planners import EnsembleMPPIPlanner, Score


class Cancelled(RuntimeError):
    """A planning call that was given up between two iterations."""


def watched(planner: EnsembleMPPIPlanner, tell: Callable[[int], None]) -> EnsembleMPPIPlanner:
    """The same planner, which says after every iteration how many there have been; what ``tell`` raises ends a plan."""
    return with_settings(planner, score=_Watched(planner.score, tell), beta=0.0)


class _Watched:
    """A score that tells how often it was asked: once an iteration."""

    def __init__(self, score: Score, tell: Callable[[int], None]) -> None:
        self.score, self.tell, self.asked = score, tell, 0

    @property
    def depths(self) -> Any:
        return self.score.depths

    def __call__(self, returns: Tensor) -> Tensor:
        scores = self.score(returns)
        self.asked += 1
        self.tell(self.asked)
        return scores
