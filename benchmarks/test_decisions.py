"""Milliseconds per decision, everything included: environment, plan, update and the decision's share of reanalyze."""

from __future__ import annotations

import itertools
from typing import Any

import pytest
import torch
from sized import DEVICE, VARIANTS, configure

from torchrl_etdmpc.collectors import SeedPolicy
from torchrl_etdmpc.envs import make_env
from torchrl_etdmpc.runs import RunDirectory, RunLog
from torchrl_etdmpc.training import TrainConfig, TrainingRun, build_agent, build_collector, build_replay

TASK = "walker-walk"
EPISODIC = "gym/Hopper-v5"  # its episodes end at different times
# What a CPU can do in minutes; a GPU runs them all.
ON_CPU = ["cpu", "efficient-tdmpc", "bmpc"]
ON_GPU = [*ON_CPU, "efficient-tdmpc-utd2", "efficient-tdmpc-utd4"]


def named(num_envs: int) -> str:
    return "one environment" if num_envs == 1 else f"{num_envs} environments"


def rounds_of(num_envs: int) -> int:
    """A round of many environments is long: at least 200 decisions are timed, in at least 5 rounds."""
    return max(20 // num_envs, 5)


def begin(config: TrainConfig, folder) -> TrainingRun:
    """A run that has compiled, and has finished its random phase and pretraining."""
    parallel = DEVICE.type == "cuda"
    env = make_env(config.task, seed=0, num_envs=config.num_envs, parallel=parallel)
    eval_env = make_env(config.task, seed=1, num_envs=config.eval_episodes, parallel=False)
    log = RunLog(RunDirectory(folder / "run"), total_env_steps=config.total_env_steps)
    run = TrainingRun(config, env=env, eval_env=eval_env, log=log)
    run.precompile()
    while run.learner.collector.in_seed_phase:
        run.learner.step()
    for _ in run.learner.pretrain():
        pass
    return run


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("num_envs", [1, 4, 16])
@pytest.mark.parametrize("name", ON_GPU if DEVICE.type == "cuda" else ON_CPU)
def test_decision(measure, tmp_path, name, num_envs, variant):
    large = DEVICE.type == "cpu" and name != "cpu"
    if large and (num_envs > 1 or variant != "eager"):
        pytest.skip("takes too long on a CPU; the parts are measured apart")
    config = configure(
        name,
        variant,
        task=TASK,
        num_envs=num_envs,
        eval_episodes=1,
        total_env_steps=1_000_000,
        replay={"seed_decisions": 1000, "pretrain_updates": 1 if large else 20},
    )
    run = begin(config, tmp_path)
    learner = run.learner
    steps = config.reanalyze.every  # of all environments; every decision's share of reanalyze is in

    def decide() -> None:
        for _ in range(steps):
            learner.step(updates=True)

    before = learner.agent.updater.updates, learner.reanalyze.refreshed
    if not large:
        decide()
        assert learner.agent.updater.updates - before[0] == steps * num_envs * config.optim.updates_per_decision
        assert learner.reanalyze.refreshed > before[1]
    try:
        measure(
            f"decision, {name}, {named(num_envs)}",
            variant,
            decide,
            rounds=1 if large else rounds_of(num_envs),
            warmup_rounds=0 if large else 2,
            calls=steps * num_envs,
        )
    finally:
        learner.collector.shutdown()
        run.evaluator.close()


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("num_envs", [1, 4, 16])
def test_decision_where_episodes_end_early(measure, tmp_path, num_envs, variant):
    """With a termination head, slices that end with their episode, and one batched plan for all environments."""
    replay = {"seed_decisions": 1008, "pretrain_updates": 20}
    config = configure(
        "cpu", variant, task=EPISODIC, num_envs=num_envs, eval_episodes=1, total_env_steps=1_000_000, replay=replay
    )
    run = begin(config, tmp_path)
    learner = run.learner
    steps = config.reanalyze.every

    def decide() -> None:
        for _ in range(steps):
            learner.step(updates=True)

    try:
        measure(
            f"decision, cpu, episodic, {named(num_envs)}",
            variant,
            decide,
            rounds=rounds_of(num_envs),
            warmup_rounds=2,
            calls=steps * num_envs,
        )
        decided = learner.replay.storage[config.seed_decisions :]  # behind the random phase
        assert decided["next", "terminated"].any(), "no episode ended early"
    finally:
        learner.collector.shutdown()
        run.evaluator.close()


@pytest.mark.parametrize("variant", ["simulator", "random policy", "environment", "environment and collector"])
def test_one_step_of_walker(measure, variant):
    """One decision without planner: dm_control alone, the TorchRL environment, and the way into the run's buffer.

    The last holds the random policy of the random phase, which is measured apart too.
    """
    config = configure("cpu", "eager", task=TASK, num_envs=1, eval_episodes=1, total_env_steps=100_000)
    env = make_env(TASK, seed=0)
    raw: Any = env._env
    raw.reset()
    actions = itertools.cycle(torch.rand(500, 6) * 2 - 1)  # what the random policy would do: a still walker costs less

    def simulate() -> None:
        action = next(actions).numpy()
        raw.step(action)
        if raw.step(action).last():
            raw.reset()

    state = {"now": env.reset()}
    policy = SeedPolicy(env.action_spec)

    def act() -> None:
        policy(state["now"])

    def step() -> None:
        now = state["now"].set("action", next(actions))
        _, state["now"] = env.step_and_maybe_reset(now)

    buffer = build_replay(config)
    collector = build_collector(config, build_agent(config, 24, 6), env, buffer)
    calls = {"simulator": simulate, "random policy": act, "environment": step}
    call = calls.get(variant, collector.step)
    call()
    assert variant != "environment and collector" or len(buffer) == 1
    measure("one step of walker", variant, call, rounds=400, warmup_rounds=50, baseline="simulator")
    assert collector.in_seed_phase
    env.close()
