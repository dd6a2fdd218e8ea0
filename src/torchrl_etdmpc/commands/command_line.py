"""The command line: Hydra overrides on a preset, and errors in one line."""

from __future__ import annotations

import dataclasses
import difflib
import functools
import itertools
import os
import re
import sys
import tempfile
import typing
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from torchrl_etdmpc.commands.settings_help import Setting, groups_of, help_text, settings_of
from torchrl_etdmpc.envs import import_task, list_tasks
from torchrl_etdmpc.runs import console, first_line
from torchrl_etdmpc.runs.dotted import flat
from torchrl_etdmpc.training import PRESETS, TASK_SETTINGS, TrainConfig, config_from_dict, follow_own_code, preset

_CONFIG = str(Path(__file__).parent / "config")


def one_line_errors(main: Callable[..., None]) -> Callable[..., None]:
    """Makes a command end in one line on stderr and exit code 1 for any error that a user can mend.

    ``TORCHRL_ETDMPC_TRACEBACK=1`` shows the traceback instead.
    """

    @functools.wraps(main)
    def wrapped(*args: Any) -> None:
        try:
            main(*args)
            sys.stdout.flush()
        except KeyboardInterrupt:
            sys.exit(130)
        except BrokenPipeError:  # whoever read the output has gone, e.g. head
            sys.exit(141)
        except Exception as error:
            if os.environ.get("TORCHRL_ETDMPC_TRACEBACK") == "1":
                raise
            text = as_typed(" ".join(str(error).split()))
            sys.exit(f"error: {text or type(error).__name__}")
        finally:
            for stream in (sys.stdout, sys.stderr):
                try:
                    stream.flush()
                except OSError:  # Python would try it again at its end, and exit with 120
                    os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())

    return wrapped


def as_typed(text: str) -> str:
    """A message in the words of the command line, or of ``make`` if that is what was typed.

    >>> as_typed("run_dir=runs/a already holds a run")
    'run_dir=runs/a already holds a run'
    >>> as_typed("action_repeat of task 'walker-walk' must be at least 1, got 0.")
    "task.action_repeat of task 'walker-walk' must be at least 1, got 0."
    """
    text = re.sub(rf"^({'|'.join(TASK_SETTINGS)}) of task", r"task.\1 of task", text)
    make = os.environ.get("TORCHRL_ETDMPC_MAKE")  # the command that was typed, without its ARGS
    if not make:
        return text
    text = re.sub(r"\b(resume=\w+)", lambda found: f'{make} ARGS="{found[1]}"', text)
    return re.sub(r"\brun_dir\b", "RUN_DIR", text)


