"""A report: tables, figures and one page that puts them together."""

from __future__ import annotations

import contextlib
import io
import os
from pathlib import Path
from typing import Literal

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from torchrl_etdmpc.analysis.comparison import Comparison
from torchrl_etdmpc.analysis.figures import plot_aggregate, plot_auc, plot_curves
from torchrl_etdmpc.analysis.robust import Interval, interquartile_mean, probability_of_improvement, scores_at
from torchrl_etdmpc.analysis.statistics import (
    NORMALISER,
    add_interval,
    aggregate,
    interpolate,
    normalise,
)
from torchrl_etdmpc.analysis.tables import AGGREGATE, result_table, to_csv, to_markdown
from torchrl_etdmpc.runs.files import replacing


def write_report(
    comparison: Comparison, out: str | os.PathLike[str], *, vector: Literal["pdf", "svg"] | None = None
) -> Path:
    """Writes ``auc.csv``, ``final.csv``, their Markdown, the figures and ``index.md``.

    Every file is written beside its name first and all are moved into place at the end, so that an error leaves the old
    report as it was.

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
    contents = {name: text.encode() for name, text in files.items()}
    for name, figure in figures.items():
        for ending in filter(None, ("png", vector)):
            contents[f"{name}.{ending}"] = _picture(figure, name, ending)
    out.mkdir(parents=True, exist_ok=True)
    with contextlib.ExitStack() as stack:
        for name, content in contents.items():
            stack.enter_context(replacing(out / name)).write_bytes(content)
    for ending in {"pdf", "svg"} - {vector}:  # of an earlier report, of other data
        for name in figures:
            (out / f"{name}.{ending}").unlink(missing_ok=True)
    return out / "index.md"


def _picture(figure: Figure, name: str, ending: str) -> bytes:
    """The same data gives the same bytes."""
    memory, undated = io.BytesIO(), {"pdf": {"CreationDate": None}, "svg": {"Date": None}}.get(ending, {})
    with matplotlib.rc_context({"svg.hashsalt": name}):  # its ids are random otherwise
        figure.savefig(memory, format=ending, dpi=160, metadata=undated)
    return memory.getvalue()


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


def _figures(comparison: Comparison) -> dict[str, Figure]:
    normalised = f"return / {NORMALISER} at {comparison.benchmark.budget:,}"
    steps = np.unique(comparison.estimates["env_steps"])
    steps = np.union1d(steps[(steps >= comparison.grid[0]) & (steps <= comparison.budget)], comparison.grid)
    curves = aggregate(normalise(interpolate(comparison.estimates, steps), comparison.constants), comparison.tasks)
    areas = comparison.areas[comparison.areas["task"] == AGGREGATE]
    options = {"methods": comparison.methods, "budget": comparison.budget}
    return {
        "curves": plot_curves(comparison.estimates, tasks=comparison.tasks, **options),
        "aggregate": plot_aggregate(curves, ylabel=normalised, **options),
        "auc": plot_auc(areas, methods=comparison.methods, ylabel="normalised AUC"),
    }


def _page(comparison: Comparison, files: dict[str, str], figures: list[str]) -> str:
    benchmark, grid = comparison.benchmark, comparison.grid
    count, total = len(comparison.tasks), len(benchmark.tasks)
    scope = f"all {total} tasks" if count == total else f"{count} of its {total} tasks, over which aggregates are taken"
    normalised = "Nothing normalises these tasks, so that areas and aggregates are unavailable. "
    if len(comparison.constants):
        by = f"{NORMALISER}'s mean return on the task at {benchmark.budget:,} env steps"
        normalised = f"Normalised by {by}. "
    parts = [
        f"# {benchmark.title}: {', '.join(comparison.methods)}\n",
        f"Budget {comparison.budget:,} environment steps; {scope}. Evaluation grid of the AUC: {grid[0]:,.0f} to "
        f"{grid[-1]:,.0f} every {grid[1] - grid[0]:,.0f} env steps, trapezoid rule, env steps in millions. "
        + normalised
        + "In brackets: number of seeds of each figure. Best in bold, second best in italics; a dash is unavailable.\n",
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
        cells += [
            "" if other == method else _quote(probability_of_improvement(found, complete[other])) for other in complete
        ]
        counts = sorted({len(values) for values in found.values()})
        lines.append(
            f"| {method} | " + " | ".join(cells) + f" | {' to '.join(map(str, counts[:: max(len(counts) - 1, 1)]))} |"
        )
    return "\n".join(lines) + "\n"


def _quote(interval: Interval) -> str:
    if np.isnan(interval.lower):
        return f"{interval.value:.3f}"
    return f"{interval.value:.3f} ({interval.lower:.3f} to {interval.upper:.3f})"
