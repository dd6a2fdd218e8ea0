from __future__ import annotations

import pytest
import torch

from torchrl_etdmpc.inspector.studies import choose_states, value_bias
from torchrl_etdmpc.inspector.studies.replan import generator_of, replan
from torchrl_etdmpc.testing import LQRWorld

DISCOUNT, OFFSET = 0.9, 2.0


def test_an_offset_of_the_values_is_found_less_the_share_that_is_the_prediction_itself(make_episodes, make_planner):
    world = LQRWorld(discount=DISCOUNT, num_values=2, value_offset=[OFFSET + 1, OFFSET - 1], policy_gain=1.0)
    episodes = make_episodes(world, world.optimal_action, steps=10)
    states = choose_states(episodes, 12)
    result = value_bias.value_bias(make_planner(world, discount=DISCOUNT, score="final"), episodes, states)
    share = DISCOUNT ** (10 - states.step)
    assert torch.allclose(result.own_share, share)
    assert torch.allclose(result.bias[:, 0], OFFSET * (1 - share), atol=1e-4)
    # The plan is worth as much, and its value stands three steps further on.
    assert torch.allclose(result.bias[:, 1], OFFSET * (DISCOUNT**3 - share), atol=0.02)


def test_the_plan_is_made_from_the_warm_start_of_its_decision(make_episodes, make_planner):
    world = LQRWorld(discount=DISCOUNT)
    planner = make_planner(world, discount=DISCOUNT, iterations=1)
    episodes = [
        episode._replace(plan_mean=torch.full_like(episode.plan_mean, 0.8))
        for episode in make_episodes(world, world.optimal_action)
    ]
    states = choose_states(episodes, 12)
    result = value_bias.value_bias(planner, episodes, states, seed=2)
    plan = replan(planner, states.observation, states.plan_mean, generator=generator_of(planner, 2))
    assert torch.equal(result.predicted[:, 1], plan.value)


def test_after_an_end_nothing_is_promised(make_episodes, make_planner):
    world = LQRWorld(discount=DISCOUNT, value_offset=[OFFSET])
    episodes = make_episodes(world, world.optimal_action, steps=4)
    episodes = [episode._replace(terminated=True) for episode in episodes]
    states = choose_states(episodes, 100)
    result = value_bias.value_bias(make_planner(world, discount=DISCOUNT), episodes, states)
    assert not result.own_share.any()
    last = states.step == 3
    assert torch.allclose(result.followed[last], torch.stack([episode.reward[-1] for episode in episodes]))


def test_the_lines_say_bias_and_scale():
    predicted = torch.stack([torch.arange(12.0) + 1, torch.arange(12.0) - 2], dim=-1)
    result = value_bias.ValueBias(
        predicted, torch.arange(12.0), torch.arange(12) / 22, torch.arange(12) % 3, torch.arange(12)
    )
    rows = value_bias.table(result)
    assert [row["mean_own_share"] for row in rows] == pytest.approx([0.25, 0.25])
    assert [row["bias"] for row in rows] == [1, -2]
    assert [row["correlation"] for row in rows] == pytest.approx([1, 1])
    points = value_bias.figure(result).axes[1].collections[0].get_offsets()
    assert points.tolist() == [[step, 1] for step in range(12)]
    assert value_bias.lines(result)[0] == (
        "value: +1.00 [+1.00, +1.00] against the return that followed (5.5 +- 3.6), correlation 1.00"
    )


def test_the_interval_of_a_bias_is_over_episodes():
    episode = torch.arange(40) // 20
    predicted = episode.unsqueeze(-1).expand(-1, 2).float()
    result = value_bias.ValueBias(predicted, torch.zeros(40), torch.zeros(40), episode, torch.arange(40) % 20)
    assert {(row["low"], row["bias"], row["high"]) for row in value_bias.table(result)} == {(0.0, 0.5, 1.0)}
