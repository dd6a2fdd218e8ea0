"""Do values and plans promise what then happens? Predictions against the discounted return that followed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchrl_etdmpc.functional import bootstrapped_returns
from torchrl_etdmpc.inspector.episodes import Episode
from torchrl_etdmpc.inspector.studies.replan import generator_of, replan, values
from torchrl_etdmpc.inspector.studies.states import States, episode_interval
from torchrl_etdmpc.planners import EnsembleMPPIPlanner

PREDICTIONS = ("value", "plan")


class ValueBias(NamedTuple):
    """Predictions in S states of episodes, and what followed."""

    predicted: Tensor
    """Mean over the value heads, and score of the chosen sequence, ``[S, 2]``; by ``PREDICTIONS``."""
    followed: Tensor
    """Discounted return of the rest of the episode, ``[S]``; where the time limit cut it, with the value there."""
    own_share: Tensor
    """Weight of that last value in ``followed``, ``[S]``: how much of it is the prediction itself."""
    episode: Tensor
    """``[S]``"""
    step: Tensor
    """``[S]``"""

    @property
    def bias(self) -> Tensor:
        """Predicted minus followed, ``[S, 2]``."""
        return self.predicted - self.followed.unsqueeze(-1)


def value_bias(
    planner: EnsembleMPPIPlanner, episodes: Sequence[Episode], states: States, *, seed: int = 0
) -> ValueBias:
    """Sets predictions beside the return of the episode that the planner went on to play.

    Args:
        planner (EnsembleMPPIPlanner): that played the episodes.
        episodes (sequence of Episode): of it.
        states (States): of these episodes.

    Keyword Args:
        seed (int): of the plans.
    """
    plan = replan(planner, states.observation, states.plan_mean, generator=generator_of(planner, seed))
    predicted = torch.stack([values(planner, states.observation), plan.value], dim=-1)
    tails = [_returns_to_go(planner, episode) for episode in episodes]
    places = list(zip(states.episode.tolist(), states.step.tolist(), strict=True))
    followed, share = (torch.stack([tails[number][part][step] for number, step in places]) for part in range(2))
    return ValueBias(predicted, followed, share, states.episode, states.step)


def _returns_to_go(planner: EnsembleMPPIPlanner, episode: Episode) -> tuple[Tensor, Tensor]:
    """Of every decision: the discounted rest, and the weight of the last value in it, both ``[T]``."""
    end = torch.zeros(()) if episode.terminated else values(planner, episode.observation[-1])
    returns = bootstrapped_returns(episode.reward, end.expand_as(episode.reward), planner.discount)
    left = torch.arange(len(returns), 0, -1)
    share = planner.discount**left * (0.0 if episode.terminated else 1.0)
    return returns, share


def table(result: ValueBias) -> list[dict[str, Any]]:
    """Mean bias with its interval, the correlation with what followed, and the scale of it."""
    bias = episode_interval(result.bias, result.episode)
    return [
        {
            "prediction": name,
            "bias": bias.value[column].item(),
            "low": bias.low[column].item(),
            "high": bias.high[column].item(),
            "mean_followed": result.followed.mean().item(),
            "std_followed": result.followed.std().item(),
            "correlation": torch.corrcoef(torch.stack([result.predicted[:, column], result.followed]))[0, 1].item(),
            "mean_own_share": result.own_share.mean().item(),
            "states": len(result.followed),
        }
        for column, name in enumerate(PREDICTIONS)
    ]


def lines(result: ValueBias) -> list[str]:
    """What came out."""
    return [
        f"{row['prediction']}: {row['bias']:+.2f} [{row['low']:+.2f}, {row['high']:+.2f}] against the return that "
        f"followed ({row['mean_followed']:.1f} +- {row['std_followed']:.1f}), correlation {row['correlation']:.2f}"
        for row in table(result)
    ]


def figure(result: ValueBias) -> Any:
    """Predicted against followed, and the bias along the episode."""
    from matplotlib.figure import Figure

    picture = Figure(figsize=(7.2, 3.1), layout="constrained")
    left, right = picture.subplots(1, 2)
    ends = [min(result.followed.min(), result.predicted.min()), max(result.followed.max(), result.predicted.max())]
    left.plot(ends, ends, color="black", linewidth=0.8)
    for column, (name, colour, marker) in enumerate(zip(PREDICTIONS, ("#0072B2", "#D55E00"), ("o", "x"), strict=True)):
        style = {"s": 9, "color": colour, "marker": marker, "alpha": 0.6, "label": name, "linewidths": 0.8}
        left.scatter(result.followed, result.predicted[:, column], **style)
        right.scatter(result.step, result.bias[:, column], **style)
    left.set_xlabel("discounted return that followed")
    left.set_ylabel("predicted")
    left.legend(frameon=False)
    right.axhline(0, color="black", linewidth=0.8)
    right.set_xlabel("decision")
    right.set_ylabel("predicted minus followed")
    return picture
