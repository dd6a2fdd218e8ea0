"""Where a search begins: wide, or where the policy is."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from torchrl_etdmpc import LatentEnv
from torchrl_etdmpc.planners import EnsembleMPPIPlanner
from torchrl_etdmpc.testing import LineWorld

BOUNDS = {"proposal_log_std_min": -2.0, "proposal_log_std_max": 1.0}


def policy_by_hand(planner, latent, log_std_bounds=None) -> tuple[torch.Tensor, torch.Tensor]:
    """Mean and standard deviation ``[H, A]`` of one state by plain loops over heads and steps."""
    model, means, variances = planner.world_model, [], []
    for head in range(model.num_dynamics):
        here, mine = latent, []
        for _ in range(planner.horizon):
            mean, log_std = model.policy(here, log_std_bounds)
            mine.append((mean, log_std.exp() ** 2))
            # Every head moves a copy of the state; only one of them is followed.
            here = model.next(here.expand(model.num_dynamics, -1), mean.expand(model.num_dynamics, -1))[head]
        means.append(torch.stack([mean for mean, _ in mine]))
        variances.append(torch.stack([variance for _, variance in mine]))
    mean = sum(means) / len(means)
    second_moment = sum(v + m**2 for m, v in zip(means, variances, strict=True)) / len(means)
    return mean, (second_moment - mean**2).sqrt()


def first_candidates(planner, observation, noise, **options) -> torch.Tensor:
    plan = planner.plan(observation, noise=noise, trace=True, **options)
    return plan.trace.actions[:, 0, planner.num_proposals :]


@pytest.mark.parametrize("bounds", [{}, BOUNDS])
@torch.no_grad()
def test_the_first_candidates_are_drawn_from_the_policy(bounds, make_planner, states):
    planner, observation = make_planner(initial="policy", std_min=1e-6, **bounds), states(4)
    noise = planner.draw_noise(4)
    found = first_candidates(planner, observation, noise)
    for state, latent in enumerate(planner.world_model.encode(observation)):
        mean, std = policy_by_hand(planner, latent, (-2.0, 1.0) if bounds else None)
        expected = (mean + std.clamp(max=planner.std_max) * noise.candidates[state, 0]).clamp(-1, 1)
        torch.testing.assert_close(found[state], expected)


def test_its_deviation_is_within_the_bounds_of_the_search(make_planner, states):
    observation = states(4)
    planner = make_planner(initial="policy", std_min=0.3, std_max=0.3)
    noise = planner.draw_noise(4)
    latent = planner.world_model.encode(observation)
    means = torch.stack([policy_by_hand(planner, state)[0] for state in latent])
    expected = (means.unsqueeze(1) + 0.3 * noise.candidates[:, 0]).clamp(-1, 1)
    torch.testing.assert_close(first_candidates(planner, observation, noise), expected)


def test_a_carried_plan_is_read_by_a_wide_search_alone(make_planner, make_model, states):
    model, observation = make_model(), states(4)
    carried = torch.full((4, 3, 2), 0.9, dtype=torch.float64)
    for initial, read in (("wide", True), ("policy", False)):
        planner = make_planner(model, initial=initial, warm_start=True)
        noise = planner.draw_noise(4)
        cold, warm = (first_candidates(planner, observation, noise, plan_mean=plan) for plan in (None, carried))
        assert torch.equal(cold, warm) is not read


def test_it_carries_its_plan_on_all_the_same(make_planner, states):
    """An environment with the planner's primer works with either."""
    planner = make_planner(initial="policy", warm_start=True)
    carried = torch.zeros(4, 3, 2, dtype=torch.float64)
    out = planner(TensorDict({"observation": states(4), "plan_mean": carried}, batch_size=[4]))
    assert out["next", "plan_mean"].shape == (4, 3, 2)


def test_a_small_search_around_a_good_policy_keeps_it_where_a_wide_one_loses_it():
    """Six candidates in one iteration know no better than a policy that goes to the goal."""
    budget = {"horizon": 3, "num_samples": 6, "num_elites": 2, "num_proposals": 0, "iterations": 1}
    world = LineWorld(policy_gain=1.0, log_std_bounds=(-3.0, -1.0))
    observation = torch.linspace(-2, 2, 200).unsqueeze(-1)
    best, _ = world.policy(world.encode(observation))
    distance = {}
    for initial in ("wide", "policy"):
        planner = EnsembleMPPIPlanner(LatentEnv(world), initial=initial, warm_start=False, **budget)
        distance[initial] = (planner.plan(observation, explore=False).loc - best).abs().mean().item()
    assert distance["policy"] < distance["wide"] / 2
