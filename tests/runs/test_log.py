from __future__ import annotations

import csv
import errno
import json
import math
from pathlib import Path

import pytest
import torch

from torchrl_etdmpc.runs import EVAL_COLUMNS, RunDirectory, RunLog, library_versions

CONFIG = {"task": "walker-walk", "preset": "efficient-tdmpc-utd4", "seed": 1}
COUNTERS = {"env_steps": 1000, "decision_steps": 500, "updates": 400, "wall_time_s": 9.5}
RESULTS = {"return_mean": 31.0, "return_std": 4.0, "episodes": 10}


@pytest.fixture
def log(tmp_path: Path) -> RunLog:
    directory = RunDirectory(tmp_path)
    directory.begin(CONFIG)
    return RunLog(directory, total_env_steps=2000)


def read_csv(path: Path) -> list[list[str]]:
    with open(path, newline="") as file:
        return list(csv.reader(file))


def snapshot(directory: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in directory.rglob("*.csv")}


@pytest.mark.parametrize("total", [0, -5])
def test_an_empty_run_is_refused(tmp_path, total):
    with pytest.raises(ValueError, match=rf"^total_env_steps must be at least 1, got {total};"):
        RunLog(RunDirectory(tmp_path), total_env_steps=total)


def test_train_rows_start_with_the_counters_and_are_on_disk_at_once(tmp_path, log):
    log.log_train({"loss/value": torch.tensor([0.25]), "grad_norm": 1}, **COUNTERS)
    assert read_csv(tmp_path / "train.csv") == [
        ["env_steps", "decision_steps", "updates", "wall_time_s", "loss/value", "grad_norm"],
        ["1000", "500", "400", "9.5", "0.25", "1"],
    ]


def test_a_metric_that_is_missing_later_leaves_an_empty_cell(tmp_path, log):
    log.log_train({"a": 1.0, "b": 2.0}, **COUNTERS)
    log.log_train({"b": 3.0}, **COUNTERS)
    assert [row[4:] for row in read_csv(tmp_path / "train.csv")] == [["a", "b"], ["1.0", "2.0"], ["", "3.0"]]


@pytest.mark.parametrize("table", ["train", "eval"])
def test_a_number_that_is_new_later_is_refused_and_writes_nothing(tmp_path, log, table):
    write = getattr(log, f"log_{table}")
    write(RESULTS, **COUNTERS)
    before = snapshot(tmp_path)
    expected = rf"^metrics must keep to the columns of the first row of {table}\.csv, got the new name 'b'; log it from"
    with pytest.raises(ValueError, match=expected):
        write({**RESULTS, "b": 2.0}, **COUNTERS)
    assert snapshot(tmp_path) == before


def test_a_metric_must_not_take_a_counters_name(tmp_path, log):
    with pytest.raises(ValueError, match=r"^metrics must not use the counter name 'updates'; rename"):
        log.log_train({"updates": 1.0}, **COUNTERS)
    assert not (tmp_path / "train.csv").exists()


@pytest.mark.parametrize(("value", "kind"), [(torch.zeros(2), "Tensor"), ("high", "str"), (None, "NoneType")])
def test_a_metric_must_be_one_number(tmp_path, log, value, kind):
    with pytest.raises(TypeError, match=rf"^loss must be a number or a one-element tensor, got {kind}; reduce it"):
        log.log_train({"loss": value}, **COUNTERS)
    assert not (tmp_path / "train.csv").exists()


def test_eval_rows_have_exactly_the_published_columns(tmp_path, log):
    log.log_eval(RESULTS, **COUNTERS)
    log.log_eval({"return_mean": math.nan, "return_std": math.nan, "episodes": 10}, **COUNTERS)
    assert (tmp_path / "eval.csv").read_text() == (
        "env_steps,decision_steps,updates,wall_time_s,return_mean,return_std,episodes\n"
        "1000,500,400,9.5,31.0,4.0,10\n"
        "1000,500,400,9.5,nan,nan,10\n"
    )
    assert EVAL_COLUMNS == tuple(read_csv(tmp_path / "eval.csv")[0])


def test_what_an_evaluation_adds_comes_after_the_published_columns(tmp_path, log):
    log.log_eval({**RESULTS, "policy_return": 12.5}, **COUNTERS)
    header, row = read_csv(tmp_path / "eval.csv")
    assert header == [*EVAL_COLUMNS, "policy_return"]
    assert row[-1] == "12.5"


