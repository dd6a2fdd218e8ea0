from __future__ import annotations

import sys
from pathlib import Path

import pytest
import torch
from torchrl.envs import StepCounter, TransformedEnv
from torchrl.envs.transforms import VecNormV2

pytest.importorskip("gymnasium")

from torchrl_etdmpc.envs import check_env, get_task, import_task, make_env, simulator_state  # noqa: E402

_RECIPE = """
from torchrl.envs import ActionScaling, GymEnv, TransformedEnv

def make_my_env():
    return TransformedEnv(GymEnv("Pendulum-v1"), ActionScaling())
"""

_MORE = """
import gymnasium
from gymnasium.envs.classic_control.pendulum import PendulumEnv
from torchrl.envs import ActionScaling, FrameSkipTransform, GymEnv, GymWrapper, SerialEnv, StepCounter, TransformedEnv
from torchrl.envs import CatFrames, Compose, ObservationNorm, RewardScaling, RewardSum, Transform
from torchrl.envs.transforms import VecNormV2
from torchrl_etdmpc.envs import Task, make_env, register_task

def scaled(*transforms, base=None, **options):
    env = TransformedEnv(base or GymEnv("Pendulum-v1", **options), ActionScaling())
    for transform in transforms:
        env = env.append_transform(transform)
    return env

def normed(): return scaled(VecNormV2(in_keys=["observation"]), StepCounter(30))
def measured():
    env = normed()
    env.rollout(3)
    env.transform[-2].freeze()
    return env
def frozen():
    env = normed()
    env.transform[-2].set_extra_state(STATISTICS)
    env.transform[-2].freeze()
    return env
def standardised():
    env = scaled(ObservationNorm(in_keys=["observation"]), StepCounter(30))
    env.transform[1].init_stats(5)
    return env
def stacked():
    env = scaled(CatFrames(2, dim=-1, in_keys=["observation"]), StepCounter(30))
    env.rollout(3)  # which leaves other frames in every copy
    return env
def standardised_by_constants(): return scaled(ObservationNorm(1.0, 2.0, in_keys=["observation"]), StepCounter(30))
def normed_by_gymnasium():
    return scaled(base=GymWrapper(gymnasium.wrappers.NormalizeReward(gymnasium.make("Pendulum-v1"))))
def frozen_by_gymnasium():
    env = normed_by_gymnasium()
    env.base_env._env.update_running_mean = False
    return env
def of_a_suite(): return TransformedEnv(make_env("gym/Pendulum-v1"), RewardScaling(0, 0.1))
class Paid(Transform):
    def _apply_transform(self, observation): return observation[..., :1]
def paid(): return TransformedEnv(make_env("gym/Pendulum-v1"), Paid(in_keys=["observation"], out_keys=["reward"]))
def sums_what_it_scales():
    return TransformedEnv(make_env("gym/Pendulum-v1"), Compose(RewardSum(), RewardScaling(0, 0.1)))
def limited(): return scaled(StepCounter(30))
def only_told(): return scaled(StepCounter(30, update_done=False), base=GymWrapper(PendulumEnv()))
def counted(): return scaled(StepCounter(), base=GymWrapper(PendulumEnv()))
def unlimited(): return scaled(base=GymWrapper(PendulumEnv()))
def repeats(): return scaled(frame_skip=4)
def repeats_by_transform():
    env = TransformedEnv(GymEnv("Pendulum-v1"), FrameSkipTransform(4))
    env.append_transform(ActionScaling())
    return env.append_transform(StepCounter(10))
def repeats_over_the_limit(): return TransformedEnv(GymEnv("Pendulum-v1"), FrameSkipTransform(7))
def repeats_what_is_scaled(): return scaled(FrameSkipTransform(4), StepCounter(10))
def wrapped(*wrappers):
    env = PendulumEnv()
    for kind, number in wrappers:
        env = getattr(gymnasium.wrappers, kind)(env, number)
    return scaled(base=GymWrapper(env))
def limited_by_its_spec():
    env = PendulumEnv()
    env.spec = gymnasium.spec("InAFile-v0")  # which nothing obeys
    return scaled(base=GymWrapper(env))
def limited_by_wrapper(): return wrapped(("TimeLimit", 12))
def repeats_by_wrapper(): return wrapped(("TimeLimit", 12), ("RepeatAction", 3))
def repeats_and_takes_the_maximum(): return wrapped(("TimeLimit", 12), ("MaxAndSkipObservation", 3))
def repeats_and_is_limited(): return wrapped(("RepeatAction", 3), ("TimeLimit", 5))
ONE = scaled()
def the_same(): return ONE
def unscaled(): return GymEnv("Pendulum-v1")
def not_wrapped(): return PendulumEnv()
def number(): return 3
def two(): return SerialEnv(2, limited)
VALUE = 3

def maker(task, *, device):
    assert task.name == "registered-in-a-file"
    return scaled(StepCounter(task.decision_steps_per_episode), frame_skip=task.action_repeat)

_OF = normed()
_OF.rollout(3)
STATISTICS = _OF.transform[-2].get_extra_state()

REGISTERED = Task("registered-in-a-file", "mine", episode_length=12, terminates=False)
register_task(REGISTERED, maker, replace=True)  # the tests import this file again and again
gymnasium.register("InAFile-v0", PendulumEnv, max_episode_steps=20)
OF_A_SUITE = Task("gym/InAFile-v0", "gymnasium", episode_length=20, terminates=False)
OF_NOBODY = Task("nobodys", "nobody", episode_length=20)
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A user's directory, in which commands run; what they import is forgotten."""
    (tmp_path / "my_file.py").write_text(_RECIPE)
    (tmp_path / "more_tasks.py").write_text(_MORE)
    (tmp_path / "misses_one.py").write_text("import not_there\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", sys.path[:])
    yield tmp_path
    if "more_tasks" in sys.modules:
        del sys.modules["more_tasks"].gymnasium.registry["InAFile-v0"]
    for name in ("my_file", "more_tasks", "misses_one", "raises"):
        sys.modules.pop(name, None)


