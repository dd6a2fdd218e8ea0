"""Figures of a trace with plotly (``plotly.graph_objects.Figure``): each is made from the trace alone.

Marks differ in shape as well as in colour, and the colours (cividis, and those of Okabe and Ito) are told apart by
colour-blind people. Backgrounds are transparent, so that a page can be light, dark or printed.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from torchrl_etdmpc.inspector.trace import Trace

__all__ = [
    "FIGURES",
    "candidate_table",
    "compare_plans",
    "disagreement",
    "empty",
    "latent_plane",
    "mixture_weights",
    "plan_and_policy",
    "plain_latent_plane",
    "plan_gaussian",
    "return_table",
    "reward_check",
    "score_spread",
]

ORANGE, SKY, GREEN, BLUE, VERMILION, PINK = "#E69F00", "#56B4E9", "#009E73", "#0072B2", "#D55E00", "#CC79A7"
GREY = "#7f7f7f"
_COLOURS = (BLUE, ORANGE, GREEN, PINK, SKY, VERMILION)
_DASHES = ("solid", "dash", "dot", "dashdot", "longdash", "longdashdot")
_MARKS = ("circle", "square", "diamond", "triangle-up", "cross", "x")
_LAYOUT: dict[str, Any] = {
    "paper_bgcolor": "rgba(0,0,0,0)",
    "plot_bgcolor": "rgba(0,0,0,0)",
    "font": {"family": "system-ui, sans-serif", "size": 12, "color": GREY},
    "margin": {"l": 55, "r": 15, "t": 30, "b": 45},
    "legend": {"orientation": "h", "y": 1.15},
}
_MOST_LINES = 6  # action dimensions that are drawn as lines; more are an image


def latent_plane(
    trace: Trace,
    iteration: int = -1,
    *,
    depth: int | None = None,
    components: tuple[int, int] = (0, 1),
    candidate: int | None = None,
) -> Any:
    """Where an iteration's candidates lead, in principal components of latent space, one panel a dynamics head.

    Circles are candidates, diamonds elites, triangles proposals of the policy, coloured by score; the star and its line
    are the chosen sequence, the cross is where the simulator ended up with it. ``customdata`` of a mark is its
    candidate.

    Args:
        trace (Trace): with latents.
        iteration (int): from 0. Default: the last.

    Keyword Args:
        depth (int, optional): after how many actions, from 1. Default: all of them.
        components (tuple of int): the two that span the plane, from 0.
        candidate (int, optional): one to mark by a ring.
    """
    from plotly import graph_objects

    options: dict[str, Any] = {"depth": depth, "components": components, "candidate": candidate}
    return graph_objects.Figure(plain_latent_plane(trace, iteration, **options)).update_layout(template="none")


def plain_latent_plane(
    trace: Trace,
    iteration: int = -1,
    *,
    depth: int | None = None,
    components: tuple[int, int] = (0, 1),
    candidate: int | None = None,
) -> Any:
    """:func:`latent_plane` as plain dictionaries, without the tenth of a second that plotly's checks take."""
    points = trace.get("points")
    if points is None:
        return empty("this planner shows no latents").to_plotly_json()
    depth = trace.horizon if depth is None else depth
    axes = [min(number, points.shape[-1] - 1) for number in components]
    heads, scores = points.shape[3], trace["scores"][iteration]
    kinds = _kinds(trace, iteration)
    layout, traces = _plane_layout(trace, axes, scores), []
    for head in range(heads):
        number = str(head + 1) if head else ""
        place = {"xaxis": f"x{number}", "yaxis": f"y{number}", "showlegend": head == 0, "type": "scatter"}
        where = points[iteration, :, depth - 1, head]
        for name, symbol, size in (("candidate", "circle", 6), ("elite", "diamond", 9), ("proposal", "triangle-up", 9)):
            shown = np.flatnonzero(kinds == name)
            traces.append(
                {
                    "x": where[shown, axes[0]],
                    "y": where[shown, axes[1]],
                    "mode": "markers",
                    "name": name,
                    "legendgroup": name,
                    "customdata": shown.tolist(),  # dash finds nothing in what plotly packs
                    "hovertemplate": f"{name} %{{customdata}}<br>score %{{marker.color:.3f}}<extra></extra>",
                    "marker": {
                        "symbol": symbol,
                        "size": size,
                        "color": scores[shown],
                        "coloraxis": "coloraxis",
                        "line": {"width": 1.2 if name != "candidate" else 0.5, "color": GREY},
                    },
                    **place,
                }
            )
        for path in _paths(trace, iteration, head, depth, axes, candidate):
            traces.append(path | place)
    return {"data": traces, "layout": layout}


