"""Where the candidates lead: principal components of latent space, one panel a dynamics head."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from torchrl_etdmpc.inspector.figures.drawing import (
    AXIS,
    GREEN,
    GREY,
    LAYOUT,
    PINK,
    VERMILION,
    Drawing,
    empty,
    figure_of,
    heading,
    plain,
    titled,
)
from torchrl_etdmpc.inspector.trace import Trace

_RING = 9  # pixels
# Fixed: margins that follow the legend are drawn twice, and where the width changes they are those of the old one.
_MARGIN = {"l": 60, "r": 105, "t": 30, "b": 125, "autoexpand": False}


@figure_of
def latent_plane(
    trace: Trace,
    iteration: int = -1,
    *,
    depth: int | None = None,
    components: tuple[int, int] = (0, 1),
    candidate: int | None = None,
) -> Drawing:
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
        candidate (int, optional): one to mark by a ring, a shape of the layout.
    """
    points = trace.get("points")
    if points is None:
        return plain(empty)("this planner shows no latents")
    depth = trace.horizon if depth is None else depth
    axes = [min(number, points.shape[-1] - 1) for number in components]
    heads, scores = points.shape[3], trace["scores"][iteration]
    kinds, data, rings = _kinds(trace, iteration), [], []
    for head in range(heads):
        number = str(head + 1) if head else ""
        panel = {"xaxis": f"x{number}", "yaxis": f"y{number}", "showlegend": head == 0, "type": "scatter"}
        where = points[iteration, :, depth - 1, head][:, axes]
        for name, symbol, size in (("candidate", "circle", 6), ("elite", "diamond", 9), ("proposal", "triangle-up", 9)):
            shown = np.flatnonzero(kinds == name)
            data.append(
                panel
                | {
                    "x": where[shown, 0],
                    "y": where[shown, 1],
                    "mode": "markers",
                    "name": name,
                    "legendgroup": name,
                    "customdata": shown.tolist(),
                    "hovertemplate": f"{name} %{{customdata}}<br>score %{{marker.color:.3f}}<extra></extra>",
                    "marker": {
                        "symbol": symbol,
                        "size": size,
                        "color": scores[shown],
                        "coloraxis": "coloraxis",
                        # Without it the lowest scores are not seen on a dark page.
                        "line": {"width": 1.2 if name != "candidate" else 0.5, "color": GREY},
                    },
                }
            )
        data += [panel | path for path in _paths(trace, head, depth, axes)]
        if candidate is not None:
            x, y = where[candidate].tolist()
            rings.append(_ring() | {"xref": f"x{number}", "yref": f"y{number}", "xanchor": x, "yanchor": y})
    layout: dict[str, Any] = _panels(trace, axes, scores) | {"shapes": rings}
    for direction in "xy":
        layout[f"{direction}axis"]["range"] = _around([mark[direction] for mark in data])
    return {"data": data, "layout": layout}


def _ring() -> dict[str, Any]:
    """Around a candidate: a shape of the layout, which can be moved without drawing the candidates anew."""
    square = {"x0": -_RING, "x1": _RING, "y0": -_RING, "y1": _RING, "xsizemode": "pixel", "ysizemode": "pixel"}
    return {"type": "circle", "name": "clicked", "line": {"color": PINK, "width": 3}, **square}


def _panels(trace: Trace, axes: list[int], scores: np.ndarray) -> dict[str, Any]:
    """The layout: panels side by side, which share their axes."""
    low, high = _score_range(scores)
    layout: dict[str, Any] = dict(LAYOUT)
    heads, gap, share = trace.num_dynamics, 0.03, trace["explained"]
    width = (1 - gap * (heads - 1)) / heads
    layout["annotations"] = []
    for head in range(heads):
        number, left = str(head + 1) if head else "", head * (width + gap)
        below = titled(f"component {axes[0] + 1} ({share[axes[0]]:.0%})")
        layout[f"xaxis{number}"] = AXIS | {"domain": [left, left + width], "anchor": f"y{number}"} | below
        layout[f"yaxis{number}"] = AXIS | {"domain": [0, 1], "anchor": f"x{number}"}
        if head:
            layout[f"xaxis{number}"]["matches"] = "x"
            layout[f"yaxis{number}"] |= {"matches": "y", "showticklabels": False}
        layout["annotations"].append(heading(f"head {head + 1}", left + width / 2, size=13))
    layout["yaxis"] |= titled(f"component {axes[1] + 1} ({share[axes[1]]:.0%})")
    bar = titled("score", thickness=12)
    return layout | {
        "coloraxis": {"colorscale": "Cividis", "cmin": low, "cmax": high, "colorbar": bar},
        "margin": _MARGIN,
        "legend": {"orientation": "h", "y": -0.23, "yanchor": "top"},  # below the axes' titles, in one row or two
        "clickmode": "event",
        "height": 445,
        "meta": {"ring": _ring()},  # for the script that moves it
    }


def _paths(trace: Trace, head: int, depth: int, axes: list[int]) -> list[dict[str, Any]]:
    """The chosen sequence and the simulator's, in one head's panel."""
    paths = []
    if trace.get("chosen_points") is not None:
        path = np.concatenate([trace["start_point"][None], trace["chosen_points"][:depth, head]])
        paths.append(("chosen", path, "solid", "star", VERMILION))
    if trace.get("real_points") is not None:
        paths.append(("simulator", trace["real_points"][: depth + 1], "dot", "x", GREEN))
    return [
        {
            "x": path[:, axes[0]],
            "y": path[:, axes[1]],
            "mode": "lines+markers",
            "name": name,
            "legendgroup": name,
            "hoverinfo": "skip",  # or it would catch clicks that are meant for a candidate
            "line": {"color": colour, "dash": dash, "width": 2},
            "marker": {
                "symbol": symbol,
                "size": [5] * (len(path) - 1) + [14],
                "color": colour,
                "line": {"width": 1, "color": "white"},
            },
        }
        for name, path, dash, symbol, colour in paths
    ]


def _around(values: Sequence[np.ndarray]) -> list[float]:
    """Limits of an axis that shows all of the values."""
    shown = np.concatenate(values)
    shown = shown[np.isfinite(shown)]
    low, high = (float(shown.min()), float(shown.max())) if len(shown) else (0.0, 0.0)
    margin = 0.06 * (high - low) or 1.0
    return [low - margin, high + margin]


def _kinds(trace: Trace, iteration: int) -> np.ndarray:
    """Of every candidate ``proposal``, ``elite`` or ``candidate``; a proposal among the elites is a proposal."""
    kinds = np.full(trace["scores"].shape[1], "candidate", dtype="<U9")
    kinds[trace["elites"][iteration]] = "elite"
    kinds[trace["proposals"]] = "proposal"
    return kinds


def _score_range(scores: np.ndarray) -> tuple[float, float]:
    """From the 5th percentile up: what is far below hides the rest."""
    finite = scores[np.isfinite(scores)]
    return (0.0, 1.0) if not len(finite) else (float(np.percentile(finite, 5)), float(finite.max()))