def test_a_function_that_changes_the_directory_does_so_for_its_environments_alone(folder):
    (folder / "my_file.py").write_text(_RECIPE.replace("    return", "    os.chdir('/')\n    return") + "import os\n")
    import_task("my_file:make_my_env")
    assert Path.cwd() == folder
    make_env("my_file:make_my_env")
    assert Path.cwd() == Path("/")


def test_a_new_task_is_one_file_and_its_path(folder):
    task = import_task("my_file:make_my_env")  # task=my_file:make_my_env on the command line
    assert (task.name, task.action_repeat, task.episode_length, task.terminates) == (
        "my_file:make_my_env",
        1,
        200,
        True,
    )
    env = make_env(task, seed=0)
    check_env(env)
    rollout = env.rollout(300)
    assert rollout.shape == (200,)
    torch.testing.assert_close(rollout["next", "episode_reward"][-1], rollout["next", "reward"].sum(0))


def test_a_task_that_was_imported_is_known_by_its_path(folder):
    (folder / "known_later.py").write_text(_RECIPE)
    with pytest.raises(ValueError, match="^task 'known_later:make_my_env' names code, which must be given on the comm"):
        get_task("known_later:make_my_env")
    task = import_task("known_later:make_my_env", episode_length=50)
    assert get_task("known_later:make_my_env") == task
    assert import_task("known_later:make_my_env").episode_length == 200  # once more, told otherwise


@pytest.mark.parametrize(
    ("path", "parallel"),
    [
        ("my_file:make_my_env", False),
        pytest.param("my_file:make_my_env", True, marks=pytest.mark.slow),
        ("more_tasks:REGISTERED", False),
        ("more_tasks:OF_A_SUITE", False),
        ("more_tasks:OF_A_SUITE", True),  # the workers have not registered its id
    ],
)
def test_several_environments_of_a_users_task(folder, path, parallel):
    env = make_env(import_task(path), seed=0, num_envs=2, parallel=parallel)
    assert env.rollout(5).shape == (2, 5)
    env.close()


@pytest.mark.parametrize(
    ("name", "repeat", "length"),
    [
        ("limited", 1, 30),
        ("limited_by_wrapper", 1, 12),
        ("limited_by_its_spec", 1, 20),
        ("repeats", 4, 200),
        ("repeats_by_transform", 4, 40),
        ("repeats_by_wrapper", 3, 12),
        ("repeats_and_takes_the_maximum", 3, 12),
        ("repeats_and_is_limited", 3, 15),
    ],
)
def test_what_an_environment_shows_is_read(folder, name, repeat, length):
    task = import_task(f"more_tasks:{name}", terminates=False)
    assert (task.action_repeat, task.episode_length) == (repeat, length)
    assert make_env(task).rollout(1000).shape == (task.decision_steps_per_episode,)


