from __future__ import annotations

import pytest

pytest.importorskip("pandas")

import numpy as np  # noqa: E402
import pandas as pd  # noqa: E402

from torchrl_etdmpc.analysis import MEAN, no_points, returns_at  # noqa: E402
from torchrl_etdmpc.analysis.steps import overview, step_table  # noqa: E402

TASKS = ("x", "y")


def curve(method: str, task: str, values: dict[int, float], *, error: float = 1.0, seeds: float = 3) -> pd.DataFrame:
    columns = {"method": method, "task": task, "env_steps": list(values), "mean": list(values.values())}
    return pd.DataFrame({**columns, "standard_error": error, "seeds": seeds})


def quote(method: str, task: str, step: float, mean: float) -> pd.DataFrame:
    return pd.DataFrame({"method": [method], "task": task, "env_steps": step, "mean": mean, "source": "a paper"})


ESTIMATES = pd.concat(
    [
        curve("a", "x", {0: 0, 20: 2, 50: 8}, error=3.0),
        curve("a", "y", {0: 0, 20: 4, 50: 6}, error=4.0),
        curve("late", "x", {0: 5, 100: 90}),  # nothing is known of it at 20 and 50
        curve("late", "y", {0: 5, 50: 60, 100: 90}),
        curve("between", "x", {40: 10, 60: 30}),
        curve("between", "y", {40: 10, 60: 20}),
    ]
)
POINTS = pd.concat([quote("paper", "x", 50, 70.0), quote("paper", "y", 50, 90.0), quote("paper", "x", 40, 1.0)])


def table(points: pd.DataFrame = POINTS, **options) -> pd.DataFrame:
    options = {"steps": (20, 50), "tasks": TASKS, "methods": ("a", "late", "between")} | options
    return returns_at(ESTIMATES, points, **options).set_index(["method", "task", "env_steps"])


def test_a_method_has_a_value_where_it_was_evaluated_or_between_two_evaluations_and_nowhere_else():
    found = table()
    assert found.loc[("a", "x", 20), ["mean", "kind"]].tolist() == [2, "evaluated"]
    assert found.loc[("between", "x", 50), ["mean", "kind"]].tolist() == [20, "interpolated"]
    assert ("between", "x", 20) not in found.index
    assert ("late", "x", 50) not in found.index and ("late", "y", 20) not in found.index
    assert found.loc[("late", "y", 50), "mean"] == 60


def test_the_mean_is_over_the_tasks_that_have_a_value_and_counts_them():
    found = table()
    row = found.loc[("a", MEAN, 50)]
    assert row[["mean", "standard_error", "tasks", "seeds"]].tolist() == [7, pytest.approx(5 / 2), 2, 3]
    assert (row["upper"] - row["lower"]) / 2 == pytest.approx(1.96 * 2.5)
    assert found.loc[("late", MEAN, 50), ["mean", "tasks"]].tolist() == [60, 1]
    assert found.loc[("between", MEAN, 50), "kind"] == "interpolated"


def test_a_mean_is_interpolated_if_one_task_is_and_of_the_fewest_seeds():
    estimates = pd.concat([curve("a", "x", {50: 1.0}, seeds=5), curve("a", "y", {40: 1.0, 60: 3.0}, seeds=2)])
    found = returns_at(estimates, no_points(), steps=[50], tasks=TASKS, methods=["a"]).set_index("task")
    assert found.loc[MEAN, ["kind", "seeds"]].tolist() == ["interpolated", 2]


def test_where_a_method_has_a_curve_and_a_quote_the_curve_counts():
    points = pd.concat([quote("a", "x", 50, 100.0), quote("between", "y", 50, 100.0), quote("late", "x", 50, 100.0)])
    found = table(points)
    assert found.index.is_unique
    for method, mean, kind in (("a", 7, "evaluated"), ("between", 17.5, "interpolated"), ("late", 80, "quoted")):
        assert found.loc[(method, MEAN, 50), ["mean", "kind", "tasks"]].tolist() == [mean, kind, 2]