class Recorder:
    """A logger that remembers, and fails if it is used after it was closed."""

    def __init__(self) -> None:
        self.calls, self.closed = [], False

    def log_metrics(self, metrics, step) -> None:
        assert not self.closed
        self.calls.append((metrics, step))

    def shutdown(self) -> None:
        assert not self.closed
        self.closed = True


def test_a_logger_gets_the_same_numbers_and_is_closed_once(log):
    log.logger = recorder = Recorder()
    log.log_train({"loss": 0.25}, **COUNTERS)
    log.log_eval(RESULTS, **COUNTERS)
    counters = {"decision_steps": 500, "updates": 400, "wall_time_s": 9.5}
    assert recorder.calls == [
        ({f"train/{name}": value for name, value in {**counters, "loss": 0.25}.items()}, 1000),
        ({f"eval/{name}": value for name, value in {**counters, **RESULTS}.items()}, 1000),
    ]
    log.finish({})
    log.close()
    assert recorder.closed


def test_a_logger_on_a_full_disk_costs_its_own_rows_alone(tmp_path, log):
    class Full:
        def log_metrics(self, *_, **__) -> None:
            raise OSError(errno.ENOSPC, "No space left on device")

        shutdown = log_metrics

    log.logger = Full()
    with pytest.warns(UserWarning, match=r"^Full failed \(No space left on device\) and misses rows, which are in "):
        log.log_train({"loss": 0.25}, **COUNTERS)
    assert len(read_csv(log.directory.train)) == 2
    with pytest.warns(UserWarning, match="^Full failed"):
        log.finish({})
    assert log.directory.finished


def test_finish_writes_valid_json_with_null_for_what_is_not_finite(tmp_path, log):
    log.log_eval(RESULTS, **COUNTERS)
    summary = {"task": "walker-walk", "final_return": math.nan, "best_return": torch.tensor(31.0), "device": Path("x")}
    path = log.finish({**summary, "nested": [math.inf, {"a": -math.inf, "done": True}, (1, 2)]})

    def refuse(constant):
        raise AssertionError(f"{constant} is not JSON")

    content = json.loads(path.read_text(), parse_constant=refuse)
    assert path == tmp_path / "summary.json"
    assert log.directory.finished
    assert content.pop("versions") == library_versions()
    assert content == {
        "task": "walker-walk",
        "final_return": None,
        "best_return": 31.0,
        "device": "x",
        "nested": [None, {"a": None, "done": True}, [1, 2]],
    }
    assert sorted(path.name for path in tmp_path.iterdir()) == [".lock", "config.yaml", "eval.csv", "summary.json"]


def test_versions_that_are_given_stay(log):
    content = json.loads(log.finish({"seed": 1, "versions": {"python": "2.7"}}).read_text())
    assert content["versions"] == {"python": "2.7"}


def test_a_run_that_goes_on_forgets_the_rows_after_its_checkpoint(tmp_path, log):
    log.log_train({"a": 1.0}, **COUNTERS)
    log.log_eval(RESULTS, **COUNTERS)
    before, state = snapshot(tmp_path), json.loads(json.dumps(log.state_dict()))
    log.log_train({"a": 2.0}, **COUNTERS)
    log.log_eval(RESULTS, **COUNTERS)
    with (tmp_path / "train.csv").open("a") as file:
        file.write("12,3,half a ro")
    again = RunLog(log.directory, total_env_steps=2000)
    again.load_state_dict(state)
    assert snapshot(tmp_path) == before
    with pytest.raises(ValueError, match=r"columns of the first row of train\.csv, got the new name 'b'"):
        again.log_train({"b": 2.0}, **COUNTERS)
    again.log_train({"a": 3.0}, **COUNTERS)
    assert [row[4:] for row in read_csv(tmp_path / "train.csv")] == [["a"], ["1.0"], ["3.0"]]


def test_a_table_that_was_not_there_yet_goes_and_may_begin_with_other_columns(tmp_path, log):
    state = log.state_dict()
    log.log_train({"a": 1.0}, **COUNTERS)
    log.load_state_dict(state)
    assert not (tmp_path / "train.csv").exists()
    log.log_train({"b": 1.0}, **COUNTERS)
    assert read_csv(tmp_path / "train.csv")[0][4:] == ["b"]