def hydra_main(
    config_name: str,
    config_class: type = TrainConfig,
    *,
    complete: Callable[[dict[str, Any], list[str]], dict[str, Any]] | None = None,
) -> Callable[[Callable[[Any], None]], Callable[[], None]]:
    """Decorates ``main(config)`` with a command line: settings as Hydra's overrides, presets, ``--help``.

    What was typed is checked before Hydra sees it, so that a mistake is named in the words of the command. The first
    line of ``main``'s docstring is the first one of the help.

    Args:
        config_name (str): a file of ``commands/config``, without its ending.
        config_class (type): dataclass that ``main`` receives, checked. Default: :class:`TrainConfig`.

    Keyword Args:
        complete (callable, optional): gets all settings and the names of those that were typed, and returns those
            that are checked, e.g. :func:`~torchrl_etdmpc.training.with_stored_settings`.

    Raises:
        ImportError: on the call, if hydra-core is missing.
    """

    def decorate(main: Callable[[Any], None]) -> Callable[[], None]:
        @one_line_errors
        @functools.wraps(main)
        def wrapped() -> None:
            told = _answer(sys.argv[1:], config_class, (main.__doc__ or "").strip())
            if told is not None:
                print(told)
                return
            try:
                import hydra
                from hydra.core.config_store import ConfigStore
                from omegaconf import OmegaConf
                from omegaconf.errors import OmegaConfBaseException
            except ImportError as error:
                raise ImportError("this command needs hydra-core; run: pip install 'hydra-core>=1.3,<1.4'") from error
            sys.argv[1:] = _checked(sys.argv[1:], config_class)
            _import_own_code(sys.argv[1:])
            os.environ["HYDRA_FULL_ERROR"] = "1"  # errors reach us instead of being printed over many lines
            for name, values in PRESETS.items():
                ConfigStore.instance().store(group="preset", name=name, node=values.to_dict(), package="_global_")

            def read(values) -> Any:
                try:
                    plain: Any = OmegaConf.to_container(values, resolve=True, throw_on_missing=True)
                except OmegaConfBaseException as error:  # ${...} in a value
                    raise ValueError(f"{error.full_key} cannot be read: {first_line(error)}") from error
                completed = plain if complete is None else complete(plain, explicit_settings())
                return config_from_dict(config_class, completed)

            @hydra.main(version_base="1.3", config_path=_CONFIG, config_name=config_name)
            @one_line_errors  # inside as well: Hydra would add a line of its own to an exception that passes through it
            def run(values) -> None:
                with console():
                    main(read(values))

            if _SWEEP_FLAGS & set(sys.argv):  # the last run's mistake is found before the first one begins
                with hydra.initialize_config_dir(_CONFIG, version_base="1.3"):
                    for overrides in _runs_of_a_sweep(sys.argv[1:]):
                        _ = read(hydra.compose(config_name, overrides)).task_spec
            with _without_traces_of_a_sweep():
                run()

        return wrapped

    return decorate


def _answer(arguments: list[str], config_class: type, what: str) -> str | None:
    """What a question is answered with: ``--help``, ``--help planner``, ``task=list``."""
    settings = settings_of(config_class)
    if "task" in settings and "task=list" in arguments:
        return list_tasks()
    asked = {"--help", "-h", "help"} & set(arguments)
    if not asked:
        return None
    topics, values = [], None
    for argument in arguments:
        name, equals, value = argument.partition("=")
        if equals and name == "preset" and "preset" in settings:
            values = flat(preset(value).to_dict())
        elif argument not in asked and not equals:
            topic = argument.lstrip("-").removesuffix(".*").rstrip(".")
            known = [*groups_of(config_class), *settings]
            if topic not in known:
                raise ValueError(f"there is no group and no setting {topic!r}; {nearest(topic, known)}")
            topics.append(topic)
    return help_text(config_class, what, _command(), tuple(topics), values)


def _command() -> str:
    """The beginning of the command as it was typed."""
    script = sys.argv[0]
    return f"python {os.path.relpath(script)}" if script.endswith(".py") else os.path.basename(script)


_ELSEWHERE = {"workers": "distributed", "engine": "distributed", "address": "distributed"}
"""Settings that stand in another command alone."""
_FLAGS = {"--cfg", "-c", "--resolve", "--multirun", "-m"}
_SWEEP_FLAGS = {"--multirun", "-m"}
_FILES = ("video", "csv")
_OUTPUTS = ("run_dir", "out", "save", *_FILES)
_PATHS = {"checkpoint", *_OUTPUTS}
_ALL = "--help lists all."


