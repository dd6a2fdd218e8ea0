"""Writes the parts of the site that are made of the code and of committed results, below docs/generated/."""

from __future__ import annotations

import ast
import contextlib
import csv
import dataclasses
import functools
import importlib
import inspect
import io
import json
import re
import statistics
import sys
import textwrap
import typing
from collections import defaultdict
from pathlib import Path
from unittest import mock

from equations import EQUATIONS

from torchrl_etdmpc.commands import main as command_main
from torchrl_etdmpc.commands.settings_help import groups_of, settings_of
from torchrl_etdmpc.training import PRESETS, DistributedConfig, TrainConfig

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "benchmarks" / "results" / "cpu"
ROOMS = (
    "planners",
    "modules",
    "objectives",
    "replay",
    "collectors",
    "envs",
    "functional",
    "checkpoints",
    "runs",
    "training",
    "suites",
    "inspector",
    "analysis",
    "testing",
    "commands",
)
COMMANDS = ("train", "train_dmc", "distributed", "suite", "evaluate", "export", "report", "study", "inspect_planner")
Rows = typing.Iterable[typing.Sequence[object]]


def table(head: typing.Sequence[str], rows: Rows) -> str:
    """A Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(str(cell).replace("|", "\\|") for cell in line) + " |" for line in lines) + "\n"


def public_names(room: str) -> list[str]:
    """What a room of the package offers."""
    return sorted(importlib.import_module(f"torchrl_etdmpc.{room}").__all__)


def public(room: str, name: str) -> typing.Any:
    """The object behind a public name, also where a loader has put the file of that name in its place."""
    thing = getattr(importlib.import_module(f"torchrl_etdmpc.{room}"), name)
    return getattr(thing, name) if inspect.ismodule(thing) else thing


def api_page(room: str) -> str:
    """reStructuredText of one room: every public name with its docstring."""
    module_name = f"torchrl_etdmpc.{room}"
    module = importlib.import_module(module_name)
    title = f"``{module_name}``"
    lines = [title, "=" * len(title), "", f".. py:module:: {module_name}", "", (module.__doc__ or "").strip(), ""]
    names = public_names(room)
    for name in names:
        thing = public(room, name)
        full = f"{module_name}.{name}"
        routine = inspect.isclass(thing) or inspect.isfunction(thing) or hasattr(thing, "cache_info")
        if not (thing.__doc__ if routine else data_doc(room, name)):
            raise ValueError(f"{full} is public and has no docstring; write one, with an example.")
        elsewhere = re.match(r"torchrl_etdmpc\.(\w+)\.", getattr(thing, "__module__", "") or "")
        if elsewhere and elsewhere[1] != room:
            lines += [f"``{name}`` is :obj:`torchrl_etdmpc.{elsewhere[1]}.{name}`.", ""]
        elif inspect.isclass(thing) and issubclass(thing, BaseException):
            lines += [f".. autoexception:: {full}", "   :no-members:", ""]
        elif inspect.isclass(thing):
            lines += [f".. autoclass:: {full}", "   :members:", "", *_inherited(thing), ""]
        elif routine:
            lines += [f".. autofunction:: {full}", ""]
        else:
            about = textwrap.indent(data_doc(room, name), "   ")
            lines += [f".. py:data:: {name}", *_value(thing), "", about, ""]
    return "\n".join(lines) + "\n"


def _inherited(thing: type) -> list[str]:
    """Entries of methods that a class has from bases which are no public names and have no entry of their own."""
    offered = {id(public(room, name)) for room in ROOMS for name in public_names(room)}
    bases = thing.__mro__[1:]
    hidden = [base.__module__.startswith("torchrl_etdmpc.") and id(base) not in offered for base in bases]
    names = dict.fromkeys(name for base in bases[: hidden.index(False)] for name in vars(base))
    names = [name for name in names if not name.startswith("_") and name not in vars(thing)]
    names = [name for name in names if inspect.isfunction(getattr(thing, name)) and getattr(thing, name).__doc__]
    return [f"   .. automethod:: {name}" for name in names]


def _value(thing: object) -> list[str]:
    text = (
        "one of " + ", ".join(map(repr, typing.get_args(thing))) if typing.get_origin(thing) is typing.Literal else ""
    )
    text = text or (repr(thing) if isinstance(thing, str | tuple) and len(repr(thing)) < 200 else "")
    return [f"   :value: {text}"] if text else []


@functools.cache
def _data_docs(room: str) -> dict[str, str]:
    found = {}
    for path in sorted((ROOT / "src" / "torchrl_etdmpc" / room).glob("*.py")):
        body = ast.parse(path.read_text(encoding="utf-8")).body
        for assigned, text in zip(body, body[1:], strict=False):
            if not (isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant)):
                continue
            targets = assigned.targets if isinstance(assigned, ast.Assign) else [getattr(assigned, "target", None)]
            found |= {
                target.id: inspect.cleandoc(text.value.value) for target in targets if isinstance(target, ast.Name)
            }
    return found


def data_doc(room: str, name: str) -> str:
    """What stands below the assignment of a constant or an alias of a type."""
    docs = _data_docs(room)
    return docs.get(name) or next((other[name] for other in map(_data_docs, ROOMS) if name in other), "")


def api_index() -> str:
    """The names of the package itself, and where each room's page is."""
    import torchrl_etdmpc

    home = {}
    for name in torchrl_etdmpc.__all__:
        home[name] = next(room for room in ROOMS if name in importlib.import_module(f"torchrl_etdmpc.{room}").__all__)
    lines = ["The same objects, importable from ``torchrl_etdmpc`` itself:", ""]
    lines += [f"- :obj:`~torchrl_etdmpc.{room}.{name}`" for name, room in sorted(home.items())]
    lines += ["", ".. toctree::", "   :maxdepth: 1", "", *(f"   {room}" for room in ROOMS)]
    title = "API"
    return "\n".join([title, "=" * len(title), "", *lines]) + "\n"


