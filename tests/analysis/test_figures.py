from __future__ import annotations

import math
import struct
from pathlib import Path

import pytest

pytest.importorskip("matplotlib")
pytest.importorskip("pandas")

import numpy as np  # noqa: E402
import pandas as pd  # noqa: E402
from matplotlib.collections import LineCollection  # noqa: E402
from matplotlib.colors import to_hex  # noqa: E402
from matplotlib.container import BarContainer, ErrorbarContainer  # noqa: E402
from matplotlib.figure import Figure  # noqa: E402

from torchrl_etdmpc.analysis import method_styles, plot_aggregate, plot_auc, plot_curves, plot_run  # noqa: E402
from torchrl_etdmpc.runs import RunDirectory, RunLog  # noqa: E402

METHODS = ("mine", "other", "BMPC", "SAC")
TASKS = ("walker-walk", "cup-catch", "walker-run")
STEPS = np.array([0.0, 40_000.0, 80_000.0, 120_000.0])
BUDGET = 100_000


def estimates(error: float = 5.0, *, methods=METHODS, tasks=TASKS) -> pd.DataFrame:
    rows = [
        (method, task, step, 10.0 * place + step / 1000, error, 3)
        for place, method in enumerate(methods)
        for task in tasks
        for step in STEPS
    ]
    return pd.DataFrame(rows, columns=["method", "task", "env_steps", "mean", "standard_error", "seeds"])


def areas(**values: tuple[float, float]) -> pd.DataFrame:
    rows = [(method, *pair) for method, pair in values.items()]
    return pd.DataFrame(rows, columns=["method", "auc", "standard_error"])


def curves(table: pd.DataFrame, *, tasks=TASKS, methods=METHODS):
    return plot_curves(table, tasks=tasks, methods=methods, budget=BUDGET)


def drawn_lines(axis) -> list:
    return [line for line in axis.lines if line.get_linestyle() != "None"]


def drawn_markers(axis) -> list:
    return [line for line in axis.lines if line.get_linestyle() == "None"]


def interval_corners(axis) -> np.ndarray:
    """All corners of all shaded areas."""
    paths = [path.vertices for shade in axis.collections for path in shade.get_paths()]
    corners = np.concatenate(paths) if paths else np.empty((0, 2))
    return corners[np.isfinite(corners).all(-1)]


def legend_colors(figure) -> dict[str, str]:
    (legend,) = figure.legends
    texts = [text.get_text() for text in legend.get_texts()]
    return dict(zip(texts, [to_hex(line.get_color()) for line in legend.get_lines()], strict=True))


def test_a_method_has_the_same_colour_in_every_figure():
    expected = {method: style["color"].lower() for method, style in method_styles(METHODS).items()}
    aggregate = plot_aggregate(estimates(tasks=TASKS[:1]), methods=METHODS, budget=BUDGET, ylabel="y")
    for figure in (curves(estimates()), aggregate):
        assert legend_colors(figure) == expected
        for axis in figure.axes:
            assert [to_hex(line.get_color()) for line in drawn_lines(axis)] == list(expected.values())
            assert [to_hex(shade.get_facecolor()[0][:3]) for shade in axis.collections] == list(expected.values())
    bars = plot_auc(areas(**dict.fromkeys(METHODS, (1.0, 0.1))), methods=METHODS, ylabel="y").axes[0].patches
    assert [to_hex(bar.get_facecolor()) for bar in bars] == list(expected.values())


def test_baselines_keep_their_colour_whatever_stands_beside_them():
    alone = method_styles(["SAC"])["SAC"]
    assert method_styles(["x", "BMPC", "SAC", "y"])["SAC"] == alone
    assert method_styles(["SAC", "x"])["x"] == method_styles(["x"])["x"]


def test_sixteen_methods_can_be_told_apart():
    names = [*(f"run {n}" for n in range(12)), "BMPC", "TD-MPC2", "DreamerV3", "SAC"]
    looks = {(style["color"], style["linestyle"]) for style in method_styles(names).values()}
    assert len(looks) == len(names)


@pytest.mark.parametrize("tasks", [TASKS, TASKS[::-1], TASKS[:1], (*TASKS, "a", "b", "c", "d", "e")])
def test_there_is_one_panel_per_task_in_order(tasks):
    figure = curves(estimates(), tasks=tasks)
    assert [axis.get_title() for axis in figure.axes] == list(tasks)


