from __future__ import annotations

import importlib.util
import inspect

import numpy as np
import pytest
import torch
from torchrl.envs import ActionScaling, Compose, DoubleToFloat, GymEnv, InitTracker, RewardSum, TransformedEnv
from torchrl.envs.utils import check_env_specs

gymnasium = pytest.importorskip("gymnasium")

from torchrl_etdmpc.envs import check_env, get_task, make_env  # noqa: E402

Box, Dict, Discrete = gymnasium.spaces.Box, gymnasium.spaces.Dict, gymnasium.spaces.Discrete
needs_mujoco = pytest.mark.skipif(importlib.util.find_spec("imageio") is None, reason="needs gymnasium[mujoco]")
_PENDULUM, _HOPPER = "gym/Pendulum-v1", pytest.param("gym/Hopper-v5", marks=needs_mujoco)


class Recorder(gymnasium.Env):
    """Keeps the actions that arrive, counts steps, hands out the same memory as observation every time."""

    def __init__(self, observation=None, action=None, ends=1000, reward=0.5):
        self.reward = reward
        self.observation_space = observation or Box(-np.inf, np.inf, (2, 3), np.float64)
        self.action_space = action or Box(np.array([-2, 0.5]), np.array([0, 3.5]), dtype=np.float64)
        self.arrived, self.steps, self.ends = [], 0, ends
        self.memory = np.zeros(self.observation_space.shape or (), self.observation_space.dtype)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        self.memory[...] = self.np_random.random()
        return self.memory, {}

    def step(self, action):
        assert self.action_space.contains(action), action
        self.arrived.append(action)
        self.steps += 1
        self.memory[...] = self.steps
        return self.memory, self.reward, self.steps >= self.ends, False, {}


@pytest.fixture
def recorder():
    """A function that registers an environment and returns the name of its task."""
    names = []

    def register(**options):
        names.append(f"Recorder{len(names)}-v0")
        gymnasium.register(names[-1], Recorder, kwargs=options, max_episode_steps=20)
        return f"gym/{names[-1]}"

    yield register
    for name in names:
        del gymnasium.registry[name]


@pytest.mark.parametrize(("ours", "theirs"), [(-1, -2), (0, 0), (0.5, 1), (1, 2)])
def test_pendulums_action_is_rescaled_to_its_bounds(ours, theirs):
    env = make_env(_PENDULUM, seed=0)
    env.step(env.reset().set("action", torch.tensor([float(ours)])))
    assert env._env.unwrapped.last_u == theirs


def test_each_dimension_has_bounds_of_its_own_and_ends_are_reached_exactly(recorder):
    env = make_env(recorder())
    state = env.reset()
    for action in ([-1.0, -1.0], [1.0, 1.0], [0.0, 0.0], [0.1, -0.25]):
        state = env.step_mdp(env.step(state.set("action", torch.tensor(action))))
    arrived = env._env.unwrapped.arrived
    assert all(action.dtype == np.float64 for action in arrived)
    np.testing.assert_array_equal(arrived[:3], [[-2, 0.5], [0, 3.5], [-1, 2]])
    np.testing.assert_allclose(arrived[3], [-1 + float(np.float32(0.1)), 2 - 0.25 * 1.5], rtol=1e-15)


def test_no_bound_is_passed_by_rounding(recorder):
    bounds = np.random.default_rng(0).normal(size=(2, 2000)).round(1)
    env = make_env(recorder(action=Box(bounds.min(0), bounds.max(0), dtype=np.float64)))
    state = env.reset()
    for end in (-1.0, 1.0):
        state = env.step_mdp(env.step(state.set("action", torch.full((2000,), end))))
    for arrived, wanted in zip(env._env.unwrapped.arrived, (bounds.min(0), bounds.max(0)), strict=True):
        np.testing.assert_allclose(arrived, wanted, rtol=0, atol=1e-15)  # and within, which the environment asserts


