"""What ``--help`` says: settings, defaults and meanings, from the docstrings of the configuration and of its parts."""

from __future__ import annotations

import ast
import dataclasses
import functools
import importlib
import inspect
import re
import shutil
import textwrap
import types
import typing
from collections.abc import Iterator
from typing import Any

from torchrl_etdmpc.training.config import typed_name

_NAME_WIDTH = 34


@dataclasses.dataclass(frozen=True)
class Setting:
    """One setting as the command line knows it.

    Args:
        name (str): e.g. ``"planner.horizon"``.
        hint (type): of its values.
        default (object): ``dataclasses.MISSING`` if it must be given.
        meaning (str): one or two sentences.
    """

    name: str
    hint: Any
    default: Any
    meaning: str

    @property
    def choices(self) -> tuple[str, ...]:
        """What it can be, for a fixed choice; else nothing."""
        options = typing.get_args(self.hint) if typing.get_origin(self.hint) in _UNIONS else (self.hint,)
        return tuple(
            choice for option in options if typing.get_origin(option) is typing.Literal for choice in option.__args__
        )

    @property
    def is_text(self) -> bool:
        """Whether any text can be its value."""
        options = typing.get_args(self.hint) if typing.get_origin(self.hint) in _UNIONS else (self.hint,)
        return str in options


_UNIONS = (types.UnionType, typing.Union)


@functools.cache
def settings_of(config_class: type, prefix: str = "") -> dict[str, Setting]:
    """All settings of a configuration, by the name that the command line gives them.

    Args:
        config_class (type): a dataclass, whose groups are dataclasses too.
        prefix (str): path of the group. Default: none.

    >>> from torchrl_etdmpc.training import TrainConfig
    >>> settings_of(TrainConfig)["planner.horizon"].meaning
    'H, actions per sequence.'
    """
    hints, meanings = typing.get_type_hints(config_class), _meanings(config_class)
    found: dict[str, Setting] = {}
    own = inspect.get_annotations(config_class)
    fields = dataclasses.fields(config_class)
    # What must be given comes first, then what this command has of its own.
    for field in sorted(fields, key=lambda field: (field.default is not dataclasses.MISSING, field.name not in own)):
        hint = hints[field.name]
        if dataclasses.is_dataclass(hint):
            found |= settings_of(typing.cast(type, hint), f"{field.name}.")
            continue
        name = f"{prefix}{field.name}" if prefix else typed_name(field.name)
        meaning = meanings.get(field.name, "")
        for own_name in (f" ({name} on the command line)", f" ({name})"):
            meaning = meaning.replace(own_name, "")  # a docstring says it, where the name stands before it here
        found[name] = Setting(name, hint, field.default, meaning)
    return found


def groups_of(config_class: type) -> dict[str, str]:
    """The groups of a configuration, and the first sentence of each one's docstring."""
    hints = typing.get_type_hints(config_class)
    groups = {name: hint for name, hint in hints.items() if dataclasses.is_dataclass(hint)}
    return {name: _plain(inspect.getdoc(group) or "").split(";")[0].rstrip(".") + "." for name, group in groups.items()}


