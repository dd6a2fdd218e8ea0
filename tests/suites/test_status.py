"""The table that says where an experiment is."""

from __future__ import annotations

import math

from torchrl_etdmpc.suites import Progress, status_text
from torchrl_etdmpc.suites.status import duration


def test_the_table_says_everything_there_is_to_know(small, tmp_path):
    experiment = small.experiment(tasks=("cartpole-balance", "cup-catch"), seeds=(1, 2), variants={"a": {}, "b": {}})
    runs = experiment.runs(tmp_path)
    progress = [
        Progress("finished", 400, 100.0, 20.0),
        Progress("running", 200, 50.0, 10.0),
        Progress("waiting"),
        Progress("waiting"),
        Progress("finished", 400, 300.0, 30.0),
        Progress("failed", 40, 10.0, error="the simulator is gone"),
        Progress("stopped", 399, 7.0, 20.0),
        Progress("pruned", 100, 3.0, 20.0, error="below the median"),
    ]
    # The median speed is 20 decisions a second: 100 decisions of the running one at 10 are 10 s, and so on.
    assert status_text(runs, progress).splitlines() == [
        "variant  task              seeds done   env steps  return  decisions/s  time left",
        "a        cartpole-balance      1/2 +1  200 to 400    75.0         15.0      1 min",
        "a        cup-catch                0/2           0       -            -      1 min",
        "b        cartpole-balance         1/2   40 to 400   155.0         30.0          -",
        "b        cup-catch                0/2  100 to 399     5.0         20.0      1 min",
        "",
        "8 runs: 2 finished, 1 running, 1 stopped, 2 waiting, 1 pruned, 1 failed; about 1 min left with 1 at a time",
        "failed: b/cartpole-balance/seed2: the simulator is gone",
    ]


def test_the_time_left_is_that_of_what_is_left(small, tmp_path):
    runs = small.experiment(seeds=(1, 2, 3), budget=720_000).runs(tmp_path)
    progress = [Progress("running", 360_000, 1.0, 50.0), Progress("waiting"), Progress("finished", 720_000, 1.0, 50.0)]
    text = status_text(runs, progress)  # 180,000 and 360,000 decisions at 50 a second are 3 hours
    assert "3 h 0 min" in text.splitlines()[1]
    assert text.splitlines()[-1].endswith("about 3 h 0 min left with 1 at a time")
    progress[0] = Progress("stopped", 360_000, 1.0, 50.0)
    assert status_text(runs, progress, workers=2).endswith("about 1 h 30 min left with 2 at a time")


def test_one_run_of_an_unusual_speed_does_not_move_the_time_left_of_those_that_wait(small, tmp_path):
    runs = small.experiment(seeds=(1, 2, 3, 4), budget=360_000).runs(tmp_path)
    done = [Progress("finished", 360_000, 1.0, speed) for speed in (50.0, 50.0, 5_000.0)]
    assert status_text(runs, [*done, Progress("waiting")]).endswith("about 1 h 0 min left with 1 at a time")


def test_runs_that_are_running_share_the_time_left(small, tmp_path):
    runs = small.experiment(seeds=(1, 2), budget=720_000).runs(tmp_path)
    progress = [Progress("running", 360_000, 1.0, 50.0)] * 2
    assert status_text(runs, progress).endswith("about 1 h 0 min left with 2 at a time")


def test_without_a_measured_speed_the_time_left_is_not_known(small, tmp_path):
    runs = small.experiment().runs(tmp_path)
    text = status_text(runs, [Progress("waiting")])
    assert text.splitlines()[1].split() == ["plain", "cartpole-balance", "0/1", "0", "-", "-", "?"]
    assert text.endswith("1 runs: 1 waiting; the time left is known when a run has written a row")


def test_when_all_is_done_nothing_is_left(small, tmp_path):
    runs = small.experiment().runs(tmp_path)
    assert status_text(runs, [Progress("finished", 400, 1.0, 2.0)]).endswith("\n\n1 runs: 1 finished")


def test_a_run_that_was_ended_early_takes_no_time(small, tmp_path):
    runs = small.experiment().runs(tmp_path)
    assert status_text(runs, [Progress("pruned", 100, 3.0, 20.0)]).endswith("\n\n1 runs: 1 pruned")


def test_a_run_beyond_the_budget_takes_no_time_from_the_others(small, tmp_path):
    runs = small.experiment(seeds=(1, 2), budget=360_000).runs(tmp_path)
    progress = [Progress("stopped", 720_000, 1.0, 50.0), Progress("waiting")]
    assert status_text(runs, progress).endswith("about 1 h 0 min left with 1 at a time")


def test_durations_have_two_units():
    assert [duration(seconds) for seconds in (0.5, 61, 3_599, 7_320, 90_000, math.nan)] == [
        *("1 min", "2 min", "1 h 0 min", "2 h 2 min", "1 d 1 h", "?"),
    ]
