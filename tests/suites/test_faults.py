"""Real runs under kill end as if nothing had happened; the whole of it is `benchmarks/suite_faults.py`."""

from __future__ import annotations

import dataclasses
import importlib.util
import os
import signal
import sys
import time
import warnings
from pathlib import Path

import pytest

from torchrl_etdmpc.suites import RunQueue, read_progress, run_locally
from torchrl_etdmpc.training import launch

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
pytestmark = pytest.mark.skipif(not Path("/proc/self").exists(), reason="looks for processes in /proc")


@pytest.fixture
def faults(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    spec = importlib.util.spec_from_file_location("suite_faults", BENCHMARKS / "suite_faults.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    yield module
    sys.modules.pop("cpu_learning", None)


@pytest.fixture
def suite_of():
    """Starts a suite in a copy of this process; returns its id."""
    children = []

    def start(runs) -> int:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of a fork beside PyTorch's threads
            child = os.fork()
        if child == 0:
            run_locally(RunQueue(runs, retries=0), workers=2)
            os._exit(0)
        children.append(child)
        return child

    yield start
    for child in children:
        os.waitpid(child, 0)


def test_a_killed_suite_and_a_killed_run_end_as_if_nothing_had_happened(faults, small, tmp_path, suite_of):
    variants = {"good": {}, "bad": {"planner.num_elites": 9}}
    good, bad = small.experiment(variants=variants).runs(tmp_path / "runs")
    first = suite_of([good, bad])
    deadline = time.monotonic() + 120
    while not faults.learning([good]) and time.monotonic() < deadline:
        time.sleep(0.02)
    steps = read_progress(good).env_steps
    assert 0 < steps < 400
    assert faults.kill_run(good)
    while not faults.processes_of(good) and time.monotonic() < deadline:  # it is begun again
        time.sleep(0.02)
    os.kill(first, signal.SIGKILL)
    assert faults.processes_of(good)  # which goes on by itself
    said: list[str] = []
    assert run_locally(RunQueue([good, bad], retries=0, say=said.append), workers=2)
    assert read_progress(good).state == "finished"
    why = "planner.num_elites must be at most num_samples=8, got 9"
    assert why in read_progress(bad).error
    assert any(line.startswith(f"{bad.name}: failed: ") and line.endswith("; given up") for line in said)
    alone = dataclasses.replace(good, path=tmp_path / "alone")
    launch(dataclasses.replace(good.config, run_dir=str(alone.path)))
    assert faults.evaluations(good) == faults.evaluations(alone)
    assert len(faults.evaluations(good)) == 4


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["local", "ray"])
def test_twelve_runs_under_many_kills(faults, tmp_path, engine):
    if engine == "ray":
        pytest.importorskip("ray")
    answer = faults.main(["--engine", engine, "--out", str(tmp_path)])
    assert (answer["suite_kills"], len(answer["run_kills"]), answer["node_kills"]) == (3, 5, int(engine == "ray"))
    assert answer["damaged"] is not None
    assert answer["finished"] == answer["same_evaluations"] == len(answer["failed_and_named"]) == 6
    assert answer["other"] == {}
    assert answer["tracebacks"] == 0
    assert answer["exit_code"] == 1
