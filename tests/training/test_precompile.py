from __future__ import annotations

import contextlib
import os
import pickle
import shutil
import subprocess
import sys
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torchrl.envs import ExplorationType
from torchrl.envs.utils import exploration_type

from torchrl_etdmpc.objectives import Term
from torchrl_etdmpc.testing import random_slices
from torchrl_etdmpc.training import DistributedConfig, build_agent, build_replay, own_code, precompile

needs_compiler = pytest.mark.skipif(
    not any(map(shutil.which, ("g++", "clang++", "c++"))), reason="needs a C++ compiler"
)


@pytest.fixture
def watched(monkeypatch, agent):
    """What happens while something precompiles, in order: parts that are called, helpers that are asked and awaited."""
    events: list[object] = []
    compiled = []

    class Helper:
        def wait(self) -> None:
            events.append("waits")

    @contextlib.contextmanager
    def helper(request):
        assert request[1:4] == (5, 1, str(agent.device))
        events.append(("asks for", request[-1]))
        yield Helper()
        events.append("ends")

    def part(name):
        def call() -> None:
            events.append(name)
            compiled.append(name)

        return call

    monkeypatch.setattr(precompile, "_helper", helper)
    monkeypatch.setattr(precompile, "_parts", lambda *_: {name: part(name) for name in "abcd"})
    monkeypatch.setattr(precompile, "_graphs_not_in_the_cache", lambda: len(compiled))
    return events


@pytest.fixture
def agent(tiny_config):
    return build_agent(tiny_config(compile="default"), 5, 1)


def run(tiny_config, agent) -> float:
    return precompile.precompile(tiny_config(compile="default"), agent, (1,), (2,))


def test_reanalyze_is_compiled_for_as_many_rows_as_a_sample_has(tiny_config, monkeypatch):
    config = tiny_config(compile="default", optim={"batch_size": 4}, reanalyze={"num_slices": 9})
    agent = build_agent(config, 5, 1)
    shapes = []
    monkeypatch.setattr(type(agent.reanalyze_planner), "forward", lambda _, states: shapes.append(states.batch_size))
    precompile._parts(config, agent, (), (1,))["reanalyze"]()
    assert shapes == [torch.Size([4 * config.loss.slice_len])]


def test_acting_and_evaluating_are_compiled_for_as_many_states_as_each_has(tiny_config, monkeypatch):
    config = tiny_config(compile="default")
    agent = build_agent(config, 5, 1)
    seen = []

    def forward(planner, states):
        seen.append((planner, states.batch_size, exploration_type()))

    monkeypatch.setattr(type(agent.planner), "forward", forward)
    parts = precompile._parts(config, agent, (), (3,))
    parts["act"]()
    parts["evaluate"]()
    acting = agent.planner, torch.Size([]), ExplorationType.RANDOM
    assert seen == [acting, (agent.eval_planner, torch.Size([3]), ExplorationType.DETERMINISTIC)]


@pytest.mark.parametrize("terminates", [False, True])
def test_the_graph_of_an_update_is_that_of_replayed_slices(tiny_config, terminates):
    config = tiny_config(compile="off", terminates=terminates, optim={"batch_size": 4})
    agent, replay = build_agent(config, 5, 1), build_replay(config)
    rows = random_slices(5, 1, num_slices=1, slice_len=30).reshape(-1)
    rows["collector", "traj_ids"] = torch.zeros(30, dtype=torch.int64)
    rows["next", "done"][-1] = True
    replay.extend(rows)
    graphs = []

    def count(graph, _):
        graphs.append(graph)
        return graph

    torch._dynamo.reset()
    updater = agent.updater
    updater._compiled = torch.compile(updater._gradients, backend=count, fullgraph=True, dynamic=False)
    precompile._parts(config, agent, (), (1,))["update"]()
    assert len(graphs) == 1
    updater.step(replay.sample())
    assert len(graphs) == 1


def test_an_update_that_reads_more_than_can_be_made_up_compiles_when_it_is_made(monkeypatch, tiny_config):
    path = f"{__name__}:reads_the_value"
    monkeypatch.setattr("torchrl_etdmpc.training.own_code._followed", {("loss.extra_terms", path): reads_the_value})
    config = tiny_config(compile="off", loss={"extra_terms": path})
    agent = build_agent(config, 5, 1)
    agent.updater._compiled = lambda *_: pytest.fail("the batch lacks the value of plans")
    precompile._parts(config, agent, (), (1,))["update"]()


def reads_the_value(world_model):
    return [Term("mine", lambda model, slices, rollout: slices.reward, keys=("reward", ("plan", "value")))]


def test_one_thread_compiles_in_one_process(monkeypatch, watched, tiny_config, agent):
    monkeypatch.setattr(torch, "get_num_threads", lambda: 1)
    monkeypatch.setattr(precompile, "usable_cores", lambda: 8)
    assert run(tiny_config, agent) > 0
    assert watched == ["a", "b", "c", "d"]


def test_every_part_is_called_until_its_cuda_graph_is_recorded(monkeypatch, watched, tiny_config):
    monkeypatch.setattr(torch, "get_num_threads", lambda: 1)
    config = tiny_config(compile="max")
    precompile.precompile(config, build_agent(config, 5, 1), (1,), (2,))
    assert watched == [*"abcd"] * 3  # run, recorded, replayed


