"""Code of the user's own behind a setting: a score, terms of the loss."""

from __future__ import annotations

import typing
from collections.abc import Callable
from typing import Any

from torchrl_etdmpc.envs import import_attribute
from torchrl_etdmpc.planners import ScoreName

OWN_CODE = {
    "planner.score": "planner.score",
    "reanalyze.score": "reanalyze.score",
    "loss.extra_terms": "loss.extra_terms",
    # Of the commands that read an agent file.
    "score": "planner.score",
    "reanalyze_score": "reanalyze.score",
    "extra_terms": "loss.extra_terms",
}
"""Settings that may be a path to code, as a command line spells them, and the run's setting that each stands for."""

_followed: dict[tuple[str, str], Callable[..., Any]] = {}


def follow_own_code(name: str, value: str) -> None:
    """Imports the code that a command line names, if this setting does; not to be called with what a file holds.

    Args:
        name (str): the setting, as it was typed.
        value (str): its value.

    Raises:
        ValueError: if there is nothing at the path, or ``score`` names one of the package's scores.

    >>> follow_own_code("planner.score", "mean")  # no path, so nothing is imported
    """
    if name == "score" and value in typing.get_args(ScoreName):
        raise ValueError(
            f"score must be the path of the code that the agent was trained with, got {value!r}; leave it out. With "
            f"evaluate and inspect_planner, planner.score={value} plans with another score."
        )
    if name in OWN_CODE and (":" in value or (not name.endswith(".score") and value != "null")):
        _followed[OWN_CODE[name], value] = import_attribute(value, name)


def own_code(setting: str, path: str) -> Callable[..., Any]:
    """What the command line imported for a setting of the run.

    Raises:
        ValueError: if it did not: a stored configuration may hold a path, and no file may make us import code.
    """
    if (setting, path) not in _followed:
        short = next(name for name, meant in reversed(OWN_CODE.items()) if meant == setting)
        raise ValueError(
            f"{setting} {path!r} names code, which must be given on the command line: {setting}={path} to train, "
            f"{short}={path} with an agent file, code={path} of a suite. In Python, call "
            f"torchrl_etdmpc.training.follow_own_code({setting!r}, {path!r}) before."
        )
    return _followed[setting, path]
