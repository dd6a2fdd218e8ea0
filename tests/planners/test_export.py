from __future__ import annotations

import pytest
import torch

from torchrl_etdmpc import EnsembleMPPIPlanner, LatentEnv, WorldModel, export_planner, export_policy
from torchrl_etdmpc.testing import LineWorld


def make_model(**options) -> WorldModel:
    torch.manual_seed(0)
    model = WorldModel(5, 2, latent_dim=16, mlp_dim=16, encoder_dim=16, **options)
    for parameter in model.parameters():
        if parameter.ndim > 1:
            torch.nn.init.normal_(parameter, std=parameter.shape[-2] ** -0.5)
    return model


def make_planner(model: torch.nn.Module, **options) -> EnsembleMPPIPlanner:
    budget = {"horizon": 3, "num_samples": 24, "num_elites": 6, "num_proposals": 4, "iterations": 2}
    return EnsembleMPPIPlanner(LatentEnv(model), **budget, **options)


@pytest.mark.parametrize("states", [1, 2, 7])
def test_the_exported_policy_acts_like_the_live_one_for_any_number_of_states(states):
    model, observation = make_model(), torch.randn(states, 5)
    with torch.no_grad():
        expected, _ = model.policy(model.encode(observation))
        torch.testing.assert_close(export_policy(model).module()(observation), expected)


@pytest.mark.parametrize("make", [make_model, lambda: make_model().double(), lambda: LineWorld(action_dim=5)])
@pytest.mark.parametrize("states", [1, 3])
def test_the_exported_planner_plans_like_the_live_one_and_draws_new_noise(states, make):
    planner = make_planner(make())
    dtype = planner.draw_noise(1).action.dtype
    observation = torch.randn(states, 5, dtype=dtype)
    plan_mean = torch.rand(states, 3, planner.world_model.action_dim, dtype=dtype) * 2 - 1
    program = export_planner(planner, batch_size=states).module()
    torch.manual_seed(1)
    action, mean = program(observation, plan_mean)
    torch.manual_seed(1)
    plan = planner.plan(observation, plan_mean, explore=False)
    torch.testing.assert_close(action, plan.action)
    torch.testing.assert_close(mean, plan.mean)
    assert not torch.equal(program(observation, plan_mean)[1], mean)


def test_a_compiled_plan_is_not_what_is_exported():
    planner = make_planner(make_model())

    def fail(*args, **kwargs):
        raise AssertionError("the compiled plan was called")

    planner.compiled_plan = fail
    export_planner(planner)
    assert planner.compiled_plan is fail


def test_no_batch_is_refused():
    with pytest.raises(ValueError, match=r"^batch_size must be at least 1, got 0\.$"):
        export_planner(make_planner(make_model()), batch_size=0)
