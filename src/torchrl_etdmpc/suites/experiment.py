"""Experiments: tasks x seeds x variants, as a small file, and the runs that it comes to."""

from __future__ import annotations

import dataclasses
import difflib
import re
import typing
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import yaml

from torchrl_etdmpc.analysis import BENCHMARKS
from torchrl_etdmpc.envs import DMC_TASKS, get_task
from torchrl_etdmpc.runs import DamagedFileError, RunDirectory
from torchrl_etdmpc.runs.dotted import flat, put
from torchrl_etdmpc.runs.files import read_whole, write_whole
from torchrl_etdmpc.training import CHANGEABLE, TrainConfig, preset, read_run_config
from torchrl_etdmpc.training.config import typed_name

TASK_SETS: dict[str, tuple[str, ...]] = {
    **{name: benchmark.tasks for name, benchmark in BENCHMARKS.items()},
    "dmc": DMC_TASKS,
}
"""Tasks by the name of their set."""
_FILE_BYTES = 2**20
_THE_SUITES_OWN = ("task", "seed", "run_dir", "resume")


class _Loader(yaml.SafeLoader):
    """YAML in which ``1e-3`` is a number, which PyYAML takes for text, and no name stands twice."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        keys = [key for key, _ in node.value if key.tag != "tag:yaml.org,2002:merge"]  # <<: *shared
        names = [self.construct_object(key, deep=True) for key in keys]
        doubled = next((name for place, name in enumerate(names) if name in names[:place]), None)
        if doubled is not None:
            raise ValueError(f"{doubled!r} stands twice, at line {node.start_mark.line + 1} and after it.")
        return super().construct_mapping(node, deep=deep)


class _Dumper(yaml.SafeDumper):
    """Puts in quotes what the loader would take for a number."""


for _kind in (_Loader, _Dumper):
    _kind.add_implicit_resolver(
        "tag:yaml.org,2002:float", re.compile(r"[-+]?\d+(\.\d*)?[eE][-+]?\d+$"), list("-+0123456789")
    )


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
        _require(bool(self.space), "search must name at least one setting, got none.")
        _require(type(self.trials) is int and self.trials > 0, f"trials must be a number, got {self.trials!r}.")
        _require(type(self.prune) is bool, f"prune must be true or false, got {self.prune!r}.")
        for name, values in self.space.items():
            known = name not in _THE_SUITES_OWN and name != "preset"
            _require(known, f"search cannot look for {name}; make a variant for each.")
            _require(
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
            _require(bool(entries), f"{what} of experiment {self.name} must not be empty.")
            doubled = [entry for entry in entries if list(entries).count(entry) > 1]
            _require(not doubled, f"{what} of experiment {self.name} must differ, got {doubled[:1]} more than once.")
        for name in names:
            _require(
                bool(re.fullmatch(r"\w[^/\\:=,]{0,99}", name)) and name.isprintable() and name == name.strip(),
                f"a variant's name becomes a folder's: it begins with a letter or a digit and has none of / \\ : = and "
                f"commas, got {name!r}.",
            )
        _require(
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
            _require(isinstance(name, str), f"preset must be a name, got {name!r}.")
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
        _require(len({run.path for run in runs}) == len(runs), "two tasks must not differ by / and _ alone.")
        return runs


def read_experiment(
    file: Path, *, tasks: Any = None, seeds: Any = None, settings: Mapping[str, Any] | None = None
) -> Experiment:
    """An experiment from its file.

    .. code-block:: yaml

        title: Small networks with a learning rate of their own   # optional, as are source, base and settings
        tasks: dmc-easy            # a set, or a list: [walker-walk, gym/Hopper-v5]
        seeds: 3                   # how many (1, 2, 3), or a list: [7, 8]
        budget: 100000             # env steps of each run, or benchmark
        settings: {preset: cpu}    # of all variants
        variants:
          cpu: {}
          two heads: {model.num_dynamics: 2}
          tuned:                   # a search: each trial is a variant, "tuned trial 0" and so on
            search:
              optim.lr: {low: 1e-4, high: 3e-3, log: true}
              model.mlp_dim: [64, 128]
            trials: 20
            prune: true            # end a trial early whose best return so far is below the median of those before it
        base: cpu                  # the one that reports compare the others with

    Args:
        file (Path): YAML as above.

    Keyword Args:
        tasks (str or list of str, optional): instead of the file's.
        seeds (int or list of int, optional): instead of the file's.
        settings (mapping, optional): added to the file's and to every variant's, whose own they replace.

    Raises:
        ValueError: if the file cannot be read, or says what it may not. It may hold the path of a task or a score of
            one's own, but only the command line can make this process follow it.

    >>> import tempfile
    >>> file = Path(tempfile.mkdtemp()) / "mine.yaml"
    >>> _ = file.write_text("{tasks: [walker-walk], seeds: 2, budget: 50000, variants: {cpu: {preset: cpu}}}")
    >>> experiment = read_experiment(file, seeds=3)
    >>> experiment.name, experiment.seeds
    ('mine', (1, 2, 3))
    """
    try:
        values = yaml.load(read_whole(file, _FILE_BYTES), _Loader)
    except (DamagedFileError, yaml.YAMLError, UnicodeDecodeError, RecursionError, ValueError) as error:
        raise ValueError(f"{file} is not an experiment: {' '.join(str(error).split())}") from error
    _require(isinstance(values, dict), f"{file} must hold entries such as tasks, seeds and variants.")
    known = {"tasks", "seeds", "variants", "settings", "budget", "base", "title", "source"}
    unknown = sorted(map(str, set(values) - known))
    _require(not unknown, f"{file} has an unknown entry {', '.join(unknown[:1])}; known: {', '.join(sorted(known))}.")
    shared = _settings(values.get("settings"), f"settings of {file}")
    _require(
        values.get("budget", "benchmark") == "benchmark" or "total_env_steps" not in shared,
        f"{file} says budget and, in its settings, total_env_steps, which are the same; leave one out.",
    )
    more = _spelled(settings or {})
    budget: Any = more.get("total_env_steps", shared.pop("total_env_steps", values.get("budget", "benchmark")))
    budget = int(budget) if isinstance(budget, float) and budget.is_integer() else budget
    _require(
        budget == "benchmark" or (type(budget) is int and budget > 0),
        f"budget of {file} must be a number of env steps or 'benchmark', got {budget!r}.",
    )
    variants, searches = _variants(values.get("variants"), more, file)
    more.pop("total_env_steps", None)
    return Experiment(
        name=file.stem,
        tasks=_tasks(values.get("tasks") if tasks is None else tasks, file),
        seeds=_seeds(values.get("seeds"), file) if seeds is None else _seeds(seeds, "this call"),
        variants=variants,
        searches=searches,
        settings=shared | more,
        budget=budget,
        base=None if values.get("base") is None else str(values["base"]),
        title=str(values.get("title", "")),
        source=str(values.get("source", "")),
    )


def find_experiment(name: str, folder: Path) -> Path:
    """The file of an experiment: a path to one, or the name of one in ``folder``.

    Raises:
        ValueError: if there is none; the message holds the nearest names.

    >>> import tempfile
    >>> folder = Path(tempfile.mkdtemp())
    >>> _ = (folder / "mine.yaml").write_text("")
    >>> find_experiment("mine", folder).name
    'mine.yaml'
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


