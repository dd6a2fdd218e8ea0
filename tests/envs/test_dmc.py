from __future__ import annotations

import importlib.metadata
import importlib.util
import logging
import sys
import warnings

import numpy as np
import pytest
import torch
from torchrl.envs import (
    ActionScaling,
    Compose,
    DMControlEnv,
    DoubleToFloat,
    EnvBase,
    InitTracker,
    RenameTransform,
    RewardSum,
    TransformedEnv,
)
from torchrl.envs.utils import check_env_specs

from torchrl_etdmpc.envs import DMC_TASKS, Task, get_task, make_env
from torchrl_etdmpc.envs.dmc import domain_and_task

pytest.importorskip("dm_control")

# What dm_control lists per domain, and the size of each part: the order that trained weights depend on.
_ORDER = {
    "acrobot-swingup": {"orientations": 4, "velocity": 2},
    "cartpole-swingup": {"position": 3, "velocity": 2},
    "cheetah-run": {"position": 8, "velocity": 9},
    "cup-catch": {"position": 4, "velocity": 4},
    "finger-spin": {"position": 4, "velocity": 3, "touch": 2},
    "finger-turn-hard": {"position": 4, "velocity": 3, "touch": 2, "target_position": 2, "dist_to_target": 1},
    "fish-swim": {"joint_angles": 7, "upright": 1, "target": 3, "velocity": 13},
    "hopper-hop": {"position": 6, "velocity": 7, "touch": 2},
    "humanoid-run": {
        "joint_angles": 21,
        "head_height": 1,
        "extremities": 12,
        "torso_vertical": 3,
        "com_velocity": 3,
        "velocity": 27,
    },
    "pendulum-swingup": {"orientation": 2, "velocity": 1},
    "quadruped-run": {
        "egocentric_state": 44,
        "torso_velocity": 3,
        "torso_upright": 1,
        "imu": 6,
        "force_torque": 24,
    },
    "reacher-easy": {"position": 2, "to_target": 2, "velocity": 2},
    "walker-walk": {"orientations": 14, "height": 1, "velocity": 9},
    "dog-run": {
        "joint_angles": 73,
        "joint_velocites": 73,  # dm_control's spelling
        "torso_pelvis_height": 2,
        "z_projection": 9,
        "torso_com_velocity": 3,
        "inertial_sensors": 9,
        "foot_forces": 12,
        "touch_sensors": 4,
        "actuator_state": 38,
    },
}
_SLOW_TO_LOAD = ("dog-run",)


def _raw_env(name: str, seed: int):
    """The dm_control environment itself, in the state in which make_env(name, seed=seed).reset() leaves it."""
    from dm_control import suite

    env = suite.load(*domain_and_task(name), task_kwargs={"random": np.random.RandomState(seed)})
    env.reset()  # TorchRL resets once when it seeds
    return env


def _actions(env: EnvBase, steps: int) -> torch.Tensor:
    torch.manual_seed(0)
    return torch.stack([env.action_spec.rand() for _ in range(steps)])


def _play(env: EnvBase, actions: torch.Tensor) -> list:
    """Steps through the actions; the transitions of one uninterrupted episode."""
    state, steps = env.reset(), []
    for action in actions:
        state, next_state = env.step_and_maybe_reset(state.set("action", action))
        steps.append(state)
        state = next_state
    return steps


@pytest.mark.parametrize("name", ["walker-walk", "quadruped-walk"])
def test_a_decisions_reward_is_the_sum_over_its_two_env_steps(name):
    env = make_env(name, seed=3)
    raw = _raw_env(name, seed=3)
    first = raw.reset()
    low, high = raw.action_spec().minimum, raw.action_spec().maximum
    actions = _actions(env, 20)
    steps = _play(env, actions)
    np.testing.assert_allclose(
        steps[0]["observation"], np.concatenate([np.ravel(part) for part in first.observation.values()]), rtol=1e-6
    )
    total = 0.0
    for action, step in zip(actions.double().numpy(), steps, strict=True):
        raw_steps = [raw.step(low + (action + 1) / 2 * (high - low)) for _ in range(2)]
        reward = sum(raw_step.reward for raw_step in raw_steps)
        total += reward
        assert step["next", "reward"].item() == pytest.approx(reward, rel=1e-5)
        assert step["next", "episode_reward"].item() == pytest.approx(total, rel=1e-5)
        flat = np.concatenate([np.ravel(part) for part in raw_steps[-1].observation.values()])
        np.testing.assert_allclose(step["next", "observation"], flat, rtol=1e-4, atol=1e-5)


