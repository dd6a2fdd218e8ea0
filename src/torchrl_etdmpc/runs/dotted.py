"""Nested settings by their dotted names, as a command line writes them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested settings by their dotted names.

    >>> flat({"seed": 1, "optim": {"lr": 0.001}})
    {'seed': 1, 'optim.lr': 0.001}
    """
    found: dict[str, Any] = {}
    for name, value in values.items():
        found |= flat(value, f"{prefix}{name}.") if isinstance(value, Mapping) else {f"{prefix}{name}": value}
    return found


def nested(values: Mapping[str, Any]) -> dict[str, Any]:
    """Settings by their dotted names, nested: :func:`flat` undone.

    >>> nested({"seed": 1, "optim.lr": 0.001})
    {'seed': 1, 'optim': {'lr': 0.001}}
    """
    found: dict[str, Any] = {}
    for name, value in values.items():
        put(found, name, value)
    return found


def put(values: dict[str, Any], name: str, value: Any) -> None:
    """Writes the setting of a dotted name into nested ones.

    Raises:
        ValueError: if what should be a group is a setting.

    >>> settings = {"optim": {"lr": 0.001}}
    >>> put(settings, "optim.lr", 0.01)
    >>> settings
    {'optim': {'lr': 0.01}}
    """
    *groups, last = name.split(".")
    for group in groups:
        values = values.setdefault(group, {})
        if not isinstance(values, dict):
            raise ValueError(f"unknown setting {name}; {group} has none below it.")
    values[last] = value
