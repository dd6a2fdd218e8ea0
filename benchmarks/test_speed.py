"""Times of planning, reanalyze, updates and sampling; each is checked before it is timed.

    make bench                               # results go to benchmarks/results/<device>/speed.{json,md}
    make bench ARGS="-k cpu"                 # some of them; the others' rows are kept

One thread on a CPU. Compiled and eager run in one process, and a ratio is that of their medians.
"""

from __future__ import annotations

import warnings

import plain_bmpc
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.data import LazyTensorStorage, SliceSampler, TensorDictReplayBuffer
from torchrl.modules import MPPIPlanner
from torchrl.objectives.value import TDLambdaEstimator

from torchrl_etdmpc import EnsembleMPPIPlanner, LatentEnv, StepSliceSampler
from torchrl_etdmpc.testing import random_slices
from torchrl_etdmpc.training import TrainConfig, build_agent, preset

OBSERVATION_DIM, ACTION_DIM = 24, 6  # walker
DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")
PRESETS = {"thesis": "efficient-tdmpc", "bmpc": "bmpc", "cpu": "cpu"}
VARIANTS = ["eager", "compiled"] + (["cuda-graph"] if DEVICE.type == "cuda" else [])
SETTINGS = {"eager": "off", "compiled": "default", "cuda-graph": "auto"}
ROUNDS = {"thesis": 3, "bmpc": 10, "cpu": 100}


def make_agent(name: str, variant: str = "eager"):
    """An agent whose networks answer as trained ones do: nothing is zero."""
    torch.manual_seed(0)
    config = TrainConfig.from_dict(preset(PRESETS[name]).to_dict() | {"compile": SETTINGS[variant]})
    agent = build_agent(config, OBSERVATION_DIM, ACTION_DIM, DEVICE)
    for parameter in agent.world_model.parameters():
        if parameter.ndim > 1:
            torch.nn.init.normal_(parameter, std=parameter.shape[-2] ** -0.5)
    return config, agent


def draw(agent_planner: EnsembleMPPIPlanner, states: int):
    return torch.randn(states, OBSERVATION_DIM, device=DEVICE), agent_planner.draw_noise(states)


