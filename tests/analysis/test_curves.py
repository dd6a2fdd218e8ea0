from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import pytest

pytest.importorskip("matplotlib")
pytest.importorskip("pandas")

import numpy as np  # noqa: E402
import pandas as pd  # noqa: E402

from torchrl_etdmpc.analysis import BENCHMARKS, estimate, read_curves, read_points  # noqa: E402

REFERENCE = Path(__file__).resolve().parents[2] / "src" / "torchrl_etdmpc" / "analysis" / "reference"
PER_SEED = "method,task,seed,env_steps,return_mean\n"
AS_MEANS = "method,task,env_steps,mean,standard_error,seeds\n"


def write(path: Path, content: str | bytes) -> Path:
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def test_a_baseline_per_seed_is_read_as_seed_curves_sorted_and_without_further_columns(tmp_path):
    text = "note,env_steps,return_mean,seed,task,method\nx,1000,4,1,walker-run,mine\ny,0,3,1,walker-run,mine\n"
    table = read_curves(write(tmp_path / "mine.csv", text))
    assert list(table) == ["method", "task", "seed", "env_steps", "return_mean"]
    assert table.to_numpy().tolist() == [["mine", "walker-run", 1, 0.0, 3.0], ["mine", "walker-run", 1, 1000.0, 4.0]]


def test_a_baseline_as_means_is_read_as_estimates(tmp_path):
    text = AS_MEANS + "mine,walker-run,1000,4,0.5,3\nmine,walker-run,0,3,,\n"
    table = read_curves(write(tmp_path / "mine.csv", text))
    assert list(table) == ["method", "task", "env_steps", "mean", "standard_error", "seeds"]
    numbers = table[["env_steps", "mean", "standard_error", "seeds"]].to_numpy()
    np.testing.assert_array_equal(numbers, [[0.0, 3.0, np.nan, np.nan], [1000.0, 4.0, 0.5, 3.0]])


def test_standard_errors_and_seeds_may_be_left_out(tmp_path):
    table = read_curves(write(tmp_path / "mine.csv", "method,task,env_steps,mean\nmine,walker-run,0,3\n"))
    assert table["mean"].tolist() == [3.0]
    assert table[["standard_error", "seeds"]].isna().all(axis=None)


@pytest.mark.parametrize("header", [PER_SEED, AS_MEANS])
def test_a_baseline_with_a_header_only_has_no_rows(tmp_path, header):
    table = read_curves(write(tmp_path / "mine.csv", header))
    assert len(table) == 0
    assert ",".join(table) + "\n" == header


@pytest.mark.parametrize(
    "content, message",
    [
        (PER_SEED + "a,walker-run,1,0,3\na,walker-run,1,0,3\n", "two rows for method=a, task=walker-run, seed=1, env_"),
        (
            AS_MEANS + "a,walker-run,0,3,1,2\na,walker-run,0,4,1,2\n",
            "two rows for method=a, task=walker-run, env_steps=",
        ),
        ("method,env_steps,mean\na,0,3\n", "lacks the column task"),
        ("task,mean\nwalker-run,3\n", "lacks the columns method, env_steps"),
        ("method,task,env_steps\na,walker-run,0\n", "neither the columns seed, return_mean"),
        ("method,task,env_steps,return_mean\na,walker-run,0,1\n", "neither the columns seed, return_mean"),
        ("method,task,decision_steps,mean\na,walker-run,0,3\n", "counts decision_steps only"),
        (
            "method,task,env_steps,decision_steps,mean\na,walker-run,500,500,3\n",
            "mixes units: 500 env_steps beside 500",
        ),
        (AS_MEANS + "a,walker-run,0,high,1,2\n", "column mean must hold numbers"),
        (AS_MEANS + "a,walker-run,0,3,low,2\n", "column standard_error must hold numbers"),
        (AS_MEANS + "a,walker-run,0,3,-1,2\n", "standard_error is at least 0, seeds at least 1; leave empty"),
        (AS_MEANS + "a,walker-run,0,3,,\na,walker-run,10,3,1,0\n", "standard_error is at least 0, seeds at least 1"),
        (PER_SEED + "a,walker-run,1,0,high\n", "column return_mean must hold numbers"),
        (PER_SEED + "a,walker-run,1,0,inf\n", "column return_mean must hold finite numbers"),
        (PER_SEED + "a,walker-run,1,0,-inf\n", "column return_mean must hold finite numbers"),
        (AS_MEANS + "a,walker-run,,3,1,2\n", "every row needs env_steps"),
        (PER_SEED + "a,walker-run,,0,1\n", "every row needs a seed"),
        (PER_SEED + "a,walker-run,,0,1\na,walker-run,2,0,1\n", "every row needs a seed"),
        (b"", "is not a CSV file with a header line"),
        (b"\n\n", "is not a CSV file with a header line"),
        (b"\x89PNG\r\n\x1a\n\x00\x00\x00\rIHDR\x00\xff", "mine.csv"),
        (bytes(range(256)) * 4, "mine.csv"),
    ],
)
def test_a_file_that_is_no_baseline_is_an_error_of_one_line_that_names_it(tmp_path, content, message):
    file = write(tmp_path / "mine.csv", content)
    with pytest.raises(ValueError, match=message) as caught:
        read_curves(file)
    assert str(file) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_baseline_whose_rows_have_more_cells_than_its_header_is_refused_and_not_shifted(tmp_path):
    file = write(tmp_path / "mine.csv", "method,task,env_steps,mean\n1,mine,walker-run,0,3\n2,mine,walker-run,1000,4\n")
    with pytest.raises(ValueError, match=r"mine\.csv"):
        read_curves(file)


