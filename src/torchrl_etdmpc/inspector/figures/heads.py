"""What the heads say by depth: return tables, weights of the depths and disagreement."""

from __future__ import annotations

from typing import Any

import numpy as np

from torchrl_etdmpc.inspector.figures.drawing import (
    Drawing,
    drawing,
    empty,
    figure_of,
    line,
    plain,
    style,
    titled,
    two_panels,
)
from torchrl_etdmpc.inspector.trace import Trace

_LINES = ("elites", "all candidates", "chosen", "policy", "clicked")


@figure_of
def return_table(trace: Trace, iteration: int = -1, candidate: int | None = None) -> Drawing:
    """Return table of a candidate, depth x dynamics head and value head; by default that of the chosen sequence."""
    if candidate is None:
        table, title = trace.get("chosen_returns"), "chosen sequence"
    else:
        table = None if trace.get("returns") is None else trace["returns"][iteration, candidate]
        title = f"candidate {candidate}, score {trace['scores'][iteration, candidate]:.3f}"
    if table is None:
        return plain(empty)("this planner has no return table")
    depths, heads, values = table.shape
    first = trace.horizon - depths + 1
    cells = {
        "type": "heatmap",
        "z": table.reshape(depths, -1),
        "x": [f"{head + 1}.{value + 1}" for head in range(heads) for value in range(values)],
        "y": [str(depth) for depth in range(first, first + depths)],
        "colorscale": "Cividis",
        "colorbar": titled("return", thickness=12),
        "texttemplate": "%{z:.2f}",
        "hovertemplate": "depth %{y}, %{x}: %{z:.4f}<extra></extra>",
    }
    return drawing(
        [cells],
        max(280, 150 + 28 * depths),
        titled("dynamics head . value head", type="category"),
        titled("depth", type="category", autorange="reversed"),
        title={"text": title, "font": {"size": 13}},
    )


@figure_of
def mixture_weights(trace: Trace, candidate: int | None = None) -> Drawing:
    """Weights that the adaptive score gives the depths, elites' mean in every iteration (thesis Fig. 4.1).

    With a candidate, that candidate's number in every iteration instead.
    """
    weights = trace.get("mixture")
    if weights is None:
        return plain(empty)("only score=adaptive weighs the depths")
    if candidate is None:
        rows = np.stack([_mean_of(of, elites) for of, elites in zip(weights, _finite_elites(trace), strict=True)])
    else:
        rows = weights[:, candidate]
    cells = {
        "type": "heatmap",
        "z": rows,
        "x": [str(depth + 1) for depth in range(rows.shape[1])],
        "y": [str(iteration + 1) for iteration in range(rows.shape[0])],
        "zmin": 0,
        "zmax": 1,
        "colorscale": "Cividis",
        "texttemplate": "%{z:.2f}",
        "colorbar": titled("weight", thickness=12),
        "hovertemplate": "iteration %{y}, depth %{x}: %{z:.3f}<extra></extra>",
    }
    return drawing(
        [cells],
        max(260, 110 + 26 * rows.shape[0]),
        titled("depth", type="category"),
        titled("iteration", type="category", autorange="reversed"),
    )


@figure_of
def disagreement(trace: Trace, iteration: int = -1, candidate: int | None = None) -> Drawing:
    """How far apart the heads are by depth: standard deviation of the returns, and distance of the latents."""
    if trace.get("returns") is None and trace.get("latent_spread") is None:
        return plain(empty)("this planner has no heads")
    axes, headings = two_panels(("returns", "latents"), 0.22)
    for name, title in (("", "std over heads"), ("2", "distance from mean")):
        axes[f"xaxis{name}"] |= titled("depth", dtick=1)
        axes[f"yaxis{name}"] |= titled(title, rangemode="tozero")
    data: list[dict[str, Any]] = []
    for axis, lines_of in (("", _of_returns), ("2", _of_latents)):
        for name, values in lines_of(trace, iteration, candidate):
            depths = np.arange(trace.horizon - len(values) + 1, trace.horizon + 1)
            place = {"xaxis": f"x{axis}", "yaxis": f"y{axis}", "legendgroup": name}
            new = name not in {each["name"] for each in data}
            data.append(line(name, depths, values, showlegend=new, **place, **style(_LINES.index(name))))
    place = {"legend": {"orientation": "h", "y": -0.4}, "margin": {"l": 55, "r": 15, "t": 30, "b": 80}}
    return drawing(data, 300, {}, {}, **axes, **headings, **place)


def _of_returns(trace: Trace, iteration: int, candidate: int | None) -> list[tuple[str, np.ndarray]]:
    if trace.get("returns") is None:
        return []
    returns = trace["returns"][iteration]
    spread = returns.std((-2, -1))
    lines = [("elites", _mean_of(spread, _finite_elites(trace)[iteration])), ("all candidates", spread.mean(0))]
    if trace.get("chosen_returns") is not None:
        lines.append(("chosen", trace["chosen_returns"].std((-2, -1))))
    if trace.get("policy_returns") is not None:
        lines.append(("policy", trace["policy_returns"].std((-2, -1)).mean(0)))
    if candidate is not None:
        lines.append(("clicked", spread[candidate]))
    return lines


def _of_latents(trace: Trace, iteration: int, candidate: int | None) -> list[tuple[str, np.ndarray]]:
    if trace.get("latent_spread") is None:
        return []
    spread = trace["latent_spread"][iteration]
    lines = [("elites", _mean_of(spread, _finite_elites(trace)[iteration])), ("all candidates", spread.mean(0))]
    return lines if candidate is None else [*lines, ("clicked", spread[candidate])]


def _finite_elites(trace: Trace) -> list[np.ndarray]:
    """Indices of the elites that have a finite score, by iteration: the planner gives the others no weight."""
    return [
        elites[np.isfinite(scores[elites])] for elites, scores in zip(trace["elites"], trace["scores"], strict=True)
    ]


def _mean_of(values: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Of some rows ``[N, D]``, NaN without one."""
    return values[rows].mean(0) if len(rows) else np.full(values.shape[1:], np.nan)
