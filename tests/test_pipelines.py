"""Foreign pipelines: collector x environment x storage x sampler, with the planner and the loss.

``docs/pipelines.md`` shows the tables of this file; a test holds them equal.
"""

from __future__ import annotations

import functools
import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.collectors import AsyncBatchedCollector, Collector, MultiAsyncCollector, MultiSyncCollector
from torchrl.data import (
    Binary,
    Bounded,
    Composite,
    LazyMemmapStorage,
    LazyTensorStorage,
    PrioritizedSliceSampler,
    SliceSampler,
    SliceSamplerWithoutReplacement,
    TensorDictReplayBuffer,
    Unbounded,
)
from torchrl.envs import EnvBase, InitTracker, ParallelEnv, SerialEnv, TensorDictPrimer, TransformedEnv
from torchrl.objectives import SoftUpdate

from torchrl_etdmpc import (
    EfficientTDMPCLoss,
    EnsembleMPPIPlanner,
    LatentEnv,
    StepCollector,
    StepSliceSampler,
    WorldModel,
)
from torchrl_etdmpc.training.ray_cluster import RayCluster

SLICE_LEN, NUM_SLICES, FRAMES, BATCHES = 3, 16, 24, 4
TRAJECTORY, WORKER = ("collector", "traj_ids"), "worker"


class Diary(EnvBase):
    """Its observation is which episode this is, of all of them, and which step; episodes last 5 to 8 steps."""

    def __init__(self, number: int) -> None:
        super().__init__()
        self.observation_spec = Composite(observation=Unbounded(2))
        self.action_spec = Bounded(-1, 1, shape=torch.Size([1]), dtype=torch.float32)
        self.reward_spec = Unbounded(1)
        self.full_done_spec = Composite(
            {key: Binary(1, dtype=torch.bool) for key in ("done", "terminated", "truncated")}
        )
        self.episode, self.step_count = 1000 * number, 0

    def _set_seed(self, seed: int | None) -> None:
        pass

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs) -> TensorDict:
        self.episode, self.step_count = self.episode + 1, 0
        return self._page()

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        self.step_count += 1
        return self._page().set("reward", tensordict["action"].abs())

    def _page(self) -> TensorDict:
        done = torch.tensor([self.step_count == 5 + self.episode % 4])
        observation = torch.tensor([float(self.episode), float(self.step_count)])
        flags = {"done": done, "terminated": torch.zeros_like(done), "truncated": done.clone()}
        return TensorDict({"observation": observation, **flags})


def make_env(number: int = 0) -> TransformedEnv:
    return TransformedEnv(Diary(number), InitTracker())


MAKERS = [functools.partial(make_env, number) for number in range(2)]


def make_planner(*, warm_start: bool = True) -> EnsembleMPPIPlanner:
    torch.manual_seed(0)
    model = WorldModel(2, 1, latent_dim=8, mlp_dim=8, encoder_dim=8, num_dynamics=1)
    budget = {"horizon": 2, "num_samples": 4, "num_elites": 2, "num_proposals": 1, "iterations": 1}
    return EnsembleMPPIPlanner(LatentEnv(model), **budget, warm_start=warm_start)


def with_collector(kind, env, planner, **options) -> Iterator[TensorDictBase]:
    options = {"frames_per_batch": FRAMES, "total_frames": FRAMES * BATCHES} | options
    collector = kind(env, planner, auto_register_policy_transforms=True, **options)
    try:
        for batch in collector:
            yield batch if batch is None else batch.exclude("plan_mean", ("next", "plan_mean")).clone()
    finally:
        collector.shutdown()


def with_step_collector(env, planner) -> Iterator[TensorDictBase]:
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(1000))
    collector = StepCollector(env, planner, replay_buffer=buffer, total_frames=FRAMES * BATCHES)
    yield from (batch.clone() for batch in collector)
    collector.shutdown()


