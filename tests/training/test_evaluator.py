from __future__ import annotations

import random

import numpy as np
import pytest
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import StepCounter, Transform

from torchrl_etdmpc.collectors import evaluate
from torchrl_etdmpc.modules import WorldModel
from torchrl_etdmpc.planners import BarePolicy
from torchrl_etdmpc.training import Agent, EvaluationResult, Evaluator, build_agent


@pytest.fixture
def agent(tiny_config) -> Agent:
    torch.manual_seed(0)
    return build_agent(tiny_config(), 5, 1)


def make_evaluator(agent: Agent, *, env_seed: int | None = None, **options) -> Evaluator:
    """On episodes of 12 decisions; two of them side by side."""
    pytest.importorskip("dm_control")
    from torchrl_etdmpc.envs import make_env

    env = make_env(
        "cartpole-swingup",
        seed=env_seed,
        num_envs=2,
        parallel=False,
    ).append_transform(StepCounter(12))
    return Evaluator(env, agent, **({"episodes": 3, "seed": 5} | options))


def policy_return(evaluator: Evaluator, model: WorldModel) -> float:
    """The mean return of a model's policy, without a planner, in the evaluator's episodes."""
    evaluator.env.set_seed(5)
    return evaluate(evaluator.env, BarePolicy(model), episodes=3).returns.mean().item()


def test_two_evaluations_of_the_same_weights_are_equal_to_the_last_bit(agent):
    evaluator = make_evaluator(agent, env_seed=1)
    first = evaluator()
    torch.randn(7)
    assert evaluator() == first
    assert make_evaluator(agent, env_seed=2)() == first  # as in another process, whose environment is elsewhere
    assert first.return_std > 0  # the episodes differ from each other
    assert make_evaluator(agent, seed=6)() != first


def test_other_weights_play_the_same_episodes(agent):
    evaluator, starts = make_evaluator(agent), []
    for _ in range(2):
        seen: list[Tensor] = []
        evaluator(on_step=lambda step, seen=seen: seen.append(step["observation"].clone()))
        starts.append(torch.stack([seen[0], seen[12]]))
        with torch.no_grad():
            agent.world_model.policy.output.weight.add_(torch.randn_like(agent.world_model.policy.output.weight))
    assert torch.equal(*starts)


def test_an_evaluation_leaves_the_caller_s_random_numbers_as_they_are(agent):
    evaluator = make_evaluator(agent, with_policy=True)
    states = []
    for act in (lambda: None, evaluator):
        torch.manual_seed(3), np.random.seed(3), random.seed(3)
        act()
        states.append((torch.rand(3).tolist(), np.random.rand(3).tolist(), random.random()))
    assert states[0] == states[1]


class DrawsFromGlobals(Transform):
    """Seeds and draws from the generators that Python and NumPy share, as some simulators do."""

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        np.random.seed(5), random.seed(5)
        return tensordict_reset

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        np.random.rand(), random.random()
        return next_tensordict


def test_a_simulator_that_draws_from_global_generators_leaves_them_too(agent):
    evaluator = make_evaluator(agent)
    evaluator.env.append_transform(DrawsFromGlobals())
    states = []
    for act in (lambda: None, evaluator):
        np.random.seed(3), random.seed(3)
        act()
        states.append((np.random.rand(3).tolist(), random.random()))
    assert states[0] == states[1]


class StartsFromGlobals(Transform):
    """Episodes begin where the generators that Python and NumPy share say, as those of some simulators do."""

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        shift = np.random.rand() + random.random()
        return tensordict_reset.set("observation", tensordict_reset["observation"] + shift)


def test_episodes_that_begin_by_global_generators_are_the_same_every_time(agent):
    evaluator, starts = make_evaluator(agent, with_policy=True), []
    evaluator.env.append_transform(StartsFromGlobals())
    for _ in range(2):
        seen: list[Tensor] = []
        evaluator(on_step=lambda step, seen=seen: seen.append(step["observation"].clone()))
        starts += [seen[0], seen[24]]  # with the planner in two rounds, and with the policy alone
        np.random.rand(), random.random()  # what training draws
    assert all(torch.equal(start, starts[0]) for start in starts)


def test_an_evaluation_that_is_left_leaves_the_random_numbers_too(agent):
    def leave(step: TensorDictBase) -> None:
        raise KeyboardInterrupt

    state = torch.get_rng_state()
    with pytest.raises(KeyboardInterrupt):
        make_evaluator(agent)(on_step=leave)
    assert torch.equal(torch.get_rng_state(), state)


def test_the_policy_without_the_planner_plays_the_same_episodes(agent):
    with_policy, without = make_evaluator(agent, with_policy=True)(), make_evaluator(agent)()
    assert with_policy[:3] == without[:3]
    assert without.policy_return is None
    expected = policy_return(make_evaluator(agent), agent.world_model)
    assert with_policy.policy_return == expected != with_policy.return_mean


def test_the_policy_that_plays_alone_is_the_one_that_acts(tiny_config):
    torch.manual_seed(0)
    agent = build_agent(tiny_config(optim={"average_decay": 0.9}), 5, 1)
    with torch.no_grad():  # what is trained goes on, its average stays
        agent.world_model.policy.output.weight.add_(torch.randn_like(agent.world_model.policy.output.weight))
    evaluator = make_evaluator(agent, with_policy=True)
    acting, trained = (policy_return(evaluator, model) for model in (agent.acting_model, agent.world_model))
    assert evaluator().policy_return == acting != trained


def test_the_result_is_that_of_the_planner(agent):
    evaluator = make_evaluator(agent)
    torch.manual_seed(5)
    evaluator.env.set_seed(5)
    returns = evaluate(evaluator.env, agent.eval_planner, episodes=3).returns
    expected = EvaluationResult(returns.mean().item(), returns.std(correction=0).item(), 3)
    assert evaluator()[:3] == expected[:3]


def test_an_evaluator_may_be_closed_twice(agent):
    evaluator = make_evaluator(agent)
    for _ in range(2):
        evaluator.close()
    assert evaluator.env.is_closed


def test_lengths_and_success_are_reported_where_they_are_asked_for(agent):
    returns = make_evaluator(agent)
    torch.manual_seed(5)
    returns.env.set_seed(5)
    played = evaluate(returns.env, agent.eval_planner, episodes=3).returns
    middle = played.sort().values[1].item()
    result = make_evaluator(agent, with_lengths=True, success_return=middle)()
    assert result.length_mean == 12
    assert result.success == pytest.approx(2 / 3)
    assert make_evaluator(agent, success_return=played.max().item() + 1)().success == 0
    plain = make_evaluator(agent)()
    assert plain[:3] == result[:3]
    assert (plain.length_mean, plain.success) == (None, None)
