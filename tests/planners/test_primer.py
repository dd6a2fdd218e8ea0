from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.collectors import Collector
from torchrl.data import Binary, Bounded, Composite, LazyTensorStorage, ReplayBuffer, Unbounded
from torchrl.envs import (
    ActionScaling,
    Compose,
    EnvBase,
    GymEnv,
    InitTracker,
    RenameTransform,
    SerialEnv,
    Transform,
    TransformedEnv,
)
from torchrl.modules import AdditiveGaussianModule
from torchrl.testing.mocking_classes import ContinuousActionVecMockEnv

from torchrl_etdmpc import EnsembleMPPIPlanner, LatentEnv, StepCollector, WorldModel
from torchrl_etdmpc.collectors import evaluate

BUDGET = {"horizon": 2, "num_samples": 8, "num_elites": 2, "num_proposals": 2, "iterations": 1}
SCALED = r"action has bounds of -2 and 2 instead of -1 and 1 \(append ActionScaling\(\)\)"


def make_env(bound=1.0) -> TransformedEnv:
    action = Bounded(-bound, bound, shape=(2,), dtype=torch.float32)
    return TransformedEnv(ContinuousActionVecMockEnv(action_spec=action), InitTracker())


def make_planner(env, *, observation_dim=None, action_dim=2, **options) -> EnsembleMPPIPlanner:
    size = env.observation_spec["observation"].shape[-1] if observation_dim is None else observation_dim
    model = WorldModel(size, action_dim, latent_dim=16, mlp_dim=16, encoder_dim=16)
    return EnsembleMPPIPlanner(LatentEnv(model), **BUDGET, **options)


def test_the_first_reset_compares_environment_and_model():
    env = make_env(2.0)
    env.append_transform(make_planner(env).make_tensordict_primer())
    with pytest.raises(ValueError, match=SCALED):
        env.reset()


def test_transforms_that_come_after_the_primer_may_mend_the_environment():
    env = make_env(2.0)
    primer, looked = make_planner(env).make_tensordict_primer(), []
    check = primer.check
    primer.check = lambda *arguments, **options: looked.append(1) or check(*arguments, **options)
    env = TransformedEnv(env.base_env, Compose(InitTracker(), primer, ActionScaling()))
    for _ in range(2):
        assert env.reset()["plan_mean"].shape == (2, 2)
    assert len(looked) == 1  # at the first reset, which is costly enough


class Nested(EnvBase):
    """Episodes of three steps, of which everything, ends included, stands below "agent"."""

    def __init__(self) -> None:
        super().__init__()
        self.observation_spec = Composite(agent=Composite(observation=Unbounded(3)))
        self.action_spec = Composite(agent=Composite(action=Bounded(-1, 1, shape=(1,), dtype=torch.float32)))
        self.reward_spec = Composite(agent=Composite(reward=Unbounded(1)))
        ends = {name: Binary(1, dtype=torch.bool) for name in ("done", "terminated")}
        self.full_done_spec = Composite(agent=Composite(ends))

    def _reset(self, tensordict: TensorDict | None = None, **kwargs) -> TensorDict:
        self.steps = 0
        return self._step(None)

    def _step(self, tensordict: TensorDict | None) -> TensorDict:
        self.steps += tensordict is not None
        end = torch.tensor([self.steps == 3])
        page = {"observation": torch.randn(3), "done": end, "terminated": end.clone()}
        if tensordict is not None:
            page["reward"] = torch.zeros(1)
        return TensorDict({"agent": page})

    def _set_seed(self, seed: int | None) -> None:
        pass


def test_where_episodes_end_in_a_nested_place_the_plan_begins_there():
    """TorchRL drops what a transform adds at a reset above that place."""
    keys = {"observation_key": ("agent", "observation"), "action_key": ("agent", "action")}
    planner = make_planner(None, observation_dim=3, action_dim=1, **keys)
    env = TransformedEnv(Nested(), Compose(InitTracker(), planner.make_tensordict_primer()))
    told = r"plan_mean_key=\('agent', 'plan_mean'\) and is_init_key=\('agent', 'is_init'\)"
    with pytest.raises(ValueError, match=rf"episodes end at \('agent', 'done'\), and TorchRL would carry .*{told}"):
        env.reset()
    keys |= {"plan_mean_key": ("agent", "plan_mean"), "is_init_key": ("agent", "is_init")}
    planner = make_planner(None, observation_dim=3, action_dim=1, **keys)
    env = TransformedEnv(Nested(), Compose(InitTracker(), planner.make_tensordict_primer()))
    steps = env.rollout(9, planner, break_when_any_done=False)
    expected = torch.cat([torch.zeros(1, 2, 1), steps["next", "agent", "plan_mean"][:-1]])
    assert expected[::3].any()
    expected[::3] = 0
    assert torch.equal(steps["agent", "plan_mean"], expected)


