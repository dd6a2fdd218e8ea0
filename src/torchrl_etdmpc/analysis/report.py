"""A report: tables, figures and one page that puts them together."""

from __future__ import annotations

import contextlib
import io
import math
import os
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Literal

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from PIL import Image

from torchrl_etdmpc.analysis.comparison import Comparison
from torchrl_etdmpc.analysis.figures import plot_aggregate, plot_auc, plot_curves
from torchrl_etdmpc.analysis.paired import RESAMPLES, paired_markdown
from torchrl_etdmpc.analysis.robust import Interval, interquartile_mean, probability_of_improvement, scores_at
from torchrl_etdmpc.analysis.statistics import (
    NORMALISER,
    add_interval,
    aggregate,
    interpolate,
    normalise,
)
from torchrl_etdmpc.analysis.steps import MEAN, overview, step_table
from torchrl_etdmpc.analysis.tables import AGGREGATE, DASH, escape, result_table, to_csv, to_markdown
from torchrl_etdmpc.runs.files import replacing

PAGE = "index.md"
TABLES = ("auc.csv", "auc.md", "final.csv", "final.md", "returns.csv", "paired.csv")
"""The last two only where the comparison has such rows."""
FIGURES = ("curves", "aggregate", "auc")
"""The last two only where something normalises the tasks, the last one where a method has an area on all of them."""
_FORMATS = ("png", "pdf", "svg")
_GRID = "Evaluation grid of the AUC"
"""On the page of every report, by which its folder is known."""


def require_report_folder(out: str | os.PathLike[str]) -> None:
    """Refuses a folder where a report would replace or remove what no report has written.

    Args:
        out (path): where a report is to be; it need not exist.

    Raises:
        ValueError: if files there have names of a report's, and there is no page of a report beside them.

    >>> require_report_folder("a folder that is not there")
    """
    out = Path(out)
    page = out / PAGE
    if page.is_file() and _GRID in page.read_text(encoding="utf-8", errors="replace"):
        return
    found = [name for name in (PAGE, *TABLES, *_figure_files()) if os.path.lexists(out / name)]
    if found:
        raise ValueError(
            f"{out} holds {', '.join(found)} of something other than a report, which would be lost; choose a folder of "
            "its own for the report."
        )


def write_report(
    comparison: Comparison,
    out: str | os.PathLike[str],
    *,
    vector: Literal["pdf", "svg"] | None = None,
    incomplete: Sequence[str] = (),
) -> Path:
    """Writes ``auc.csv``, ``final.csv``, their Markdown, ``returns.csv``, ``paired.csv``, the figures and ``index.md``.

    ``returns.csv`` (at fixed steps) and ``paired.csv`` are there where the comparison has such rows.

    Every file is written beside its name first and all are moved into place at the end, so that an error leaves the old
    report as it was. What an older report had and this one has not is removed.

    Args:
        comparison (Comparison): see :func:`compare`.
        out (path): folder; made if missing, files of the same name are replaced.
        vector (str, optional): also writes every figure in this format.
        incomplete (sequence of str): lines on runs that are missing or not finished, see :func:`incomplete_runs`.

    Returns:
        Path: of ``index.md``.

    Raises:
        ValueError: as :func:`require_report_folder`.

    >>> import tempfile
    >>> from torchrl_etdmpc.analysis import compare, get_benchmark, seed_estimates
    >>> curve = {"task": "walker-walk", "seed": 1, "env_steps": [0, 100_000, 200_000], "return_mean": [0, 450, 900]}
    >>> runs = pd.concat([pd.DataFrame({**curve, "method": method}) for method in ("BMPC", "ours")])
    >>> nothing = seed_estimates(runs.head(0))
    >>> found = compare(runs, nothing, benchmark=get_benchmark("dmc-easy"), tasks=("walker-walk",))
    >>> page = write_report(found, tempfile.mkdtemp())
    >>> page.name, sorted(file.name for file in page.parent.glob("*.png"))
    ('index.md', ['aggregate.png', 'auc.png', 'curves.png'])
    """
    out = Path(out)
    require_report_folder(out)
    files = _tables(comparison)
    with matplotlib.rc_context({"text.parse_math": False}):  # a name may hold any sign
        figures = _figures(comparison)
    contents = {name: text.encode() for name, text in files.items()}
    for name, figure in figures.items():
        for ending in filter(None, ("png", vector)):
            contents[f"{name}.{ending}"] = _picture(figure, name, ending)
    contents[PAGE] = _page(comparison, files, figures, incomplete).encode()
    out.mkdir(parents=True, exist_ok=True)
    with contextlib.ExitStack() as stack:  # which moves the last one first: no part of a report is without its page
        for name, content in contents.items():
            stack.enter_context(replacing(out / name)).write_bytes(content)
    for name in {*TABLES, *_figure_files()} - set(contents):  # of an earlier report, of other data
        (out / name).unlink(missing_ok=True)
    return out / PAGE


