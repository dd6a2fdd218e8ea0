"""Tasks by name: which suite, how long an episode is, how often an action repeats, whether episodes end early."""

from __future__ import annotations

import dataclasses
import difflib
import importlib.util
import textwrap
from collections.abc import Iterable
from dataclasses import KW_ONLY, dataclass
from typing import Any, Literal, Protocol

import torch
from torchrl.envs import EnvBase


@dataclass(frozen=True)
class Task:
    """A task and the numbers that fix its protocol.

    Args:
        name (str): the name by which commands and result tables know the task, e.g. ``"walker-walk"``.
        suite (str): the library that simulates it, e.g. ``"dm_control"`` or ``"gymnasium"``; any word for a task with a
            maker of its own.
        action_repeat (int): env steps per decision, at least 1. One decision's reward is the sum over its env steps.
        episode_length (int): the time limit, in env steps, at least 1.
        terminates (bool): whether an episode can end for another reason than the time limit. The world model then
            learns to predict it.
        observation (str): what an observation is. Only vectors are supported now.

    Raises:
        ValueError: if ``action_repeat`` or ``episode_length`` is below 1.

    >>> task = Task("swimmer-swimmer6", "dm_control", action_repeat=2, episode_length=1000, terminates=False)
    >>> task.decision_steps_per_episode
    500
    """

    name: str
    suite: str
    _: KW_ONLY
    action_repeat: int = 1
    episode_length: int
    terminates: bool = True
    observation: Literal["vector", "pixels", "dictionary"] = "vector"

    def __post_init__(self) -> None:
        for field in ("action_repeat", "episode_length"):
            if getattr(self, field) < 1:
                raise ValueError(f"{field} of task {self.name!r} must be at least 1, got {getattr(self, field)}.")
        if self.action_repeat > self.episode_length:
            raise ValueError(
                f"action_repeat of task {self.name!r} must be at most episode_length={self.episode_length}, got "
                f"{self.action_repeat}."
            )

    @property
    def decision_steps_per_episode(self) -> int:
        """Decisions in a full episode; the last one is shorter if the action repeat does not divide the episode."""
        return -(-self.episode_length // self.action_repeat)


class Maker(Protocol):
    """Makes one environment of a task, batch size []."""

    def __call__(self, task: Task, *, device: torch.device | str) -> EnvBase: ...


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

HUMANOIDBENCH_HARD: tuple[str, ...] = (
    "h1hand-walk",
    "h1hand-stand",
    "h1hand-run",
    "h1hand-crawl",
    "h1hand-hurdle",
    "h1hand-maze",
    "h1hand-sit-simple",
    "h1hand-sit-hard",
    "h1hand-slide",
    "h1hand-stair",
    "h1hand-pole",
    "h1hand-balance-simple",
    "h1hand-reach",
)
"""The 13 tasks of HumanoidBench-Hard, in the order of the thesis' Table C.5."""

# What HumanoidBench registers: every goal for every robot. An episode has 500 steps where it says so, otherwise 1,000.
_HUMANOID_ROBOTS = ("h1", "h1hand", "h1simplehand", "h1strong", "h1touch", "g1")
_HUMANOID_GOALS = (
    *("stand", "walk", "run", "kitchen", "maze", "hurdle", "cube", "bookshelf-simple", "bookshelf-hard"),
    *("highbar-simple", "highbar-hard", "crawl", "window", "spoon", "door", "push", "reach", "basketball", "truck"),
    *("package", "cabinet", "sit-simple", "sit-hard", "balance-simple", "balance-hard", "stair", "slide", "pole"),
    *("room", "insert-normal", "insert-small", "powerlift"),
)
_HUMANOID_SHORT = {"kitchen", "cube", "push", "basketball", "insert-normal", "insert-small"}

INSTALL_GYMNASIUM = "pip install 'gymnasium[mujoco,classic-control]>=1.4,<2' 'mujoco<4'"
# Gymnasium's registry does not say which tasks never terminate; in the source of gymnasium 1.4 the `step` of these, in
# every version, always returns terminated=False. (MountainCarContinuous, for one, terminates at its goal.)
_GYMNASIUM_NEVER_TERMINATES = {"Pendulum", "HalfCheetah", "HumanoidStandup", "Pusher", "Reacher", "Swimmer"}

_tasks = {name: Task(name, "dm_control", action_repeat=2, episode_length=1000, terminates=False) for name in DMC_TASKS}
_makers: dict[str, Maker] = {}


def register_task(task: Task, make: Maker | None = None, *, replace: bool = False) -> None:
    """Makes a task known to :func:`get_task` and :func:`~torchrl_etdmpc.envs.make_env` under its name.

    Args:
        task (Task): the task.
        make (callable, optional): ``make(task, device=...)`` returns one TorchRL environment, batch size [], that keeps
            the contract of :func:`~torchrl_etdmpc.envs.check_env`; ``is_init`` and ``episode_reward`` are added where
            they are missing. It obeys the task's ``action_repeat`` and ``episode_length``, which a command may have
            changed. ``None`` leaves it to the task's suite. With several environments it is called in worker processes,
            so it must be importable there, or picklable.
        replace (bool): whether another task of this name makes room.

    Raises:
        ValueError: if the name belongs to another task, or to the same one with another maker.

    >>> from torchrl_etdmpc.envs import Task, get_task, register_task
    >>> register_task(Task("swimmer-swimmer6", "dm_control", action_repeat=2, episode_length=1000, terminates=False))
    >>> get_task("swimmer-swimmer6").decision_steps_per_episode
    500
    """
    known = task.name in _tasks and (_tasks[task.name], _makers.get(task.name)) != (task, make)
    if known and not replace:
        raise ValueError(f"task {task.name!r} is registered already, as something else; choose another name.")
    _tasks[task.name] = task
    _makers.pop(task.name, None)
    if make is not None:
        _makers[task.name] = make


def registered_maker(task: Task) -> Maker | None:
    """The maker that was registered under the task's name, if any."""
    return _makers.get(task.name)


def get_task(
    name: str,
    *,
    action_repeat: int | None = None,
    episode_length: int | None = None,
    terminates: bool | None = None,
) -> Task:
    """Looks a task up by its name; never imports a user's code.

    Args:
        name (str): one of :data:`DMC_TASKS`, a task of HumanoidBench, e.g. ``"h1hand-walk"``, a name that
            :func:`register_task` knows, or ``gym/`` and any id of Gymnasium, e.g. ``"gym/Pendulum-v1"``.
        action_repeat (int, optional): instead of the task's own; likewise the next two.
        episode_length (int, optional): in env steps.
        terminates (bool, optional): ``True`` for a Gymnasium task unless it is known never to terminate.

    Returns:
        Task: the task's entry, with what was given here in it.

    Raises:
        ValueError: if no task has this name (the message holds the nearest names), if the name is a path to code
            (``package.module:attribute``) that :func:`~torchrl_etdmpc.envs.import_task` has not followed, if Gymnasium
            sets no time limit and ``episode_length`` is not given, or if a number is below 1.
        ImportError: if a Gymnasium task is asked for without gymnasium.

    >>> from torchrl_etdmpc.envs import get_task
    >>> task = get_task("cup-catch")
    >>> task.suite, task.action_repeat, task.decision_steps_per_episode
    ('dm_control', 2, 500)
    >>> get_task("cup-catch", episode_length=200).decision_steps_per_episode
    100
    """
    told: dict[str, Any] = {"action_repeat": action_repeat, "episode_length": episode_length, "terminates": terminates}
    told = {field: value for field, value in told.items() if value is not None}
    if name in _tasks:
        return dataclasses.replace(_tasks[name], **told)
    return suite_task(name, **told)


def suite_task(name: str, **told: Any) -> Task:
    """The entry of a task of Gymnasium or HumanoidBench as its suite makes it, with what was told in it.

    Raises:
        ValueError, ImportError: as by :func:`get_task`.
    """
    if str(name).startswith("gym/"):
        return _gymnasium_task(name, told)
    if ":" in str(name):
        # A stored run or checkpoint may hold such a name, and no file may make us import code.
        raise ValueError(
            f"task {name!r} names code, which must be given on the command line: task={name}, or code={name} of a "
            f"suite. In Python, call torchrl_etdmpc.envs.import_task({name!r}) before."
        )
    robot, _, goal = str(name).partition("-")
    if robot in _HUMANOID_ROBOTS and goal in _HUMANOID_GOALS:
        length = 500 if goal in _HUMANOID_SHORT else 1000
        return Task(name, "humanoid_bench", **({"episode_length": length, "terminates": True} | told))
    humanoids = (f"{robot}-{goal}" for robot in _HUMANOID_ROBOTS for goal in _HUMANOID_GOALS)
    nearest = difflib.get_close_matches(str(name), [*_tasks, *humanoids], n=3)
    hint = f"did you mean {', '.join(nearest)}? " if nearest else ""
    raise ValueError(f"unknown task {name!r}; {hint}task=list on the command line lists all.")


def list_tasks() -> str:
    """All tasks by suite, as a text.

    >>> list_tasks().splitlines()[0]
    'Easy DMC'
    """
    others = [name for name in _tasks if name not in DMC_TASKS]
    groups = {"Easy DMC": EASY_DMC, "Hard DMC": HARD_DMC, "HumanoidBench-Hard": HUMANOIDBENCH_HARD}
    groups |= {"registered": tuple(others), "Gymnasium": tuple(_gymnasium_ids())}
    lines = []
    for title, names in groups.items():
        if names:
            lines += [title, *_columns(names), ""]
    lines += [
        "HumanoidBench: ROBOT-GOAL, for any other one that it has, e.g. h1-walk, h1hand-push",
        "Gymnasium: gym/ID, for any other ID with actions within bounds and one vector as observation",
        "your own: MODULE:FUNCTION, a function that returns a TorchRL environment",
    ]
    return "\n".join(lines)


def _columns(names: Iterable[str]) -> list[str]:
    return textwrap.wrap("  ".join(names), 78, break_on_hyphens=False, initial_indent="  ", subsequent_indent="  ")


def _gymnasium_ids() -> list[str]:
    """Those of MuJoCo and of classic control with continuous actions, in their newest versions."""
    if importlib.util.find_spec("gymnasium") is None:
        return []
    import gymnasium

    continuous = {"Pendulum", "MountainCarContinuous"}
    newest: dict[str, int] = {}
    for spec in gymnasium.registry.values():
        if spec.version is not None and (spec.name in continuous or "mujoco" in str(spec.entry_point)):
            newest[spec.name] = max(spec.version, newest.get(spec.name, 0))
    return [f"gym/{name}-v{version}" for name, version in sorted(newest.items())]


def of_own_code(env_id: str) -> str:
    """What names a Gymnasium id that a user's own code registers, which no command imports by itself."""
    return (
        "An id that your own code registers is named by a module of yours that imports this code: task=MODULE:NAME, "
        f"with NAME = get_task('gym/{env_id.rpartition(':')[2]}') in it."
    )


def _gymnasium_task(name: str, told: dict[str, Any]) -> Task:
    if importlib.util.find_spec("gymnasium") is None:
        raise ImportError(f"task {name!r} needs gymnasium, which is missing; run: {INSTALL_GYMNASIUM}")
    import gymnasium

    env_id = name.removeprefix("gym/")
    if env_id not in gymnasium.registry:
        nearest = difflib.get_close_matches(env_id, gymnasium.registry, n=3)
        hint = f"did you mean {', '.join(f'gym/{other}' for other in nearest)}? " if nearest else ""
        raise ValueError(
            f"unknown task {name!r}; {hint}task=list on the command line lists those of MuJoCo. " + of_own_code(env_id)
        )
    limit = gymnasium.registry[env_id].max_episode_steps
    if limit in (None, -1) and "episode_length" not in told:
        raise ValueError(f"Gymnasium sets no time limit for {env_id}; give one in env steps: task.episode_length=")
    terminates = env_id.rpartition("-v")[0] not in _GYMNASIUM_NEVER_TERMINATES
    return Task(name, "gymnasium", **({"episode_length": limit, "terminates": terminates} | told))
