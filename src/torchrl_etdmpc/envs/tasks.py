"""The benchmark tasks by name: which suite, how long an episode is, how often an action repeats."""

from __future__ import annotations

import difflib
from dataclasses import dataclass

__all__ = ["DMC_TASKS", "EASY_DMC", "HARD_DMC", "Task", "get_task"]


@dataclass(frozen=True)
class Task:
    """A benchmark task and the numbers that fix its protocol.

    Args:
        name: the name by which commands and result tables know the task, e.g. ``"walker-walk"``.
        suite: the library that simulates it, e.g. ``"dm_control"``.
        domain: the suite's name of the body, e.g. ``"walker"``.
        task: the suite's name of the goal, e.g. ``"walk"``.
        action_repeat: env steps per decision, at least 1. One decision's reward is the sum over its env steps.
        episode_length: the suite's own time limit, in env steps, at least 1.

    Raises:
        ValueError: if ``action_repeat`` or ``episode_length`` is below 1.

    Examples:
        >>> from torchrl_etdmpc.envs import Task
        >>> task = Task("swimmer6", "dm_control", "swimmer", "swimmer6", action_repeat=2, episode_length=1000)
        >>> task.decision_steps_per_episode
        500
    """

    name: str
    suite: str
    domain: str
    task: str
    action_repeat: int
    episode_length: int

    def __post_init__(self) -> None:
        for field in ("action_repeat", "episode_length"):
            if getattr(self, field) < 1:
                raise ValueError(f"{field} of task {self.name!r} must be at least 1, got {getattr(self, field)}.")

    @property
    def decision_steps_per_episode(self) -> int:
        """Decisions in a full episode; the last one is shorter if the action repeat does not divide the episode."""
        return -(-self.episode_length // self.action_repeat)


EASY_DMC: tuple[str, ...] = (
    "cup-catch",
    "pendulum-swingup",
    "cartpole-swingup-sparse",
    "finger-spin",
    "hopper-hop",
    "acrobot-swingup",
    "cartpole-swingup",
    "hopper-stand",
    "reacher-hard",
    "cartpole-balance",
    "cartpole-balance-sparse",
    "cheetah-run",
    "finger-turn-easy",
    "finger-turn-hard",
    "fish-swim",
    "quadruped-run",
    "quadruped-walk",
    "reacher-easy",
    "walker-run",
    "walker-stand",
    "walker-walk",
)
"""The 21 tasks of the Easy DMC benchmark, in the order of the result tables."""

HARD_DMC: tuple[str, ...] = (
    "humanoid-run",
    "humanoid-stand",
    "humanoid-walk",
    "dog-trot",
    "dog-walk",
    "dog-run",
    "dog-stand",
)
"""The 7 tasks of the Hard DMC benchmark, in the order of the result tables."""

DMC_TASKS: tuple[str, ...] = EASY_DMC + HARD_DMC
"""All 28 DeepMind Control tasks."""

# The benchmark tables shorten one domain name.
_DMC_DOMAINS = {"cup": "ball_in_cup"}


def _dmc_task(name: str) -> Task:
    domain, _, task = name.partition("-")
    return Task(
        name=name,
        suite="dm_control",
        domain=_DMC_DOMAINS.get(domain, domain),
        task=task.replace("-", "_"),
        action_repeat=2,
        episode_length=1000,
    )


_TASKS = {name: _dmc_task(name) for name in DMC_TASKS}


def get_task(name: str) -> Task:
    """Looks a task up by its name.

    Args:
        name: one of :data:`DMC_TASKS`.

    Returns:
        The task's entry.

    Raises:
        ValueError: if no task has this name; the message holds the nearest names.

    Examples:
        >>> from torchrl_etdmpc.envs import get_task
        >>> task = get_task("cup-catch")
        >>> task.domain, task.task, task.action_repeat, task.decision_steps_per_episode
        ('ball_in_cup', 'catch', 2, 500)
        >>> get_task("cartpole-balance-sparse").task
        'balance_sparse'
    """
    if name in _TASKS:
        return _TASKS[name]
    nearest = difflib.get_close_matches(str(name), _TASKS, n=3)
    hint = f"did you mean {', '.join(nearest)}? " if nearest else ""
    raise ValueError(f"unknown task {name!r}; {hint}All names: torchrl_etdmpc.envs.DMC_TASKS.")
