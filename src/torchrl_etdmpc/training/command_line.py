"""The command line of the examples: Hydra overrides on a preset, and errors in one line."""

from __future__ import annotations

import functools
import os
import sys
from collections.abc import Callable
from typing import Any

from torchrl_etdmpc.envs import import_task
from torchrl_etdmpc.training.config import TrainConfig, config_from_dict
from torchrl_etdmpc.training.presets import PRESETS, preset


def one_line_errors(main: Callable[..., None]) -> Callable[..., None]:
    """Makes a command end in one line on stderr and exit code 1 for any error that a user can mend.

    ``TORCHRL_ETDMPC_TRACEBACK=1`` shows the traceback instead.
    """

    @functools.wraps(main)
    def wrapped(*args: Any) -> None:
        try:
            main(*args)
        except KeyboardInterrupt:
            sys.exit(130)
        except Exception as error:
            if os.environ.get("TORCHRL_ETDMPC_TRACEBACK") == "1":
                raise
            causes: list[BaseException] = [error]
            while _is_hydra(causes[-1]) and (cause := causes[-1].__cause__ or causes[-1].__context__) is not None:
                causes.append(cause)
            text = " ".join(" ".join(str(cause) for cause in causes).split())
            sys.exit(f"error: {text or type(error).__name__}")

    return wrapped


def _is_hydra(error: BaseException) -> bool:
    return type(error).__module__.startswith(("hydra", "omegaconf"))


def hydra_main(
    config_path: str, config_name: str, config_class: type = TrainConfig
) -> Callable[[Callable[[Any], None]], Callable[[], None]]:
    """Decorates ``main(config)`` with Hydra's command line and the presets as its group ``preset``.

    Args:
        config_path (str): absolute folder of the YAML files.
        config_name (str): the file, without its ending.
        config_class (type): dataclass that ``main`` receives, checked. Default: :class:`TrainConfig`.

    Raises:
        ImportError: on the call, if hydra-core is missing.
    """

    def decorate(main: Callable[[Any], None]) -> Callable[[], None]:
        @one_line_errors
        @functools.wraps(main)
        def wrapped() -> None:
            try:
                import hydra
                from hydra.core.config_store import ConfigStore
                from omegaconf import OmegaConf
            except ImportError as error:
                raise ImportError("the examples need hydra-core; run: pip install torchrl_etdmpc[train]") from error
            sys.argv[1:] = [_without_task_prefix(argument) for argument in sys.argv[1:]]
            _import_tasks(sys.argv[1:])
            os.environ["HYDRA_FULL_ERROR"] = "1"  # errors reach us instead of being printed over many lines
            for name, values in PRESETS.items():
                ConfigStore.instance().store(group="preset", name=name, node=values.to_dict(), package="_global_")
            _check_preset(sys.argv[1:])

            @hydra.main(version_base="1.3", config_path=config_path, config_name=config_name)
            @one_line_errors  # inside as well: Hydra would add a line of its own to an exception that passes through it
            def run(values) -> None:
                plain: Any = OmegaConf.to_container(values, resolve=True, throw_on_missing=True)
                main(config_from_dict(config_class, plain))

            run()

        return wrapped

    return decorate


def explicit_settings(arguments: list[str] | None = None) -> list[str]:
    """Settings that the command line names, e.g. ``planner.horizon``, without the preset and Hydra's own.

    Args:
        arguments (list of str, optional): Default: those of this process.
    """
    given = sys.argv[1:] if arguments is None else arguments
    names = [argument.lstrip("+").partition("=")[0] for argument in given if "=" in argument]
    return [name for name in names if not name.startswith(("hydra", "-", "~"))]


_TASK_SETTINGS = ("action_repeat", "episode_length", "terminates")


def _without_task_prefix(argument: str) -> str:
    """``task.action_repeat=2`` as the setting ``action_repeat=2``: ``task`` itself is a name, not a group."""
    name, equals, value = argument.partition("=")
    group, _, setting = name.partition(".")
    return f"{setting}{equals}{value}" if group == "task" and setting in _TASK_SETTINGS else argument


def _import_tasks(arguments: list[str]) -> None:
    """Follows a task that is a path to code, ``task=package.module:function``.

    Only the command line can make this process import code: a stored configuration that names such a task is refused
    unless the command repeats it.
    """
    given = dict(argument.split("=", 1) for argument in arguments if "=" in argument)
    settings = {}
    for name in _TASK_SETTINGS:
        try:
            if name in given and given[name] != "null":
                settings[name] = _TRUTH[given[name].lower()] if name == "terminates" else int(float(given[name]))
        except (KeyError, ValueError) as error:
            kind = "true or false" if name == "terminates" else "a whole number"
            raise ValueError(f"task.{name} must be {kind}, got {given[name]!r}.") from error
    for task in given.get("task", "").split(","):  # a sweep names several
        if ":" in task:
            import_task(task, **settings)


_TRUTH = {"true": True, "false": False}


def _check_preset(arguments: list[str]) -> None:
    for argument in arguments:
        if argument.startswith("preset="):
            for name in argument.removeprefix("preset=").split(","):  # a sweep names several
                preset(name)