def _checked(arguments: list[str], config_class: type) -> list[str]:
    """The arguments as Hydra takes them: names that exist, values that can be read, text in quotes.

    Raises:
        ValueError: naming what was typed, and what may have been meant.
    """
    settings, groups = settings_of(config_class), groups_of(config_class)
    sweep = bool(_SWEEP_FLAGS & set(arguments))
    flags, checked, rest = [], [], iter(arguments)
    for argument in rest:
        bare = argument.lstrip("-")
        if argument in _FLAGS:
            flags.append(argument)
            if argument in ("--cfg", "-c"):
                what = next(rest, "")
                if what != "job":
                    raise ValueError(f"{argument} must be followed by job, got {what!r}.")
                flags.append(what)
            continue
        name, equals, value = bare.lstrip("+").partition("=")
        if argument.startswith("-") and not (equals or bare in settings):
            raise ValueError(f"unknown option {argument}; settings are written name=value, and --help lists them.")
        if argument.startswith("~"):
            raise ValueError(f"a setting cannot be removed, got {argument!r}; {name.lstrip('~')}=null may do.")
        name = f"task.{name}" if f"task.{name}" in settings else name
        if name.startswith("hydra.") and equals and sweep:  # of the sweeper or the launcher
            checked.append(argument)
            continue
        if name in groups:
            raise ValueError(
                f"{name} is a group of settings; --help {name} lists them, e.g. {_first(name, settings)}=..."
            )
        if name not in settings:
            hint = f"the command {_ELSEWHERE[name]} has it." if name in _ELSEWHERE else nearest(name, settings)
            main = next((main for main in ("checkpoint", "task") if main in settings), None)
            if main is not None and hint == _ALL and not equals:
                raise ValueError(f"a setting is written name=value, got {argument!r}; did you mean {main}={argument}?")
            raise ValueError(f"unknown setting {name}; {hint}")
        if argument.startswith("-") or not equals:
            raise ValueError(f"a setting is written name=value, without dashes or spaces, got {argument!r}.")
        if name == "preset":
            for preset_name in value.split(",") if sweep else [value]:
                preset(preset_name)
        if name in _PATHS and value.startswith("~"):
            value = os.path.expanduser(value)
        if name in _OUTPUTS:  # a setting of the task is named as it is typed; for Hydra the task is a text
            value = re.sub(r"\$\{task\.(\w+)\}", r"${\1}", value)
        short = name.removeprefix("task.")
        checked.append(f"{short}={value if sweep else _readable(settings[name], value)}")
    given = {argument.partition("=")[0] for argument in checked}
    for name, setting in settings.items():
        if setting.default is dataclasses.MISSING and name not in given and not {"--cfg", "-c"} & set(flags):
            raise ValueError(f"{name}=... is missing: {setting.meaning[0].lower()}{setting.meaning[1:]}")
    if sweep:
        for name in _OUTPUTS:
            if name in settings:
                _require_one_each(name, settings[name].default, checked)
    return flags + checked  # Hydra takes no flag between settings


def _overrides(arguments: list[str]) -> list[Any]:
    """The arguments as Hydra reads them."""
    from hydra.core.override_parser.overrides_parser import OverridesParser

    return OverridesParser.create().parse_overrides([argument for argument in arguments if argument not in _FLAGS])


def _runs_of_a_sweep(arguments: list[str]) -> Iterator[list[str]]:
    """What each run of a sweep is told, in the words of a single run."""
    ways = []
    for override in _overrides(arguments):
        name = override.get_key_element()
        if not name.startswith("hydra."):
            swept = override.is_sweep_override()
            values = override.sweep_string_iterator() if swept else [override.get_value_element_as_str()]
            ways.append([f"{name}={value}" for value in values])
    return map(list, itertools.product(*ways))


def _require_one_each(output: str, default: str | None, arguments: list[str]) -> None:
    """What a run writes is its own; without ``run_dir`` its directory is named by task, preset and seed."""
    swept = [it.key_or_group for it in _overrides(arguments) if it.is_sweep_override()]
    swept = [name for name in swept if name != output and not name.startswith("hydra.")]
    path = dict(argument.split("=", 1) for argument in arguments).get(output, default or "null")
    if path != "null":
        what, named = f"{output}={path}", re.findall(r"\$\{([\w.]+)\}", path)
        folder, file = os.path.split(path) if output in _FILES else (path, "")
    elif output == "run_dir":
        what, named, folder, file = "the default run_dir", ["task", "preset", "seed"], "runs", ""
    else:
        return
    shared = [name for name in swept if name not in named]
    if shared:
        missing = swept if path == "null" else shared
        remedy = os.path.join(folder, *(f"${{{name}}}" for name in missing), file).rstrip("/")
        raise ValueError(
            f"{what} would be that of several runs, which differ in {', '.join(shared)}; put what differs into it, "
            f"e.g. {output}='{remedy}'."
        )