def test_curves_go_up_to_the_budget_and_markers_stand_at_evaluations_only():
    for place, axis in enumerate(curves(estimates()).axes):
        assert len(drawn_lines(axis)) == len(drawn_markers(axis)) == len(METHODS), TASKS[place]
        for offset, line in enumerate(drawn_lines(axis)):
            # none to the marker at 0: nobody measured what was learned in between
            np.testing.assert_allclose(line.get_xdata(), [40_000, 80_000, BUDGET])
            np.testing.assert_allclose(line.get_ydata(), 10 * offset + np.array([40, 80, 100]))
        for line in drawn_markers(axis):
            np.testing.assert_array_equal(line.get_xdata(), STEPS[STEPS <= BUDGET])
        assert interval_corners(axis)[:, 0].max() == BUDGET
        low, high = axis.get_xlim()
        assert low == 0 and BUDGET <= high <= 1.05 * BUDGET


def test_quoted_points_are_hollow_markers_that_nothing_joins_and_stand_in_the_legend():
    rows = [
        ("paper", TASKS[0], 20_000, 5.0, "s"),
        ("paper", TASKS[0], 40_000, 7.0, "s"),
        ("paper", "z", 20_000, 9.0, "s"),
    ]
    rows += [("paper", TASKS[0], BUDGET + 1, 8.0, "s")]
    points = pd.DataFrame(rows, columns=["method", "task", "env_steps", "mean", "source"])
    figure = plot_curves(estimates(), tasks=TASKS, methods=METHODS, budget=BUDGET, points=points)
    hollow = [[line for line in axis.lines if line.get_markerfacecolor() == "none"] for axis in figure.axes]
    (line,) = (line for line in hollow[0] if len(line.get_xdata()))
    assert (list(line.get_xdata()), list(line.get_ydata())) == ([20_000, 40_000], [5.0, 7.0])
    assert line.get_linestyle() == "None"
    assert all(len(line.get_xdata()) == 0 for lines in hollow[1:] for line in lines)
    assert "paper, quoted" in legend_colors(figure)


def test_an_aggregate_of_one_evaluation_is_a_marker_with_its_interval():
    table = estimates(5.0, tasks=TASKS[:1])
    table = table[(table["method"] != METHODS[1]) | table["env_steps"].isin([0, 80_000])]  # as BMPC's every 100,000
    figure = plot_aggregate(table, methods=METHODS, budget=BUDGET, ylabel="y")
    (axis,), height = figure.axes, 10 + 80
    assert len(drawn_lines(axis)) == len(METHODS) - 1
    (marker,) = drawn_markers(axis)
    assert (list(marker.get_xdata()), list(marker.get_ydata())) == ([80_000], [height])
    (bar,) = (bars.get_segments()[0] for bars in axis.collections if isinstance(bars, LineCollection))
    np.testing.assert_allclose(bar, [[80_000, height - 9.8], [80_000, height + 9.8]])
    assert {to_hex(marker.get_color())} == {legend_colors(figure)[METHODS[1]]}


def test_quoted_aggregates_are_hollow_markers_up_to_the_budget():
    points = pd.DataFrame(
        {"method": "paper", "env_steps": [40_000, 80_000, BUDGET + 1], "mean": [0.5, np.nan, 0.7]}  # a task is missing
    )
    table = estimates(tasks=TASKS[:1])
    figure = plot_aggregate(table, methods=METHODS, budget=BUDGET, ylabel="y", points=points)
    (line,) = drawn_markers(figure.axes[0])
    assert (list(line.get_xdata()), list(line.get_ydata())) == ([40_000], [0.5])
    assert line.get_markerfacecolor() == "none"
    assert "paper, quoted" in legend_colors(figure)


def test_nothing_is_drawn_between_the_untrained_agent_and_the_first_evaluation():
    table = estimates().query("env_steps == 0 or env_steps == 120_000")  # as baselines that begin after the budget
    for axis in curves(table).axes:
        assert drawn_lines(axis) == [] or all(len(line.get_xdata()) == 0 for line in drawn_lines(axis))
        assert len(interval_corners(axis)) == 0
        assert {tuple(line.get_xdata()) for line in drawn_markers(axis)} == {(0.0,)}