def help_text(
    config_class: type, what: str, command: str, topics: tuple[str, ...] = (), values: dict[str, Any] | None = None
) -> str:
    """The text of ``--help``, or of ``--help TOPIC``.

    Args:
        config_class (type): the command's settings.
        what (str): one sentence on the command.
        command (str): as it was typed.
        topics (tuple of str): groups or settings. Default: the main settings.
        values (dict, optional): defaults by name, where a preset says otherwise than the class.
    """
    settings, groups = settings_of(config_class), groups_of(config_class)
    width = max(min(shutil.get_terminal_size().columns, 100), _NAME_WIDTH + 23)
    lines: list[str] = []
    for topic in topics:
        chosen = [name for name in settings if name == topic or name.startswith(f"{topic}.")]
        if topic in groups:
            lines += [f"{topic}: {groups[topic]}", ""]
        lines += [line for name in chosen for line in _entry(settings[name], values, width)]
        lines.append("")
    if topics:
        return "\n".join(lines[:-1])
    needed = " ".join(f"{name}=..." for name, setting in settings.items() if setting.default is dataclasses.MISSING)
    lines += [*_wrap(what, width), ""]
    lines += _wrap(f"usage: {' '.join(f'{command} {needed}'.split())} [SETTING=VALUE ...]", width)
    lines += ["", "settings and their defaults:"]
    own = [setting for name, setting in settings.items() if name.split(".")[0] not in groups]
    lines += [line for setting in own for line in _entry(setting, values, width)]
    if groups:
        lines += ["", "groups of settings, e.g. --help planner:"]
        for name, meaning in groups.items():
            lines += _wrap(f"{name + '.*':14}{meaning}", width, initial_indent="  ", subsequent_indent=" " * 16)
    swept = "seed=1,2" if "checkpoint" in settings else "task=a,b"
    lines += ["", "also:"]
    for name, meaning in {
        **({"task=list": "prints all tasks by suite"} if "task" in settings else {}),
        **({"--help preset=cpu": "shows the defaults of that preset"} if "preset" in settings else {}),
        "--cfg job": "prints every setting with its value, unchecked, and does nothing else",
        **({f"--multirun {swept}": "one run after the other for every combination"} if groups else {}),
    }.items():
        lines += _wrap(f"{name:22}{meaning}", width, initial_indent="  ", subsequent_indent=" " * 24)
    return "\n".join(lines)


def _entry(setting: Setting, values: dict[str, Any] | None, width: int) -> Iterator[str]:
    default = (values or {}).get(setting.name, setting.default)
    head = f"{setting.name}={'...' if default is dataclasses.MISSING else _shown(default)}"
    choices = f" One of {', '.join(setting.choices)}." if setting.choices else ""
    meaning = setting.meaning[:1].upper() + setting.meaning[1:]
    text = _wrap(meaning + choices, width - _NAME_WIDTH - 3) or [""]
    if len(head) > _NAME_WIDTH:
        yield f"  {head}"
        head = ""
    for line in text:
        yield f"  {head:{_NAME_WIDTH}} {line}".rstrip()
        head = ""


def _wrap(text: str, width: int, **options: str) -> list[str]:
    return textwrap.wrap(text, width, break_on_hyphens=False, **options)  # pyright: ignore[reportArgumentType]


def _shown(value: Any) -> str:
    if value is None:
        return "null"
    return str(value).lower() if isinstance(value, bool) else f"{value}"


def _meanings(config_class: type) -> dict[str, str]:
    """Of every field: its own docstring, else what the class that takes it as an argument says."""
    found: dict[str, str] = {}
    for base in reversed(config_class.__mro__):
        if dataclasses.is_dataclass(base):
            for part in re.findall(r":class:`~([\w.]+)`", base.__doc__ or ""):
                module, _, name = part.rpartition(".")
                arguments = _arguments(getattr(importlib.import_module(module), name))
                found |= {argument: text for argument, text in arguments.items() if text}
            found |= {name: _plain(text) for name, text in _field_docs(base)}
    return found


def _field_docs(config_class: type) -> Iterator[tuple[str, str]]:
    (tree,) = ast.parse(textwrap.dedent(inspect.getsource(config_class))).body
    assert isinstance(tree, ast.ClassDef)
    for field, doc in zip(tree.body, tree.body[1:], strict=False):
        if isinstance(field, ast.AnnAssign) and isinstance(doc, ast.Expr) and isinstance(doc.value, ast.Constant):
            assert isinstance(field.target, ast.Name)
            yield field.target.id, str(doc.value.value)


def _arguments(part: type) -> dict[str, str]:
    """``name (type): text`` of a class' docstring, without the defaults, which a configuration has of its own."""
    entries = re.findall(r"^    (\w+) \([^)]*\): (.*(?:\n {8}.*)*)", inspect.getdoc(part) or "", re.M)
    return {name: re.sub(r"\s*Default: [^.]*(\.\d+[^.]*)?\.", "", _plain(text)) for name, text in entries}


def _plain(text: str) -> str:
    text = re.sub(r":\w+:`~?(?:[\w.]*\.)?(\w+)`", r"\1", " ".join(text.split()))
    return text.replace("``", "").replace('"', "")