def _plane_layout(trace: Trace, axes: list[int], scores: np.ndarray) -> dict[str, Any]:
    """Panels side by side, which share their axes."""
    low, high = _range(scores)
    layout: dict[str, Any] = dict(_LAYOUT)
    heads, gap, share = trace.num_dynamics, 0.03, trace["explained"]
    width = (1 - gap * (heads - 1)) / heads
    layout["annotations"] = []
    for head in range(heads):
        number, left = str(head + 1) if head else "", head * (width + gap)
        lines = {"gridcolor": "rgba(127,127,127,0.25)", "zerolinecolor": "rgba(127,127,127,0.5)"}
        title = {"text": f"component {axes[0] + 1} ({share[axes[0]]:.0%})"}
        layout[f"xaxis{number}"] = lines | {"domain": [left, left + width], "anchor": f"y{number}", "title": title}
        layout[f"yaxis{number}"] = lines | {"domain": [0, 1], "anchor": f"x{number}"}
        if head:
            layout[f"xaxis{number}"]["matches"] = "x"
            layout[f"yaxis{number}"] |= {"matches": "y", "showticklabels": False}
        text = {"text": f"head {head + 1}", "x": left + width / 2, "y": 1, "yanchor": "bottom", "showarrow": False}
        layout["annotations"].append(text | {"xref": "paper", "yref": "paper", "font": {"size": 13}})
    layout["yaxis"]["title"] = {"text": f"component {axes[1] + 1} ({share[axes[1]]:.0%})"}
    bar = {"title": {"text": "score"}, "thickness": 12}
    return layout | {
        "coloraxis": {"colorscale": "Cividis", "cmin": low, "cmax": high, "colorbar": bar},
        "legend": {"orientation": "h", "y": -0.2},
        "clickmode": "event",
        "height": 400,
    }


def _paths(
    trace: Trace, iteration: int, head: int, depth: int, axes: list[int], candidate: int | None
) -> list[dict[str, Any]]:
    """The chosen sequence, the simulator's and the ring around a candidate, in one head's panel."""
    start = trace["start_point"][None]
    paths, drawn = [], []
    if trace.get("chosen_points") is not None:
        path = np.concatenate([start, trace["chosen_points"][:depth, head]])
        paths.append(("chosen", path, "solid", "star", VERMILION))
    if trace.get("real_points") is not None:
        paths.append(("simulator", trace["real_points"][: depth + 1], "dot", "x", GREEN))
    for name, path, dash, symbol, colour in paths:
        sizes = [5] * (len(path) - 1) + [14]
        drawn.append(
            {
                "x": path[:, axes[0]],
                "y": path[:, axes[1]],
                "mode": "lines+markers",
                "name": name,
                "legendgroup": name,
                "hoverinfo": "skip",  # or it would catch clicks that are meant for a candidate
                "line": {"color": colour, "dash": dash, "width": 2},
                "marker": {"symbol": symbol, "size": sizes, "color": colour, "line": {"width": 1, "color": "white"}},
            }
        )
    if candidate is not None:
        x, y = trace["points"][iteration, candidate, depth - 1, head, axes]
        ring = {"symbol": "circle-open", "size": 18, "color": PINK, "line": {"width": 3}}
        drawn.append(
            {
                "x": [x],
                "y": [y],
                "mode": "markers",
                "name": "clicked",
                "legendgroup": "clicked",
                "hoverinfo": "skip",
                "marker": ring,
            }
        )
    return drawn


def score_spread(trace: Trace) -> Any:
    """Best, median and worst elite score and the median candidate's after every iteration, and the policy's own."""
    scores = np.where(np.isfinite(trace["scores"]), trace["scores"], -np.inf)
    elites = np.take_along_axis(scores, trace["elites"], 1)
    steps = np.arange(1, trace.iterations + 1)
    figure = _figure()
    lines = [
        ("best elite", elites[:, 0]),
        ("worst elite", elites[:, -1]),
        ("median candidate", np.median(scores, 1)),
    ]
    for number, (name, values) in enumerate(lines):
        shown = np.where(np.isfinite(values), values, np.nan)
        figure.add_scatter(x=steps, y=shown, name=name, mode="lines+markers", **_style(number))
    if trace.get("policy_scores") is not None:
        value = np.full(len(steps), trace["policy_scores"].mean())
        figure.add_scatter(x=steps, y=value, name="policy", mode="lines+markers", **_style(5))
    figure.update_xaxes(title_text="iteration", dtick=1)
    figure.update_yaxes(title_text="score")
    return figure.update_layout(height=300)


