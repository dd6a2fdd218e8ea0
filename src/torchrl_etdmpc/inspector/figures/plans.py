"""What was planned: actions, scores and rewards."""

from __future__ import annotations

from typing import Any

import numpy as np

from torchrl_etdmpc.inspector.figures.drawing import (
    BLUE,
    GREEN,
    ORANGE,
    VERMILION,
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

_MOST_LINES = 6  # action dimensions that are drawn as lines; more are an image


@figure_of
def score_spread(trace: Trace) -> Drawing:
    """Best and worst elite score and the median candidate's after every iteration, and the policy's own."""
    scores = np.where(np.isfinite(trace["scores"]), trace["scores"], -np.inf)
    elites = np.take_along_axis(scores, trace["elites"], 1)
    steps = np.arange(1, trace.iterations + 1)
    data = []
    for number, (name, values) in enumerate(
        (("best elite", elites[:, 0]), ("worst elite", elites[:, -1]), ("median candidate", np.median(scores, 1)))
    ):
        data.append(line(name, steps, np.where(np.isfinite(values), values, np.nan), **style(number)))
    if trace.get("policy_scores") is not None:
        data.append(line("policy", steps, np.full(len(steps), trace["policy_scores"].mean()), **style(5)))
    return drawing(data, 300, titled("iteration", dtick=1), titled("score"))


@figure_of
def plan_gaussian(trace: Trace, iteration: int = -1) -> Drawing:
    """Mean and standard deviation of every action dimension at every step, as one iteration left them."""
    mean, std = trace["mean"][iteration], trace["std"][iteration]
    steps = np.arange(1, len(mean) + 1)
    if mean.shape[1] > _MOST_LINES:
        return _gaussian_image(steps, mean, std)
    data: list[dict[str, Any]] = []
    for number in range(mean.shape[1]):
        look = style(number)
        low, high = mean[:, number] - std[:, number], mean[:, number] + std[:, number]
        band = {
            "type": "scatter",
            "x": np.concatenate([steps, steps[::-1]]),
            "y": np.concatenate([high, low[::-1]]),
            "fill": "toself",
            "fillcolor": _faint(look["line"]["color"]),
            "mode": "lines",
            "line": {"width": 0},
            "hoverinfo": "skip",
            "showlegend": False,
            "legendgroup": str(number),
        }
        said: dict[str, Any] = {
            "customdata": std[:, number],
            "hovertemplate": "step %{x}: %{y:.3f} ± %{customdata:.3f}",
        }
        if len(steps) == 1:  # a band over one step has no width
            said["error_y"] = {"type": "data", "array": std[:, number]}
        mark = line(f"a{number + 1}", steps, mean[:, number], legendgroup=str(number), **said, **look)
        data += [band, mark]
    place = {"legend": {"orientation": "v", "x": 1.02, "y": 1}, "margin": {"l": 55, "r": 60, "t": 30, "b": 45}}
    return drawing(data, 300, titled("step", dtick=1), titled("mean ± std"), **place)


def _gaussian_image(steps: np.ndarray, mean: np.ndarray, std: np.ndarray) -> Drawing:
    axes, headings = two_panels(("mean", "standard deviation"), 0.15)
    names = [str(number + 1) for number in range(mean.shape[1])]
    data = []
    for axis, values, place, limits in (("", mean, 0.43, {"zmin": -1, "zmax": 1}), ("2", std, 1.0, {"zmin": 0})):
        bar = {"thickness": 10, "x": place}
        cells = {"type": "heatmap", "z": values.T, "x": steps, "y": names, "colorscale": "Cividis", "colorbar": bar}
        data.append(cells | limits | {"xaxis": f"x{axis}", "yaxis": f"y{axis}"})
        axes[f"xaxis{axis}"] |= titled("step", dtick=1)
    axes["yaxis"] |= titled("action dimension")
    return drawing(data, max(300, 60 + 12 * mean.shape[1]), {}, {}, **axes, **headings)


@figure_of
def plan_and_policy(trace: Trace) -> Drawing:
    """First action of the plan beside the policy's own."""
    names = [f"action {number + 1}" for number in range(trace["action"].shape[0])]
    bars = [("plan", trace["action"], BLUE, "")]
    if trace.get("policy_action") is not None:
        bars.append(("policy", trace["policy_action"], ORANGE, "/"))
    data = []
    for name, values, colour, pattern in bars:
        marker = {"color": colour, "pattern": {"shape": pattern, "fillmode": "replace"}}
        data.append({"type": "bar", "x": names, "y": values, "name": name, "marker": marker})
    return drawing(data, 300, {}, titled("first action", range=[-1.05, 1.05]), barmode="group")


@figure_of
def reward_check(trace: Trace) -> Drawing:
    """Rewards of the chosen sequence: by each head, and in the simulator."""
    if trace.get("chosen_rewards") is None:
        return plain(empty)("this planner says no rewards of its choice")
    rewards = trace["chosen_rewards"]
    steps = np.arange(1, len(rewards) + 1)
    data = [
        line(f"head {head + 1}", steps, rewards[:, head], **style(head, dash="dash"))
        for head in range(rewards.shape[1])
    ]
    if trace.get("real_rewards") is not None:
        real = trace["real_rewards"]
        look = {"line": {"color": GREEN, "width": 4}, "marker": {"symbol": "x", "size": 10, "color": GREEN}}
        data.append(line("simulator", steps[: len(real)], real, **look))
    return drawing(data, 300, titled("step", dtick=1), titled("reward"))


@figure_of
def compare_plans(trace: Trace, other: Trace) -> Drawing:
    """Difference of two traces' final means, second less first, by action dimension."""
    steps = min(trace.horizon, other.horizon)
    gap = other["mean"][-1, :steps] - trace["mean"][-1, :steps]
    widest = max(float(np.abs(gap).max()), 1e-6)
    cells = {
        "type": "heatmap",
        "z": gap,
        "x": [f"action {number + 1}" for number in range(gap.shape[1])],
        "y": [str(step + 1) for step in range(steps)],
        "zmin": -widest,
        "zmax": widest,
        "colorscale": [[0, BLUE], [0.5, "#f5f5f5"], [1, VERMILION]],
        "colorbar": {"title": {"text": "second - first", "side": "right"}, "thickness": 12},
    }
    if gap.shape[1] <= 12:
        cells["texttemplate"] = "%{z:.2f}"
    rows = titled("step", type="category", autorange="reversed")
    return drawing([cells], max(240, 110 + 26 * steps), {}, rows)


def _faint(colour: str) -> str:
    red, green, blue = (int(colour[place : place + 2], 16) for place in (1, 3, 5))
    return f"rgba({red},{green},{blue},0.15)"
