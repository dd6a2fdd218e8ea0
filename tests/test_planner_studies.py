"""The tables of benchmarks/planner_studies.py: those that are committed, and their rule for bold type."""

from __future__ import annotations

import importlib
from pathlib import Path

import pytest

pytest.importorskip("pandas")
pytest.importorskip("matplotlib")

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
pytestmark = pytest.mark.skipif(not BENCHMARKS.exists(), reason="needs a checkout")


@pytest.fixture
def script(monkeypatch):
    monkeypatch.syspath_prepend(BENCHMARKS)
    return importlib.import_module("planner_studies")


def test_the_committed_tables_are_those_of_the_committed_files(script):
    assert (script.FOLDER / "README.md").read_text() == script.report(script.FOLDER)


def test_the_page_has_the_rows_of_the_tables(script):
    page = (BENCHMARKS.parent / "docs" / "studies" / "planner.md").read_text().splitlines()
    rows = [line for line in script.report(script.FOLDER).splitlines() if line.startswith("| ")]
    assert len(rows) > 30
    assert [row for row in rows if row not in page] == []


@pytest.mark.parametrize(
    ("low", "high", "without", "expected"),
    [
        (0.1, 2.0, 0, "**+1.0 [+0.1, +2.0]**"),
        (-0.1, 2.0, 0, "+1.0 [-0.1, +2.0]"),
        (-2.0, -0.1, 0, "**+1.0 [-2.0, -0.1]**"),
        (0.9, 1.1, 1, "+1.0 [+0.9, +1.1]"),
        (0.1, 2.0, None, "+1.0 [+0.1, +2.0]"),
    ],
)
def test_bold_is_an_interval_without_the_number(script, low, high, without, expected):
    assert script.written({"mean": 1.0, "low": low, "high": high}, "mean", 1, without=without) == expected
