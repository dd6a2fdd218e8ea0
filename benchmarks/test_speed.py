"""Times of the parts at the sizes of the cpu preset, eager, on one thread; each is checked before it is timed.

make bench
"""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, SliceSampler, TensorDictReplayBuffer

from torchrl_etdmpc import StepSliceSampler
from torchrl_etdmpc.testing import random_slices
from torchrl_etdmpc.training import build_agent, preset

OBSERVATION_DIM, ACTION_DIM = 24, 6  # walker


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="module")
def agent():
    torch.manual_seed(0)
    config = preset("cpu")
    values = config.to_dict()
    return build_agent(type(config).from_dict({**values, "compile": "off"}), OBSERVATION_DIM, ACTION_DIM)


@pytest.mark.parametrize("states", [1, 10], ids=lambda states: f"{states}-states")
def test_plan(benchmark, agent, states):
    observation = torch.randn(states, OBSERVATION_DIM)
    plan = agent.planner.plan(observation)
    assert plan.action.isfinite().all() and plan.action.abs().max() <= 1 and not plan.fallback.any()
    benchmark(agent.planner.plan, observation)


def test_reanalyze_plan(benchmark, agent):
    observation = torch.randn(18, OBSERVATION_DIM)
    plan = agent.reanalyze_planner.plan(observation)
    assert plan.scale.min() >= 0.05 and plan.value.isfinite().all()
    benchmark(agent.reanalyze_planner.plan, observation)


def test_update(benchmark, agent):
    batch = random_slices(OBSERVATION_DIM, ACTION_DIM, num_slices=64)
    before = [parameter.clone() for parameter in agent.world_model.parameters()]
    for _ in range(2):  # heads that start at zero pass a gradient on from the second step
        metrics = agent.updater.step(batch)
    assert all(float(value) == float(value) for value in metrics.values())
    changed = [not torch.equal(old, new) for old, new in zip(before, agent.world_model.parameters(), strict=True)]
    assert all(changed)
    benchmark(agent.updater.step, batch)


@pytest.mark.parametrize("sampler", ["ours", "torchrl"])
def test_sample_slices_after_a_write(benchmark, sampler):
    samplers = {
        "ours": lambda: StepSliceSampler(3),
        "torchrl": lambda: SliceSampler(
            slice_len=3, traj_key=("collector", "traj_ids"), truncated_key=None, cache_values=True
        ),
    }
    rows, episode = 100_000, 500
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(rows), sampler=samplers[sampler](), batch_size=3 * 256)
    steps = TensorDict(
        {
            "observation": torch.randn(rows, OBSERVATION_DIM),
            "step": torch.arange(rows) % episode,
            "collector": {"traj_ids": torch.arange(rows) // episode},
        },
        batch_size=[rows],
    )
    buffer.extend(steps)

    def write_and_sample():
        buffer.extend(steps[:1])
        return buffer.sample()

    slices = buffer.sample().reshape(-1, 3)
    assert (slices["step"].diff(dim=1) == 1).all()
    benchmark(write_and_sample)
