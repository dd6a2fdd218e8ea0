"""The whole chain on a CUDA device."""

from __future__ import annotations

import contextlib
import dataclasses
import warnings
from collections.abc import Iterator

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

from torchrl_etdmpc.collectors import evaluate
from torchrl_etdmpc.testing import random_slices
from torchrl_etdmpc.training import (
    TrainConfig,
    build_agent,
    build_collector,
    build_reanalyze,
    build_replay,
    load_agent,
    preset,
    save_agent,
)
from torchrl_etdmpc.training.builders import resolve_device
from torchrl_etdmpc.training.evaluator import Evaluator

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


def interleaved(compile_mode: str) -> dict[str, list[torch.Tensor]]:
    """Plans, updates and re-planned states in turns, with a coefficient and a weight average that move on the way."""
    torch.manual_seed(0)
    base = small()
    config = dataclasses.replace(
        base,
        compile=compile_mode,
        model=dataclasses.replace(base.model, dropout=0.0),
        loss=dataclasses.replace(base.loss, value_replayed=1.0),  # then an update draws no random numbers
        optim=dataclasses.replace(base.optim, average_decay=0.5, lr_halved_after=3.0),
    )
    agent = build_agent(config, 3, 1, "cuda")
    for parameter in (*agent.world_model.parameters(), *agent.acting_model.parameters()):
        if parameter.ndim > 1:
            torch.nn.init.normal_(parameter, std=parameter.shape[-2] ** -0.5)
    observation, batch = torch.randn(5, 3).cuda(), random_slices(3, 1, num_slices=8).to("cuda")
    noise = {id(planner): planner.draw_noise(5) for planner in (agent.planner, agent.reanalyze_planner)}
    kept: dict[str, list[torch.Tensor]] = {"plan": [], "replan": [], "loss": [], "weights": []}
    for turn in range(5):
        for name, planner in (("plan", agent.planner), ("replan", agent.reanalyze_planner)):
            kept[name].append(plan_of(planner)(observation, noise=noise[id(planner)]).mean)
        if turn == 3:
            agent.loss.reward_coef = 1.0
        metrics = agent.updater.step(batch)
        kept["loss"].append(torch.stack([metrics["loss_reward"], metrics["grad_norm_model"], metrics["kl_scale"]]))
    kept["weights"] = [parameter.detach() for parameter in agent.acting_model.parameters()]
    return kept


def test_graphs_that_take_turns_give_what_eager_calls_give():
    eager, graphs = interleaved("off"), interleaved("auto")
    for name in ("loss", "weights"):
        for expected, found in zip(eager[name], graphs[name], strict=True):
            torch.testing.assert_close(found, expected, rtol=2e-2, atol=2e-3)
    for name in ("plan", "replan"):  # what was returned first is still what it was: memory is not shared
        torch.testing.assert_close(graphs[name][0], eager[name][0], rtol=1e-2, atol=1e-2)
        assert all(found.isfinite().all() for found in graphs[name])
    before, after = graphs["loss"][2][0], graphs["loss"][3][0]
    assert after > 5 * before, "a coefficient that is assigned reaches the recorded graph"


def test_new_priorities_outlive_the_next_planning_call():
    config = dataclasses.replace(small(), compile="auto")
    agent = build_agent(config, 3, 1, "cuda")
    batch = random_slices(3, 1, num_slices=8).to("cuda")
    batch["priority_weight"] = torch.ones(8, 3, device="cuda")
    for _ in range(3):  # recorded after a first run
        agent.updater.step(batch)
        priority = batch["td_error"].clone()
        plan_of(agent.planner)(torch.zeros(1, 3, device="cuda"))
        torch.testing.assert_close(batch["td_error"], priority)


@pytest.mark.parametrize("compile_mode", ["off", "auto"])
def test_a_plan_never_waits_for_the_device(compile_mode):
    planner = build_agent(dataclasses.replace(small(), compile=compile_mode), 3, 1, "cuda").planner
    values = {"observation": torch.zeros(3), "plan_mean": torch.zeros(planner.horizon, 1)}
    state = TensorDict(values | {"is_init": torch.ones(1, dtype=torch.bool)}, [], device="cuda")
    for _ in range(3):
        planner(state.copy())
    with no_synchronisation():
        planner(state.copy())


