from __future__ import annotations

import csv
import io

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip("matplotlib")
pytest.importorskip("pandas")

import numpy as np  # noqa: E402
import pandas as pd  # noqa: E402

from torchrl_etdmpc.analysis import AGGREGATE, rank_methods, result_table, to_csv, to_markdown  # noqa: E402

nan = np.nan
METHODS = ["a", "b", "c"]


def table_of(*rows: list[float], columns: list[str] = METHODS) -> pd.DataFrame:
    names = [f"task-{n}" for n in range(len(rows) - 1)]
    return pd.DataFrame([*rows], index=pd.Index([*names, AGGREGATE], name="task"), columns=columns, dtype=float)


def marks(line: str) -> dict[str, str]:
    """Which mark the cells of a Markdown row have."""
    cells = [cell.strip().split(" ")[0] for cell in line.strip("|").split("|")[1:]]
    return {name: "*" * (len(cell) - len(cell.lstrip("*"))) for name, cell in zip(METHODS, cells, strict=True)}


@settings(deadline=None, max_examples=40)
@given(row=st.lists(st.integers(-3, 3).map(float) | st.just(nan), min_size=1, max_size=5))
def test_nothing_beats_the_best_and_only_the_best_beats_the_second_best(row):
    table = pd.DataFrame([row], index=["x"], columns=list("abcde")[: len(row)])
    best, second = rank_methods(table).loc["x"]
    there = {name: value for name, value in zip(table, row, strict=True) if not np.isnan(value)}
    assert pd.isna(best) == (len(there) < 1)
    assert pd.isna(second) == (len(there) < 2)
    if there:
        assert there[best] == max(there.values())
        rest = {name: value for name, value in there.items() if name != best}
        assert not rest or there[second] == max(rest.values())


@pytest.mark.parametrize(
    "row, best, second",
    [
        ([1.0, 3.0, 2.0], "b", "c"),
        ([2.0, 2.0, 1.0], "a", "b"),
        ([1.0, 2.0, 2.0], "b", "c"),
        ([2.0, 1.0, 1.0], "a", "b"),
        ([5.0, 5.0, 5.0], "a", "b"),
        ([nan, -2.0, -1.0], "c", "b"),
        ([nan, 1.0, nan], "b", None),
        ([nan, nan, nan], None, None),
    ],
)
def test_ranks_by_hand(row, best, second):
    ranks = rank_methods(table_of([0.0, 0.0, 0.0], row)).loc[AGGREGATE]
    assert [None if pd.isna(name) else name for name in ranks] == [best, second]


def test_ties_go_to_the_first_column_however_many_there_are():
    ranks = rank_methods(table_of([1.0] * 40, columns=[str(number) for number in range(40)]))
    assert ranks.loc[AGGREGATE].tolist() == ["0", "1"]


@pytest.mark.parametrize(
    "row, expected",
    [
        ([1.0, 3.0, 2.0], {"a": "", "b": "**", "c": "*"}),
        ([2.0, 2.0, 1.0], {"a": "**", "b": "**", "c": ""}),
        ([2.0, 1.0, 1.0], {"a": "**", "b": "*", "c": "*"}),
        ([2.0, 2.0, 2.0], {"a": "**", "b": "**", "c": "**"}),
        ([nan, 1.0, nan], {"a": "", "b": "", "c": ""}),
        ([nan, nan, nan], {"a": "", "b": "", "c": ""}),
    ],
)
def test_best_is_bold_and_second_best_in_italics(row, expected):
    text = to_markdown(table_of(row), table_of([3, 3, 3]), digits=1)
    assert marks(text.splitlines()[-1]) == expected


def test_markdown_by_hand():
    table, seeds = table_of([12.345, nan, 700.0], [0.5, 0.25, nan]), table_of([3, nan, nan], [3, 1, nan])
    assert to_markdown(table, seeds, digits={"task-0": 1, AGGREGATE: 3}).splitlines() == [
        "| task | a | b | c |",
        "|---|---|---|---|",
        "| task-0 | *12.3* (3) | – | **700.0** (?) |",
        "| Normalized aggregate | **0.500** (3) | *0.250* (1) | – |",
    ]


def test_csv_holds_values_ranks_errors_and_seeds_and_nothing_where_nothing_is_known():
    table, seeds = table_of([1.5, nan, 2.0], [0.5, 0.25, nan]), table_of([3, nan, 1], [3, 1, nan])
    errors = table_of([0.125, nan, nan], [0.0625, nan, nan])
    rows = list(csv.DictReader(io.StringIO(to_csv(table, seeds, errors))))
    assert [row.pop("task") for row in rows] == ["task-0", AGGREGATE]
    text = {"best": "c", "second_best": "a"}
    numbers = {"a": 1.5, "c": 2.0, "a standard_error": 0.125, "a seeds": 3, "c seeds": 1}
    empty = dict.fromkeys(["b", "b standard_error", "c standard_error", "b seeds"], "")
    assert {name: rows[0].pop(name) for name in text} == text
    assert {name: rows[0].pop(name) for name in empty} == empty
    assert {name: float(value) for name, value in rows[0].items()} == numbers
    assert list(rows[1]) == [
        *METHODS,
        *("best", "second_best"),
        *(f"{name} standard_error" for name in METHODS),
        *(f"{name} seeds" for name in METHODS),
    ]


def test_a_row_without_values_has_no_best_in_csv():
    empty = table_of([nan, nan, nan])
    (row,) = csv.DictReader(io.StringIO(to_csv(empty, empty, empty)))
    assert row.pop("task") == AGGREGATE
    assert set(row.values()) == {""}


def test_the_result_table_has_the_rows_and_columns_that_were_asked_for_in_that_order():
    rows = [("a", "x", 1.0), ("b", "x", 2.0), ("a", "y", 3.0), ("a", AGGREGATE, 4.0), ("other", "x", 9.0)]
    values = pd.DataFrame(rows, columns=["method", "task", "auc"])
    expected = [[nan, 3.0], [2.0, 1.0], [nan, 4.0]]
    for arranged in (values, values.iloc[::-1]):
        table = result_table(arranged, tasks=["y", "x"], methods=["b", "a"], column="auc")
        assert list(table.index) == ["y", "x", AGGREGATE]
        assert list(table.columns) == ["b", "a"]
        np.testing.assert_array_equal(table.to_numpy(float), expected)
