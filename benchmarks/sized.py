"""Agents of the sizes that the benchmarks compare."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from torchrl_etdmpc import EnsembleMPPIPlanner
from torchrl_etdmpc.planners import Plan, PlanNoise
from torchrl_etdmpc.training import Agent, TrainConfig, build_agent, preset

OBSERVATION_DIM, ACTION_DIM = 24, 6  # walker
DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")
PRESETS = {"thesis": "efficient-tdmpc", "bmpc": "bmpc", "cpu": "cpu"}
SETTINGS = {"eager": "off", "compiled": "default", "cuda-graph": "auto"}
FORMER_CPU = (
    "model.num_bins=101",
    "model.normalize_observations=false",
    "planner.num_elites=10",
    "reanalyze.num_elites=6",
    "reanalyze.num_slices=6",
    "loss.tau=0.03",
    "loss.value_replayed=0",
    "loss.value_expectile=0.5",
    "loss.kl_direction=backward",
)
"""What the preset ``cpu`` had in earlier measurements, besides its width."""
COMPILED = ["compiled"] + (["cuda-graph"] if DEVICE.type == "cuda" else [])
VARIANTS = ["eager", *COMPILED]


def configure(name: str, variant: str = "eager", **changes) -> TrainConfig:
    """The preset of a size; a variant is ``eager``, ``compiled`` or ``cuda-graph``, with `` bf16`` for the scoring."""
    mode, *dtype = variant.split()
    values = preset(PRESETS.get(name, name)).to_dict() | {"compile": SETTINGS[mode]}
    if dtype:
        changes = {"planner": {"scoring_dtype": "bfloat16"}, "reanalyze": {"scoring_dtype": "bfloat16"}} | changes
    for key, value in changes.items():
        values[key] = values[key] | value if isinstance(value, dict) else value
    return TrainConfig.from_dict(values)


def make_agent(name: str, variant: str = "eager", **changes) -> tuple[TrainConfig, Agent]:
    """An agent whose networks answer as trained ones do: nothing is zero. Every variant gets the same weights."""
    torch.manual_seed(0)
    config = configure(name, variant, **changes)
    agent = build_agent(config, OBSERVATION_DIM, ACTION_DIM, DEVICE)
    for parameter in agent.world_model.parameters():
        if parameter.ndim > 1:
            torch.nn.init.normal_(parameter, std=parameter.shape[-2] ** -0.5)
    return config, agent


def draw(planner: EnsembleMPPIPlanner, states: int) -> tuple[Tensor, PlanNoise]:
    """Observations and the noise of one plan for each."""
    return torch.randn(states, OBSERVATION_DIM, device=DEVICE), planner.draw_noise(states)


def plan_of(planner: EnsembleMPPIPlanner) -> Callable[..., Plan]:
    """What the planner calls when it acts: its compiled plan if it has one."""
    return planner.compiled_plan or planner.plan


def assert_same_plan(plan, expected, variant: str = "eager") -> None:
    """Up to rounding, which may swap elites of nearly the same score; half precision swaps more of them.

    The TF32 products of a GPU round so much that a search may end elsewhere: what it finds must be worth the same.
    """
    if DEVICE.type == "cuda":
        torch.testing.assert_close(plan.value, expected.value, rtol=0.1, atol=0.1)
        return
    largest, mean = (0.5, 0.1) if variant.endswith("bf16") else (0.1, 1e-2)
    for field in ("mean", "scale"):
        difference = (getattr(plan, field) - getattr(expected, field)).abs()
        assert difference.max() < largest and difference.mean() < mean, field
