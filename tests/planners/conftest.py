from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch

from torchrl_etdmpc import EnsembleMPPIPlanner, LatentEnv, Plan, WorldModel
from torchrl_etdmpc.planners import PlanNoise


@pytest.fixture(autouse=True)
def _seed() -> None:
    torch.manual_seed(0)


def _make_planner(world=None, **options) -> EnsembleMPPIPlanner:
    """A small planner that starts cold, unless told otherwise."""
    small = {"horizon": 3, "num_samples": 24, "num_elites": 6, "num_proposals": 5, "iterations": 3, "warm_start": False}
    return EnsembleMPPIPlanner(LatentEnv(_make_model() if world is None else world), **{**small, **options})


@pytest.fixture
def make_planner() -> Callable[..., Any]:
    return _make_planner


def _make_model(**options) -> WorldModel:
    """A small float64 world model in which rewards, values and heads differ."""
    sizes = {"latent_dim": 16, "mlp_dim": 16, "encoder_dim": 16, "num_dynamics": 2, "num_values": 2}
    model = WorldModel(3, 2, **{**sizes, **options})
    for head in (model.reward_head, model.value_head, model.policy):
        torch.nn.init.normal_(head.output.weight, std=0.5)
    return model.double()


@pytest.fixture
def make_model() -> Callable[..., Any]:
    return _make_model


def _states(*batch_size: int) -> torch.Tensor:
    return torch.randn(*batch_size, 3, dtype=torch.float64)


@pytest.fixture
def states() -> Callable[..., Any]:
    return _states


def _rows(noise: PlanNoise, index) -> PlanNoise:
    return PlanNoise(*(draw[index] for draw in noise))


@pytest.fixture
def rows() -> Callable[..., Any]:
    return _rows


def _assert_same_plan(plan: Plan, expected: Plan) -> None:
    for name in Plan._fields[:-1]:
        torch.testing.assert_close(
            getattr(plan, name), getattr(expected, name), equal_nan=True, msg=lambda text, name=name: f"{name}: {text}"
        )


@pytest.fixture
def assert_same_plan() -> Callable[..., Any]:
    return _assert_same_plan


def _count_calls(monkeypatch, world, name: str) -> list[tuple]:
    """The shapes of the first argument of every call of a method of the world, from now on."""
    method, shapes = getattr(world, name), []

    def counted(latent, *arguments):
        shapes.append(tuple(latent.shape))
        return method(latent, *arguments)

    monkeypatch.setattr(world, name, counted)
    return shapes


@pytest.fixture
def count_calls() -> Callable[..., Any]:
    return _count_calls


def _run(planner, tensordict, *, seed: int = 0):
    """The planner's output on a copy of the input, with seeded noise."""
    torch.manual_seed(seed)
    return planner(tensordict.clone())


@pytest.fixture
def run() -> Callable[..., Any]:
    return _run


def _expected_plan(planner, observation, carried, *, seed: int = 0) -> Plan:
    """The same from ``plan``."""
    torch.manual_seed(seed)
    return planner.plan(observation, carried, explore=False, noise=planner.draw_noise(len(observation)))


@pytest.fixture
def expected_plan() -> Callable[..., Any]:
    return _expected_plan


def _elites_by_hand(planner, actions, scores) -> tuple[list[int], list[float]]:
    """Indices and weights of the best of N candidates by plain loops; the scores are finite."""
    scores = scores.tolist()
    best = sorted(range(len(scores)), key=lambda n: -scores[n])[: planner.num_elites]
    weights = [math.exp(planner.inverse_temperature * (scores[n] - scores[best[0]])) for n in best]
    return best, [weight / sum(weights) for weight in weights]


@pytest.fixture
def elites_by_hand() -> Callable[..., Any]:
    return _elites_by_hand
