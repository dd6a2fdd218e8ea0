"""A configuration dataclass from plain values, whose types and choices are checked by its annotations."""

from __future__ import annotations

import dataclasses
import functools
import types
import typing
from collections.abc import Mapping
from typing import Any, Literal

from torchrl_etdmpc.training.own_code import OWN_CODE, own_code

# What single precision holds with room for sums and squares of it, and what a float counts without a gap.
_LARGEST_FLOAT = 1e30
_LARGEST_INT = 2**53


def config_from_dict(cls: type, values: Mapping[str, Any], prefix: str = "") -> Any:
    """A (nested) configuration dataclass from a dictionary, with every value's type and choice checked.

    Args:
        cls (type): the dataclass.
        values (mapping): its fields, nested dataclasses as mappings; missing fields take their default.
        prefix (str): path of the group, for messages.

    Raises:
        ValueError: if a key is unknown, or a value has the wrong type or is out of range.

    >>> from torchrl_etdmpc.training.config import OptimConfig
    >>> config_from_dict(OptimConfig, {"lr": 1e-3}).lr
    0.001
    """
    hints = _type_hints(cls)
    unknown = sorted(set(values) - set(hints))
    require(not unknown, f"unknown setting {prefix}{unknown[0] if unknown else ''}; known: {', '.join(hints)}.")
    converted = {}
    for name, value in values.items():
        hint = hints[name]
        if isinstance(hint, type) and dataclasses.is_dataclass(hint):
            require(isinstance(value, Mapping), f"{prefix}{name} must be a group of settings, got {value!r}.")
            converted[name] = config_from_dict(hint, value, f"{prefix}{name}.")
        else:
            converted[name] = _convert(hint, value, f"{prefix}{name}")
    return cls(**converted)


_type_hints = functools.cache(typing.get_type_hints)  # which evaluates every annotation anew


def check_types(config: Any, prefix: str = "") -> None:
    """Checks what was not made by :func:`config_from_dict`."""
    for name, hint in _type_hints(type(config)).items():
        value = getattr(config, name)
        if isinstance(hint, type) and dataclasses.is_dataclass(hint):
            require(isinstance(value, hint), f"{prefix}{name} must be a {hint.__name__}, got {value!r}.")
            check_types(value, f"{prefix}{name}.")
        else:
            meant = _convert(hint, value, f"{prefix}{name}")
            same = type(meant) is type(value) or isinstance(meant, float)
            require(same, f"{prefix}{name} must be {meant!r}, got {value!r}.")


def _convert(hint: Any, value: Any, name: str) -> Any:
    if name in OWN_CODE and isinstance(value, str) and (":" in value or not _has_choices(hint)):
        own_code(OWN_CODE[name], value)
        return value
    if typing.get_origin(hint) in (types.UnionType, typing.Union):  # the latter with a Literal in it
        if value is None and type(None) in typing.get_args(hint):
            return None
        hint = next(option for option in typing.get_args(hint) if option is not type(None))
    choices = typing.get_args(hint)
    if "off" in choices and isinstance(value, bool):
        value = "off" if value is False else "on"  # YAML reads a bare off as a boolean
    if choices:
        require(value in choices, f"{name} must be one of {', '.join(choices)}, got {value!r}.")
        return value
    if hint is float and isinstance(value, int | float) and not isinstance(value, bool):
        require(abs(value) < _LARGEST_FLOAT, f"{name} must be a finite number below 1e30, got {value!r}.")
        return float(value)
    if hint is int and isinstance(value, int | float) and not isinstance(value, bool):
        require(abs(value) < _LARGEST_INT, f"{name} must be a whole number below 2**53, got {value!r}.")
    if hint is int and isinstance(value, float) and value.is_integer():
        return int(value)  # 2e5 is a natural way to write a budget
    if type(value) is not hint:
        raise ValueError(f"{name} must be of type {hint.__name__}, got {value!r}.")
    return value


def _has_choices(hint: Any) -> bool:
    return any(typing.get_origin(option) is Literal for option in typing.get_args(hint))


def require(condition: bool, message: str) -> None:
    """Raises ValueError with the message unless the condition holds."""
    if not condition:
        raise ValueError(message)
