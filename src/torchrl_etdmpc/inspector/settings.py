"""A planner's settings: read from its constructor, so that whatever it takes can be shown and changed."""

from __future__ import annotations

import inspect
import types
import typing
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import torch
from tensordict import NestedKey

from torchrl_etdmpc.keys import LOC
from torchrl_etdmpc.planners import EnsembleMPPIPlanner, FunctionScore
from torchrl_etdmpc.planners.scores import SCORES

__all__ = ["PlannerSetting", "plain_settings", "planner_settings", "settings_of_class", "with_settings"]

Kind = Literal["whole", "number", "switch", "choice", "other"]


class PlannerSetting(NamedTuple):
    """One argument of a planner."""

    name: str
    kind: Kind
    """``"other"`` for what is neither a number, a switch nor a choice."""
    choices: tuple[Any, ...]
    """Of a choice."""
    optional: bool
    """Whether it may be ``None``."""
    default: Any


def settings_of_class(planner_class: type) -> dict[str, PlannerSetting]:
    """The arguments of a planner's constructor, the environment and the keys of tensordicts left out.

    Where a subclass hands ``**kwargs`` on, its base's arguments follow its own.

    Args:
        planner_class (type): e.g. :class:`~torchrl_etdmpc.planners.EnsembleMPPIPlanner`.

    >>> settings_of_class(EnsembleMPPIPlanner)["score"].choices
    ('final', 'mean', 'adaptive')
    """
    return {
        name: _setting(parameter, hint)
        for name, (parameter, hint) in _arguments(planner_class).items()
        if not name.endswith("_key")
    }


def planner_settings(planner: EnsembleMPPIPlanner) -> dict[str, Any]:
    """What a planner was made with, by the names of its constructor's arguments.

    Args:
        planner (EnsembleMPPIPlanner): or a subclass, each of whose arguments is an attribute of the same name.

    Raises:
        TypeError: if it takes an argument that it does not keep.

    >>> from torchrl_etdmpc import LatentEnv
    >>> from torchrl_etdmpc.testing import LineWorld
    >>> planner_settings(EnsembleMPPIPlanner(LatentEnv(LineWorld()), score="final", beta=2.0))["beta"]
    2.0
    """
    values = {}
    for name in settings_of_class(type(planner)):
        if name in _DERIVED:
            values[name] = _DERIVED[name](planner)
        elif hasattr(planner, name):
            values[name] = getattr(planner, name)
        else:
            raise TypeError(
                f"{type(planner).__name__} takes {name} and has no attribute of that name; keep it as self.{name}, so "
                "that it can be shown and changed."
            )
    return values


def with_settings(planner: EnsembleMPPIPlanner, **changes: Any) -> EnsembleMPPIPlanner:
    """The same networks, planned over with other settings; the planner itself stays as it is.

    Args:
        planner (EnsembleMPPIPlanner): or a subclass.
        **changes: arguments of its constructor, which checks them.

    Raises:
        ValueError: if there is no such argument, or the constructor refuses a value.

    >>> from torchrl_etdmpc import LatentEnv
    >>> from torchrl_etdmpc.testing import LineWorld
    >>> planner = EnsembleMPPIPlanner(LatentEnv(LineWorld()), horizon=3)
    >>> with_settings(planner, horizon=5).horizon, planner.horizon
    (5, 3)
    """
    values = planner_settings(planner)
    unknown = sorted(changes.keys() - values.keys())
    if unknown:
        raise ValueError(f"planner has no setting {unknown[0]!r}; it has {', '.join(values)}.")
    keys = {name: key for name, key in _keys(planner).items() if name in _arguments(type(planner))}
    return type(planner)(planner.env, **keys, **values | changes)


def plain_settings(planner: EnsembleMPPIPlanner) -> dict[str, Any]:
    """:func:`planner_settings` as numbers and text, e.g. for a manifest.

    >>> from torchrl_etdmpc import LatentEnv
    >>> from torchrl_etdmpc.testing import LineWorld
    >>> planner = EnsembleMPPIPlanner(LatentEnv(LineWorld()), scoring_dtype="float64")
    >>> plain_settings(planner)["scoring_dtype"]
    'float64'
    """
    return {name: _plain(value) for name, value in planner_settings(planner).items()}


def _plain(value: Any) -> Any:
    if isinstance(value, torch.dtype):
        return str(value).removeprefix("torch.")
    if isinstance(value, FunctionScore):
        return getattr(value.function, "__name__", repr(value.function))
    return value if value is None or isinstance(value, bool | int | float | str) else repr(value)


def _arguments(planner_class: type) -> dict[str, tuple[inspect.Parameter, Any]]:
    """Arguments behind the environment with their types, those that ``**kwargs`` hands on to a base included."""
    found: dict[str, tuple[inspect.Parameter, Any]] = {}
    for base in planner_class.__mro__:
        if "__init__" not in vars(base):
            continue
        hints = typing.get_type_hints(vars(base)["__init__"])
        parameters = list(inspect.signature(vars(base)["__init__"]).parameters.values())
        for parameter in parameters[2:]:  # without self and env
            if parameter.kind in (parameter.KEYWORD_ONLY, parameter.POSITIONAL_OR_KEYWORD):
                found.setdefault(parameter.name, (parameter, hints.get(parameter.name, type(parameter.default))))
        if not any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters):
            break
    return found


def _keys(planner: EnsembleMPPIPlanner) -> dict[str, NestedKey | None]:
    fields = planner.plan_keys[LOC]
    return {
        "observation_key": planner.observation_key,
        "latent_key": planner.latent_key,
        "action_key": planner.action_key,
        "is_init_key": planner.is_init_key,
        "plan_mean_key": planner.plan_mean_key,
        "plan_key": fields[0] if len(fields) == 2 else fields[:-1],
    }


def _setting(parameter: inspect.Parameter, hint: Any) -> PlannerSetting:
    options = typing.get_args(hint) if typing.get_origin(hint) in (types.UnionType, typing.Union) else (hint,)
    choices = tuple(
        choice for option in options if typing.get_origin(option) is Literal for choice in typing.get_args(option)
    )
    kinds: dict[Any, Kind] = {bool: "switch", int: "whole", float: "number"}
    kind: Kind = "choice" if choices else "other"
    for option in () if choices else options:
        kind = kinds.get(option, kind)
    default = None if parameter.default is parameter.empty else parameter.default
    return PlannerSetting(parameter.name, kind, choices, type(None) in options, default)


def _score(planner: EnsembleMPPIPlanner) -> Any:
    """The name of a named score, or the score itself."""
    names: dict[type, str] = {kind: name for name, kind in SCORES.items() if isinstance(kind, type)}
    return names.get(type(planner.score), planner.score)


def _extra_iterations(planner: EnsembleMPPIPlanner) -> int:
    return planner.extra_iterations if planner.world_model.action_dim > planner.large_action_dim else 0


# What the planner keeps in another form than it was given.
_DERIVED: dict[str, Callable[[EnsembleMPPIPlanner], Any]] = {
    "score": _score,
    "beta": lambda planner: getattr(planner.score, "beta", 0.0) if isinstance(_score(planner), str) else 0.0,
    "iterations": lambda planner: planner.iterations - _extra_iterations(planner),
    "proposal_log_std_min": lambda planner: (planner.proposal_log_std_bounds or (None, None))[0],
    "proposal_log_std_max": lambda planner: (planner.proposal_log_std_bounds or (None, None))[1],
}
