"""Exact worlds in the place of a simulator, so that what a study should find is known."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from torchrl_etdmpc.inspector import Episode, Rolled
from torchrl_etdmpc.planners import EnsembleMPPIPlanner, LatentEnv
from torchrl_etdmpc.testing.worlds import AnalyticWorld


class WorldSimulator:
    """The world as it is, without the errors of its heads; a state is an observation."""

    def __init__(self, world: AnalyticWorld) -> None:
        self.world = world

    def restore(self, state: Tensor) -> None:
        self.latent = self.world.encode(state)

    @property
    def observation(self) -> Tensor:
        return self.latent[: self.world.observation_dim]

    def roll(self, actions: Tensor) -> Rolled:
        observations, rewards = [self.observation], []
        for action in actions:
            rewards.append(self.world.reward(self.latent, action))
            self.latent = self.world.transition(self.latent, action)
            observations.append(self.observation)
        return Rolled(torch.stack(observations), torch.stack(rewards), False)


class EndingSimulator(WorldSimulator):
    """The same, where the task ends with the second action."""

    def roll(self, actions: Tensor) -> Rolled:
        return super().roll(actions[:2])._replace(terminated=True)


def make_planner(world: AnalyticWorld, **settings: object) -> EnsembleMPPIPlanner:
    """A planner that finds the best plan of a small world."""
    budget = {"horizon": 3, "num_samples": 256, "num_elites": 32, "num_proposals": 4, "iterations": 6}
    # The weights of the elites are flat where returns are small.
    return EnsembleMPPIPlanner(LatentEnv(world), **budget | {"inverse_temperature": 20.0} | settings)


def make_episodes(
    world: AnalyticWorld, act: Callable[[Tensor], Tensor], *, count: int = 3, steps: int = 8, horizon: int = 3
) -> list[Episode]:
    """Episodes from different starts, with the plan of doing ``act`` in every step."""
    generator, episodes = torch.Generator().manual_seed(0), []
    for seed in range(count):
        simulator = WorldSimulator(world)
        simulator.restore(torch.rand(world.observation_dim, generator=generator) - 0.5)
        observations, actions, rewards = [simulator.observation], [], []
        for _ in range(steps):
            actions.append(act(simulator.observation))
            rewards.append(simulator.roll(actions[-1].unsqueeze(0)).reward[0])
            observations.append(simulator.observation)
        plans = torch.zeros(steps, horizon, world.action_dim)
        episodes.append(
            Episode(
                observation=torch.stack(observations),
                action=torch.stack(actions),
                reward=torch.stack(rewards),
                plan_mean=plans,
                states=observations,
                terminated=False,
                task="world",
                seed=seed,
            )
        )
    return episodes


@pytest.fixture(autouse=True)
def _seeded() -> None:
    torch.manual_seed(0)


@pytest.fixture(name="WorldSimulator")
def world_simulator() -> type[WorldSimulator]:
    return WorldSimulator


@pytest.fixture(name="EndingSimulator")
def ending_simulator() -> type[EndingSimulator]:
    return EndingSimulator


@pytest.fixture(name="make_planner")
def planner_maker() -> Callable[..., EnsembleMPPIPlanner]:
    return make_planner


@pytest.fixture(name="make_episodes")
def episodes_maker() -> Callable[..., list[Episode]]:
    return make_episodes
