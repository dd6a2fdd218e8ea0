"""The runs on Ray: by a stand-in for the cluster, and on a real one."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from types import SimpleNamespace

import pytest

from torchrl_etdmpc.suites import RunQueue, ray_engine, read_progress, run_on_ray, run_queue


class RayError(Exception):
    """A node or a worker that is gone."""


class RayTaskError(RayError):
    """An error that the task raised."""

    cause = OSError("No space left on device")


class TaskCancelledError(RayError):
    """Of a task that was told to stop."""


class FakeRay:
    """As much of Ray as the engine uses, in threads of this process; tasks in ``lost`` die with their node."""

    exceptions = SimpleNamespace(RayError=RayError, RayTaskError=RayTaskError, TaskCancelledError=TaskCancelledError)

    def __init__(self, *resources: dict[str, float], lost=()) -> None:
        self.resources = list(resources)
        self.lost = list(lost)
        self.asked: list[dict[str, float]] = []
        self.given: list[str] = []
        self.pool = ThreadPoolExecutor(8)

    def nodes(self):
        return [{"Alive": True, "Resources": resources} for resources in self.resources] + [{"Alive": False}]

    def cluster_resources(self):
        return {"GPU": sum(resources.get("GPU", 0) for resources in self.resources)}

    def remote(self, **options):
        self.asked.append(options)

        def decorate(function):
            def submit(run, threads):
                self.given.append(run.name)
                if run.name in self.lost:
                    self.lost.remove(run.name)
                    return self.pool.submit(self._die)
                return self.pool.submit(function, run, threads)

            return SimpleNamespace(remote=submit)

        return decorate

    def _die(self):
        raise RayError("the node is gone")

    def wait(self, references, timeout=None, num_returns=1):
        done, rest = wait(references, timeout, return_when=FIRST_COMPLETED)
        return list(done), list(rest)

    def get(self, reference):
        return reference.result()

    def cancel(self, reference):
        raise AssertionError("nothing is to be cancelled here")


@pytest.fixture
def fake(monkeypatch):
    def use(*resources, **options) -> FakeRay:
        ray = FakeRay(*resources, **options)

        @contextlib.contextmanager
        def cluster(address):
            yield ray

        monkeypatch.setattr(ray_engine, "_cluster", cluster)
        monkeypatch.setattr(ray_engine, "_POLL_S", 0.01)
        monkeypatch.setattr(run_queue, "_LOOK_AGAIN_S", 0.05)
        return ray

    return use


def test_runs_are_tasks_with_what_they_need(fake, small, tmp_path, stand_in):
    ray = fake({"CPU": 2.0}, {"CPU": 1.0})
    stand_in({"seed2": [("kill", 100), ("finish", 400)], "seed3": [("fail", 0)]})
    runs = small.experiment(seeds=(1, 2, 3, 4)).runs(tmp_path)
    assert run_on_ray(RunQueue(runs, retries=1))
    assert ray.asked == [{"num_cpus": 1.0, "num_gpus": 0.0, "max_retries": 0}]
    assert [read_progress(run).state for run in runs] == ["finished", "finished", "failed", "finished"]
    assert [small.tries(run) for run in runs] == [1, 2, 2, 1]


def test_a_run_whose_node_dies_is_begun_again(fake, small, tmp_path, stand_in):
    runs = small.experiment(seeds=(1, 2)).runs(tmp_path)
    ray = fake({"CPU": 4.0}, lost=[runs[0].name])
    stand_in({})
    said: list[str] = []
    assert run_on_ray(RunQueue(runs, say=said.append))
    assert {read_progress(run).state for run in runs} == {"finished"}
    assert ray.given.count(runs[0].name) == 2
    assert f"{runs[0].name}: was stopped at 0 env steps (exit code -9); it is tried again" in said


def test_a_trial_that_ends_early_is_cancelled_once_and_not_begun_again(fake, small, tmp_path, monkeypatch):
    run = small.experiment(seeds=(1,)).runs(tmp_path)[0]
    ray, queue = fake({"CPU": 4.0}), RunQueue([run])
    told, saved = [], threading.Event()

    def train(run, threads):
        assert saved.wait(10)
        error = RayTaskError()
        error.cause = TaskCancelledError()
        raise error

    def cancel(reference):
        told.append(reference)
        threading.Timer(0.3, saved.set).start()  # the run takes its time to save itself

    monkeypatch.setattr(ray_engine, "_train", train)
    monkeypatch.setattr(ray, "cancel", cancel)
    monkeypatch.setattr(queue, "to_be_stopped", lambda: queue._pruned.add(run.name) or {run.name})
    assert run_on_ray(queue)
    assert len(told) == 1
    assert ray.given == [run.name]
    assert read_progress(run).state == "pruned"


@pytest.mark.parametrize(
    ("resources", "options", "needs", "room"),
    [
        ([{"CPU": 4.0}], {}, (1.0, 0.0), 4),
        ([{"CPU": 4.0}, {"CPU": 3.0}], {"cpus_per_run": 2.0}, (2.0, 0.0), 3),
        ([{"CPU": 8.0, "GPU": 1.0}, {"CPU": 8.0}], {}, (1.0, 1.0), 1),
        ([{"CPU": 8.0, "GPU": 2.0}], {"gpus_per_run": 0.25}, (1.0, 0.25), 8),
        ([{"CPU": 8.0, "GPU": 1.0}], {"gpus_per_run": 0.1, "cpus_per_run": 0.5}, (0.5, 0.1), 10),
        ([{"CPU": 8.0, "GPU": 1.0}], {"gpus_per_run": 0.0, "workers": 3}, (1.0, 0.0), 3),
    ],
)
def test_as_many_run_as_the_nodes_have_room_for(fake, small, tmp_path, monkeypatch, resources, options, needs, room):
    ray = fake(*resources)
    now, most, given, lock = [0], [0], set(), threading.Lock()
    all_there = threading.Event()

    def train(run, threads):
        with lock:
            given.add(threads)
            now[0] += 1
            most[0] = max(most[0], now[0])
            if now[0] == room:
                all_there.set()
        all_there.wait(10)
        time.sleep(0.05)
        small.write_finished(run)
        with lock:
            now[0] -= 1
        return 0

    monkeypatch.setattr(ray_engine, "_train", train)
    ray.pool = ThreadPoolExecutor(20)
    assert run_on_ray(RunQueue(small.experiment(seeds=tuple(range(1, 13))).runs(tmp_path)), **options)
    assert most[0] == room
    assert (ray.asked[0]["num_cpus"], ray.asked[0]["num_gpus"]) == needs
    assert given == {max(int(needs[0]), 1)}


def test_a_cluster_without_room_for_a_run_is_named(fake, small, tmp_path):
    fake({"CPU": 2.0}, {"CPU": 2.0})
    with pytest.raises(
        ValueError, match="no node of the cluster has 4 CPUs and 0 GPUs; lower cpus_per_run or gpus_per"
    ):
        run_on_ray(RunQueue(small.experiment().runs(tmp_path)), cpus_per_run=4.0)


def test_a_node_that_cannot_begin_a_run_is_tried_again_and_named(fake, small, tmp_path, monkeypatch):
    ray = fake({"CPU": 1.0})

    def train(run, threads):
        raise RayTaskError

    monkeypatch.setattr(ray_engine, "_train", train)
    (run,) = small.experiment().runs(tmp_path)
    assert run_on_ray(RunQueue([run], retries=1))
    assert ray.given == [run.name] * 2
    assert read_progress(run).error.startswith("cannot be started: No space left on device")


def test_a_run_that_is_cancelled_is_asked_to_save_itself(small, tmp_path, monkeypatch):
    told = []

    def poll():
        raise KeyboardInterrupt

    process = SimpleNamespace(poll=poll, terminate=lambda: told.append(1), wait=lambda: 75)
    monkeypatch.setattr(ray_engine, "start", lambda run, threads: process)
    (run,) = small.experiment().runs(tmp_path)
    assert ray_engine._train(run, 1) == 75
    assert told == [1]


def test_a_suite_that_stops_asks_every_run_once_and_waits_for_all(small, tmp_path):
    runs = small.experiment(seeds=(1, 2)).runs(tmp_path)
    told, awaited, said = [], [], []
    ray = SimpleNamespace(cancel=told.append, wait=lambda references, num_returns: awaited.append(num_returns))
    ray_engine._stop(ray, dict(zip("ab", runs, strict=True)), RunQueue(runs, say=said.append), {"a"})
    assert (told, awaited, said) == (["b"], [2], ["stopping: 2 runs save themselves"])


def test_an_address_where_nobody_answers_is_named_at_once(small, tmp_path):
    pytest.importorskip("ray")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    queue = RunQueue(small.experiment().runs(tmp_path))
    for address, message in {
        f"127.0.0.1:{port}": "cannot be reached .*; start Ray there .ray start --head., or leave address out",
        f"ray://127.0.0.1:{port}": "cannot be reached",
        "127.0.0.1:many": "address must be host:port",
        "127.0.0.1:99999999": "cannot be reached",
    }.items():
        tick = time.monotonic()
        with pytest.raises((OSError, ValueError), match=message) as error:
            run_on_ray(queue, address=address)
        assert "\n" not in str(error.value)
        assert time.monotonic() - tick < 5


@pytest.mark.parametrize(
    ("address", "message"),
    [
        (None, "a local Ray cluster cannot be started (no memory); take another engine."),
        ("auto", "address=auto is no cluster (no memory); leave address out for one of this machine, or take another "),
    ],
)
def test_what_cannot_be_started_advises_something_else(monkeypatch, address, message):
    def fail(**options):
        raise RuntimeError("no memory.")

    monkeypatch.setitem(sys.modules, "ray", SimpleNamespace(init=fail, shutdown=lambda: None))
    with pytest.raises(OSError, match=re.escape(message)):
        run_on_ray(RunQueue([]), address=address)


# -- a real cluster ---------------------------------------------------------------------------------------------------


@pytest.fixture
def suite_on_ray(small, tmp_path):
    """Starts ``suite`` with an experiment of two small runs on a cluster of its own."""
    from torchrl_etdmpc.suites import write_experiment

    experiment = small.experiment(seeds=(1, 2), settings=small.settings | {"checkpoint_every": 50})
    write_experiment(experiment, tmp_path / "small.yaml")

    def start() -> subprocess.Popen:
        words = [f"experiment={tmp_path}/small.yaml", f"runs_dir={tmp_path}/runs", "engine=ray", "workers=2"]
        environment = {**os.environ, "MUJOCO_GL": "disable", "OMP_NUM_THREADS": "1"}
        with open(tmp_path / "log", "ab") as log:
            return subprocess.Popen(
                [sys.executable, "-m", "torchrl_etdmpc.commands", "suite", *words],
                stdout=log,
                stderr=subprocess.STDOUT,
                env=environment,
            )

    return start, experiment.runs(tmp_path / "runs"), tmp_path / "log"


@pytest.mark.slow
def test_a_real_cluster_stops_cleanly_and_goes_on(suite_on_ray):
    pytest.importorskip("ray")
    start, runs, log = suite_on_ray
    process = start()
    deadline = time.monotonic() + 200
    while not all((run.path / "train.csv").exists() for run in runs) and time.monotonic() < deadline:
        time.sleep(0.1)
    process.send_signal(signal.SIGTERM)
    assert process.wait(200) == 75
    assert {read_progress(run).state for run in runs} <= {"stopped", "finished"}
    text = log.read_text()
    assert "stopping: 2 runs save themselves" in text
    assert text.endswith("stopped; the same command goes on.\n")
    assert start().wait(300) == 0
    assert {read_progress(run).state for run in runs} == {"finished"}
    said = [line for line in log.read_text().splitlines() if not line[:2].isdigit()]
    assert not [line for line in said if "ray" in line.lower() and "runs" not in line]  # no banner, no log of Ray's
