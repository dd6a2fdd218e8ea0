"""Figures of learning curves and areas, for pages and papers: colour-blind safe, one colour per method everywhere."""

from __future__ import annotations

import os
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import EngFormatter

from torchrl_etdmpc.analysis.runs import read_evaluations, read_header
from torchrl_etdmpc.analysis.statistics import Z_95, add_interval, interpolate
from torchrl_etdmpc.analysis.steps import no_points
from torchrl_etdmpc.runs import RunDirectory
from torchrl_etdmpc.runs.files import replacing

# The palette of Okabe and Ito, which people with any colour vision tell apart. Published baselines keep their colour in
# every report; the rest goes to the runs in their order. There are more baselines than colours of that palette: others
# have one of Paul Tol's, and dashes where they are another version of a method.
_BASELINES = {
    "BMPC": ("#D55E00", "-", "s"),
    "TD-MPC2": ("#009E73", "-", "^"),
    "DreamerV3": ("#CC79A7", "-", "D"),
    "SAC": ("#E69F00", "-", "v"),
    "DR.Q": ("#882255", "-", "P"),
    "WIMLE": ("#117733", "-", "X"),
    "TD-MPC": ("#44AA99", "-", "<"),
    "SimBa": ("#332288", "-", ">"),
    "SimbaV2-UTD2": ("#AA4499", "-", "p"),
    "SimbaV2-UTD8": ("#AA4499", "--", "h"),
    "SAC (pytorch_sac)": ("#E69F00", "--", "d"),
    "DreamerV3 (author)": ("#CC79A7", "--", "*"),
    "DC-MPC": ("#D55E00", "", "s"),
    "EfficientZero V2": ("#CC3311", "", "P"),
    "FoG": ("#666666", "", "X"),
    "MR.Q": ("#882255", "", "o"),
    "SAC (EZ-V2's figure)": ("#E69F00", "", "v"),
    "TD-MPC2 (EZ-V2's figure)": ("#009E73", "", "^"),
}
_RUNS = ("#0072B2", "#56B4E9", "#000000")
_DASHES = ("-", "--", ":", "-.")


