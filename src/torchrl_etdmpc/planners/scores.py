"""Scores, the planner's objectives: how the table of return estimates becomes the score of a candidate.

A score is any callable from ``[..., D, F, V]`` (depth, dynamics head, value head) to ``[...]``. D is the horizon, or 1
for a score whose attribute ``depths`` is ``"last"``: the planner then computes values at the last depth only. A plain
function has no such attribute and gets them all.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal, Protocol, get_args, runtime_checkable

from torch import Tensor, nn

from torchrl_etdmpc.functional import adaptive_mixture, ensemble_mean, ensemble_std, lower_confidence_bound

Depths = Literal["last", "all"]
"""How much of the return table a score reads."""
ScoreName = Literal["final", "mean", "adaptive"]
"""The scores that are chosen by name."""
ScoreFunction = Callable[[Tensor], Tensor]
"""A score of one's own: return estimates ``[..., D, F, V]`` to scores ``[...]``."""


@runtime_checkable
class Score(Protocol):
    """Reduces a return table, and says how much of it the planner has to compute.

    :func:`make_score` makes one of any function.

    >>> isinstance(FinalScore(), Score), isinstance(lambda returns: returns.mean((-3, -2, -1)), Score)
    (True, False)
    """

    @property
    def depths(self) -> Depths:
        """``"all"``, values at every depth (D is the horizon), or ``"last"``, at the last one only (D is 1)."""
        ...

    def __call__(self, returns: Tensor) -> Tensor:
        """Return estimates ``[..., D, F, V]`` to scores ``[...]``; what is not finite ranks last."""
        ...


class FunctionScore(nn.Module):
    """A function as a score that reads every depth (a module, so that weights in it move with the planner).

    Args:
        function (callable): from ``[..., D, F, V]`` to ``[...]``, with D the horizon.

    >>> import torch
    >>> FunctionScore(lambda returns: returns.amin((-3, -2, -1)))(torch.tensor([[[1.0, 3.0]], [[5.0, 7.0]]])).item()
    1.0
    """

    depths: Depths = "all"

    def __init__(self, function: ScoreFunction) -> None:
        super().__init__()
        self.function = function

    def forward(self, returns: Tensor) -> Tensor:
        """Calls the function."""
        return self.function(returns)


@dataclass(frozen=True)
class FinalScore:
    """Return estimate of the last depth: ``mean_ij Q_H - beta sigma_H`` (BMPC; thesis Eq. 3.2 and 3.4.3).

    Args:
        beta (float): weight of the standard deviation of the heads' mean. Default: 0.

    >>> import torch
    >>> FinalScore()(torch.tensor([[[1.0, 3.0]], [[5.0, 7.0]]])).item()
    6.0
    """

    beta: float = 0.0
    depths: Depths = field(default="last", init=False, repr=False)

    def __post_init__(self) -> None:
        _require_finite(self.beta)

    def __call__(self, returns: Tensor) -> Tensor:
        return lower_confidence_bound(returns[..., -1, :, :], self.beta)


@dataclass(frozen=True)
class MeanScore:
    """Return estimates averaged over depths, then ``mean_ij Qbar - beta sigma(Qbar)`` (thesis Eq. 3.4).

    Args:
        beta (float): weight of the standard deviation of the heads' mean. Default: 0.

    >>> import torch
    >>> MeanScore()(torch.tensor([[[1.0, 3.0]], [[5.0, 7.0]]])).item()
    4.0
    """

    beta: float = 0.0
    depths: Depths = field(default="all", init=False, repr=False)

    def __post_init__(self) -> None:
        _require_finite(self.beta)

    def __call__(self, returns: Tensor) -> Tensor:
        return lower_confidence_bound(returns.mean(-3), self.beta)


@dataclass(frozen=True)
class AdaptiveScore:
    """Best lower confidence bound over mixtures of depths, solved exactly (thesis Eq. 4.14).

    Args:
        beta (float): weight of the mixture's standard deviation, >= 0. Default: 0, the best single depth.

    Raises:
        ValueError: if beta is negative.

    >>> import torch
    >>> AdaptiveScore(beta=0.0)(torch.tensor([[[1.0, 3.0]], [[5.0, 7.0]]])).item()
    6.0
    """

    beta: float = 0.0
    depths: Depths = field(default="all", init=False, repr=False)

    def __post_init__(self) -> None:
        _require_finite(self.beta)
        if self.beta < 0:
            raise ValueError(
                f"beta must not be negative with the adaptive score, got {self.beta}; score='final' and score='mean' "
                "take a negative one, for optimism."
            )

    def __call__(self, returns: Tensor) -> Tensor:
        return adaptive_mixture(ensemble_mean(returns), ensemble_std(returns), self.beta)[0]


def _require_finite(beta: float) -> None:
    if not math.isfinite(beta):
        raise ValueError(f"beta must be finite, got {beta}.")


SCORES: dict[ScoreName, Callable[..., Score]] = {"final": FinalScore, "mean": MeanScore, "adaptive": AdaptiveScore}


def make_score(score: ScoreName | Score | ScoreFunction, beta: float = 0.0) -> Score:
    """A score by name, or of the user's own callable.

    Args:
        score (str or callable): ``"final"``, ``"mean"``, ``"adaptive"``, a :class:`Score`, which is returned unchanged,
            or a callable without ``depths``, e.g. a function, which is given all of them.
        beta (float): penalty of a named score; a callable carries its own.

    Raises:
        ValueError: if the name or the callable's ``depths`` is unknown, or beta is given beside a callable.

    >>> make_score("mean", 10.0)
    MeanScore(beta=10.0)
    """
    if isinstance(score, type):
        raise ValueError(f"score must be an object, got the class {score.__name__}; pass {score.__name__}(...).")
    if callable(score):
        if beta:
            raise ValueError(f"beta={beta} has no effect on a score of your own; put the penalty into the callable.")
        if not isinstance(score, Score):
            return FunctionScore(score)
        if score.depths not in get_args(Depths):
            raise ValueError(f"depths of a score must be one of {', '.join(get_args(Depths))}, got {score.depths!r}.")
        return score
    if score not in get_args(ScoreName):
        raise ValueError(f"score must be one of {', '.join(get_args(ScoreName))} or a callable, got {score!r}.")
    return SCORES[score](beta=float(beta))
