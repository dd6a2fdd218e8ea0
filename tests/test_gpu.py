"""The whole chain on a CUDA device."""

from __future__ import annotations

import contextlib
import dataclasses
import warnings
from collections.abc import Iterator

import pytest
import torch

from torchrl_etdmpc.collectors import evaluate
from torchrl_etdmpc.testing import random_slices
from torchrl_etdmpc.training import (
    TrainConfig,
    build_agent,
    build_collector,
    build_reanalyze,
    build_replay,
    preset,
)

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device"),
]


def small(**replay) -> TrainConfig:
    base = preset("cpu")
    return dataclasses.replace(
        base,
        task="pendulum-swingup",
        compile="off",
        total_env_steps=1000,
        replay=dataclasses.replace(base.replay, seed_decisions=60, **replay),
    )


@contextlib.contextmanager
def no_synchronisation() -> Iterator[None]:
    """Where the host waits for the device, it fails."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # PyTorch: the mode is a prototype and does not see everything
        torch.cuda.set_sync_debug_mode("error")
    try:
        yield
    finally:
        torch.cuda.set_sync_debug_mode("default")


@pytest.mark.parametrize("storage", ["cpu", "run", "auto"])
def test_collecting_reanalyzing_and_updating_agree_on_the_device(storage):
    from torchrl_etdmpc.envs import make_env

    config = small(device=storage)
    env = make_env(config.task, seed=0)
    agent = build_agent(config, 3, 1, "cuda")
    replay = build_replay(config, "cuda")
    reanalyze = build_reanalyze(config, agent, replay)
    collector = build_collector(config, agent, env, replay)
    for _ in range(70):
        collector.step()
    for _ in range(2 * reanalyze.interval):
        metrics = agent.updater.step(replay.sample().to("cuda"))
    assert reanalyze.refreshed > 0
    assert all(value.isfinite() and value.is_cuda for value in metrics.values())
    eval_env = env.append_transform(agent.eval_planner.make_tensordict_primer())
    assert evaluate(eval_env, agent.eval_planner, episodes=1, policy_device="cuda").returns.isfinite().all()


@pytest.mark.parametrize("compile_mode", ["off", "auto"])
def test_an_update_never_waits_for_the_device(compile_mode):
    config = dataclasses.replace(small(device="run"), compile=compile_mode)
    agent = build_agent(config, 3, 1, "cuda")
    replay = build_replay(config, "cuda")
    rows = random_slices(3, 1, num_slices=20).reshape(-1)
    rows["collector", "traj_ids"] = torch.arange(60) // 3
    replay.extend(rows.to("cuda"))
    for _ in range(3):  # compilation, and the sampler's first look at the rows
        agent.updater.step(replay.sample())
    with no_synchronisation():
        agent.updater.step(replay.sample())


def plan_of(planner):
    """What the planner calls: the compiled plan where there is one."""
    return planner.compiled_plan or planner.plan


@pytest.mark.parametrize("compile_mode", ["off", "default", "auto"])
def test_a_plan_and_an_update_agree_with_the_cpu(compile_mode):
    torch.manual_seed(0)
    config = dataclasses.replace(small(), compile=compile_mode)
    agents = {device: build_agent(config, 3, 1, device) for device in ("cpu", "cuda")}
    for parameter in agents["cpu"].world_model.parameters():
        if parameter.ndim > 1:  # new networks predict zeros, so that rounding alone would choose the elites
            torch.nn.init.normal_(parameter, std=parameter.shape[-2] ** -0.5)
    agents["cuda"].world_model.load_state_dict(agents["cpu"].world_model.state_dict())
    observation = torch.randn(5, 3)
    noise = agents["cpu"].planner.draw_noise(5)
    plans = {
        device: plan_of(agent.planner)(observation.to(device), noise=type(noise)(*(draw.to(device) for draw in noise)))
        for device, agent in agents.items()
    }
    torch.testing.assert_close(plans["cuda"].loc.cpu(), plans["cpu"].loc, atol=1e-2, rtol=1e-2)
    batch = random_slices(3, 1, num_slices=8)
    metrics = {device: agent.updater.step(batch.to(device)) for device, agent in agents.items()}
    for name in ("loss_consistency", "loss_reward"):
        torch.testing.assert_close(metrics["cuda"][name].cpu(), metrics["cpu"][name], atol=1e-3, rtol=1e-2)


@pytest.mark.parametrize("compile_mode", ["default", "auto"])
def test_compiled_replays_draw_new_noise(compile_mode):
    config = dataclasses.replace(small(), compile=compile_mode)
    planner = build_agent(config, 3, 1, "cuda").planner
    observation = torch.zeros(1, 3, device="cuda")
    actions = torch.cat([plan_of(planner)(observation).action for _ in range(8)])
    assert actions.std(0).min() > 0