def test_of_a_method_that_is_partly_quoted_the_cells_are_marked_and_a_mean_with_an_interpolated_one_is_such():
    estimates = pd.concat([curve("a", "x", {50: 1.0}), curve("b", "x", {40: 1.0, 60: 3.0})])
    points = pd.concat([quote(method, "y", 50, 9.0) for method in "ab"])
    found = returns_at(estimates, points, steps=[50], tasks=TASKS, methods=["a", "b"])
    assert found.set_index(["method", "task"]).loc[[("a", MEAN), ("b", MEAN)], "kind"].tolist() == [
        "quoted",
        "interpolated",
    ]
    lines = step_table(found, 50, tasks=TASKS, methods=["a", "b"]).splitlines()
    assert lines[0] == "| task | a | b |"
    assert lines[3:] == ["| y | 9 (quoted) | 9 (quoted) |", f"| {MEAN} | 5 (quoted) | ≈ 6 |"]
    assert "| a (quoted) | 5 |" in overview(found, tasks=TASKS, methods=["a", "b"])


def test_quoted_points_stand_at_their_step_only_and_have_no_interval():
    found = table()
    assert found.loc[("paper", MEAN, 50), ["mean", "kind", "tasks"]].tolist() == [80, "quoted", 2]
    assert found.xs("paper")[["standard_error", "lower", "upper", "seeds"]].isna().all(axis=None)
    assert set(found.xs("paper").index.get_level_values("env_steps")) == {50}  # 40 is no step of the table


def test_tasks_and_methods_that_are_not_compared_count_nowhere():
    pd.testing.assert_frame_equal(table(pd.concat([POINTS, quote("paper", "z", 50, 1000.0)])), table())
    more = pd.concat([ESTIMATES, curve("a", "z", {20: 1000.0, 50: 1000.0}), curve("other", "x", {50: 1000.0})])
    options = {"steps": (20, 50), "tasks": TASKS, "methods": ("a", "late", "between")}
    found = returns_at(more, POINTS, **options).set_index(["method", "task", "env_steps"])
    pd.testing.assert_frame_equal(found, table())


def test_quotes_on_both_sides_of_a_step_are_not_joined():
    points = pd.concat([quote("paper", "x", 10, 1.0), quote("paper", "x", 30, 3.0)])
    assert "paper" not in table(points).index.get_level_values("method")


def test_without_points_and_without_curves_there_is_still_a_table():
    assert len(table(no_points())) == len(table()) - 3
    empty = returns_at(ESTIMATES.iloc[:0], no_points(), steps=[20], tasks=TASKS, methods=())
    assert empty.empty and "kind" in empty


def test_a_page_says_what_is_quoted_interpolated_not_evaluated_and_of_fewer_tasks():
    found = table().reset_index()
    names = {"tasks": TASKS, "methods": ("a", "late", "between", "paper", "absent")}
    lines = step_table(found, 50, **names).splitlines()
    assert lines == [
        "| task | a | late | between | paper (quoted) |",
        "|---|---|---|---|---|",
        "| x | 8 [2, 14] (3) | – | ≈ 20 [18, 22] (3) | 70 |",
        "| y | 6 [-2, 14] (3) | 60 [58, 62] (3) | ≈ 15 [13, 17] (3) | 90 |",
        f"| {MEAN} | 7 [2, 12] (3) | 60 [58, 62] (3), 1 of 2 tasks | ≈ 18 [16, 19] (3) | 80 |",
    ]
    assert overview(found, **names).splitlines() == [
        "| method | 20 | 50 |",
        "|---|---|---|",
        "| paper (quoted) | – | 80 |",
        "| between | – | ≈ 18 [16, 19] (3) |",
        "| a | 3 [-2, 8] (3) | 7 [2, 12] (3) |",
        "| late | – | 60 [58, 62] (3), 1 of 2 tasks |",  # a mean over fewer tasks is below whole ones
    ]


def test_rows_and_columns_come_in_the_order_of_the_steps():
    pd.testing.assert_frame_equal(table(steps=(50, 20)), table())
    found = table().reset_index()
    assert found[found["task"] != MEAN]["env_steps"].is_monotonic_increasing
    names = {"tasks": TASKS, "methods": ("a",)}
    assert overview(found[::-1], **names).startswith("| method | 20 | 50 |\n")


def test_a_bar_in_a_name_makes_no_column():
    found = returns_at(curve("a|b", "x", {50: 8}), no_points(), steps=[50], tasks=["x"], methods=["a|b"])
    names = {"tasks": ["x"], "methods": ["a|b"]}
    assert "| a\\|b |" in step_table(found, 50, **names) and "| a\\|b |" in overview(found, **names)


def test_an_unknown_error_is_no_interval():
    unknown = curve("a", "x", {50: 8}, error=np.nan, seeds=np.nan)
    found = returns_at(unknown, no_points(), steps=[50], tasks=["x"], methods=["a"])
    assert "| x | 8 |" in step_table(found, 50, tasks=["x"], methods=["a"])
