"""Tasks in a user's own file, by the path to the code."""

from __future__ import annotations

import contextlib
import dataclasses
import importlib
import math
import os
import sys
import traceback
import weakref
from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from torchrl.envs import EnvBase, FrameSkipTransform, ObservationNorm, StepCounter, VecNorm
from torchrl.envs.transforms import VecNormV2

from torchrl_etdmpc.envs.episode import equal_states, is_plain, transform_states
from torchrl_etdmpc.envs.layers import simulator_of, transforms_of, wrappers_of
from torchrl_etdmpc.envs.make import find_maker
from torchrl_etdmpc.envs.tasks import Maker, Task, of_own_code, register_task

_returned: dict[str, weakref.WeakSet[EnvBase]] = {}
"""By the path to a function, the simulators that it has returned."""
_first_states: dict[str, dict[str, Any]] = {}
"""By the path to a function, what the transforms around its first environment held."""


def import_task(
    path: str,
    *,
    action_repeat: int | None = None,
    episode_length: int | None = None,
    terminates: bool | None = None,
) -> Task:
    """Imports a user's own task and registers it under its path.

    The path must come from the person who started the program, never from a file.

    Args:
        path (str): ``package.module:attribute``; the module is looked for on Python's path and in the current
            directory. The attribute is a function without arguments that returns one TorchRL environment, with any
            transforms; or a :class:`~torchrl_etdmpc.envs.Task`, which its suite makes or the maker that the module
            registered with it.
        action_repeat (int, optional): env steps per decision. A function's environment repeats actions itself if it
            has to, so here it can only be told what is true.
        episode_length (int, optional): the time limit in env steps; a function's environment without one, or with a
            longer one, is truncated there. Needed where the environment does not show a limit (a
            :class:`~torchrl.envs.transforms.StepCounter`, or the own one of Gymnasium or dm_control).
        terminates (bool, optional): whether an episode can end for another reason than the time limit; ``True`` for a
            function unless told.

    Returns:
        Task: the task, with the path as its name.

    Raises:
        ValueError: if nothing can be found there, the code raises, or it is not a task or an environment.

    >>> import_task("no.such.module:make")
    Traceback (most recent call last):
        ...
    ValueError: task 'no.such.module:make': there is no module 'no.such.module' on Python's path or in ...
    """
    told: dict[str, Any] = {"action_repeat": action_repeat, "episode_length": episode_length, "terminates": terminates}
    told = {field: value for field, value in told.items() if value is not None}
    if path.startswith("gym/"):  # gymnasium.make takes MODULE:ID
        raise ValueError(f"task {path!r} is no path to a task. {of_own_code(path)}")
    found = import_attribute(path, "task")
    if isinstance(found, Task):
        maker: Maker = partial(_make_as, found.name, find_maker(found))
        task = dataclasses.replace(found, name=path, **told)
    else:
        maker = partial(_make_limited, found)
        _first_states.pop(path, None)
        with contextlib.chdir("."):  # it may change to another directory, where a command's relative paths mean others
            env = _call(found, path)
        repeat, limit = _action_repeat(env), _limit(env)
        if limit is None and "episode_length" not in told:
            raise ValueError(f"task {path!r} shows no time limit; give one in env steps: task.episode_length=")
        task = Task(path, "user", **({"action_repeat": repeat, "episode_length": limit} | told))
        _require_agreement(task, env)
        env.close()
    register_task(task, maker, replace=True)
    return task