@pytest.mark.parametrize(
    ("cores", "asked", "own"),
    [
        (1, [], "abcd"),
        (2, ["bd"], "ac"),
        (3, ["b", "c"], "ad"),
        (4, ["b", "c", "d"], "a"),
        (64, ["b", "c", "d"], "a"),
    ],
)
def test_with_several_threads_the_cores_share_the_parts(monkeypatch, watched, tiny_config, agent, cores, asked, own):
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    monkeypatch.setattr(precompile, "usable_cores", lambda: cores)
    run(tiny_config, agent)
    asks, waits, ends = [("asks for", [*names]) for names in asked], ["waits"] * len(asked), ["ends"] * len(asked)
    assert watched == [*asks, *own, *waits, *"".join(asked), *ends]


def test_beside_a_gpu_the_cores_share_the_parts_whatever_the_threads(monkeypatch, watched, tiny_config, agent):
    monkeypatch.setattr(torch, "get_num_threads", lambda: 1)
    monkeypatch.setattr(precompile, "usable_cores", lambda: 2)
    monkeypatch.setattr(type(agent), "device", torch.device("cuda:1"))
    monkeypatch.setattr(torch.random, "fork_rng", lambda devices: contextlib.nullcontext())
    run(tiny_config, agent)
    assert watched[0] == ("asks for", ["b", "d"])
    assert watched[1:] == ["a", "c", "waits", "b", "d", "ends"]


def test_nobody_waits_for_helpers_where_the_cache_has_everything(monkeypatch, watched, tiny_config, agent):
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    monkeypatch.setattr(precompile, "usable_cores", lambda: 2)
    monkeypatch.setattr(precompile, "_graphs_not_in_the_cache", lambda: 7)
    run(tiny_config, agent)
    assert watched == [("asks for", ["b", "d"]), "a", "c", "b", "d", "ends"]


def test_a_helper_that_fails_does_so_in_silence_and_leaves_its_parts_to_this_process(capfd):
    with precompile._helper(("no", "request")) as helper:
        assert helper.wait(60) == 1
    assert capfd.readouterr() == ("", "")


def test_a_helper_finds_the_user_s_modules_and_the_folder_s_only_behind_all_others(monkeypatch, tmp_path):
    (tmp_path / "mine.py").touch()
    (tmp_path / "random.py").write_text("raise SystemExit(3)")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path, str(tmp_path)])  # as a task of one's own leaves it
    monkeypatch.setattr(precompile, "_HELP", "import random, mine")
    with precompile._helper(("a", "request")) as helper:
        assert helper.wait(60) == 0


def test_a_helper_follows_the_code_that_the_one_that_it_helps_has_followed(monkeypatch, tmp_path, tiny_config):
    (tmp_path / "of_mine.py").write_text(
        "def score(returns): return returns.mean((-3, -2, -1))\ndef terms(world_model): return []\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(own_code, "_followed", {})
    score, terms = "of_mine:score", "of_mine:terms"
    for name, value in {"planner.score": score, "reanalyze.score": score, "loss.extra_terms": terms}.items():
        own_code.follow_own_code(name, value)
    config = tiny_config(planner={"score": score}, reanalyze={"score": score}, loss={"extra_terms": terms})
    with precompile._helper((config, 5, 1, (1,), (2,), [])) as helper:
        assert helper.wait(100) == 0


def test_a_helper_ends_with_the_one_that_it_helps(tiny_config):
    with pytest.raises(KeyboardInterrupt), precompile._helper((tiny_config(), 5, 1, (1,), (2,), [])) as helper:
        raise KeyboardInterrupt
    assert helper.poll() is not None


@pytest.mark.parametrize(("device", "acts"), [("cpu", True), ("cuda", False)])
def test_a_learner_on_a_gpu_compiles_no_plans_of_its_workers(tiny_config, device, acts):
    model = SimpleNamespace(observation_dim=5, action_dim=1)
    agent: Any = SimpleNamespace(world_model=model, device=torch.device(device))
    config = DistributedConfig.from_dict(tiny_config().to_dict())
    assert ("act" in precompile._parts(config, agent, (), (1,))) == acts
    assert "act" in precompile._parts(tiny_config(), agent, (), (1,))


_FIND = """
import pickle, sys
import torch
from torchrl_etdmpc.training import build_agent
from torchrl_etdmpc.training.precompile import _graphs_not_in_the_cache, _helper, _parts

torch.set_num_threads(2)
config, sizes, batches = pickle.load(sys.stdin.buffer)
with _helper((config, *sizes, *batches, ["act"])) as helper:
    assert helper.wait() == 0
_parts(config, build_agent(config, *sizes), *batches)["act"]()
print(torch._dynamo.utils.counters["stats"]["unique_graphs"], _graphs_not_in_the_cache())
"""


@pytest.mark.slow  # compiles in an empty cache
@needs_compiler
def test_what_a_helper_compiles_the_process_that_it_helps_finds_in_the_cache(tmp_path, tiny_config):
    config = tiny_config(compile="default", planner={"horizon": 1, "num_proposals": 0})
    request = pickle.dumps((config, (5, 1), ((1,), (2,))))
    environment = {**os.environ, "TORCHINDUCTOR_CACHE_DIR": str(tmp_path)}  # empty
    command = [sys.executable, "-c", _FIND]
    done = subprocess.run(command, input=request, env=environment, capture_output=True, timeout=500, check=True)
    assert done.stdout.split() == [b"1", b"0"]
