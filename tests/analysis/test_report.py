from __future__ import annotations

import csv
import os
import re
from pathlib import Path
from typing import BinaryIO

import pytest

pytest.importorskip("matplotlib")
pytest.importorskip("pandas")

import numpy as np  # noqa: E402
import pandas as pd  # noqa: E402
from matplotlib.figure import Figure  # noqa: E402
from PIL import Image  # noqa: E402

from torchrl_etdmpc.analysis import (  # noqa: E402
    AGGREGATE,
    MEAN,
    Comparison,
    compare,
    get_benchmark,
    write_report,
)
from torchrl_etdmpc.analysis import report as module  # noqa: E402

TASKS = ("walker-walk", "walker-run")
STEPS = (0, 100_000, 200_000)
TEXTS = {"auc.csv", "auc.md", "final.csv", "final.md", "index.md", "returns.csv"}
FIGURES = {"curves", "aggregate", "auc"}
FILES = TEXTS | {f"{name}.png" for name in FIGURES}


def draw(file: BinaryIO, size: int = 4) -> None:
    """A picture of noise, which takes a byte a pixel."""
    Image.effect_noise((size, size), 50).save(file, "png")


def comparison(
    *, seeds: int = 2, height: float = 1.0, short: bool = False, points: pd.DataFrame | None = None
) -> Comparison:
    """Ours with some seeds, which may end early on walker-run, beside BMPC's straight lines to 100."""
    ours = [
        ("ours", task, seed, step, height * (seed + step / 2000))
        for task in TASKS
        for seed in range(seeds)
        for step in STEPS[: 2 if short and task == "walker-run" else 3]
    ]
    bmpc = [("BMPC", task, step, step / 2000, 2.0, 5) for task in TASKS for step in STEPS]
    return compare(
        pd.DataFrame(ours, columns=["method", "task", "seed", "env_steps", "return_mean"]),
        pd.DataFrame(bmpc, columns=["method", "task", "env_steps", "mean", "standard_error", "seeds"]),
        benchmark=get_benchmark("dmc-easy"),
        tasks=TASKS,
        points=points,
    )


