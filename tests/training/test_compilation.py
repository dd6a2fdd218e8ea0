from __future__ import annotations

import copy
import gc
import itertools
import shutil
import sys
import warnings

import pytest
import torch

pytest.importorskip("dm_control")

from torchrl_etdmpc.testing import random_slices  # noqa: E402
from torchrl_etdmpc.training import (
    build_agent,  # noqa: E402
    compilation,  # noqa: E402
)
from torchrl_etdmpc.training.compilation import compile_call, resolve_compile  # noqa: E402

needs_compiler = pytest.mark.skipif(
    not any(map(shutil.which, ("g++", "clang++", "c++"))), reason="needs a C++ compiler"
)


@pytest.mark.parametrize(
    ("setting", "device", "compiler", "mode"),
    [
        ("off", "cpu", "g++", None),
        ("off", "cuda", "g++", None),
        ("auto", "cpu", "g++", "default"),
        ("auto", "cpu", "clang++", "default"),
        ("auto", "cuda", None, "reduce-overhead"),
        ("default", "cpu", None, "default"),
        ("default", "cuda", None, "default"),
        ("max", "cuda", None, "max-autotune"),
    ],
)
def test_auto_compiles_where_a_compiler_exists(monkeypatch, setting, device, compiler, mode):
    monkeypatch.setattr(shutil, "which", lambda name: f"/usr/bin/{name}" if name == compiler else None)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert resolve_compile(setting, torch.device(device), 10_000) == mode


def test_auto_does_not_compile_what_is_over_sooner_without(monkeypatch):
    monkeypatch.setattr(shutil, "which", lambda name: f"/usr/bin/{name}")
    cpu, cuda = torch.device("cpu"), torch.device("cuda")
    assert resolve_compile("auto", cpu, 5_999) is None
    assert resolve_compile("auto", cpu, 6_000) == "default"
    assert resolve_compile("auto", cuda, 1) == "reduce-overhead"
    assert resolve_compile("default", cpu, 1) == "default"


def test_the_results_of_a_graph_that_is_replayed_outlive_the_next_call(monkeypatch):
    memory = torch.zeros(2)  # CUDA graphs write every result to the same place

    def replayed(value: float) -> tuple[torch.Tensor, int]:
        return memory.fill_(value), 7

    monkeypatch.setattr(torch, "compile", lambda function, **options: function)
    call = compile_call(replayed, "reduce-overhead")
    first, number = call(1.0)
    call(2.0)
    assert (first.tolist(), number) == ([1, 1], 7)
    borrowed, _ = compile_call(replayed, "reduce-overhead", keep=False)(3.0)
    assert borrowed is memory


class Adder:
    def __init__(self, amount: float) -> None:
        self.amount = amount

    def add(self, x: torch.Tensor) -> torch.Tensor:
        return x + self.amount


def test_one_process_compiles_as_many_agents_as_it_likes(monkeypatch):
    compile_with = torch.compile
    monkeypatch.setattr(  # the limit is Dynamo's, whatever compiles what it finds
        torch, "compile", lambda function, options, **rest: compile_with(function, backend="eager", **rest)
    )
    with torch._dynamo.config.patch(recompile_limit=2):
        calls = [compile_call(Adder(amount).add, "default") for amount in range(4)]
        assert [call(torch.zeros(1)).item() for call in calls] == [0, 1, 2, 3]


def test_a_run_that_cannot_compile_goes_on_without_and_says_so_once(
    tmp_path, monkeypatch, tiny_config, make_run, user_warnings
):
    def broken(function, **options):
        def call(*args, **kwargs):
            raise RuntimeError("no such file: omp.h\nand a long log")

        return call

    monkeypatch.setattr(shutil, "which", lambda name: "/usr/bin/g++")
    monkeypatch.setattr(torch, "compile", broken)
    monkeypatch.setattr(compilation, "_WORTH_IT", 0)
    run = make_run(tiny_config(compile="auto", total_env_steps=80, checkpoint_every=1000), tmp_path)
    with pytest.warns(
        UserWarning, match=r"^cannot compile here, so training is slower: no such file: omp.h$"
    ) as caught:
        run.run()
    assert len(user_warnings(caught)) == 1
    assert run.learner.agent.updater.updates == 7 + 2 * 10


