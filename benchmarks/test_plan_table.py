"""Milliseconds per plan by heads, horizon, samples and batch, at the thesis' width: the table of README.md."""

from __future__ import annotations

import pytest
import torch
from sized import COMPILED, DEVICE, assert_same_plan, draw, make_agent, plan_of

SIZES = [(heads, horizon, samples) for heads in (1, 2, 4) for horizon in (3, 6) for samples in (128, 512)]
BATCHES = [1, 16] if DEVICE.type == "cuda" else [1]


@pytest.mark.parametrize("states", BATCHES)
@pytest.mark.parametrize(("heads", "horizon", "samples"), SIZES)
def test_plan_by_size(measure, heads, horizon, samples, states):
    """Six iterations, an eighth of the samples as elites, 24 proposals, two values, the mean over depths."""
    budget = {"horizon": horizon, "num_samples": samples, "num_elites": samples // 8}
    changes = {"model": {"num_dynamics": heads}, "planner": budget}
    _, reference = make_agent("thesis", **changes)
    _, agent = make_agent("thesis", COMPILED[-1], **changes)
    observation, noise = draw(reference.planner, states)
    with torch.no_grad():
        expected = reference.planner.plan(observation, noise=noise)
        plan = plan_of(agent.planner)
        assert_same_plan(plan(observation, noise=noise), expected)
        flop = measure.flop(lambda: reference.planner.plan(observation))
        case = f"plan of {states}, {heads} heads, horizon {horizon}, {samples} samples"
        measure(case, COMPILED[-1], lambda: plan(observation), rounds=3, warmup_rounds=1, flop=flop)