def test_actions_of_any_shape_and_precision_arrive_as_the_environment_wants_them(recorder):
    env = make_env(recorder(action=Box(-3, 3, (2, 2), np.float32)))
    assert env.action_spec.shape == (4,)
    env.step(env.reset().set("action", torch.tensor([1.0, -1.0, 0.0, 0.5])))
    (arrived,) = env._env.unwrapped.arrived
    assert arrived.dtype == np.float32
    np.testing.assert_array_equal(arrived, [[3, -3], [0, 1.5]])


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_an_observation_of_any_shape_is_a_float32_vector_in_memory_of_its_own(recorder, dtype):
    env = make_env(recorder(observation=Box(-np.inf, np.inf, (2, 3), dtype)))
    first = env.reset()
    before = first["observation"].clone()
    second = env.step(first.set("action", torch.zeros(2)))
    assert second["next", "observation"].dtype == torch.float32
    assert second["next", "observation"].tolist() == [1] * 6
    assert torch.equal(first["observation"], before)  # the environment has written over its own


@pytest.mark.parametrize("reward", [2, 2.0, np.float32(2), np.array(2), np.array([2.0])], ids=repr)
def test_a_reward_is_a_number_of_any_kind_or_an_array_of_one(reward, recorder):
    assert make_env(recorder(reward=reward)).rollout(2)["next", "reward"].tolist() == [[2.0], [2.0]]


def test_a_task_that_is_not_asked_how_it_is_drawn_is_made_all_the_same(recorder, monkeypatch):
    """Some say how they can be drawn and take no ``render_mode``."""
    monkeypatch.setattr(Recorder, "metadata", {"render_modes": ["rgb_array"]})
    env = make_env(recorder())
    assert env._env.render_mode is None
    assert env.rollout(2).shape == (2,)


def test_a_task_whose_arguments_cannot_be_read_is_asked_for_its_pictures(recorder, monkeypatch):
    """Compiled code has no signature."""
    monkeypatch.setattr(Recorder, "metadata", {"render_modes": ["rgb_array"]})
    monkeypatch.setattr(Recorder, "__signature__", 0, raising=False)
    with pytest.raises(TypeError, match="unexpected object 0 in __signature__"):
        inspect.signature(Recorder)
    begin = Recorder.__init__

    def drawn(self, render_mode=None, **options):
        begin(self, **options)
        self.render_mode = render_mode

    monkeypatch.setattr(Recorder, "__init__", drawn)
    assert make_env(recorder())._env.render_mode == "rgb_array"


def test_an_end_terminates_and_cuts_the_action_repeat_short(recorder):
    env = make_env(get_task(recorder(ends=4), action_repeat=3), seed=0)
    rollout = env.rollout(10)
    assert rollout["next", "reward"].squeeze(-1).tolist() == [1.5, 0.5]
    assert rollout["next", "episode_reward"].squeeze(-1).tolist() == [1.5, 2.0]
    assert env._env.unwrapped.steps == 4
    ends = {name: rollout["next", name].squeeze(-1).tolist() for name in ("terminated", "truncated", "done")}
    assert ends == {"terminated": [False, True], "truncated": [False, False], "done": [False, True]}


def test_the_episode_length_is_the_tasks(recorder):
    rollout = make_env(get_task(recorder(), episode_length=7)).rollout(30)
    assert rollout.shape == (7,)
    assert rollout["next", "truncated"][-1].item()
    assert not rollout["next", "terminated"].any()
    assert make_env(get_task(_PENDULUM, episode_length=300)).rollout(1000).shape == (300,)


@pytest.mark.parametrize("name", [_PENDULUM, _HOPPER])
def test_the_environment_is_torchrls_with_transforms(name):
    transforms = [DoubleToFloat(in_keys=["observation"])] if "Hopper" in name else [ActionScaling()]
    reference = TransformedEnv(GymEnv(name.removeprefix("gym/")), Compose(*transforms, InitTracker(), RewardSum()))
    check_env(reference)
    ours = make_env(name, seed=4)
    reference.set_seed(4)
    states = [ours.reset(), reference.reset()]
    torch.manual_seed(0)
    ended = 0
    for _ in range(250):
        action, steps = torch.rand(ours.action_spec.shape) * 2 - 1, []
        for i, env in enumerate((ours, reference)):
            step, states[i] = env.step_and_maybe_reset(states[i].set("action", action))
            steps.append(step)
        assert set(steps[0].keys(True, True)) == set(steps[1].keys(True, True))
        for key, value in steps[1].items(True, True):
            assert steps[0][key].dtype == value.dtype, key
            torch.testing.assert_close(steps[0][key], value, rtol=0, atol=0, msg=str(key))
        ended += steps[0]["next", "done"].item()
    assert ended >= 1