def plan_gaussian(trace: Trace, iteration: int = -1) -> Any:
    """Mean and standard deviation of every action dimension at every step, as one iteration left them."""
    mean, std = trace["mean"][iteration], trace["std"][iteration]
    steps = np.arange(1, len(mean) + 1)
    if mean.shape[1] > _MOST_LINES:
        figure = _figure(rows=1, cols=2, subplot_titles=["mean", "standard deviation"], horizontal_spacing=0.15)
        names = [str(number + 1) for number in range(mean.shape[1])]
        for column, (values, options) in enumerate(
            ((mean, {"colorscale": "Cividis", "zmin": -1, "zmax": 1}), (std, {"colorscale": "Cividis", "zmin": 0})), 1
        ):
            bar = {"thickness": 10, "x": 0.43 if column == 1 else 1.0}
            figure.add_heatmap(z=values.T, x=steps, y=names, colorbar=bar, **options, row=1, col=column)
        figure.update_xaxes(title_text="step", dtick=1)
        figure.update_yaxes(title_text="action dimension", col=1)
        return figure.update_layout(height=max(300, 60 + 12 * mean.shape[1]))
    figure = _figure()
    for number in range(mean.shape[1]):
        style = _style(number)
        low, high = mean[:, number] - std[:, number], mean[:, number] + std[:, number]
        figure.add_scatter(
            x=np.concatenate([steps, steps[::-1]]),
            y=np.concatenate([high, low[::-1]]),
            fill="toself",
            fillcolor=_faint(style["line"]["color"]),
            mode="lines",
            line={"width": 0},
            hoverinfo="skip",
            showlegend=False,
            legendgroup=str(number),
        )
        figure.add_scatter(
            x=steps,
            y=mean[:, number],
            name=f"a{number + 1}",
            legendgroup=str(number),
            mode="lines+markers",
            customdata=std[:, number],
            hovertemplate="step %{x}: %{y:.3f} ± %{customdata:.3f}",
            **style,
        )
    figure.update_xaxes(title_text="step", dtick=1)
    figure.update_yaxes(title_text="mean ± std")
    return figure.update_layout(height=300, legend={"orientation": "v", "x": 1.02, "y": 1}, margin={"r": 60})


def candidate_table(trace: Trace, iteration: int, candidate: int) -> np.ndarray | None:
    """Return table ``[D, F, V]`` of a candidate."""
    return None if trace.get("returns") is None else trace["returns"][iteration, candidate]


def return_table(trace: Trace, iteration: int = -1, candidate: int | None = None) -> Any:
    """Return table of a candidate, depth x dynamics head and value head; by default that of the chosen sequence."""
    if candidate is None:
        table, title = trace.get("chosen_returns"), "chosen sequence"
    else:
        table = candidate_table(trace, iteration, candidate)
        title = f"candidate {candidate}, score {trace['scores'][iteration, candidate]:.3f}"
    if table is None:
        return empty("this planner has no return table")
    depths, heads, values = table.shape
    names = [f"{head + 1}.{value + 1}" for head in range(heads) for value in range(values)]
    rows = table.reshape(depths, -1)
    first = trace.horizon - depths + 1
    figure = _figure()
    figure.add_heatmap(
        z=rows,
        x=names,
        y=[str(depth) for depth in range(first, first + depths)],
        colorscale="Cividis",
        colorbar={"thickness": 12, "title": "return"},
        texttemplate="%{z:.2f}",
        hovertemplate="depth %{y}, %{x}: %{z:.4f}<extra></extra>",
    )
    figure.update_yaxes(title_text="depth", autorange="reversed", type="category")
    figure.update_xaxes(title_text="dynamics head . value head", type="category")
    return figure.update_layout(height=max(280, 150 + 28 * depths), title={"text": title, "font": {"size": 13}})


