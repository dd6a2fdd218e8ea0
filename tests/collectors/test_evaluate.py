from __future__ import annotations

from functools import partial

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import (
    ActionScaling,
    EnvBase,
    ExplorationType,
    GymEnv,
    RenameTransform,
    SerialEnv,
    StepCounter,
    TransformedEnv,
)
from torchrl.envs.utils import exploration_type, set_exploration_type

from torchrl_etdmpc import EnsembleMPPIPlanner, LatentEnv, WorldModel
from torchrl_etdmpc.collectors import NonFiniteError, evaluate
from torchrl_etdmpc.planners import BarePolicy
from torchrl_etdmpc.testing import LineWorld


class CountingEnv(EnvBase):
    """Counts its steps. Step t = 1, 2, .. earns t plus the action; the episode ends after ``length`` steps."""

    def __init__(self, length: int) -> None:
        super().__init__()
        self.length = length
        self.steps = 0
        self.resets = 0
        self.observation_spec = Composite(observation=Unbounded((1,)))
        self.action_spec = Bounded(-1, 1, (1,))
        self.reward_spec = Unbounded((1,))
        self.done_spec = Composite(done=Binary(1, dtype=torch.bool), terminated=Binary(1, dtype=torch.bool))

    def _reset(self, tensordict: TensorDictBase | None) -> TensorDict:
        self.steps = 0
        self.resets += 1
        return TensorDict({"observation": torch.zeros(1)})

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        self.steps += 1
        done = torch.tensor([self.steps >= self.length])
        return TensorDict(
            {
                "observation": torch.tensor([float(self.steps)]),
                "reward": self.steps + tensordict["action"],
                "done": done,
                "terminated": done.clone(),
            }
        )

    def _set_seed(self, seed: int | None) -> None:
        pass


class ConstantPolicy(TensorDictModuleBase):
    """Always the same action; notes how it was called."""

    in_keys = ["observation"]
    out_keys = ["action"]

    def __init__(self, action: float = 0.5) -> None:
        super().__init__()
        self.action = action
        self.exploration_types: list[ExplorationType | None] = []
        self.gradients: list[bool] = []
        self.inputs: list[set] = []

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        self.exploration_types.append(exploration_type())
        self.gradients.append(torch.is_grad_enabled())
        self.inputs.append(set(tensordict.keys(True, True)))
        return tensordict.set("action", torch.full_like(tensordict["observation"], self.action))


def side_by_side(*lengths: int) -> SerialEnv:
    return SerialEnv(len(lengths), [partial(CountingEnv, length) for length in lengths])


def expected_return(length: int, action: float = 0.5) -> float:
    return length * (length + 1) / 2 + length * action


def test_a_return_equals_that_of_an_independent_rollout():
    pytest.importorskip("dm_control")
    from torchrl_etdmpc.envs import make_env

    torch.manual_seed(0)
    policy = BarePolicy(WorldModel(5, 1, latent_dim=16, mlp_dim=16))
    env, other = (make_env("cartpole-balance", seed=3).append_transform(StepCounter(25)) for _ in range(2))
    rollout = other.rollout(100, policy)
    assert rollout.shape == (25,)
    returns = evaluate(env, policy, episodes=1).returns
    torch.testing.assert_close(returns, rollout["next", "reward"].sum().reshape(1))
    assert returns.item() > 1


def test_several_episodes_of_one_environment_are_counted_apart():
    env = CountingEnv(3)
    assert evaluate(env, ConstantPolicy(), episodes=4).returns.tolist() == [expected_return(3)] * 4
    assert env.resets == 4  # an environment that resets to a list of starts plays each of them


@pytest.mark.parametrize("episodes", [1, 2, 3, 4])
def test_a_batch_of_environments_gives_as_many_returns_as_asked_for(episodes):
    single = evaluate(CountingEnv(3), ConstantPolicy(), episodes=episodes)
    batched = evaluate(side_by_side(3, 3), ConstantPolicy(), episodes=episodes)
    assert batched.returns.shape == batched.lengths.shape == (episodes,)
    assert torch.equal(batched.returns, single.returns)
    assert torch.equal(batched.lengths, single.lengths)


@pytest.mark.parametrize("policy_device", [None, "cpu"])
def test_only_the_first_episode_counts_where_episodes_end_at_different_times(policy_device):
    returns, lengths = evaluate(side_by_side(2, 7, 3), ConstantPolicy(), episodes=3, policy_device=policy_device)
    assert lengths.tolist() == [2, 7, 3]
    assert returns.tolist() == [expected_return(2), expected_return(7), expected_return(3)]


