from __future__ import annotations

import dataclasses

import torch

from torchrl_etdmpc.training import PRESETS, TrainConfig, estimated_seconds, what_it_takes
from torchrl_etdmpc.training import estimate as module


def test_a_plan_takes_the_operations_that_were_counted():
    """benchmarks/results/cpu/speed.md: a plan of one head, horizon 3 and 512 samples is 43.3 GFLOP, mean score."""
    model = dataclasses.replace(TrainConfig().model, num_dynamics=4)
    planner = dataclasses.replace(TrainConfig().planner, horizon=3)
    flops = module.decision_flops(dataclasses.replace(TrainConfig(), model=model, planner=planner))[0]
    assert 0.5 * 162e9 < flops < 2 * 162e9


def test_the_time_grows_with_the_work(monkeypatch):
    monkeypatch.setattr(module, "_flops_per_second", lambda config: 1e10)
    config = PRESETS["cpu"]
    longer = dataclasses.replace(config, total_env_steps=2 * config.total_env_steps)
    assert 1.5 * estimated_seconds(config) < estimated_seconds(longer) < 3 * estimated_seconds(config)
    assert estimated_seconds(PRESETS["efficient-tdmpc"]) > 100 * estimated_seconds(config)


def test_the_full_size_on_a_cpu_is_said_to_take_long_and_the_small_preset_is_named(monkeypatch):
    monkeypatch.setattr(module, "_flops_per_second", lambda config: 1e11)
    line = what_it_takes(PRESETS["efficient-tdmpc"], torch.device("cpu"))
    assert " days on this CPU" in line
    assert line.endswith(
        "preset=efficient-tdmpc is made for a GPU and there is none here: preset=cpu is made for a CPU"
    )
    assert what_it_takes(PRESETS["tdmpc2"], torch.device("cpu")).endswith("preset=tdmpc2-cpu is made for a CPU")
    for small in ("cpu", "tdmpc2-cpu"):
        assert "GPU" not in what_it_takes(PRESETS[small], torch.device("cpu"))


def test_compilation_is_named_where_something_is_compiled(monkeypatch):
    monkeypatch.setattr(module, "_flops_per_second", lambda config: 1e11)
    cpu = torch.device("cpu")
    assert what_it_takes(PRESETS["cpu"], cpu).endswith("before it some minutes to compile the first time")
    assert what_it_takes(PRESETS["cpu"], cpu, compiled=False).endswith("minutes on this CPU")


def test_a_first_product_that_takes_a_minute_changes_nothing(monkeypatch):
    config = PRESETS["cpu"]
    monkeypatch.setattr(module.timeit, "repeat", lambda *args, **kwargs: [60.0, 0.002, 0.001])
    rows, width = min(config.planner.num_samples * config.model.num_dynamics, 2048), config.model.mlp_dim
    assert module._flops_per_second(config) == 2.0 * rows * width**2 / 0.001


def test_threads_that_wait_for_each_other_on_a_busy_machine_change_nothing(monkeypatch):
    config, threads = PRESETS["cpu"], [2]
    monkeypatch.setattr(torch, "get_num_threads", lambda: threads[-1])
    monkeypatch.setattr(torch, "set_num_threads", threads.append)
    monkeypatch.setattr(module.timeit, "repeat", lambda *_, **__: [0.001 if threads[-1] == 1 else 0.02] * 10)
    rows, width = min(config.planner.num_samples * config.model.num_dynamics, 2048), config.model.mlp_dim
    assert module._flops_per_second(config) == 2.0 * rows * width**2 / 0.001
    assert threads[-1] == 2  # as it was


def test_an_estimate_draws_no_random_numbers():
    torch.manual_seed(0)
    before = torch.get_rng_state()
    estimated_seconds(PRESETS["cpu"])
    assert torch.equal(before, torch.get_rng_state())
