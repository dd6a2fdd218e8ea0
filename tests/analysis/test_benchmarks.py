from __future__ import annotations

import csv
import dataclasses
from pathlib import Path

import pytest

pytest.importorskip("matplotlib")
pytest.importorskip("pandas")

from torchrl_etdmpc.analysis import BENCHMARKS, benchmark_of, get_benchmark  # noqa: E402
from torchrl_etdmpc.envs import get_task  # noqa: E402

THESIS_TABLES = Path(__file__).resolve().parents[2] / "src/torchrl_etdmpc/analysis/reference/thesis_tables.csv"
ALL = [(benchmark.name, task) for benchmark in BENCHMARKS.values() for task in benchmark.tasks]


def thesis_rows(name: str) -> list[dict[str, str]]:
    with THESIS_TABLES.open(newline="") as file:
        return [row for row in csv.DictReader(file) if row["benchmark"] == name]


@pytest.mark.parametrize("name", BENCHMARKS)
def test_a_benchmark_has_the_tasks_and_the_budget_of_its_thesis_tables(name):
    rows = thesis_rows(name)
    tasks = dict.fromkeys(row["task"] for row in rows if row["task"] != "aggregate")
    assert get_benchmark(name).tasks == tuple(tasks)
    assert {int(row["env_steps"]) for row in rows} == {get_benchmark(name).budget}


def test_the_benchmarks_have_the_sizes_of_the_thesis():
    assert {name: len(benchmark.tasks) for name, benchmark in BENCHMARKS.items()} == {
        "dmc-easy": 21,
        "dmc-hard": 7,
        "humanoidbench-hard": 13,
    }


def test_no_task_is_in_two_benchmarks_or_twice_in_one():
    assert len({task for _, task in ALL}) == len(ALL)


@pytest.mark.parametrize("name", ["dmc-easy", "dmc-hard"])
def test_the_action_repeat_is_that_of_the_environments(name):
    benchmark = get_benchmark(name)
    assert {get_task(task).action_repeat for task in benchmark.tasks} == {benchmark.action_repeat}


@pytest.mark.parametrize("name", BENCHMARKS)
def test_a_benchmark_is_found_by_its_name_by_each_task_and_by_all_of_them(name):
    benchmark = get_benchmark(name)
    assert benchmark.name == name
    assert {benchmark_of([task]).name for task in benchmark.tasks} == {name}
    assert benchmark_of(reversed(benchmark.tasks)) is benchmark


def test_an_unknown_benchmark_is_an_error_that_lists_the_names():
    with pytest.raises(ValueError, match="unknown benchmark 'dmc'; choose one of dmc-easy, dmc-hard, humanoidbench-"):
        get_benchmark("dmc")


def test_a_misspelt_task_is_an_error_with_the_nearest_names():
    with pytest.raises(ValueError, match="unknown task 'walker-wlak'; did you mean walker-walk"):
        benchmark_of(["walker-run", "walker-wlak"])


def test_a_task_like_no_other_is_an_error_that_lists_the_benchmarks():
    with pytest.raises(
        ValueError, match="unknown task 'zzzzzz'; choose tasks of dmc-easy, dmc-hard, humanoidbench-hard"
    ):
        benchmark_of(["zzzzzz"])


def test_tasks_of_two_benchmarks_have_none_in_common():
    with pytest.raises(ValueError, match="several benchmarks: walker-run is of dmc-easy, dog-run is of dmc-hard"):
        benchmark_of(["walker-run", "walker-walk", "dog-run"])


def test_a_benchmark_cannot_be_changed():
    with pytest.raises(dataclasses.FrozenInstanceError):
        get_benchmark("dmc-easy").budget = 1