def test_a_run_that_must_compile_and_cannot_stops(tmp_path, monkeypatch, tiny_config, make_run):
    def broken(function, **options):
        raise RuntimeError("no compiler")

    monkeypatch.setattr(torch, "compile", broken)
    with pytest.raises(RuntimeError, match="no compiler"):
        make_run(tiny_config(compile="default"), tmp_path).run()


@pytest.fixture(scope="module")
def warmed(tmp_path_factory, tiny_config, make_run):
    """A run of small networks that was warmed up, and what it was before."""
    run = make_run(tiny_config(compile="default"), tmp_path_factory.mktemp("runs") / "run")
    before = copy.deepcopy(run.learner.agent.loss.state_dict()), torch.get_rng_state()
    torch._dynamo.utils.counters.clear()
    run.precompile()
    yield run, before, (copy.deepcopy(run.learner.agent.loss.state_dict()), torch.get_rng_state())
    run.learner.collector.shutdown()
    run.evaluator.close()
    run.log.directory.close()


@needs_compiler
def test_warming_up_moves_neither_weights_nor_the_running_scale_nor_random_numbers(warmed):
    run, (weights, state), (weights_after, state_after) = warmed
    assert torch.equal(state, state_after)
    assert all(torch.equal(value, weights_after[name]) for name, value in weights.items())
    assert run.learner.agent.updater.updates == 0
    assert run.learner.agent.loss.distill
    assert len(run.learner.replay) == 0


@needs_compiler
def test_a_run_that_was_warmed_up_compiles_nothing_more(warmed):
    run, _, _ = warmed
    graphs = torch._dynamo.utils.counters["stats"]["unique_graphs"]
    assert graphs == 4  # acting, evaluation, reanalyze and the gradients: one graph each
    assert not torch._dynamo.utils.counters["graph_break"]
    for _ in range(50):
        run.learner.step()
    list(run.learner.pretrain())
    for _ in range(2 * run.learner.reanalyze.interval):
        run.learner.step()
        run.learner.update()
    assert run.learner.reanalyze.refreshed > 0
    assert torch._dynamo.utils.counters["stats"]["unique_graphs"] == graphs


@needs_compiler
def test_compiled_updates_leave_no_memory_behind(warmed):
    updater, batch = warmed[0].learner.agent.updater, random_slices(5, 1, num_slices=4).contiguous()

    def blocks_after_100_updates():
        for _ in range(100):
            updater.step(batch)
        gc.collect()
        return sys.getallocatedblocks()

    # Caches grow at first, and less and less; a leak grows by a block or more with every update.
    counts = (blocks_after_100_updates() for _ in range(16))
    assert any(after - before < 50 for before, after in itertools.pairwise(counts))


@needs_compiler
def test_a_compiled_update_equals_an_eager_one(warmed, tiny_config):
    agent = warmed[0].learner.agent
    eager = build_agent(tiny_config(), 5, 1)
    eager.loss.load_state_dict(agent.loss.state_dict())
    batch = random_slices(5, 1, num_slices=4).contiguous()
    metrics, gradients = [], []
    for updater in (eager.updater, agent.updater):
        applied = []

        def record(optimizer, *_, applied=applied):
            flats = [flat for group in optimizer.param_groups for flat in group["params"]]
            applied += [flat.grad.clone() for flat in flats if flat.grad is not None]

        hook = updater.optimizer.register_step_pre_hook(record)
        torch.manual_seed(1)
        metrics.append(updater.step(batch).to_dict())
        hook.remove()
        gradients.append(applied)
    assert len(gradients[0]) == 4
    torch.testing.assert_close(metrics[1], metrics[0], rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(gradients[1], gradients[0], rtol=1e-3, atol=1e-5)


@needs_compiler
def test_compiled_calls_draw_the_random_numbers_of_eager_ones(warmed):
    planner = warmed[0].learner.agent.planner
    draws = []
    for call in (compile_call(planner.draw_noise, "default"), planner.draw_noise):
        torch.manual_seed(3)
        draws.append(call(2))
    for compiled, eager in zip(*draws, strict=True):
        torch.testing.assert_close(compiled, eager)
