"""Runs of half a second: the whole method on a real task, with networks and planners that cost next to nothing."""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torchrl.envs import EnvBase, Transform

from torchrl_etdmpc.envs import make_env
from torchrl_etdmpc.runs import RunDirectory, RunLog
from torchrl_etdmpc.training import TrainConfig, TrainingRun

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
def read_table() -> Callable[[Path], list[dict[str, float]]]:
    """Reads a CSV file of numbers."""

    def read(path: Path) -> list[dict[str, float]]:
        with path.open(newline="") as file:
            return [{name: float(value) for name, value in row.items()} for row in csv.DictReader(file)]

    return read