def test_the_time_limit_of_dm_control_is_read(folder):
    pytest.importorskip("dm_control")
    (folder / "of_dm_control.py").write_text(
        "from torchrl.envs import CatTensors, DMControlEnv, DoubleToFloat, TransformedEnv\n"
        "def make():\n"
        "    env = TransformedEnv(DMControlEnv('cartpole', 'balance', frame_skip=20), DoubleToFloat())\n"
        "    return env.append_transform(CatTensors(['position', 'velocity'], 'observation'))\n"
    )
    task = import_task("of_dm_control:make", terminates=False)
    assert (task.action_repeat, task.episode_length) == (20, 1000)
    rollout = make_env(task).rollout(1000)
    assert rollout.shape == (50,)
    assert rollout["next", "truncated"][-1].item()
    with pytest.raises(ValueError, match="must be at most 1000, its environment's own limit, got 2000"):
        import_task("of_dm_control:make", episode_length=2000)


def test_a_repeat_that_steps_over_the_time_limit_is_refused(folder):
    with pytest.raises(ValueError, match="repeats actions 7 times with FrameSkipTransform, .* limit of 200 env steps"):
        import_task("more_tasks:repeats_over_the_limit", terminates=False)


def test_a_repeat_that_steps_on_after_an_episode_has_ended_is_refused(folder):
    with pytest.raises(ValueError) as error:
        import_task("more_tasks:repeats_by_transform")
    assert str(error.value) == (
        "task 'more_tasks:repeats_by_transform' repeats actions with FrameSkipTransform, which steps on where an "
        "episode has ended; repeat them with frame_skip= of GymEnv or DMControlEnv, or in a step of your own, or say "
        "that only the time limit ends its episodes: task.terminates=false."
    )


def test_a_repeat_of_actions_that_are_scaled_already_is_refused(folder):
    with pytest.raises(
        ValueError, match=r"action is changed once .* \(append FrameSkipTransform before ActionScaling\)"
    ):
        make_env(import_task("more_tasks:repeats_what_is_scaled", terminates=False))
    env = make_env(import_task("more_tasks:repeats_by_transform", terminates=False), seed=0)
    simulator, arrived = env.base_env._env.unwrapped, []
    step = simulator.step
    simulator.step = lambda action: arrived.append(action.item()) or step(action)
    env.step(env.reset().set("action", torch.tensor([0.5])))
    assert arrived == [1.0] * 4  # of [-2, 2]


@pytest.mark.parametrize("name", ["unlimited", "counted", "only_told"])
def test_a_time_limit_that_is_told_ends_episodes(folder, name):
    with pytest.raises(ValueError) as error:
        import_task(f"more_tasks:{name}")
    assert str(error.value) == (
        f"task 'more_tasks:{name}' shows no time limit; give one in env steps: task.episode_length="
    )
    rollout = make_env(import_task(f"more_tasks:{name}", episode_length=11, terminates=False)).rollout(100)
    assert rollout.shape == (11,)
    assert rollout["next", "truncated"][-1].item()
    assert not get_task(f"more_tasks:{name}").terminates


def test_a_shorter_time_limit_is_obeyed_and_a_longer_one_refused(folder):
    assert make_env(import_task("more_tasks:repeats", episode_length=10)).rollout(100).shape == (3,)
    with pytest.raises(ValueError) as error:
        import_task("more_tasks:limited", episode_length=31)
    assert str(error.value) == (
        "episode_length of task 'more_tasks:limited' must be at most 30, its environment's own limit, got 31."
    )


@pytest.mark.parametrize("told", [{"episode_length": 31}, {"action_repeat": 2}])
def test_what_is_told_after_the_import_is_held_against_the_environment_too(folder, told):
    import_task("more_tasks:limited")
    with pytest.raises(ValueError, match=f"^{next(iter(told))} of task 'more_tasks:limited' must be "):
        make_env(get_task("more_tasks:limited", **told))


def test_the_environment_that_an_import_looks_at_is_closed(folder):
    (folder / "raises.py").write_text(f"{_RECIPE}made = []\ndef make(): made.append(make_my_env()); return made[-1]\n")
    import_task("raises:make")
    assert [env.is_closed for env in sys.modules["raises"].made] == [True]


