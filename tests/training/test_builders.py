from __future__ import annotations

import dataclasses

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import CatTensors, StepCounter

from torchrl_etdmpc import EfficientTDMPCLoss
from torchrl_etdmpc.objectives import Term
from torchrl_etdmpc.training import (
    build_agent,
    build_collector,
    build_reanalyze,
    build_replay,
    resolve_device,
    row_bytes,
)
from torchrl_etdmpc.training.builders import replay_device

OBSERVATION_DIM, ACTION_DIM = 5, 2


@pytest.mark.parametrize(
    ("changes", "capacity"),
    [
        ({"total_env_steps": 20_000}, 10_000),
        ({"total_env_steps": 20_001}, 10_001),  # the last decision may pass the budget
        ({"total_env_steps": 20_002, "num_envs": 4}, 10_004),  # and so may the last decisions of several environments
        ({"total_env_steps": 20_000, "replay": {"capacity": 3000}}, 3000),
        ({"total_env_steps": 4_000_000}, 1_000_000),
    ],
)
def test_the_buffer_holds_the_budget_and_no_more_than_its_capacity(changes, capacity, tiny_config):
    config = tiny_config(**changes)
    size = build_replay(config).storage.max_size
    allowance = 101 * config.num_envs if capacity < config.replay.capacity else 0  # for resets that fail
    assert capacity <= size <= capacity + allowance


@pytest.mark.parametrize(
    ("setting", "device", "needed", "expected"),
    [
        ("auto", "cuda:1", 50, "cuda:1"),
        ("auto", "cuda:1", 51, "cpu"),  # more than half of what is free
        ("run", "cuda:1", 51, "cuda:1"),
        ("cpu", "cuda:1", 1, "cpu"),
        ("auto", "cpu", 1, "cpu"),
        ("run", "cpu", 10**12, "cpu"),
    ],
)
def test_the_buffer_is_on_the_run_s_device_if_it_fits(monkeypatch, setting, device, needed, expected, tiny_config):
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda which: (100, 1000) if which.index == 1 else (0, 1000))
    config = tiny_config(replay={"device": setting})
    assert replay_device(config, device, needed) == torch.device(expected)


@pytest.mark.parametrize(("short_of", "expected"), [(0, "cuda:1"), (1, "cpu")])
def test_the_buffer_is_on_a_gpu_if_all_of_its_rows_fit(monkeypatch, short_of, expected, tiny_config):
    config = tiny_config()
    free = 2 * config.replay_rows * row_bytes(24, 6) - short_of
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda which: (free, free))
    assert build_replay(config, "cuda:1", sizes=(24, 6)).storage.device == torch.device(expected)


def test_a_row_has_the_bytes_that_the_rule_counts_with(tiny_config):
    pytest.importorskip("dm_control")
    from torchrl_etdmpc.envs import make_env

    config = tiny_config(task="walker-walk")
    env = make_env("walker-walk", seed=0)
    replay = build_replay(config, sizes=(24, 6))
    collector = build_collector(config, build_agent(config, 24, 6), env, replay)
    for _ in range(3):
        collector.step()
    generation = 8  # an integer per row, kept by the writer
    assert replay[:].bytes() / 3 == row_bytes(24, 6) - generation


def test_what_an_environment_observes_and_no_term_reads_is_not_stored(tiny_config):
    pytest.importorskip("dm_control")
    from torchrl_etdmpc.envs import make_env

    def stored(*keys):
        config = tiny_config(task="walker-walk")
        env = make_env("walker-walk", seed=0).append_transform(StepCounter())
        env.append_transform(CatTensors(["observation"], "copy", del_keys=False))
        agent, replay = build_agent(config, 24, 6), build_replay(config)
        if keys:
            term = Term("idle", lambda world_model, slices, rollout: slices.reward, keys=("reward", *keys))
            loss = EfficientTDMPCLoss(agent.world_model, discount=0.99, extra_terms=[term])
            agent = dataclasses.replace(agent, loss=loss)
        collector = build_collector(config, agent, env, replay)
        for _ in range(3):
            collector.step()
        return replay[:]

    assert stored().bytes() / 3 == row_bytes(24, 6) - 8  # the generation, kept by the writer
    read = {"step_count", ("next", "copy"), "episode_reward", ("plan", "fallback")}
    assert set(stored(*read).keys(True, True)) - set(stored().keys(True, True)) == read