def _shown(value: object) -> str:
    if value is dataclasses.MISSING:
        return ""
    if value is None:
        return "`null`"
    return f"`{str(value).lower()}`" if isinstance(value, bool) else f"`{value}`"


def _kind(setting) -> str:
    if setting.choices:
        other = ", or your own" if setting.is_text else ""
        return ", ".join(f"`{choice}`" for choice in setting.choices) + other
    options = typing.get_args(setting.hint) or (setting.hint,)
    names = {"int": "whole number", "float": "number", "bool": "`true`, `false`", "str": "text"}
    return " or ".join(names.get(option.__name__, option.__name__) for option in options if option is not type(None))


def _flat(values: dict, prefix: str = "") -> dict[str, object]:
    flat: dict[str, object] = {}
    for name, value in values.items():
        key = f"{prefix}{name}"
        flat |= _flat(value, f"{key}.") if isinstance(value, dict) else {key: value}
    return flat


def configuration() -> str:
    """Every setting: default, type, meaning, and the value of each preset that has another."""
    settings, groups = settings_of(TrainConfig), groups_of(TrainConfig)
    presets = {name: _flat(config.to_dict()) for name, config in PRESETS.items()}
    text = []
    for group in ("", *groups):
        text.append(f"## {f'`{group}.*`' if group else 'A run'}\n\n{groups.get(group, '')}\n")
        rows = []
        for name, setting in settings.items():
            field = name.removeprefix("task.")
            if (name.split(".")[0] if name.split(".")[0] in groups else "") != group:
                continue
            other = defaultdict(list)
            for preset, values in presets.items():
                if name != "preset" and values[field] != setting.default:
                    other[_shown(values[field])].append(preset)
            elsewhere = "<br>".join(f"{value} in {', '.join(names)}" for value, names in other.items())
            meaning = setting.meaning[:1].upper() + setting.meaning[1:]
            default = _shown(setting.default) + (f"<br>{elsewhere}" if elsewhere else "")
            rows.append([f"`{name}`", _kind(setting), default, meaning])
        text.append(table(["setting", "type", "default", "meaning"], rows))
    own = {name: setting for name, setting in settings_of(DistributedConfig).items() if name not in settings}
    text.append("## Workers\n\nOf `distributed`, beside all the others.\n")
    rows = [[f"`{name}`", _kind(one), _shown(one.default), one.meaning] for name, one in own.items()]
    text.append(table(["setting", "type", "default", "meaning"], rows))
    return "\n".join(text)


def command_help(command: str, *topics: str) -> str:
    """What a command answers to ``--help``, at 88 columns."""
    out = io.StringIO()
    arguments = [f"torchrl-etdmpc {command}", *topics, "--help"]
    with (
        mock.patch.object(sys, "argv", arguments),
        mock.patch.dict("os.environ", {"COLUMNS": "88"}),
        contextlib.redirect_stdout(out),
        contextlib.suppress(SystemExit),
    ):
        command_main(command)
    return out.getvalue()


def commands() -> str:
    """All commands as they explain themselves."""
    text = [
        f"## `{command}`\n\n```text\n{command_help(command)}```\n" for command in COMMANDS if command != "train_dmc"
    ]
    return "\n".join(text)


def _runs(folder: Path) -> dict[int, tuple[list[dict], dict]]:
    found = {}
    for directory in sorted(folder.glob("seed*")):
        with open(directory / "eval.csv", newline="", encoding="utf-8") as file:
            rows = [{key: float(value) for key, value in row.items()} for row in csv.DictReader(file)]
        found[int(directory.name[4:])] = rows, json.loads((directory / "summary.json").read_text(encoding="utf-8"))
    return found