def test_a_legend_of_many_long_names_fits_beside_panels_of_full_size():
    names = [f"a method with a very long name {n}" for n in range(14)]
    figure = curves(estimates(methods=names, tasks=TASKS[:1]), tasks=TASKS[:1], methods=names)
    figure.canvas.draw()
    assert figure.axes[0].get_window_extent().height > 150
    (legend,) = figure.legends
    assert legend.get_window_extent().width <= figure.bbox.width


def test_a_curve_that_ends_early_is_not_drawn_further():
    axis = curves(estimates().query("env_steps <= 40_000")).axes[0]
    assert {line.get_xdata().max() for line in axis.lines} == {40_000}


def test_a_curve_that_begins_after_the_budget_has_no_point():
    axis = curves(estimates().query("env_steps > @BUDGET")).axes[0]
    assert sum(len(line.get_xdata()) for line in axis.lines) == 0
    assert len(interval_corners(axis)) == 0


def test_the_shaded_interval_is_1_96_standard_errors_to_both_sides():
    axis = curves(estimates(5.0, methods=METHODS[:1]), methods=METHODS[:1]).axes[0]
    corners = interval_corners(axis)
    for step, mean in ((40_000, 40), (80_000, 80), (100_000, 100)):
        heights = corners[corners[:, 0] == step][:, 1]
        np.testing.assert_allclose([heights.min(), heights.max()], [mean - 9.8, mean + 9.8])


def test_no_interval_is_drawn_where_the_standard_error_is_unknown():
    aggregate = plot_aggregate(estimates(np.nan, tasks=TASKS[:1]), methods=METHODS, budget=BUDGET, ylabel="y")
    for figure in (curves(estimates(np.nan)), aggregate):
        for axis in figure.axes:
            assert len(interval_corners(axis)) == 0
            assert all(np.isfinite(line.get_ydata()).all() for line in drawn_lines(axis))


def test_an_interval_ends_where_the_standard_error_becomes_unknown():
    table = estimates(5.0)
    table = table.assign(standard_error=table["standard_error"].where(table["env_steps"] <= 40_000))
    for axis in curves(table).axes:
        assert interval_corners(axis)[:, 0].max() == 40_000


def test_a_method_without_a_curve_on_a_task_leaves_the_others_panel_complete():
    axis = curves(estimates().query("method != 'mine'")).axes[0]
    assert [to_hex(line.get_color()) for line in drawn_lines(axis)] == [
        method_styles(METHODS)[name]["color"].lower() for name in METHODS[1:]
    ]


def test_negative_returns_are_within_the_panel():
    table = estimates()
    axis = curves(table.assign(mean=table["mean"] - 500)).axes[0]
    low, high = axis.get_ylim()
    values = np.concatenate([line.get_ydata() for line in axis.lines])
    assert low <= values.min() and values.max() <= high


@pytest.mark.parametrize("lowest", [-1.0, -40.0])
def test_a_return_a_little_below_0_is_within_the_panel_and_the_picture(lowest, tmp_path, run_log, monkeypatch):
    table = estimates()
    axis = curves(table.assign(mean=table["mean"].where(table["env_steps"] > 0, lowest))).axes[0]
    assert axis.get_ylim()[0] < lowest
    drawn = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, path, **_: (drawn.extend(figure.axes), path.write_bytes(b"")))
    evaluate(run_log, lowest, 900.0, 2500.0, std=0.0)
    plot_run(tmp_path)
    assert drawn[0].get_ylim()[0] < lowest


def test_an_interval_a_little_below_0_is_no_reason_to_begin_there():
    table = estimates(error=2.0)
    axis = curves(table.assign(mean=table["mean"].where(table["method"] != "mine", 1.0))).axes[0]
    assert interval_corners(axis)[:, 1].min() < 0 and axis.get_ylim()[0] == 0


def test_markers_stand_where_it_is_said_that_there_are_evaluations():
    evaluated = {("mine", TASKS[0], 40_000.0), ("mine", TASKS[0], 120_000.0), ("SAC", TASKS[1], 0.0)}
    table = estimates().query("method != 'BMPC' or task != 'walker-run'")  # which has no curve there
    figure = plot_curves(table, tasks=TASKS, methods=METHODS, budget=BUDGET, evaluated=evaluated)
    marked = [[x for line in drawn_markers(axis) for x in line.get_xdata()] for axis in figure.axes]
    assert marked == [[40_000], [0], []]


