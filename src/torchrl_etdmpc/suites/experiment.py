"""Experiments: tasks x seeds x variants, as a small file, and the runs that it comes to."""

from __future__ import annotations

import dataclasses
import difflib
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import yaml

from torchrl_etdmpc.analysis import BENCHMARKS
from torchrl_etdmpc.envs import DMC_TASKS
from torchrl_etdmpc.runs import DamagedFileError
from torchrl_etdmpc.runs.files import read_whole, write_whole
from torchrl_etdmpc.training import CHANGEABLE, TASK_SETTINGS, TrainConfig, preset

TASK_SETS: dict[str, tuple[str, ...]] = {
    **{name: benchmark.tasks for name, benchmark in BENCHMARKS.items()},
    "dmc": DMC_TASKS,
}
"""Tasks by the name of their set."""
_FILE_BYTES = 2**20
_THE_SUITES_OWN = ("task", "seed", "run_dir", "resume")


@dataclass(frozen=True)
class Run:
    """One run of an experiment.

    Args:
        variant (str): its name.
        task (str): its task.
        seed (int): its seed.
        path (Path): its run directory.
        config (TrainConfig): all of its settings.
    """

    variant: str
    task: str
    seed: int
    path: Path
    config: TrainConfig

    @property
    def name(self) -> str:
        """As tables and messages call it."""
        return f"{self.variant}/{self.task}/seed{self.seed}"


@dataclass(frozen=True)
class Experiment:
    """What is to be compared on what.

    Args:
        name (str): by which commands know it.
        tasks (tuple of str): their names.
        seeds (tuple of int): each task is trained with each of them.
        variants (mapping): settings by the name of the variant, e.g. ``{"one head": {"model.num_dynamics": 1}}``;
            ``preset`` may be one of them.
        settings (mapping): of all variants; a variant's own come after them.
        budget (int or "benchmark"): env steps of each run, or those of the benchmark that a task belongs to.
        base (str, optional): the variant that reports compare the others with. Default: the first.
        title (str): one line for reports.
        source (str): where the comparison comes from.

    Raises:
        ValueError: if something is missing, doubled or of the wrong kind; the message names the entry.
    """

    name: str
    tasks: tuple[str, ...]
    seeds: tuple[int, ...]
    variants: Mapping[str, Mapping[str, Any]]
    settings: Mapping[str, Any] = field(default_factory=dict)
    budget: int | Literal["benchmark"] = "benchmark"
    base: str | None = None
    title: str = ""
    source: str = ""

    def __post_init__(self) -> None:
        for what in ("tasks", "seeds", "variants"):
            entries = list(getattr(self, what))
            _require(bool(entries), f"{what} of experiment {self.name} must not be empty.")
            doubled = [entry for entry in entries if entries.count(entry) > 1]
            _require(not doubled, f"{what} of experiment {self.name} must differ, got {doubled[:1]} more than once.")
        for name in self.variants:
            _require(
                name not in (".", "..") and not set("/\\:=,") & set(name) and name == name.strip(),
                f"a variant's name becomes a folder's, so it has none of / \\ : = and commas, got {name!r}.",
            )
        _require(
            self.base is None or self.base in self.variants,
            f"base of experiment {self.name} must be one of {', '.join(self.variants)}, got {self.base!r}.",
        )

    def to_dict(self) -> dict[str, Any]:
        """Plain values, as a file holds them."""
        return {
            "title": self.title,
            "source": self.source,
            "tasks": list(self.tasks),
            "seeds": list(self.seeds),
            "budget": self.budget,
            "settings": dict(self.settings),
            "variants": {name: dict(settings) for name, settings in self.variants.items()},
            "base": self.base or next(iter(self.variants)),
        }

    def config(self, variant: str, task: str, seed: int) -> TrainConfig:
        """All settings of one run, checked.

        Raises:
            ValueError: if a setting is unknown or out of range; the message names the variant.
        """
        settings = {**self.settings, **self.variants[variant]}
        try:
            values = preset(settings.pop("preset", "efficient-tdmpc")).to_dict()
            settings.setdefault("total_env_steps", self._budget(task))
            for name, value in settings.items():
                _put(values, name, value)
            return TrainConfig.from_dict({**values, "task": task, "seed": seed})
        except ValueError as error:
            raise ValueError(f"variant {variant!r} of experiment {self.name}: {error}") from error

    def _budget(self, task: str) -> int:
        if self.budget != "benchmark":
            return self.budget
        for benchmark in BENCHMARKS.values():
            if task in benchmark.tasks:
                return benchmark.budget
        raise ValueError(f"{task} is of no benchmark, so budget must be a number of env steps.")

    def runs(self, folder: Path) -> list[Run]:
        """Every run, each in a directory of its own below ``folder``: ``variant/task/seedN``.

        Raises:
            ValueError: as :meth:`config` does, before anything is made.
        """
        return [
            Run(variant, task, seed, folder / variant / _folder(task) / f"seed{seed}", self.config(variant, task, seed))
            for variant in self.variants
            for task in self.tasks
            for seed in self.seeds
        ]