def import_attribute(path: str, setting: str) -> Any:
    """Follows a path to code, the only place that does.

    The path must come from the person who started the program, never from a file.

    Args:
        path (str): ``package.module:attribute``, of a function or (for tasks) a :class:`~torchrl_etdmpc.envs.Task`; the
            module is looked for on Python's path and in the current directory.
        setting (str): what names the path, for messages.

    Raises:
        ValueError: if nothing can be found there, the module raises, or it is something else.

    >>> import_attribute("math:floor", "planner.score")(2.5)
    2
    """
    module_name, _, attribute = path.partition(":")
    if not module_name or not attribute:
        raise ValueError(f"{setting} {path!r} must read package.module:attribute.")
    here = os.getcwd()
    if here not in sys.path:
        sys.path.append(here)  # for good: the user's code may import more, later and in worker processes
    importlib.invalidate_caches()
    try:
        module = importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{module_name}.".startswith(f"{error.name}."):
            # The user's module was found, and misses another one.
            raise ValueError(f"{setting} {path!r}: {_raised(error)}") from error
        hint = f"; write {module_name[:-3]}:{attribute}" if module_name.endswith(".py") else ""
        raise ValueError(
            f"{setting} {path!r}: there is no module {module_name!r} on Python's path or in {here}{hint}."
        ) from error
    except (Exception, SystemExit) as error:
        raise ValueError(f"{setting} {path!r}: {_raised(error)}") from error
    found = getattr(module, attribute, None)
    if found is None:
        where = getattr(module, "__file__", None) or "built in"
        raise ValueError(f"{setting} {path!r}: the module {module_name!r} ({where}) has no {attribute!r}.")
    if not (callable(found) or isinstance(found, Task)):
        kind = "a function or a Task" if setting == "task" else "a function"
        raise ValueError(f"{setting} {path!r} must be {kind}, got {type(found).__name__}.")
    return found


def _raised(error: BaseException) -> str:
    """What a user's code raised, and the line of its file; a syntax error tells its own."""
    ours = (__file__, importlib.__file__)
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if frame.filename not in ours]
    frames = [frame for frame in frames if not frame.filename.startswith("<frozen")]
    own = [frame for frame in frames if frame.filename == frames[0].filename]
    place = f" ({os.path.basename(own[-1].filename)}, line {own[-1].lineno})" if own else ""
    text = " ".join(str(error).split())
    return f"{type(error).__name__}{text and ': '}{text}{place}"


def _make_as(name: str, make: Maker, task: Task, *, device: torch.device | str) -> EnvBase:
    """Calls a maker with the name that the task had in its own module."""
    return make(dataclasses.replace(task, name=name), device=device)


def _make_limited(function: Callable[[], EnvBase], task: Task, *, device: torch.device | str) -> EnvBase:
    """A function's environment, which must be what the task says it is."""
    env = _call(function, task.name)
    _require_agreement(task, env)
    if task.episode_length < min(_limits(env), default=math.inf):
        # Under a name of its own, beside a StepCounter that the environment may have.
        env = env.append_transform(StepCounter(task.decision_steps_per_episode, step_count_key="decision_count"))
    return env.to(device)


def _require_agreement(task: Task, env: EnvBase) -> None:
    repeat, limit = _action_repeat(env), _limit(env)
    if task.action_repeat != repeat:
        raise ValueError(
            f"action_repeat of task {task.name!r} must be {repeat}, which is how often its environment repeats an "
            f"action, got {task.action_repeat}; repeat actions inside the function."
        )
    if limit is not None and task.episode_length > limit:
        raise ValueError(
            f"episode_length of task {task.name!r} must be at most {limit}, its environment's own limit, got "
            f"{task.episode_length}."
        )
    skips = any(isinstance(transform, FrameSkipTransform) for transform in transforms_of(env))
    if skips and any(own % repeat for own in _simulators_limits(env)):
        raise ValueError(
            f"task {task.name!r} repeats actions {repeat} times with FrameSkipTransform, which steps on behind the "
            f"time limit of {min(_simulators_limits(env))} env steps, dm_control into its next episode; repeat them "
            "with frame_skip= of GymEnv or DMControlEnv, or as often as divides the limit."
        )
    if task.terminates and skips:
        raise ValueError(
            f"task {task.name!r} repeats actions with FrameSkipTransform, which steps on where an episode has ended; "
            "repeat them with frame_skip= of GymEnv or DMControlEnv, or in a step of your own, or say that only the "
            "time limit ends its episodes: task.terminates=false."
        )


