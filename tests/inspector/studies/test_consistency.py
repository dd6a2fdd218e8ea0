from __future__ import annotations

import pytest
import torch

from torchrl_etdmpc.inspector.studies import choose_states, consistency
from torchrl_etdmpc.inspector.studies.replan import generator_of, replan
from torchrl_etdmpc.testing import LineWorld

MOVED = 0.3


@pytest.fixture
def world():
    return LineWorld(goal=0.0, policy_gain=1.0)


def test_a_plan_that_was_right_survives_and_one_that_was_moved_is_as_far_as_it_was_moved(
    world, make_episodes, make_planner
):
    planner = make_planner(world, std_min=0.05, inverse_temperature=200.0)
    found = {}
    for moved in (0.0, MOVED):
        episodes = [
            # Everything stands at the goal, where the best plan is to stay.
            episode._replace(
                observation=torch.zeros_like(episode.observation),
                plan_mean=torch.full_like(episode.plan_mean, moved),
            )
            for episode in make_episodes(world, torch.zeros_like)
        ]
        found[moved] = consistency.consistency(planner, choose_states(episodes, 9))
    assert found[0.0].change.shape[1:] == (3, 3)
    first = (MOVED / found[MOVED].std)[:, 0]
    assert torch.allclose(found[MOVED].change[:, 0, 0], first, rtol=0.25)
    assert (found[0.0].change[:, :, 0] < 1).all()
    assert found[0.0].change[:, :2, -1].isnan().all()  # the plan before ends there
    assert not found[0.0].change[:, 2].isnan().any()


def test_every_change_is_measured_by_the_last_deviation_of_the_plan_from_the_warm_start(
    world, make_episodes, make_planner
):
    planner = make_planner(world)
    states = choose_states(make_episodes(world, world.optimal_action), 9)  # whose plans before are zeros
    result = consistency.consistency(planner, states, seed=3)
    kept, generator = states.step > 0, generator_of(planner, 3)
    warm, _, cold = (
        replan(planner, states.observation[kept], carried, generator=generator, trace=True)
        for carried in (states.plan_mean[kept], states.plan_mean[kept], None)
    )
    std = warm.trace.std[:, -1]
    assert torch.allclose(result.std, std.mean(-1))
    for row, plan in enumerate((warm, cold)):
        assert torch.allclose(result.change[:, row, :-1], (plan.mean / std).abs()[:, :-1, 0])


def test_the_plan_before_is_compared_a_step_further_on_and_other_samples_are_other_ones(
    world, make_episodes, make_planner
):
    planner, before = make_planner(world), torch.tensor([[0.5], [-0.25], [0.1]])
    episodes = [
        episode._replace(plan_mean=before.expand(len(episode.reward), -1, -1))
        for episode in make_episodes(world, world.optimal_action)
    ]
    states = choose_states(episodes, 9)
    result, kept = consistency.consistency(planner, states, seed=3), states.step > 0
    observation, carried = states.observation[kept], states.plan_mean[kept]
    generator = generator_of(planner, 3)
    warm, again = (replan(planner, observation, carried, generator=generator, trace=True) for _ in range(2))
    moved = (warm.mean[:, :-1] - before[1:]) / warm.trace.std[:, -1, :-1]
    assert torch.allclose(result.change[:, 0, :-1], moved.abs()[..., 0])
    assert torch.allclose(result.change[:, 2], ((warm.mean - again.mean) / warm.trace.std[:, -1]).abs()[..., 0])
    assert (result.change[:, 2] > 0).all()


def test_first_decisions_are_left_out_and_states_without_plans_refused(world, make_episodes, make_planner):
    planner, episodes = make_planner(world), make_episodes(world, world.optimal_action, steps=4)
    states = choose_states(episodes, 100)
    result = consistency.consistency(planner, states)
    assert len(result.episode) == 3 * 3
    assert len(consistency.table(result)) == 2 + 2 + 3
    assert [len(line.lines[0].get_xdata()) for line in consistency.figure(result).axes[0].containers] == [2, 2, 3]
    for none in (states._replace(plan_mean=None), states._replace(step=torch.zeros_like(states.step))):
        with pytest.raises(ValueError, match="states must have plans before them, got none; play the episodes with"):
            consistency.consistency(planner, none)


def test_a_planner_that_reads_no_plan_before_is_refused(world, make_episodes, make_planner):
    states = choose_states(make_episodes(world, world.optimal_action, steps=4), 100)
    with pytest.raises(ValueError, match="reads no plan before"):
        consistency.consistency(make_planner(world, initial="policy"), states)


def test_a_page_says_how_many_plans_moved_by_less_than_one_deviation():
    change = torch.tensor([[0.5, 9.0], [0.9, 9.0], [0.2, 9.0], [4.0, 9.0]]).unsqueeze(1).expand(-1, 3, -1)
    std = torch.tensor([1.0, 2.0]).expand(4, -1)
    result = consistency.Consistency(change, std, torch.arange(4) // 2)
    rows = consistency.table(result)
    assert [row["within_one_std"] for row in rows] == [0.75, 0.0] * 3
    assert [row["std"] for row in rows] == [1.0, 2.0] * 3
    said = consistency.lines(result)
    assert [line.partition(",")[0] for line in said] == list(consistency.COMPARED)
    assert said[0].endswith("moved by 1.40 std [0.70, 2.10], in 75% of the states by less than one")


def test_the_interval_of_a_change_is_over_episodes():
    episode = torch.arange(40) // 20
    change = episode.view(40, 1, 1).expand(-1, 3, 2).float()
    rows = consistency.table(consistency.Consistency(change, torch.ones(40, 2), episode))
    assert {(row["low"], row["change_in_std"], row["high"]) for row in rows} == {(0.0, 0.5, 1.0)}
