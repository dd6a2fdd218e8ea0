"""Which runs an experiment should have, and which of them are missing or not finished."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import yaml

from torchrl_etdmpc.analysis.benchmarks import BENCHMARKS
from torchrl_etdmpc.analysis.runs import Run

EXPERIMENT = "experiment.yaml"
SLACK = 0.02  # finished runs of one budget differ by a step, which is of all environments side by side


@dataclass(frozen=True)
class Experiment:
    """A folder of runs ``<variant>/<task>/seed<N>`` with a list of what should be there.

    Args:
        root (Path): the folder.
        variants (tuple of str): names of its folders.
        tasks (tuple of str): task names.
        seeds (tuple of int): seeds.
        budget (int, optional): env steps of every run. Default: those of the benchmark that a task belongs to.
        base (str, optional): the variant that the others are compared with.
        own_budgets (mapping): env steps of the variants that have a number of their own.

    >>> Experiment(root=Path("runs/utd"), variants=("one", "two"), tasks=("walker-walk",), seeds=(1, 2)).variants
    ('one', 'two')
    """

    root: Path
    variants: tuple[str, ...]
    tasks: tuple[str, ...]
    seeds: tuple[int, ...]
    budget: int | None = None
    base: str | None = None
    own_budgets: Mapping[str, int] = field(default_factory=dict)

    def env_steps(self, task: str, variant: str | None = None) -> int | None:
        """How long a run on the task, of the variant, is to be, if that is known."""
        budget = self.budget if variant is None else self.own_budgets.get(variant, self.budget)
        if budget is not None:
            return budget
        return next((benchmark.budget for benchmark in BENCHMARKS.values() if task in benchmark.tasks), None)


def read_experiment(root: Path) -> Experiment:
    """Reads ``variants`` (names, or a mapping by name), ``tasks``, ``seeds``, ``budget`` and ``base`` of a folder.

    Args:
        root (Path): the folder that holds it.

    Raises:
        ValueError: if it does not list them; other keys are ignored.

    >>> import tempfile
    >>> root = Path(tempfile.mkdtemp())
    >>> text = "{variants: [one, two], tasks: [walker-walk], seeds: [1, 2], budget: 50000}"
    >>> _ = (root / "experiment.yaml").write_text(text)
    >>> read_experiment(root).seeds
    (1, 2)
    """
    file = root / EXPERIMENT
    try:
        values = yaml.load(file.read_text(encoding="utf-8"), getattr(yaml, "CSafeLoader", yaml.SafeLoader))
        tasks = values["tasks"]
        tasks = BENCHMARKS[tasks].tasks if isinstance(tasks, str) and tasks in BENCHMARKS else tasks
        variants, own = values["variants"], {}
        if isinstance(variants, dict):  # a search has no runs of its own; its trials are variants
            settings_of = {name: settings or {} for name, settings in variants.items()}
            variants = [name for name, settings in settings_of.items() if "search" not in settings]
            own = {name: settings_of[name].get("total_env_steps") for name in variants}
            own = {name: int(steps) for name, steps in own.items() if steps is not None}
        lists = {"variants": (list(variants), str), "tasks": (tasks, str), "seeds": (values["seeds"], int)}
        for name, (items, kind) in lists.items():
            if not isinstance(items, list | tuple) or not items or not all(isinstance(item, kind) for item in items):
                raise ValueError(name)
        budget = None if values.get("budget") == "benchmark" else values.get("budget")
        if not (budget is None or isinstance(budget, int) and budget > 0):
            raise ValueError("budget")
    except (OSError, ValueError, KeyError, TypeError, yaml.YAMLError) as error:
        raise ValueError(
            f"{file} does not list variants, tasks, seeds and a budget, so that nobody can say which runs are missing."
        ) from error
    variants, tasks, seeds = (tuple(items) for items, _ in lists.values())
    return Experiment(root, variants, tasks, seeds, budget, values.get("base") or variants[0], own)


def experiment_root(run: Path) -> Path | None:
    """The folder of the experiment that a run belongs to, ``None`` if to none.

    That is the nearest folder above it, up to five, with an ``experiment.yaml`` that lists the variant by which the
    run's folder begins; where that file cannot be read, nobody knows better.

    >>> from pathlib import Path
    >>> experiment_root(Path("runs/alone")) is None
    True
    """
    whole = run.absolute()
    for folder in list(whole.parents)[:5]:
        if (folder / EXPERIMENT).is_file():
            try:
                known = whole.relative_to(folder).parts[0] in read_experiment(folder).variants
            except ValueError:
                known = True
            if known:  # as it was spelled, if it was
                return next((given for given in run.parents if given.absolute() == folder), folder)
    return None


def incomplete_runs(
    runs: Sequence[Run], experiments: Iterable[Experiment] = (), *, budget: float | None = None
) -> list[str]:
    """Names every run that is missing or not finished, a line each.

    A run is missing if its experiment lists it, or if another method of the same runs has one with this task and seed
    on a task that both have. It is not finished without its summary, or if it ends before the budget of its experiment
    or before the others on its task. One that is a step short of these is whole, unless it has no value at the budget
    of a comparison.

    Args:
        runs (sequence of Run): those that were read.
        experiments (iterable of Experiment): of which the runs should be all.
        budget (float, optional): env steps at which the runs are compared.

    >>> incomplete_runs([])
    []
    """
    experiments = list(experiments)
    lines = list(_unfinished(runs, experiments, budget))
    there = {(run.method, run.task, run.seed) for run in runs}
    planned = [
        (variant, task, seed)
        for plan in experiments
        for variant in plan.variants
        for task in plan.tasks
        for seed in plan.seeds
    ]
    shared = Counter((task, seed) for _, task, seed in there)
    if not experiments and max(shared.values(), default=0) > 1:
        pairs = sorted({(method, task) for method, task, _ in there})
        planned = [(method, task, seed) for method, task in pairs for other, seed in sorted(shared) if other == task]
    missing = [key for key in planned if key not in there]
    return lines + [f"{method} on {task} with seed {seed}: no run" for method, task, seed in missing]


def _unfinished(runs: Sequence[Run], experiments: list[Experiment], compared: float | None) -> Iterator[str]:
    longest: dict[str, float] = {}
    for run in runs:
        longest[run.task] = max(longest.get(run.task, 0.0), run.last)  # a NaN is never the larger one
    for run in runs:
        plans = [plan for plan in experiments if plan.root.absolute() in run.path.absolute().parents]
        plan = max(plans, key=lambda plan: len(plan.root.absolute().parts), default=None)  # the innermost one
        budget = plan.env_steps(run.task, run.method) if plan else None
        target = budget or longest[run.task]
        where = f"{run.method} on {run.task} with seed {run.seed}"
        ends = f"ends at {run.last:,.0f} env steps" if run.last >= 0 else "has no evaluation"
        if not run.last >= 0 and len(run.curve):
            ends = "has no evaluation whose return is a number"
        if not run.finished:
            yield f"{where}: not finished, {ends}"
        elif run.last == 0:
            yield f"{where}: no evaluation after 0 env steps"
        elif not run.last >= target * (1 - SLACK) or (compared is not None and run.last < min(target, compared)):
            yield f"{where}: {ends}, {'its budget is' if budget else 'others at'} {target:,.0f}"