def _figure_files() -> list[str]:
    return [f"{name}.{ending}" for name in FIGURES for ending in _FORMATS]


def _picture(figure: Figure, name: str, ending: str) -> bytes:
    """The same data gives the same bytes."""
    memory, undated = io.BytesIO(), {"pdf": {"CreationDate": None}, "svg": {"Date": None}}.get(ending, {})
    with matplotlib.rc_context({"svg.hashsalt": name}):  # its ids are random otherwise
        figure.savefig(memory, format=ending, dpi=160, metadata=undated)
    if ending != "png":
        return memory.getvalue()
    small = io.BytesIO()  # a palette takes a third of the bytes, and no eye misses the rest
    Image.open(memory).convert("RGB").quantize(256, dither=Image.Dither.NONE).save(small, "png", optimize=True)
    return small.getvalue()


def _wide(comparison: Comparison, values: pd.DataFrame, column: str) -> list[pd.DataFrame]:
    shape = {"tasks": comparison.tasks, "methods": comparison.methods}
    return [result_table(values, column=name, **shape) for name in (column, "seeds", "standard_error")]


def _normalised(comparison: Comparison) -> bool:
    """Whether something normalises one of the tasks."""
    return any(task in comparison.constants.index for task in comparison.tasks)


def _tables(comparison: Comparison) -> dict[str, str]:
    areas, finals = _wide(comparison, comparison.areas, "auc"), _wide(comparison, comparison.finals, "mean")
    files = {
        "auc.csv": to_csv(*areas),
        "auc.md": to_markdown(*areas[:2], digits=3),
        "final.csv": to_csv(*finals),
        "final.md": to_markdown(*finals[:2], digits={**dict.fromkeys(comparison.tasks, 1), AGGREGATE: 3}),
    }
    long = {
        "returns.csv": _with_sources(comparison),
        "paired.csv": comparison.paired,
    }
    for name, table in long.items():
        if len(table):
            files[name] = table.to_csv(index=False, float_format="%.6g", lineterminator="\n")
    return files


def _with_sources(comparison: Comparison) -> pd.DataFrame:
    """The returns with where each quoted number stands; a mean has those of the numbers that it is of."""
    returns, cell = comparison.returns, ["method", "task", "env_steps"]
    quoted = returns.loc[returns["kind"] == "quoted", cell].merge(comparison.points[[*cell, "source"]], on=cell)
    if quoted.empty:
        return returns.assign(source=np.nan)
    together = quoted.groupby(["method", "env_steps"])["source"].agg(lambda texts: "; ".join(dict.fromkeys(texts)))
    return returns.merge(pd.concat([quoted, together.reset_index().assign(task=MEAN)]), how="left", on=cell)


def _figures(comparison: Comparison) -> dict[str, Figure]:
    normalised = f"return / {NORMALISER} at {comparison.benchmark.budget:,}"
    steps = np.unique(comparison.estimates["env_steps"])
    steps = np.union1d(steps[(steps >= comparison.grid[0]) & (steps <= comparison.budget)], comparison.grid)
    curves = aggregate(normalise(interpolate(comparison.estimates, steps), comparison.constants), comparison.tasks)
    points = comparison.points.assign(standard_error=np.nan, seeds=np.nan)
    points = aggregate(normalise(points, comparison.constants), comparison.tasks)
    areas = comparison.areas[comparison.areas["task"] == AGGREGATE]
    options = {"methods": comparison.methods, "budget": comparison.budget}
    known = {"points": comparison.points, "evaluated": comparison.evaluated}
    learned = plot_curves(comparison.estimates, tasks=comparison.tasks, **known, **options)
    figures = {"curves": learned}
    if _normalised(comparison):
        figures["aggregate"] = plot_aggregate(curves, ylabel=normalised, points=points, **options)
    if areas["auc"].notna().any():
        figures["auc"] = plot_auc(areas, methods=comparison.methods, ylabel="normalised AUC")
    return figures


