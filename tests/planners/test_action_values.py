"""Planning with a critic of actions: how rollouts are bootstrapped."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor, nn

from torchrl_etdmpc import EnsembleMPPIPlanner, LatentEnv, export_planner, export_policy
from torchrl_etdmpc.modules import ActionValueWorldModel, has_action_values, require_prediction_model
from torchrl_etdmpc.planners import BarePolicy
from torchrl_etdmpc.planners.imagination import sampled_values


def make_model(**options) -> ActionValueWorldModel:
    sizes = {"latent_dim": 16, "mlp_dim": 16, "encoder_dim": 16}
    model = ActionValueWorldModel(3, 2, **(sizes | options))
    for head in (model.reward_head, model.value_head, model.policy):
        nn.init.normal_(head.output.weight, std=0.5)
    return model.double()


def return_by_hand(model, observation, actions, noise, heads, discount) -> Tensor:
    """Return table ``[H, F, 2]`` of one sequence ``[H, A]`` with noise ``[H, F, A]`` and uniform draws ``[V]``."""
    first, second = heads.argsort(descending=True)[:2].tolist()
    table = torch.zeros(len(actions), model.num_dynamics, 2, dtype=torch.float64)
    for head in range(model.num_dynamics):
        latent, total = model.encode(observation), 0.0
        for step, action in enumerate(actions):
            total += discount**step * model.reward(latent, action).item()
            latent = model.next(latent.unsqueeze(0), action)[head]
            mean, log_std = model.policy.before_tanh(latent)
            sampled = torch.tanh(mean + log_std.exp() * noise[step, head])
            values = model.action_values(latent, sampled)
            for column, member in enumerate((first, second)):
                table[step, head, column] = total + discount ** (step + 1) * values[member].item()
    return table


@pytest.mark.parametrize("score", ["mean", "final"])
@pytest.mark.parametrize("heads", [1, 2])
@torch.no_grad()
def test_every_rollout_ends_with_two_heads_value_of_a_sampled_action(make_planner, states, score, heads):
    model = make_model(num_dynamics=heads)
    budget = {"num_samples": 6, "num_elites": 3, "num_proposals": 2, "iterations": 2}
    planner, depths = make_planner(model, score=score, discount=0.9, **budget), {"mean": 3, "final": 1}[score]
    observation, noise = states(2), planner.draw_noise(2)
    assert noise.bootstrap.shape == (2, 2, 6, depths, heads, 2)
    assert noise.heads.shape == (2, 2, 5)
    trace = planner.plan(observation, noise=noise, trace=True).trace
    assert trace.returns.shape == (2, 2, 6, depths, heads, 2)
    for state in range(2):
        for iteration in range(2):
            for sequence in range(6):
                drawn_in = 0 if sequence < 2 else iteration  # the proposals keep the scores of the first iteration
                sampled = torch.full((3, heads, 2), torch.nan, dtype=torch.float64)
                sampled[-depths:] = noise.bootstrap[state, drawn_in, sequence]
                expected = return_by_hand(
                    model,
                    observation[state],
                    trace.actions[state, iteration, sequence],
                    sampled,
                    noise.heads[state, drawn_in],
                    0.9,
                )
                torch.testing.assert_close(trace.returns[state, iteration, sequence], expected[-depths:])
    expected = {"mean": trace.returns.mean((-3, -2, -1)), "final": trace.returns[:, :, :, -1].mean((-2, -1))}[score]
    torch.testing.assert_close(trace.scores, expected)
    assert (noise.heads[0].topk(2).indices != noise.heads[1].topk(2).indices).any()


def test_a_batch_plans_as_each_state_alone(make_planner, states, rows, assert_same_plan):
    planner = make_planner(make_model())
    observation = states(2, 3)
    noise = planner.draw_noise(2, 3)
    together = planner.plan(observation, noise=noise)
    alone = planner.plan(observation[1, 2], noise=rows(noise, (1, 2)))
    assert_same_plan(type(together)(*(field[1, 2] for field in together[:-1]), trace=None), alone)


def test_a_model_of_state_values_draws_nothing_more_than_before(make_planner):
    planner = make_planner()
    torch.manual_seed(3)
    noise = planner.draw_noise(4)
    after = torch.rand(1)
    assert noise.bootstrap.shape == noise.heads.shape == (4, 0)
    torch.manual_seed(3)
    for drawn in noise[:4]:
        again = torch.rand_like(drawn) if drawn is noise.elite else torch.randn_like(drawn)
        assert torch.equal(again, drawn)
    assert torch.rand(1) == after


class Slope(nn.Module):
    """A user's own model of action values: a line on which the value is that of going right."""

    observation_dim = latent_dim = action_dim = num_dynamics = 1
    num_values = 3
    version = torch.zeros((), dtype=torch.int64)

    def encode(self, observation: Tensor) -> Tensor:
        return observation

    def next(self, latent: Tensor, action: Tensor) -> Tensor:
        return latent + action

    def reward(self, latent: Tensor, action: Tensor) -> Tensor:
        return torch.zeros_like(latent[..., 0])

    def action_values(self, latent: Tensor, action: Tensor) -> Tensor:
        return (latent + action) * torch.tensor([1.0, 2.0, 3.0])

    def values(self, latent: Tensor) -> Tensor:
        raise AssertionError("the planner asks for action values")

    def termination(self, latent: Tensor) -> Tensor | None:
        return None

    def policy(self, latent: Tensor, log_std_bounds: tuple[float, float] | None = None) -> tuple[Tensor, Tensor]:
        return torch.zeros_like(latent), torch.zeros_like(latent)

    def act(self, latent: Tensor, noise: Tensor, log_std_bounds: tuple[float, float] | None = None) -> Tensor:
        return noise.expand(*latent.shape[:-1], 1).clamp(-1, 1)


