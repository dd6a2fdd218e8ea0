"""Experiments and runs that were begun before: what may be added to them, and what may not have changed."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from pathlib import Path

from torchrl_etdmpc.runs import RunDirectory
from torchrl_etdmpc.runs.dotted import flat
from torchrl_etdmpc.suites.experiment import Experiment, Run
from torchrl_etdmpc.training import CHANGEABLE, TrainConfig, read_run_config
from torchrl_etdmpc.training.config import typed_name


def extended(stored: Experiment, asked: Experiment, folder: Path) -> Experiment:
    """An experiment that a folder was begun with, and what a command adds: tasks, seeds, variants, budget.

    Args:
        stored (Experiment): the folder's.
        asked (Experiment): the command's; what it leaves out stays part of the experiment.
        folder (Path): for the message.

    Raises:
        ValueError: if a run that belongs to both would train with other settings; the message names the first.

    >>> stored = Experiment("heads", ("walker-walk",), (1,), {"cpu": {"preset": "cpu"}}, budget=50_000)
    >>> asked = Experiment("heads", ("walker-walk",), (1, 2), {"cpu": {"preset": "cpu"}}, budget=50_000)
    >>> extended(stored, asked, Path("runs/heads")).seeds
    (1, 2)
    """
    for name, search in asked.searches.items():
        before = dataclasses.replace(stored.searches.get(name, search), trials=search.trials, prune=search.prune)
        uses = [(set(one.tasks), set(one.seeds), one.budget) for one in (stored, asked)]
        if name in stored.searches and not (uses[0] == uses[1] and before == search):
            raise ValueError(
                f"experiment {asked.name} was begun in {folder} with another space, other tasks, seeds or budget for "
                f"the search {name!r}, whose trials would not compare; choose another runs_dir for the changed one."
            )
    both = dataclasses.replace(
        asked,
        tasks=tuple(dict.fromkeys((*stored.tasks, *asked.tasks))),
        seeds=tuple(dict.fromkeys((*stored.seeds, *asked.seeds))),
        variants={**stored.variants, **asked.variants},
        searches={**stored.searches, **asked.searches},
        base=asked.base or stored.base,
    )
    for task in stored.tasks:
        before, now = (
            {name: one.config(name, task, stored.seeds[0]) for name in stored.variants} | dict(one.proposals(task))
            for one in (stored, both)
        )
        for name, old in before.items():  # of a search the last point, which stands for all
            new = now[name]
            changed = _changed(old, new)
            if new.total_env_steps < old.total_env_steps:
                changed = f"total_env_steps={old.total_env_steps}", f"{new.total_env_steps}, which is less"
            if changed:
                raise ValueError(
                    f"experiment {asked.name} was begun in {folder} with {changed[0]} for variant {name!r}, now it is "
                    f"{changed[1]}; choose another runs_dir for the changed one."
                )
    return both


def require_unchanged(runs: Iterable[Run]) -> None:
    """Refuses to go on with runs that were begun with other settings, as by a version whose presets differ.

    Args:
        runs (iterable of Run): of an experiment; those that have not begun are passed over.

    Raises:
        ValueError: naming the first one, its setting and both values.

    >>> experiment = Experiment("heads", ("walker-walk",), (1,), {"cpu": {"preset": "cpu"}}, budget=50_000)
    >>> require_unchanged(experiment.runs(Path("runs/nowhere")))
    """
    for run in runs:
        directory = RunDirectory(run.path)
        if not directory.config.exists():
            continue
        try:
            changed = _changed(read_run_config(directory), run.config)
        except ValueError:  # one that cannot be gone on with says so itself, and stops no other
            continue
        if changed and not directory.leftover:
            raise ValueError(
                f"{run.path} was begun with {changed[0]}, now it is {changed[1]}; choose another runs_dir for the "
                "changed one."
            )


def _changed(old: TrainConfig, new: TrainConfig) -> tuple[str, str] | None:
    """The first setting that differs and may not: with its old value as it is typed, and the new value."""
    before, now = flat(old.to_dict()), flat(new.to_dict())
    for name, value in now.items():
        if before[name] != value and name not in CHANGEABLE:
            return f"{typed_name(name)}={before[name]}", str(value)
    return None
