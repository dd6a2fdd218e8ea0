"""A pool of processes."""

from __future__ import annotations

import os
import signal
import threading
import time

import pytest
import torch

from torchrl_etdmpc.suites import Run, RunQueue, local, read_progress, run_locally, run_queue
from torchrl_etdmpc.suites.local import visible_gpus


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    monkeypatch.setattr(local, "_POLL_S", 0.01)
    monkeypatch.setattr(run_queue, "_LOOK_AGAIN_S", 0.05)


def wait_until_at_work(runs: list[Run], count: int) -> None:
    deadline = time.monotonic() + 30
    while sum((run.path / "eval.csv").exists() for run in runs) < count and time.monotonic() < deadline:
        time.sleep(0.01)


def test_everything_that_can_be_finished_is(small, tmp_path, stand_in):
    runs = small.experiment(seeds=(1, 2), variants={"good": {}, "bad": {}, "weak": {}, "done": {}}).runs(tmp_path)
    for run in runs[-2:]:
        small.write_finished(run)
    stand_in({"bad": [("fail", 0)], "weak": [("kill", 100), ("kill", 200), ("fail", 300), ("finish", 400)]})
    said: list[str] = []
    assert run_locally(RunQueue(runs, say=said.append), workers=3)
    states = {run.name: read_progress(run).state for run in runs}
    assert [name for name, state in states.items() if state != "finished"] == [
        "bad/cartpole-balance/seed1",
        "bad/cartpole-balance/seed2",
    ]
    assert [small.tries(run) for run in runs] == [1, 1, 3, 3, 4, 4, 0, 0]
    assert read_progress(runs[2]).error == "the simulator is gone"
    assert small.log_of(runs[2])[-1] == "suite: failed: the simulator is gone"
    assert sum(line.endswith("; given up") for line in said) == 2
    assert sum("was stopped at" in line for line in said) == 4
    assert [said.count(f"{runs[4].name}: {word}") for word in ("begins", "goes on")] == [1, 3]


def test_as_many_run_at_a_time_as_there_are_workers(small, tmp_path, stand_in, monkeypatch):
    at_once, now = [], [0]
    start = local.start

    def counted(run, **places):
        now[0] += 1
        at_once.append(now[0])
        return start(run, **places)

    ended = RunQueue.ended

    def uncounted(queue, run, code):
        now[0] -= 1
        ended(queue, run, code)

    monkeypatch.setattr(local, "start", counted)
    monkeypatch.setattr(RunQueue, "ended", uncounted)
    stand_in({})
    assert run_locally(RunQueue(small.experiment(seeds=tuple(range(1, 8))).runs(tmp_path)), workers=2)
    assert len(at_once) == 7
    assert max(at_once) == 2


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_stops_every_run_which_goes_on_later(small, tmp_path, stand_in, number):
    runs = small.experiment(seeds=(1, 2, 3)).runs(tmp_path)
    stand_in({"": [("wait", 120), ("finish", 400)]})
    said: list[str] = []

    def when_both_run() -> None:
        wait_until_at_work(runs, 2)
        os.kill(os.getpid(), number)

    thread = threading.Thread(target=when_both_run)
    thread.start()
    assert not run_locally(RunQueue(runs, say=said.append), workers=2)
    thread.join()
    assert said[-1] == "stopping: 2 runs save themselves"
    assert sorted(read_progress(run).state for run in runs) == ["stopped", "stopped", "waiting"]
    stand_in({})
    assert run_locally(RunQueue(runs), workers=2)
    assert {read_progress(run).state for run in runs} == {"finished"}


def test_runs_are_asked_to_stop_before_a_second_signal_ends_the_suite(small, tmp_path, monkeypatch):
    class Process:
        told = 0

        def terminate(self):
            self.told += 1

        def poll(self):
            return None

        def wait(self):
            return 75

    (run,) = small.experiment().runs(tmp_path)
    queue, process, told = RunQueue([run]), Process(), []

    def twice() -> set[str]:
        for _ in range(2):
            os.kill(os.getpid(), signal.SIGINT)
        return set()

    monkeypatch.setattr(local, "start", lambda run, **places: process)
    monkeypatch.setattr(queue, "to_be_stopped", twice)
    monkeypatch.setattr(os, "_exit", lambda code: told.append((code, process.told)))
    run_locally(queue, workers=1)
    assert told == [(128 + signal.SIGINT, 1)]
    assert process.told == 1


