"""Configurations drawn at random: they run a few steps, or are refused in one line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

pytest.importorskip("dm_control")

from torchrl_etdmpc.envs import make_env  # noqa: E402
from torchrl_etdmpc.runs import RunDirectory, RunLog  # noqa: E402
from torchrl_etdmpc.training import TrainConfig, TrainingRun  # noqa: E402


def mostly(valid: st.SearchStrategy, *bad: Any) -> st.SearchStrategy:
    """Now and then a value that is never right."""
    return st.integers(0, 40).flatmap(lambda number: st.sampled_from(bad) if number == 0 and bad else valid)


FEW = mostly(st.integers(1, 4), 0)
CONFIGURATIONS = st.fixed_dictionaries(
    {
        "task": st.sampled_from(["cartpole-swingup", "reacher-easy", "walker-walk", "finger-turn-hard", "dog-run"]),
        "num_envs": st.sampled_from([1, 1, 2]),
        "episode_length": st.sampled_from([12, 13]),  # of two env steps a decision; the suite's own are 500 decisions
        "overlap": st.booleans(),
        "model": st.fixed_dictionaries(
            {
                "latent_dim": mostly(st.sampled_from([8, 16, 24]), 20),
                "simnorm_dim": st.sampled_from([2, 4, 8]),
                "mlp_dim": mostly(st.integers(2, 9), 0),
                "encoder_dim": st.integers(2, 9),
                "encoder_layers": mostly(st.integers(1, 3), 0),
                "num_dynamics": FEW,
                "num_values": FEW,
                "num_bins": mostly(st.sampled_from([2, 3, 21]), 1),
                "dropout": mostly(st.sampled_from([0.0, 0.1]), 1.0),
                "activation": st.sampled_from(["mish", "silu", "relu"]),
                "termination": st.sampled_from([None, False, True]),
                "action_values": st.booleans(),
            }
        ),
        "planner": st.fixed_dictionaries(
            {
                "horizon": FEW,
                "num_samples": st.integers(3, 9),
                "num_elites": st.integers(1, 4),
                "num_proposals": st.integers(0, 3),
                "iterations": mostly(st.integers(1, 2), 0),
                "score": st.sampled_from(["final", "mean", "adaptive"]),
                "beta": mostly(st.sampled_from([0.0, 2.0]), -1.0),
                "first_action": st.sampled_from(["elite", "mean", "best"]),
                "scoring_dtype": st.sampled_from([None, "bfloat16"]),
            }
        ),
        "reanalyze": st.fixed_dictionaries(
            {
                "every": mostly(st.integers(0, 2), -1),
                "num_slices": FEW,
                "horizon": st.integers(1, 3),
                "num_samples": st.integers(3, 6),
                "num_elites": st.integers(1, 4),
                "num_proposals": st.integers(0, 3),
                "iterations": st.just(1),
            }
        ),
        "loss": st.fixed_dictionaries({"slice_len": FEW, "kl_direction": st.sampled_from(["backward", "forward"])}),
        "optim": st.fixed_dictionaries({"batch_size": FEW, "updates_per_decision": mostly(st.integers(1, 2), 0)}),
        "replay": st.fixed_dictionaries(
            {
                "seed_decisions": st.integers(4, 20),
                "seed_hold": st.sampled_from([1.0, 1.5, 8.0]),
                "pretrain_updates": st.integers(0, 2),
                "pretrain_policy": st.booleans(),
                "capacity": st.integers(8, 60),
                "uniform_over": st.sampled_from(["episodes", "starts"]),
                "partial": st.booleans(),
            }
        ),
    }
)


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(values=CONFIGURATIONS, seed=st.integers(0, 2**31))
def test_a_configuration_runs_or_is_refused_in_one_line(tmp_path_factory, values: dict[str, Any], seed: int):
    steps = 2 * values["replay"]["seed_decisions"] + 12
    values |= {"preset": "cpu", "compile": "off", "eval_episodes": 1, "log_every": 4, "total_env_steps": steps}
    run_dir = tmp_path_factory.mktemp("runs") / "run"
    torch.manual_seed(seed)
    try:
        config = TrainConfig.from_dict(values)
        run = new_run(config, run_dir, seed)
    except ValueError as error:
        assert "\n" not in str(error)
        assert any(name in str(error) for group in values.values() if isinstance(group, dict) for name in group)
        assert not run_dir.exists()
        return
    run.log.directory.begin(config.to_dict())
    summary = run.run()  # with warnings as errors
    run.log.directory.close()
    assert summary["env_steps"] >= steps
    assert (run_dir / "summary.json").exists()


def new_run(config: TrainConfig, run_dir: Path, seed: int) -> TrainingRun:
    """A run on environments with the configuration's own time limit."""
    env = make_env(config.task_spec, seed=seed, num_envs=config.num_envs, parallel=False)
    log = RunLog(RunDirectory(run_dir), total_env_steps=config.total_env_steps)
    return TrainingRun(config, env=env, eval_env=make_env(config.task_spec), log=log)
