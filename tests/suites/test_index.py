"""How far runs are, from their directories; and the index, which is only faster."""

from __future__ import annotations

import fcntl
import json
import math
import os
import sqlite3
import time

import pytest

from torchrl_etdmpc.runs import RunDirectory
from torchrl_etdmpc.suites import Progress, RunIndex, index, read_progress, status_text
from torchrl_etdmpc.suites.attempt import note


@pytest.fixture
def runs(small, tmp_path):
    return small.experiment(seeds=(1, 2, 3, 4)).runs(tmp_path / "runs")


@pytest.fixture
def read_again(monkeypatch):
    """Names of the runs whose directories were read since the last call."""
    read: list[str] = []

    def watched(run):
        read.append(run.name)
        return read_progress(run)

    monkeypatch.setattr(index, "read_progress", watched)

    def since() -> list[str]:
        names, read[:] = list(read), []
        return names

    return since


def test_a_run_is_what_its_directory_says(runs, small):
    finished, stopped, waiting, failed = runs
    small.write_finished(finished, returns=321.0, speed=25.0)
    small.write_tables(stopped, 200, returns=50.0, speed=10.0)
    small.write_tables(failed, 100)
    note(failed, "failed", "the simulator is gone")
    assert read_progress(finished) == Progress("finished", 400, 321.0, 25.0)
    assert read_progress(stopped) == Progress("stopped", 200, 50.0, 10.0)
    assert repr(read_progress(waiting)) == repr(Progress("waiting"))
    assert read_progress(failed) == Progress("failed", 100, 500.0, 20.0, "the simulator is gone")
    note(stopped, "pruned", "below the median")
    assert read_progress(stopped).state == "pruned"


def test_a_run_whose_last_evaluation_failed_has_no_return(runs, small):
    small.write_finished(runs[0], returns=321.0)
    file = RunDirectory(runs[0].path).summary
    file.write_text(json.dumps(json.loads(file.read_text()) | {"final_return": None}))
    assert math.isnan(read_progress(runs[0]).latest_return)


def test_a_run_is_finished_only_at_the_budget_that_is_asked_for(runs, small, tmp_path):
    small.write_finished(runs[0])
    longer = small.experiment(budget=800).runs(tmp_path / "runs")[0]
    assert read_progress(longer) == Progress("stopped", 400, 500.0, 20.0)
    shorter = small.experiment(budget=200).runs(tmp_path / "runs")[0]
    assert read_progress(shorter).state == "finished"


def test_a_finished_run_is_finished_though_its_tables_are_gone(runs, small):
    small.write_finished(runs[0])
    for name in ("train.csv", "eval.csv"):
        (runs[0].path / name).unlink()
    assert repr(read_progress(runs[0])) == repr(Progress("finished", 400, math.nan, 20.0))


@pytest.mark.parametrize("newer", ["train.csv", "eval.csv"])
def test_a_run_is_as_far_as_the_newer_of_its_tables(runs, small, newer):
    small.write_tables(runs[0], 200)
    with open(runs[0].path / newer, "a") as file:
        file.write("240,120,0,6.0" + ",500.0,0,1" * (newer == "eval.csv") + "\n")
    assert read_progress(runs[0]).env_steps == 240


def test_a_run_that_any_process_has_is_running(runs, small, in_copy):
    small.write_tables(runs[0], 200)
    with open(runs[0].path / ".lock", "w") as lock:
        fcntl.lockf(lock, fcntl.LOCK_EX)

        def look() -> None:
            assert read_progress(runs[0]).state == "running"

        assert in_copy(look) == 0
    assert read_progress(runs[0]).state == "stopped"


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\xff\xfe\x00",
        b"\xff,\xfe\n1,2\n",
        b"env_steps\nnan\n",
        b"env_steps\n1e999\n",
        b"env_steps\nx\n",
        b"a\n\n\n",
    ],
)
def test_a_damaged_table_counts_as_missing(runs, small, content):
    small.write_tables(runs[0], 200)
    for file in ("train.csv", "eval.csv"):
        (runs[0].path / file).write_bytes(content)
    assert repr(read_progress(runs[0])) == repr(Progress("stopped"))


def test_a_row_that_is_being_written_does_not_count(runs, small):
    small.write_tables(runs[0], 200, returns=50.0)
    with open(runs[0].path / "eval.csv", "a") as file:
        file.write("400,200,0,10.0,9")
    assert read_progress(runs[0]).latest_return == 50.0