@contextmanager
def _without_traces_of_a_sweep() -> Iterator[None]:
    """Hydra's own files of a sweep are gone when it ends, unless the command names a folder for them."""
    if not _SWEEP_FLAGS & set(sys.argv) or any("hydra.sweep." in argument for argument in sys.argv):
        yield
        return
    with tempfile.TemporaryDirectory() as folder:
        sys.argv.append(f"hydra.sweep.dir='{folder}'")
        yield


def _readable(setting: Setting, value: str) -> str:
    """A value as Hydra reads it: text in quotes, whatever is in it; anything else must be one word."""
    quoted = len(value) > 1 and value[0] == value[-1] and value[0] in "'\""
    if quoted or value in ("null", "None"):
        return value.replace("None", "null") if not quoted else value
    if setting.is_text and value:
        # Hydra takes a backslash for itself where a quote or the end follows.
        escaped = re.sub(r"(\\*)('|$)", lambda found: found[1] * 2 + ("\\'" if found[2] else ""), value)
        return f"'{escaped}'"
    if not value:
        raise ValueError(f"{setting.name} must not be empty.")
    if not re.fullmatch(r"[\w.+-]+", value, re.ASCII):
        kinds = {int: "a whole number", float: "a number", bool: "true or false"}
        options = typing.get_args(setting.hint) or (setting.hint,)
        kind = next((kinds[option] for option in options if option in kinds), "text")
        kind = f"one of {', '.join(setting.choices)}" if setting.choices else kind
        raise ValueError(f"{setting.name} must be {kind}, got {value!r}.")
    return value


def _first(group: str, settings: Iterable[str]) -> str:
    return next(name for name in settings if name.startswith(f"{group}."))


def nearest(name: str, known: Iterable[str]) -> str:
    """A hint at names like this one: the same last part in another group counts too."""
    known, last = list(known), name.rpartition(".")[2].lower()
    same = [other for other in known if other.rpartition(".")[2] == last]
    parts = {other.rpartition(".")[2]: other for other in known}
    near = difflib.get_close_matches(name.lower(), known, n=2, cutoff=0.85)
    near += [other for part in difflib.get_close_matches(last, parts, n=2, cutoff=0.75) for other in [parts[part]]]
    found = list(dict.fromkeys([*same, *near]))[:3]
    return f"did you mean {' or '.join(found)}? {_ALL}" if found else _ALL


def explicit_settings() -> list[str]:
    """Settings that the command line names, e.g. ``planner.horizon``, without Hydra's own."""
    names = [argument.lstrip("+").partition("=")[0] for argument in sys.argv[1:] if "=" in argument]
    return [name for name in names if not name.startswith("hydra")]


def _import_own_code(arguments: list[str]) -> None:
    """Follows a task, a score or terms that are a path to code, ``task=package.module:function``.

    Only the command line can make this process import code: a stored configuration that names such a path is refused
    unless the command repeats it.
    """
    given = dict(argument.split("=", 1) for argument in arguments if "=" in argument)
    given = {name: value.strip("'") for name, value in given.items()}
    for name, value in given.items():
        for path in value.split(","):  # a sweep names several
            follow_own_code(name, path)
    settings = {}
    for name in TASK_SETTINGS:
        try:
            if name in given and given[name] != "null":
                settings[name] = _TRUTH[given[name].lower()] if name == "terminates" else int(float(given[name]))
        except (KeyError, ValueError, OverflowError) as error:
            if _SWEEP_FLAGS & set(sys.argv):  # several values, which are checked run by run
                continue
            kind = "true or false" if name == "terminates" else "a whole number"
            raise ValueError(f"task.{name} must be {kind}, got {given[name]!r}.") from error
    for task in given.get("task", "").split(","):  # a sweep names several
        if ":" in task:
            import_task(task, **settings)


_TRUTH = {"true": True, "false": False}