def read_experiment(file: Path, **changes: Any) -> Experiment:
    """An experiment from its file; ``changes`` take the place of what the file says.

    Args:
        file (Path): YAML with ``tasks`` (a list, or the name of a set such as ``dmc-easy``), ``seeds`` (a list, or how
            many), ``variants``, and optionally ``settings``, ``budget``, ``base``, ``title`` and ``source``.
        **changes: ``tasks`` and ``seeds`` in the same forms; ``settings`` are added to the file's and to every
            variant's, whose own they replace.

    Raises:
        ValueError: if the file cannot be read, or says what it may not: it never names code or directories.
    """
    try:
        values = yaml.safe_load(read_whole(file, _FILE_BYTES))
    except (DamagedFileError, yaml.YAMLError, UnicodeDecodeError, RecursionError) as error:
        raise ValueError(f"{file} is not an experiment: {' '.join(str(error).split())}") from error
    _require(isinstance(values, dict), f"{file} must hold entries such as tasks, seeds and variants.")
    known = {"tasks", "seeds", "variants", "settings", "budget", "base", "title", "source"}
    unknown = sorted(map(str, set(values) - known))
    _require(not unknown, f"{file} has an unknown entry {', '.join(unknown[:1])}; known: {', '.join(sorted(known))}.")
    variants = values.get("variants") or {}
    _require(isinstance(variants, dict), f"variants of {file} must be settings by name.")
    variants = {str(name): _settings(settings, f"variant {name} of {file}") for name, settings in variants.items()}
    settings = _settings(values.get("settings"), f"settings of {file}")
    tasks = _tasks(values.get("tasks"), file)
    _require(not any(":" in task for task in tasks), f"{file} names code in its tasks; give it as tasks=... instead.")
    more = dict(changes.get("settings") or {})
    budget = more.pop("total_env_steps", values.get("budget", "benchmark"))
    _require(
        budget == "benchmark" or (type(budget) is int and budget > 0),
        f"budget of {file} must be a number of env steps or 'benchmark', got {budget!r}.",
    )
    return Experiment(
        name=file.stem,
        tasks=_tasks(changes["tasks"], file) if changes.get("tasks") else tasks,
        seeds=_seeds(changes.get("seeds") or values.get("seeds"), file),
        variants={name: own | more for name, own in variants.items()},
        settings=settings | more,
        budget=budget,
        base=values.get("base"),
        title=str(values.get("title", "")),
        source=str(values.get("source", "")),
    )


def find_experiment(name: str, folder: Path) -> Path:
    """The file of an experiment: a path to one, or the name of one in ``folder``.

    Raises:
        ValueError: if there is none; the message holds the nearest names.
    """
    if name.endswith((".yaml", ".yml")):
        path = Path(name).expanduser()
        _require(path.is_file(), f"experiment={name} is not a file.")
        return path
    known = {file.stem: file for file in sorted(folder.glob("*.yaml"))}
    nearest = difflib.get_close_matches(name, known, n=3, cutoff=0.5)
    hint = f"did you mean {' or '.join(nearest)}?" if nearest else f"there are {', '.join(known)}."
    _require(name in known, f"unknown experiment {name!r}; {hint} A path to a .yaml file does as well.")
    return known[name]


