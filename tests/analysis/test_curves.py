from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip("matplotlib")
pytest.importorskip("pandas")

import numpy as np  # noqa: E402
import pandas as pd  # noqa: E402

from torchrl_etdmpc.analysis import (  # noqa: E402
    BENCHMARKS,
    estimate,
    find_runs,
    mixed_settings,
    read_curves,
    read_points,
    read_run,
    read_runs,
)
from torchrl_etdmpc.analysis.curves import Run  # noqa: E402
from torchrl_etdmpc.runs import RunDirectory, RunLog  # noqa: E402

REFERENCE = Path(__file__).resolve().parents[2] / "src" / "torchrl_etdmpc" / "analysis" / "reference"
HEADER = "env_steps,decision_steps,updates,wall_time_s,return_mean,return_std,episodes\n"
CONFIG = "task: {task}\npreset: {preset}\nseed: {seed}\nmodel:\n  latent_dim: 16\n"
PER_SEED = "method,task,seed,env_steps,return_mean\n"
AS_MEANS = "method,task,env_steps,mean,standard_error,seeds\n"


def line(env_steps: int, value: float) -> str:
    return f"{env_steps},{env_steps // 2},{env_steps // 4},12.5,{value},0.5,10\n"


def make_run(path: Path, text: str, *, task: str = "walker-walk", preset: str = "cpu", seed: object = 1) -> Path:
    path.mkdir(parents=True, exist_ok=True)
    (path / "config.yaml").write_text(CONFIG.format(task=task, preset=preset, seed=seed))
    (path / "eval.csv").write_text(text)
    return path


def curve_of(table: pd.DataFrame) -> list[tuple[float, float]]:
    return list(zip(table["env_steps"], table["return_mean"], strict=True))


def write(path: Path, content: str | bytes) -> Path:
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def test_every_prefix_of_a_growing_file_gives_its_whole_rows(tmp_path):
    text = HEADER + line(0, 1.25) + line(1000, -20.5) + line(2000, 300.75)
    rows = [(0.0, 1.25), (1000.0, -20.5), (2000.0, 300.75)]
    for length in range(len(text) + 1):
        run = make_run(tmp_path / "run", text[:length])
        whole = max(text[:length].count("\n") - 1, 0)
        assert curve_of(read_run(run)) == rows[:whole], text[:length]


@settings(deadline=None, max_examples=25)
@given(rows=st.lists(st.tuples(st.integers(0, 5), st.integers(-100, 1000)), max_size=12))
def test_of_rows_with_the_same_steps_the_last_counts_and_steps_increase(tmp_path_factory, rows):
    text = HEADER + "".join(line(1000 * step, value) for step, value in rows)
    run = make_run(tmp_path_factory.getbasetemp() / "repeated", text)
    expected = {1000 * step: value for step, value in rows}  # the last one wins here too
    assert curve_of(read_run(run)) == sorted(expected.items())