def learned_tasks() -> list[Path]:
    """Folders of committed runs of the cpu preset, one for each task."""
    folders = [path.parent for path in sorted(RESULTS.glob("*/seed1"))]
    return [folder for folder in folders if folder.name not in ("bf16", "make_train", "tdmpc2-walker-stand")]


def curves() -> str:
    """Expected returns with bands, and minutes, of the committed runs of the cpu preset."""
    steps = [5_000, 10_000, 20_000, 30_000, 50_000, 100_000]
    text = ["**Return after so many env steps**: mean of the seeds, lowest and highest in brackets.\n"]
    shown, minutes = [], []
    for folder in learned_tasks():
        runs = _runs(folder)
        by_step = defaultdict(list)
        for rows, _ in runs.values():
            for row in rows:
                by_step[int(row["env_steps"])].append(row["return_mean"])
        cells = []
        for step in steps:
            values = by_step[step]
            complete = len(values) == len(runs)
            band = f" [{min(values):.0f}, {max(values):.0f}]" if len(values) > 1 else ""
            cells.append(f"{statistics.mean(values):.0f}{band}" if complete else "–")
        name = "gym/Pendulum-v1, half the width" if folder.name == "gym-pendulum" else folder.name
        shown.append([name, len(runs), *cells])
        walls = [summary["wall_time_s"] / 60 for _, summary in runs.values()]
        speeds = [summary["decisions_per_second"] for _, summary in runs.values()]
        budget = max(summary["env_steps"] for _, summary in runs.values())
        row = [name, f"{budget:,}", f"{min(walls):.1f} to {max(walls):.1f}", f"{min(speeds):.0f} to {max(speeds):.0f}"]
        minutes.append(row)
    text.append(table(["task", "seeds", *(f"{step:,}" for step in steps)], shown))
    text.append("\n**Minutes of these runs**, evaluations and compilation included, one thread each:\n")
    text.append(table(["task", "env steps", "minutes", "decisions per second"], minutes))
    return "\n".join(text)


def markers() -> str:
    """Ranges of early markers in the runs that ``benchmarks/early_markers.py`` read."""
    with open(RESULTS / "early_markers.csv", newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    groups = list(dict.fromkeys(row["runs"] for row in rows))
    by_marker = defaultdict(dict)
    for row in rows:
        by_marker[row["marker"]][row["runs"]] = row
    body = []
    for marker, found in by_marker.items():
        cells = [f"{_short(found[g]['low'])} to {_short(found[g]['high'])}" if g in found else "" for g in groups]
        body.append([f"`{marker}`", *cells])
    last = {row["runs"]: f"{row['seeds']} runs, {_short(row['final_return'])}" for row in rows}
    body.append(["runs, mean final return", *(last[group] for group in groups)])
    return table(["column of train.csv", *groups], body)


def _short(text: str) -> str:
    value = float(text)
    return f"{value:.0f}" if abs(value) >= 100 or value == 0 else f"{value:.2g}"


def equations() -> str:
    """Equation, function, tests."""
    rows = []
    for one in EQUATIONS:
        tests = "<br>".join(f"`{test}`" for test in one.tests)
        name = one.function.removeprefix("torchrl_etdmpc.")
        rows.append([one.source, one.what, f"${one.formula}$", f"{{py:obj}}`{name} <{one.function}>`", tests])
    return table(["source", "what", "formula", "code", "test"], rows)


def unknown_settings() -> list[str]:
    """Settings that pages name and the configuration does not have, each with its page."""
    known = {*settings_of(TrainConfig), *settings_of(DistributedConfig)}
    known.add("planner.compiled_plan")  # an attribute, in a table of contracts
    groups = "|".join(groups_of(TrainConfig))
    faults = []
    for page in sorted((ROOT / "docs").rglob("*.md")):
        if not {"generated", "gallery"} & set(page.relative_to(ROOT).parts):
            named = re.findall(rf"[ `]((?:{groups})\.[a-z]\w*)[`=]", page.read_text(encoding="utf-8"))
            faults += [f"{page.relative_to(ROOT)} names {name}" for name in named if name not in known]
    return faults


def write(folder: Path) -> None:
    """Writes every part; a file that is as it was is not touched, so that a second build is quick.

    Raises:
        ValueError: if a public name has no docstring, or a page names a setting that does not exist.
    """
    if unknown := unknown_settings():
        raise ValueError(f"settings that do not exist: {'; '.join(unknown)}.")
    parts = {
        "parts/configuration.md": configuration(),
        "parts/commands.md": commands(),
        "parts/curves.md": curves(),
        "parts/markers.md": markers(),
        "parts/equations.md": equations(),
        "api/index.rst": api_index(),
        **{f"api/{room}.rst": api_page(room) for room in ROOMS},
    }
    for name, text in parts.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if not path.is_file() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    write(Path(__file__).parent / "generated")