def test_a_seed_that_is_not_done_adds_no_marker_to_the_curves():
    seeds = {1: (0, 50_000, 100_000, 150_000, 200_000), 2: (0, 50_000, 100_000)}
    ours = [("ours", TASKS[0], seed, step, 1.0 + step) for seed, steps in seeds.items() for step in steps]
    bmpc = [("BMPC", TASKS[0], step, step / 2000, 2.0, 5) for step in range(0, 200_001, 25_000)]
    found = compare(
        pd.DataFrame(ours, columns=["method", "task", "seed", "env_steps", "return_mean"]),
        pd.DataFrame(bmpc, columns=["method", "task", "env_steps", "mean", "standard_error", "seeds"]),
        benchmark=get_benchmark("dmc-easy"),
        tasks=TASKS[:1],
    )
    assert {step for method, _, step in found.evaluated if method == "ours"} == {*seeds[1]}
    axis = module._figures(found)["curves"].axes[0]
    marked = [{*line.get_xdata()} for line in axis.lines if line.get_linestyle() == "None"]
    assert {*seeds[1]} in marked and {*range(0, 200_001, 25_000)} in marked


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def read_table(path: Path) -> dict[str, dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        return {row.pop("task"): row for row in csv.DictReader(file)}


def links(page: Path) -> list[str]:
    return re.findall(r"\]\(([^)]+)\)", page.read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A report with figures as vectors, in a folder whose parents did not exist."""
    out = tmp_path_factory.mktemp("made") / "some" / "where"
    assert write_report(comparison(), out, vector="svg") == out / "index.md"
    return out


def test_a_report_is_exactly_its_files_and_nothing_is_left_beside_it(report):
    assert set(contents(report.parent)) == {
        f"{report.name}/{name}" for name in FILES | {f"{name}.svg" for name in FIGURES}
    }
    assert [path.name for path in report.parent.iterdir()] == [report.name]


def test_figures_are_pictures(report):
    for name in FIGURES:
        assert (report / f"{name}.png").read_bytes().startswith(b"\x89PNG")
        with Image.open(report / f"{name}.png") as picture:
            assert picture.mode == "P"  # a third of the bytes
        assert b"<svg" in (report / f"{name}.svg").read_bytes()


def test_every_link_of_the_page_exists_and_every_figure_is_on_it(report):
    found = links(report / "index.md")
    assert {name for name in found if not (report / name).is_file()} == set()
    assert {f"{name}.png" for name in FIGURES} <= set(found)


def test_the_tables_hold_the_numbers_of_the_comparison(report):
    areas, finals = read_table(report / "auc.csv"), read_table(report / "final.csv")
    assert list(areas) == list(finals) == [*TASKS, AGGREGATE]
    for task in TASKS:
        # seeds 0 and 1 are BMPC's line and one more: mean 0.5 above, standard error 0.5, over a constant of 100
        assert float(finals[task]["ours"]) == pytest.approx(100.5)
        assert float(finals[task]["ours standard_error"]) == pytest.approx(0.5)
        assert float(areas[task]["ours"]) == pytest.approx(0.2 * 0.505)
        assert float(areas[task]["ours standard_error"]) == pytest.approx(0.2 * 0.005)
        assert float(areas[task]["BMPC"]) == pytest.approx(0.1)
        assert float(finals[task]["ours seeds"]) == 2
    assert float(finals[AGGREGATE]["ours"]) == pytest.approx(1.005)
    assert float(areas[AGGREGATE]["ours standard_error"]) == pytest.approx(0.001 / 2**0.5)
    assert areas[AGGREGATE]["BMPC standard_error"] == ""
    assert (areas[AGGREGATE]["best"], areas[AGGREGATE]["second_best"]) == ("ours", "BMPC")


def test_the_page_holds_both_tables_and_what_the_spread_over_seeds_is(report):
    page = (report / "index.md").read_text(encoding="utf-8")
    for name in ("auc.md", "final.md"):
        assert (report / name).read_text(encoding="utf-8") in page
    # mean, standard deviation sqrt(1/2), standard error 1/2, and 1.96 of them to both sides
    assert "| walker-run | ours | 100.5 | 0.7 | 0.5 | 99.5 to 101.5 | 2 |" in page
    assert "all 21 tasks" not in page
    assert "2 of its 21 tasks" in page


def test_the_same_data_gives_the_same_files_and_a_report_replaces_an_old_one(report, tmp_path):
    out = tmp_path / "report"
    write_report(comparison(height=3.0), out, vector="svg")
    old = contents(out)
    (out / "mine.txt").write_text("stays")
    write_report(comparison(), out, vector="svg")
    new = contents(out)
    assert new.pop("mine.txt") == b"stays"
    assert new == contents(report)
    assert all(new[name] != old[name] for name in old)


@pytest.mark.parametrize("which", [1, 3])
def test_a_figure_that_fails_leaves_the_old_report_as_it_was_and_nothing_beside_it(
    without_figures, monkeypatch, tmp_path, which
):
    out = tmp_path / "report"
    write_report(comparison(height=3.0), out)
    old = contents(out)
    calls = []

    def save(figure, file, **options):
        calls.append(file)
        if len(calls) == which:
            raise RuntimeError("no figure today")
        draw(file)

    monkeypatch.setattr(Figure, "savefig", save)
    with pytest.raises(RuntimeError, match="no figure today"):
        write_report(comparison(), out)
    assert contents(out) == old
    assert [path.name for path in tmp_path.iterdir()] == ["report"]


def test_a_full_disk_leaves_the_old_report_as_it_was_and_nothing_beside_it(monkeypatch, small_disk, leave_free):
    monkeypatch.setattr(Figure, "savefig", lambda figure, file, **options: draw(file, 200))
    out = small_disk / "report"
    write_report(comparison(), out)
    old = contents(out)
    for free in (0, 20_000, 60_000, 100_000):
        leave_free(small_disk, free)
        with pytest.raises(OSError, match="No space left on device"):
            write_report(comparison(height=3.0), out)
        assert contents(out) == old
    leave_free(small_disk, None)
    write_report(comparison(height=3.0), out)
    assert set(contents(out)) == FILES and contents(out) != old


def test_a_figure_that_fails_makes_no_report(monkeypatch, tmp_path):
    def fail(*arguments, **options):
        raise RuntimeError("no figure today")

    monkeypatch.setattr(Figure, "savefig", fail)
    with pytest.raises(RuntimeError, match="no figure today"):
        write_report(comparison(), tmp_path / "report")
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def without_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """The page and the tables only, which is much faster."""
    monkeypatch.setattr(Figure, "savefig", lambda figure, file, **options: draw(file))


def test_one_seed_is_a_mean_whose_missing_interval_the_page_explains(without_figures, tmp_path):
    page = write_report(comparison(seeds=1), tmp_path / "report").read_text(encoding="utf-8")
    assert "- ours: one seed on walker-run, walker-walk; a mean of one run, no interval." in page
    assert "nan" not in page.lower()
    row = read_table(tmp_path / "report" / "final.csv")["walker-run"]
    assert float(row["ours"]) == pytest.approx(100)
    assert row["ours standard_error"] == ""
    assert "| walker-run | ours |" not in page  # no row in the table of intervals


def test_what_is_unavailable_is_a_dash_on_the_page_empty_in_csv_and_explained(without_figures, tmp_path):
    page = write_report(comparison(short=True), tmp_path / "report").read_text(encoding="utf-8")
    for name in ("auc", "final"):
        table = read_table(tmp_path / "report" / f"{name}.csv")
        assert [table[task]["ours"] == "" for task in (*TASKS, AGGREGATE)] == [False, True, True]
        lines = (tmp_path / "report" / f"{name}.md").read_text(encoding="utf-8").splitlines()
        assert [line.split("|")[2].strip() == "–" for line in lines[2:]] == [False, True, True]
    assert "- ours ends before 200,000 env steps on walker-run (last evaluation 100,000): unavailable there" in page
    assert "nan" not in page.lower()


def test_without_an_area_on_all_tasks_there_is_no_figure_of_areas(without_figures, tmp_path):
    steps = {"walker-walk": (50_000, 60_000), "walker-run": (60_000,)}
    late = [("ours", task, seed, step, step / 1000) for task in TASKS for seed in (0, 1) for step in steps[task]]
    bmpc = [("BMPC", task, step, step / 2000, 2.0, 5) for task in TASKS for step in STEPS]
    found = compare(
        pd.DataFrame(late, columns=["method", "task", "seed", "env_steps", "return_mean"]),
        pd.DataFrame(bmpc, columns=["method", "task", "env_steps", "mean", "standard_error", "seeds"]),
        benchmark=get_benchmark("dmc-easy"),
        tasks=TASKS,
        budget=60_000,
        grid_step=10_000,
    )
    write_report(comparison(), tmp_path)
    page = write_report(found, tmp_path).read_text(encoding="utf-8")
    assert set(contents(tmp_path)) == FILES - {"auc.png"}
    assert "(aggregate.png)" in page and "(auc.png)" not in page


def test_a_table_of_an_older_report_that_this_one_lacks_is_gone(without_figures, tmp_path):
    write_report(comparison(), tmp_path, vector="svg")
    for name in ("paired.csv", "mine.csv"):
        (tmp_path / name).write_text("of other runs")
    write_report(comparison(), tmp_path)
    assert {path.suffix for path in tmp_path.iterdir()} == {".csv", ".md", ".png"}
    assert {path.name for path in tmp_path.glob("*.csv")} == {"auc.csv", "final.csv", "returns.csv", "mine.csv"}


@pytest.mark.parametrize("name", ["returns.csv", "curves.svg", "index.md"])
def test_a_folder_with_such_files_of_something_else_is_refused_and_stays_as_it_was(without_figures, tmp_path, name):
    (tmp_path / name).write_text("of a paper")
    with pytest.raises(ValueError, match=rf"holds {re.escape(name)} of something other than a report"):
        write_report(comparison(), tmp_path)
    assert contents(tmp_path) == {name: b"of a paper"}


def test_the_page_is_there_before_any_other_file_so_that_what_a_kill_leaves_is_a_report(without_figures, tmp_path):
    moved, move = [], os.replace

    def note(source: Path, target: Path) -> None:
        moved.append(target)
        move(source, target)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "replace", note)
        write_report(comparison(), tmp_path)
    assert Path(moved[0]).name == "index.md" and len(moved) == len(FILES)


def test_methods_known_per_seed_on_all_tasks_have_an_interquartile_mean_on_the_page(without_figures, tmp_path):
    page = write_report(comparison(seeds=2), tmp_path / "report").read_text(encoding="utf-8")
    (row,) = re.findall(r"^\| ours \| ([\d.]+) \(([\d.]+) to ([\d.]+)\) \| 2 \|$", page, re.MULTILINE)
    assert np.array(row, float) == pytest.approx([1.005, 1.0, 1.01])
    assert "P is the probability" not in page  # there is no second method
    assert "Interquartile mean" not in write_report(comparison(short=True), tmp_path / "other").read_text("utf-8")


def test_a_row_of_probabilities_is_how_often_its_method_scores_more_than_the_column_s(without_figures, tmp_path):
    rows = [
        (method, task, seed, step, height + seed)
        for method, height in (("ours", 60.0), ("BMPC", 20.0))
        for task in TASKS
        for seed in (1, 2)
        for step in STEPS
    ]
    curves = pd.DataFrame(rows, columns=["method", "task", "seed", "env_steps", "return_mean"])
    none = pd.DataFrame(columns=["method", "task", "env_steps", "mean", "standard_error", "seeds"])
    found = compare(curves, none, benchmark=get_benchmark("dmc-easy"), tasks=TASKS)
    page = write_report(found, tmp_path).read_text(encoding="utf-8")
    assert "| method | interquartile mean | P(> ours) | P(> BMPC) | seeds per task |" in page
    assert re.search(r"^\| ours \| [^|]+ \|  \| 1\.000 \(1\.000 to 1\.000\) \| 2 \|$", page, re.MULTILINE)
    assert re.search(r"^\| BMPC \| [^|]+ \| 0\.000 \(0\.000 to 0\.000\) \|  \| 2 \|$", page, re.MULTILINE)


def test_seeds_that_differ_from_task_to_task_are_said_from_fewest_to_most(without_figures, tmp_path):
    tasks = ("cartpole-balance", *TASKS)
    ours = [
        ("ours", task, seed, step, step + 1.0)
        for count, task in enumerate(tasks, start=1)
        for seed in range(count)
        for step in STEPS
    ]
    bmpc = [("BMPC", task, step, step + 1.0, 2.0, 5) for task in tasks for step in STEPS]
    found = compare(
        pd.DataFrame(ours, columns=["method", "task", "seed", "env_steps", "return_mean"]),
        pd.DataFrame(bmpc, columns=["method", "task", "env_steps", "mean", "standard_error", "seeds"]),
        benchmark=get_benchmark("dmc-easy"),
        tasks=tasks,
    )
    page = write_report(found, tmp_path).read_text(encoding="utf-8")
    assert "| ours | 1.000 | 1 to 3 |" in page  # one seed has no interval


def test_beside_a_mean_over_fewer_tasks_stands_the_first_method_s_over_the_same_ones(without_figures, tmp_path):
    rows = [("paper", "walker-run", step, 70.0, "s") for step in (100_000, 200_000)]
    quoted = pd.DataFrame(rows, columns=["method", "task", "env_steps", "mean", "source"])
    page = write_report(comparison(short=True, points=quoted), tmp_path).read_text(encoding="utf-8")
    assert "- On the one task of paper at 100,000: paper 70, ours 50.\n" in page
    assert "task of paper at 200,000" not in page  # where ours was not evaluated


def test_quoted_means_stand_in_the_aggregate_where_every_task_has_one(monkeypatch, tmp_path):
    rows = [("paper", task, 50_000, value, "s") for task, value in zip(TASKS, (20.0, 60.0), strict=True)]
    rows += [("paper", TASKS[0], 100_000, 90.0, "s")]
    quoted = pd.DataFrame(rows, columns=["method", "task", "env_steps", "mean", "source"])
    drawn: list[pd.DataFrame] = []

    def plot(aggregates: pd.DataFrame, *, points: pd.DataFrame, **options) -> Figure:
        drawn.append(points.dropna(subset="mean"))
        return Figure()

    monkeypatch.setattr("torchrl_etdmpc.analysis.report.plot_aggregate", plot)
    write_report(comparison(points=quoted), tmp_path)
    (points,) = drawn
    # BMPC's return at 200,000, which normalises, is 100 on both.
    assert points[["method", "env_steps", "mean"]].to_numpy().tolist() == [["paper", 50_000, pytest.approx(0.4)]]


def test_every_quoted_number_has_its_own_source_and_no_other_number_has_one(tmp_path):
    rows = [
        ("BMPC", "walker-run", 20_000, 1.0, "a talk"),  # whose curve begins at 100,000
        ("paper", "walker-walk", 20_000, 1.0, "table 2"),
        ("paper", "walker-walk", 100_000, 2.0, "table 2"),
        ("paper", "walker-run", 100_000, 3.0, "figure 3"),
        ("paper", "walker-walk", 30_000, 1.5, "a poster"),  # a marker, and no cell of a table
    ]
    quoted = pd.DataFrame(rows, columns=["method", "task", "env_steps", "mean", "source"])
    page = write_report(comparison(points=quoted), tmp_path)
    with open(tmp_path / "returns.csv", newline="", encoding="utf-8") as file:
        found = {
            (row["method"], row["task"], int(row["env_steps"])): row["source"]
            for row in csv.DictReader(file)
            if row["source"]
        }
    assert found == {
        ("BMPC", "walker-run", 20_000): "a talk",
        ("BMPC", MEAN, 20_000): "a talk",
        ("paper", "walker-walk", 20_000): "table 2",
        ("paper", MEAN, 20_000): "table 2",
        ("paper", "walker-walk", 100_000): "table 2",
        ("paper", "walker-run", 100_000): "figure 3",
        ("paper", MEAN, 100_000): "table 2; figure 3",
    }
    assert "- paper: table 2\n- paper: figure 3\n- paper: a poster\n" in page.read_text(encoding="utf-8")
