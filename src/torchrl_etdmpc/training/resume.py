"""The configuration of a run that goes on: the run's own, with what may change on the way."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from torchrl_etdmpc.training.config import TrainConfig

CHANGEABLE = {
    "resume",
    "run_dir",
    "total_env_steps",
    "device",
    "threads",
    "compile",
    "logger",
    "checkpoint_every",
    "checkpoint_minutes",
    "checkpoint_keep",
}


def read_run_config(run_dir: str | Path) -> TrainConfig:
    """The configuration in a run directory.

    Raises:
        FileNotFoundError: if there is none.
        ValueError: if it is not a configuration of this version.
    """
    import yaml

    path = Path(run_dir).expanduser() / "config.yaml"
    if not path.is_file():
        raise FileNotFoundError(f"run_dir={run_dir} holds no run to go on with; start it with resume=off.")
    try:
        return TrainConfig.from_dict(yaml.safe_load(path.read_text(encoding="utf-8")))
    except (yaml.YAMLError, ValueError, TypeError) as error:
        raise ValueError(f"{path} is not a configuration of this version: {error}") from error


def resumed_config(saved: TrainConfig, asked: TrainConfig, explicit: Iterable[str]) -> TrainConfig:
    """The saved configuration with the settings that may change.

    Args:
        saved (TrainConfig): of the run directory.
        asked (TrainConfig): of this command.
        explicit (iterable of str): settings that the command names, e.g. ``planner.horizon``; the others are taken
            from the run.

    Raises:
        ValueError: if the command names a setting with another value than the run's, and it may not change.
    """
    values, wanted = _flat(saved.to_dict()), _flat(asked.to_dict())
    for name in explicit:
        if name in CHANGEABLE:
            values[name] = wanted[name]
        elif values[name] != wanted[name]:
            raise ValueError(
                f"{name}={wanted[name]} was asked for, but this run was started with {name}={values[name]}; leave it "
                "out to go on, or start a new run_dir."
            )
    return TrainConfig.from_dict(_nested(values))


def _flat(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in values.items():
        flat |= _flat(value, f"{prefix}{name}.") if isinstance(value, dict) else {f"{prefix}{name}": value}
    return flat


def _nested(values: dict[str, Any]) -> dict[str, Any]:
    nested: dict[str, Any] = {}
    for name, value in values.items():
        *groups, last = name.split(".")
        target = nested
        for group in groups:
            target = target.setdefault(group, {})
        target[last] = value
    return nested
