from __future__ import annotations

import pytest
import torch

from torchrl_etdmpc.inspector.studies import advantage, choose_states
from torchrl_etdmpc.testing import LineWorld

HORIZON = 5


def true_sum(world: LineWorld, start: torch.Tensor, steps: int) -> float:
    """Of the optimal actions for some steps, and of standing still from then on."""
    latent, total = world.encode(start), 0.0
    for step in range(HORIZON):
        action = world.optimal_action(latent) if step < steps else torch.zeros(1)
        total += world.reward(latent, action).item()
        latent = world.transition(latent, action)
    return total


@pytest.fixture
def measure(make_episodes, make_planner, WorldSimulator):
    def run(world: LineWorld, steps: int) -> tuple[advantage.Advantage, torch.Tensor]:
        states = choose_states(make_episodes(world, torch.zeros_like), 5, ahead=HORIZON)
        planner = make_planner(world)
        return advantage.advantage(planner, states, WorldSimulator(world), steps=steps, horizon=HORIZON), states

    return run


@pytest.mark.parametrize("steps", [1, 3])
def test_the_planner_gains_what_the_best_actions_gain_over_a_policy_that_stands_still(measure, steps):
    world = LineWorld(policy_gain=0.0)
    result, states = measure(world, steps)
    policy = [true_sum(world, start, 0) for start in states.observation]
    planned = [true_sum(world, start, steps) for start in states.observation]
    assert result.policy.tolist() == pytest.approx(policy, rel=1e-4)
    assert result.planned.tolist() == pytest.approx(planned, abs=0.1)
    assert (result.difference > 0.5).all()
    sorted_ones = advantage.figure(result).axes[1].lines[0].get_ydata()
    assert sorted_ones.tolist() == sorted(result.difference.tolist())


def test_nothing_is_gained_over_an_optimal_policy(measure):
    result, _ = measure(LineWorld(policy_gain=1.0), 3)
    assert (result.difference <= 1e-4).all()
    assert (result.difference > -0.1).all()


def test_every_plan_begins_from_the_one_before(measure, monkeypatch):
    given, plans = [], []

    def replan(planner, observation, carried, **options):
        given.append(carried)
        plans.append(replan_state(planner, observation, carried, **options))
        return plans[-1]

    replan_state = advantage.replan
    monkeypatch.setattr(advantage, "replan", replan)
    _, states = measure(LineWorld(), 3)
    for index in range(5):
        first, *following = given[3 * index : 3 * index + 3]
        assert torch.equal(first, states.plan_mean[index : index + 1])
        assert all(map(torch.equal, following, (plan.mean for plan in plans[3 * index : 3 * index + 2])))


def test_the_planner_acts_within_the_horizon(measure):
    with pytest.raises(ValueError, match=r"steps must be in 1..horizon=5, got 6"):
        measure(LineWorld(), 6)


def test_the_median_of_an_even_number_lies_in_the_middle():
    earned = torch.tensor([0.0, 1.0, 3.0, 100.0])
    result = advantage.Advantage(earned, torch.zeros(4), torch.zeros(4, 2), 1, 2, torch.arange(4))
    (row,) = advantage.table(result)
    assert row["median"] == 2.0


def test_a_draw_is_won_by_neither_the_planner_nor_the_policy():
    planned = torch.tensor([3.0, 3.0, 3.0, 2.0, 0.0])
    result = advantage.Advantage(planned, torch.full((5,), 2.0), torch.zeros(5, 2), 1, 2, torch.arange(5))
    (row,) = advantage.table(result)
    shares = [row[name] for name in ("planner_better", "policy_better", "mean_policy")]
    assert shares == pytest.approx([0.6, 0.2, 2.0])
    assert advantage.lines(result)[1] == "the planner earned more in 60% of 5 states, the policy in 20%"


def test_the_interval_of_a_difference_is_over_episodes():
    episode = torch.arange(40) // 20
    result = advantage.Advantage(episode.float(), torch.zeros(40), torch.zeros(40, 2), 1, 2, episode)
    (row,) = advantage.table(result)
    assert (row["low"], row["difference"], row["high"]) == (0.0, 0.5, 1.0)


@pytest.mark.parametrize("scale", [1e-6, 0.1, 0.3, 2.0, 70.0])
def test_ticks_of_the_differences_do_not_overlap(scale):
    draws = torch.linspace(-1, 1, 401) * scale
    earned = draws * (1 + 100 * draws.abs().div(scale).pow(20))  # a few states make all the difference
    result = advantage.Advantage(earned, torch.zeros(401), torch.randn(401, 4), 1, 2, torch.arange(401))
    picture = advantage.figure(result)
    picture.draw_without_rendering()
    axis = picture.axes[1].yaxis
    low, high = axis.get_view_interval()
    extents = [tick.label1.get_window_extent() for tick in axis.get_major_ticks() if low <= tick.get_loc() <= high]
    extents.sort(key=lambda extent: extent.y0)
    assert len(extents) >= 3
    assert all(below.y1 <= above.y0 for below, above in zip(extents, extents[1:], strict=False))
