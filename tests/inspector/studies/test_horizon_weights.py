from __future__ import annotations

import pytest
import torch

from torchrl_etdmpc.functional import adaptive_mixture
from torchrl_etdmpc.inspector.settings import with_settings
from torchrl_etdmpc.inspector.studies import choose_states, horizon_weights
from torchrl_etdmpc.inspector.studies.replan import generator_of, replan
from torchrl_etdmpc.testing import LineWorld

DISCOUNT, APART = 0.5, 0.2


def test_the_weights_are_the_inverse_variances_where_all_depths_promise_the_same(make_episodes, make_planner):
    # At the goal every return is 0 and the values are APART beside it: sigma of depth h is APART * 0.5^h.
    world = LineWorld(goal=0.0, num_values=2, value_offset=[APART, -APART], policy_gain=1.0)
    episodes = make_episodes(world, torch.zeros_like)
    states = choose_states(episodes, 4)
    states = states._replace(observation=torch.zeros_like(states.observation))
    planner = make_planner(world, discount=DISCOUNT, std_min=1e-4, num_elites=8)
    result = horizon_weights.horizon_weights(planner, states, betas=(0.0, 10.0), horizon=4)
    assert result.weights.shape == (4, 2, 6, 4)
    assert torch.allclose(result.weights.sum(-1), torch.ones(4, 2, 6), atol=1e-5)
    sigma = APART * DISCOUNT ** torch.arange(1.0, 5)
    assert torch.allclose(result.sigma[:, 1], sigma.expand(4, -1), atol=1e-4)
    inverse = sigma.square().reciprocal()
    assert torch.allclose(result.weights[:, 1, -1], (inverse / inverse.sum()).expand(4, -1), atol=0.01)
    assert ((result.weights[:, 0] > 0).sum(-1) >= 1).all()


def test_without_pessimism_the_best_depth_has_all_the_weight(make_episodes, make_planner):
    world = LineWorld(goal=1.0, num_values=2, value_offset=[APART, -APART], policy_gain=1.0)
    states = choose_states(make_episodes(world, world.optimal_action), 4)
    planner = make_planner(world, num_elites=1)
    result = horizon_weights.horizon_weights(planner, states, betas=(0.0,), horizon=3)
    assert torch.equal(result.weights.amax(-1), torch.ones(4, 1, 6))
    _, weights = adaptive_mixture(result.mean, result.sigma, 0.0)
    assert torch.equal(result.weights[:, :, -1], weights)


def test_every_beta_is_planned_with_the_same_random_numbers(make_episodes, make_planner):
    world = LineWorld(goal=1.0, num_values=2, value_offset=[APART, -APART], policy_gain=1.0)
    states = choose_states(make_episodes(world, torch.zeros_like), 4)
    result = horizon_weights.horizon_weights(make_planner(world), states, betas=(1.0, 1.0), horizon=3, seed=2)
    for field in (result.weights, result.mean, result.sigma):
        assert torch.equal(*field.unbind(1))


def test_estimates_are_of_the_last_elites_of_a_plan_with_this_beta(make_episodes, make_planner):
    world = LineWorld(goal=1.0, num_dynamics=2, drift=[[0.3], [-0.3]])  # heads agree at the goal alone
    states = choose_states(make_episodes(world, torch.zeros_like), 4)
    planner = make_planner(world, discount=DISCOUNT, num_samples=32, num_elites=1, num_proposals=0)
    result = horizon_weights.horizon_weights(planner, states, betas=(10.0,), horizon=3, seed=2)
    searcher = with_settings(planner, score="adaptive", beta=10.0)
    scores = replan(searcher, states.observation, generator=generator_of(planner, 2), trace=True).trace.scores
    assert (scores[:, -1].amax(-1) > scores[:, 0].amax(-1)).any()
    value, _ = adaptive_mixture(result.mean[:, 0], result.sigma[:, 0], 10.0)
    assert torch.allclose(value, scores[:, -1].amax(-1))


def test_candidates_without_a_finite_score_have_no_weights(make_episodes, make_planner):
    """The planner gives them none, however many of the elites they are."""

    class Diverging(LineWorld):
        def next(self, latent, action):
            return torch.where(action[..., :1] > 0.9, torch.nan, super().next(latent, action))

    world = LineWorld(goal=1.0, num_values=2, value_offset=[APART, -APART])
    states = choose_states(make_episodes(world, world.optimal_action), 4)
    planner = make_planner(
        Diverging(goal=1.0, num_values=2, value_offset=[APART, -APART]), num_samples=64, num_elites=40, iterations=1
    )
    result = horizon_weights.horizon_weights(planner, states, betas=(1.0,), horizon=3)
    assert torch.allclose(result.weights.sum(-1), torch.ones(4, 1, 1), atol=1e-5)
    assert result.mean.isfinite().all()


def test_the_table_names_every_weight_and_the_lines_the_mean_depth():
    weights = torch.tensor([[0.5, 0.5], [0.0, 1.0]]).expand(6, 1, 2, 2)  # two iterations of two depths
    mean, sigma = torch.tensor([1.0, 2.0]).expand(6, 1, 2), torch.tensor([3.0, 4.0]).expand(6, 1, 2)
    result = horizon_weights.HorizonWeights(weights, mean, sigma, (3.0,), torch.arange(6) % 3)
    rows = horizon_weights.table(result)
    assert [row["weight"] for row in rows] == [0.5, 0.5, 0.0, 1.0]
    assert [row["mean"] for row in rows] == ["", "", 1.0, 2.0]
    assert [row["sigma"] for row in rows] == ["", "", 3.0, 4.0]
    assert horizon_weights.lines(result) == [
        "beta 3: mean depth 1.50 in the first iteration, 2.00 in the last, change +0.50 [+0.50, +0.50]"
    ]
    shown = horizon_weights.figure(result).axes[0].images[0].get_array()
    assert shown.tolist() == weights[0, 0].tolist()


@pytest.mark.parametrize("bad", [torch.nan, torch.inf])
def test_a_candidate_that_diverged_is_no_elite(make_episodes, make_planner, bad):
    class Patchy(LineWorld):
        def reward(self, latent, action):
            return torch.where(action[..., 0].abs() > 0.6, bad, super().reward(latent, action))

    world = Patchy(num_values=2, value_offset=[APART, -APART], policy_gain=1.0)
    states = choose_states(make_episodes(world, torch.zeros_like), 4)
    result = horizon_weights.horizon_weights(make_planner(world), states, betas=(1.0,), horizon=3)
    assert all(field.isfinite().all() for field in (result.weights, result.mean, result.sigma))


def test_the_interval_of_a_weight_is_over_episodes():
    episode = torch.arange(40) // 20
    weights = torch.stack([episode, 1 - episode], dim=-1).view(40, 1, 1, 2).float()
    result = horizon_weights.HorizonWeights(weights, torch.ones(40, 1, 2), torch.ones(40, 1, 2), (1.0,), episode)
    rows = horizon_weights.table(result)
    assert {(row["low"], row["weight"], row["high"]) for row in rows} == {(0.0, 0.5, 1.0)}