def test_an_episode_is_500_decisions_and_ends_truncated_not_terminated():
    env = make_env("pendulum-swingup", seed=0)
    rollout = env.rollout(600)
    assert rollout.shape == (500,)
    ends = torch.arange(500).unsqueeze(-1) == 499
    assert torch.equal(rollout["next", "truncated"], ends)
    assert torch.equal(rollout["next", "done"], ends)
    assert not rollout["next", "terminated"].any()
    assert torch.equal(rollout["is_init"], torch.arange(500).unsqueeze(-1) == 0)
    torch.testing.assert_close(rollout["next", "episode_reward"][-1], rollout["next", "reward"].sum(0))


def test_an_early_end_terminates_and_ends_the_action_repeat(monkeypatch):
    from dm_env import StepType

    env = make_env("pendulum-swingup", seed=0)
    state = env.reset()
    simulate, calls = env._env.step, []

    def fall(action):
        calls.append(action)
        return simulate(action)._replace(step_type=StepType.LAST, discount=0.0, reward=0.25)

    monkeypatch.setattr(env._env, "step", fall)
    after = env.step(state.set("action", torch.zeros(1)))["next"]
    assert len(calls) == 1
    assert after["reward"].item() == 0.25
    assert [after[name].item() for name in ("terminated", "truncated", "done")] == [True, False, True]


@pytest.mark.parametrize("name", ["walker-walk", "quadruped-walk"])
def test_the_environment_is_torchrls_with_transforms(name):
    names, options = domain_and_task(name), {"flat_observation": True}
    base = DMControlEnv(*names, frame_skip=2, device="cpu", environment_kwargs=options)
    # On the way in transforms apply from last to first, so actions are scaled in float64.
    transforms = [RenameTransform(["observations"], ["observation"]), DoubleToFloat(), InitTracker(), RewardSum()]
    reference = TransformedEnv(base, Compose(*([ActionScaling()] if "quadruped" in name else []), *transforms))
    reference.set_seed(4)
    ours = make_env(name, seed=4)
    actions = _actions(ours, 20)
    for step, expected in zip(_play(ours, actions), _play(reference, actions), strict=True):
        assert set(step.keys(True, True)) == set(expected.keys(True, True))
        for key, value in expected.items(True, True):
            assert step[key].dtype == value.dtype, key
            torch.testing.assert_close(step[key], value, rtol=0, atol=0, msg=str(key))


@pytest.mark.parametrize(
    ("name", "names"),
    [
        ("cup-catch", ("ball_in_cup", "catch")),
        ("cartpole-balance-sparse", ("cartpole", "balance_sparse")),
        ("cartpole-swingup-sparse", ("cartpole", "swingup_sparse")),
        ("finger-turn-easy", ("finger", "turn_easy")),
        ("dog-trot", ("dog", "trot")),
    ],
)
def test_names_map_to_the_suites_own_names(name, names):
    assert domain_and_task(name) == names


@pytest.mark.parametrize("end", [-1.0, 0.0, 1.0])
def test_quadruped_actions_span_the_raw_bounds_and_are_stored_as_given(end):
    env = make_env("quadruped-walk", seed=0)
    raw = _raw_env("quadruped-walk", seed=0).action_spec()
    assert not (np.all(raw.minimum == -1) and np.all(raw.maximum == 1))
    action = torch.full((12,), end)
    (step,) = _play(env, action.unsqueeze(0))
    assert torch.equal(step["action"], action)
    physics = env.physics
    expected = {-1.0: raw.minimum, 0.0: (raw.minimum + raw.maximum) / 2, 1.0: raw.maximum}[end]
    np.testing.assert_allclose(physics.control(), expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow) if name in _SLOW_TO_LOAD else name for name in _ORDER]
)
def test_the_observation_joins_the_parts_in_dm_controls_order(name):
    raw = _raw_env(name, seed=0)
    parts = raw.reset().observation
    assert [(key, np.size(part)) for key, part in parts.items()] == list(_ORDER[name].items())
    observation = make_env(name, seed=0).reset()["observation"]
    flat = np.concatenate([np.ravel(part) for part in parts.values()]).astype(np.float32)
    np.testing.assert_array_equal(observation, flat)