def test_an_action_repeat_that_is_not_there_is_refused(folder):
    assert import_task("more_tasks:repeats", action_repeat=4).action_repeat == 4
    with pytest.raises(ValueError, match=r"^action_repeat of task 'more_tasks:limited' must be 1, .*, got 2; repeat"):
        import_task("more_tasks:limited", action_repeat=2)


def test_a_task_of_a_file_keeps_its_numbers_and_maker(folder):
    task = import_task("more_tasks:REGISTERED", action_repeat=3)
    assert (task.name, task.suite, task.episode_length) == ("more_tasks:REGISTERED", "mine", 12)
    assert make_env(task).rollout(100).shape == (4,)
    of_a_suite = make_env(import_task("more_tasks:OF_A_SUITE"), seed=0)
    assert of_a_suite.rollout(100).shape == (20,)
    assert simulator_state(of_a_suite) is not None


def test_an_id_of_ones_own_is_a_task_behind_the_code_that_registers_it(folder):
    gymnasium = pytest.importorskip("gymnasium")
    (folder / "registers.py").write_text(
        "import gymnasium\n"
        "from gymnasium.envs.classic_control import PendulumEnv\n"
        "from torchrl_etdmpc.envs import get_task\n"
        "gymnasium.register('OfOnesOwn-v0', entry_point=PendulumEnv, max_episode_steps=30)\n"
        "mine = get_task('gym/OfOnesOwn-v0', terminates=False)\n"
    )
    try:
        task = import_task("registers:mine")
        assert (task.name, task.episode_length, task.terminates) == ("registers:mine", 30, False)
        env = make_env(task, seed=0)
        check_env(env)  # actions within -1 and 1 among others, as with every task of Gymnasium
        assert env.rollout(100).shape == (30,)
    finally:
        gymnasium.registry.pop("OfOnesOwn-v0", None)


@pytest.mark.parametrize(
    ("path", "message"),
    [
        ("my_file", r"task 'my_file' must read package\.module:attribute\."),
        (":make", r"task ':make' must read package\.module:attribute\."),
        ("my_file:", r"task 'my_file:' must read package\.module:attribute\."),
        ("no_file:make", r"task 'no_file:make': there is no module 'no_file' on Python's path or in .*"),
        (
            "no.such.file:make",
            r"task 'no\.such\.file:make': there is no module 'no\.such\.file' on Python's path or .*",
        ),
        ("my_file.py:make", r"task 'my_file\.py:make': there is no module 'my_file\.py' .*; write my_file:make\."),
        (
            "gym/my_file:Cart-v0",
            r"task 'gym/my_file:Cart-v0' is no path to a task\. An id that your own code registers is named by a "
            r"module of yours that imports this code: task=MODULE:NAME, with NAME = get_task\('gym/Cart-v0'\) in it\.",
        ),
        ("my_file:other", r"task 'my_file:other': the module 'my_file' \(.*my_file\.py\) has no 'other'\."),
        ("more_tasks:VALUE", r"task 'more_tasks:VALUE' must be a function or a Task, got int\."),
        ("more_tasks:number", r"task 'more_tasks:number' must return a TorchRL environment, got int\."),
        (
            "more_tasks:not_wrapped",
            r"task 'more_tasks:not_wrapped' must return a TorchRL environment, got PendulumEnv; return "
            r"GymWrapper\(env\), of torchrl\.envs\.",
        ),
        ("more_tasks:two", r"task 'more_tasks:two' must return one environment, got \[2\] of them; use num_envs=\."),
        ("more_tasks:OF_NOBODY", r"nothing makes the suite 'nobody' of task 'nobodys'; .*"),
    ],
)
def test_a_path_that_leads_nowhere_is_refused_in_one_line(folder, path, message):
    with pytest.raises(ValueError, match=f"^{message}$"):
        import_task(path)


@pytest.mark.parametrize(
    ("path", "cause", "what"),
    [
        ("misses_one:make", ModuleNotFoundError, "No module named 'not_there' (misses_one.py, line 1)"),
        ("leaves:make", SystemExit, "0 (leaves.py, line 2)"),
        ("no_python:make", SyntaxError, "'(' was never closed (no_python.py, line 1)"),
        ("raises:divides", ZeroDivisionError, "division by zero (raises.py, line 1)"),
        ("raises:looks_up", KeyError, "'nothing' (raises.py, line 5)"),
        ("raises:asks", TypeError, "asks() missing 1 required positional argument: 'size'"),
    ],
)
def test_what_the_users_code_raises_is_named_with_its_line(folder, path, cause, what):
    (folder / "leaves.py").write_text("import sys\nsys.exit(0)\n")
    (folder / "no_python.py").write_text("make = (\n")
    functions = ("def divides(): return 1 / 0", "def asks(size): return None", "def looks_up():", "    def inner():")
    (folder / "raises.py").write_text("\n".join([*functions, "        return {}['nothing']", "    return inner()"]))
    with pytest.raises(ValueError) as caught:
        import_task(path)
    assert str(caught.value) == f"task {path!r}: {cause.__name__}: {what}"
    assert type(caught.value.__cause__) is cause


