"""A report: tables, figures and one page that puts them together."""

from __future__ import annotations

import os
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import pandas as pd

from torchrl_etdmpc.analysis.benchmarks import Benchmark
from torchrl_etdmpc.analysis.figures import plot_auc, plot_aggregate, plot_curves
from torchrl_etdmpc.analysis.robust import interquartile_mean, probability_of_improvement, scores_at
from torchrl_etdmpc.analysis.statistics import (
    NORMALISER,
    add_interval,
    aggregate,
    auc,
    auc_standard_error,
    estimate,
    interpolate,
    normalise,
    normalisers,
    shared_grid,
)
from torchrl_etdmpc.analysis.tables import AGGREGATE, result_table, to_csv, to_markdown


@dataclass(frozen=True)
class Comparison:
    """Everything that a report shows, as tables.

    Args:
        benchmark: whose tasks and normaliser.
        tasks: compared tasks, in the benchmark's order.
        methods: in the order of tables and legends.
        budget: env steps.
        grid: env steps of the shared evaluation grid.
        seed_curves: of the methods that are known per seed.
        estimates: of all methods, one row per evaluation.
        constants: by which tasks are normalised.
        areas: ``method, task, auc, standard_error, seeds``, normalised, with the aggregate as the last task.
        finals: ``method, task, mean, standard_error, seeds``, returns at the budget, the aggregate normalised.
        notes: what a reader must know about the data.
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
    grid = shared_grid(estimates, budget, grid_step)
    if start is not None:
        grid = np.arange(start, budget + 1, grid_step, dtype=float)

    on_grid = normalise(interpolate(estimates, grid), constants)
    errors = auc_standard_error(normalise(seed_curves, constants), grid)
    areas = auc(on_grid).merge(errors, on=["method", "task"], how="left")
    areas = pd.concat([areas, _aggregate_rows(areas.rename(columns={"auc": "mean"}), tasks, "auc")])

    finals = interpolate(estimates, np.array([float(budget)])).drop(columns="env_steps")
    finals = pd.concat([finals, _aggregate_rows(normalise(finals, constants), tasks, "mean")])
    parts = {"areas": areas.reset_index(drop=True), "finals": finals.reset_index(drop=True)}
    notes = tuple(_notes(seed_curves, estimates, constants, tasks, methods, budget, parts["areas"]))
    return Comparison(
        benchmark, tasks, methods, budget, grid, seed_curves, estimates, constants, notes=notes, **parts
    )


def write_report(
    comparison: Comparison, out: str | os.PathLike[str], *, vector: Literal["pdf", "svg"] | None = None
) -> Path:
    """Writes ``auc.csv``, ``final.csv``, their Markdown, the figures and ``index.md``.

    Everything is made beside ``out`` first and moved into it at the end, so that an error leaves ``out`` as it was.

    Args:
        comparison (Comparison): see :func:`compare`.
        out (path): folder; made if missing, files of the same name are replaced.
        vector (str, optional): also writes every figure in this format.

    Returns:
        Path: of ``index.md``.
    """
    out = Path(out)
    files = _tables(comparison)
    figures = _figures(comparison)
    files["index.md"] = _page(comparison, files, list(figures))
    out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=out.parent, prefix=f".{out.name}-") as folder:
        for name, text in files.items():
            (Path(folder) / name).write_text(text, encoding="utf-8")
        for name, figure in figures.items():
            for ending in filter(None, ("png", vector)):
                figure.savefig(Path(folder) / f"{name}.{ending}", dpi=160, metadata=_undated(ending))
        out.mkdir(exist_ok=True)
        for file in sorted(Path(folder).iterdir()):
            os.replace(file, out / file.name)
    return out / "index.md"


def _undated(ending: str) -> dict[str, None]:
    """The same data gives the same file."""
    return {"pdf": {"CreationDate": None}, "svg": {"Date": None}}.get(ending, {})


def _aggregate_rows(table: pd.DataFrame, tasks: tuple[str, ...], column: str) -> pd.DataFrame:
    rows = aggregate(table.assign(env_steps=0), tasks).drop(columns="env_steps")
    return rows.rename(columns={"mean": column}).assign(task=AGGREGATE)


def _notes(seed_curves, estimates, constants, tasks, methods, budget, areas):
    missing = int(seed_curves["return_mean"].isna().sum())
    if missing:
        yield f"{missing} evaluation{'s' * (missing > 1)} with a return that is not a number: left out."
    single = estimates[estimates["seeds"] == 1][["method", "task"]].drop_duplicates()
    for method, rows in single.groupby("method", sort=False):
        yield f"{method}: one seed on {', '.join(rows['task'])}; a mean of one run, no interval."
    counts = estimates.groupby(["method", "task"])["seeds"].agg(["min", "max"])
    varying = counts[counts["min"] != counts["max"]].reset_index()
    for method, rows in varying.groupby("method", sort=False):
        yield f"{method}: not all seeds have every evaluation on {', '.join(rows['task'])}; each mean is of those there."
    unknown = [name for name in methods if areas[areas["method"] == name]["standard_error"].isna().all()]
    if unknown:
        yield f"No interval of the AUC for {', '.join(unknown)}: it needs the curves of at least two seeds."
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


def _wide(comparison: Comparison, values: pd.DataFrame, column: str) -> list[pd.DataFrame]:
    shape = {"tasks": comparison.tasks, "methods": comparison.methods}
    return [result_table(values, column=name, **shape) for name in (column, "seeds", "standard_error")]


def _tables(comparison: Comparison) -> dict[str, str]:
    areas, finals = _wide(comparison, comparison.areas, "auc"), _wide(comparison, comparison.finals, "mean")
    return {
        "auc.csv": to_csv(*areas),
        "auc.md": to_markdown(*areas[:2], digits=3),
        "final.csv": to_csv(*finals),
        "final.md": to_markdown(*finals[:2], digits={**dict.fromkeys(comparison.tasks, 1), AGGREGATE: 3}),
    }


def _figures(comparison: Comparison) -> dict:
    normalised = f"return / {NORMALISER} at {comparison.benchmark.budget:,}"
    steps = np.unique(comparison.estimates["env_steps"])
    steps = np.union1d(steps[(steps >= comparison.grid[0]) & (steps <= comparison.budget)], comparison.grid)
    curves = aggregate(
        normalise(interpolate(comparison.estimates, steps), comparison.constants), comparison.tasks
    )
    areas = comparison.areas[comparison.areas["task"] == AGGREGATE]
    options = {"methods": comparison.methods, "budget": comparison.budget}
    return {
        "curves": plot_curves(comparison.estimates, tasks=comparison.tasks, **options),
        "aggregate": plot_aggregate(curves, ylabel=normalised, **options),
        "auc": plot_auc(areas, methods=comparison.methods, ylabel="normalised AUC"),
    }


def _page(comparison: Comparison, files: dict[str, str], figures: list[str]) -> str:
    benchmark, grid = comparison.benchmark, comparison.grid
    scope = f"all {len(comparison.tasks)} tasks" if len(comparison.tasks) == len(benchmark.tasks) else (
        f"{len(comparison.tasks)} of its {len(benchmark.tasks)} tasks; aggregates are over these {len(comparison.tasks)}"
    )
    parts = [
        f"# {benchmark.title}: {', '.join(comparison.methods)}\n",
        f"Budget {comparison.budget:,} environment steps; {scope}. Evaluation grid of the AUC: {grid[0]:,.0f} to "
        f"{grid[-1]:,.0f} every {grid[1] - grid[0]:,.0f} env steps, trapezoid rule, env steps in millions. Normalised by "
        f"{NORMALISER}'s mean return on the task at {benchmark.budget:,} env steps. In brackets: number of seeds of each "
        "figure. Best in bold, second best in italics; a dash is unavailable.\n",
        "## Area under the normalised learning curve\n",
        files["auc.md"],
        f"![areas](auc.png)\n\n## Return at {comparison.budget:,} environment steps\n",
        "The last row is the mean of normalised returns.\n",
        files["final.md"],
        "## Learning curves\n",
        "Mean over seeds; shaded: 95% interval, 1.96 standard errors.\n",
        "![learning curves](curves.png)\n\n![aggregate](aggregate.png)\n",
        _intervals(comparison),
        _robust(comparison),
    ]
    if comparison.notes:
        parts.append("## About the data\n\n" + "\n".join(f"- {note}" for note in comparison.notes) + "\n")
    return "\n".join(part for part in parts if part)


def _intervals(comparison: Comparison) -> str:
    """Final returns with what a paper quotes beside them."""
    table = add_interval(comparison.finals[comparison.finals["task"] != AGGREGATE]).dropna(subset="standard_error")
    if table.empty:
        return ""
    lines = [
        f"## Spread over seeds at {comparison.budget:,} environment steps\n",
        "| task | method | mean | std (N-1) | standard error | 95% interval | seeds |\n|---|---|---|---|---|---|---|",
    ]
    for task in comparison.tasks:
        for row in table[table["task"] == task].itertuples():
            lines.append(
                f"| {task} | {row.method} | {row.mean:.1f} | {row.std:.1f} | {row.standard_error:.1f} | "
                f"{row.lower:.1f} to {row.upper:.1f} | {row.seeds:.0f} |"
            )
    return "\n".join(lines) + "\n"


def _robust(comparison: Comparison) -> str:
    """Interquartile means and probabilities of improvement, for methods known per seed."""
    curves = normalise(comparison.seed_curves, comparison.constants)
    scores = {method: scores_at(curves, method, comparison.budget) for method in comparison.methods}
    complete = {method: found for method, found in scores.items() if set(found) == set(comparison.tasks)}
    if not complete:
        return ""
    lines = [
        f"## Interquartile mean of normalised scores at {comparison.budget:,} environment steps\n",
        "95% percentile intervals of a stratified bootstrap (2,000 resamples of the seeds within each task); P is the "
        "probability that a run of the row's method scores more than one of the column's, averaged over tasks. Only "
        "methods whose runs are known per seed on all tasks.\n",
        "| method | interquartile mean | " + " | ".join(f"P(> {name})" for name in complete) + " | seeds per task |",
        "|---" * (len(complete) + 3) + "|",
    ]
    for method, found in complete.items():
        cells = [_quote(interquartile_mean(found))]
        cells += ["" if other == method else _quote(probability_of_improvement(found, complete[other])) for other in complete]
        counts = sorted({len(values) for values in found.values()})
        lines.append(f"| {method} | " + " | ".join(cells) + f" | {' to '.join(map(str, counts[:: max(len(counts) - 1, 1)]))} |")
    return "\n".join(lines) + "\n"


def _quote(interval) -> str:
    if np.isnan(interval.lower):
        return f"{interval.value:.3f}"
    return f"{interval.value:.3f} ({interval.lower:.3f} to {interval.upper:.3f})"