def with_async_batched(_) -> Iterator[TensorDictBase]:
    planner = make_planner(warm_start=False)  # this collector registers no primer
    options = {"frames_per_batch": FRAMES, "total_frames": FRAMES * BATCHES, "env_backend": "threading"}
    collector = AsyncBatchedCollector(create_env_fn=MAKERS, policy=planner, **options)
    try:
        for batch in collector:
            yield batch.clone()
    finally:
        collector.shutdown()


def with_one_collector_per_worker(_) -> Iterator[TensorDictBase]:
    """Rows as Ray's and the distributed collectors bring them: each worker counts its episodes from 0."""
    workers = [with_collector(Collector, make(), make_planner()) for make in MAKERS]
    for batches in zip(*workers, strict=True):
        for number, batch in enumerate(batches):
            yield batch.set(WORKER, torch.full(batch.batch_size, number))


def with_ray(planner) -> Iterator[TensorDictBase]:
    """Two workers of a cluster of this machine: each counts its episodes from 0; its environment knows its number."""
    ray = pytest.importorskip("ray")
    ray.cloudpickle.register_pickle_by_value(sys.modules[__name__])  # the workers cannot import this file
    from torchrl.collectors.distributed import RayCollector

    cluster = RayCluster(None, workers=2)
    try:
        numbers = [TensorDictPrimer({WORKER: Unbounded(1, dtype=torch.int64)}, default_value=k) for k in range(2)]
        makers = [functools.partial(make_numbered_env, k, number) for k, number in enumerate(numbers)]
        options: dict = {"frames_per_batch": FRAMES, "total_frames": FRAMES * BATCHES}
        options["remote_configs"] = {"num_cpus": 1}
        options["sync"] = True  # else batches come in any order, and episodes are joined or not
        options["collector_kwargs"] = [{"auto_register_policy_transforms": True} for _ in makers]
        collector = RayCollector(makers, planner, **options)
        collector.update_policy_weights_(planner)
        for batch in collector:  # which shuts itself down
            yield batch.exclude("plan_mean", ("next", "plan_mean"), ("next", WORKER)).clone()
    finally:
        cluster.close()
        ray.cloudpickle.unregister_pickle_by_value(sys.modules[__name__])


def make_numbered_env(number: int, primer: TensorDictPrimer) -> TransformedEnv:
    return make_env(number).append_transform(primer)


SOURCES: dict[tuple[str, str], Callable[[EnsembleMPPIPlanner], Iterator[TensorDictBase]]] = {
    ("StepCollector", "single"): lambda planner: with_step_collector(make_env(), planner),
    ("StepCollector", "SerialEnv"): lambda planner: with_step_collector(SerialEnv(2, MAKERS), planner),
    ("Collector", "single"): lambda planner: with_collector(Collector, make_env(), planner),
    ("Collector", "single, split_trajs"): lambda planner: with_collector(
        Collector, make_env(), planner, split_trajs=True
    ),
    ("Collector", "SerialEnv"): lambda planner: with_collector(Collector, SerialEnv(2, MAKERS), planner),
    ("Collector", "SerialEnv, split_trajs"): lambda planner: with_collector(
        Collector, SerialEnv(2, MAKERS), planner, split_trajs=True
    ),
    ("Collector", "ParallelEnv"): lambda planner: with_collector(Collector, ParallelEnv(2, MAKERS), planner),
    ("MultiSyncCollector", "single"): lambda planner: with_collector(MultiSyncCollector, MAKERS, planner),
    ("MultiAsyncCollector", "single"): lambda planner: with_collector(MultiAsyncCollector, MAKERS, planner),
    ("AsyncBatchedCollector", "single"): with_async_batched,
    ("RayCollector", "single"): with_ray,
    ("one Collector per worker", "single"): with_one_collector_per_worker,
}

