"""Planner objectives: how the table of return estimates becomes the score of a candidate.

A score is any callable from ``[..., D, F, V]`` (depth, dynamics head, value head) to ``[...]``. D is the horizon, or 1
for a score whose attribute ``depths`` is ``"last"``: the planner then computes values at the last depth only.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, Literal, Protocol

from torch import Tensor

from torchrl_etdmpc.functional import adaptive_mixture, ensemble_mean, ensemble_variance

Depths = Literal["last", "all"]


class Score(Protocol):
    """Anything that reduces a return table; a plain function will do."""

    def __call__(self, returns: Tensor) -> Tensor:
        """Return estimates ``[..., D, F, V]`` to scores ``[...]``."""


def lower_confidence_bound(returns: Tensor, beta: float) -> Tensor:
    """``mean - beta * sigma`` over the heads (thesis 3.4.3); beta < 0 is optimism.

    Args:
        returns (Tensor): return estimates, shape ``[..., F, V]``.
        beta (float): weight of the standard deviation of the mean (thesis Eq. 3.3).

    Returns:
        Tensor: shape ``[...]``.
    """
    mean = ensemble_mean(returns)
    return mean if beta == 0 else mean - beta * ensemble_variance(returns).sqrt()


@dataclass(frozen=True)
class FinalScore:
    """Return estimate of the last depth: ``mean_ij Q_H - beta sigma_H`` (BMPC; thesis Eq. 3.2 and 3.4.3).

    Args:
        beta (float): weight of the ensemble's standard deviation. Default: 0.

    >>> import torch
    >>> FinalScore()(torch.tensor([[[1.0, 3.0]], [[5.0, 7.0]]])).item()
    6.0
    """

    beta: float = 0.0
    depths: ClassVar[Depths] = "last"

    def __call__(self, returns: Tensor) -> Tensor:
        return lower_confidence_bound(returns[..., -1, :, :], self.beta)


@dataclass(frozen=True)
class MeanScore:
    """Return estimates averaged over depths, then ``mean_ij Qbar - beta sigma(Qbar)`` (thesis Eq. 3.4).

    Args:
        beta (float): weight of the ensemble's standard deviation. Default: 0.

    >>> import torch
    >>> MeanScore()(torch.tensor([[[1.0, 3.0]], [[5.0, 7.0]]])).item()
    4.0
    """

    beta: float = 0.0
    depths: ClassVar[Depths] = "all"

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
    depths: ClassVar[Depths] = "all"

    def __post_init__(self) -> None:
        if self.beta < 0:
            raise ValueError(
                f"the adaptive score needs beta >= 0, got {self.beta}; use 'final' or 'mean' for optimism."
            )

    def __call__(self, returns: Tensor) -> Tensor:
        return adaptive_mixture(ensemble_mean(returns), ensemble_variance(returns).sqrt(), self.beta)[0]


SCORES: dict[str, Callable[..., Score]] = {"final": FinalScore, "mean": MeanScore, "adaptive": AdaptiveScore}


def make_score(score: str | Score, beta: float = 0.0) -> Score:
    """A score by name, or the user's own callable unchanged.

    Args:
        score (str or callable): ``"final"``, ``"mean"``, ``"adaptive"`` or a callable.
        beta (float): penalty of a named score; a callable carries its own.

    Raises:
        ValueError: if the name is unknown, or beta is given beside a callable.

    >>> make_score("mean", 10.0)
    MeanScore(beta=10.0)
    """
    if callable(score):
        if beta:
            raise ValueError(f"beta={beta} has no effect on a score of your own; put the penalty into the callable.")
        return score
    if score not in SCORES:
        raise ValueError(f"score must be one of {', '.join(SCORES)} or a callable, got {score!r}.")
    return SCORES[score](beta=float(beta))
