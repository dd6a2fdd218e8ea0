from __future__ import annotations

import dataclasses
import importlib.util
import sys
from functools import partial

import pytest

from torchrl_etdmpc.envs import DMC_TASKS, EASY_DMC, HARD_DMC, Task, get_task, register_task
from torchrl_etdmpc.envs.tasks import registered_maker


def test_the_sets_have_the_sizes_of_the_benchmarks_and_do_not_overlap():
    assert (len(EASY_DMC), len(HARD_DMC)) == (21, 7)
    assert DMC_TASKS == EASY_DMC + HARD_DMC
    assert len(set(DMC_TASKS)) == 28


@pytest.mark.parametrize("name", DMC_TASKS)
def test_every_name_resolves_to_the_dmc_protocol(name):
    task = get_task(name)
    assert (task.name, task.suite, task.terminates, task.observation) == (name, "dm_control", False, "vector")
    assert (task.action_repeat, task.episode_length, task.decision_steps_per_episode) == (2, 1000, 500)


def test_an_unknown_name_is_answered_with_the_nearest_names_in_one_line():
    with pytest.raises(ValueError) as error:
        get_task("walker-stnad")
    assert str(error.value) == (
        "unknown task 'walker-stnad'; did you mean walker-stand, walker-run, walker-walk? "
        "task=list on the command line lists all."
    )


def test_a_name_that_is_near_to_nothing_gets_no_suggestion():
    with pytest.raises(ValueError, match=r"^unknown task 'zzzz'; task=list on the command line lists all\.$"):
        get_task("zzzz")


def test_a_task_cannot_be_changed():
    with pytest.raises(dataclasses.FrozenInstanceError):
        get_task("walker-walk").action_repeat = 4


def test_the_last_decision_may_be_shorter_than_the_action_repeat():
    assert Task("x", "dm_control", action_repeat=3, episode_length=10).decision_steps_per_episode == 4


@pytest.mark.parametrize("field", ["action_repeat", "episode_length"])
def test_a_task_without_steps_is_refused(field):
    with pytest.raises(ValueError, match=rf"^{field} of task 'walker-walk' must be at least 1, got 0\.$"):
        dataclasses.replace(get_task("walker-walk"), **{field: 0})


@pytest.mark.parametrize(
    ("told", "expected"),
    [
        ({}, (2, 1000, False)),
        ({"action_repeat": 4}, (4, 1000, False)),
        ({"episode_length": 50}, (2, 50, False)),
        ({"terminates": True}, (2, 1000, True)),
    ],
)
def test_what_is_told_replaces_the_tasks_own_numbers(told, expected):
    task = get_task("walker-walk", **told)
    assert (task.action_repeat, task.episode_length, task.terminates) == expected
    assert get_task("walker-walk") == get_task("walker-walk", action_repeat=2)  # nothing was remembered


def test_a_told_number_is_checked():
    with pytest.raises(ValueError, match=r"^action_repeat of task 'walker-walk' must be at least 1, got 0\.$"):
        get_task("walker-walk", action_repeat=0)


def test_a_registered_task_is_known_by_its_name():
    task = Task("registered-here", "mine", episode_length=7)
    register_task(task)
    assert get_task("registered-here") == task
    assert get_task("registered-here", episode_length=3).episode_length == 3
    with pytest.raises(ValueError, match="did you mean registered-here"):
        get_task("registered-her")


def test_registering_the_same_task_again_is_fine_and_another_one_is_an_error():
    make, other = partial(print), partial(print)
    task = Task("registered-twice", "mine", episode_length=7)
    register_task(task, make)
    register_task(task, make)
    for again in ((dataclasses.replace(task, episode_length=8), make), (task, other), (task, None)):
        with pytest.raises(ValueError, match=r"^task 'registered-twice' is registered already, as something else"):
            register_task(*again)
    register_task(dataclasses.replace(task, episode_length=8), make, replace=True)
    assert get_task("registered-twice").episode_length == 8


def test_a_task_that_replaces_another_has_its_own_maker_or_none():
    task = Task("registered-anew", "mine", episode_length=7)
    register_task(task, print)
    register_task(task, replace=True)
    assert registered_maker(task) is None


