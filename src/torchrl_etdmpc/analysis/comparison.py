"""A comparison of methods by the protocol of thesis appendix A.1.2, as tables."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pandas as pd

from torchrl_etdmpc.analysis.benchmarks import Benchmark
from torchrl_etdmpc.analysis.statistics import (
    NORMALISER,
    aggregate,
    auc,
    auc_standard_error,
    estimate,
    interpolate,
    normalise,
    normalisers,
    shared_grid,
)
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
        estimates (DataFrame): of all methods, one row per evaluation.
        constants (Series): by which tasks are normalised.
        areas (DataFrame): ``method, task, auc, standard_error, seeds``, normalised, with the aggregate as the last
            task.
        finals (DataFrame): ``method, task, mean, standard_error, seeds``, returns at the budget, the aggregate
            normalised.
        notes (tuple of str): what a reader must know about the data.
    """

    benchmark: Benchmark
    tasks: tuple[str, ...]
    methods: tuple[str, ...]
    budget: int
    grid: np.ndarray
    seed_curves: pd.DataFrame
    estimates: pd.DataFrame
    constants: pd.Series
    areas: pd.DataFrame
    finals: pd.DataFrame
    notes: tuple[str, ...]


def merge_estimates(seed_curves: pd.DataFrame, means: pd.DataFrame) -> pd.DataFrame:
    """One table of estimates from seed curves and from published means.

    Where a method is known both ways on a task, the seed curves count: they say more.

    Args:
        seed_curves (DataFrame): ``method, task, seed, env_steps, return_mean``.
        means (DataFrame): estimates.
    """
    table = estimate(seed_curves)
    known = set(zip(table["method"], table["task"], strict=True))
    rest = means[[pair not in known for pair in zip(means["method"], means["task"], strict=True)]]
    return pd.concat([part for part in (table, rest) if len(part)] or [table], ignore_index=True)


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
            :func:`interpolate`; for the thesis' own tables only.

    Raises:
        ValueError: if the grid has fewer than two points, or the budget is no multiple of its step.
    """
    tasks = tuple(tasks or benchmark.tasks)
    budget = budget or benchmark.budget
    estimates = merge_estimates(seed_curves, means)
    constants = normalisers(estimates[estimates["task"].isin(benchmark.tasks)], benchmark.budget)
    estimates = estimates[estimates["task"].isin(tasks)]
    methods = tuple(methods or dict.fromkeys([*seed_curves["method"], *means["method"]]))
    estimates = estimates[estimates["method"].isin(methods)]
    seed_curves = seed_curves[seed_curves["task"].isin(tasks) & seed_curves["method"].isin(methods)]
    grid = shared_grid(estimates, budget, grid_step, start=start)

    on_grid = normalise(interpolate(estimates, grid, from_zero=from_zero), constants)
    errors = auc_standard_error(normalise(seed_curves, constants), grid, from_zero=from_zero)
    areas = auc(on_grid).merge(errors, on=["method", "task"], how="left")
    areas = pd.concat([areas, _aggregate_rows(areas.rename(columns={"auc": "mean"}), tasks, "auc")])

    finals = interpolate(estimates, np.array([float(budget)]), from_zero=from_zero).drop(columns="env_steps")
    finals = pd.concat([finals, _aggregate_rows(normalise(finals, constants), tasks, "mean")])
    parts = {"areas": areas.reset_index(drop=True), "finals": finals.reset_index(drop=True)}
    notes = tuple(_notes(seed_curves, estimates, constants, tasks, methods, budget, parts["areas"]))
    return Comparison(benchmark, tasks, methods, budget, grid, seed_curves, estimates, constants, notes=notes, **parts)


def _aggregate_rows(table: pd.DataFrame, tasks: tuple[str, ...], column: str) -> pd.DataFrame:
    rows = aggregate(table.assign(env_steps=0), tasks).drop(columns="env_steps")
    return rows.rename(columns={"mean": column}).assign(task=AGGREGATE)


def _notes(
    seed_curves: pd.DataFrame,
    estimates: pd.DataFrame,
    constants: pd.Series,
    tasks: tuple[str, ...],
    methods: tuple[str, ...],
    budget: int,
    areas: pd.DataFrame,
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
        yield f"{method}: not all seeds have every evaluation on {where}; each mean is of those that have it."
    unknown = [name for name in methods if areas[areas["method"] == name]["standard_error"].isna().all()]
    if unknown:
        yield f"No interval of the AUC for {', '.join(unknown)}: it needs the curves of at least two seeds."
    there = estimates[estimates["env_steps"] == budget]["method"]
    between = [name for name in methods if name not in set(there)]
    between = [name for name in between if (estimates[estimates["method"] == name]["env_steps"] > budget).any()]
    if between:
        yield (
            f"{', '.join(between)}: not evaluated at {budget:,} env steps; values there lie on the straight line "
            "between the neighbouring evaluations."
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