def test_an_episode_that_terminates_is_over_before_its_time_limit():
    env = CountingEnv(3)

    def look(step: TensorDictBase) -> None:
        assert env.resets <= 2  # the second one makes the observation after the end

    limited = TransformedEnv(env, StepCounter(max_steps=10))
    assert evaluate(limited, ConstantPolicy(), episodes=1, on_step=look).lengths.tolist() == [3]


def test_an_episode_may_end_in_a_nested_place():
    class Nested(CountingEnv):
        def __init__(self, length: int) -> None:
            super().__init__(length)
            self.full_done_spec = Composite(agent=self.full_done_spec.clone())

        def _reset(self, tensordict: TensorDictBase | None) -> TensorDict:
            return super()._reset(tensordict).update(self.full_done_spec.zero())

        def _step(self, tensordict: TensorDictBase) -> TensorDict:
            after = super()._step(tensordict)
            return after.exclude("done", "terminated").set("agent", after.select("done", "terminated"))

    env = Nested(3)
    assert "done" not in env.done_keys
    assert evaluate(env, ConstantPolicy(), episodes=2).lengths.tolist() == [3, 3]


def test_a_round_lasts_as_long_as_its_longest_episode():
    steps: list[Tensor] = []
    env = side_by_side(2, 5)
    evaluate(env, ConstantPolicy(), episodes=3, on_step=lambda step: steps.append(step["next", "reward"].clone()))
    assert len(steps) == 2 * 5
    assert [step[1].item() for step in steps] == [1.5, 2.5, 3.5, 4.5, 5.5] * 2


@pytest.mark.parametrize("policy_device", [None, "cpu"])
def test_the_policy_acts_without_exploration_and_without_gradients(policy_device):
    policy = ConstantPolicy()
    with set_exploration_type(ExplorationType.RANDOM), torch.enable_grad():
        evaluate(CountingEnv(3), policy, episodes=2, policy_device=policy_device)
        assert exploration_type() is ExplorationType.RANDOM
    assert set(policy.exploration_types) == {ExplorationType.DETERMINISTIC}
    assert not any(policy.gradients)


def test_on_another_device_the_policy_is_given_what_it_reads_and_no_more():
    policy = ConstantPolicy()
    returns = evaluate(CountingEnv(3), policy, episodes=1, policy_device="cpu").returns
    assert returns.tolist() == [expected_return(3)]
    assert policy.inputs == [{"observation"}] * 3


def test_a_policy_may_answer_in_a_tensordict_of_its_own():
    env = TransformedEnv(CountingEnv(20), StepCounter(max_steps=5))  # which counts on from what the state holds
    answer = TensorDict({"action": torch.full((1,), 0.5)})
    assert evaluate(env, lambda state: answer.clone(), episodes=1).returns.tolist() == [expected_return(5)]


def test_a_planner_that_was_told_to_explore_is_refused():
    budget = {"horizon": 2, "num_samples": 8, "num_elites": 2, "num_proposals": 0, "warm_start": False}
    planner, env = EnsembleMPPIPlanner(LatentEnv(LineWorld()), **budget), CountingEnv(3)
    planner.explore = True
    with pytest.raises(ValueError, match=r"told to explore \(planner\.explore = True\), .* set it to False or"):
        evaluate(env, TensorDictSequential(planner), episodes=1)
    assert env.resets == 0
    for explore in (False, None):
        planner.explore = explore
        assert evaluate(env, TensorDictSequential(planner), episodes=1).lengths.tolist() == [3]
    other = TensorDictModule(torch.nn.Linear(1, 1), in_keys=["observation"], out_keys=["action"])
    other.explore = True  # which may mean anything
    assert evaluate(env, other, episodes=1).lengths.tolist() == [3]


@pytest.mark.parametrize("episodes", [0, -1])
def test_less_than_one_episode_is_refused(episodes):
    env = CountingEnv(3)
    with pytest.raises(ValueError) as caught:
        evaluate(env, ConstantPolicy(), episodes=episodes)
    assert str(caught.value) == f"episodes must be at least 1, got {episodes}."
    assert env.resets == 0


@pytest.mark.parametrize("batched", [False, True])
def test_the_warm_start_is_carried_through_a_round_and_reset_between_rounds(batched):
    torch.manual_seed(0)
    planner = EnsembleMPPIPlanner(
        LatentEnv(LineWorld()), horizon=3, num_samples=16, num_elites=4, num_proposals=2, iterations=2
    )
    carried: list[Tensor] = []
    plan = planner.plan

    def record(observation: Tensor, plan_mean: Tensor, **options):
        carried.append(plan_mean.clone())
        return plan(observation, plan_mean, **options)

    planner.compiled_plan = record
    env = side_by_side(4, 4) if batched else CountingEnv(4)
    env = env.append_transform(planner.make_tensordict_primer())
    evaluate(env, planner, episodes=4 if batched else 2)
    assert len(carried) == 8
    assert [bool(plan_mean.any()) for plan_mean in carried] == [False, True, True, True] * 2