@pytest.mark.parametrize("storage", ["cpu", "run"])
@pytest.mark.parametrize(("num_envs", "insertion"), [(1, "episode"), (2, "step"), (2, "episode")])
def test_rows_of_every_kind_reach_the_device_and_a_fault_ends_their_episodes(storage, num_envs, insertion):
    from torchrl_etdmpc.envs import make_env

    config = dataclasses.replace(small(device=storage), num_envs=num_envs, episode_length=40)
    config = dataclasses.replace(config, replay=dataclasses.replace(config.replay, insertion=insertion))
    env = make_env(config.task_spec, seed=0, num_envs=num_envs, parallel=False)
    agent = build_agent(config, 3, 1, "cuda")
    replay = build_replay(config, "cuda")
    collector = build_collector(config, agent, env, replay)
    for _ in range(35):
        collector.step()
    collector._truncate_episodes()
    rows = replay.storage[:]
    assert rows["next", "done"].sum() >= num_envs
    for _ in range(35):
        collector.step()
    assert all(value.isfinite() for value in agent.updater.step(replay.sample().to("cuda")).values())
    collector.shutdown()


def test_an_evaluation_leaves_the_random_numbers_of_training_alone():
    from torchrl_etdmpc.envs import make_env

    config = dataclasses.replace(small(), episode_length=20)
    agent = build_agent(config, 3, 1, "cuda")
    env = make_env(config.task_spec, num_envs=2, parallel=False)
    evaluator = Evaluator(env, agent, episodes=2, seed=7)
    before = torch.get_rng_state(), torch.cuda.get_rng_state()
    returns = [evaluator().return_mean for _ in range(2)]
    assert returns[0] == returns[1]
    assert all(map(torch.equal, before, (torch.get_rng_state(), torch.cuda.get_rng_state())))
    evaluator.close()


def test_an_agent_file_of_a_gpu_goes_on_on_a_cpu_and_back(tmp_path):
    config = small()
    agent = build_agent(config, 3, 1, "cuda")
    batch = random_slices(3, 1, num_slices=8)
    agent.updater.step(batch.to("cuda"))
    counters = {"env_steps": 0, "decision_steps": 0, "updates": 1, "wall_time_s": 0.0}
    for number, device in enumerate(("cpu", "cuda")):
        agent, *_ = load_agent(save_agent(tmp_path / f"{number}.pt", agent, config, counters), device=device)
        metrics = agent.updater.step(batch.to(device))
        assert all(value.device.type == device and value.isfinite() for value in metrics.values())
        assert agent.updater.updates == number + 2


@pytest.mark.skipif(torch.cuda.device_count() < 2, reason="needs two CUDA devices")
def test_what_comes_back_from_another_than_the_first_device_has_been_waited_for():
    from torchrl_etdmpc.collectors import StepCollector
    from torchrl_etdmpc.envs import make_env

    class Slow(TensorDictModuleBase):
        in_keys, out_keys = ["observation"], ["action"]

        def forward(self, tensordict):
            with torch.cuda.device(tensordict.device):
                torch.cuda._sleep(200_000_000)  # a tenth of a second of that device's time
            return tensordict.set("action", 0 * tensordict["observation"][..., :1] + 0.25)

    replay, before = TensorDictReplayBuffer(storage=LazyTensorStorage(100)), torch.cuda.current_device()
    try:
        device = resolve_device("cuda:1")
        env = make_env("pendulum-swingup", seed=0)
        collector = StepCollector(env, Slow(), replay_buffer=replay, policy_device=device)
        for _ in range(5):
            acted = collector.act()
            assert acted["action"].item() == 0.25
            collector.finish_step(acted)
        collector.shutdown()
    finally:
        torch.cuda.set_device(before)


def test_torchrl_s_planners_and_collectors_take_what_is_on_the_device():
    from torchrl.collectors import Collector
    from torchrl.modules import CEMPlanner

    from torchrl_etdmpc import LatentEnv
    from torchrl_etdmpc.envs import make_env

    agent = build_agent(small(), 3, 1, "cuda")
    latent_env = LatentEnv(agent.world_model)
    start = latent_env.reset(TensorDict({"observation": torch.zeros(2, 3)}, [2], device="cuda"))
    planner = CEMPlanner(latent_env, planning_horizon=2, optim_steps=2, num_candidates=8, top_k=3)
    assert planner(start)["action"].is_cuda
    options = {"frames_per_batch": 4, "total_frames": 8, "policy_device": "cuda"}
    options["use_buffers"] = False  # with them TorchRL 0.14 fails where the policy says what it writes
    env = make_env("pendulum-swingup", seed=0)
    collector = Collector(env, agent.planner, auto_register_policy_transforms=True, **options)
    assert [batch["plan", "loc"].isfinite().all().item() for batch in collector] == [True, True]
    collector.shutdown()