def write_experiment(experiment: Experiment, file: Path) -> None:
    """Writes what :func:`read_experiment` reads, whole or not at all.

    >>> import tempfile
    >>> file = Path(tempfile.mkdtemp()) / "experiment.yaml"
    >>> write_experiment(Experiment("heads", ("walker-walk",), (1, 2), {"cpu": {"preset": "cpu"}}), file)
    >>> read_experiment(file).seeds
    (1, 2)
    """
    text = yaml.dump(experiment.to_dict(), Dumper=_Dumper, sort_keys=False, allow_unicode=True)
    write_whole(file, text)


def _variants(given: Any, more: Mapping[str, Any], file: Path) -> tuple[dict[str, dict[str, Any]], dict[str, Search]]:
    """Those with fixed settings, and those that are searched; with what the command adds to each."""
    _require(given is None or isinstance(given, dict), f"variants of {file} must be settings by name, got {given!r}.")
    variants: dict[str, dict[str, Any]] = {}
    searches: dict[str, Search] = {}
    for name, settings in (given or {}).items():
        _require(
            isinstance(name, str), f"variants of {file} must have texts for names, got {name!r}; put it in quotes."
        )
        what = f"variant {name} of {file}"
        if not (isinstance(settings, dict) and "search" in settings):
            variants[name] = _replaced(_settings(settings, what), more)
            continue
        _require(isinstance(settings["search"], dict), f"{what} must search settings by name.")
        fixed = dict(settings)
        space, trials, prune = _spelled(fixed.pop("search")), fixed.pop("trials", None), fixed.pop("prune", True)
        shared = _replaced(_settings(fixed, what), more)
        both = sorted(set(map(str, space)) & set(shared))
        _require(not both, f"{what} searches {', '.join(both)}, which is given as well.")
        try:
            searches[name] = Search(space, trials, shared, prune)
        except ValueError as error:
            raise ValueError(f"{what}: {error}") from error
    return variants, searches


def _replaced(own: dict[str, Any], more: Mapping[str, Any]) -> dict[str, Any]:
    """A variant's settings under those of a command, whose env steps are the budget unless the variant has its own."""
    return own | {name: value for name, value in more.items() if name != "total_env_steps" or name in own}


def _is_range(values: Mapping[str, Any]) -> bool:
    """Whether a search's entry has two ends in the right order."""
    low: Any = values.get("low")
    high: Any = values.get("high")
    log = values.get("log", False)
    numbers = all(type(end) in (int, float) for end in (low, high))
    known = set(values) <= {"low", "high", "log"} and type(log) is bool
    return numbers and known and low < high and (low > 0 or not log)


def _settings(values: Any, what: str) -> dict[str, Any]:
    """Settings by their dotted names, however they were nested."""
    _require(values is None or isinstance(values, Mapping), f"{what} must be settings by name, got {values!r}.")
    settings = flat(values or {})
    for name in settings:
        _require(
            name == typed_name(name) or typed_name(name) not in settings,
            f"{what} sets {name} and {typed_name(name)}, which are the same; leave one out.",
        )
        _require(name not in _THE_SUITES_OWN, f"{what} sets {name}, which a suite gives each run itself.")
    return _spelled(settings)


def _spelled(settings: Mapping[Any, Any]) -> dict[Any, Any]:
    """Settings by one name each: those of the task as a command line writes them."""
    return {typed_name(name): value for name, value in settings.items()}


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
        f"seeds of {what} must be a list of numbers or how many, at least 1, got {given!r}.",
    )
    return tuple(seeds)


def _folder(task: str) -> str:
    """A task as the name of a folder.

    >>> _folder("gym/Pendulum-v1")
    'gym_Pendulum-v1'
    """
    return re.sub(r"[/:\\]", "_", task)


def _require(condition: bool, message: str) -> None:
    if not condition:
        raise ValueError(message)