def _call(function: Callable[[], EnvBase], path: str) -> EnvBase:
    try:
        env = function()
    except Exception as error:
        raise ValueError(f"task {path!r}: {_raised(error)}") from error
    if not isinstance(env, EnvBase):
        remedy = "; return GymWrapper(env), of torchrl.envs" if hasattr(env, "action_space") else ""
        raise ValueError(f"task {path!r} must return a TorchRL environment, got {type(env).__name__}{remedy}.")
    if env.batch_size:
        raise ValueError(
            f"task {path!r} must return one environment, got {list(env.batch_size)} of them; use num_envs=."
        )
    before, simulator = _returned.setdefault(path, weakref.WeakSet()), simulator_of(env)
    if simulator in before:
        raise ValueError(
            f"task {path!r} must return a new environment every time, got one that it had returned before: training "
            "and evaluation would step the same."
        )
    before.add(simulator)
    _require_same_numbers(path, env)
    return env


def _require_same_numbers(path: str, env: EnvBase) -> None:
    """Refuses statistics that every call measures anew, as ObservationNorm does by steps that it takes at random.

    Of other transforms that remember, e.g. the last frames, copies may differ.
    """
    states = transform_states(env)
    first = _first_states.setdefault(path, states)
    for place, transform in enumerate(transforms_of(env)):
        one, other = first.get(str(place)), states.get(str(place))
        measures = isinstance(transform, ObservationNorm | VecNorm | VecNormV2)
        if measures and is_plain(one) and is_plain(other) and not equal_states(one, other):
            raise ValueError(
                f"task {path!r}: {type(transform).__name__} has other numbers in every environment that is made, so "
                "training and evaluation would see different ones; give it fixed numbers, or leave it out and set "
                "model.normalize_observations=true, whose statistics are the agent's."
            )


def _action_repeat(env: EnvBase) -> int:
    """Env steps per step of this environment, as far as its layers tell."""
    repeat = math.prod(_wrapper_repeat(wrapper) for wrapper in wrappers_of(env))
    for layer in [*transforms_of(env), simulator_of(env)]:
        # Of an environment that cannot repeat actions itself, TorchRL keeps the number and appends the transform.
        if isinstance(layer, FrameSkipTransform) or getattr(type(layer), "_has_frame_skip", False):
            repeat *= layer.frame_skip
    return repeat


def _wrapper_repeat(wrapper: Any) -> int:
    """How often a wrapper of Gymnasium repeats an action."""
    told_by = {"RepeatAction": "num_repeats", "MaxAndSkipObservation": "_skip"}.get(type(wrapper).__name__, "")
    return int(vars(wrapper).get(told_by, 1))


def _limit(env: EnvBase) -> int | None:
    """The time limit of this environment in env steps, the least that its layers tell, or else what its spec says."""
    wrappers = wrappers_of(env)
    told = getattr(getattr(wrappers[0], "spec", None), "max_episode_steps", None) if wrappers else None
    return min(_limits(env), default=told)


def _limits(env: EnvBase) -> list[int]:
    """The time limits that end an episode of this environment, in env steps."""
    # One that only tells, and ends nothing (update_done=False), is no limit.
    counters = (each for each in transforms_of(env) if isinstance(each, StepCounter) and each.update_done)
    limits = [counter.max_steps * _action_repeat(env) for counter in counters if counter.max_steps is not None]
    return [*limits, *_simulators_limits(env)]


def _simulators_limits(env: EnvBase) -> list[int]:
    """Those of Gymnasium's wrappers and of dm_control, in env steps."""
    wrappers, limits, repeat = wrappers_of(env), [], 1
    for wrapper in reversed(wrappers):  # the innermost first, whose steps are env steps
        limits.append((vars(wrapper).get("_max_episode_steps") or math.inf) * repeat)
        limits.append(vars(wrapper).get("_step_limit", math.inf))
        repeat *= _wrapper_repeat(wrapper)
    return [math.ceil(limit) for limit in limits if limit < math.inf]