def _page(comparison: Comparison, files: dict[str, str], figures: Collection[str], incomplete: Sequence[str]) -> str:
    benchmark, grid = comparison.benchmark, comparison.grid
    count, total = len(comparison.tasks), len(benchmark.tasks)
    scope = f"all {total} tasks" if count == total else f"{count} of its {total} tasks, over which aggregates are taken"
    normalised = "Nothing normalises these tasks, so that areas and aggregates are unavailable. "
    if _normalised(comparison):
        by = f"{NORMALISER}'s mean return on the task at {benchmark.budget:,} env steps"
        normalised = f"Normalised by {by}. "
    parts = [
        f"# {benchmark.title}: {', '.join(comparison.methods)}\n",
        f"Budget {comparison.budget:,} environment steps; {scope}. {_GRID}: {grid[0]:,.0f} to "
        f"{grid[-1]:,.0f} every {grid[1] - grid[0]:,.0f} env steps, trapezoid rule, env steps in millions. "
        + normalised
        + "In brackets: number of seeds of each figure. Best in bold, second best in italics; equal ones share it. "
        "A dash is not evaluated: no value is made up before a method's first evaluation of the trained agent, beyond "
        "its last one, or for a task that it lacks.\n",
        _incomplete(incomplete),
        _steps(comparison),
        _paired(comparison),
        "## Area under the normalised learning curve\n",
        files["auc.md"],
        "![areas](auc.png)\n" if "auc" in figures else "",
        f"## Return at {comparison.budget:,} environment steps\n",
        "Of runs and published curves; the last row is the mean of normalised returns.\n",
        files["final.md"],
        "## Learning curves\n",
        "Mean over seeds; shaded: 95% interval, 1.96 standard errors, as the thesis has it; with 2, 3 or 5 seeds such "
        "an interval holds the mean in 70, 81 or 88% of cases (Student's t). A line begins at the first evaluation of "
        "the trained agent; a marker at 0 is the untrained one. Hollow markers are quoted, and belong to no line. The "
        "aggregate has what is known on every task; a single value is a marker with its interval.\n",
        "![learning curves](curves.png)\n",
        "![aggregate](aggregate.png)\n" if "aggregate" in figures else "",
        _intervals(comparison),
        _robust(comparison),
    ]
    if comparison.notes:
        parts.append("## About the data\n\n" + "\n".join(f"- {note}" for note in comparison.notes) + "\n")
    return "\n".join(part for part in parts if part)


def _tasks(count: int) -> str:
    return "the one task" if count == 1 else f"the {count} tasks"


def _incomplete(lines: Sequence[str]) -> str:
    if not lines:
        return ""
    return "## Missing and unfinished runs\n\n" + "\n".join(f"- {line}" for line in lines) + "\n"


def _steps(comparison: Comparison) -> str:
    """Returns at fixed steps, of every method that has one, quoted ones included."""
    returns, points = comparison.returns, comparison.points
    if returns.empty:
        return ""
    names = {"tasks": comparison.tasks, "methods": [*dict.fromkeys([*comparison.methods, *points["method"]])]}
    steps = sorted(returns["env_steps"].unique())
    parts = [
        "## Returns at fixed numbers of environment steps\n",
        f"Mean return over {_tasks(len(comparison.tasks))}, best at the last step first; a mean over fewer tasks "
        "says so, and compares with no other. In square brackets: 95% interval, 1.96 standard errors; in round ones: "
        "seeds; both where they are known. ≈ lies on the straight line between two evaluations of the trained "
        "agent; – was not evaluated there.\n",
        overview(returns, **names),
        _same_tasks(comparison),
    ]
    for step in steps:
        here = set(returns[returns["env_steps"] == step]["method"])
        absent = [name for name in names["methods"] if name not in here]
        parts += [f"### At {step:,.0f} environment steps\n", step_table(returns, step, **names)]
        if absent:
            parts.append(f"Not evaluated at {step:,.0f} on any of these tasks: {', '.join(absent)}.\n")
    sources = points.drop_duplicates(["method", "source"])  # those between the steps are in the figures
    if len(sources):
        parts.append("Quoted numbers, which nobody here has measured, without intervals and seeds:\n")
        parts.append("".join(f"- {row.method}: {row.source}\n" for row in sources.itertuples()))
    return "\n".join(part for part in parts if part)