def test_a_sample_is_a_batch_of_slices(tiny_config):
    config = tiny_config(optim={"batch_size": 5}, loss={"slice_len": 4}, replay={"uniform_over": "starts"})
    replay = build_replay(config)
    steps = torch.arange(30)
    trajectories = {"traj_ids": steps // 10}
    replay.extend(TensorDict({"step": steps, "collector": trajectories}, [30]))
    sample = replay.sample()
    assert sample.shape == (5, 4)
    assert (sample["step"].diff(dim=-1) == 1).all()
    assert replay.sampler.uniform_over == "starts"
    assert replay.writer.tracks_generations


def test_slices_may_begin_in_the_last_steps_of_an_episode_where_episodes_can_end_early_or_if_asked(tiny_config):
    assert not build_replay(tiny_config()).sampler.partial
    assert build_replay(tiny_config(terminates=True)).sampler.partial
    assert build_replay(tiny_config(replay={"partial": True})).sampler.partial
    assert not build_replay(tiny_config(terminates=True, replay={"partial": False})).sampler.partial


@pytest.mark.parametrize(("updates", "every", "interval"), [(1, 10, 10), (2, 5, 10), (4, 2, 8)])
def test_the_reanalyze_interval_counts_decisions(updates, every, interval, tiny_config):
    # Reanalyze counts samples, and there is one per update.
    config = tiny_config(optim={"updates_per_decision": updates}, reanalyze={"every": every, "num_slices": 7})
    agent, replay = build_agent(config, OBSERVATION_DIM, ACTION_DIM), build_replay(config)
    reanalyze = build_reanalyze(config, agent, replay)
    assert (reanalyze.interval, reanalyze.num_slices, reanalyze.slice_len) == (interval, 7, 3)
    assert reanalyze.planner is agent.reanalyze_planner
    assert reanalyze.replay_buffer is replay


def test_reanalyze_can_be_turned_off(tiny_config):
    config = tiny_config(reanalyze={"every": 0})
    assert build_reanalyze(config, build_agent(config, OBSERVATION_DIM, ACTION_DIM), build_replay(config)) is None


def test_auto_is_the_cuda_device_where_there_is_one(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert resolve_device("auto") == torch.device("cpu")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    current, precisions = [], []
    monkeypatch.setattr(torch.cuda, "set_device", current.append)
    monkeypatch.setattr(torch, "set_float32_matmul_precision", precisions.append)
    assert resolve_device("auto") == torch.device("cuda")
    assert resolve_device("cuda:1") == torch.device("cuda", 1)
    assert current == [torch.device("cuda", 1)]  # whose copies TensorDict waits for
    assert precisions == ["high", "high"]
    assert resolve_device("cpu") == torch.device("cpu")
    with pytest.raises(ValueError, match=r"^device=cuda:2 is not there: this PyTorch sees 2 CUDA devices, "):
        resolve_device("cuda:2")
    assert precisions == ["high", "high"]


@pytest.mark.parametrize("name", ["cuda", "cuda:0"])
def test_cuda_without_a_device_is_refused(monkeypatch, name):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(ValueError) as caught:
        resolve_device(name)
    expected = f"device={name} needs a CUDA device and this PyTorch sees none; use device=cpu or device=auto."
    assert str(caught.value) == expected


@pytest.mark.parametrize("name", ["gpu", "meta", "mps", "cuda:first"])
def test_another_device_is_refused_by_its_name(name):
    with pytest.raises(ValueError, match=f"^device must be one of auto, cpu, cuda, cuda:N, got '{name}'.$"):
        resolve_device(name)
