"""Experiments as YAML files: reading, finding and writing them."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import yaml

from torchrl_etdmpc.analysis import BENCHMARKS
from torchrl_etdmpc.envs import DMC_TASKS
from torchrl_etdmpc.runs import DamagedFileError
from torchrl_etdmpc.runs.dotted import flat
from torchrl_etdmpc.runs.files import read_whole, write_whole
from torchrl_etdmpc.suites.experiment import GIVEN_BY_THE_SUITE, Experiment, Search
from torchrl_etdmpc.training.config import typed_name
from torchrl_etdmpc.training.conversion import require

TASK_SETS: dict[str, tuple[str, ...]] = {
    **{name: benchmark.tasks for name, benchmark in BENCHMARKS.items()},
    "dmc": DMC_TASKS,
}
"""Tasks by the name of their set."""
_FILE_BYTES = 2**20


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
    require(isinstance(values, dict), f"{file} must hold entries such as tasks, seeds and variants.")
    known = {"tasks", "seeds", "variants", "settings", "budget", "base", "title", "source"}
    unknown = sorted(map(str, set(values) - known))
    require(not unknown, f"{file} has an unknown entry {', '.join(unknown[:1])}; known: {', '.join(sorted(known))}.")
    shared = _settings(values.get("settings"), f"settings of {file}")
    require(
        values.get("budget", "benchmark") == "benchmark" or "total_env_steps" not in shared,
        f"{file} says budget and, in its settings, total_env_steps, which are the same; leave one out.",
    )
    more = _spelled(settings or {})
    budget: Any = more.get("total_env_steps", shared.pop("total_env_steps", values.get("budget", "benchmark")))
    budget = int(budget) if isinstance(budget, float) and budget.is_integer() else budget
    require(
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
        require(path.is_file(), f"experiment={name} is not a file.")
        return path
    known = {file.stem: file for file in sorted(folder.glob("*.yaml"))}
    nearest = difflib.get_close_matches(name, known, n=3, cutoff=0.5)
    hint = f"did you mean {' or '.join(nearest)}?" if nearest else f"there are {', '.join(known)}."
    require(name in known, f"unknown experiment {name!r}; {hint} A path to a .yaml file does as well.")
    return known[name]


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
    require(given is None or isinstance(given, dict), f"variants of {file} must be settings by name, got {given!r}.")
    variants: dict[str, dict[str, Any]] = {}
    searches: dict[str, Search] = {}
    for name, settings in (given or {}).items():
        require(isinstance(name, str), f"variants of {file} must have texts for names, got {name!r}; put it in quotes.")
        what = f"variant {name} of {file}"
        if not (isinstance(settings, dict) and "search" in settings):
            variants[name] = _replaced(_settings(settings, what), more)
            continue
        require(isinstance(settings["search"], dict), f"{what} must search settings by name.")
        fixed = dict(settings)
        space, trials, prune = _spelled(fixed.pop("search")), fixed.pop("trials", None), fixed.pop("prune", True)
        shared = _replaced(_settings(fixed, what), more)
        both = sorted(set(map(str, space)) & set(shared))
        require(not both, f"{what} searches {', '.join(both)}, which is given as well.")
        try:
            searches[name] = Search(space, trials, shared, prune)
        except ValueError as error:
            raise ValueError(f"{what}: {error}") from error
    return variants, searches


def _replaced(own: dict[str, Any], more: Mapping[str, Any]) -> dict[str, Any]:
    """A variant's settings under those of a command, whose env steps are the budget unless the variant has its own."""
    return own | {name: value for name, value in more.items() if name != "total_env_steps" or name in own}


def _settings(values: Any, what: str) -> dict[str, Any]:
    """Settings by their dotted names, however they were nested."""
    require(values is None or isinstance(values, Mapping), f"{what} must be settings by name, got {values!r}.")
    settings = flat(values or {})
    for name in settings:
        require(
            name == typed_name(name) or typed_name(name) not in settings,
            f"{what} sets {name} and {typed_name(name)}, which are the same; leave one out.",
        )
        require(name not in GIVEN_BY_THE_SUITE, f"{what} sets {name}, which a suite gives each run itself.")
    return _spelled(settings)


def _spelled(settings: Mapping[Any, Any]) -> dict[Any, Any]:
    """Settings by one name each: those of the task as a command line writes them."""
    return {typed_name(name): value for name, value in settings.items()}


def _tasks(given: Any, what: object) -> tuple[str, ...]:
    names = [given] if isinstance(given, str) else given
    require(
        isinstance(names, Iterable) and all(isinstance(name, str) for name in names),
        f"tasks of {what} must be a list of tasks or one of {', '.join(TASK_SETS)}, got {given!r}.",
    )
    return tuple(task for name in names for task in TASK_SETS.get(name, (name,)))


def _seeds(given: Any, what: object) -> tuple[int, ...]:
    seeds = range(1, given + 1) if type(given) is int else given
    require(
        isinstance(seeds, Iterable) and all(type(seed) is int for seed in seeds) and bool(list(seeds)),
        f"seeds of {what} must be a list of numbers or how many, at least 1, got {given!r}.",
    )
    return tuple(seeds)
