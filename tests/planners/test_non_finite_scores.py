from __future__ import annotations

import math

import pytest
import torch

from torchrl_etdmpc import Plan
from torchrl_etdmpc.functional import shift_plan
from torchrl_etdmpc.testing import LineWorld

_MODES = ("elite", "mean", "best")
_WIDE = {"proposal_log_std_min": -2.0, "proposal_log_std_max": 1.0}


class PatchyWorld(LineWorld):
    """A line world whose reward is ``bad`` for actions below ``edge`` and for positions beyond 10."""

    def __init__(self, *, bad: float = torch.nan, edge: float = -1.0, **options) -> None:
        super().__init__(**options)
        self.bad, self.edge = bad, edge

    def reward(self, latent, action):
        spoilt = (action[..., 0] < self.edge) | (latent[..., 0] > 10)
        return torch.where(spoilt, self.bad, super().reward(latent, action))


@pytest.mark.parametrize("mode", _MODES)
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_non_finite_candidate_is_never_an_elite(bad, mode, make_planner):
    # All returns are negative, so a candidate that counted as 0 would win.
    world = PatchyWorld(bad=bad, edge=-0.2, goal=2.0)
    planner = make_planner(world, num_samples=64, iterations=6, eval_first_action=mode)
    plan = planner.plan(torch.zeros(4, 1), explore=False, trace=True)
    assert not plan.trace.scores.isfinite().all()
    assert plan.trace.scores[plan.trace.scores.isfinite()].max() < 0
    assert all(field.isfinite().all() for field in (plan.loc, plan.scale, plan.value, *plan.trace[3:]))
    torch.testing.assert_close(plan.loc, torch.ones(4, 1), atol=0.1, rtol=0)
    assert not plan.fallback.any()


@pytest.mark.parametrize("mode", _MODES)
def test_a_plan_stays_out_of_a_non_finite_region_even_if_the_optimum_lies_within(mode, make_planner):
    world = PatchyWorld(edge=-0.2, goal=-2.0)
    plan = make_planner(world, num_samples=64, iterations=6, eval_first_action=mode).plan(
        torch.zeros(4, 1), explore=False
    )
    assert (plan.loc >= -0.2).all()
    assert (plan.loc < 0.1).all()
    assert (plan.mean >= -0.2).all()


def test_the_value_of_a_mean_action_is_that_of_the_finite_candidates_alone(make_planner):
    options = {"horizon": 1, "num_samples": 4, "num_elites": 3, "num_proposals": 0, "iterations": 1}
    planner = make_planner(PatchyWorld(edge=-0.5), first_action="mean", **options)
    noise = planner.draw_noise(1)
    noise = noise._replace(candidates=torch.tensor([0.2, -0.8, -0.7, -0.9]).view(1, 1, 4, 1, 1) / 2.0)
    plan = planner.plan(torch.zeros(1, 1), noise=noise, trace=True)
    torch.testing.assert_close(plan.value, plan.trace.scores[:, 0, 0])


def test_fewer_finite_candidates_than_elites_share_all_the_weight(make_planner):
    planner = make_planner(
        PatchyWorld(edge=-0.5), horizon=1, num_samples=4, num_elites=3, num_proposals=0, iterations=1, std_min=1e-3
    )
    noise = planner.draw_noise(1)
    actions = torch.tensor([0.2, -0.8, 0.6, -0.9])
    noise = noise._replace(candidates=actions.view(1, 1, 4, 1, 1) / 2.0)
    plan = planner.plan(torch.zeros(1, 1), noise=noise, trace=True)
    scores = plan.trace.scores[0, 0]
    assert scores.isfinite().tolist() == [True, False, True, False]
    better = 1 / (1 + math.exp(0.5 * (scores[0] - scores[2])))
    mean = 0.2 + 0.4 * better
    assert plan.mean.item() == pytest.approx(mean)
    assert plan.scale.item() == pytest.approx(math.sqrt((1 - better) * (0.2 - mean) ** 2 + better * (0.6 - mean) ** 2))


@pytest.mark.parametrize("explore", [True, False])
@pytest.mark.parametrize("mode", _MODES)
def test_without_any_finite_score_the_policy_acts_in_that_state_only(
    mode, explore, make_planner, rows, assert_same_plan
):
    world = PatchyWorld(goal=0.3, policy_gain=0.5)
    planner = make_planner(world, first_action=mode, eval_first_action=mode, **_WIDE)
    observation, carried = torch.tensor([[0.0], [20.0], [0.5]]), torch.rand(3, 3, 1)
    noise = planner.draw_noise(3)
    plan = planner.plan(observation, carried, noise=noise, explore=explore, trace=True)
    assert plan.fallback.tolist() == [False, True, False]
    # The policy's own mean and std: half the best action, and the middle of the bounds (-3, 1).
    assert plan.loc[1].item() == -0.5
    assert plan.scale[1].item() == pytest.approx(math.exp(-1))
    action = -0.5 + math.exp(-1) * noise.action[1].item() if explore else -0.5
    assert plan.action[1].item() == pytest.approx(max(min(action, 1), -1))
    assert plan.value.isnan().tolist() == [False, True, False]
    torch.testing.assert_close(plan.mean[1], shift_plan(carried[1]))  # where it started
    others = planner.plan(observation[[0, 2]], carried[[0, 2]], noise=rows(noise, [0, 2]), explore=explore)
    assert_same_plan(Plan(*(field[[0, 2]] for field in plan[:-1]), None), others)


@pytest.mark.parametrize(("bounds", "expected"), [({"std_min": 0.5}, 0.5), ({"std_max": 0.25}, 0.25)])
def test_the_scale_of_the_fallback_stays_within_the_planners_bounds(bounds, expected, make_planner):
    plan = make_planner(PatchyWorld(), **bounds).plan(torch.tensor([20.0]))
    assert plan.fallback.item()
    assert plan.scale.item() == expected