def test_a_benchmark_task_cannot_be_registered_as_something_else():
    with pytest.raises(ValueError, match="^task 'walker-walk' is registered already"):
        register_task(get_task("walker-walk", action_repeat=1))


def test_a_path_to_code_is_not_followed(tmp_path, monkeypatch):
    (tmp_path / "has_side_effect.py").write_text("raise SystemExit('imported')\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError) as error:
        get_task("has_side_effect:make")
    assert str(error.value) == (
        "task 'has_side_effect:make' names code, which must be given on the command line: task=has_side_effect:make, "
        "or code=has_side_effect:make of a suite. In Python, call "
        "torchrl_etdmpc.envs.import_task('has_side_effect:make') before."
    )
    for name in ("gym/has_side_effect:Pendulum-v1", "has_side_effect"):  # gymnasium.make would import the module
        with pytest.raises(ValueError, match=r"^unknown task"):
            get_task(name)
    with pytest.raises(ValueError, match=r"a module of yours .*, with NAME = get_task\('gym/Pendulum-v1'\) in it\.$"):
        get_task("gym/has_side_effect:Pendulum-v1")
    assert "has_side_effect" not in sys.modules


@pytest.mark.parametrize(
    ("name", "length", "terminates"),
    [
        ("Pendulum-v1", 200, False),
        ("MountainCarContinuous-v0", 999, True),
        ("InvertedPendulum-v5", 1000, True),
        ("Hopper-v5", 1000, True),
        ("HalfCheetah-v5", 1000, False),
        ("HalfCheetah-v4", 1000, False),
        ("Reacher-v5", 50, False),
        ("Pusher-v5", 100, False),
        ("Swimmer-v5", 1000, False),
        ("HumanoidStandup-v5", 1000, False),
        ("Humanoid-v5", 1000, True),
    ],
)
def test_a_gymnasium_id_brings_its_time_limit_and_whether_it_terminates(name, length, terminates):
    pytest.importorskip("gymnasium")
    task = get_task(f"gym/{name}")
    assert task == Task(f"gym/{name}", "gymnasium", action_repeat=1, episode_length=length, terminates=terminates)
    assert get_task(f"gym/{name}", action_repeat=4, terminates=not terminates) == dataclasses.replace(
        task, action_repeat=4, terminates=not terminates
    )


def test_a_gymnasium_id_without_a_time_limit_asks_for_one():
    pytest.importorskip("gymnasium")
    with pytest.raises(ValueError) as error:
        get_task("gym/CliffWalking-v1")
    assert str(error.value) == (
        "Gymnasium sets no time limit for CliffWalking-v1; give one in env steps: task.episode_length="
    )
    assert get_task("gym/CliffWalking-v1", episode_length=30).episode_length == 30


def test_gymnasium_s_own_word_for_no_limit_asks_for_one_too(monkeypatch):
    registration = pytest.importorskip("gymnasium").envs.registration
    endless = dataclasses.replace(registration.registry["Pendulum-v1"], id="Endless-v0", max_episode_steps=-1)
    monkeypatch.setitem(registration.registry, "Endless-v0", endless)
    with pytest.raises(ValueError, match="^Gymnasium sets no time limit for Endless-v0; give one in env steps"):
        get_task("gym/Endless-v0")
    assert get_task("gym/Endless-v0", episode_length=30).episode_length == 30


def test_an_unknown_gymnasium_id_is_answered_with_the_nearest_ids():
    pytest.importorskip("gymnasium")
    with pytest.raises(ValueError, match=r"^unknown task 'gym/Pendulum-v7'; did you mean gym/Pendulum-v1"):
        get_task("gym/Pendulum-v7")


def test_a_missing_gymnasium_is_one_line_that_says_what_to_install(monkeypatch):
    find_spec = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *rest: None if name == "gymnasium" else find_spec(name, *rest)
    )
    with pytest.raises(ImportError) as error:
        get_task("gym/Pendulum-v1")
    assert str(error.value) == (
        "task 'gym/Pendulum-v1' needs gymnasium, which is missing; run: "
        "pip install 'gymnasium[mujoco,classic-control]>=1.4,<2' 'mujoco<4'"
    )
    assert get_task("walker-walk").suite == "dm_control"
