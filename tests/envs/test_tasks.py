from __future__ import annotations

import dataclasses

import pytest

from torchrl_etdmpc.envs import DMC_TASKS, EASY_DMC, HARD_DMC, Task, get_task


def test_the_sets_have_the_sizes_of_the_benchmarks_and_do_not_overlap():
    assert (len(EASY_DMC), len(HARD_DMC)) == (21, 7)
    assert DMC_TASKS == EASY_DMC + HARD_DMC
    assert len(set(DMC_TASKS)) == 28


@pytest.mark.parametrize("name", DMC_TASKS)
def test_every_name_resolves_to_the_dmc_protocol(name):
    task = get_task(name)
    assert (task.name, task.suite) == (name, "dm_control")
    assert (task.action_repeat, task.episode_length, task.decision_steps_per_episode) == (2, 1000, 500)


@pytest.mark.parametrize(
    ("name", "domain", "task"),
    [
        ("cup-catch", "ball_in_cup", "catch"),
        ("cartpole-balance-sparse", "cartpole", "balance_sparse"),
        ("cartpole-swingup-sparse", "cartpole", "swingup_sparse"),
        ("finger-turn-easy", "finger", "turn_easy"),
        ("dog-trot", "dog", "trot"),
    ],
)
def test_names_map_to_the_suites_own_names(name, domain, task):
    assert (get_task(name).domain, get_task(name).task) == (domain, task)


def test_an_unknown_name_is_answered_with_the_nearest_names_in_one_line():
    with pytest.raises(ValueError) as error:
        get_task("walker-stnad")
    assert str(error.value) == (
        "unknown task 'walker-stnad'; did you mean walker-stand, walker-run, walker-walk? "
        "All names: torchrl_etdmpc.envs.DMC_TASKS."
    )


def test_a_name_that_is_near_to_nothing_gets_no_suggestion():
    with pytest.raises(ValueError, match=r"^unknown task 'zzzz'; All names: torchrl_etdmpc\.envs\.DMC_TASKS\.$"):
        get_task("zzzz")


def test_a_task_cannot_be_changed():
    with pytest.raises(dataclasses.FrozenInstanceError):
        get_task("walker-walk").action_repeat = 4


def test_the_last_decision_may_be_shorter_than_the_action_repeat():
    assert Task("x", "dm_control", "walker", "walk", action_repeat=3, episode_length=10).decision_steps_per_episode == 4


@pytest.mark.parametrize("field", ["action_repeat", "episode_length"])
def test_a_task_without_steps_is_refused(field):
    with pytest.raises(ValueError, match=rf"^{field} of task 'walker-walk' must be at least 1, got 0\.$"):
        dataclasses.replace(get_task("walker-walk"), **{field: 0})
