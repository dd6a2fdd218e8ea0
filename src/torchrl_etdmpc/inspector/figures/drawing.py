"""What the figures have in common: they are drawn as plain dictionaries, in the same colours, dashes and marks."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from typing import Any, ParamSpec

Drawing = dict[str, Any]
"""``data`` and ``layout`` as plotly.js takes them."""
_Arguments = ParamSpec("_Arguments")

ORANGE, SKY, GREEN, BLUE, VERMILION, PINK = "#E69F00", "#56B4E9", "#009E73", "#0072B2", "#D55E00", "#CC79A7"
GREY = "#7f7f7f"
_COLOURS = (BLUE, ORANGE, GREEN, PINK, SKY, VERMILION)
_DASHES = ("solid", "dash", "dot", "dashdot", "longdash", "longdashdot")
_MARKS = ("circle", "square", "diamond", "triangle-up", "cross", "x")
LAYOUT: dict[str, Any] = {
    "paper_bgcolor": "rgba(0,0,0,0)",
    "plot_bgcolor": "rgba(0,0,0,0)",
    "font": {"family": "system-ui, sans-serif", "size": 12, "color": GREY},
    "margin": {"l": 55, "r": 15, "t": 30, "b": 45},
    "legend": {"orientation": "h", "y": 1.15},
}
AXIS: dict[str, Any] = {"gridcolor": "rgba(127,127,127,0.25)", "zerolinecolor": "rgba(127,127,127,0.5)"}


def figure_of(draw: Callable[_Arguments, Drawing]) -> Callable[_Arguments, Any]:
    """Makes what a function draws a figure of plotly, which checks it; :func:`plain` gives the function back."""

    @functools.wraps(draw)
    def make(*args: _Arguments.args, **kwargs: _Arguments.kwargs) -> Any:
        from plotly import graph_objects

        return graph_objects.Figure(draw(*args, **kwargs)).update_layout(template="none")

    return make


def plain(figure: Callable[_Arguments, Any]) -> Callable[_Arguments, Drawing]:
    """The same as plain dictionaries, for a page: plotly's checks take up to a tenth of a second a figure."""
    return inspect.unwrap(figure)


def drawing(data: list[dict[str, Any]], height: int, x: dict[str, Any], y: dict[str, Any], **layout: Any) -> Drawing:
    """One panel."""
    return {"data": data, "layout": LAYOUT | {"xaxis": AXIS | x, "yaxis": AXIS | y, "height": height} | layout}


def two_panels(titles: tuple[str, str], gap: float) -> tuple[dict[str, Any], dict[str, Any]]:
    """Layouts of the axes ``x, y`` and ``x2, y2``, and their headings, side by side."""
    width = (1 - gap) / 2
    axes: dict[str, Any] = {}
    headings = []
    for number, (title, left) in enumerate(zip(titles, (0.0, width + gap), strict=True), 1):
        name = "" if number == 1 else "2"
        axes[f"xaxis{name}"] = AXIS | {"domain": [left, left + width], "anchor": f"y{name}"}
        axes[f"yaxis{name}"] = AXIS | {"anchor": f"x{name}"}
        headings.append(heading(title, left + width / 2, size=16))
    return axes, {"annotations": headings}


def heading(text: str, middle: float, *, size: int) -> dict[str, Any]:
    """Text above a panel."""
    place = {"x": middle, "y": 1, "xref": "paper", "yref": "paper", "xanchor": "center", "yanchor": "bottom"}
    return {"text": text, "font": {"size": size}, "showarrow": False, **place}


def titled(text: str, **options: Any) -> dict[str, Any]:
    """An axis or a colour bar with a title."""
    return {"title": {"text": text}, **options}


def style(number: int, dash: str | None = None) -> dict[str, Any]:
    """Line and mark of the n-th of several lines."""
    colour = _COLOURS[number % len(_COLOURS)]
    return {
        "line": {"color": colour, "dash": _DASHES[number % len(_DASHES)] if dash is None else dash},
        "marker": {"color": colour, "symbol": _MARKS[number % len(_MARKS)], "size": 7},
    }


def line(name: str, x: Any, y: Any, **options: Any) -> dict[str, Any]:
    """A line with marks."""
    return {"type": "scatter", "mode": "lines+markers", "name": name, "x": x, "y": y, **options}


@figure_of
def empty(text: str) -> Drawing:
    """A sentence in the place of a figure."""
    note = {"text": text, "showarrow": False, "x": 0.5, "y": 0.5, "xref": "paper", "yref": "paper"}
    return drawing([], 120, {"visible": False}, {"visible": False}, annotations=[note])
