"""Runs of half a second: the whole method on a real task, with networks and planners that cost next to nothing."""

from __future__ import annotations

import csv
import json
import warnings
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch.utils._pytree import tree_map_only
from torchrl.envs import EnvBase, Transform

from torchrl_etdmpc.envs import make_env
from torchrl_etdmpc.runs import RunDirectory, RunLog
from torchrl_etdmpc.training import TrainConfig, TrainingRun, read_agent_file

EPISODE = 20  # decisions; the suite's own 500 would cost more than they show


def _tiny_config(**changes: Any) -> TrainConfig:
    values: dict[str, Any] = {
        "task": "cartpole-balance",
        "preset": "cpu",
        "episode_length": 2 * EPISODE,
        "total_env_steps": 160,
        "compile": "off",
        "eval_every": 80,
        "eval_episodes": 1,
        "checkpoint_every": 80,
        "log_every": 2 * EPISODE,
        "model": {"latent_dim": 16, "mlp_dim": 16, "encoder_dim": 16, "num_dynamics": 2},
        "planner": {"horizon": 2, "num_samples": 8, "num_elites": 4, "num_proposals": 2, "iterations": 1},
        "reanalyze": {"horizon": 2, "num_samples": 6, "num_elites": 3, "num_proposals": 1, "iterations": 1},
        "optim": {"batch_size": 4, "updates_per_decision": 2},
        "replay": {"seed_decisions": 30, "pretrain_updates": 7},
    }
    values["reanalyze"] |= {"every": 3, "num_slices": 2}
    for name, change in changes.items():
        values[name] = {**values.get(name, {}), **change} if isinstance(change, dict) else change
    return TrainConfig.from_dict(values)


def _make_run(config: TrainConfig, run_dir: Path, *transforms: Transform, resume: bool = False) -> TrainingRun:
    """As a new process would: one that goes on has other random numbers until they are restored."""
    torch.manual_seed(99 if resume else 0)

    def make(num_envs: int, seed: int, *more: Transform) -> EnvBase:
        env = make_env(config.task_spec, seed=seed, num_envs=num_envs, parallel=False)
        for transform in more:
            env = env.append_transform(transform)
        return env

    directory = RunDirectory(run_dir)
    log = RunLog(directory, total_env_steps=config.total_env_steps)
    env = make(config.num_envs, 90 if resume else 0, *transforms)
    run = TrainingRun(config, env=env, eval_env=make(config.eval_episodes, 1), log=log)
    if resume:
        directory.go_on()
        run.checkpoints.restore()
        directory.write_config(config.to_dict())
    else:
        directory.begin(config.to_dict())
    return run


@pytest.fixture(scope="session")
def tiny_config() -> Callable[..., TrainConfig]:
    """Makes a configuration; a group is changed by a dictionary."""
    return _tiny_config


@pytest.fixture(scope="session")
def make_run() -> Callable[..., TrainingRun]:
    """Makes a run in a directory, with transforms on the training environment."""
    return _make_run


@pytest.fixture(scope="session")
def user_warnings() -> Callable[[Iterable[warnings.WarningMessage]], list[str]]:
    """The texts of those among the warnings that are for users, which deprecations in libraries are not."""

    def texts(caught: Iterable[warnings.WarningMessage]) -> list[str]:
        return [str(warning.message) for warning in caught if issubclass(warning.category, UserWarning)]

    return texts


@pytest.fixture(scope="session")
def read_table() -> Callable[[Path], list[dict[str, float]]]:
    """Reads a CSV file of numbers."""

    def read(path: Path) -> list[dict[str, float]]:
        with path.open(newline="") as file:
            return [{name: float(value) for name, value in row.items()} for row in csv.DictReader(file)]

    return read


_SMALL: dict[str, Any] = {
    "task": "cartpole-swingup",
    "total_env_steps": 110,
    "eval_every": 54,
    "eval_episodes": 2,
    "checkpoint_every": 50,
    "log_every": 20,
    "replay": {"seed_decisions": 24, "seed_hold": 3.0},
}


@pytest.fixture(scope="session")
def small_config() -> Callable[..., TrainConfig]:
    """Makes a configuration of three episodes, the last cut off; checkpoints, rows and evaluations at other steps."""

    def make(**changes: Any) -> TrainConfig:
        return _tiny_config(**_SMALL | changes | {"replay": _SMALL["replay"] | changes.get("replay", {})})

    return make


def _results(run: TrainingRun, run_dir: Path) -> dict[str, Any]:
    def rows(name: str) -> list[dict[str, str]]:
        with (run_dir / name).open(newline="") as file:
            return [{key: value for key, value in row.items() if key != "wall_time_s"} for row in csv.DictReader(file)]

    stored = run.learner.replay.storage[:]
    best = read_agent_file(run_dir / "checkpoints" / "best.pt")
    summary = json.loads((run_dir / "summary.json").read_text())
    return {
        "train.csv": rows("train.csv"),
        "eval.csv": rows("eval.csv"),
        "summary": {key: summary[key] for key in ("env_steps", "final_return", "best_return")},
        "weights": {name: value.tolist() for name, value in run.learner.agent.loss.state_dict().items()},
        "best": {name: value.tolist() for name, value in best["loss"].items()} | {"at": best["counters"]["updates"]},
        "updater": tree_map_only(torch.Tensor, torch.Tensor.tolist, run.learner.agent.updater.state_dict()),
        "replay": {str(key): stored.get(key).tolist() for key in stored.keys(True, True)},
        "generations": run.learner.replay.writer.generations_of(torch.arange(len(run.learner.replay))).tolist(),
        "random": torch.rand(3).tolist(),
    }


@pytest.fixture(scope="session")
def results() -> Callable[[TrainingRun, Path], dict[str, Any]]:
    """Reads everything of a run that must not depend on interruptions, as comparable values."""
    return _results


@pytest.fixture(scope="session")
def stop_at() -> Callable[[TrainingRun, Any, str, int], None]:
    """Stops a run as if the signal came during the given call of a method."""

    def stop(run: TrainingRun, owner: Any, method: str, call: int) -> None:
        original, calls = getattr(owner, method), [0]

        def watched(*args: Any, **kwargs: Any) -> Any:
            calls[0] += 1
            if calls[0] == call:
                run.stop.requested = True
            return original(*args, **kwargs)

        setattr(owner, method, watched)

    return stop


@pytest.fixture(scope="session")
def straight(tmp_path_factory: pytest.TempPathFactory) -> Callable[[TrainConfig], dict[str, Any]]:
    """The results of a run without interruptions, one per configuration."""
    known: dict[str, dict[str, Any]] = {}

    def run(config: TrainConfig) -> dict[str, Any]:
        key = str(config)
        if key not in known:
            run_dir = tmp_path_factory.mktemp("straight")
            run = _make_run(config, run_dir)
            run.run()
            known[key] = _results(run, run_dir)
        return known[key]

    return run


@pytest.fixture(scope="session")
def finished(tmp_path_factory: pytest.TempPathFactory, small_config: Callable[..., TrainConfig]) -> Path:
    """The directory of a run that came to its end; tests damage a copy."""
    run_dir = tmp_path_factory.mktemp("finished")
    run = _make_run(small_config(), run_dir)
    run.run()
    run.log.directory.close()
    return run_dir
