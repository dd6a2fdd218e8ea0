"""Experiments: tasks x seeds x variants, and the runs that they come to."""

from __future__ import annotations

import dataclasses
import re
import typing
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from torchrl_etdmpc.analysis import BENCHMARKS
from torchrl_etdmpc.envs import get_task
from torchrl_etdmpc.runs.dotted import put
from torchrl_etdmpc.training import TrainConfig, preset
from torchrl_etdmpc.training.conversion import require

GIVEN_BY_THE_SUITE = ("task", "seed", "run_dir", "resume")
"""Settings that each run gets from its place in the experiment."""


@dataclass(frozen=True)
class Run:
    """One run of an experiment.

    Args:
        variant (str): its name.
        task (str): its task.
        seed (int): its seed.
        path (Path): its run directory.
        config (TrainConfig): all of its settings.

    >>> experiment = Experiment("heads", ("walker-walk",), (1,), {"cpu": {"preset": "cpu"}}, budget=50_000)
    >>> (run,) = experiment.runs(Path("runs/heads"))
    >>> str(run.path), run.config.total_env_steps
    ('runs/heads/cpu/walker-walk/seed1', 50000)
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
class Search:
    """A variant some of whose settings are looked for: each proposal is a trial, on all tasks and seeds.

    Args:
        space (mapping): by the name of a setting the values to choose from, ``[64, 128]``, or their range,
            ``{"low": 1e-4, "high": 3e-3, "log": True}``; a range between whole numbers, or of a setting that is one,
            holds whole numbers.
        trials (int): how many are made.
        settings (mapping): those that all trials share.
        prune (bool): whether a trial ends early whose best return so far is below the median of what those before it
            returned at the same step.

    Raises:
        ValueError: if the space is empty, or an entry is neither.

    >>> Search({"optim.lr": {"low": 1e-4, "high": 3e-3, "log": True}}, trials=20).prune
    True
    """

    space: Mapping[str, Any]
    trials: int
    settings: Mapping[str, Any] = field(default_factory=dict)
    prune: bool = True

    def __post_init__(self) -> None:
        require(bool(self.space), "search must name at least one setting, got none.")
        require(type(self.trials) is int and self.trials > 0, f"trials must be a number, got {self.trials!r}.")
        require(type(self.prune) is bool, f"prune must be true or false, got {self.prune!r}.")
        for name, values in self.space.items():
            known = name not in GIVEN_BY_THE_SUITE and name != "preset"
            require(known, f"search cannot look for {name}; make a variant for each.")
            require(
                _is_range(values) if isinstance(values, Mapping) else isinstance(values, list) and bool(values),
                f"search of {name} must be a list of values or low and high, with log: true or not, got {values!r}.",
            )

    def is_whole(self, name: str) -> bool:
        """Whether a range holds whole numbers: that of a setting that is one, or between two of them."""
        low, high = self.space[name]["low"], self.space[name]["high"]
        group, _, last = name.removeprefix("task.").rpartition(".")
        hints = typing.get_type_hints(TrainConfig)
        hint = (typing.get_type_hints(hints[group]) if group in hints else hints).get(last)
        counted = int in (hint, *typing.get_args(hint))
        return type(low) is type(high) is int or (counted and float(low).is_integer() and float(high).is_integer())

    def points(self) -> list[dict[str, Any]]:
        """Every value of a list and both ends of a range, one at a time.

        A value that is wrong by itself is so refused before anything is trained; two that do not go together are found
        when they are proposed.
        """
        ends = {
            name: [values["low"], values["high"]] if isinstance(values, Mapping) else values
            for name, values in self.space.items()
        }
        first = {name: values[0] for name, values in ends.items()}
        return [first, *(first | {name: value} for name, values in ends.items() for value in values[1:])]


@dataclass(frozen=True)
class Experiment:
    """What is to be compared on what.

    Args:
        name (str): by which commands know it.
        tasks (tuple of str): their names.
        seeds (tuple of int): each task is trained with each of them.
        variants (mapping): settings by the name of the variant, e.g. ``{"one head": {"model.num_dynamics": 1}}``;
            ``preset`` may be one of them.
        searches (mapping): :class:`Search` by the name of the variant that they look for.
        settings (mapping): of all variants; a variant's own come after them.
        budget (int or "benchmark"): env steps of each run, or those of the benchmark that a task belongs to.
        base (str, optional): the variant (no search) that reports compare the others with. Default: the first.
        title (str): one line for reports.
        source (str): where the comparison comes from.

    Raises:
        ValueError: if something is missing, doubled or of the wrong kind; the message names the entry.

    >>> heads = {"one": {"model.num_dynamics": 1}, "two": {"model.num_dynamics": 2}}
    >>> experiment = Experiment("heads", ("walker-walk",), (1, 2), heads, settings={"preset": "cpu"}, budget=50_000)
    >>> [f"{run.variant} {run.seed}" for run in experiment.runs(Path("runs/heads"))]
    ['one 1', 'one 2', 'two 1', 'two 2']
    """

    name: str
    tasks: tuple[str, ...]
    seeds: tuple[int, ...]
    variants: Mapping[str, Mapping[str, Any]]
    searches: Mapping[str, Search] = field(default_factory=dict)
    settings: Mapping[str, Any] = field(default_factory=dict)
    budget: int | Literal["benchmark"] = "benchmark"
    base: str | None = None
    title: str = ""
    source: str = ""

    def __post_init__(self) -> None:
        names = [*self.variants, *self.searches]
        for what, entries in {"tasks": self.tasks, "seeds": self.seeds, "variants": names}.items():
            require(bool(entries), f"{what} of experiment {self.name} must not be empty.")
            doubled = [entry for entry in entries if list(entries).count(entry) > 1]
            require(not doubled, f"{what} of experiment {self.name} must differ, got {doubled[:1]} more than once.")
        for name in names:
            require(
                bool(re.fullmatch(r"\w[^/\\:=,]{0,99}", name)) and name.isprintable() and name == name.strip(),
                f"a variant's name becomes a folder's: it begins with a letter or a digit and has none of / \\ : = and "
                f"commas, got {name!r}.",
            )
        require(
            self.base is None or self.base in self.variants,
            f"base of experiment {self.name} must be one of {', '.join(self.variants)}, got {self.base!r}.",
        )

    def to_dict(self) -> dict[str, Any]:
        """Plain values, as a file holds them."""
        searches = {
            name: {**search.settings, "search": dict(search.space), "trials": search.trials, "prune": search.prune}
            for name, search in self.searches.items()
        }
        return {
            "title": self.title,
            "source": self.source,
            "tasks": list(self.tasks),
            "seeds": list(self.seeds),
            "budget": self.budget,
            "settings": dict(self.settings),
            "variants": {name: dict(settings) for name, settings in self.variants.items()} | searches,
            "base": self.base or next(iter(self.variants), None),
        }

    def config(self, variant: str, task: str, seed: int) -> TrainConfig:
        """All settings of one run, checked.

        Raises:
            ValueError: if a setting is unknown or out of range; the message names the variant.
        """
        return self._config(variant, self.variants[variant], task, seed)

    def _config(self, variant: str, own: Mapping[str, Any], task: str, seed: int) -> TrainConfig:
        settings = {**self.settings, **own}
        try:
            name = settings.pop("preset", "efficient-tdmpc")
            require(isinstance(name, str), f"preset must be a name, got {name!r}.")
            values = preset(name).to_dict()
            settings.setdefault("total_env_steps", self._budget(task))
            for name, value in settings.items():
                put(values, name.removeprefix("task."), value)
            return TrainConfig.from_dict({**values, "task": task, "seed": seed})
        except ValueError as error:
            raise ValueError(f"variant {variant!r} of experiment {self.name}: {error}") from error

    def _budget(self, task: str) -> int:
        if self.budget != "benchmark":
            return self.budget
        for benchmark in BENCHMARKS.values():
            if task in benchmark.tasks:
                return benchmark.budget
        if ":" not in task:
            get_task(task)  # one that is misspelt is of no benchmark either
        raise ValueError(f"{task} is of no benchmark, so budget must be a number of env steps.")

    def proposals(self, task: str) -> list[tuple[str, TrainConfig]]:
        """Names of the searches and the settings that :meth:`Search.points` comes to on a task, checked."""
        return [
            (name, self._config(name, {**search.settings, **point}, task, self.seeds[0]))
            for name, search in self.searches.items()
            for point in search.points()
        ]

    def runs(self, folder: Path) -> list[Run]:
        """Every run of the variants, each in a directory of its own below ``folder``: ``variant/task/seedN``.

        Raises:
            ValueError: as :meth:`config` does, also for what a search may propose, before anything is made.
        """
        for task in self.tasks:
            self.proposals(task)
        runs = []
        for variant in self.variants:
            for task in self.tasks:
                place, config = folder / variant / _folder(task), self.config(variant, task, self.seeds[0])
                for seed in self.seeds:
                    own = dataclasses.replace(config, seed=seed)
                    runs.append(Run(variant, task, seed, place / f"seed{seed}", own))
        require(len({run.path for run in runs}) == len(runs), "two tasks must not differ by / and _ alone.")
        return runs


def _is_range(values: Mapping[str, Any]) -> bool:
    """Whether a search's entry has two ends in the right order."""
    low: Any = values.get("low")
    high: Any = values.get("high")
    log = values.get("log", False)
    numbers = all(type(end) in (int, float) for end in (low, high))
    known = set(values) <= {"low", "high", "log"} and type(log) is bool
    return numbers and known and low < high and (low > 0 or not log)


def _folder(task: str) -> str:
    """A task as the name of a folder.

    >>> _folder("gym/Pendulum-v1")
    'gym_Pendulum-v1'
    """
    return re.sub(r"[/:\\]", "_", task)