def method_styles(methods: Sequence[str]) -> dict[str, dict[str, str]]:
    """Colour, dash and marker of each method, the same in every figure.

    >>> method_styles(["mine", "BMPC"])["BMPC"]["color"]
    '#D55E00'
    """
    styles, others = {}, 0
    for method in methods:
        if method in _BASELINES:
            styles[method] = dict(zip(("color", "linestyle", "marker"), _BASELINES[method], strict=True))
        else:
            color, dash = _RUNS[others % len(_RUNS)], _DASHES[others // len(_RUNS) % len(_DASHES)]
            styles[method] = {"color": color, "linestyle": dash, "marker": "o"}
            others += 1
    return styles


def plot_run(run_dir: str | os.PathLike[str]) -> Path:
    """Draws the ``curve.png`` of one run: mean return against env steps, with a band of one standard deviation.

    Args:
        run_dir (str or Path): of a run that is under way or done.

    Returns:
        Path: the picture.

    Raises:
        FileNotFoundError: if it has not evaluated, or does not say what was trained.
        ValueError: if no evaluation has a finite return.

    >>> import tempfile
    >>> folder = Path(tempfile.mkdtemp())
    >>> _ = (folder / "config.yaml").write_text("{task: walker-walk, preset: cpu, seed: 1}")
    >>> rows = ["env_steps,decision_steps,updates,wall_time_s,return_mean,return_std,episodes", "0,0,0,1,20,1,10", ""]
    >>> _ = (folder / "eval.csv").write_text(os.linesep.join(rows))
    >>> plot_run(folder).name
    'curve.png'
    """
    directory, header, table = RunDirectory(run_dir), read_header(run_dir), read_evaluations(run_dir)
    mean = table["return_mean"]
    if not np.isfinite(mean).any():
        raise ValueError(f"run_dir={directory} needs an evaluation with a finite return, got none; evaluate first.")
    std = table["return_std"].fillna(0) if "return_std" in table else 0.0
    figure = Figure(figsize=(6.4, 4.0), dpi=150, layout="tight")
    axis = figure.subplots()
    style = {"color": _RUNS[0], "linewidth": 1.5, "marker": "o", "markersize": 4}
    axis.plot(table["env_steps"], mean, **style, label="mean over the evaluation's episodes")
    band = {"color": _RUNS[0], "alpha": 0.18, "linewidth": 0, "label": "\N{PLUS-MINUS SIGN} 1 standard deviation"}
    axis.fill_between(table["env_steps"], mean - std, mean + std, **band)
    _dress(axis, max(table["env_steps"].max(), 1))
    axis.set_xlabel("environment steps")
    axis.set_ylabel("episode return")
    axis.set_title(f"{header['task']}, {header['preset']}, seed {header['seed']}")
    axis.legend(frameon=False, loc="best")
    with replacing(directory.curve) as partial:
        figure.savefig(partial, format="png")
    return directory.curve


def plot_curves(
    estimates: pd.DataFrame,
    *,
    tasks: Sequence[str],
    methods: Sequence[str],
    budget: float,
    points: pd.DataFrame | None = None,
    evaluated: Collection[tuple[str, str, float]] | None = None,
) -> Figure:
    """A grid of tasks: mean return against env steps, shaded 95% intervals (none where the standard error is unknown).

    Lines begin at the first evaluation after 0 env steps; the untrained agent is a marker at 0.

    Args:
        estimates (DataFrame): of returns.
        tasks (sequence of str): one panel each.
        methods (sequence of str): in the order of the legend.
        budget (float): right end of the axis, env steps.
        points (DataFrame, optional): quoted means, drawn as hollow markers that no line joins.
        evaluated (collection of tuple, optional): method, task and env steps of the estimates that are evaluations, and
            have a marker. Default: all of them.

    >>> estimates = pd.DataFrame({"method": "ours", "task": "walker-walk", "env_steps": [0, 10, 20], "mean": 1.0})
    >>> estimates = estimates.assign(standard_error=0.1, seeds=3)
    >>> figure = plot_curves(estimates, tasks=["walker-walk"], methods=["ours"], budget=20)
    >>> [axis.get_title() for axis in figure.axes]
    ['walker-walk']
    """
    points = no_points() if points is None else points[points["task"].isin(tasks) & (points["env_steps"] <= budget)]
    quoted = list(dict.fromkeys(points["method"]))
    columns = min(len(tasks), 4 if len(tasks) > 6 else 3 if len(tasks) > 4 else 2)
    rows = -(-len(tasks) // columns)
    names = [*methods, *(f"{name}, quoted" for name in quoted)]
    width = max(3.1 * columns, 6.2 if len(names) > 6 else 4.5)
    legend = _legend_columns(names, width)
    figure = Figure(figsize=(width, 2.4 * rows + 0.4 + 0.2 * -(-len(names) // legend)), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False)
    styles = method_styles([*methods, *quoted])
    unclipped = {"clip_on": False, "in_layout": False}  # whole markers at the ends of the axis
    found = dict(list(estimates.groupby(["task", "method"])))
    for place, (axis, task) in enumerate(zip(axes.flat, tasks, strict=False)):
        for method in methods:
            curve = found.get((task, method), estimates.iloc[:0])
            _line(axis, curve, styles[method], budget)
            here = curve[curve["env_steps"] <= budget]
            if evaluated is not None:
                there = [(method, task, step) in evaluated for step in here["env_steps"]]
                here = here[np.array(there, bool)]
            axis.plot(
                here["env_steps"],
                here["mean"],
                color=styles[method]["color"],
                marker=styles[method]["marker"],
                linestyle="none",
                markersize=3,
                **unclipped,
            )
        for method in quoted:
            here = points[(points["task"] == task) & (points["method"] == method)]
            axis.plot(here["env_steps"], here["mean"], **_hollow(styles[method]), markersize=5, **unclipped)
        axis.set_title(task, fontsize=10)
        _dress(axis, budget)
        if place + columns >= len(tasks):
            axis.set_xlabel("environment steps", fontsize=9)
        if place % columns == 0:
            axis.set_ylabel("episode return", fontsize=9)
    for axis in axes.flat[len(tasks) :]:
        axis.remove()
    _legend(figure, methods, styles, columns=legend, quoted=quoted)
    return figure


def plot_aggregate(
    aggregates: pd.DataFrame,
    *,
    methods: Sequence[str],
    budget: float,
    ylabel: str,
    points: pd.DataFrame | None = None,
) -> Figure:
    """Aggregate normalised curves with shaded 95% intervals; a single value is a marker with its interval.

    Args:
        aggregates (DataFrame): see :func:`torchrl_etdmpc.analysis.aggregate`.
        methods (sequence of str): in the order of the legend.
        budget (float): right end of the axis, env steps.
        ylabel (str): what the values are.
        points (DataFrame, optional): quoted aggregates ``method, env_steps, mean``, drawn as hollow markers that no
            line joins.

    >>> from torchrl_etdmpc.analysis import AGGREGATE
    >>> curve = pd.DataFrame({"method": "ours", "task": AGGREGATE, "env_steps": [0, 10, 20], "mean": [0.0, 0.5, 1.0]})
    >>> curve = curve.assign(standard_error=0.1, seeds=3)
    >>> plot_aggregate(curve, methods=["ours"], budget=20, ylabel="normalised return").axes[0].get_ylabel()
    'normalised return'
    """
    points = no_points() if points is None else points[points["env_steps"] <= budget].dropna(subset="mean")
    quoted = list(dict.fromkeys(points["method"]))
    trained = aggregates[aggregates["env_steps"] > 0].dropna(subset="mean")
    trained = trained[trained.groupby("method")["env_steps"].transform("min") <= budget]
    named = [method for method in methods if method in set(trained["method"])]
    names = [*named, *(f"{name}, quoted" for name in quoted)]
    width = 6.4 if len(names) > 6 else 4.8
    legend = _legend_columns(names, width)
    figure = Figure(figsize=(width, 3.0 + 0.2 * -(-len(names) // legend)), layout="constrained")
    axis = figure.subplots()
    styles = method_styles([*methods, *quoted])
    unclipped = {"clip_on": False, "in_layout": False}
    for method in named:
        curve, style = trained[trained["method"] == method], styles[method]
        if len(curve) > 1:
            _line(axis, curve, style, budget)
        else:
            half = Z_95 * curve["standard_error"].fillna(0)
            look = {"color": style["color"], "marker": style["marker"], "markersize": 4, "elinewidth": 1}
            axis.errorbar(curve["env_steps"], curve["mean"], yerr=half, linestyle="none", **look, **unclipped)
    for method in quoted:
        here = points[points["method"] == method]
        axis.plot(here["env_steps"], here["mean"], **_hollow(styles[method]), markersize=5, **unclipped)
    _dress(axis, budget)
    axis.set_xlabel("environment steps")
    axis.set_ylabel(ylabel)
    _legend(figure, named, styles, columns=legend, quoted=quoted)
    return figure


def plot_auc(areas: pd.DataFrame, *, methods: Sequence[str], ylabel: str) -> Figure:
    """Bars of aggregate areas with 95% intervals; a method without a value gets no bar and the word "unavailable".

    Args:
        areas (DataFrame): ``method, auc, standard_error``, one row per method.
        methods (sequence of str): in the order of the bars.
        ylabel (str): what the values are.

    >>> from torchrl_etdmpc.analysis import AGGREGATE
    >>> areas = pd.DataFrame({"method": ["ours", "theirs"], "task": AGGREGATE, "auc": [0.15, 0.13]})
    >>> figure = plot_auc(areas.assign(standard_error=0.01, seeds=3), methods=["ours", "theirs"], ylabel="area")
    >>> len(figure.axes[0].patches)
    2
    """
    figure = Figure(figsize=(max(0.9 * len(methods) + 1.2, 3.2), 3.2), layout="constrained")
    axis = figure.subplots()
    styles = method_styles(methods)
    table = areas.set_index("method").reindex(methods)
    for place, (method, row) in enumerate(table.iterrows()):
        if np.isnan(row["auc"]):
            axis.text(place, 0, " unavailable", rotation=90, ha="center", va="bottom", fontsize=8, color="0.4")
            continue
        half = Z_95 * row["standard_error"]
        axis.bar(place, row["auc"], color=styles[method]["color"], width=0.7)
        if not np.isnan(half):
            axis.errorbar(place, row["auc"], yerr=half, color="black", capsize=3, linewidth=1)
    axis.set_xlim(-0.6, len(methods) - 0.4)
    axis.set_xticks(range(len(methods)), methods, rotation=20, ha="right")
    axis.set_ylabel(ylabel)
    axis.grid(axis="y", linewidth=0.5, alpha=0.4)
    axis.spines[["top", "right"]].set_visible(False)
    return figure


def _line(axis, curve: pd.DataFrame, style: dict[str, str], budget: float) -> None:
    """The curve from the first evaluation of the trained agent to the budget, with its interval."""
    curve = curve[curve["env_steps"] > 0].dropna(subset="mean")
    if curve.empty:
        return
    steps = curve["env_steps"].to_numpy(float)
    curve = add_interval(interpolate(curve, np.union1d(steps[steps <= budget], [budget])).dropna(subset="mean"))
    axis.plot(curve["env_steps"], curve["mean"], color=style["color"], linestyle=style["linestyle"], linewidth=1.5)
    axis.fill_between(curve["env_steps"], curve["lower"], curve["upper"], color=style["color"], alpha=0.18, linewidth=0)


def _dress(axis, budget: float) -> None:
    axis.set_xlim(0, budget * 1.02)
    axis.autoscale(axis="y")
    low, high = axis.get_ylim()
    drawn = np.concatenate([np.asarray(line.get_ydata(), float) for line in axis.lines] or [np.empty(0)])
    negative = np.min(drawn, initial=0, where=~np.isnan(drawn)) < 0 or low < -0.1 * high  # or a band is
    axis.set_ylim(low if negative else 0, high)
    axis.xaxis.set_major_formatter(EngFormatter(sep=""))
    axis.grid(linewidth=0.5, alpha=0.4)
    axis.spines[["top", "right"]].set_visible(False)
    axis.tick_params(labelsize=8)


def _legend_columns(names: Sequence[str], width: float) -> int:
    """How many columns of a legend fit into a figure of this width in inches."""
    longest = max(map(len, names), default=0)
    return min(max(int(width / (0.6 + 0.07 * longest)), 1), max(len(names), 1))


def _hollow(style: dict[str, str]) -> dict[str, Any]:
    """The look of a quoted point."""
    return {"color": style["color"], "marker": style["marker"], "linestyle": "none", "markerfacecolor": "none"}


def _legend(
    figure: Figure,
    methods: Sequence[str],
    styles: dict[str, dict[str, str]],
    *,
    columns: int,
    quoted: Sequence[str] = (),
) -> None:
    handles = [Line2D([], [], linewidth=1.5, markersize=4, label=method, **styles[method]) for method in methods]
    handles += [Line2D([], [], markersize=5, label=f"{name}, quoted", **_hollow(styles[name])) for name in quoted]
    figure.legend(handles=handles, loc="outside upper center", ncols=columns, frameon=False, fontsize=9)