def test_a_damaged_summary_leaves_the_tables_to_say_how_far_it_is(runs, small):
    for content in ("", "[]", "{", '{"env_steps": "many"}'):
        small.write_finished(runs[0])
        (runs[0].path / "summary.json").write_text(content)
        assert read_progress(runs[0]) == Progress("finished", 400, 500.0, 20.0)


def test_the_speed_is_that_of_the_last_rows_and_needs_time_and_decisions(runs, small):
    small.write_tables(runs[0], 200)
    head = "env_steps,decision_steps,updates,wall_time_s\n"
    slow = "".join(f"{i},{i},0,{i}\n" for i in range(20))
    fast = "".join(f"{i},{i},0,{19 + (i - 19) / 8}\n" for i in range(20, 40))
    for rows, expected in ((slow, 1.0), (slow + fast, 8.0), ("1,1,0,1\n", math.nan), ("1,1,0,1\n1,1,0,2\n", math.nan)):
        (runs[0].path / "train.csv").write_text(head + rows)
        assert read_progress(runs[0]).decisions_per_second == pytest.approx(expected, nan_ok=True)


def test_long_tables_are_read_from_their_end(runs, small):
    small.write_tables(runs[0], 200)
    head = "env_steps,decision_steps,updates,wall_time_s\n"
    (runs[0].path / "train.csv").write_text(head + "".join(f"{i},{i},0,{i / 4}\n" for i in range(50_000)))
    assert read_progress(runs[0]).env_steps == 49_999
    assert read_progress(runs[0]).decisions_per_second == pytest.approx(4.0)


def test_a_run_that_ends_while_it_is_read_is_finished_with_its_last_return_or_not_yet(runs, small, monkeypatch):
    last_rows = index.last_rows

    def ends_meanwhile(table):
        rows = last_rows(table)
        small.write_finished(runs[0])
        return rows

    small.write_tables(runs[0], 100, returns=5.0)
    monkeypatch.setattr(index, "last_rows", ends_meanwhile)
    assert read_progress(runs[0]).state == "stopped"
    progress = read_progress(runs[0])
    assert (progress.state, progress.latest_return) == ("finished", 500.0)


def test_a_column_may_have_a_name_of_any_letters(runs, small):
    small.write_tables(runs[0], 200)
    rows = "".join(f"{i},{i},0,{i / 4},0\n" for i in range(5))
    table = runs[0].path / "train.csv"
    table.write_text(f"env_steps,decision_steps,updates,wall_time_s,loss_größe\n{rows}", encoding="utf-8")
    assert read_progress(runs[0]).decisions_per_second == pytest.approx(4.0)


def test_a_row_that_the_end_of_a_table_begins_with_is_cut_and_says_nothing_of_the_speed(runs, small):
    small.write_tables(runs[0], 200)
    head = "env_steps,decision_steps,updates,wall_time_s,metrics\n"
    rows = (f"{i},{i},0,{i / 4},{'9' * 1500}\n" for i in range(20))  # five of them are read
    (runs[0].path / "train.csv").write_text(head + "".join(rows))
    assert read_progress(runs[0]).decisions_per_second == pytest.approx(4.0)


# -- the index --------------------------------------------------------------------------------------------------------


def test_only_finished_runs_are_remembered_and_read_again_when_they_change(runs, small, tmp_path, read_again):
    for run in runs[:2]:
        small.write_finished(run)
    small.write_tables(runs[2], 100)
    known = RunIndex(tmp_path / "index.sqlite")
    first = known.read(runs)
    assert len(read_again()) == 4
    assert repr(RunIndex(tmp_path / "index.sqlite").read(runs)) == repr(first)
    assert read_again() == [runs[2].name, runs[3].name]  # somebody may have begun to train them
    small.write_finished(runs[1], returns=700.0)  # as many bytes
    os.utime(runs[1].path / "eval.csv", ns=(1, time.time_ns()))
    assert known.read(runs)[1].latest_return == 700.0
    assert runs[1].name in read_again()
    longer = small.experiment(seeds=(1, 2, 3, 4), budget=800).runs(tmp_path / "runs")
    assert known.read(longer)[0].state == "stopped"