STORAGES: dict[str, Callable[[Path], LazyTensorStorage]] = {
    "LazyTensorStorage": lambda path: LazyTensorStorage(200),
    "LazyMemmapStorage": lambda path: LazyMemmapStorage(200, scratch_dir=path),
    "LazyTensorStorage(ndim=2)": lambda path: LazyTensorStorage(200, ndim=2),
}
PLAIN = {"slice_len": SLICE_LEN, "truncated_key": None, "init_key": None}
SAMPLERS = {
    "StepSliceSampler": lambda ours, theirs: StepSliceSampler(SLICE_LEN, traj_key=ours),
    "SliceSampler": lambda ours, theirs: SliceSampler(**PLAIN, **theirs),
    "PrioritizedSliceSampler": lambda ours, theirs: PrioritizedSliceSampler(200, 0.7, 0.9, **PLAIN, **theirs),
    "SliceSamplerWithoutReplacement": lambda ours, theirs: SliceSamplerWithoutReplacement(**PLAIN, **theirs),
}


@functools.cache
def collected(source: tuple[str, str]) -> list[TensorDictBase]:
    return list(SOURCES[source](make_planner()))


def fill(source: tuple[str, str], storage: str, sampler: str, path: Path) -> TensorDictReplayBuffer:
    batches = collected(source)
    ours = [WORKER, TRAJECTORY] if WORKER in batches[0].keys() else TRAJECTORY
    # Where rows have no ids, TorchRL's samplers have the ends alone.
    theirs = {"traj_key": TRAJECTORY} if "collector" in batches[0].keys() else {"end_key": ("next", "done")}
    buffer = TensorDictReplayBuffer(
        storage=STORAGES[storage](path), sampler=SAMPLERS[sampler](ours, theirs), batch_size=SLICE_LEN * NUM_SLICES
    )
    for batch in batches:
        if "ndim" not in storage:
            batch = batch.reshape(-1)
            mask = batch.get(("collector", "mask"), None)
            if mask is not None and sampler != "StepSliceSampler":
                batch = batch[mask]  # TorchRL's samplers take padding for steps
        buffer.extend(batch)
    return buffer


def learn(buffer: TensorDictReplayBuffer) -> None:
    """Samples, looks whether a slice is one piece of one episode, and takes a gradient of the loss."""
    model = make_planner().world_model  # seeds PyTorch, too
    np.random.seed(0)  # TorchRL's prioritized samplers draw from it
    loss = EfficientTDMPCLoss(model, discount=0.9)
    SoftUpdate(loss, tau=0.01)
    for _ in range(8):
        batch = buffer.sample().reshape(-1, SLICE_LEN)
        episode, step = batch["observation"].unbind(-1)
        assert (episode == episode[:, :1]).all(), "slices join episodes"
        assert (step.diff(dim=-1) == 1).all(), "slices skip steps"
        assert torch.equal(batch["next", "observation"][:, :-1], batch["observation"][:, 1:])
    sum(value for key, value in loss(batch).items() if key.startswith("loss_")).backward()
    assert all(parameter.grad is None or parameter.grad.isfinite().all() for parameter in loss.parameters())


# What a cell of the table says, and what happens then.
OUTCOMES = {
    "yes": None,
    "flat": (TypeError, "StepSliceSampler needs a one-dimensional tensor storage, .* write flat rows"),
    "shape": (Exception, "dim0 and dim1 must be within the range|indexed destination TensorDict batch size"),
    "turns": (RuntimeError, "Did not find a single trajectory with sufficient length|non-positive p_sum"),
    "joins": (AssertionError, "slices join episodes"),
}
FLAT, TWO = ("LazyTensorStorage", "LazyMemmapStorage"), ("LazyTensorStorage(ndim=2)",)
ALL, NONE = ("yes",) * 4, ("shape",) * 4
IN_TURN, JOINED = ("yes", *("turns",) * 3), ("yes", *("joins",) * 3)
TABLE = {
    ("StepCollector", "single", FLAT): ALL,
    ("StepCollector", "SerialEnv", FLAT): IN_TURN,
    ("StepCollector", "SerialEnv", TWO): NONE,
    ("Collector", "single", FLAT): ALL,
    ("Collector", "single", TWO): NONE,
    ("Collector", "single, split_trajs", FLAT): ALL,
    ("Collector", "single, split_trajs", TWO): NONE,
    ("Collector", "SerialEnv", FLAT): ALL,
    ("Collector", "SerialEnv", TWO): ("flat", "yes", "yes", "yes"),
    ("Collector", "SerialEnv, split_trajs", FLAT): ALL,
    ("Collector", "SerialEnv, split_trajs", TWO): NONE,
    ("Collector", "ParallelEnv", FLAT): ALL,
    ("Collector", "ParallelEnv", TWO): ("flat", "yes", "yes", "yes"),
    ("MultiSyncCollector", "single", FLAT): ALL,
    ("MultiSyncCollector", "single", TWO): ("flat", "yes", "yes", "yes"),
    ("MultiAsyncCollector", "single", FLAT): ALL,
    ("AsyncBatchedCollector", "single", FLAT): JOINED,
    ("RayCollector", "single", FLAT): JOINED,
    ("one Collector per worker", "single", FLAT): JOINED,
}
# Starting processes takes ten seconds.
SLOW = {"ParallelEnv", "MultiSyncCollector", "MultiAsyncCollector", "RayCollector"}


