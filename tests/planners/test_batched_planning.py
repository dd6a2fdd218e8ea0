from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict

from torchrl_etdmpc import Plan, PlanTrace
from torchrl_etdmpc.planners import PlanNoise


def test_planning_a_batch_is_planning_each_state_alone(make_planner, states, rows, assert_same_plan):
    planner = make_planner(score="final", beta=1.0)
    observation, carried = states(5), 0.5 * torch.randn(5, 3, 2, dtype=torch.float64)
    noise = planner.draw_noise(5)
    together = planner.plan(observation, carried, noise=noise, trace=True)
    for i in range(5):
        alone = planner.plan(observation[i], carried[i], noise=rows(noise, i), trace=True)
        assert_same_plan(alone, Plan(*(field[i] for field in together[:-1]), None))
        for name in PlanTrace._fields:
            torch.testing.assert_close(getattr(alone.trace, name), getattr(together.trace, name)[i])


@pytest.mark.parametrize("explore", [True, False])
@pytest.mark.parametrize("batch_size", [(), (1,), (5,), (2, 3), (2, 1, 2)])
def test_any_leading_batch_is_planned(batch_size, explore, make_planner, states, assert_same_plan):
    planner = make_planner()
    size = math.prod(batch_size)
    observation, carried = states(size), torch.rand(size, 3, 2, dtype=torch.float64)
    noise = planner.draw_noise(size)
    flat = planner.plan(observation, carried, noise=noise, explore=explore, trace=True)

    def fold(tensor):
        return tensor.reshape(batch_size + tensor.shape[1:])

    folded = PlanNoise(*(fold(draw) for draw in noise))
    assert all(a.shape == b.shape for a, b in zip(planner.draw_noise(*batch_size), folded, strict=True))
    plan = planner.plan(fold(observation), fold(carried), noise=folded, explore=explore, trace=True)
    assert_same_plan(plan, Plan(*(fold(field) for field in flat[:-1]), None))
    for field, expected in zip(plan.trace, flat.trace, strict=True):
        torch.testing.assert_close(field, fold(expected))
    shapes = {"action": (2,), "loc": (2,), "scale": (2,), "value": (), "mean": (3, 2), "fallback": ()}
    assert {name: getattr(plan, name).shape for name in shapes} == {
        name: batch_size + shape for name, shape in shapes.items()
    }
    shapes = {"actions": (3, 24, 3, 2), "scores": (3, 24), "returns": (3, 24, 3, 2, 2), "mean": (3, 3, 2)}
    assert {name: getattr(plan.trace, name).shape for name in shapes} == {
        name: batch_size + shape for name, shape in shapes.items()
    }


@pytest.mark.parametrize("strange", [3.0, torch.nan])
def test_a_state_does_not_leak_into_the_others(strange, make_planner, states):
    planner = make_planner()
    observation, carried = states(3), torch.rand(3, 3, 2, dtype=torch.float64)
    noise = planner.draw_noise(3)
    before = planner.plan(observation, carried, noise=noise)
    observation[1], carried[1] = strange, strange
    after = planner.plan(observation, carried, noise=noise)
    for old, new in zip(before[:-1], after[:-1], strict=True):
        torch.testing.assert_close(old[[0, 2]], new[[0, 2]])
    assert not torch.equal(before.loc[1], after.loc[1])


def test_a_latent_can_take_the_place_of_the_observation(make_planner, make_model, states, assert_same_plan):
    model, observation = make_model(), states(4)
    planner = make_planner(model)
    noise = planner.draw_noise(4)
    latent = model.encode(observation)
    assert_same_plan(planner.plan(latent=latent, noise=noise), planner.plan(observation, noise=noise))


def test_an_observation_beside_a_latent_is_refused_unless_latents_are_not_read(
    make_planner, make_model, states, run, expected_plan
):
    # A rollout in the latent env keeps the observation that it began with; a pipeline may carry a stale latent.
    model, observation = make_model(), states(3)
    td = TensorDict({"observation": observation, "latent": model.encode(states(3))}, batch_size=[3])
    with pytest.raises(ValueError, match="found both 'observation' and 'latent'"):
        run(make_planner(model), td)
    out = run(make_planner(model, latent_key=None), td)
    torch.testing.assert_close(out["plan", "loc"], expected_plan(make_planner(model), observation, None).loc)


def test_the_key_of_the_latent_can_be_renamed(make_planner, make_model, states, run, expected_plan):
    model, observation = make_model(), states(3)
    td = TensorDict({"agent": {"z": model.encode(observation)}, "latent": states(3)}, batch_size=[3])
    out = run(make_planner(model, latent_key=("agent", "z")), td)
    torch.testing.assert_close(out["plan", "loc"], expected_plan(make_planner(model), observation, None).loc)