def assert_same_plan(plan, expected) -> None:
    """Up to rounding, which may swap elites of nearly the same score."""
    for field in ("mean", "scale"):
        difference = (getattr(plan, field) - getattr(expected, field)).abs()
        assert difference.max() < 0.1 and difference.mean() < 1e-2, field


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("name", PRESETS)
def test_plan(measure, name, variant):
    _, reference = make_agent(name)
    _, agent = make_agent(name, variant)
    observation, noise = draw(reference.planner, 1)
    with torch.no_grad():
        expected = reference.planner.plan(observation, noise=noise)
        assert_same_plan(agent.planner.plan(observation, noise=noise), expected)
        flop = measure.flop(lambda: reference.planner.plan(observation))
        measure(f"plan, {name}", variant, lambda: agent.planner.plan(observation), rounds=ROUNDS[name], flop=flop)


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("name", ["thesis", "cpu"])
def test_reanalyze(measure, name, variant):
    config, reference = make_agent(name)
    _, agent = make_agent(name, variant)
    states = config.reanalyze.num_slices * config.loss.slice_len
    observation, noise = draw(reference.reanalyze_planner, states)
    with torch.no_grad():
        expected = reference.reanalyze_planner.plan(observation, noise=noise)
        assert_same_plan(agent.reanalyze_planner.plan(observation, noise=noise), expected)
        flop = measure.flop(lambda: reference.reanalyze_planner.plan(observation))
        call, rounds = lambda: agent.reanalyze_planner.plan(observation), max(ROUNDS[name] // 3, 1)
        measure(f"reanalyze {states} states, {name}", variant, call, rounds=rounds, flop=flop)


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("name", ["thesis", "cpu"])
def test_update(measure, name, variant):
    config, agent = make_agent(name, variant)
    batch = random_slices(OBSERVATION_DIM, ACTION_DIM, num_slices=config.optim.batch_size).to(DEVICE)
    before = [parameter.clone() for parameter in agent.world_model.parameters()]
    metrics = agent.updater.step(batch)
    assert all(float(value) == float(value) for value in metrics.values())
    assert not any(map(torch.equal, before, agent.world_model.parameters()))
    flop = measure.flop(lambda: make_agent(name)[1].updater.step(batch))
    measure(f"update, {name}", variant, lambda: agent.updater.step(batch), rounds=ROUNDS[name], flop=flop)


@pytest.mark.parametrize("variant", ["eager per head", "eager", "compiled"])
def test_bmpc_plan_against_a_straightforward_one(measure, variant):
    _, reference = make_agent("bmpc")
    _, agent = make_agent("bmpc", "compiled" if variant == "compiled" else "eager")
    observation, noise = draw(reference.planner, 1)
    with torch.no_grad():
        plain = plain_bmpc.plan(reference.planner, observation, noise)
        assert_same_plan(reference.planner.plan(observation, noise=noise), plain)
        calls = {
            "eager per head": lambda: plain_bmpc.plan(reference.planner, observation, reference.planner.draw_noise(1))
        }
        call = calls.get(variant, lambda: agent.planner.plan(observation))
        measure("BMPC plan against a plain one", variant, call, rounds=10, baseline="eager per head")


@pytest.mark.parametrize("variant", ["TorchRL MPPIPlanner", "eager", "compiled"])
@pytest.mark.parametrize("name", ["bmpc", "cpu"])
def test_plan_against_torchrl(measure, name, variant):
    """One dynamics and one value head, the same candidates, horizon and iterations, no proposals."""
    config, agent = make_agent(name)
    config = TrainConfig.from_dict(
        config.to_dict() | {"compile": "off", "model": config.to_dict()["model"] | {"num_dynamics": 1, "num_values": 1}}
    )
    torch.manual_seed(0)
    world_model = build_agent(config, OBSERVATION_DIM, ACTION_DIM, DEVICE).world_model
    budget = {"horizon": config.planner.horizon, "num_samples": config.planner.num_samples}
    budget |= {"num_elites": config.planner.num_elites, "iterations": config.planner.iterations, "num_proposals": 0}
    ours = EnsembleMPPIPlanner(LatentEnv(world_model), score="final", warm_start=False, **budget)
    plan = torch.compile(ours.plan, fullgraph=True, dynamic=False) if variant == "compiled" else ours.plan
    latent = world_model.encode(torch.randn(1, OBSERVATION_DIM, device=DEVICE)).detach()
    value = TensorDictModule(
        lambda z: world_model.values(z).mean(-1, keepdim=True), in_keys=["latent"], out_keys=["state_value"]
    )
    theirs = MPPIPlanner(
        LatentEnv(world_model),
        TDLambdaEstimator(gamma=0.99, lmbda=1.0, value_network=value),
        temperature=0.5,
        planning_horizon=budget["horizon"],
        optim_steps=budget["iterations"],
        num_candidates=budget["num_samples"],
        top_k=budget["num_elites"],
    )
    state = TensorDict({"latent": latent}, [1])
    with torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for action in (plan(latent=latent).action, theirs.planning(state)):
            assert action.shape[-1] == ACTION_DIM and action.isfinite().all() and action.abs().max() <= 1
        call = (lambda: theirs.planning(state)) if variant.startswith("TorchRL") else (lambda: plan(latent=latent))
        case = f"plan, one head, {name} size"
        measure(case, variant, call, rounds=max(ROUNDS[name] // 3, 5), baseline="TorchRL MPPIPlanner")


@pytest.mark.parametrize("variant", ["TorchRL SliceSampler", "StepSliceSampler"])
@pytest.mark.parametrize("rows", [100_000, 1_000_000])
def test_sample_slices_after_a_write(measure, rows, variant):
    samplers = {
        "StepSliceSampler": lambda: StepSliceSampler(3),
        "TorchRL SliceSampler": lambda: SliceSampler(
            slice_len=3, traj_key=("collector", "traj_ids"), truncated_key=None, cache_values=True
        ),
    }
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(rows), sampler=samplers[variant](), batch_size=3 * 256)
    steps = TensorDict(
        {
            "observation": torch.randn(rows, OBSERVATION_DIM),
            "step": torch.arange(rows) % 500,
            "collector": {"traj_ids": torch.arange(rows) // 500},
        },
        batch_size=[rows],
    )
    buffer.extend(steps)

    def write_and_sample():
        buffer.extend(steps[:1])
        return buffer.sample()

    slices = buffer.sample().reshape(-1, 3)
    assert (slices["step"].diff(dim=1) == 1).all()
    case = f"write a row and sample 256 slices of {rows:,} rows"
    measure(case, variant, write_and_sample, rounds=30, baseline="TorchRL SliceSampler")