def mixture_weights(trace: Trace, candidate: int | None = None) -> Any:
    """Weights that the adaptive score gives the depths, elites' mean in every iteration (thesis Fig. 4.1).

    With a candidate, that candidate's number in every iteration instead.
    """
    weights = trace.get("mixture")
    if weights is None:
        return empty("depths have weights of their own with score=adaptive only")
    if candidate is None:
        rows = np.take_along_axis(weights, trace["elites"][..., None], 1).mean(1)
    else:
        rows = weights[:, candidate]
    figure = _figure()
    figure.add_heatmap(
        z=rows,
        x=[str(depth + 1) for depth in range(rows.shape[1])],
        y=[str(iteration + 1) for iteration in range(rows.shape[0])],
        zmin=0,
        zmax=1,
        colorscale="Cividis",
        texttemplate="%{z:.2f}",
        colorbar={"thickness": 12, "title": "weight"},
        hovertemplate="iteration %{y}, depth %{x}: %{z:.3f}<extra></extra>",
    )
    figure.update_xaxes(title_text="depth", type="category")
    figure.update_yaxes(title_text="iteration", autorange="reversed", type="category")
    return figure.update_layout(height=max(260, 110 + 26 * rows.shape[0]))


def plan_and_policy(trace: Trace) -> Any:
    """First action of the plan beside the policy's own."""
    names = [f"action {number + 1}" for number in range(trace["action"].shape[0])]
    figure = _figure()
    bars = [("plan", trace["action"], BLUE, "")]
    if trace.get("policy_action") is not None:
        bars.append(("policy", trace["policy_action"], ORANGE, "/"))
    for name, values, colour, pattern in bars:
        marker = {"color": colour, "pattern": {"shape": pattern, "fillmode": "replace"}}
        figure.add_bar(x=names, y=values, name=name, marker=marker)
    figure.update_yaxes(title_text="first action", range=[-1.05, 1.05])
    return figure.update_layout(height=300, barmode="group")


def disagreement(trace: Trace, iteration: int = -1, candidate: int | None = None) -> Any:
    """How far apart the heads are by depth: standard deviation of the returns, and distance of the latents."""
    if trace.get("returns") is None and trace.get("latent_spread") is None:
        return empty("this planner has no heads")
    figure = _figure(rows=1, cols=2, subplot_titles=["returns", "latents"], horizontal_spacing=0.22)
    elites = trace["elites"][iteration]
    tables, spreads = [], []
    if trace.get("returns") is not None:
        returns = trace["returns"][iteration]
        tables = [("elites", returns[elites].std((-2, -1)).mean(0)), ("all candidates", returns.std((-2, -1)).mean(0))]
        if trace.get("chosen_returns") is not None:
            tables.append(("chosen", trace["chosen_returns"].std((-2, -1))))
        if trace.get("policy_returns") is not None:
            tables.append(("policy", trace["policy_returns"].std((-2, -1)).mean(0)))
        if candidate is not None:
            tables.append(("clicked", returns[candidate].std((-2, -1))))
    if trace.get("latent_spread") is not None:
        spread = trace["latent_spread"][iteration]
        spreads = [("elites", spread[elites].mean(0)), ("all candidates", spread.mean(0))]
        if candidate is not None:
            spreads.append(("clicked", spread[candidate]))
    styles = {
        name: _style(number) for number, name in enumerate(("elites", "all candidates", "chosen", "policy", "clicked"))
    }
    shown: set[str] = set()
    for column, lines in enumerate((tables, spreads), 1):
        for name, values in lines:
            depths = np.arange(trace.horizon - len(values) + 1, trace.horizon + 1)
            options = {"name": name, "legendgroup": name, "showlegend": name not in shown, "mode": "lines+markers"}
            figure.add_scatter(x=depths, y=values, **options, **styles[name], row=1, col=column)
            shown.add(name)
    figure.update_xaxes(title_text="depth", dtick=1)
    figure.update_yaxes(title_text="std over heads", rangemode="tozero", col=1)
    figure.update_yaxes(title_text="distance from mean", rangemode="tozero", col=2)
    return figure.update_layout(height=300, legend={"orientation": "h", "y": -0.4}, margin={"b": 80})


