"""Returns at fixed env steps: of curves at or between their evaluations, of quoted points where they stand."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np
import pandas as pd

from torchrl_etdmpc.analysis.curves import POINT_COLUMNS
from torchrl_etdmpc.analysis.statistics import add_interval, interpolate
from torchrl_etdmpc.analysis.tables import DASH, escape

STEPS = (20_000, 50_000, 100_000, 200_000)
"""Env steps at which reports table returns."""
MEAN = "Mean over tasks"
"""The name of the row over all tasks in tables of returns."""
_KINDS = ("evaluated", "quoted", "interpolated")
_COLUMNS = ("env_steps", "method", "task", "mean", "standard_error", "lower", "upper", "seeds", "tasks", "kind")


def no_points() -> pd.DataFrame:
    """A table of quoted points without a row.

    >>> no_points().empty
    True
    """
    return pd.DataFrame(
        {name: pd.Series(dtype=float if name in ("env_steps", "mean") else str) for name in POINT_COLUMNS}
    )


def returns_at(
    estimates: pd.DataFrame,
    points: pd.DataFrame,
    *,
    steps: Sequence[float],
    tasks: Sequence[str],
    methods: Sequence[str],
    evaluated: Collection[tuple[str, str, float]] | None = None,
) -> pd.DataFrame:
    """Mean returns at fixed steps by task, and their mean over the tasks that have a value.

    Args:
        estimates (DataFrame): of curves.
        points (DataFrame): quoted means ``method, task, env_steps, mean, source``; they count at their own step only,
            and where the method has a curve's value on the task at that step, the quote is left out.
        steps (sequence of float): env steps.
        tasks (sequence of str): the compared tasks.
        methods (sequence of str): of the curves; those of the points come behind them.
        evaluated (collection of tuple, optional): method, task and env steps of the estimates in which nothing is
            interpolated. Default: all.

    Returns:
        DataFrame: a row for every value that exists, ``env_steps, method, task, mean, standard_error, lower, upper,
        seeds, tasks, kind``. ``kind`` is ``evaluated``, ``quoted`` or ``interpolated`` (between two evaluations). The
        task :data:`MEAN` is the mean over ``tasks`` tasks, its standard error that of independent tasks, its kind the
        last of these three that one of them has.

    >>> rows = [("a", "x", 50, 1.0, 0.3, 3), ("a", "y", 50, 2.0, 0.4, 5), ("a", "y", 90, 4.0, 0.4, 5)]
    >>> curves = pd.DataFrame(rows, columns=["method", "task", "env_steps", "mean", "standard_error", "seeds"])
    >>> table = returns_at(curves, no_points(), steps=[50, 70], tasks=["x", "y"], methods=["a"])
    >>> table[["env_steps", "task", "mean", "standard_error", "tasks", "kind"]]
       env_steps             task  mean  standard_error  tasks          kind
    0       50.0                x   1.0            0.30      1     evaluated
    1       50.0                y   2.0            0.40      1     evaluated
    2       70.0                y   3.0            0.40      1  interpolated
    3       50.0  Mean over tasks   1.5            0.25      2     evaluated
    4       70.0  Mean over tasks   3.0            0.40      1  interpolated
    """
    grid = np.array(sorted(steps), dtype=float)
    chosen = estimates[estimates["method"].isin(methods) & estimates["task"].isin(tasks)]
    curves = interpolate(chosen, grid).dropna(subset="mean")
    there = evaluated_cells(chosen, chosen) if evaluated is None else evaluated
    here = zip(curves["method"], curves["task"], curves["env_steps"], strict=True)
    curves = curves.assign(kind=["evaluated" if cell in there else "interpolated" for cell in here])
    quoted = points[points["task"].isin(tasks) & points["env_steps"].isin(grid)]
    known, cells = (part.set_index(["method", "task", "env_steps"]).index for part in (curves, quoted))
    quoted = quoted[~cells.isin(known)]
    quoted = quoted.drop(columns="source").assign(standard_error=np.nan, seeds=np.nan, kind="quoted")
    table = pd.concat([part for part in (curves, quoted) if len(part)] or [curves], ignore_index=True).assign(tasks=1)
    table = table.sort_values("env_steps", kind="stable", ignore_index=True)
    groups = table.groupby(["env_steps", "method"], sort=False)
    means = groups.agg(
        mean=("mean", "mean"),
        standard_error=("standard_error", lambda errors: np.sqrt(np.square(errors).sum(skipna=False)) / len(errors)),
        seeds=("seeds", lambda seeds: seeds.min(skipna=False)),
        tasks=("tasks", "sum"),
        kind=("kind", lambda kinds: max(kinds, key=_KINDS.index)),
    )
    table = pd.concat([table, means.reset_index().assign(task=MEAN)] if len(table) else [table], ignore_index=True)
    return add_interval(table).reindex(columns=list(_COLUMNS))


def evaluated_cells(estimates: pd.DataFrame, evaluations: pd.DataFrame) -> set[tuple[str, str, float]]:
    """Method, task and env steps of the estimates that are of as many seeds as were evaluated there.

    Args:
        estimates (DataFrame): of seeds that may have been brought to common steps.
        evaluations (DataFrame): estimates of the seeds' own evaluations.
    """
    cells, there = (
        dict(zip(zip(table["method"], table["task"], table["env_steps"], strict=True), table["seeds"], strict=True))
        for table in (estimates, evaluations)
    )
    return {cell for cell, seeds in cells.items() if cell in there and not there[cell] < seeds}


def step_table(returns: pd.DataFrame, step: float, *, tasks: Sequence[str], methods: Sequence[str]) -> str:
    """One step as Markdown: a row per task and the mean, a column per method that has a value there.

    Args:
        returns (DataFrame): see :func:`returns_at`.
        step (float): env steps.
        tasks (sequence of str): rows.
        methods (sequence of str): columns, in this order.
    """
    here = returns[returns["env_steps"] == step]
    columns = [method for method in methods if method in set(here["method"])]
    rows = {(row.method, row.task): row for row in here.itertuples()}
    quoted = _all_quoted(here)
    heads = [escape(method) + " (quoted)" * (method in quoted) for method in columns]
    lines = ["| task | " + " | ".join(heads) + " |", "|---" * (1 + len(columns)) + "|"]
    for task in [*tasks, MEAN]:
        of = len(tasks) if task == MEAN else 1
        cells = [_cell(rows.get((method, task)), of, mark=method not in quoted) for method in columns]
        lines.append(f"| {task} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def overview(returns: pd.DataFrame, *, tasks: Sequence[str], methods: Sequence[str]) -> str:
    """The means over tasks as Markdown: a row per method, a column per step, best first at the last step.

    Args:
        returns (DataFrame): see :func:`returns_at`.
        tasks (sequence of str): all compared tasks; a mean over fewer says so and stands below the whole ones.
        methods (sequence of str): rows; those without any value are left out.
    """
    means = returns[returns["task"] == MEAN]
    steps = sorted(means["env_steps"].unique())
    rows = {(row.method, row.env_steps): row for row in means.itertuples()}

    def place(method: str) -> list[tuple[bool, float]]:
        found = [rows.get((method, step)) for step in reversed(steps)]
        return [(row is None or row.tasks < len(tasks), -row.mean if row is not None else 0.0) for row in found]

    shown = sorted((method for method in methods if method in set(means["method"])), key=place)
    quoted = _all_quoted(means)
    lines = ["| method | " + " | ".join(f"{step:,.0f}" for step in steps) + " |", "|---" * (1 + len(steps)) + "|"]
    for method in shown:
        cells = [_cell(rows.get((method, step)), len(tasks), mark=method not in quoted) for step in steps]
        lines.append(f"| {escape(method)}{' (quoted)' * (method in quoted)} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def _all_quoted(returns: pd.DataFrame) -> set[str]:
    """The methods of which all values are quoted."""
    return set(returns["method"]) - set(returns[returns["kind"] != "quoted"]["method"])


def _cell(row, tasks: int, *, mark: bool) -> str:
    """A value with its interval and seeds, or a dash; a quote may be marked."""
    if row is None:
        return DASH
    text = f"{'≈ ' * (row.kind == 'interpolated')}{row.mean:.0f}{' (quoted)' * (mark and row.kind == 'quoted')}"
    if not np.isnan(row.lower):
        text += f" [{row.lower:.0f}, {row.upper:.0f}]"
    if not np.isnan(row.seeds):
        text += f" ({row.seeds:.0f})"
    return text + (f", {row.tasks} of {tasks} tasks" if row.tasks < tasks else "")
