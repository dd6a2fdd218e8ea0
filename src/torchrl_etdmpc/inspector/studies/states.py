"""States of episodes to study, and intervals that know that states of one episode belong together."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from torchrl_etdmpc.inspector.episodes import Episode, Rolled

__all__ = ["Interval", "States", "TrueWorld", "choose_states", "episode_interval", "roll_all"]

RESAMPLES = 1000


class States(NamedTuple):
    """S states in the order of their episodes, so that a simulator goes from one to the next on a short way."""

    observation: Tensor
    """``[S, O]``"""
    plan_mean: Tensor | None
    """The warm start of the decision there, ``[S, H, A]``."""
    simulator: list[Any]
    """S simulator states."""
    episode: Tensor
    """Which episode, int64 ``[S]``."""
    step: Tensor
    """Which decision of it, int64 ``[S]``."""


class Interval(NamedTuple):
    """An estimate with its 95% interval; the bounds are NaN for fewer than two episodes."""

    value: Tensor
    low: Tensor
    high: Tensor


class TrueWorld(Protocol):
    """What studies ask of a simulator: :class:`~torchrl_etdmpc.inspector.Simulator`, or an exact world."""

    @property
    def observation(self) -> Tensor:
        """Of the present state, ``[O]``."""
        ...

    def restore(self, state: Any) -> None:
        """Goes to a state."""
        ...

    def roll(self, actions: Tensor) -> Rolled:
        """Takes actions ``[T, A]``."""
        ...


def choose_states(
    episodes: Sequence[Episode], count: int, *, ahead: int = 0, limit: int | None = None, seed: int = 0
) -> States:
    """Draws states of episodes evenly, without repeats; all there are if there are not so many.

    Args:
        episodes (sequence of Episode): of one task.
        count (int): S.

    Keyword Args:
        ahead (int): how many decisions have to follow a state in an episode that was cut. Of one that ended its task
            every decision counts: all that followed is known. Default: 0.
        limit (int, optional): the task's time limit, in decisions. Other actions may live where an episode ended, and
            what would follow the limit is unknown: no state has it ``ahead``. Default: none.
        seed (int): of the draw.

    Raises:
        ValueError: if no state has so many decisions after it.
    """
    places = []
    for number, episode in enumerate(episodes):
        length = len(episode.reward)
        if not episode.terminated:
            length += 1 - max(ahead, 1)
        elif limit is not None:
            length = min(length, limit + 1 - max(ahead, 1))
        places += [(number, step) for step in range(length)]
    if count < 1 or not places:
        longest = max((len(episode.reward) for episode in episodes), default=0)
        raise ValueError(
            f"states must be at least 1 and have {ahead} decisions after them, got states={count} and episodes of at "
            f"most {longest} decisions; take longer episodes."
        )
    drawn = torch.randperm(len(places), generator=torch.Generator().manual_seed(seed))[:count]
    chosen = [places[index] for index in sorted(drawn.tolist())]
    carried = all(episode.plan_mean is not None for episode in episodes)
    return States(
        observation=torch.stack([episodes[number].observation[step] for number, step in chosen]),
        plan_mean=torch.stack([episodes[number].plan_mean[step] for number, step in chosen]) if carried else None,
        simulator=[episodes[number].states[step] for number, step in chosen],
        episode=torch.tensor([number for number, _ in chosen]),
        step=torch.tensor([step for _, step in chosen]),
    )


def episode_interval(
    values: Tensor,
    episode: Tensor,
    statistic: Callable[[Tensor], Tensor] = lambda rows: rows.mean(0),
    *,
    resamples: int = RESAMPLES,
) -> Interval:
    """A statistic of states with a 95% bootstrap interval that draws whole episodes.

    States of one episode resemble each other, so that an interval over states would be too narrow. It holds the value
    itself, which resamples may all lie on one side of (of Spearman's correlation, they have more ties).

    Args:
        values (Tensor): ``[S, ...]``.
        episode (Tensor): of each state, ``[S]``.
        statistic (callable): from ``[S', ...]`` to any shape. Default: the mean.

    Keyword Args:
        resamples (int): Default: 1000.

    >>> interval = episode_interval(torch.tensor([1.0, 1.0, 3.0, 3.0]), torch.tensor([0, 0, 1, 1]))
    >>> interval.value.item(), interval.low.item(), interval.high.item()
    (2.0, 1.0, 3.0)
    """
    value = statistic(values)
    groups = [values[episode == number] for number in episode.unique()]
    if len(groups) < 2:
        return Interval(value, torch.full_like(value, torch.nan), torch.full_like(value, torch.nan))
    generator = torch.Generator().manual_seed(0)
    draws = torch.randint(len(groups), (resamples, len(groups)), generator=generator).tolist()
    drawn = torch.stack([statistic(torch.cat([groups[index] for index in draw])) for draw in draws])
    low, high = torch.nanquantile(drawn, torch.tensor([0.025, 0.975], dtype=drawn.dtype), dim=0)
    return Interval(value, torch.minimum(low, value), torch.maximum(high, value))


def roll_all(simulator: TrueWorld, states: States, actions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """What really follows from actions in every state.

    Args:
        simulator (TrueWorld): of the states' task.
        states (States): S of them.
        actions (Tensor): ``[S, H, A]``.

    Returns:
        tuple of Tensor: observations ``[S, H + 1, O]``, rewards ``[S, H]``, and whether the task had not ended
        ``[S, H + 1]``; after an end nothing is observed, which is NaN, and nothing is earned. After a time limit the
        rewards are unknown, and NaN.
    """
    size, horizon = actions.shape[:2]
    observation = torch.full((size, horizon + 1, states.observation.shape[-1]), torch.nan)
    reward, alive = torch.zeros(size, horizon), torch.ones(size, horizon + 1, dtype=torch.bool)
    for index, state in enumerate(states.simulator):
        simulator.restore(state)
        rolled = simulator.roll(actions[index])
        steps = len(rolled.reward)
        observation[index, : steps + 1] = rolled.observation
        reward[index, :steps] = rolled.reward
        if rolled.terminated:
            alive[index, steps:] = False
        else:
            reward[index, steps:] = torch.nan
    return observation, reward, alive
