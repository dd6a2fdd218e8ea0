"""The planner in the hands of TorchRL: rollouts, batched environments, collectors, and TorchRL's own planners."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.collectors import Collector
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import (
    ActionScaling,
    Compose,
    EnvBase,
    GymEnv,
    InitTracker,
    SerialEnv,
    StepCounter,
    TensorDictPrimer,
    TransformedEnv,
)
from torchrl.envs.utils import ExplorationType, set_exploration_type, step_mdp
from torchrl.modules import CEMPlanner, MPPIPlanner
from torchrl.objectives.value import TDLambdaEstimator

from torchrl_etdmpc import EnsembleMPPIPlanner, LatentEnv, WorldModel
from torchrl_etdmpc.testing import LineWorld


def make_planner(world, **options) -> EnsembleMPPIPlanner:
    small = {"horizon": 3, "num_samples": 32, "num_elites": 8, "num_proposals": 4, "iterations": 3}
    return EnsembleMPPIPlanner(LatentEnv(world), **{**small, **options})


class LineTask(EnvBase):
    """The line world itself; every episode starts at -2."""

    def __init__(self, world: LineWorld) -> None:
        super().__init__()
        self.world = world
        self.observation_spec = Composite(observation=Unbounded((1,)))
        self.action_spec = Bounded(-1.0, 1.0, shape=(1,))
        self.reward_spec = Unbounded((1,))

    def _reset(self, tensordict, **kwargs):
        return TensorDict({"observation": torch.full((1,), -2.0)})

    def _step(self, tensordict):
        latent = self.world.encode(tensordict["observation"])
        observation = self.world.transition(latent, tensordict["action"])[..., :1]
        reward = self.world.reward(latent, tensordict["action"]).unsqueeze(-1)
        return TensorDict({"observation": observation, "reward": reward, "done": torch.zeros(1, dtype=torch.bool)})

    def _set_seed(self, seed):
        pass


def make_task(world: LineWorld, *transforms, max_steps: int) -> TransformedEnv:
    return TransformedEnv(LineTask(world), Compose(StepCounter(max_steps), InitTracker(), *transforms))


def make_pendulum(*transforms) -> TransformedEnv:
    pytest.importorskip("gymnasium")
    return TransformedEnv(GymEnv("Pendulum-v1"), Compose(ActionScaling(), InitTracker(), *transforms))


def collect(env, planner, *, frames_per_batch: int, batches: int, **options) -> TensorDict:
    """Everything that a collector yields, in one piece, time last."""
    options.setdefault("auto_register_policy_transforms", False)
    total_frames = batches * frames_per_batch
    collector = Collector(env, planner, frames_per_batch=frames_per_batch, total_frames=total_frames, **options)
    try:
        return torch.cat([data.clone() for data in collector], dim=-1)
    finally:
        collector.shutdown()


def assert_carried(data: TensorDict, *, resets: list) -> None:
    """The plan travels from step to step and is zero where an episode starts; data has its time last."""
    is_init = data["is_init"].squeeze(-1)
    assert is_init.nonzero().tolist() == resets
    start = is_init[..., None, None].expand_as(data["plan_mean"])
    assert data["plan_mean"][start].eq(0).all()
    time = is_init.ndim - 1
    steps = data.shape[time]
    carried, start = (tensor.narrow(time, 1, steps - 1) for tensor in (data["plan_mean"], start))
    previous = data["next", "plan_mean"].narrow(time, 0, steps - 1)
    assert torch.equal(carried[~start], previous[~start])
    # No two steps have the same plan, so that neither could pass for another's.
    plans = data["next", "plan_mean"].flatten(0, time).flatten(1)
    assert torch.cdist(plans, plans).fill_diagonal_(1).min() > 1e-5


def record_starts(monkeypatch, planner) -> list:
    """What every planning call from now on starts from and ends with."""
    plan, calls = planner.plan, []

    def recorded(observation, plan_mean=None, **options):
        result = plan(observation, plan_mean, **options)
        calls.append((plan_mean, result.mean))
        return result

    monkeypatch.setattr(planner, "plan", recorded)
    return calls


# Rollouts


def test_a_rollout_reaches_the_goal_of_the_true_world():
    world = LineWorld(goal=1.0)
    planner = make_planner(world, num_samples=128, num_elites=16)
    env = make_task(world, planner.make_tensordict_primer(), max_steps=10)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        data = env.rollout(100, planner)
    optimum = world.optimal_actions(torch.tensor([-2.0]), 10)
    assert data["next", "observation"][-1].item() == pytest.approx(1.0, abs=0.1)
    assert data["next", "reward"].sum().item() == pytest.approx(-(2.5**2 + 2**2 + 1.5**2 + 1 + 0.5**2), abs=0.2)
    torch.testing.assert_close(data["action"], optimum, atol=0.25, rtol=0)
    assert_carried(data, resets=[[0]])


def test_a_rollout_of_a_gymnasium_task_with_rescaled_actions():
    planner = make_planner(WorldModel(3, 1, latent_dim=16, mlp_dim=16, encoder_dim=16))
    env = make_pendulum(planner.make_tensordict_primer())
    with set_exploration_type(ExplorationType.RANDOM):
        data = env.rollout(30, planner)
    assert data.batch_size == (30,)
    assert data["action"].abs().max() <= 1
    assert data["action"].std() > 0.1
    assert_carried(data, resets=[[0]])
    assert all(data[key].isfinite().all() for key in planner.out_keys)


def test_a_rollout_of_the_imagination_is_planned_from_its_latents():
    world = LineWorld(goal=1.0, num_dynamics=2, drift=torch.tensor([[0.05], [-0.05]]))
    planner = make_planner(world)
    env = TransformedEnv(planner.env, Compose(InitTracker(), planner.make_tensordict_primer()))
    data = env.rollout(40, planner)
    assert data.batch_size == (40,)
    assert "observation" not in data.keys()
    torch.testing.assert_close(data["latent"][10:, 0], torch.ones(30), atol=0.3, rtol=0)
    assert_carried(data, resets=[[0]])


def test_a_batch_of_imaginations_is_planned_at_once(monkeypatch):
    planner = make_planner(LineWorld(goal=1.0), warm_start=False)
    calls = record_starts(monkeypatch, planner)
    start = TensorDict({"observation": torch.linspace(-1, 3, 6).view(3, 2, 1)}, batch_size=[3, 2])
    start = planner.env.reset(start).exclude("observation")
    data = planner.env.rollout(8, planner, tensordict=start, auto_reset=False)
    assert data.batch_size == (3, 2, 8)
    torch.testing.assert_close(data["latent"][..., -1, 0], torch.ones(3, 2), atol=0.3, rtol=0)
    assert [mean.shape for _, mean in calls] == [(3, 2, 3, 1)] * 8


def test_the_plan_is_carried_across_the_resets_of_a_rollout():
    planner = make_planner(LineWorld())
    env = make_task(planner.world_model, planner.make_tensordict_primer(), max_steps=4)
    data = env.rollout(10, planner, break_when_any_done=False)
    assert_carried(data, resets=[[0], [4], [8]])


def test_the_primer_can_have_a_name_of_its_own():
    planner = make_planner(LineWorld(), plan_mean_key=("agent", "carried"))
    env = make_task(planner.world_model, planner.make_tensordict_primer(), max_steps=4)
    data = env.rollout(10, planner, break_when_any_done=False)
    assert_carried(
        data.rename_key_(("agent", "carried"), "plan_mean").rename_key_(
            ("next", "agent", "carried"), ("next", "plan_mean")
        ),
        resets=[[0], [4], [8]],
    )


def test_a_primer_alone_carries_the_plan(monkeypatch):
    planner = make_planner(LineWorld())
    env = TransformedEnv(LineTask(planner.world_model), Compose(StepCounter(4), planner.make_tensordict_primer()))
    calls = record_starts(monkeypatch, planner)
    env.rollout(10, planner, break_when_any_done=False)
    assert len(calls) == 10
    for step, (carried, _) in enumerate(calls):
        assert torch.equal(carried, calls[step - 1][1] if step % 4 else torch.zeros(3, 1))


def test_an_init_tracker_alone_loses_the_plan_with_a_warning(monkeypatch):
    # A TorchRL environment carries what its specs name, and an InitTracker names is_init only.
    planner = make_planner(LineWorld())
    calls = record_starts(monkeypatch, planner)
    with pytest.warns(UserWarning, match="'plan_mean' is not in the planner's input, so every plan starts cold"):
        make_task(planner.world_model, max_steps=4).rollout(10, planner, break_when_any_done=False)
    assert [carried for carried, _ in calls] == [None] * 10


def test_an_init_tracker_is_enough_where_the_loop_carries_everything(monkeypatch):
    planner = make_planner(LineWorld())
    env = make_task(planner.world_model, max_steps=4)
    calls = record_starts(monkeypatch, planner)
    td = env.reset()
    for _ in range(4):
        td = step_mdp(env.step(planner(td)))  # the function, which knows no specs
    assert calls[0][0] is None
    assert all(torch.equal(calls[step][0], calls[step - 1][1]) for step in range(1, 4))


def test_without_any_transform_the_planner_warns_and_starts_cold(monkeypatch):
    planner = make_planner(LineWorld())
    calls = record_starts(monkeypatch, planner)
    with pytest.warns(UserWarning, match="so every plan starts cold"):
        data = LineTask(planner.world_model).rollout(5, planner)
    assert [carried for carried, _ in calls] == [None] * 5
    assert ("next", "plan_mean") not in data.keys(True)


# Batches of environments


def make_two_tasks(planner) -> TransformedEnv:
    """Two environments whose episodes have three and four steps."""
    env = SerialEnv(
        2, [lambda: make_task(planner.world_model, max_steps=3), lambda: make_task(planner.world_model, max_steps=4)]
    )
    return TransformedEnv(env, planner.make_tensordict_primer())


_TWO_RESETS = [[0, 0], [0, 3], [0, 6], [0, 9], [1, 0], [1, 4], [1, 8]]


def test_a_batch_of_environments_resets_each_plan_on_its_own():
    planner = make_planner(LineWorld())
    data = make_two_tasks(planner).rollout(10, planner, break_when_any_done=False)
    assert data.batch_size == (2, 10)
    assert_carried(data, resets=_TWO_RESETS)


@pytest.mark.parametrize("use_buffers", [True, False])
def test_a_collector_carries_the_plans_of_a_batch_of_environments(use_buffers):
    planner = make_planner(LineWorld())
    data = collect(make_two_tasks(planner), planner, frames_per_batch=10, batches=2, use_buffers=use_buffers)
    assert_carried(data, resets=_TWO_RESETS)


def test_a_batch_of_environments_is_one_planning_call(monkeypatch):
    planner = make_planner(LineWorld())
    calls = record_starts(monkeypatch, planner)
    make_two_tasks(planner).rollout(5, planner, break_when_any_done=False)
    assert [mean.shape for _, mean in calls] == [(2, 3, 1)] * 5


# Collectors


@pytest.mark.parametrize("use_buffers", [True, False])
def test_a_collector_finds_the_primer_by_itself(use_buffers):
    planner = make_planner(LineWorld())
    env = TransformedEnv(LineTask(planner.world_model), StepCounter(4))
    data = collect(
        env, planner, frames_per_batch=5, batches=2, auto_register_policy_transforms=True, use_buffers=use_buffers
    )
    assert any(isinstance(transform, TensorDictPrimer) for transform in env.transform)
    assert_carried(data, resets=[[0], [4], [8]])
    assert all(data[key].shape[0] == 10 for key in planner.out_keys)


def test_a_collector_of_a_gymnasium_task_stores_every_target():
    planner = make_planner(WorldModel(3, 1, latent_dim=16, mlp_dim=16, encoder_dim=16))
    env = make_pendulum(StepCounter(7), planner.make_tensordict_primer())
    data = collect(env, planner, frames_per_batch=10, batches=2)
    assert_carried(data, resets=[[0], [7], [14]])
    assert set(planner.out_keys) <= set(data.keys(True, True))
    assert data["plan", "version"].dtype == torch.int64
    assert data["plan", "scale"].min() >= 0.05


@pytest.mark.parametrize("mode", [ExplorationType.RANDOM, ExplorationType.DETERMINISTIC])
def test_a_collector_explores_as_it_is_told(mode):
    planner = make_planner(LineWorld(goal=-2.0))
    env = make_task(planner.world_model, planner.make_tensordict_primer(), max_steps=4)
    data = collect(env, planner, frames_per_batch=10, batches=1, exploration_type=mode)
    explored = (data["action"] != data["plan", "loc"]).any().item()
    assert explored == (mode is ExplorationType.RANDOM)


def test_a_collector_plans_with_the_weights_of_the_moment():
    planner = make_planner(LineWorld())
    env = make_task(planner.world_model, planner.make_tensordict_primer(), max_steps=4)
    collector = Collector(
        env, planner, frames_per_batch=2, total_frames=6, auto_register_policy_transforms=False, use_buffers=False
    )
    versions = []
    for data in collector:
        versions.append(data["plan", "version"].flatten().tolist())
        planner.world_model.version += 1
    collector.shutdown()
    assert versions == [[0, 0], [1, 1], [2, 2]]


# TorchRL's own planners


@pytest.mark.parametrize("batch_size", [(), (3,)])
@pytest.mark.parametrize("kind", [CEMPlanner, MPPIPlanner])
def test_torchrls_own_planners_drive_the_latent_env(kind, batch_size):
    world = LineWorld(goal=0.3, num_dynamics=2)
    env = LatentEnv(world)
    budget = {"planning_horizon": 2, "optim_steps": 6, "num_candidates": 128, "top_k": 16}
    if kind is MPPIPlanner:
        value = TensorDictModule(lambda latent: world.value(latent).unsqueeze(-1), ["latent"], ["state_value"])
        advantage = TDLambdaEstimator(gamma=0.99, lmbda=0.95, value_network=value)
        budget |= {"temperature": 5.0, "advantage_module": advantage}
    planner = kind(env, **budget)
    start = env.reset(TensorDict({"observation": torch.zeros(*batch_size, 1)}, batch_size=batch_size))
    action = planner(start)["action"]
    torch.testing.assert_close(action, torch.full((*batch_size, 1), 0.6), atol=0.2, rtol=0)


def test_torchrls_own_planner_rolls_the_imagination_on():
    env = LatentEnv(WorldModel(3, 2, latent_dim=16, mlp_dim=16, encoder_dim=16))
    planner = CEMPlanner(env, planning_horizon=3, optim_steps=2, num_candidates=8, top_k=2)
    data = env.rollout(5, planner)
    assert data["action"].shape == (5, 2)
    assert data["next", "latent"].isfinite().all()