def test_a_run_whose_trial_ended_early_is_asked_to_stop_once(small, tmp_path, monkeypatch):
    """Asked twice, it would leave without having saved itself."""

    class Process:
        returncode, told, looks = 75, 0, 0

        def terminate(self):
            self.told += 1

        def poll(self):
            self.looks += 1
            return self.returncode if self.looks > 12 else None  # it takes its time to save itself

    runs = small.experiment(seeds=(1, 2)).runs(tmp_path)
    queue, processes, names = RunQueue(runs), [], {run.name for run in runs}
    monkeypatch.setattr(local, "start", lambda run, **places: processes.append(Process()) or processes[-1])
    monkeypatch.setattr(queue, "to_be_stopped", lambda: queue._pruned.update(names) or names)
    assert run_locally(queue, workers=1)
    assert [process.told for process in processes] == [1, 1]  # one after the other in the same place
    assert {read_progress(run).state for run in runs} == {"pruned"}


def test_nothing_is_left_running_if_the_suite_itself_fails(small, tmp_path, stand_in, monkeypatch):
    runs = small.experiment(seeds=(1, 2)).runs(tmp_path)
    stand_in({"seed1": [("wait", 100)], "seed2": [("finish", 400)]})

    def broken(queue, run, code):
        wait_until_at_work(runs, 2)
        raise RuntimeError("a defect")

    monkeypatch.setattr(RunQueue, "ended", broken)
    with pytest.raises(RuntimeError, match="a defect"):
        run_locally(RunQueue(runs), workers=2)
    assert [read_progress(run).state for run in runs] == ["stopped", "finished"]


def test_two_suites_share_the_runs_and_train_none_twice(small, tmp_path, stand_in, in_copy):
    runs = small.experiment(seeds=tuple(range(1, 7))).runs(tmp_path)
    stand_in({})
    child = os.fork()
    if child == 0:
        run_locally(RunQueue(runs), workers=2)
        os._exit(0)
    assert run_locally(RunQueue(runs), workers=2)
    assert os.waitpid(child, 0)[1] == 0
    assert {read_progress(run).state for run in runs} == {"finished"}
    lines = [line for run in runs for line in small.log_of(run)]
    assert all(line == "suite: begun" or "is in use by another process" in line for line in lines)


def test_a_run_that_cannot_be_started_does_not_stop_the_others(small, tmp_path, stand_in):
    runs = small.experiment(seeds=(1, 2)).runs(tmp_path)
    runs[0].path.parent.mkdir(parents=True)
    runs[0].path.write_text("a file where the directory should be")
    stand_in({})

    from torchrl_etdmpc.suites import attempt

    plain = attempt.command
    attempt.command = lambda run, **more: plain(runs[1], **more)  # of which the first never comes to be called
    said: list[str] = []
    assert run_locally(RunQueue(runs, retries=1, say=said.append), workers=1)
    assert read_progress(runs[1]).state == "finished"
    assert [line for line in said if "cannot be started: File exists" in line][-1].endswith("; given up")


def test_gpus_are_those_that_this_process_may_use(monkeypatch):
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    assert visible_gpus() == ["0", "1"]
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "3, GPU-5")
    assert visible_gpus() == ["3", "GPU-5"]
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 0)
    assert visible_gpus() == []


def test_runs_are_spread_over_the_gpus_and_the_cores_over_the_runs(small, tmp_path, stand_in, monkeypatch):
    monkeypatch.setattr(local, "visible_gpus", lambda: ["3", "5"])
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: range(12), raising=False)
    given = []
    start = local.start

    def watched(run, **places):
        given.append((run.variant, places["threads"], places["gpu"]))
        return start(run, **places)

    monkeypatch.setattr(local, "start", watched)
    stand_in({})
    variants = {"any": {"device": "auto"}, "cpu": {}, "that one": {"device": "cuda:1"}}
    runs = small.experiment(variants=variants, seeds=(1, 2, 3, 4)).runs(tmp_path)
    assert run_locally(RunQueue(runs), per_gpu=2)
    assert {(threads, gpu) for variant, threads, gpu in given if variant == "any"} <= {(3, "3"), (3, "5")}
    assert {(threads, gpu) for variant, threads, gpu in given if variant == "cpu"} == {(3, None)}
    assert {gpu for variant, _, gpu in given if variant == "that one"} == {None}  # it sees all, and takes the second
    assert {gpu for _, _, gpu in given} >= {"3", "5"}


def test_runs_that_are_fewer_than_the_gpus_have_room_for_are_on_different_ones(small, tmp_path, stand_in, monkeypatch):
    monkeypatch.setattr(local, "visible_gpus", lambda: ["3", "5"])
    given, start = [], local.start

    def watched(run, **places):
        given.append(places["gpu"])
        return start(run, **places)

    monkeypatch.setattr(local, "start", watched)
    stand_in({})
    runs = small.experiment(variants={"any": {"device": "auto"}}, seeds=(1, 2)).runs(tmp_path)
    assert run_locally(RunQueue(runs), workers=2, per_gpu=2)
    assert given == ["3", "5"]
