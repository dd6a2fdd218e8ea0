"""Configurations drawn at random: they run a few steps and go on when stopped, or are refused in one line."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest
from hypothesis import HealthCheck, given, reject, settings
from hypothesis import strategies as st

pytest.importorskip("dm_control")

from torchrl_etdmpc.training import RunInterrupted, TrainConfig  # noqa: E402


def mostly(valid: st.SearchStrategy, *bad: Any) -> st.SearchStrategy:
    """Now and then a value that is never right."""
    return st.integers(1, 100).flatmap(lambda number: st.sampled_from(bad) if number == 50 else valid)


FEW = mostly(st.integers(1, 4), 0)
SEARCH = {
    "extra_iterations": mostly(st.integers(0, 1), -1),
    "large_action_dim": st.integers(0, 4),
    "score": mostly(st.sampled_from(["final", "mean", "adaptive"]), "median"),
    "beta": mostly(st.sampled_from([0.0, 2.0]), -1.0),
    "inverse_temperature": mostly(st.sampled_from([0.1, 10.0]), -0.1),
    "std_min": mostly(st.sampled_from([0.01, 0.5]), 3.0),
    "std_max": mostly(st.sampled_from([0.5, 2.0]), 0.0),
    "initial": st.sampled_from(["wide", "policy"]),
    "first_action": st.sampled_from(["elite", "mean", "best"]),
    "eval_first_action": st.sampled_from(["elite", "mean", "best"]),
    "scoring_dtype": st.sampled_from([None, "bfloat16"]),
}
ALWAYS: dict[str, dict[str, st.SearchStrategy]] = {
    "model": {
        "latent_dim": mostly(st.sampled_from([8, 16, 24]), 20),
        "simnorm_dim": st.sampled_from([2, 4, 8]),
        "mlp_dim": mostly(st.integers(2, 9), 0),
        "encoder_dim": st.integers(2, 9),
        "encoder_layers": mostly(st.integers(1, 3), 0),
        "num_dynamics": FEW,
        "num_values": FEW,
    },
    "planner": {
        "horizon": FEW,
        "num_samples": mostly(st.integers(4, 9), 3),
        "num_elites": st.integers(1, 4),
        "num_proposals": st.integers(0, 3),
        "iterations": mostly(st.integers(1, 2), 0),
    },
    "reanalyze": {
        "every": mostly(st.integers(0, 2), -1),
        "num_slices": FEW,
        "horizon": st.integers(1, 3),
        "num_samples": mostly(st.integers(4, 6), 3),
        "num_elites": st.integers(1, 4),
        "num_proposals": st.integers(0, 3),
        "iterations": st.just(1),
    },
    "loss": {"slice_len": FEW},
    "optim": {"batch_size": FEW},
    "replay": {
        "seed_decisions": st.integers(4, 20),
        "pretrain_updates": st.integers(0, 2),
        "capacity": st.integers(8, 60),
    },
}
SOMETIMES: dict[str, dict[str, st.SearchStrategy]] = {
    "model": {
        "num_bins": mostly(st.sampled_from([2, 3, 101]), 1),
        "bin_min": mostly(st.sampled_from([-20.0, -5.0]), 10.0),
        "bin_max": mostly(st.sampled_from([5.0, 20.0]), -10.0),
        "dropout": mostly(st.sampled_from([0.0, 0.1]), 1.0),
        "log_std_min": mostly(st.sampled_from([-10.0, -2.0]), 1.0),
        "log_std_max": mostly(st.sampled_from([-1.0, 2.0]), -3.0),
        "activation": st.sampled_from(["mish", "silu", "relu"]),
        "normalize_observations": st.booleans(),
        "termination": st.sampled_from([None, False, True]),
        "action_values": st.booleans(),
    },
    "planner": SEARCH,
    "reanalyze": {
        **SEARCH,
        "eval_first_action": mostly(st.just("best"), "mean"),  # which reanalyze does not read
        "proposal_log_std_min": mostly(st.sampled_from([-2.0, -0.5]), 3.0, None),
        "proposal_log_std_max": mostly(st.sampled_from([1.0, 0.0]), -3.0, None),
    },
    "loss": {
        "rho": mostly(st.sampled_from([0.5, 1.0]), 0.0),
        "consistency_coef": mostly(st.sampled_from([0.0, 2.0]), -1.0),
        "reward_coef": mostly(st.sampled_from([0.0, 1.0]), -1.0),
        "value_coef": mostly(st.sampled_from([0.0, 1.0]), -1.0),
        "value_beta": mostly(st.sampled_from([0.0, 2.0]), -1.0),
        "value_replayed": mostly(st.sampled_from([0.0, 0.3, 1.0]), 1.1),
        "value_expectile": mostly(st.sampled_from([0.3, 0.5, 0.9]), 1.0),
        "termination_coef": mostly(st.sampled_from([0.0, 2.0]), -1.0),
        "entropy_coef": mostly(st.sampled_from([0.0, 0.1]), -1.0),
        "kl_direction": mostly(st.sampled_from(["backward", "forward"]), "sideward"),
        "squashed_entropy": st.booleans(),
        "tau": mostly(st.sampled_from([0.0, 1.0]), 2.0),
        "discount": mostly(st.sampled_from([None, 0.5, 1.0]), 0.0),
    },
    "optim": {
        "updates_per_decision": mostly(st.integers(1, 2), 0),
        "lr": mostly(st.sampled_from([1e-5, 1e-2]), 0.0),
        "encoder_lr_scale": mostly(st.sampled_from([0.0, 2.0]), -1.0),
        "lr_halved_after": mostly(st.sampled_from([None, 2.0]), 0.0),
        "grad_clip_norm": mostly(st.sampled_from([0.1, 1e6]), 0.0),
        "average_decay": mostly(st.sampled_from([0.0, 0.9]), 1.0),
    },
    "replay": {
        "seed_hold": mostly(st.sampled_from([1.0, 1.5, 8.0]), 0.5),
        "pretrain_policy": st.booleans(),
        "insertion": st.sampled_from(["step", "episode"]),
        "uniform_over": st.sampled_from(["episodes", "starts"]),
        "partial": st.sampled_from([None, False, True]),
        "device": st.sampled_from(["auto", "cpu", "run"]),
    },
}
GROUPS = {name: st.fixed_dictionaries(ALWAYS[name], optional=SOMETIMES[name]) for name in ALWAYS}
RUN_ALWAYS: dict[str, st.SearchStrategy] = {
    "task": st.sampled_from(["cartpole-swingup", "reacher-easy", "walker-walk", "finger-turn-hard", "dog-run"]),
    "episode_length": st.sampled_from([12, 13]),  # the suite's own are 1000
}
RUN_SOMETIMES: dict[str, st.SearchStrategy] = {
    "seed": mostly(st.integers(0, 2**32 - 1), -1),
    "num_envs": mostly(st.integers(1, 2), 0),
    "overlap": st.booleans(),
    "action_repeat": mostly(st.integers(1, 4), 0),
    "terminates": st.sampled_from([None, False, True]),
    "eval_policy": st.booleans(),
    "eval_every": mostly(st.sampled_from([10, 1000]), 0),
    "log_every": mostly(st.sampled_from([4, 1000]), 0),
    "checkpoint_every": mostly(st.sampled_from([20, 1000]), 0),
    "checkpoint_keep": mostly(st.integers(1, 2), 0),
    "checkpoint_minutes": mostly(st.sampled_from([None, 1e-6]), 0.0),
    "max_faults": mostly(st.integers(1, 2), 0),
    "max_skipped": mostly(st.integers(1, 2), 0),
}
CONFIGURATIONS = st.fixed_dictionaries(GROUPS | RUN_ALWAYS, optional=RUN_SOMETIMES)
FIXED = {"preset": "cpu", "device": "cpu", "compile": "off", "eval_episodes": 1}
NOT_DRAWN = {"run_dir", "total_env_steps", "logger", "resume", "threads", "loss.extra_terms"}


def test_every_setting_is_drawn():
    groups = {f"{group}.{name}" for group in GROUPS for name in ALWAYS[group] | SOMETIMES[group]}
    drawn = groups | GROUPS.keys() | RUN_ALWAYS.keys() | RUN_SOMETIMES.keys() | FIXED.keys()
    assert drawn | NOT_DRAWN == names(TrainConfig()) and not drawn & NOT_DRAWN


def names(config: Any) -> set[str]:
    """All settings, those of groups with the group's name before them."""
    found = set()
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        inner = names(value) if dataclasses.is_dataclass(value) else set()
        found |= {field.name, *(f"{field.name}.{name}" for name in inner)}
    return found


