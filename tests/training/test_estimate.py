from __future__ import annotations

import dataclasses

import pytest
import torch

from torchrl_etdmpc.training import PRESETS, TrainConfig, estimated_seconds, what_it_takes
from torchrl_etdmpc.training import estimate as module


def test_a_plan_takes_the_operations_that_were_counted():
    """benchmarks/results/cpu/speed.md: a plan of one head, horizon 3 and 512 samples is 43.3 GFLOP, mean score."""
    model = dataclasses.replace(TrainConfig().model, num_dynamics=4)
    planner = dataclasses.replace(TrainConfig().planner, horizon=3)
    flops = module.decision_flops(dataclasses.replace(TrainConfig(), model=model, planner=planner))[0]
    assert 0.5 * 162e9 < flops < 2 * 162e9


def flops(group, **options):
    """Of a plan and of the rest of a decision, with some settings of one group."""
    config = PRESETS["efficient-tdmpc"]
    changed = dataclasses.replace(getattr(config, group), **options)
    return module.decision_flops(dataclasses.replace(config, **{group: changed}))


def test_proposals_are_rolled_once_and_other_candidates_in_every_iteration():
    budget = {"num_samples": 512, "iterations": 6}
    without, half = (flops("planner", num_proposals=number, **budget)[0] for number in (0, 256))
    assert half == pytest.approx(without * 7 / 12)


def test_values_are_read_at_the_depths_that_a_score_reads():
    mean, final = ([flops("planner", score=score, horizon=h)[0] for h in (1, 6)] for score in ("mean", "final"))
    assert mean[0] == final[0] and mean[1] == pytest.approx(6 * mean[0])
    assert 3 * final[0] < final[1] < mean[1]


def test_reanalyze_costs_what_its_interval_leaves_of_it():
    never, every_tenth, every_fifth = (flops("reanalyze", every=every)[1] for every in (0, 10, 5))
    assert every_tenth > never
    assert every_fifth - never == pytest.approx(2 * (every_tenth - never))


def test_a_decision_is_as_many_env_steps_as_its_action_is_repeated(monkeypatch):
    monkeypatch.setattr(module, "_flops_per_second", lambda config: 1e10)

    def of_more_steps(repeat: int) -> float:
        options = {"action_repeat": repeat, "eval_every": 10**9}
        less, more = (dataclasses.replace(PRESETS["cpu"], total_env_steps=n, **options) for n in (50_000, 90_000))
        return estimated_seconds(more) - estimated_seconds(less)

    assert of_more_steps(2) == pytest.approx(2 * of_more_steps(4))


def test_updates_before_the_first_decision_take_their_time(monkeypatch):
    monkeypatch.setattr(module, "_flops_per_second", lambda config: 1e10)
    config = PRESETS["cpu"]
    without = dataclasses.replace(config, replay=dataclasses.replace(config.replay, pretrain_updates=0))
    assert estimated_seconds(config) > 1.01 * estimated_seconds(without)


def test_a_run_that_goes_on_has_the_rest_of_its_time_before_it(monkeypatch):
    monkeypatch.setattr(module, "estimated_seconds", lambda config: 20 * 3600)
    config, cpu = PRESETS["cpu"], torch.device("cpu")
    assert "about 20 hours on this CPU" in what_it_takes(config, cpu)
    assert "about 5 hours on this CPU" in what_it_takes(config, cpu, env_steps=config.total_env_steps * 3 // 4)


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