@pytest.mark.parametrize("states", [1, 2, 5])  # as many as the plan has steps, fewer and more
def test_an_environment_of_any_batch_size_gets_a_plan_for_each_state(states):
    model = WorldModel(3, 1, latent_dim=16, mlp_dim=16, encoder_dim=16).double()
    planner = EnsembleMPPIPlanner(LatentEnv(model), **BUDGET)
    env = TransformedEnv(LatentEnv(model), planner.make_tensordict_primer())
    start = env.reset(TensorDict({"latent": model.encode(torch.randn(states, 3).double())}, [states]))
    assert start["plan_mean"].dtype == torch.float64
    assert torch.equal(start["plan_mean"], torch.zeros(states, 2, 1).double())
    steps = env.rollout(3, planner, tensordict=start, auto_reset=False)
    assert torch.equal(steps["plan_mean"][:, 1:], steps["next", "plan_mean"][:, :-1])


@pytest.mark.parametrize("warm_start", [True, False])
@pytest.mark.parametrize(
    ("sizes", "message"),
    [
        ({"action_dim": 3}, "action has 2 entries instead of the model's 3"),
        ({"observation_dim": 4}, "observation has 7 entries instead of the model's 4"),
    ],
)
def test_our_collector_compares_before_it_acts(sizes, message, warm_start):
    env = SerialEnv(2, make_env)
    buffer = ReplayBuffer(storage=LazyTensorStorage(10))
    with pytest.raises(ValueError, match=message):
        StepCollector(env, make_planner(env, **sizes, warm_start=warm_start), replay_buffer=buffer)


def test_a_collector_of_torchrl_compares_at_its_first_reset():
    env = make_env(2.0)
    with pytest.raises(ValueError, match=SCALED):
        Collector(env, make_planner(env), frames_per_batch=2, total_frames=2, auto_register_policy_transforms=True)


@pytest.mark.parametrize("warm_start", [True, False])
def test_a_planner_in_a_policy_of_several_modules_is_compared_by_our_collector(warm_start):
    env, buffer = make_env(2.0), ReplayBuffer(storage=LazyTensorStorage(10))
    with pytest.raises(ValueError, match=SCALED):
        StepCollector(env, TensorDictSequential(make_planner(env, warm_start=warm_start)), replay_buffer=buffer)
    with pytest.raises(ValueError, match=SCALED):
        evaluate(env, TensorDictSequential(make_planner(env, warm_start=warm_start)), episodes=1)


def pendulum(*transforms: Transform) -> TransformedEnv:
    pytest.importorskip("gymnasium")
    return TransformedEnv(GymEnv("Pendulum-v1"), Compose(InitTracker(), *transforms))


@pytest.mark.parametrize("collect", ["ours", "torchrl's"])
def test_a_planner_in_a_policy_of_several_modules_is_warm_started(collect, monkeypatch):
    env = pendulum(ActionScaling())
    planner, started = make_planner(env, action_dim=1), []
    plan = planner.plan

    def note(observation, plan_mean=None, **options):
        started.append(plan_mean is not None)
        return plan(observation, plan_mean, **options)

    monkeypatch.setattr(planner, "plan", note)
    noise = AdditiveGaussianModule(spec=env.action_spec, sigma_init=0.1, sigma_end=0.1, annealing_num_steps=1)
    policy = TensorDictSequential(planner, noise)
    if collect == "ours":
        collector = StepCollector(
            env, policy, replay_buffer=ReplayBuffer(storage=LazyTensorStorage(10)), total_frames=4
        )
    else:
        collector = Collector(env, policy, frames_per_batch=4, total_frames=4, auto_register_policy_transforms=True)
    for _ in collector:
        pass
    assert len(started) >= 4 and all(started)


def test_what_other_modules_of_the_policy_read_or_write_is_not_asked_of_the_environment():
    planner = make_planner(pendulum(), action_dim=1, action_key="unit_action")
    env = pendulum(RenameTransform(["observation"], ["raw"]))
    policy = TensorDictSequential(
        TensorDictModule(lambda raw: raw, ["raw"], ["observation"]),
        planner,
        TensorDictModule(lambda action: 2 * action, ["unit_action"], ["action"]),
    )
    buffer = ReplayBuffer(storage=LazyTensorStorage(10))
    for step in StepCollector(env, policy, replay_buffer=buffer, total_frames=3):
        torch.testing.assert_close(step["action"], 2 * step["unit_action"])
    env = pendulum(RenameTransform(["observation"], ["raw"]))
    for steps in Collector(env, policy, frames_per_batch=3, total_frames=3, auto_register_policy_transforms=True):
        torch.testing.assert_close(steps["action"], 2 * steps["unit_action"])


def test_alone_it_asks_the_environment_for_what_it_reads_and_writes():
    env, buffer = make_env(), ReplayBuffer(storage=LazyTensorStorage(10))
    planner = make_planner(env, observation_key="seen", action_key="torque")
    with pytest.raises(ValueError, match=r"seen is missing .*; the actions are \['action'\] instead of one 'torque'"):
        StepCollector(env, planner, replay_buffer=buffer)
    with pytest.raises(KeyError, match="the planner needs 'seen' .* or append what check_env"):
        next(iter(Collector(env, planner, frames_per_batch=2, total_frames=2, auto_register_policy_transforms=True)))


def test_an_environment_of_latents_needs_no_observation_unless_latents_are_not_read():
    planner = make_planner(make_env())
    planner.make_tensordict_primer().check(planner.env)
    other = EnsembleMPPIPlanner(planner.env, latent_key=None, **BUDGET)
    with pytest.raises(ValueError, match="observation is missing"):
        other.make_tensordict_primer().check(planner.env)
