"""A comparison of methods by the protocol of thesis appendix A.1.2, as tables."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from torchrl_etdmpc.analysis.benchmarks import Benchmark
from torchrl_etdmpc.analysis.curves import SEED_COLUMNS
from torchrl_etdmpc.analysis.paired import compare_paired
from torchrl_etdmpc.analysis.statistics import (
    NORMALISER,
    aggregate,
    auc,
    auc_of_seeds,
    estimate,
    interpolate,
    normalise,
    normalisers,
    seed_estimates,
    shared_grid,
)
from torchrl_etdmpc.analysis.steps import STEPS, evaluated_cells, no_points, returns_at
from torchrl_etdmpc.analysis.tables import AGGREGATE


@dataclass(frozen=True)
class Comparison:
    """Everything that a report shows, as tables.

    Args:
        benchmark (Benchmark): whose tasks and normaliser.
        tasks (tuple of str): compared tasks, in the benchmark's order.
        methods (tuple of str): in the order of tables and legends.
        budget (int): env steps.
        grid (ndarray): env steps of the shared evaluation grid.
        seed_curves (DataFrame): of the methods that are known per seed.
        estimates (DataFrame): of all methods, one row per evaluation, and more where seeds differ in their steps.
        evaluated (set of tuple): method, task and env steps of the estimates that are of all seeds' own evaluations.
        constants (Series): by which tasks are normalised.
        areas (DataFrame): ``method, task, auc, standard_error, seeds``, normalised, with the aggregate as the last
            task.
        finals (DataFrame): ``method, task, mean, standard_error, seeds``, returns at the budget, the aggregate
            normalised.
        points (DataFrame): quoted means ``method, task, env_steps, mean, source`` of the tasks, up to the budget.
        returns (DataFrame): at fixed steps, of methods and points, see :func:`returns_at`.
        paired (DataFrame): differences between variants, see :func:`compare_paired`; no row if none was asked for.
        notes (tuple of str): what a reader must know about the data.

    >>> from torchrl_etdmpc.analysis import get_benchmark, seed_estimates
    >>> curve = {"task": "walker-walk", "seed": 1, "env_steps": [0, 100_000, 200_000], "return_mean": [0, 450, 900]}
    >>> runs = pd.concat([pd.DataFrame({**curve, "method": method}) for method in ("BMPC", "ours")])
    >>> nothing = seed_estimates(runs.head(0))
    >>> found = compare(runs, nothing, benchmark=get_benchmark("dmc-easy"), tasks=("walker-walk",))
    >>> isinstance(found, Comparison)
    True
    >>> list(found.areas.columns)
    ['method', 'task', 'auc', 'seeds', 'standard_error']
    """

    benchmark: Benchmark
    tasks: tuple[str, ...]
    methods: tuple[str, ...]
    budget: int
    grid: np.ndarray
    seed_curves: pd.DataFrame
    estimates: pd.DataFrame
    evaluated: set[tuple[str, str, float]]
    constants: pd.Series
    areas: pd.DataFrame
    finals: pd.DataFrame
    points: pd.DataFrame
    returns: pd.DataFrame
    paired: pd.DataFrame
    notes: tuple[str, ...]


def merge_estimates(seed_curves: pd.DataFrame, means: pd.DataFrame) -> pd.DataFrame:
    """One table of estimates from seed curves and from published means.

    Where a method is known both ways on a task, the seed curves count: they say more.

    Args:
        seed_curves (DataFrame): ``method, task, seed, env_steps, return_mean``.
        means (DataFrame): estimates.

    >>> runs = pd.DataFrame({"method": "a", "task": "t", "seed": [1, 2], "env_steps": 10, "return_mean": [1.0, 3.0]})
    >>> mean = {"mean": 5.0, "standard_error": 1.0, "seeds": 3}
    >>> means = pd.DataFrame({"method": ["b"], "task": "t", "env_steps": 10, **mean})
    >>> sorted(merge_estimates(runs, means)["mean"])
    [2.0, 5.0]
    """
    table = estimate(seed_curves)
    known = set(zip(table["method"], table["task"], strict=True))
    rest = means[[pair not in known for pair in zip(means["method"], means["task"], strict=True)]]
    return pd.concat([part for part in (table, rest) if len(part)] or [table], ignore_index=True)


def on_common_steps(seed_curves: pd.DataFrame, further: Iterable[float] = ()) -> pd.DataFrame:
    """Every seed's curve at all steps of its method on the task that lie within its own evaluations.

    Between two evaluations a return lies on the straight line. Where seeds were evaluated at other steps than each
    other, a mean would otherwise be of whoever happened to be evaluated there; and between the end of one of them and
    the next evaluation of the others, a line would lead from the mean of all to that of those who are left.

    Args:
        seed_curves (DataFrame): ``method, task, seed, env_steps, return_mean``; NaN returns are left out.
        further (iterable of float): more steps at which curves are read, for methods whose seeds differ in their steps.

    >>> rows = [("a", "t", 1, 10, 0.0), ("a", "t", 1, 30, 2.0), ("a", "t", 2, 20, 5.0)]
    >>> curves = pd.DataFrame(rows, columns=["method", "task", "seed", "env_steps", "return_mean"])
    >>> on_common_steps(curves)["return_mean"].tolist()
    [0.0, 1.0, 2.0, 5.0]
    """
    parts = []
    for _, curves in seed_curves.dropna(subset="return_mean").groupby(["method", "task"], sort=False):
        steps = np.unique(curves["env_steps"])
        if len(curves) < len(steps) * curves["seed"].nunique():
            lines = interpolate(seed_estimates(curves), np.union1d(steps, [*further])).dropna(subset="mean")
            curves = lines.rename(columns={"mean": "return_mean"})[[*SEED_COLUMNS]]
        parts.append(curves)
    return pd.concat(parts, ignore_index=True) if parts else seed_curves


def compare(
    seed_curves: pd.DataFrame,
    means: pd.DataFrame,
    *,
    benchmark: Benchmark,
    tasks: tuple[str, ...] | None = None,
    methods: tuple[str, ...] | None = None,
    budget: int | None = None,
    grid_step: int = 100_000,
    start: int | None = None,
    from_zero: bool = False,
    points: pd.DataFrame | None = None,
    steps: Sequence[int] = STEPS,
    base: str | None = None,
    variants: Sequence[str] = (),
) -> Comparison:
    """Tables of areas and final returns by the protocol of thesis appendix A.1.2.

    Args:
        seed_curves (DataFrame): of the runs, and of baselines that are published per seed.
        means (DataFrame): estimates of baselines that are published as means.
        benchmark (Benchmark): gives the default budget, and the budget at which BMPC's mean return normalises.
        tasks (tuple of str, optional): rows. Default: all of the benchmark.
        methods (tuple of str, optional): columns. Default: all, in the order of the tables.
        budget (int, optional): env steps. Default: the benchmark's.
        grid_step (int): env steps between the points of the shared grid.
        start (int, optional): first point of the grid. Default: the first that all methods have.
        from_zero (bool): draws a line from the evaluation of the untrained agent to the next one, see
            :func:`interpolate`, and takes each mean over the seeds that were evaluated there, not over
            :func:`on_common_steps`; for the thesis' own tables only.
        points (DataFrame, optional): quoted means, see :func:`read_points`.
        steps (sequence of int): env steps at which returns are tabled, those within the budget.
        base (str, optional): with which ``variants`` are compared, paired by task and seed.
        variants (sequence of str): methods of ``seed_curves``.

    Raises:
        ValueError: if the grid has fewer than two points, or the budget is no multiple of its step.

    >>> from torchrl_etdmpc.analysis import get_benchmark, seed_estimates
    >>> curve = {"task": "walker-walk", "seed": 1, "env_steps": [0, 100_000, 200_000], "return_mean": [0, 450, 900]}
    >>> runs = pd.concat([pd.DataFrame({**curve, "method": method}) for method in ("BMPC", "ours")])
    >>> nothing = seed_estimates(runs.head(0))
    >>> found = compare(runs, nothing, benchmark=get_benchmark("dmc-easy"), tasks=("walker-walk",))
    >>> found.methods, found.budget
    (('BMPC', 'ours'), 200000)
    """
    tasks = tuple(tasks or benchmark.tasks)
    budget = budget or benchmark.budget
    read_at = {*seed_curves["env_steps"], *means["env_steps"], *steps, *range(0, budget, grid_step), budget}
    read_at.add(benchmark.budget)
    estimates = merge_estimates(seed_curves if from_zero else on_common_steps(seed_curves, read_at), means)
    evaluated = evaluated_cells(estimates, merge_estimates(seed_curves, means))
    points = no_points() if points is None else points
    points = points[points["task"].isin(tasks) & (points["env_steps"] <= budget)].reset_index(drop=True)
    constants = normalisers(estimates[estimates["task"].isin(benchmark.tasks)], benchmark.budget)
    estimates = estimates[estimates["task"].isin(tasks)]
    notes = [*_both_ways(seed_curves, means, tasks)]
    methods = tuple(methods or dict.fromkeys([*seed_curves["method"], *means["method"]]))
    notes += _left_out(estimates[~estimates["method"].isin(methods)], budget)
    estimates = estimates[estimates["method"].isin(methods)]
    seed_curves = seed_curves[seed_curves["task"].isin(tasks) & seed_curves["method"].isin(methods)]
    grid = shared_grid(estimates, budget, grid_step, start=start)

    areas = _areas(estimates, seed_curves, constants, grid, from_zero=from_zero)
    areas = pd.concat([areas, _aggregate_rows(areas.rename(columns={"auc": "mean"}), tasks, "auc")])

    finals = interpolate(estimates, np.array([float(budget)]), from_zero=from_zero).drop(columns="env_steps")
    finals = pd.concat([finals, _aggregate_rows(normalise(finals, constants), tasks, "mean")])
    within = [step for step in steps if step <= budget]
    tables = {
        "areas": areas.reset_index(drop=True),
        "finals": finals.reset_index(drop=True),
        "points": points,
        "returns": returns_at(estimates, points, steps=within, tasks=tasks, methods=methods, evaluated=evaluated),
        "paired": compare_paired(
            seed_curves, base=base or "", variants=variants, env_steps=budget, tasks=tasks, constants=constants
        ),
    }
    paired = set(tables["paired"]["variant"])
    notes += [_why_unpaired(seed_curves, name, base, budget) for name in variants if name not in paired]
    known = (seed_curves, estimates, evaluated, constants, tasks, methods, budget, tables["areas"], tables["finals"])
    notes = (*_notes(*known), *notes)
    parts = (benchmark, tasks, methods, budget, grid, seed_curves, estimates, evaluated, constants)
    return Comparison(*parts, notes=notes, **tables)


def evaluated_methods(
    seed_curves: pd.DataFrame, means: pd.DataFrame, *, tasks: Sequence[str], budget: float
) -> list[str]:
    """The methods with an evaluation of the trained agent up to the budget on one of the tasks; published means first.

    Args:
        seed_curves (DataFrame): of the runs, and of baselines that are published per seed.
        means (DataFrame): estimates of baselines that are published as means.
        tasks (sequence of str): the compared tasks.
        budget (float): env steps.

    >>> runs = pd.DataFrame({"method": "a", "task": "t", "seed": 1, "env_steps": [0, 10], "return_mean": 1.0})
    >>> mean = {"mean": 5.0, "standard_error": 1.0, "seeds": 3}
    >>> means = pd.DataFrame({"method": ["b"], "task": "t", "env_steps": 10, **mean})
    >>> evaluated_methods(runs, means, tasks=["t"], budget=10)
    ['b', 'a']
    """
    first = begins(merge_estimates(seed_curves, means)).reset_index()
    here = set(first[first["task"].isin(tasks) & (first["env_steps"] <= budget)]["method"])
    return [name for name in dict.fromkeys([*means["method"], *seed_curves["method"]]) if name in here]


def begins(curves: pd.DataFrame) -> pd.Series:
    """The first evaluation of the trained agent by method and task, those at 0 env steps apart.

    Args:
        curves (DataFrame): seed curves or estimates.

    >>> curves = pd.DataFrame({"method": "a", "task": "t", "env_steps": [0, 10, 20], "mean": 1.0})
    >>> begins(curves).tolist()
    [10]
    """
    value = "return_mean" if "return_mean" in curves else "mean"
    trained = curves[(curves["env_steps"] > 0) & curves[value].notna()]
    return trained.groupby(["method", "task"], sort=False)["env_steps"].min()


def _areas(
    estimates: pd.DataFrame, seed_curves: pd.DataFrame, constants: pd.Series, grid: np.ndarray, *, from_zero: bool
) -> pd.DataFrame:
    """Of the mean curves; where seeds are known, the mean of those of the seeds that cover the grid.

    The mean curve of seeds that begin or end apart is nobody's, and neither is the area below it.
    """
    areas = auc(normalise(interpolate(estimates, grid, from_zero=from_zero), constants))
    known = auc_of_seeds(normalise(seed_curves, constants), grid, from_zero=from_zero)
    areas = areas.merge(known, on=["method", "task"], how="left", suffixes=("", "_of_seeds"), indicator="source")
    if not from_zero:
        published = areas["source"] == "left_only"
        for name in ("auc", "seeds"):
            areas[name] = areas[name].where(published, areas[f"{name}_of_seeds"])
    return areas[["method", "task", "auc", "seeds", "standard_error"]]


def _aggregate_rows(table: pd.DataFrame, tasks: tuple[str, ...], column: str) -> pd.DataFrame:
    rows = aggregate(table.assign(env_steps=0), tasks).drop(columns="env_steps")
    return rows.rename(columns={"mean": column}).assign(task=AGGREGATE)


def _notes(
    seed_curves: pd.DataFrame,
    estimates: pd.DataFrame,
    evaluated: set[tuple[str, str, float]],
    constants: pd.Series,
    tasks: tuple[str, ...],
    methods: tuple[str, ...],
    budget: int,
    areas: pd.DataFrame,
    finals: pd.DataFrame,
) -> Iterator[str]:
    """What a reader of the figures must know about the data behind them."""
    missing = int(seed_curves["return_mean"].isna().sum())
    if missing:
        yield f"{missing} evaluation{'s' * (missing > 1)} with a return that is not a number: left out."
    counts = estimates.groupby(["method", "task"], sort=False)["seeds"].agg(["min", "max"]).reset_index()
    for method, rows in counts[counts["max"] == 1].groupby("method", sort=False):
        yield f"{method}: one seed on {', '.join(rows['task'])}; a mean of one run, no interval."
    for method, rows in counts[counts["min"] < counts["max"]].groupby("method", sort=False):
        where = ", ".join(rows["task"])
        yield f"{method}: not all seeds begin and end alike on {where}; each mean is of those that reach there."
    known = areas[areas["auc"].notna()]
    unknown = [
        name for name in dict.fromkeys(known["method"]) if known[known["method"] == name]["standard_error"].isna().all()
    ]
    if unknown:
        names = ", ".join(unknown)
        yield f"No interval of the AUC for {names}: it needs the curves of at least two seeds on the whole grid."
    known = finals[(finals["task"] != AGGREGATE) & finals["mean"].notna()]
    between = [row.method for row in known.itertuples() if (row.method, row.task, budget) not in evaluated]
    if between:
        yield (
            f"{', '.join(dict.fromkeys(between))}: not evaluated at {budget:,} env steps; values there lie on the "
            "straight line between the neighbouring evaluations."
        )
    without = [task for task in tasks if task not in constants.index]
    if without:
        yield f"No return of {NORMALISER} to normalise by on {', '.join(without)}: areas there are unavailable."
    ends = estimates.groupby(["method", "task"])["env_steps"].agg(["min", "max"]).reset_index()
    for method in methods:
        rows = ends[ends["method"] == method]
        short = rows[rows["max"] < budget]
        if len(short):
            yield (
                f"{method} ends before {budget:,} env steps on {', '.join(short['task'])} (last evaluation "
                f"{short['max'].min():,.0f}): unavailable there, nothing is extrapolated."
            )
        absent = [task for task in tasks if task not in set(rows["task"])]
        if absent:
            yield f"{method} has no curve on {', '.join(absent)}."
    yield from _late(estimates, methods, budget)


def _late(estimates: pd.DataFrame, methods: tuple[str, ...], budget: int) -> Iterator[str]:
    """Where the curves of methods begin, if others are evaluated earlier."""
    first = begins(estimates).groupby(level="method").max().reindex(methods).dropna()
    late = first[first > first.min()]
    if len(late):
        names = ", ".join(f"{method} from {step:,.0f}" for method, step in late.items())
        yield f"Not evaluated before their first evaluation after 0 env steps, on one task at least: {names}."


def _left_out(estimates: pd.DataFrame, budget: int) -> Iterator[str]:
    """Methods that have nothing to show up to the budget."""
    first = begins(estimates).groupby(level="method").min()
    if len(late := first[first > budget]):
        names = ", ".join(f"{method} (from {step:,.0f})" for method, step in late.items())
        yield f"Not evaluated by {budget:,} env steps on these tasks, so left out: {names}."


def _why_unpaired(seed_curves: pd.DataFrame, variant: str, base: str | None, budget: int) -> str:
    runs = [seed_curves[seed_curves["method"] == name] for name in (variant, base)]
    one, other = (set(zip(rows["task"], rows["seed"], strict=True)) for rows in runs)
    if one & other:
        return f"{variant} and {base} share no task and seed on which both reach {budget:,} env steps: not paired."
    return f"{variant} shares no task and seed with {base}: not paired."


def _both_ways(seed_curves: pd.DataFrame, means: pd.DataFrame, tasks: tuple[str, ...]) -> Iterator[str]:
    """Methods of which two sets of runs are published on a task."""
    known = [set(zip(t["method"], t["task"], strict=True)) for t in (seed_curves, means)]
    both = dict.fromkeys(method for method, task in sorted(known[0] & known[1]) if task in tasks)
    if both:
        yield f"Published per seed and, of other runs, as means: {', '.join(both)}; the curves per seed are used."
