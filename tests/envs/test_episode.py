from __future__ import annotations

import io

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import EnvBase, StepCounter, TransformedEnv
from torchrl.testing.mocking_classes import ContinuousActionVecMockEnv

pytest.importorskip("dm_control")

from torchrl_etdmpc import SeedPolicy, StepCollector  # noqa: E402
from torchrl_etdmpc.envs import load_simulator_state, make_dmc_env, simulator_state  # noqa: E402

LIMIT = 9


def make_env(task: str, num_envs: int, *, parallel: bool, seed: int = 3) -> EnvBase:
    """Episodes of nine steps; the last transform is outside the workers."""
    return make_dmc_env(task, seed=seed, num_envs=num_envs, parallel=parallel).append_transform(StepCounter(LIMIT))


def step(env: EnvBase, carrier: TensorDictBase) -> tuple[TensorDictBase, TensorDictBase]:
    carrier.set("action", torch.rand(env.action_spec.shape) * 2 - 1)
    stepped, carrier = env.step_and_maybe_reset(carrier)
    return stepped.clone(), carrier


def through_a_file(state):
    """As a checkpoint would: only tensors and plain containers survive ``weights_only``."""
    file = io.BytesIO()
    torch.save(state, file)
    file.seek(0)
    return torch.load(file, weights_only=True)


@pytest.mark.parametrize(
    ("task", "num_envs", "parallel"),
    [
        ("walker-walk", 1, False),
        ("walker-walk", 3, False),
        ("walker-walk", 2, True),
        ("quadruped-walk", 1, False),  # random initial orientation, rescaled actions
        ("reacher-easy", 1, False),  # a target drawn at every reset
        ("humanoid-run", 1, False),
        ("finger-spin", 1, False),
    ],
)
@pytest.mark.parametrize("steps", [4, 2 * LIMIT + 3])
def test_another_environment_goes_on_where_the_first_one_was(task, num_envs, parallel, steps):
    torch.manual_seed(0)
    first, second = (make_env(task, num_envs, parallel=parallel, seed=seed) for seed in (3, 4))
    carrier = first.reset()
    for _ in range(steps):
        _, carrier = step(first, carrier)
    state, resumed = through_a_file(simulator_state(first)), carrier.clone()
    torch.manual_seed(1)
    expected = []
    for _ in range(2 * LIMIT):  # over two resets
        stepped, carrier = step(first, carrier)
        expected.append(stepped)
    assert load_simulator_state(second, state)
    torch.manual_seed(1)
    for wanted in expected:
        stepped, resumed = step(second, resumed)
        assert (stepped == wanted).all()
    first.close()
    second.close()


def test_a_simulator_that_behaves_otherwise_is_noticed():
    first, second = (make_env("walker-walk", 1, parallel=False) for _ in range(2))
    carrier = first.reset()
    for _ in range(3):
        _, carrier = step(first, carrier)
    second.physics.model.opt.gravity[2] = -5.0
    assert not load_simulator_state(second, simulator_state(first))


def test_other_environments_say_that_they_cannot_be_restored():
    assert simulator_state(TransformedEnv(ContinuousActionVecMockEnv(), StepCounter(3))) is None


@pytest.mark.parametrize("num_envs", [1, 3])
@pytest.mark.parametrize("insertion", ["step", "episode"])
def test_a_loaded_collector_goes_on_inside_the_episode(insertion, num_envs):
    def make_collector(seed: int) -> tuple[StepCollector, TensorDictReplayBuffer]:
        env = make_env("cartpole-swingup", num_envs, parallel=False, seed=seed)
        buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(200))
        policy = SeedPolicy(env.action_spec)
        return StepCollector(env, policy, replay_buffer=buffer, insertion=insertion), buffer

    first, buffer = make_collector(seed=0)
    for _ in range(LIMIT + 4):
        first.step()
    state, rows = through_a_file(first.state_dict()), len(buffer)
    torch.manual_seed(5)
    for _ in range(2 * LIMIT):
        first.step()
    second, resumed = make_collector(seed=1)
    second.load_state_dict(state)
    torch.manual_seed(5)
    for _ in range(2 * LIMIT):
        second.step()
    wanted = buffer.storage[:][rows:].exclude("index")
    assert (resumed.storage[:].exclude("index") == wanted).all()
    assert len(resumed) == len(wanted) > 0


def test_a_collector_whose_simulator_does_not_come_back_begins_fresh_episodes_and_says_so():
    envs = [make_env("walker-walk", 1, parallel=False) for _ in range(2)]
    collectors = [
        StepCollector(
            env, SeedPolicy(env.action_spec), replay_buffer=TensorDictReplayBuffer(storage=LazyTensorStorage(50))
        )
        for env in envs
    ]
    for _ in range(3):
        collectors[0].step()
    envs[1].physics.model.opt.gravity[2] = -5.0
    with pytest.warns(UserWarning, match="^the simulator did not come back to where it was"):
        collectors[1].load_state_dict(collectors[0].state_dict())
    assert collectors[1].frames == 3
    row = collectors[1].step()
    assert row["collector", "traj_ids"].item() == 1
    assert row["next", "step_count"].item() == 1


def test_a_state_is_small_and_of_plain_types():
    env = make_env("humanoid-run", 1, parallel=False)
    carrier = env.reset()
    for _ in range(5):
        _, carrier = step(env, carrier)
    state = simulator_state(env)
    tensors = TensorDict(state).flatten_keys()
    assert tensors.bytes() < 10_000