@pytest.mark.parametrize("row", [",walker-run,0,3\n", "mine,,0,3\n"])
def test_a_row_without_method_or_task_is_refused_and_not_dropped(tmp_path, row):
    with pytest.raises(ValueError, match=r"mine\.csv"):
        read_curves(write(tmp_path / "mine.csv", "method,task,env_steps,mean\n" + row))


def test_a_missing_baseline_and_a_folder_are_no_files(tmp_path):
    for path in (tmp_path / "none.csv", tmp_path):
        with pytest.raises(FileNotFoundError, match=re.escape(f"no such file of learning curves: {path}")):
            read_curves(path)


@pytest.fixture(scope="module")
def published() -> Mapping[str, pd.DataFrame]:
    """The reference data by our reader and as it is."""
    tables = {name: pd.read_csv(REFERENCE / f"{name}.csv") for name in ("bmpc", "tdmpc2")}
    return tables | {f"{name} read": read_curves(REFERENCE / f"{name}.csv") for name in ("bmpc", "tdmpc2")}


@pytest.mark.parametrize("name, values", [("bmpc", "mean"), ("tdmpc2", "return_mean")])
def test_the_reference_data_loses_nothing_when_read(published, name, values):
    raw, table = published[name], published[f"{name} read"]
    assert len(table) == len(raw) > 2000
    assert table[values].sum() == pytest.approx(raw[values].sum())
    assert table.groupby(["method", "task"]).size().to_dict() == raw.groupby(["method", "task"]).size().to_dict()


@pytest.mark.parametrize("method", ["BMPC", "SAC"])
def test_the_reference_standard_errors_are_those_of_the_published_limits(published, method):
    rows = published["bmpc"].query("method == @method").dropna(subset=["standard_error", "seeds"])
    assert len(rows) > 300
    factor = 2.776 * np.sqrt(1 - 1 / rows["seeds"])  # Student's for five seeds; population to sample deviation
    expected = (rows["upper"] - rows["lower"]) / 2 / factor
    assert (rows["standard_error"] - expected).abs().max() < 0.0051  # rounded to 0.01


def test_the_two_sources_agree_on_sac(published):
    means = published["bmpc"].query("method == 'SAC'").set_index(["task", "env_steps"])
    groups = published["tdmpc2"].query("method == 'SAC'").groupby(["task", "env_steps"])["return_mean"]
    ours = groups.agg(mean="mean", standard_error=lambda values: np.std(values, ddof=1) / np.sqrt(len(values)))
    both = means.join(ours.assign(count=groups.size()).add_suffix("_of_seeds"), how="inner").dropna(subset="seeds")
    assert len(both) > 300
    assert (both["seeds"] == both["count_of_seeds"]).all()
    assert (both["mean"] - both["mean_of_seeds"]).abs().max() < 0.06
    assert (both["standard_error"] - both["standard_error_of_seeds"]).abs().max() < 0.06


def test_the_estimates_of_the_reference_seeds_are_those_of_numpy(published):
    table = estimate(published["tdmpc2 read"]).set_index(["method", "task", "env_steps"])
    values = published["tdmpc2"].query("method == 'TD-MPC2' and task == 'dog-run' and env_steps == 500_000")
    row = table.loc[("TD-MPC2", "dog-run", 500_000)]
    returns = values["return_mean"].to_numpy()
    assert len(returns) == row["seeds"] >= 3
    assert row["mean"] == pytest.approx(np.mean(returns))
    assert row["standard_error"] == pytest.approx(np.std(returns, ddof=1) / np.sqrt(len(returns)))


def test_published_curves_and_quoted_points_name_tasks_of_the_benchmarks_and_their_sources():
    known = {task for benchmark in BENCHMARKS.values() for task in benchmark.tasks}
    readme = (REFERENCE / "README.md").read_text(encoding="utf-8")
    curves, points = read_curves(REFERENCE / "lowbudget.csv"), read_points(REFERENCE / "points.csv")
    assert set(curves["task"]) | set(points["task"]) <= known
    assert len(curves) == 1594 and len(points) == 585
    sources = pd.read_csv(REFERENCE / "lowbudget.csv")["source"].str.split().str[0].unique()
    for repository in sources:
        assert f"github.com/{repository}" in readme
    assert points[points["method"] == "FoG"]["source"].str.contains("the unit of its steps is unverified").all()
    assert set(points["method"]).isdisjoint(curves["method"])


@pytest.mark.parametrize(
    "rows, message",
    [
        ("a,walker-walk,5,1,s\n" * 2, "has two rows for method=a, task=walker-walk, env_steps=5; keep one"),
        ("a,walker-walk,5,1,\n", "every point needs a source, a mean and env_steps above 0"),
        ("a,walker-walk,5,,s\n", "every point needs a source, a mean and env_steps above 0"),
        ("a,walker-walk,0,1,s\n", "every point needs a source, a mean and env_steps above 0"),
        ("a,walker-walk,5,much,s\n", "column mean must hold numbers"),
    ],
)
def test_a_file_of_points_that_is_none_is_one_line(tmp_path, rows, message):
    file = write(tmp_path / "points.csv", "method,task,env_steps,mean,source\n" + rows)
    with pytest.raises(ValueError, match=message):
        read_points(file)