_REFUSED = {
    "discrete actions": ({"action": Discrete(3)}, r"has discrete actions \(Discrete\); only continuous actions are"),
    "whole numbers": (
        {"action": Box(-3, 3, (2,), np.int64)},
        r"has discrete actions \(dtype int64\); only continuous actions are",
    ),
    "dictionary of actions": (
        {"action": Dict(a=Box(-1, 1, (2,)))},
        r"has actions of type Dict; only one vector of them is supported",
    ),
    "no bounds": ({"action": Box(-np.inf, np.inf, (2,))}, "has actions without finite bounds, so they cannot be"),
    "half-open": ({"action": Box(0, np.inf, (2,))}, "has actions without finite bounds, so they cannot be"),
    "as good as none": (
        {"action": Box(np.finfo(np.float32).min, np.finfo(np.float32).max, (2,))},
        "has actions without finite bounds, so they cannot be",
    ),
    "pixels": (
        {"observation": Box(0, 255, (8, 8, 3), np.uint8)},
        r"has pixel observations \[8, 8, 3\]; only vectors are supported\.",
    ),
    "grey pixels": ({"observation": Box(0, 255, (8, 8), np.uint8)}, r"has pixel observations \[8, 8\]; only vectors"),
    "pixels as numbers": (
        {"observation": Box(0, 1, (8, 8, 3), np.float32)},
        r"has pixel observations \[8, 8, 3\]; only vectors are supported\.",
    ),
    "dictionary": (
        {"observation": Dict(a=Box(0, 1))},
        "has observations of type Dict; only vectors are supported, .*FlattenObservation makes",
    ),
    "discrete": ({"observation": Discrete(4)}, "has observations of type Discrete; only vectors are supported"),
}


@pytest.mark.parametrize("fault", _REFUSED)
def test_what_cannot_become_vectors_is_refused_in_one_line(fault, recorder, monkeypatch):
    options, reason = _REFUSED[fault]
    monkeypatch.setattr(Recorder, "reset", None)  # refused before anything runs
    name = recorder(**{k: v for k, v in options.items() if k == "action"})
    gymnasium.registry[name.removeprefix("gym/")].kwargs = options
    with pytest.raises(ValueError, match=rf"^{name} {reason}") as error:
        make_env(name)
    assert "\n" not in str(error.value)


def test_an_id_that_misses_its_library_says_so_in_one_line(monkeypatch, recorder):
    def needs_more(**kwargs):
        raise gymnasium.error.DependencyNotInstalled("Box2D is not installed,\nyou can install it")

    name = recorder()
    gymnasium.registry[name.removeprefix("gym/")].entry_point = needs_more
    with pytest.raises(ImportError) as error:
        make_env(name)
    assert str(error.value) == (
        f"{name} cannot be made: Box2D is not installed, you can install it (for MuJoCo and classic control run: "
        "pip install 'gymnasium[mujoco,classic-control]>=1.4,<2' 'mujoco<4')."
    )


@needs_mujoco
def test_making_an_environment_prints_and_writes_nothing(capfd, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo's own notices go to a file here
    make_env("gym/HalfCheetah-v5", seed=0).rollout(2)
    assert capfd.readouterr() == ("", "")
    assert not list(tmp_path.iterdir())


@needs_mujoco
def test_making_an_environment_leaves_mujoco_s_warnings_to_whom_they_were():
    mujoco = pytest.importorskip("mujoco")

    def mine(message: str) -> None:
        pass

    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(mine)
    try:
        make_env("gym/Hopper-v5")
        assert mujoco.get_mju_user_warning() is mine
    finally:
        mujoco.set_mju_user_warning(before)


@needs_mujoco
@pytest.mark.parametrize("name", ["Walker2d-v5", "Hopper-v5", "InvertedPendulum-v5", "HalfCheetah-v5", "Ant-v5"])
def test_the_usual_mujoco_tasks_work(name):
    env = make_env(f"gym/{name}", seed=0)
    check_env_specs(env)
    assert env.rollout(30, break_when_any_done=False)["next", "observation"].isfinite().all()