def test_an_environment_of_other_bounds_is_refused_before_it_is_stepped():
    env = CountingEnv(3)
    env.action_spec = Bounded(-2, 2, (1,))
    model = WorldModel(1, 1, latent_dim=16, mlp_dim=16)
    planner = EnsembleMPPIPlanner(
        LatentEnv(model), horizon=2, num_samples=8, num_elites=4, warm_start=False, num_proposals=0
    )
    with pytest.raises(ValueError, match=r"bounds of -2 and 2 instead of -1 and 1 \(append ActionScaling\(\)\)"):
        evaluate(env, planner, episodes=1)
    assert env.resets == 0


class BrokenEnv(CountingEnv):
    """Its third step has a value that is not finite."""

    def __init__(self, key: str, value: float) -> None:
        super().__init__(5)
        self.broken, self.value = key, value

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        following = super()._step(tensordict)
        if self.steps == 3:
            following[self.broken] = torch.full_like(following[self.broken], self.value)
        return following


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
@pytest.mark.parametrize("key", ["observation", "reward"])
def test_a_value_that_is_not_finite_is_no_return(key, value):
    with pytest.raises(NonFiniteError, match=f"^the environment returned a non-finite '{key}' at decision step 3$"):
        evaluate(BrokenEnv(key, value), ConstantPolicy(), episodes=1)


def test_an_action_and_a_first_observation_are_looked_at_too():
    class BrokenFirst(CountingEnv):
        def _reset(self, tensordict: TensorDictBase | None = None) -> TensorDict:
            first = super()._reset(tensordict)
            return first.set("observation", torch.full_like(first["observation"], torch.nan))

    with pytest.raises(NonFiniteError, match="^the environment returned a non-finite 'observation' at decision step 0"):
        evaluate(BrokenFirst(5), ConstantPolicy(), episodes=1)
    policy = TensorDictModule(lambda observation: observation * torch.nan, ["observation"], ["action"])
    with pytest.raises(NonFiniteError, match="^the policy returned a non-finite 'action' at decision step 1$"):
        evaluate(CountingEnv(5), policy, episodes=1)


class BrokenLater(CountingEnv):
    """Its first episode is whole; the first step of the next has no number."""

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        following = super()._step(tensordict)
        if self.resets > 1:
            following["reward"] = torch.full_like(following["reward"], torch.nan)
        return following


def test_what_follows_an_episode_that_counts_may_have_no_number():
    env = SerialEnv(2, [partial(BrokenLater, 2), partial(CountingEnv, 5)])
    assert evaluate(env, ConstantPolicy(), episodes=2).returns.tolist() == [expected_return(2), expected_return(5)]
    with pytest.raises(NonFiniteError, match="non-finite 'reward' at decision step 1"):
        evaluate(env, ConstantPolicy(), episodes=3)  # a second round, of which it counts


def test_the_reward_may_have_another_name_and_must_be_one():
    env = CountingEnv(3)
    renamed = TransformedEnv(env, RenameTransform(["reward"], ["score"]))
    assert evaluate(renamed, ConstantPolicy(), episodes=1).returns.item() == expected_return(3)
    both = TransformedEnv(CountingEnv(3), RenameTransform(["reward"], ["score"], create_copy=True))
    with pytest.raises(ValueError, match=r"^a return is the sum of one reward, .* has \['reward', 'score'\]"):
        evaluate(both, ConstantPolicy(), episodes=1)


def test_the_policy_alone_is_compared_with_the_environment_too():
    env = TransformedEnv(GymEnv("Pendulum-v1"))
    policy = BarePolicy(WorldModel(3, 1, latent_dim=16, mlp_dim=16))
    with pytest.raises(ValueError, match=r"bounds of -2 and 2 instead of -1 and 1 \(append ActionScaling\(\)\)"):
        evaluate(env, policy, episodes=1)
    with pytest.raises(ValueError, match="observation has 3 entries instead of the model's 4"):
        evaluate(env, BarePolicy(WorldModel(4, 1, latent_dim=16, mlp_dim=16)), episodes=1)
    behind = TensorDictSequential(BarePolicy(WorldModel(4, 1, latent_dim=16, mlp_dim=16), observation_key="other"))
    with pytest.raises(ValueError, match="bounds of -2 and 2"):  # what it reads may come from another module
        evaluate(env, behind, episodes=1)
    env.append_transform(ActionScaling())
    assert evaluate(env, policy, episodes=1).lengths.tolist() == [200]
    reading = TensorDictModule(lambda observation: observation, ["observation"], ["other"])
    part = BarePolicy(policy.world_model, observation_key="other")
    assert evaluate(env, TensorDictSequential(reading, part), episodes=1).lengths.tolist() == [200]
