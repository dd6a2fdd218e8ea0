"""Small experiments, and a stand-in for training that takes no time."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest

from torchrl_etdmpc.suites import Experiment, Run, attempt
from torchrl_etdmpc.suites.attempt import log_file

SMALL = {
    "preset": "cpu",
    "device": "cpu",
    "threads": 1,
    "compile": "off",
    "task.episode_length": 200,
    "log_every": 40,
    "eval_every": 150,
    "eval_episodes": 1,
    "checkpoint_every": 30,
    "model.latent_dim": 16,
    "model.mlp_dim": 16,
    "model.encoder_dim": 16,
    "planner.horizon": 2,
    "planner.num_samples": 8,
    "planner.num_elites": 4,
    "planner.num_proposals": 2,
    "planner.iterations": 1,
    "reanalyze.num_samples": 6,
    "reanalyze.num_elites": 3,
    "reanalyze.iterations": 1,
    "optim.batch_size": 4,
    "replay.seed_decisions": 40,
    "replay.pretrain_updates": 4,
}
"""Settings of a run that trains in seconds."""


def small_experiment(**changes) -> Experiment:
    usual = {
        "name": "small",
        "tasks": ("cartpole-balance",),
        "seeds": (1,),
        "variants": {"plain": {}},
        "settings": SMALL,
        "budget": 400,
    }
    return Experiment(**(usual | changes))


def write_finished(run: Run, returns: float = 500.0, speed: float = 20.0) -> None:
    """The directory of a run that reached its budget, as far as a suite reads it."""
    run.path.mkdir(parents=True, exist_ok=True)
    write_tables(run, run.config.total_env_steps, returns, speed)
    summary = {"env_steps": run.config.total_env_steps, "decisions_per_second": speed}
    (run.path / "summary.json").write_text(json.dumps(summary))


def write_tables(run: Run, env_steps: int, returns: float = 500.0, speed: float = 20.0) -> None:
    """The tables of a run that came this far."""
    run.path.mkdir(parents=True, exist_ok=True)
    (run.path / "config.yaml").write_text("task: none\n")
    head = "env_steps,decision_steps,updates,wall_time_s"
    rows = [f"{step},{step // 2},0,{step / 2 / speed}" for step in range(0, env_steps + 1, max(env_steps // 4, 1))]
    (run.path / "train.csv").write_text("\n".join([head, *rows, ""]))
    evaluated = [f"{row},{returns},0,1" for row in rows]
    (run.path / "eval.csv").write_text("\n".join([f"{head},return_mean,return_std,episodes", *evaluated, ""]))


STAND_IN = """
import fcntl, json, os, pathlib, signal, sys, time
path, total, plan = pathlib.Path(sys.argv[1]), int(sys.argv[2]), json.loads(sys.argv[3])
lock = open(path / ".lock", "w")
try:
    fcntl.lockf(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
except OSError:
    sys.exit(f"error: run_dir={path} is in use by another process; wait for it.")
(path / "config.yaml").touch()
tries = path / "tries"
count = len(tries.read_text()) if tries.exists() else 0
tries.write_text("x" * (count + 1))
told = []
signal.signal(signal.SIGTERM, lambda *_: told.append(75))
kind, steps = plan[min(count, len(plan) - 1)]
row = f"{steps},{steps // 2},0,{steps / 40}"
head = "env_steps,decision_steps,updates,wall_time_s"
(path / "train.csv").write_text(f"{head}\\n{row}\\n")
(path / "eval.csv").write_text(f"{head},return_mean,return_std,episodes\\n{row},500.0,0,1\\n")
if kind == "wait":
    while not told:
        time.sleep(0.01)
    sys.exit(75)
if kind == "fail":
    sys.exit("error: the simulator is gone")
if kind == "kill":
    os.kill(os.getpid(), signal.SIGKILL)
(path / "summary.json").write_text(json.dumps({"env_steps": total, "decisions_per_second": 20.0}))
"""


@pytest.fixture
def stand_in(monkeypatch, tmp_path_factory) -> Callable[[dict[str, list[tuple[str, int]]]], None]:
    """Makes runs do what is told, try by try: ``finish``, ``fail``, ``kill`` or ``wait`` after so many env steps.

    By a word of the run's name; ``{"": [("finish", 400)]}`` is for all others. The last one is repeated.
    """

    script = tmp_path_factory.mktemp("stand_in") / "train.py"
    script.write_text(STAND_IN)

    def behave(plans: dict[str, list[tuple[str, int]]]) -> None:
        plans = {"": [("finish", 400)]} | plans

        def command(run: Run, **more) -> list[str]:
            plan = next(plan for word, plan in reversed(plans.items()) if word in run.name)
            run.path.mkdir(parents=True, exist_ok=True)
            arguments = [str(run.path), str(run.config.total_env_steps), json.dumps(plan)]
            return [sys.executable, "-S", str(script), *arguments]

        monkeypatch.setattr(attempt, "command", command)

    return behave


def tries(run: Run) -> int:
    """How many processes of a stand-in came to their work."""
    file: Path = run.path / "tries"
    return len(file.read_text()) if file.exists() else 0


def log_of(run: Run) -> list[str]:
    return log_file(run).read_text().splitlines()


@pytest.fixture(scope="session")
def small() -> SimpleNamespace:
    """The functions of this file."""
    return SimpleNamespace(
        settings=SMALL,
        experiment=small_experiment,
        write_finished=write_finished,
        write_tables=write_tables,
        tries=tries,
        log_of=log_of,
    )