@pytest.mark.slow
@pytest.mark.parametrize("name", DMC_TASKS)
def test_every_task_loads_and_steps(name):
    env = make_env(name, seed=0)
    rollout = env.rollout(10)
    assert rollout.shape == (10,)
    assert rollout["action"].abs().max() <= 1
    for key in ("observation", "reward"):
        assert rollout["next", key].dtype == torch.float32
        assert rollout["next", key].isfinite().all()
    raw = _raw_env(name, seed=0)
    assert raw.action_spec().shape == env.action_spec.shape
    # dm_control offers no public name for its time limit in env steps.
    assert raw._step_limit == get_task(name).episode_length


def test_making_an_environment_prints_nothing(capfd):
    make_env("cheetah-run", seed=0).rollout(2)
    assert capfd.readouterr() == ("", "")


def test_notices_are_hidden_while_a_task_is_made_and_shown_before_and_after(monkeypatch, caplog):
    from absl import logging as absl_logging
    from dm_control import suite

    load = suite.load

    def noisy(*args, **options):
        warnings.warn("an old attribute", stacklevel=2)
        absl_logging.warning("an old attribute")
        return load(*args, **options)

    monkeypatch.setattr(suite, "load", noisy)
    # absl's own handler would print them as well.
    monkeypatch.setattr(absl_logging.get_absl_logger(), "handlers", [logging.NullHandler()])
    absl_logging.warning("before")
    make_env("pendulum-swingup")
    absl_logging.warning("after")
    assert caplog.messages == ["before", "after"]


NEEDED = "pip install 'dm-control==1.0.50' 'mujoco>=3.17,<4'"
WITHOUT_LABMAZE = (
    "pip install 'mujoco>=3.17,<4' absl-py dm-env dm-tree glfw lxml protobuf pyopengl pyparsing requests scipy tqdm && "
    "pip install --no-deps 'dm-control==1.0.50'"
)


@pytest.mark.parametrize(("python", "needed"), [((3, 12, 9), NEEDED), ((3, 13, 0), WITHOUT_LABMAZE)])
def test_a_missing_dm_control_is_one_line_that_says_what_to_install(monkeypatch, python, needed):
    find_spec = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util,
        "find_spec",
        lambda name, package=None: None if name == "dm_control" else find_spec(name, package),
    )
    monkeypatch.setattr(sys, "version_info", python)
    with pytest.raises(ImportError) as error:
        make_env("walker-walk")
    assert str(error.value) == f"dm_control tasks need dm-control, which is missing; run: {needed}"


@pytest.mark.parametrize(
    ("mujoco", "dm_control", "works"),
    [("4.0.0", "1.0.50", False), ("4.0.0", "1.0.49", False), ("4.0.0", "1.0.51", True), ("3.17.0", "1.0.50", True)],
)
def test_a_mujoco_that_breaks_this_dm_control_is_refused_in_one_line(mujoco, dm_control, works, monkeypatch):
    version, faked = importlib.metadata.version, {"mujoco": mujoco, "dm-control": dm_control}
    monkeypatch.setattr(importlib.metadata, "version", lambda name: faked.get(name) or version(name))
    if works:
        make_env("pendulum-swingup")
        return
    with pytest.raises(ImportError) as error:
        make_env("pendulum-swingup")
    needed = NEEDED if sys.version_info < (3, 13) else WITHOUT_LABMAZE
    assert str(error.value) == (
        f"dm-control {dm_control} does not work with mujoco {mujoco}; run in a fresh virtual environment: {needed}"
    )


def test_actuators_without_a_range_are_refused():
    task = Task("lqr-lqr_2_1", "dm_control", episode_length=100)
    with pytest.raises(ValueError, match=r"actions have no finite bounds \(they reach from -1e\+10 to 1e\+10\), so"):
        make_env(task)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_on_a_gpu_every_entry_is_there():
    env = make_env("quadruped-walk", seed=0, device="cuda")
    check_env_specs(env)
    rollout = env.rollout(3)
    assert all(value.device.type == "cuda" for value in rollout.values(True, True))
