from __future__ import annotations

import dataclasses
import importlib.metadata
import importlib.util
import logging
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


@pytest.mark.parametrize("name", ["pendulum-swingup", "quadruped-run", "walker-walk"])
def test_the_specs_describe_what_the_environment_does(name):
    env = make_env(name, seed=0)
    check_env_specs(env)
    assert env.batch_size == ()
    assert env.device == torch.device("cpu")
    assert set(env.full_observation_spec.keys()) == {"observation", "is_init", "episode_reward"}
    for spec in (env.observation_spec["observation"], env.reward_spec, env.action_spec):
        assert spec.dtype == torch.float32
    assert (env.action_spec.space.low == -1).all()
    assert (env.action_spec.space.high == 1).all()


def test_the_same_seed_repeats_the_episode_and_another_does_not():
    def play(seed):
        env = make_env("walker-walk", seed=seed)
        steps = _play(env, _actions(env, 5))
        return torch.stack([step["next", "observation"] for step in steps])

    torch.testing.assert_close(play(1), play(1), rtol=0, atol=0)
    assert not torch.equal(play(1), play(2))


def test_episodes_of_one_environment_differ_and_seeding_starts_them_over():
    env = make_env("walker-walk", seed=1)
    first, second = env.reset()["observation"], env.reset()["observation"]
    assert not torch.equal(first, second)
    env.set_seed(1)
    assert torch.equal(env.reset()["observation"], first)


def test_without_a_seed_two_environments_start_differently():
    first, second = make_env("walker-walk"), make_env("walker-walk")
    assert not torch.equal(first.reset()["observation"], second.reset()["observation"])


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
    actions = _actions(ours, 50)
    for step, expected in zip(_play(ours, actions), _play(reference, actions), strict=True):
        assert set(step.keys(True, True)) == set(expected.keys(True, True))
        for key, value in expected.items(True, True):
            assert step[key].dtype == value.dtype, key
            torch.testing.assert_close(step[key], value, rtol=0, atol=0, msg=str(key))


def test_the_episode_reward_starts_over_with_each_episode():
    env = make_env("cartpole-balance", seed=0)
    rollout = env.rollout(502, break_when_any_done=False)
    assert rollout["is_init"].squeeze(-1).nonzero().squeeze(-1).tolist() == [0, 500]
    torch.testing.assert_close(rollout["next", "episode_reward"][500], rollout["next", "reward"][500])


def test_the_action_repeat_comes_from_the_task():
    task = dataclasses.replace(get_task("pendulum-swingup"), action_repeat=4)
    assert make_env(task, seed=0).rollout(600).shape == (task.decision_steps_per_episode,) == (250,)


def test_the_episode_length_comes_from_the_task():
    env = make_env(get_task("pendulum-swingup", episode_length=25), seed=0)
    rollout = env.rollout(600)
    assert rollout.shape == (13,)  # the last decision is one env step
    assert rollout["next", "truncated"][-1].item()
    assert env.rollout(600).shape == (13,)


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


def test_the_walkers_height_stands_between_orientations_and_velocity():
    env = make_env("walker-walk", seed=0)
    observation = env.reset()["observation"]
    assert observation[14].item() == pytest.approx(env.physics.torso_height())


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


@pytest.fixture(scope="module")
def two_walkers():
    threads = torch.get_num_threads()
    env = make_env("walker-walk", seed=5, num_envs=2)
    env.reset()
    assert torch.get_num_threads() == threads
    yield env
    env.close()


def test_parallel_environments_have_the_entries_of_a_single_one(two_walkers):
    rollout = two_walkers.rollout(4)
    assert rollout.shape == (2, 4)
    assert rollout["observation"].shape == (2, 4, 24)
    assert rollout["next", "reward"].shape == (2, 4, 1)
    assert rollout["is_init"].squeeze(-1).tolist() == [[True, False, False, False]] * 2
    assert set(rollout.keys(True, True)) == set(make_env("walker-walk").rollout(1).keys(True, True))


def test_parallel_environments_have_seeds_of_their_own_and_repeat(two_walkers):
    two_walkers.set_seed(5)
    first = two_walkers.reset()["observation"].clone()
    two_walkers.set_seed(5)
    again = two_walkers.reset()["observation"].clone()
    assert torch.equal(first, again)
    assert not torch.equal(first[0], first[1])
    assert torch.equal(first[0], make_env("walker-walk", seed=5).reset()["observation"])


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


def test_a_missing_dm_control_is_one_line_that_says_what_to_install(monkeypatch):
    find_spec = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util,
        "find_spec",
        lambda name, package=None: None if name == "dm_control" else find_spec(name, package),
    )
    with pytest.raises(ImportError) as error:
        make_env("walker-walk")
    assert str(error.value) == (
        "dm_control tasks need dm-control, which is missing; run: pip install 'dm-control==1.0.50' 'mujoco>=3.17,<4'"
    )


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
    assert str(error.value) == (
        f"dm-control {dm_control} does not work with mujoco {mujoco}; "
        "run in a fresh virtual environment: pip install 'dm-control==1.0.50' 'mujoco>=3.17,<4'"
    )


def test_an_unknown_task_is_refused_with_the_nearest_names():
    with pytest.raises(ValueError, match="^unknown task 'walker_walk'; did you mean walker-walk"):
        make_env("walker_walk")


def test_actuators_without_a_range_are_refused():
    task = Task("lqr-lqr_2_1", "dm_control", episode_length=100)
    with pytest.raises(ValueError, match=r"actions have no finite bounds \(they reach from -1e\+10 to 1e\+10\), so"):
        make_env(task)


def test_no_environments_at_all_is_refused():
    with pytest.raises(ValueError, match=r"^num_envs must be at least 1, got 0\.$"):
        make_env("walker-walk", num_envs=0)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_on_a_gpu_every_entry_is_there():
    env = make_env("quadruped-walk", seed=0, device="cuda")
    check_env_specs(env)
    rollout = env.rollout(3)
    assert all(value.device.type == "cuda" for value in rollout.values(True, True))