def reward_check(trace: Trace) -> Any:
    """Rewards of the chosen sequence: by each head, and in the simulator."""
    if trace.get("chosen_rewards") is None:
        return empty("this planner says no rewards of its choice")
    rewards = trace["chosen_rewards"]
    steps = np.arange(1, len(rewards) + 1)
    figure = _figure()
    for head in range(rewards.shape[1]):
        figure.add_scatter(
            x=steps, y=rewards[:, head], name=f"head {head + 1}", mode="lines+markers", **_style(head, dash="dash")
        )
    if trace.get("real_rewards") is not None:
        real = trace["real_rewards"]
        line = {"line": {"color": GREEN, "width": 4}, "marker": {"symbol": "x", "size": 10, "color": GREEN}}
        figure.add_scatter(x=steps[: len(real)], y=real, name="simulator", mode="lines+markers", **line)
    figure.update_xaxes(title_text="step", dtick=1)
    figure.update_yaxes(title_text="reward")
    return figure.update_layout(height=300)


def compare_plans(trace: Trace, other: Trace) -> Any:
    """Difference of two traces' final means and chosen first actions, second less first, by action dimension."""
    steps = min(trace.horizon, other.horizon)
    gap = other["mean"][-1, :steps] - trace["mean"][-1, :steps]
    figure = _figure()
    widest = max(float(np.abs(gap).max()), 1e-6)
    figure.add_heatmap(
        z=gap,
        x=[f"action {number + 1}" for number in range(gap.shape[1])],
        y=[str(step + 1) for step in range(steps)],
        zmin=-widest,
        zmax=widest,
        colorscale=[[0, BLUE], [0.5, "#f5f5f5"], [1, VERMILION]],
        texttemplate="%{z:.2f}" if gap.shape[1] <= 12 else None,
        colorbar={"thickness": 12, "title": "second - first"},
    )
    figure.update_yaxes(title_text="step", autorange="reversed", type="category")
    return figure.update_layout(height=max(240, 110 + 26 * steps))


FIGURES = {
    "latent_plane": "Where the candidates lead, by each head",
    "return_table": "Return table: depth x head",
    "disagreement": "Disagreement of the heads by depth",
    "plan_gaussian": "Plan: mean and standard deviation",
    "score_spread": "Scores over the iterations",
    "plan_and_policy": "Plan against policy",
    "mixture_weights": "Weights of the depths (adaptive score)",
    "reward_check": "Rewards: predicted and in the simulator",
}


def _kinds(trace: Trace, iteration: int) -> np.ndarray:
    """Of every candidate ``proposal``, ``elite`` or ``candidate``; a proposal among the elites is a proposal."""
    kinds = np.full(trace["scores"].shape[1], "candidate", dtype="<U9")
    kinds[trace["elites"][iteration]] = "elite"
    kinds[trace["proposals"]] = "proposal"
    return kinds


def _range(scores: np.ndarray) -> tuple[float, float]:
    """From the 5th percentile up: what is far below hides the rest."""
    finite = scores[np.isfinite(scores)]
    return (0.0, 1.0) if not len(finite) else (float(np.percentile(finite, 5)), float(finite.max()))


def _style(number: int, dash: str | None = None) -> dict[str, Any]:
    colour = _COLOURS[number % len(_COLOURS)]
    return {
        "line": {"color": colour, "dash": _DASHES[number % len(_DASHES)] if dash is None else dash},
        "marker": {"color": colour, "symbol": _MARKS[number % len(_MARKS)], "size": 7},
    }


def _faint(colour: str) -> str:
    red, green, blue = (int(colour[place : place + 2], 16) for place in (1, 3, 5))
    return f"rgba({red},{green},{blue},0.15)"


def _figure(**subplots: Any) -> Any:
    from plotly import graph_objects
    from plotly.subplots import make_subplots

    figure = make_subplots(**subplots) if subplots else graph_objects.Figure()
    figure.update_layout(template="none", **_LAYOUT)
    figure.update_xaxes(gridcolor="rgba(127,127,127,0.25)", zerolinecolor="rgba(127,127,127,0.5)")
    figure.update_yaxes(gridcolor="rgba(127,127,127,0.25)", zerolinecolor="rgba(127,127,127,0.5)")
    return figure


def empty(text: str) -> Any:
    """A sentence in the place of a figure."""
    figure = _figure()
    figure.add_annotation(text=text, showarrow=False, x=0.5, y=0.5, xref="paper", yref="paper")
    figure.update_xaxes(visible=False)
    figure.update_yaxes(visible=False)
    return figure.update_layout(height=120)
