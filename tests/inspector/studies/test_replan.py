from __future__ import annotations

import pytest
import torch

from torchrl_etdmpc.inspector.studies.components import components
from torchrl_etdmpc.inspector.studies.replan import (
    best_sequences,
    generator_of,
    imagine,
    policy_sequences,
    replan,
    return_estimates,
    true_returns,
)
from torchrl_etdmpc.testing import LineWorld, LQRWorld


def test_many_states_are_planned_as_few_are(make_planner):
    planner = make_planner(LineWorld(policy_gain=1.0))
    observation = torch.linspace(-0.5, 0.5, 70).unsqueeze(-1)
    plan = replan(planner, observation, generator=generator_of(planner, 0), trace=True)
    assert plan.action.shape == (70, 1)
    assert plan.trace.actions.shape == (70, 6, 256, 3, 1)
    assert torch.equal(best_sequences(plan)[:, 0], plan.action)  # in evaluation the best one acts
    estimates = return_estimates(planner, observation, plan.mean.unsqueeze(1))
    alone = return_estimates(planner, observation[-1:], plan.mean[-1:].unsqueeze(1))
    assert torch.allclose(estimates[-1:], alone)
    again = replan(planner, observation, generator=generator_of(planner, 0))
    assert torch.equal(again.mean, plan.mean)
    assert again.trace is None
    assert not torch.equal(replan(planner, observation, generator=generator_of(planner, 1)).mean, plan.mean)


def test_the_policy_s_sequence_is_its_mean_on_the_average_of_the_heads(make_planner):
    world = LineWorld(policy_gain=1.0, num_dynamics=2, drift=[[0.1], [-0.1]])
    observation = torch.tensor([[-0.75], [0.6]])
    sequences = policy_sequences(make_planner(world), observation, 4)
    assert torch.allclose(sequences, world.optimal_actions(observation, 4))


def test_every_head_goes_its_own_way(make_planner):
    world = LineWorld(num_dynamics=2, drift=[[0.1], [-0.1]])
    observation, actions = torch.zeros(5, 1), torch.ones(5, 3, 1)
    latents = imagine(make_planner(world), observation, actions)
    expected = torch.tensor([[0, 0.6, 1.2, 1.8], [0, 0.4, 0.8, 1.2]])
    assert torch.allclose(latents[..., 0], expected.expand(5, -1, -1))


def test_estimates_equal_the_truth_where_the_model_is_exact(make_planner, WorldSimulator):
    world = LQRWorld(discount=0.9)
    planner = make_planner(world, discount=0.9)
    observation, actions = torch.rand(2, 2), torch.rand(2, 4, 1) * 2 - 1
    simulator, observations, rewards = WorldSimulator(world), [], []
    for state, sequence in zip(observation, actions, strict=True):
        simulator.restore(state)
        rolled = simulator.roll(sequence)
        observations.append(rolled.observation)
        rewards.append(rolled.reward)
    truth = true_returns(planner, torch.stack(observations), torch.stack(rewards), torch.ones(2, 5, dtype=torch.bool))
    estimated = return_estimates(planner, observation, actions.unsqueeze(1))
    assert estimated.shape == (2, 1, 4, 1, 1)
    assert torch.allclose(estimated[:, 0, :, 0, 0], truth, atol=1e-5)
    ended = true_returns(planner, torch.stack(observations), torch.stack(rewards), torch.zeros(2, 5, dtype=torch.bool))
    assert torch.allclose(ended[:, 0], torch.stack(rewards)[:, 0])


def test_components_are_those_of_the_largest_spread():
    torch.manual_seed(0)
    hidden = torch.randn(200, 2) * torch.tensor([5.0, 2.0])
    directions = torch.linalg.qr(torch.randn(7, 2)).Q.mT
    coordinates, shares = components((hidden @ directions + 3).reshape(50, 4, 7))
    assert coordinates.shape == (50, 4, 2)
    centred = hidden - hidden.mean(0)
    assert abs(torch.corrcoef(torch.stack([coordinates[..., 0].flatten(), centred[:, 0]]))[0, 1]) > 0.99
    assert float(shares.sum()) == pytest.approx(1)
    assert shares[0] > shares[1]


def test_a_plan_begins_from_its_warm_start(make_planner):
    planner = make_planner(LineWorld(policy_gain=1.0), iterations=1)
    observation, carried = torch.zeros(70, 1), torch.linspace(-0.9, 0.9, 70).reshape(70, 1, 1).expand(-1, 3, -1)
    plan = replan(planner, observation, carried, generator=generator_of(planner, 0), trace=True)
    searched = plan.trace.actions[:, 0, 4:].mean((1, 2, 3))  # without the policy's sequences
    assert torch.corrcoef(torch.stack([searched, carried[:, 0, 0]]))[0, 1] > 0.9


def test_a_planner_without_a_warm_start_is_given_none(make_planner):
    planner = make_planner(LineWorld(policy_gain=1.0), warm_start=False)
    observation, carried = torch.zeros(2, 1), torch.full((2, 3, 1), 0.9)
    plans = [replan(planner, observation, warm, generator=generator_of(planner, 0)) for warm in (carried, None)]
    assert torch.equal(plans[0].mean, plans[1].mean)


@pytest.mark.parametrize("bad", [torch.nan, torch.inf])
def test_a_score_that_is_not_finite_is_never_the_best(make_planner, bad):
    planner = make_planner(Patchy(bad))
    plan = replan(planner, torch.zeros(3, 1), generator=generator_of(planner, 0), trace=True)
    assert not plan.trace.scores[:, -1].isfinite().all()
    assert torch.equal(best_sequences(plan)[:, 0], plan.action)


class Patchy(LineWorld):
    """A world whose reward is bad where actions are large."""

    def __init__(self, bad: float) -> None:
        super().__init__(policy_gain=1.0)
        self.bad = bad

    def reward(self, latent, action):
        return torch.where(action[..., 0].abs() > 0.6, self.bad, super().reward(latent, action))