@pytest.mark.parametrize("name", ["summary.json", "eval.csv", "train.csv", ".lock", "suite.log"])
def test_a_finished_run_is_read_again_when_any_of_its_files_changes(runs, small, tmp_path, read_again, name):
    small.write_finished(runs[0])
    known = RunIndex(tmp_path / "index.sqlite")
    known.read(runs)
    read_again()
    (runs[0].path / name).touch()
    os.utime(runs[0].path / name, ns=(1, time.time_ns() + 10**9))
    known.read(runs)
    assert runs[0].name in read_again()


def test_a_run_whose_summary_was_removed_is_not_remembered_as_finished(runs, small, tmp_path):
    small.write_finished(runs[0])
    known = RunIndex(tmp_path / "index.sqlite")
    assert known.read(runs)[0].state == "finished"
    (runs[0].path / "summary.json").unlink()  # as by a longer budget
    assert known.read(runs)[0].state == "stopped"


def test_what_is_known_of_a_run_stays_when_another_changes(runs, small, tmp_path, read_again):
    small.write_finished(runs[0])
    small.write_tables(runs[1], 100)
    known = RunIndex(tmp_path / "index.sqlite")
    known.read(runs)
    small.write_finished(runs[1])
    known.read(runs)
    read_again()
    known.read(runs)
    assert read_again() == [runs[2].name, runs[3].name]


def test_an_index_that_is_removed_or_damaged_is_made_again(runs, small, tmp_path, read_again):
    small.write_finished(runs[0])
    file = tmp_path / "index.sqlite"
    expected = repr(RunIndex(file).read(runs))
    whole = file.read_bytes()
    other = tmp_path / "other.sqlite"
    with sqlite3.connect(other) as database:
        database.execute("CREATE TABLE runs (path, stamp)")
    database.close()
    for content in (None, b"", b"not a database at all", whole[: len(whole) // 2], b"\0" * 5000, other.read_bytes()):
        file.unlink()
        if content is not None:
            file.write_bytes(content)
        read_again()
        assert repr(RunIndex(file).read(runs)) == expected
        assert len(read_again()) == 4
        RunIndex(file).read(runs)
        assert runs[0].name not in read_again()


def test_what_the_index_cannot_mean_is_read_from_the_directory(runs, small, tmp_path):
    small.write_finished(runs[0])
    file = tmp_path / "index.sqlite"
    RunIndex(file).read(runs)
    with sqlite3.connect(file) as database:
        database.execute("UPDATE runs SET env_steps = 'many'")
    database.close()
    assert RunIndex(file).read(runs)[0].env_steps == 400


def test_a_folder_that_cannot_be_written_needs_no_index(runs, small, tmp_path):
    small.write_finished(runs[0])
    nowhere = tmp_path / "none" / "index.sqlite"
    assert RunIndex(nowhere).read(runs)[0].state == "finished"
    assert not nowhere.exists()
    (tmp_path / "folder").mkdir()
    assert RunIndex(tmp_path / "folder").read(runs)[0].state == "finished"


def test_two_processes_may_use_the_index_at_once(runs, small, tmp_path, monkeypatch):
    small.write_finished(runs[0])
    file = tmp_path / "index.sqlite"
    RunIndex(file).read(runs)
    connect, patience = sqlite3.connect, []
    with connect(file) as database:
        database.execute("BEGIN EXCLUSIVE")
        note = lambda *names, timeout, **rest: patience.append(timeout) or connect(*names, timeout=timeout, **rest)  # noqa: E731
        monkeypatch.setattr(sqlite3, "connect", note)
        assert RunIndex(file).read(runs[:1])[0].state == "finished"
    database.close()
    assert patience and max(patience) <= 0.5  # seconds that the other process is waited for


@pytest.mark.slow
def test_a_thousand_finished_runs_are_read_once(small, tmp_path, read_again):
    experiment = small.experiment(seeds=tuple(range(1, 126)), variants={f"v{index}": {} for index in range(8)})
    runs = experiment.runs(tmp_path / "runs")
    assert len(runs) == 1000
    for run in runs:
        small.write_finished(run)
    for expected in (1000, 0):  # to make the index, and to use it
        tick = time.monotonic()
        progress = RunIndex(tmp_path / "index.sqlite").read(experiment.runs(tmp_path / "runs"))
        text = status_text(runs, progress)
        print(f"{expected} directories read: {time.monotonic() - tick:.2f} s")
        assert len(read_again()) == expected
        assert text.endswith("1000 runs: 1000 finished")
        assert {entry.state for entry in progress} == {"finished"}
