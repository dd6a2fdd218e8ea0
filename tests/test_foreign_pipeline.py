"""The parts in somebody else's TorchRL pipeline: nothing here comes from ``torchrl_etdmpc.training``."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, SliceSampler, TensorDictReplayBuffer, TensorDictRoundRobinWriter
from torchrl.envs import ActionScaling, Compose, GymEnv, InitTracker, RenameTransform, TransformedEnv
from torchrl.objectives import SoftUpdate

import torchrl_etdmpc
from torchrl_etdmpc import (
    EfficientTDMPCLoss,
    EnsembleMPPIPlanner,
    LatentEnv,
    ReanalyzeTransform,
    SeedPolicy,
    StepCollector,
    StepSliceSampler,
    WorldModel,
)

pytest.importorskip("gymnasium")

OBSERVATION, ACTION, REWARD, IS_INIT = ("obs", "state"), ("control", "u"), ("signal", "r"), ("flags", "first")
PLAN, PLAN_MEAN = ("expert", "plan"), ("expert", "carried")
SLICE_LEN, NUM_SLICES = 3, 32
BUDGET = {"horizon": 3, "num_samples": 16, "num_elites": 4, "num_proposals": 4, "iterations": 2}


def make_env() -> TransformedEnv:
    """Pendulum with actions in [-1, 1] and every key renamed and nested."""
    env = TransformedEnv(
        GymEnv("Pendulum-v1"),
        Compose(
            InitTracker(),
            ActionScaling(),
            RenameTransform(
                in_keys=["observation", "reward", "is_init"],
                out_keys=[OBSERVATION, REWARD, IS_INIT],
                in_keys_inv=["action"],
                out_keys_inv=[ACTION],
            ),
        ),
    )
    env.set_seed(0)
    return env


def make_model() -> WorldModel:
    torch.manual_seed(0)
    return WorldModel(3, 1, latent_dim=32, mlp_dim=32, encoder_dim=32, num_dynamics=2)


WIDE = {"proposal_log_std_min": -2.0, "proposal_log_std_max": 1.0}


def make_planner(model: WorldModel, **options) -> EnsembleMPPIPlanner:
    return EnsembleMPPIPlanner(
        LatentEnv(model),
        **BUDGET,
        observation_key=OBSERVATION,
        action_key=ACTION,
        is_init_key=IS_INIT,
        plan_mean_key=PLAN_MEAN,
        plan_key=PLAN,
        **options,
    )


def make_reanalyze(model: WorldModel, buffer: TensorDictReplayBuffer) -> ReanalyzeTransform:
    planner = make_planner(model, warm_start=False, score="final", **WIDE)
    return ReanalyzeTransform(
        planner,
        slice_len=SLICE_LEN,
        interval=10,
        num_slices=5,
        observation_key=OBSERVATION,
        plan_key=PLAN,
    ).attach(buffer)


def make_loss(model: WorldModel) -> EfficientTDMPCLoss:
    loss = EfficientTDMPCLoss(model, discount=0.97)
    loss.set_keys(
        observation=OBSERVATION,
        action=ACTION,
        reward=REWARD,
        plan_loc=(*PLAN, "loc"),
        plan_scale=(*PLAN, "scale"),
    )
    return loss


def make_buffer(sampler) -> TensorDictReplayBuffer:
    return TensorDictReplayBuffer(
        storage=LazyTensorStorage(1000),
        sampler=sampler,
        writer=TensorDictRoundRobinWriter(track_generations=True),
        batch_size=NUM_SLICES * SLICE_LEN,
    )


def test_the_parts_learn_in_a_pipeline_of_torchrl_s_own_with_other_keys():
    model = make_model()
    planner = make_planner(model)
    env = make_env()
    collector = Collector(
        env,
        planner,
        frames_per_batch=50,
        total_frames=300,
        use_buffers=False,
        auto_register_policy_transforms=True,
    )
    buffer = make_buffer(
        SliceSampler(slice_len=SLICE_LEN, traj_key=("collector", "traj_ids"), truncated_key=None, init_key=None)
    )
    for batch in collector:
        assert batch[ACTION].abs().max() <= 1
        assert (batch[PLAN_MEAN] != 0).any()  # the collector registered the primer: plans are warm-started
        assert (batch[PLAN_MEAN][batch[IS_INIT].squeeze(-1)] == 0).all()
        buffer.extend(batch.reshape(-1).exclude(PLAN_MEAN, ("next", *PLAN_MEAN)))
    collector.shutdown()
    assert len(buffer) == 300
    stored = buffer.storage[:]
    assert stored[(*PLAN, "loc")].shape == stored[ACTION].shape == (300, 1)

    reanalyze = make_reanalyze(model, buffer)
    loss = make_loss(model)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
    target_update = SoftUpdate(loss, tau=0.01)

    def terms(batch) -> dict[str, torch.Tensor]:
        torch.manual_seed(9)  # the loss draws actions and dropout
        out = loss(batch)
        return {key: value for key, value in out.items() if key.startswith("loss_")}

    reanalyze.enabled = False
    fixed = buffer.sample().reshape(-1, SLICE_LEN)
    assert (fixed["collector", "traj_ids"] == fixed["collector", "traj_ids"][:, :1]).all()
    assert torch.equal(fixed["next", *OBSERVATION][:, :-1], fixed[OBSERVATION][:, 1:])
    first = terms(fixed)
    before_updates = buffer.storage[:].clone()
    torch.manual_seed(1)
    untrained = planner.plan(fixed[OBSERVATION][:, 0])
    for update in range(100):
        reanalyze.enabled = update % 2 == 1  # every second batch is the fixed one
        batch = buffer.sample().reshape(-1, SLICE_LEN) if update % 2 else fixed
        losses = loss(batch)
        total = sum(value for key, value in losses.items() if key.startswith("loss_"))
        assert total.isfinite()
        total.backward()
        assert all(parameter.grad is not None and parameter.grad.isfinite().all() for parameter in loss.parameters())
        optimizer.step()
        optimizer.zero_grad()
        target_update.step()
    last = terms(fixed)
    assert set(first) == {"loss_consistency", "loss_reward", "loss_value", "loss_policy"}
    assert all(value.isfinite() for value in last.values())
    assert last["loss_reward"] < 0.8 * first["loss_reward"]
    assert last["loss_consistency"] + last["loss_reward"] < first["loss_consistency"] + first["loss_reward"]

    assert (reanalyze.refreshed, reanalyze.stale) == (5 * 5 * SLICE_LEN, 0)
    assert reanalyze.target_age > 0
    after = buffer.storage[:]
    renewed = after[(*PLAN, "version")].squeeze(-1) > 0
    assert 0 < renewed.sum() <= 5 * 5 * SLICE_LEN
    assert after[(*PLAN, "version")].max() == 99  # made by the weights of 99 updates
    for key in before_updates.keys(True, True):
        different = (before_updates[key] != after[key]).reshape(300, -1).any(-1)
        assert not different[~renewed].any(), key
    assert (before_updates[(*PLAN, "value")] != after[(*PLAN, "value")])[renewed].all()

    torch.manual_seed(1)
    trained = planner.plan(fixed[OBSERVATION][:, 0])
    assert (trained.value != untrained.value).any()
    owned = {parameter.data_ptr() for parameter in planner.parameters()}
    assert owned == {parameter.data_ptr() for parameter in loss.parameters()}


def test_our_collector_and_sampler_take_the_same_keys():
    model, env = make_model(), make_env()
    planner = make_planner(model)
    buffer = make_buffer(StepSliceSampler(SLICE_LEN))
    collector = StepCollector(
        env,
        planner,
        replay_buffer=buffer,
        total_frames=60,
        init_random_frames=30,
        seed_policy=SeedPolicy(env.action_spec, action_key=ACTION, plan_key=PLAN),
        exclude_keys=[PLAN_MEAN, ("next", *PLAN_MEAN), IS_INIT, ("next", *IS_INIT)],
    )
    for _ in collector:
        pass
    collector.shutdown()
    keys = set(buffer.storage[:].keys(True, True))
    assert {OBSERVATION, ACTION, ("next", *REWARD), (*PLAN, "loc"), (*PLAN, "version")} <= keys
    assert not [key for key in keys if "carried" in key or "first" in key]
    reanalyze = make_reanalyze(model, buffer)
    for _ in range(10):
        batch = buffer.sample().reshape(-1, SLICE_LEN)
    assert reanalyze.refreshed == 5 * SLICE_LEN
    loss = make_loss(model)
    SoftUpdate(loss, tau=0.01)
    out = loss(batch)
    assert all(out[key].isfinite() for key in out.keys())


def test_the_planner_drives_a_rollout_with_other_keys():
    env = make_env()
    planner = make_planner(make_model())
    env = env.append_transform(planner.make_tensordict_primer())
    rollout = env.rollout(5, planner)
    assert rollout[ACTION].shape == (5, 1)
    assert torch.equal(rollout[PLAN_MEAN][1:], rollout["next", *PLAN_MEAN][:-1])
    assert (rollout[PLAN_MEAN][0] == 0).all() and (rollout[PLAN_MEAN][1:] != 0).any()


@pytest.mark.parametrize("begins", [True, False])
def test_the_planner_drops_the_carried_plan_where_the_renamed_flag_says_so(begins):
    planner = make_planner(make_model())
    state, carried = torch.randn(4, 3), torch.ones(4, 3, 1)
    data = TensorDict({OBSERVATION: state, PLAN_MEAN: carried, IS_INIT: torch.full((4, 1), begins)}, [4])
    torch.manual_seed(1)
    out = planner(data)
    torch.manual_seed(1)
    expected = planner.plan(state, torch.zeros_like(carried) if begins else carried)
    torch.manual_seed(1)
    other = planner.plan(state, carried if begins else torch.zeros_like(carried))
    assert torch.equal(out["next", *PLAN_MEAN], expected.mean)
    assert not torch.equal(out["next", *PLAN_MEAN], other.mean)


def test_none_of_the_parts_imports_the_training_layer():
    root = Path(torchrl_etdmpc.__file__).parent
    files = [path for path in root.rglob("*.py") if path.parent.name not in ("training", "suites", "commands")]
    assert len(files) > 20
    for path in files:
        for node in ast.walk(ast.parse(path.read_text())):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [f"{node.module}.{alias.name}" for alias in node.names] if isinstance(node, ast.ImportFrom) else []
            assert not [name for name in names if name.startswith("torchrl_etdmpc.training")], path