def test_a_model_of_ones_own_with_action_values_is_planned_over():
    require_prediction_model(Slope())
    assert has_action_values(Slope())
    planner = EnsembleMPPIPlanner(LatentEnv(Slope()), horizon=2, score="final", warm_start=False)
    assert (planner.plan(torch.zeros(2, 1), explore=False).action > 0.5).all()


def test_a_single_head_bootstraps_alone():
    latent, noise = torch.rand(1, 1, 2, 4, 16, dtype=torch.float64), torch.zeros(2, 4, 1, 1, 2, dtype=torch.float64)
    model = make_model(num_values=1)
    values = sampled_values(model, latent, noise, torch.rand(2, 1))
    torch.testing.assert_close(values, model.values(latent))


def test_candidates_are_scored_in_another_dtype(make_planner, states):
    model = make_model()
    plain, rough = make_planner(model), make_planner(model, scoring_dtype="float32")
    observation, noise = states(2), plain.draw_noise(2)
    expected = plain.plan(observation, noise=noise, trace=True).trace.scores[:, 0]
    actual = rough.plan(observation, noise=noise, trace=True).trace.scores[:, 0]
    torch.testing.assert_close(actual, expected, rtol=1e-3, atol=1e-4)
    assert not torch.equal(actual, expected)
    assert actual.dtype == torch.float64


def test_a_compiled_plan_equals_an_eager_one(make_planner, states, assert_same_plan):
    planner = make_planner(make_model(), horizon=2, iterations=1)
    observation, noise = states(2), planner.draw_noise(2)
    compiled = torch.compile(planner.plan, backend="eager", fullgraph=True)
    assert_same_plan(compiled(observation, noise=noise), planner.plan(observation, noise=noise))


def test_policy_and_planner_are_exported(make_planner, states):
    model = make_model()
    observation = states(5)
    action = export_policy(model).module()(observation)
    torch.testing.assert_close(action, model.policy(model.encode(observation))[0])
    bare = BarePolicy(model)(TensorDict({"observation": observation}, batch_size=[5]))
    torch.testing.assert_close(action, bare["action"])
    planner = make_planner(model, horizon=2, iterations=1)
    program = export_planner(planner)
    torch.manual_seed(4)
    exported, mean = program.module()(observation[:1], torch.zeros(1, 2, 2).double())
    torch.manual_seed(4)
    plan = planner.plan(observation[:1], torch.zeros(1, 2, 2).double(), explore=False)
    torch.testing.assert_close(exported, plan.action)
    torch.testing.assert_close(mean, plan.mean)


@torch.no_grad()
def test_an_end_that_is_expected_takes_its_share_of_the_values_of_actions(make_planner, states):
    model = make_model(termination=True)
    for head in (model.reward_head, model.value_head, model.termination_head):
        nn.init.zeros_(head.output.weight)  # a reward of 0, and an end with probability 1/2 in every state
        nn.init.zeros_(head.output.bias)
    model.value_head.output.bias[..., 55] = 100  # symlog 1: worth e - 1
    planner = make_planner(model, horizon=2, discount=0.9, score="mean")
    returns = planner.plan(states(2), trace=True).trace.returns
    worth = torch.tensor([0.9 / 2, 0.9**2 / 4], dtype=torch.float64) * math.expm1(1)
    torch.testing.assert_close(returns, worth.view(2, 1, 1).expand_as(returns))
