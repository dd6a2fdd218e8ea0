from __future__ import annotations

import pytest
import torch

from torchrl_etdmpc.inspector.studies import choose_states, cross_scoring
from torchrl_etdmpc.modules import ActionValueWorldModel
from torchrl_etdmpc.planners import EnsembleMPPIPlanner, LatentEnv
from torchrl_etdmpc.testing import LineWorld

BUDGET = {"num_samples": 256, "num_elites": 16}


def test_one_head_s_trap_is_exploited_alone_and_seen_through_by_the_ensemble(
    make_episodes, make_planner, WorldSimulator
):
    # At the goal: a wrong way and back costs 0.03 or more, for which head 0 promises 0.1, the mean of the heads 0.025.
    world = LineWorld(goal=0.0, num_dynamics=4, trap=(-1.0, -0.5), trap_bonus=0.1, policy_gain=1.0)
    states = choose_states(make_episodes(world, world.optimal_action), 6, ahead=3)
    goal = torch.zeros_like(states.observation)
    states = states._replace(observation=goal, simulator=list(goal))
    result = cross_scoring.cross_scoring(make_planner(world), states, WorldSimulator(world), **BUDGET)
    single, ensemble = result.gain.unbind(1)
    assert (single[:, 0] > 0.03 * result.scale).all()  # what it believes
    assert (single[:, 2] < -0.03 * result.scale).all()  # what happens
    assert (ensemble[:, 2] > -0.01 * result.scale).all()
    assert (ensemble[:, 2] <= 0).all()  # the policy is optimal
    assert (single[:, 1] < ensemble[:, 1]).all()  # nor does the ensemble think much of it


def test_all_estimates_agree_where_all_heads_are_exact(make_episodes, make_planner, WorldSimulator):
    world = LineWorld(num_dynamics=2, num_values=2, policy_gain=0.5)
    episodes = make_episodes(world, world.optimal_action, count=8, steps=3)  # from far off the goal
    states = choose_states(episodes, 8, ahead=3)
    result = cross_scoring.cross_scoring(make_planner(world), states, WorldSimulator(world), decisions=60, **BUDGET)
    assert result.returns.shape == (8, 3, 3)
    assert torch.allclose(result.returns, result.returns[..., :1].expand_as(result.returns), atol=1e-5)
    assert result.scale == 20
    assert torch.allclose(result.gain[:, 0], 20 * (result.returns[:, 0] - result.returns[:, 2]))
    assert (result.gain[:, :, 2] > 0).all()  # half of the best action is not the best


def test_a_planner_that_is_pessimistic_is_compared_without(make_episodes, make_planner, WorldSimulator):
    world = LineWorld(num_dynamics=2, num_values=2, value_offset=[0.2, -0.2], policy_gain=0.5)
    states = choose_states(make_episodes(world, world.optimal_action), 4, ahead=3)
    planners = make_planner(world), make_planner(world, score="adaptive", beta=3.0)
    one, other = (cross_scoring.cross_scoring(it, states, WorldSimulator(world), **BUDGET) for it in planners)
    assert torch.equal(one.returns, other.returns)


def test_the_budget_of_plans_is_the_study_s_own_but_for_proposals_that_the_planner_has_none_of(
    make_episodes, make_planner, WorldSimulator
):
    world = LineWorld(num_dynamics=2, policy_gain=0.5)
    states = choose_states(make_episodes(world, world.optimal_action), 4, ahead=3)

    def found(wanted: int, **settings):
        planner = make_planner(world, **settings)
        options = {"num_samples": 16, "num_elites": 4, "iterations": 1, "num_proposals": wanted}
        return cross_scoring.cross_scoring(planner, states, WorldSimulator(world), **options).returns

    assert torch.equal(found(3), found(3, extra_iterations=4, large_action_dim=0))
    assert torch.equal(found(0), found(3, num_proposals=0))
    assert not torch.equal(found(0), found(3))


def test_an_agent_of_one_head_has_no_ensemble_to_compare_with(make_episodes, make_planner, WorldSimulator):
    world = LineWorld(num_dynamics=1, num_values=1)
    states = choose_states(make_episodes(world, world.optimal_action), 2, ahead=3)
    with pytest.raises(ValueError, match="a single head is the ensemble"):
        cross_scoring.cross_scoring(make_planner(world), states, WorldSimulator(world), **BUDGET)


def test_a_critic_whose_heads_are_drawn_is_refused(make_episodes):
    world = LineWorld()
    states = choose_states(make_episodes(world, world.optimal_action), 2, ahead=3)
    planner = EnsembleMPPIPlanner(LatentEnv(ActionValueWorldModel(1, 1, latent_dim=16, mlp_dim=16, encoder_dim=16)))
    with pytest.raises(ValueError, match="critic must be of states, got ActionValueWorldModel, with which plans"):
        cross_scoring.cross_scoring(planner, states, None, **BUDGET)


def test_the_table_has_an_interval_around_every_gain():
    returns = torch.rand(40, 3, 3)
    result = cross_scoring.CrossScores(returns, 100.0, torch.arange(40) % 8)
    rows = cross_scoring.table(result)
    assert len(rows) == 6
    found = next(row for row in rows if (row["found_by"], row["scored_by"]) == ("ensemble", "simulator"))
    assert found["gain"] == pytest.approx(100 * (returns[:, 1, 2] - returns[:, 2, 2]).mean().item(), rel=1e-4)
    assert all(row["low"] < row["gain"] < row["high"] for row in rows)
    bars = [bar.get_height() for bar in cross_scoring.figure(result).axes[0].patches]
    assert sorted(bars) == pytest.approx(sorted(row["gain"] for row in rows))


def test_the_median_of_an_even_number_lies_in_the_middle_and_the_error_is_that_of_a_sample():
    returns = torch.zeros(4, 3, 3)
    returns[:, :2] = torch.tensor([0.0, 1.0, 3.0, 100.0]).view(4, 1, 1)
    rows = cross_scoring.table(cross_scoring.CrossScores(returns, 1.0, torch.arange(4)))
    assert {row["median"] for row in rows} == {2.0}
    assert [row["standard_error_over_states"] for row in rows] == pytest.approx([24.67] * 6, abs=0.01)


def test_the_lines_set_what_is_believed_beside_what_is_true():
    gains = torch.tensor([[3.0, 2.0, 1.0], [6.0, 5.0, 4.0], [0.0, 0.0, 0.0]])
    result = cross_scoring.CrossScores(gains.expand(4, 3, 3), 10.0, torch.arange(4))
    assert cross_scoring.lines(result) == [
        "planned with single head: believes in +30.0 per episode over the policy, the simulator gives +10.0 "
        "[+10.0, +10.0]",
        "planned with ensemble: believes in +50.0 per episode over the policy, the simulator gives +40.0 "
        "[+40.0, +40.0]",
    ]


def test_the_interval_of_a_gain_is_over_episodes():
    returns = torch.zeros(40, 3, 3)
    returns[:20, :2] = 1.0
    rows = cross_scoring.table(cross_scoring.CrossScores(returns, 1.0, torch.arange(40) // 20))
    assert {(row["low"], row["gain"], row["high"]) for row in rows} == {(0.0, 0.5, 1.0)}
