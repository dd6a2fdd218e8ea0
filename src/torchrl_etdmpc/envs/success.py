"""From which return on an episode is a success, where a task's authors say so."""

from __future__ import annotations

from torchrl_etdmpc.envs.gymnasium import gymnasium_success_return
from torchrl_etdmpc.envs.humanoid_bench import humanoid_bench_success_return
from torchrl_etdmpc.envs.tasks import Task, registered_maker, suite_task

_SUITES = {"gymnasium": gymnasium_success_return, "humanoid_bench": humanoid_bench_success_return}


def success_return(task: Task) -> float | None:
    """The undiscounted return from which on an episode is a success, by the task's own definition.

    HumanoidBench gives each task a bar (``success_bar``), Gymnasium some of its own (``reward_threshold``), dm_control
    none. With another episode length than the task's own, other returns are to be had, and there is none either.

    Args:
        task (Task): as :func:`~torchrl_etdmpc.envs.get_task` returns it.

    Returns:
        float, optional: the return; ``None`` if the task defines no success.

    Raises:
        ImportError: if the task's suite is missing.

    >>> from torchrl_etdmpc.envs import get_task, success_return
    >>> success_return(get_task("gym/InvertedPendulum-v5"))
    950.0
    """
    look_up = None if registered_maker(task) else _SUITES.get(task.suite)
    if look_up is None:
        return None
    try:
        own = suite_task(task.name).episode_length  # whatever the program has registered
    except ValueError:  # it has no limit of its own, or another name
        return None
    if task.episode_length != own:
        return None
    return look_up(task)