def test_bars_are_as_high_as_their_areas_with_1_96_standard_errors():
    axis = plot_auc(areas(b=(0.5, 0.1), a=(0.25, 0.05)), methods=("a", "b"), ylabel="area").axes[0]
    assert [bar.get_height() for bar in axis.patches] == [0.25, 0.5]
    assert [label.get_text() for label in axis.get_xticklabels()] == ["a", "b"]
    assert axis.get_ylabel() == "area"
    limits = [c.lines[2][0].get_segments()[0][:, 1] for c in axis.containers if isinstance(c, ErrorbarContainer)]
    np.testing.assert_allclose(limits, [[0.25 - 0.098, 0.25 + 0.098], [0.5 - 0.196, 0.5 + 0.196]])


def test_a_bar_without_standard_error_has_no_whisker():
    axis = plot_auc(areas(a=(0.5, np.nan), b=(0.5, 0.1)), methods=("a", "b"), ylabel="y").axes[0]
    assert sum(isinstance(container, ErrorbarContainer) for container in axis.containers) == 1
    assert sum(isinstance(container, BarContainer) for container in axis.containers) == 2


@pytest.mark.parametrize("table", [areas(a=(np.nan, np.nan), b=(0.5, 0.1)), areas(b=(0.5, 0.1))])
def test_an_unavailable_area_has_the_word_and_no_bar(table):
    axis = plot_auc(table, methods=("a", "b"), ylabel="y").axes[0]
    assert [(text.get_text().strip(), text.get_position()[0]) for text in axis.texts] == [("unavailable", 0)]
    (bar,) = axis.patches
    assert bar.get_x() < 1 < bar.get_x() + bar.get_width()


@pytest.fixture
def run_log(tmp_path: Path) -> RunLog:
    directory = RunDirectory(tmp_path)
    directory.begin({"task": "walker-walk", "preset": "cpu", "seed": 1})
    return RunLog(directory, total_env_steps=4000)


def evaluate(log: RunLog, *means: float, std: float = 2.0) -> None:
    for step, mean in enumerate(means):
        results = {"return_mean": mean, "return_std": std, "episodes": 10}
        log.log_eval(results, env_steps=1000 * step, decision_steps=500 * step, updates=step, wall_time_s=9.5)


def png_size(path: Path) -> tuple[int, int]:
    header = path.read_bytes()[:24]
    assert header[:8] == b"\x89PNG\r\n\x1a\n"
    return struct.unpack(">II", header[16:24])


def test_the_picture_of_a_run_is_of_sensible_size_even_with_a_nan_return(tmp_path, run_log):
    evaluate(run_log, 10.0, math.nan, 300.0, 700.0)
    path = plot_run(tmp_path)
    assert path == run_log.directory.curve
    assert png_size(path) == (960, 600)
    assert path.stat().st_size > 10_000
    assert sorted(file.name for file in tmp_path.iterdir()) == [".lock", "config.yaml", "curve.png", "eval.csv"]


def test_the_picture_of_a_run_has_its_means_and_a_deviation_to_both_sides(tmp_path, run_log, monkeypatch):
    drawn = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, path, **_: (drawn.extend(figure.axes), path.write_bytes(b"")))
    evaluate(run_log, 10.0, 300.0, 200.0)
    plot_run(tmp_path)
    assert drawn[0].lines[0].get_xydata().tolist() == [[0, 10], [1000, 300], [2000, 200]]
    assert {tuple(corner) for corner in interval_corners(drawn[0])} == {
        *((0, 8), (0, 12), (1000, 298), (1000, 302), (2000, 198), (2000, 202))
    }


def test_a_single_evaluation_without_a_spread_is_drawn_too(tmp_path, run_log):
    evaluate(run_log, -31.0, std=math.nan)
    assert png_size(plot_run(tmp_path)) == (960, 600)


def test_the_picture_of_a_run_needs_a_finite_return(tmp_path, run_log):
    evaluate(run_log, math.nan)
    with pytest.raises(ValueError, match=r"needs an evaluation with a finite return, got none; evaluate first\.$"):
        plot_run(tmp_path)
    assert not run_log.directory.curve.exists()


def test_the_picture_of_a_run_needs_the_directory_of_a_run(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"has neither config\.yaml nor summary\.json, which name its task and"):
        plot_run(tmp_path)