def test_what_the_run_log_writes_is_read_back(tmp_path):
    config = {"task": "walker-run", "preset": "utd4", "seed": 7}
    directory = RunDirectory(tmp_path / "run")
    directory.begin(config)
    log = RunLog(directory, total_env_steps=4000)
    for steps, value in ((0, 1.5), (4000, 20.25)):
        counters = {"env_steps": steps, "decision_steps": steps // 2, "updates": 3, "wall_time_s": 1.0}
        log.log_eval({"return_mean": value, "return_std": 0.0, "episodes": 1}, **counters)
    expected = {
        "method": "utd4",
        "task": "walker-run",
        "seed": 7,
        "env_steps": [0.0, 4000.0],
        "return_mean": [1.5, 20.25],
    }
    pd.testing.assert_frame_equal(read_run(tmp_path / "run"), pd.DataFrame(expected), check_dtype=False)


def test_the_method_is_the_preset_unless_it_is_given(tmp_path):
    run = make_run(tmp_path / "run", HEADER + line(0, 1.0), preset="utd4")
    assert set(read_run(run)["method"]) == {"utd4"}
    assert set(read_run(run, method="mine")["method"]) == {"mine"}


def test_a_finished_run_without_its_configuration_is_known_by_its_summary(tmp_path):
    run = make_run(tmp_path / "run", HEADER + line(0, 1.0))
    (run / "config.yaml").unlink()
    (run / "summary.json").write_text(json.dumps({"task": "cup-catch", "preset": "big", "seed": 4, "final_return": 1}))
    table = read_run(run)
    assert table[["method", "task", "seed"]].to_numpy().tolist() == [["big", "cup-catch", 4]]


@pytest.mark.parametrize("text", ["", "\n", "env_steps,deci", HEADER.rstrip("\n"), HEADER, HEADER + "0,0,0"])
def test_a_run_that_has_not_evaluated_yet_is_empty(tmp_path, text):
    run = make_run(tmp_path / "run", text)
    table = read_run(run)
    assert len(table) == 0
    assert list(table) == ["method", "task", "seed", "env_steps", "return_mean"]
    assert len(read_runs([run])) == 0


def test_an_empty_run_beside_a_full_one_changes_nothing(tmp_path):
    full = make_run(tmp_path / "full", HEADER + line(0, 1.0) + line(1000, 2.0))
    make_run(tmp_path / "empty", HEADER, seed=2)
    pd.testing.assert_frame_equal(read_runs([tmp_path]), read_runs([full]))


def test_a_return_that_is_not_a_number_is_kept_as_a_missing_value(tmp_path):
    run = make_run(tmp_path / "run", HEADER + line(0, 1.0) + line(1000, float("nan")))
    assert read_run(run)["return_mean"].isna().tolist() == [False, True]


def test_runs_are_found_at_any_depth_sorted_and_once(tmp_path):
    for name in ("b/deep/er", "a", "c"):
        make_run(tmp_path / name, HEADER)
    (tmp_path / "no_run").mkdir()
    expected = [tmp_path / "a", tmp_path / "b" / "deep" / "er", tmp_path / "c"]
    assert find_runs([tmp_path / "c", tmp_path, tmp_path / "a"]) == expected
    assert find_runs([str(tmp_path / "a")]) == expected[:1]


def test_runs_behind_links_are_found_and_each_of_them_once(tmp_path):
    runs, elsewhere = tmp_path / "runs", tmp_path / "elsewhere"
    make_run(elsewhere / "b", HEADER)
    make_run(runs / "c", HEADER)
    (runs / "b").symlink_to(elsewhere / "b")
    (runs / "a").symlink_to(runs / "c")
    (runs / "c" / "back").symlink_to(runs)
    assert find_runs([runs]) == [runs / "b", runs / "c"]


def test_what_cannot_be_looked_into_is_found_so_that_its_reader_says_why(tmp_path, monkeypatch):
    for seed in (1, 2):
        make_run(tmp_path / f"seed{seed}", HEADER)
    (tmp_path / "seed3").symlink_to(tmp_path / "not mounted")
    (tmp_path / "seed1" / "checkpoints").mkdir()
    (tmp_path / "seed1" / "checkpoints" / "best").symlink_to(tmp_path / "gone")  # is no run
    assert find_runs([tmp_path]) == [tmp_path / f"seed{seed}" for seed in (1, 2, 3)]
    with pytest.raises(FileNotFoundError):
        Run.read(tmp_path / "seed3")

    scan = os.scandir  # by which os.walk looks; permissions do not stop everybody

    def refusing(folder):
        if Path(folder) == tmp_path / "seed2":
            raise PermissionError(13, "Permission denied", str(folder))
        return scan(folder)

    monkeypatch.setattr(os, "scandir", refusing)
    assert find_runs([tmp_path]) == [tmp_path / f"seed{seed}" for seed in (1, 2, 3)]


def test_a_path_that_does_not_exist_is_an_error(tmp_path):
    make_run(tmp_path / "a", HEADER)
    with pytest.raises(FileNotFoundError, match=re.escape(f"no such run directory: {tmp_path / 'b'}")):
        find_runs([tmp_path / "a", tmp_path / "b"])


def test_a_folder_without_runs_is_an_error_even_beside_one_with_runs(tmp_path):
    make_run(tmp_path / "a", HEADER)
    (tmp_path / "b").mkdir()
    with pytest.raises(FileNotFoundError, match=re.escape(f"no runs found in {tmp_path / 'b'}")):
        find_runs([tmp_path / "a", tmp_path / "b"])


def test_seeds_and_tasks_of_one_method_are_different_runs(tmp_path):
    for number, (task, seed) in enumerate([("walker-walk", 1), ("walker-walk", 2), ("walker-run", 1)]):
        make_run(tmp_path / str(number), HEADER + line(0, number), task=task, seed=seed)
    assert read_runs([tmp_path])["return_mean"].tolist() == [0.0, 1.0, 2.0]


@pytest.mark.parametrize("text", [HEADER, HEADER + line(0, 1.0)])
def test_the_same_method_task_and_seed_twice_is_an_error(tmp_path, text):
    for name in ("a", "b"):
        make_run(tmp_path / name, text, seed=3)
    with pytest.raises(ValueError, match=r"two runs of cpu on walker-walk with seed 3: .*a and .*b; leave one out"):
        read_runs([tmp_path])


@pytest.mark.parametrize(
    "setting",
    [
        *("total_env_steps", "eval_every", "eval_episodes", "eval_policy", "checkpoint_every", "checkpoint_minutes"),
        *("checkpoint_keep", "log_every", "max_faults", "max_skipped", "overlap", "compile", "workers"),
    ],
)
def test_what_says_nothing_of_how_a_run_learns_may_differ(tmp_path, setting):
    for seed in (1, 2):
        run = make_run(tmp_path / str(seed), HEADER + line(0, 1.0), seed=seed)
        with (run / "config.yaml").open("a") as file:
            file.write(f"{setting}: {seed}\n")
    assert mixed_settings([Run.read(run) for run in find_runs([tmp_path])]) == []


def test_what_a_summary_says_of_a_result_is_no_setting(tmp_path):
    for seed in (1, 2):
        run = make_run(tmp_path / str(seed), HEADER + line(0, 1.0))
        (run / "config.yaml").unlink()
        summary = {"task": "walker-walk", "preset": "cpu", "seed": seed, "final_return": 100.0 * seed}
        (run / "summary.json").write_text(json.dumps(summary))
    assert mixed_settings([Run.read(run) for run in find_runs([tmp_path])]) == []


def test_a_first_run_whose_settings_are_not_known_hides_no_difference():
    runs = [
        Run(Path(name), "ours", "walker-walk", seed, True, pd.DataFrame(), settings=settings)
        for seed, (name, settings) in enumerate([("a", {}), ("b", {"optim.lr": 1}), ("c", {"optim.lr": 2})])
    ]
    assert mixed_settings(runs) == ["ours has runs with different settings: optim.lr is 1 in b and 2 in c"]


@pytest.mark.parametrize("order", [(0, 1, 2), (1, 0, 2), (2, 1, 0)])
def test_a_setting_that_an_older_run_does_not_know_is_compared_between_the_others(order):
    known = [{"optim.lr": 1}, {"optim.lr": 1, "loss.new": 0.5}, {"optim.lr": 1, "loss.new": 0.0}]
    runs = [
        Run(Path(str(n)), "ours", "walker-walk", n, True, pd.DataFrame(), settings=values)
        for n, values in enumerate(known)
    ]
    (line,) = mixed_settings([runs[n] for n in order])
    assert line.startswith("ours has runs with different settings: loss.new is ")


def test_a_run_without_evaluations_is_found_so_that_its_reader_says_so(tmp_path):
    run = make_run(tmp_path / "run", HEADER + line(0, 1.0))
    (run / "summary.json").write_text("{}")
    (run / "eval.csv").unlink()
    assert find_runs([tmp_path]) == [run]
    with pytest.raises(FileNotFoundError, match=r"run has no eval\.csv, which holds the evaluations of a run"):
        read_run(run)


def test_a_run_on_a_task_of_one_s_own_is_read_without_its_code(tmp_path):
    run = make_run(tmp_path / "run", HEADER + line(0, 1.0))
    (run / "config.yaml").write_text('{task: "mine:make", preset: cpu, seed: 1, episode_length: 200}')
    assert Run.read(run).changed == ("episode_length=200",)


def test_steps_that_are_not_environment_steps_are_an_error(tmp_path):
    run = make_run(tmp_path / "run", HEADER + "1000,1000,5,1.0,3.0,0.5,10\n")
    with pytest.raises(
        ValueError, match="mixes units: 1000 env_steps beside 1000 decision_steps.* 2 env steps per dec"
    ):
        read_run(run)


def test_a_run_that_repeats_actions_as_it_was_told_is_read(tmp_path):
    run = make_run(tmp_path / "run", HEADER + "400,100,5,1.0,3.0,0.5,10\n")
    with pytest.raises(ValueError, match="mixes units"):
        read_run(run)
    with (run / "config.yaml").open("a") as file:
        file.write("\naction_repeat: 4\n")
    assert curve_of(read_run(run)) == [(400.0, 3.0)]


def test_one_env_step_is_one_decision_where_actions_are_not_repeated(tmp_path):
    run = make_run(tmp_path / "run", HEADER + "1000,1000,5,1.0,3.0,0.5,10\n", task="h1hand-walk")
    assert curve_of(read_run(run)) == [(1000.0, 3.0)]
    run = make_run(tmp_path / "other", HEADER + "2000,1000,5,1.0,3.0,0.5,10\n", task="h1hand-walk")
    with pytest.raises(ValueError, match="mixes units: 2000 env_steps beside 1000 decision_steps.* 1 env steps per d"):
        read_run(run)


def test_decision_steps_alone_are_an_error(tmp_path):
    run = make_run(tmp_path / "run", "decision_steps,return_mean\n0,1.0\n")
    with pytest.raises(ValueError, match="counts decision_steps only; add a column env_steps"):
        read_run(run)


@pytest.mark.parametrize("value", ["", "many"])
def test_decision_steps_that_are_no_numbers_are_an_error_that_names_the_file(tmp_path, value):
    run = make_run(tmp_path / "run", HEADER + f"1000,{value},5,1.0,3.0,0.5,10\n")
    with pytest.raises(ValueError, match=re.escape(str(run / "eval.csv"))):
        read_run(run)


@pytest.mark.parametrize(
    "text, message",
    [
        ("env_steps,updates\n0,1\n", "lacks the column return_mean"),
        ("return_mean\n1.0\n", "lacks the column env_steps"),
        ("a,b\n0,1\n", "lacks the columns env_steps, return_mean"),
        ("env_steps,return_mean\n0,high\n", "column return_mean must hold numbers"),
        ("env_steps,return_mean\nnone at all,1\n", "column env_steps must hold numbers"),
        ("env_steps,return_mean\n,1\n", "every row needs env_steps"),
        ("env_steps,return_mean\n-2,1\n", "every row needs env_steps of at least 0"),
        ("env_steps,return_mean\n0,1\n2,3,4,5\n", "is not a CSV file"),
    ],
)
def test_an_evaluation_table_that_is_not_one_is_an_error_that_names_it(tmp_path, text, message):
    run = make_run(tmp_path / "run", text)
    with pytest.raises(ValueError, match=f"{re.escape(str(run / 'eval.csv'))}.*{message}"):
        read_run(run)


def test_rows_with_more_cells_than_the_header_are_refused_and_not_shifted(tmp_path):
    run = make_run(tmp_path / "run", "env_steps,return_mean\n0,10,20\n1000,30,40\n")
    with pytest.raises(ValueError, match="eval.csv"):
        read_run(run)


def test_a_run_without_configuration_and_summary_is_an_error(tmp_path):
    run = make_run(tmp_path / "run", HEADER)
    (run / "config.yaml").unlink()
    with pytest.raises(FileNotFoundError, match="neither config.yaml nor summary.json"):
        read_run(run)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[unclosed",
        "just words",
        "- a\n- b\n",
        "task: walker-walk\nseed: 1\n",
        "task: walker-walk\npreset: cpu\nseed: one\n",
        "task: walker-walk\npreset: cpu\nseed:\n",
        "task: [walker-walk, walker-run]\npreset: cpu\nseed: 1\n",
        "task: [walker-walk]\npreset: cpu\nseed: 1\n",
        "task:\npreset: cpu\nseed: 1\n",
    ],
)
def test_a_configuration_without_task_preset_and_seed_is_an_error_that_names_it(tmp_path, text):
    run = make_run(tmp_path / "run", HEADER + line(0, 1.0))
    (run / "config.yaml").write_text(text)
    with pytest.raises(ValueError, match=f"{re.escape(str(run / 'config.yaml'))} does not give"):
        read_runs([run])


def test_a_broken_summary_is_an_error_that_names_it(tmp_path):
    run = make_run(tmp_path / "run", HEADER)
    (run / "config.yaml").unlink()
    (run / "summary.json").write_text('{"task": "walker-walk"')
    with pytest.raises(ValueError, match=r"summary\.json does not give the run's task, preset and seed"):
        read_run(run)


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