def _cells():
    for (collector, env, storages), row in TABLE.items():
        for storage in storages:
            for sampler, outcome in zip(SAMPLERS, row, strict=True):
                marks = [pytest.mark.slow] if {collector, env} & SLOW else []
                name = f"{collector}-{env}-{storage}-{sampler}"
                yield pytest.param((collector, env), storage, sampler, outcome, id=name, marks=marks)


@pytest.mark.filterwarnings("ignore:__array__ implementation:DeprecationWarning")  # TorchRL with NumPy 2
@pytest.mark.filterwarnings("ignore:split_trajs=True produces:UserWarning")
@pytest.mark.usefixtures("segment_trees")
@pytest.mark.parametrize(("source", "storage", "sampler", "outcome"), [*_cells()])
def test_a_pipeline_does_what_its_cell_says(source, storage, sampler, outcome, tmp_path):
    if OUTCOMES[outcome] is None:
        learn(fill(source, storage, sampler, tmp_path))
        return
    error, sentence = OUTCOMES[outcome]
    with pytest.raises(error, match=sentence):
        learn(fill(source, storage, sampler, tmp_path))


def test_a_loss_warns_of_slices_that_join_episodes(tmp_path):
    buffer = fill(("one Collector per worker", "single"), "LazyTensorStorage", "SliceSampler", tmp_path)
    loss = EfficientTDMPCLoss(make_planner().world_model, discount=0.9)  # seeds PyTorch, too
    SoftUpdate(loss, tau=0.01)
    batch = torch.cat([buffer.sample().reshape(-1, SLICE_LEN) for _ in range(8)])
    batch = batch[~batch["next", "done"][:, :-1].flatten(1).any(1)]  # an end inside of a slice is refused
    with pytest.warns(UserWarning, match="the slices join rows of several episodes"):
        loss(batch)


@pytest.mark.slow
def test_rows_that_worker_processes_write_by_themselves_are_noticed():
    sampler = StepSliceSampler(SLICE_LEN)
    buffer = TensorDictReplayBuffer(storage=LazyMemmapStorage(200), sampler=sampler, batch_size=SLICE_LEN, shared=True)
    batches = with_collector(MultiSyncCollector, MAKERS, make_planner(warm_start=False), replay_buffer=buffer)
    next(batches)
    buffer.sample()
    next(batches)
    with pytest.raises(RuntimeError, match="the 24 writes that the sampler saw: it holds 48 of 200 rows; write thro"):
        buffer.sample()
    batches.close()


def test_every_source_is_in_the_table():
    assert {(collector, env) for collector, env, _ in TABLE} == set(SOURCES)


def test_the_documented_table_is_this_one():
    page = (Path(__file__).parents[1] / "docs" / "pipelines.md").read_text()
    rows = [[cell.strip(" `") for cell in line.strip("|").split("|")] for line in re.findall(r"^\|.*\|$", page, re.M)]
    assert rows[0] == ["collector", "environment", "storage", *SAMPLERS]
    expected = [
        [collector, env, "flat" if storages == FLAT else "ndim=2", *row]
        for (collector, env, storages), row in TABLE.items()
    ]
    assert rows[2:] == expected
    for outcome in OUTCOMES:
        assert f"**{outcome}**" in page