def _same_tasks(comparison: Comparison) -> str:
    """Beside every mean over fewer tasks, the first method's over the same ones."""
    first, lines = comparison.methods[0], []
    by_task = comparison.returns[comparison.returns["task"] != MEAN]
    for (step, method), rows in by_task.groupby(["env_steps", "method"], sort=False):
        ours = by_task[(by_task["env_steps"] == step) & (by_task["method"] == first)]
        ours = ours[ours["task"].isin(rows["task"])]
        if method != first and len(rows) < len(comparison.tasks) and len(ours) == len(rows):
            lines.append(
                f"- On {_tasks(len(rows))} of {method} at {step:,.0f}: {method} {rows['mean'].mean():.0f}, "
                f"{first} {ours['mean'].mean():.0f}.\n"
            )
    return "".join(lines)


def _paired(comparison: Comparison) -> str:
    table = comparison.paired
    if table.empty:
        return ""
    against = f"{table['base'].iloc[0]}, paired by task and seed, at {comparison.budget:,} environment steps"
    normalised = table["task"].str.startswith(AGGREGATE).any()
    over = "Over tasks, differences are of normalised returns. " if normalised else ""
    text = (
        "Difference of returns, and probability that a run of the variant scores more than one of the base (ties "
        f"half), of the runs that both have with the same task and seed. {over}In brackets: 95% percentile interval of "
        f"a bootstrap that resamples pairs within each task ({RESAMPLES:,} resamples; narrower than it should be where "
        "pairs are few, none with one pair on a task). Left out: runs of either without a partner.\n"
    )
    return "\n".join([f"## Variants against {against}\n", text, paired_markdown(table)])


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
            std = DASH if math.isnan(row.std) else f"{row.std:.1f}"
            seeds = "?" if math.isnan(row.seeds) else f"{row.seeds:.0f}"
            lines.append(
                f"| {task} | {escape(row.method)} | {row.mean:.1f} | {std} | {row.standard_error:.1f} | "
                f"{row.lower:.1f} to {row.upper:.1f} | {seeds} |"
            )
    return "\n".join(lines) + "\n"


def _robust(comparison: Comparison) -> str:
    """Interquartile means and probabilities of improvement, for methods known per seed."""
    curves = normalise(comparison.seed_curves, comparison.constants)
    scores = {method: scores_at(curves, method, comparison.budget) for method in comparison.methods}
    complete = {method: found for method, found in scores.items() if set(found) == set(comparison.tasks)}
    if not complete:
        return ""
    pairs = list(complete) if len(complete) > 1 else []
    probability = (
        "P is the probability that a run of the row's method scores more than one of the column's, averaged over "
        "tasks. "
    )
    header = ["method", "interquartile mean", *(f"P(> {escape(name)})" for name in pairs), "seeds per task"]
    lines = [
        f"## Interquartile mean of normalised scores at {comparison.budget:,} environment steps\n",
        "95% percentile intervals of a stratified bootstrap (2,000 resamples of the seeds within each task; narrower "
        f"than they should be where seeds are few). {probability if pairs else ''}Only methods whose runs are known "
        "per seed on all tasks.\n",
        f"| {' | '.join(header)} |",
        "|---" * len(header) + "|",
    ]
    for method, found in complete.items():
        cells = [_quote(interquartile_mean(found))]
        cells += [
            "" if other == method else _quote(probability_of_improvement(found, complete[other])) for other in pairs
        ]
        counts = sorted({len(values) for values in found.values()})
        seeds = " to ".join(map(str, counts[:: max(len(counts) - 1, 1)]))
        lines.append(f"| {escape(method)} | {' | '.join(cells)} | {seeds} |")
    return "\n".join(lines) + "\n"


def _quote(interval: Interval) -> str:
    if np.isnan(interval.lower):
        return f"{interval.value:.3f}"
    return f"{interval.value:.3f} ({interval.lower:.3f} to {interval.upper:.3f})"
