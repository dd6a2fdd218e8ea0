"""Figures of learning curves and areas, for pages and papers: colour-blind safe, one colour per method everywhere."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import EngFormatter

from torchrl_etdmpc.analysis.curves import read_evaluations, read_header
from torchrl_etdmpc.analysis.statistics import Z_95, add_interval, interpolate
from torchrl_etdmpc.runs import RunDirectory
from torchrl_etdmpc.runs.files import replacing

# The palette of Okabe and Ito, which people with any colour vision tell apart. Published baselines keep their colour in
# every report; the rest goes to the runs in their order.
_BASELINES = {"BMPC": "#D55E00", "TD-MPC2": "#009E73", "DreamerV3": "#CC79A7", "SAC": "#E69F00"}
_RUNS = ("#0072B2", "#56B4E9", "#000000")
_DASHES = ("-", "--", ":", "-.")
_MARKERS = ("o", "s", "^", "D", "v", "P", "X")


def method_styles(methods: Sequence[str]) -> dict[str, dict[str, str]]:
    """Colour, dash and marker of each method, the same in every figure.

    >>> method_styles(["mine", "BMPC"])["BMPC"]["color"]
    '#D55E00'
    """
    styles, others = {}, 0
    for method in methods:
        if method in _BASELINES:
            index = list(_BASELINES).index(method)
            styles[method] = {"color": _BASELINES[method], "linestyle": "-", "marker": _MARKERS[1 + index]}
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


def plot_curves(estimates: pd.DataFrame, *, tasks: Sequence[str], methods: Sequence[str], budget: float) -> Figure:
    """A grid of tasks: mean return against env steps, shaded 95% intervals (none where the standard error is unknown).

    Args:
        estimates (DataFrame): of returns.
        tasks (sequence of str): one panel each.
        methods (sequence of str): in the order of the legend.
        budget (float): right end of the axis, env steps.
    """
    columns = min(len(tasks), 4 if len(tasks) > 4 else 2)
    rows = -(-len(tasks) // columns)
    figure = Figure(figsize=(max(3.1 * columns, 4.5), 2.4 * rows + 0.8), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False)
    styles = method_styles(methods)
    for place, (axis, task) in enumerate(zip(axes.flat, tasks, strict=False)):
        for method in methods:
            curve = estimates[(estimates["task"] == task) & (estimates["method"] == method)]
            _line(axis, curve, styles[method], budget)
            here = curve[curve["env_steps"] <= budget]
            axis.plot(
                here["env_steps"],
                here["mean"],
                color=styles[method]["color"],
                marker=styles[method]["marker"],
                linestyle="none",
                markersize=3,
            )
        axis.set_title(task, fontsize=10)
        _dress(axis, budget)
        if place + columns >= len(tasks):
            axis.set_xlabel("environment steps", fontsize=9)
        if place % columns == 0:
            axis.set_ylabel("episode return", fontsize=9)
    for axis in axes.flat[len(tasks) :]:
        axis.remove()
    _legend(figure, methods, styles, columns=5 if columns > 1 else 3)
    return figure


def plot_aggregate(aggregates: pd.DataFrame, *, methods: Sequence[str], budget: float, ylabel: str) -> Figure:
    """Aggregate normalised curves with shaded 95% intervals.

    Args:
        aggregates (DataFrame): see :func:`torchrl_etdmpc.analysis.aggregate`.
        methods (sequence of str): in the order of the legend.
        budget (float): right end of the axis, env steps.
        ylabel (str): what the values are.
    """
    figure = Figure(figsize=(4.8, 3.4), layout="constrained")
    axis = figure.subplots()
    styles = method_styles(methods)
    for method in methods:
        curve = aggregates[aggregates["method"] == method].assign(task="aggregate")
        _line(axis, curve, styles[method], budget)
    _dress(axis, budget)
    axis.set_xlabel("environment steps")
    axis.set_ylabel(ylabel)
    _legend(figure, methods, styles, columns=3)
    return figure


def plot_auc(areas: pd.DataFrame, *, methods: Sequence[str], ylabel: str) -> Figure:
    """Bars of aggregate areas with 95% intervals; a method without a value gets no bar and the word "unavailable".

    Args:
        areas (DataFrame): ``method, auc, standard_error``, one row per method.
        methods (sequence of str): in the order of the bars.
        ylabel (str): what the values are.
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
    axis.set_ylim(low if low < -0.1 * high else 0, high)
    axis.xaxis.set_major_formatter(EngFormatter(sep=""))
    axis.grid(linewidth=0.5, alpha=0.4)
    axis.spines[["top", "right"]].set_visible(False)
    axis.tick_params(labelsize=8)


def _legend(figure: Figure, methods: Sequence[str], styles: dict[str, dict[str, str]], *, columns: int) -> None:
    handles = [Line2D([], [], linewidth=1.5, markersize=4, label=method, **styles[method]) for method in methods]
    columns = min(len(methods), columns)
    figure.legend(handles=handles, loc="outside upper center", ncols=columns, frameon=False, fontsize=9)