def extended(stored: Experiment, asked: Experiment, folder: Path) -> Experiment:
    """An experiment that a folder was begun with, and what a command adds: tasks, seeds, variants, budget.

    Args:
        stored (Experiment): the folder's.
        asked (Experiment): the command's; what it leaves out stays part of the experiment.
        folder (Path): for the message.

    Raises:
        ValueError: if a run that belongs to both would train with other settings; the message names the first.
    """
    both = dataclasses.replace(
        asked,
        tasks=tuple(dict.fromkeys((*stored.tasks, *asked.tasks))),
        seeds=tuple(dict.fromkeys((*stored.seeds, *asked.seeds))),
        variants={**stored.variants, **asked.variants},
    )
    for variant in stored.variants:
        for task in stored.tasks:
            old, new = (flat(one.config(variant, task, stored.seeds[0]).to_dict()) for one in (stored, both))
            changed = [name for name in new if old.get(name) != new[name] and name not in CHANGEABLE]
            if changed:
                name = f"task.{changed[0]}" if changed[0] in TASK_SETTINGS else changed[0]
                raise ValueError(
                    f"experiment {asked.name} was begun in {folder} with {name}={old.get(changed[0])} for variant "
                    f"{variant!r}, now it is {new[changed[0]]}; choose another runs_dir for the changed one."
                )
    return both


def write_experiment(experiment: Experiment, file: Path) -> None:
    """Writes what :func:`read_experiment` reads, whole or not at all."""
    write_whole(file, yaml.safe_dump(experiment.to_dict(), sort_keys=False, allow_unicode=True))


def _settings(values: Any, what: str) -> dict[str, Any]:
    """Settings by their dotted names, however they were nested."""
    _require(values is None or isinstance(values, Mapping), f"{what} must be settings by name, got {values!r}.")
    settings = flat(values or {})
    for name in settings:
        _require(name not in _THE_SUITES_OWN, f"{what} sets {name}, which a suite gives each run itself.")
    return settings


def _tasks(given: Any, what: object) -> tuple[str, ...]:
    names = [given] if isinstance(given, str) else given
    _require(
        isinstance(names, Iterable) and all(isinstance(name, str) for name in names),
        f"tasks of {what} must be a list of tasks or one of {', '.join(TASK_SETS)}, got {given!r}.",
    )
    return tuple(task for name in names for task in TASK_SETS.get(name, (name,)))


def _seeds(given: Any, what: object) -> tuple[int, ...]:
    seeds = range(1, given + 1) if type(given) is int else given
    _require(
        isinstance(seeds, Iterable) and all(type(seed) is int for seed in seeds) and bool(list(seeds)),
        f"seeds of {what} must be a list of numbers or how many, got {given!r}.",
    )
    return tuple(seeds)


def _folder(task: str) -> str:
    """A task as the name of a folder.

    >>> _folder("gym/Pendulum-v1")
    'gym_Pendulum-v1'
    """
    return re.sub(r"[/:\\]", "_", task)


def _put(values: dict[str, Any], name: str, value: Any) -> None:
    *groups, last = name.removeprefix("task.").split(".")
    for group in groups:
        values = values.setdefault(group, {})
        _require(isinstance(values, dict), f"unknown setting {name}; {group} has none below it.")
    values[last] = value


def flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested settings by their dotted names."""
    found: dict[str, Any] = {}
    for name, value in values.items():
        found |= flat(value, f"{prefix}{name}.") if isinstance(value, Mapping) else {f"{prefix}{name}": value}
    return found


def _require(condition: bool, message: str) -> None:
    if not condition:
        raise ValueError(message)
