from __future__ import annotations

import json
import os
import re
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip("matplotlib")
pytest.importorskip("pandas")

import pandas as pd  # noqa: E402

from torchrl_etdmpc.analysis import Run, find_runs, mixed_settings, read_run, read_runs  # noqa: E402
from torchrl_etdmpc.runs import RunDirectory, RunLog  # noqa: E402

HEADER = "env_steps,decision_steps,updates,wall_time_s,return_mean,return_std,episodes\n"
CONFIG = "task: {task}\npreset: {preset}\nseed: {seed}\nmodel:\n  latent_dim: 16\n"


def line(env_steps: int, value: float) -> str:
    return f"{env_steps},{env_steps // 2},{env_steps // 4},12.5,{value},0.5,10\n"


def make_run(path: Path, text: str, *, task: str = "walker-walk", preset: str = "cpu", seed: object = 1) -> Path:
    path.mkdir(parents=True, exist_ok=True)
    (path / "config.yaml").write_text(CONFIG.format(task=task, preset=preset, seed=seed))
    (path / "eval.csv").write_text(text)
    return path


def curve_of(table: pd.DataFrame) -> list[tuple[float, float]]:
    return list(zip(table["env_steps"], table["return_mean"], strict=True))


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


@pytest.mark.parametrize("cut", ["1000,500,250,12.5,3", "1000,500,250,12.5,300.5,0.5", "1000,500", "1000"])
def test_a_row_that_was_cut_is_refused_and_no_return_is_made_of_what_is_left(tmp_path, cut):
    run = make_run(tmp_path / "run", HEADER + line(0, 1.0) + cut + "\n\n" + line(2000, 400.5))
    with pytest.raises(ValueError, match=f"eval.csv has a row with fewer cells than its header, '{re.escape(cut)}'"):
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