@pytest.mark.parametrize("damage", ["rows removed", "a digit changed", "the file removed"])
def test_what_happened_to_the_files_is_undone(tmp_path, log, damage):
    log.log_train({"a": 1.0}, **COUNTERS)
    log.log_eval(RESULTS, **COUNTERS)
    log.log_eval(RESULTS, **COUNTERS)
    state, before, file = log.state_dict(), snapshot(tmp_path), log.directory.eval
    text = file.read_text()
    file.write_text(text[: len(text) // 2] if damage == "rows removed" else text.replace("31.0", "91.0"))
    if damage == "the file removed":
        file.unlink()
    again = RunLog(log.directory, total_env_steps=2000)
    again.load_state_dict(state)
    again.log_eval(RESULTS, **COUNTERS)
    after = snapshot(tmp_path)
    assert after[str(log.directory.train)] == before[str(log.directory.train)]
    assert after[str(file)] == before[str(file)] + text.splitlines(keepends=True)[-1].encode()


def test_a_copy_of_the_run_that_was_made_by_links_gets_no_rows(tmp_path, log):
    for table in ("train", "eval"):
        write, copy = getattr(log, f"log_{table}"), tmp_path / f"copy-{table}.csv"
        write(RESULTS, **COUNTERS)
        copy.hardlink_to(tmp_path / f"{table}.csv")
        before = copy.read_bytes()
        write(RESULTS, **COUNTERS)
        assert copy.read_bytes() == before
        assert len(read_csv(tmp_path / f"{table}.csv")) == 3


def test_rows_that_somebody_else_wrote_do_not_stay(tmp_path, log):
    log.log_train({"a": 1.0}, **COUNTERS)
    with log.directory.train.open("a") as file:
        file.write("mine\n")
    log.log_train({"a": 2.0}, **COUNTERS)
    assert [row[4:] for row in read_csv(tmp_path / "train.csv")] == [["a"], ["1.0"], ["2.0"]]


@pytest.fixture
def disk_log(small_disk: Path) -> RunLog:
    directory = RunDirectory(small_disk / "run")
    directory.begin(CONFIG)
    return RunLog(directory, total_env_steps=2000)


@pytest.mark.parametrize("first", [True, False])
def test_rows_that_a_full_disk_does_not_take_are_written_with_the_next_one(disk_log, small_disk, leave_free, first):
    log, file = disk_log, disk_log.directory.train
    wide = {f"metric_{number}": float(number) for number in range(3000)}  # several pages of 4 KB
    if not first:
        log.log_train(wide, **COUNTERS)
    whole = file.read_bytes() if file.exists() else b""
    leave_free(small_disk, 4096)
    for _ in range(2):
        with pytest.warns(UserWarning, match=r"train\.csv cannot be written \(No space left on device\); its rows are"):
            log.log_train(wide, **COUNTERS)
        assert (file.read_bytes() if file.exists() else b"") == whole  # no half row
    leave_free(small_disk, None)
    log.log_train(wide, **COUNTERS)
    rows = read_csv(file)
    assert len(rows) == 4 + (not first)
    assert len({len(row) for row in rows}) == 1
    assert all(row == rows[1] for row in rows[1:])


def test_unwritten_rows_are_in_a_checkpoint(disk_log, small_disk, leave_free):
    log = disk_log
    leave_free(small_disk, 0)
    with pytest.warns(UserWarning, match="cannot be written"):
        log.log_train({"a": 1.0}, **COUNTERS)
    state = json.loads(json.dumps(log.state_dict()))
    leave_free(small_disk, None)
    again = RunLog(log.directory, total_env_steps=2000)
    again.load_state_dict(state)
    with pytest.raises(ValueError, match="got the new name 'b'"):
        again.log_train({"b": 2.0}, **COUNTERS)
    again.log_train({"a": 2.0}, **COUNTERS)
    assert [row[4:] for row in read_csv(log.directory.train)] == [["a"], ["1.0"], ["2.0"]]


def test_a_run_whose_rows_cannot_be_written_is_not_finished(disk_log, small_disk, leave_free):
    leave_free(small_disk, 0)
    with pytest.warns(UserWarning, match="cannot be written"):
        disk_log.log_train({"a": 1.0}, **COUNTERS)
    with pytest.raises(OSError, match="No space left on device"):
        disk_log.finish({"final_return": 1.0})
    assert not disk_log.directory.finished
    leave_free(small_disk, None)
    disk_log.finish({"final_return": 1.0})
    assert len(read_csv(disk_log.directory.train)) == 2


def test_a_file_elsewhere_with_the_same_content_is_not_cut(tmp_path, log):
    """A hard link looks like a file of the run."""
    log.log_train({"a": 1.0}, **COUNTERS)
    state = log.state_dict()
    log.log_train({"a": 2.0}, **COUNTERS)
    victim = tmp_path / "victim"
    victim.hardlink_to(log.directory.train)
    before = victim.read_bytes()
    log.load_state_dict(state)
    log.log_train({"a": 3.0}, **COUNTERS)
    assert victim.read_bytes() == before