def configuration(values: dict[str, Any], decisions: int) -> TrainConfig:
    """One that learns for so many decisions."""
    steps = (values.get("action_repeat") or 2) * (values["replay"]["seed_decisions"] + decisions)
    return TrainConfig.from_dict(values | FIXED | {"total_env_steps": steps})


@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(values=CONFIGURATIONS)
def test_a_configuration_runs_or_is_refused_in_one_line(tmp_path_factory, values: dict[str, Any], make_run):
    run_dir = tmp_path_factory.mktemp("runs") / "run"
    try:
        config = configuration(values, 6)
        run = make_run(config, run_dir)
    except ValueError as error:
        assert "\n" not in str(error)
        drawn = {f"{group}.{name}" for group in GROUPS for name in values[group]}
        drawn |= values.keys() - GROUPS.keys() - {"task"}  # a word of many messages
        assert any(name in str(error) for name in drawn), str(error)
        assert not run_dir.exists()
        return
    summary = run.run()  # with warnings as errors
    run.log.directory.close()
    assert summary["env_steps"] >= config.total_env_steps
    assert (run_dir / "summary.json").exists()


CALLS = {
    "a decision": lambda run: (run.learner.collector, "act"),
    "an update": lambda run: (run.learner.agent.updater, "step"),
    "a step of an evaluation": lambda run: (run.evaluator.env, "step_and_maybe_reset"),
    "a checkpoint": lambda run: (run.checkpoints.store, "save"),
}
STOPS = st.lists(st.tuples(st.sampled_from([*CALLS]), st.integers(1, 25)), min_size=1, max_size=3)


@settings(max_examples=6, deadline=None, suppress_health_check=[HealthCheck.too_slow, HealthCheck.filter_too_much])
@given(values=CONFIGURATIONS, stops=STOPS)
def test_a_configuration_that_is_stopped_anywhere_ends_as_if_it_had_not_been(
    tmp_path_factory, values: dict[str, Any], stops: list[tuple[str, int]], straight, make_run, results, stop_at
):
    run_dir = tmp_path_factory.mktemp("runs") / "run"
    try:
        config = configuration(values, 16)
        expected = straight(config)
    except ValueError:
        reject()
    run = make_run(config, run_dir)
    for kind, call in stops:
        stop_at(run, *CALLS[kind](run), call)
        try:
            run.run()
            break  # it has fewer of these calls
        except RunInterrupted:
            run.log.directory.close()
            run = make_run(config, run_dir, resume=run.env_steps > 0)
    else:
        run.run()
    run.log.directory.close()
    assert str(results(run, run_dir)) == str(expected)  # as texts, in which a nan is like another