def test_an_environment_that_is_returned_twice_is_refused(folder):
    task = import_task("more_tasks:the_same")  # looks at one
    for options in ({}, {"num_envs": 2, "parallel": False}):
        with pytest.raises(ValueError) as error:
            make_env(task, **options).reset()
        assert str(error.value) == (
            "task 'more_tasks:the_same' must return a new environment every time, got one that it had returned before: "
            "training and evaluation would step the same."
        )


def test_what_a_users_environment_lacks_is_named(folder):
    with pytest.raises(ValueError, match=r"^task 'more_tasks:unscaled': .* \(append ActionScaling\(\)\)\.$"):
        make_env(import_task("more_tasks:unscaled"))


def test_a_users_environment_cannot_be_brought_back(folder):
    for options in ({}, {"num_envs": 2, "parallel": False}):
        env = make_env(import_task("my_file:make_my_env"), seed=0, **options)
        env.rollout(3)
        assert simulator_state(env) is None


def test_statistics_that_move_in_every_copy_are_refused_unless_they_are_frozen(folder):
    with pytest.raises(
        ValueError, match=r"^task 'more_tasks:normed': VecNormV2 has .* model\.normalize_observations=true"
    ):
        make_env(import_task("more_tasks:normed"), num_envs=2, parallel=False)
    with pytest.raises(
        ValueError, match="NormalizeReward has statistics that move, .*; set update_running_mean = False"
    ):
        make_env(import_task("more_tasks:normed_by_gymnasium"))
    make_env(import_task("more_tasks:frozen_by_gymnasium"))
    env = make_env(import_task("more_tasks:frozen"))
    assert any(isinstance(transform, VecNormV2) for transform in env.transform)


@pytest.mark.parametrize(("name", "factor"), [("of_a_suite", 1), ("paid", 1), ("sums_what_it_scales", 10)])
@pytest.mark.parametrize("num_envs", [1, 2])
def test_the_episode_s_reward_is_the_sum_of_rewards_that_a_transform_has_changed(folder, num_envs, name, factor):
    """Unless a transform of the user's own sums others."""
    task = import_task(f"more_tasks:{name}", terminates=False, episode_length=5)
    env = make_env(task, seed=0, num_envs=num_envs, parallel=False)
    rollout = env.rollout(12, break_when_any_done=False).reshape(num_envs, 12)
    reward, total = (rollout["next", key].squeeze(-1) for key in ("reward", "episode_reward"))
    for begin in (0, 5, 10):
        expected = factor * reward[:, begin : begin + 5].cumsum(1)
        torch.testing.assert_close(total[:, begin : begin + 5], expected)


@pytest.mark.parametrize(("name", "transform"), [("measured", "VecNormV2"), ("standardised", "ObservationNorm")])
@pytest.mark.parametrize("num_envs", [1, 2])
def test_statistics_that_every_copy_measures_for_itself_are_refused(folder, name, transform, num_envs):
    task = import_task(f"more_tasks:{name}")
    with pytest.raises(ValueError) as error:
        make_env(task, num_envs=num_envs, parallel=False).reset()
    assert str(error.value) == (
        f"task 'more_tasks:{name}': {transform} has other numbers in every environment that is made, so training and "
        "evaluation would see different ones; give it fixed numbers, or leave it out and set "
        "model.normalize_observations=true, whose statistics are the agent's."
    )
    for name in ("standardised_by_constants", "stacked"):
        make_env(import_task(f"more_tasks:{name}"), num_envs=num_envs, parallel=False).reset()


def test_a_users_own_transforms_stay(folder):
    env = make_env(import_task("more_tasks:limited"))
    assert isinstance(env, TransformedEnv)
    assert any(isinstance(transform, StepCounter) for transform in env.transform)
    assert "step_count" in env.reset()
