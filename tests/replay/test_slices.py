from __future__ import annotations

import copy
import itertools
from collections import defaultdict
from collections.abc import Callable
from functools import partial

import numpy as np
import pytest
import torch
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from scipy.stats import chisquare
from tensordict import NonTensorStack, TensorDict
from torchrl.collectors import Collector
from torchrl.data import (
    ImmutableDatasetWriter,
    LazyMemmapStorage,
    LazyTensorStorage,
    ListStorage,
    RandomSampler,
    ReplayBuffer,
    Storage,
    TensorDictMaxValueWriter,
    TensorDictReplayBuffer,
    TensorDictRoundRobinWriter,
    TensorStorage,
)
from torchrl.envs import SerialEnv
from torchrl.testing.mocking_classes import CountingEnv, CountingEnvCountPolicy

from torchrl_etdmpc import StepSliceSampler

TRAJ_KEY = ("collector", "traj_ids")


class Ring:
    """A replay buffer next to a plain list of everything that was ever written to it."""

    def __init__(self, capacity: int, slice_len: int, storage=LazyTensorStorage, **options) -> None:
        self.capacity, self.slice_len = capacity, slice_len
        self.sampler = StepSliceSampler(slice_len, **options)
        self.buffer = TensorDictReplayBuffer(
            storage=storage(capacity), sampler=self.sampler, writer=TensorDictRoundRobinWriter(track_generations=True)
        )
        self.history: list[tuple[int, int]] = []

    def write(self, rows: list[tuple[int, int]], *, one_by_one: bool = False) -> None:
        data = TensorDict(
            {
                "t": torch.tensor([step for _, step in rows]),
                "collector": {"traj_ids": torch.tensor([trajectory for trajectory, _ in rows])},
            },
            [len(rows)],
        )
        if one_by_one:
            for row in data.unbind(0):
                self.buffer.add(row)
        else:
            self.buffer.extend(data)
        self.history.extend(rows)

    def every_valid_slice(self) -> set[tuple[int, ...]]:
        """Brute force: the windows of each trajectory's stored rows, as storage indices."""
        stored = defaultdict(list)
        for count in range(max(0, len(self.history) - self.capacity), len(self.history)):
            stored[self.history[count][0]].append(count % self.capacity)
        windows = range(self.slice_len)
        return {
            tuple(rows[first + k] for k in windows)
            for rows in stored.values()
            for first in range(len(rows) - self.slice_len + 1)
        }

    def draw(self, number: int) -> np.ndarray:
        index, _ = self.sampler.sample(self.buffer.storage, number * self.slice_len)
        return index.reshape(number, self.slice_len).numpy()

    def every_drawn_slice(self) -> set[tuple[int, ...]]:
        """What thousands of draws find: each valid slice is missed with a probability below e-40."""
        valid = self.every_valid_slice()
        if not valid:
            with pytest.raises(RuntimeError, match=f"has {self.slice_len} steps yet"):
                self.draw(1)
            assert not self.sampler.can_sample(self.buffer.storage, self.slice_len)
            return set()
        assert self.sampler.can_sample(self.buffer.storage, self.slice_len)
        trajectories = len({trajectory for trajectory, _ in self.history[-self.capacity :]})
        drawn = self.draw(40 * trajectories * self.capacity)
        _, first = np.unique(drawn @ self.capacity ** np.arange(self.slice_len), return_index=True)
        return {tuple(rows) for rows in drawn[first].tolist()}


def interleaved(lengths: list[int], num_envs: int, rows: int, first: int = 0) -> list[tuple[int, int]]:
    """Rows as StepCollector writes them: one step of every environment in turn, episodes of the given lengths."""
    lengths, ids = itertools.cycle(lengths), itertools.count(first)
    running = [[next(ids), 0, next(lengths)] for _ in range(num_envs)]
    out = []
    while len(out) < rows:
        for env in running:
            if env[1] == env[2]:
                env[:] = [next(ids), 0, next(lengths)]
            out.append((env[0], env[1]))
            env[1] += 1
    return out[:rows]


def contiguous(lengths: list[int], rows: int) -> list[tuple[int, int]]:
    """Whole episodes one after the other."""
    return interleaved(lengths, 1, rows)


@settings(max_examples=60, deadline=None, database=None, derandomize=True, phases=[Phase.generate])
@given(
    lengths=st.lists(st.integers(1, 12), min_size=1, max_size=8),
    num_envs=st.integers(1, 4),
    capacity=st.integers(1, 30),
    slice_len=st.integers(1, 5),
    uniform_over=st.sampled_from(["episodes", "starts"]),
    chunks=st.lists(st.tuples(st.integers(1, 20), st.booleans(), st.booleans()), min_size=1, max_size=14),
)
def test_the_slices_that_can_be_drawn_are_exactly_the_valid_ones(
    lengths, num_envs, capacity, slice_len, uniform_over, chunks
):
    ring = Ring(capacity, slice_len, uniform_over=uniform_over)
    rows = interleaved(lengths, num_envs, sum(size for size, _, _ in chunks))
    for size, one_by_one, look in [*chunks, (0, False, True)]:
        for begin in range(0, size, capacity):
            ring.write(rows[: min(capacity, size - begin)], one_by_one=one_by_one)
            rows = rows[min(capacity, size - begin) :]
        if look:
            assert ring.every_drawn_slice() == ring.every_valid_slice()


@pytest.mark.parametrize(("capacity", "num_envs"), [(60, 1), (61, 3)])
def test_no_slice_of_a_full_ring_crosses_a_border_or_the_write_head(capacity, num_envs):
    ring = Ring(capacity, 4)
    ring.write(interleaved([10], num_envs, 60))
    for row in interleaved([10], num_envs, 90, first=1000):
        ring.write([row])
        sample = ring.buffer.sample(400).reshape(-1, 4)
        assert (sample["t"].diff() == 1).all()
        assert (sample[TRAJ_KEY] == sample[TRAJ_KEY][:, :1]).all()
    assert ring.every_drawn_slice() == ring.every_valid_slice()


def test_a_trajectory_that_fills_the_whole_ring_is_never_cut_at_the_write_head():
    ring = Ring(10, 3)
    for step in range(37):
        ring.write([(0, step)])
        if step >= 2:
            assert ring.every_drawn_slice() == ring.every_valid_slice()


def test_rows_that_arrive_unseen_by_a_sample_more_than_once_round_the_ring_are_followed():
    ring = Ring(8, 2)
    ring.write([(0, 0)])
    ring.write([(1, 0), (1, 1), (1, 2)])
    assert ring.every_drawn_slice() == ring.every_valid_slice()
    ring.write([(0, step) for step in range(1, 8)])
    ring.write([(0, step) for step in range(8, 15)])
    assert ring.every_drawn_slice() == ring.every_valid_slice()


def test_the_running_episode_can_be_sampled_from_its_first_complete_slice_on():
    ring = Ring(50, 3)
    for step in range(2):
        ring.write([(7, step)])
        with pytest.raises(RuntimeError, match="no trajectory in the buffer has 3 steps yet"):
            ring.buffer.sample(3)
    ring.write([(7, 2)])
    assert ring.buffer.sample(6)["t"].tolist() == [0, 1, 2, 0, 1, 2]


def test_one_trajectory_that_goes_on_with_another_stride_is_joined():
    ring = Ring(40, 3)
    ring.write([(0, 0), (1, 0), (0, 1), (1, 1), (0, 2), (1, 2)])
    ring.write([(0, step) for step in range(3, 8)])
    assert ring.every_drawn_slice() == ring.every_valid_slice()
    assert {(0, 2, 4), (2, 4, 6), (4, 6, 7), (7, 8, 9)} <= ring.every_drawn_slice()


@settings(max_examples=40, deadline=None, database=None, derandomize=True, phases=[Phase.generate])
@given(
    num_envs=st.integers(1, 4),
    lengths=st.lists(st.integers(1, 9), min_size=1, max_size=5),
    turns=st.lists(st.integers(0, 3), min_size=1, max_size=90),
    size=st.integers(1, 40),
    capacity=st.integers(1, 40),
    slice_len=st.integers(1, 4),
    flag=st.sampled_from(["done", "is_init", "both"]),
    save=st.booleans(),
)
def test_environments_that_write_in_any_order_and_use_their_ids_again_are_sliced_within_episodes(
    num_envs, lengths, turns, size, capacity, slice_len, flag, save
):
    lengths, episodes = itertools.cycle(lengths), itertools.count()
    running = [[next(episodes), 0, next(lengths)] for _ in range(num_envs)]
    rows, ring = [], Ring(capacity, slice_len)
    for turn in turns:
        env = running[turn % num_envs]
        rows.append((turn % num_envs, env[0], env[1], env[1] + 1 == env[2]))
        env[1] += 1
        if env[1] == env[2]:
            env[:] = [next(episodes), 0, next(lengths)]
    size = min(size, capacity)
    for begin in range(0, len(rows), size):
        ids, episode, step, done = map(torch.tensor, zip(*rows[begin : begin + size], strict=True))
        data = TensorDict({"collector": {"traj_ids": ids}, "t": step}, [len(ids)])
        if flag != "is_init":
            data["next", "done"] = done.unsqueeze(-1)
        if flag != "done":
            data["is_init"] = (step == 0).unsqueeze(-1)
        ring.buffer.extend(data)
        ring.history.extend(zip(episode.tolist(), step.tolist(), strict=True))
        if save:
            state = ring.sampler.state_dict()
            ring.sampler.load_state_dict(state)
        if begin % 3 == 0:
            ring.sampler.can_sample(ring.buffer.storage, slice_len)
    assert ring.every_drawn_slice() == ring.every_valid_slice()


def _rows(ids, *, done=(), init=(), **more) -> TensorDict:
    """Rows with these ids; ``done`` and ``init`` list where the flags are true."""
    number = len(ids)
    data = TensorDict({"t": torch.arange(number), "collector": {"traj_ids": torch.tensor(ids)}, **more}, [number])
    for key, places in ((("next", "done"), done), ("is_init", init)):
        data[key] = torch.zeros(number, 1, dtype=torch.bool)
        data[key][list(places)] = True
    return data


def _drawn(buffer: TensorDictReplayBuffer, slice_len: int, key="t") -> set[tuple[int, ...]]:
    return {tuple(row) for row in buffer.sample(2000 * slice_len)[key].reshape(-1, slice_len).tolist()}


def _buffer(slice_len: int, **options) -> TensorDictReplayBuffer:
    return TensorDictReplayBuffer(storage=LazyTensorStorage(50), sampler=StepSliceSampler(slice_len, **options))


def test_an_id_that_comes_back_after_the_end_of_its_episode_is_another_episode():
    buffer = _buffer(2)
    buffer.extend(_rows([7, 7, 7, 7, 7], done=[2]))
    assert _drawn(buffer, 2) == {(0, 1), (1, 2), (3, 4)}


def test_an_id_that_comes_back_after_a_fault_ended_its_episode_is_another_episode():
    buffer = _buffer(2)
    buffer.extend(_rows([7, 7, 7]))
    buffer.sample(2)  # the episode has been followed
    buffer.sampler.end_episodes(2, buffer.storage)
    buffer.extend(_rows([7, 7], t=torch.arange(3, 5)))
    assert _drawn(buffer, 2) == {(0, 1), (1, 2), (3, 4)}


def test_two_collectors_in_a_row_that_both_count_from_zero_are_told_apart_by_their_first_steps():
    buffer = _buffer(2)
    buffer.extend(_rows([0, 0, 0], init=[0]))
    buffer.extend(_rows([0, 0, 0], init=[0]))
    rows = buffer.sample(2000)["index"].reshape(-1, 2).tolist()
    assert {tuple(row) for row in rows} == {(0, 1), (1, 2), (3, 4), (4, 5)}


def test_several_keys_tell_the_episodes_of_several_workers_apart():
    workers = torch.tensor([0, 1, 0, 1, 1, 0])
    keys = ["worker", ("collector", "traj_ids")]
    for traj_key, joined in ((keys, False), (("collector", "traj_ids"), True)):
        buffer = _buffer(3, traj_key=traj_key)
        buffer.extend(_rows([0] * 6, worker=workers))
        slices = _drawn(buffer, 3, "worker")
        assert (slices == {(0, 0, 0), (1, 1, 1)}) != joined
        assert (_drawn(buffer, 3) == {(0, 2, 5), (1, 3, 4)}) != joined


def test_rows_that_have_the_environment_s_number_alone_are_sliced_by_it_and_their_ends():
    buffer = _buffer(2)
    buffer.extend(_rows([0] * 6, done=[3], env_index=torch.tensor([0, 1, 0, 1, 1, 0])).exclude("collector"))
    assert _drawn(buffer, 2) == {(0, 2), (2, 5), (1, 3)}


def test_rows_that_have_the_environment_s_number_alone_need_the_ends_of_episodes():
    buffer = _buffer(2)
    rows = _rows([0] * 6, env_index=torch.zeros(6, dtype=torch.int64)).exclude("collector", "is_init")
    buffer.extend(rows.exclude(("next", "done")))
    with pytest.raises(KeyError, match="'env_index' tells environments apart and not their episodes: rows need"):
        buffer.sample(4)


def test_padded_rows_are_never_sampled():
    buffer = _buffer(2)
    batch = _rows([0, 0, 0, 1, 1, 0], t=torch.arange(6))
    batch["collector", "mask"] = torch.tensor([True, True, True, True, True, False])
    buffer.extend(batch)
    assert _drawn(buffer, 2) == {(0, 1), (1, 2), (3, 4)}
    batch["collector", "mask"] = torch.zeros(6, dtype=torch.bool)
    buffer.extend(batch)
    assert _drawn(buffer, 2) == {(0, 1), (1, 2), (3, 4)}


def test_batches_of_a_torchrl_collector_are_sliced_within_trajectories():
    limits, num_envs = [4, 6, 9], 3
    env = SerialEnv(num_envs, [lambda limit=limit: CountingEnv(max_steps=limit) for limit in limits])
    collector = Collector(
        env,
        CountingEnvCountPolicy(env.action_spec),
        frames_per_batch=5 * num_envs,
        total_frames=60 * num_envs,
        auto_register_policy_transforms=False,
    )
    flat, turned = Ring(50 * num_envs, 3), Ring(50 * num_envs, 3)
    for batch in collector:
        batch = batch.select("observation", TRAJ_KEY)
        assert batch.shape == (num_envs, 5)
        for ring, rows in ((flat, batch.reshape(-1)), (turned, batch.transpose(0, 1).reshape(-1))):
            ring.write(list(zip(rows[TRAJ_KEY].tolist(), rows["observation"].flatten().tolist(), strict=True)))
    collector.shutdown()
    for ring in (flat, turned):
        sample = ring.buffer.sample(9000).reshape(-1, 3)
        assert (sample["t"].diff() == 1).all()
        assert (sample[TRAJ_KEY] == sample[TRAJ_KEY][:, :1]).all()
    assert flat.every_drawn_slice() == flat.every_valid_slice()
    assert turned.every_drawn_slice() == turned.every_valid_slice()


@pytest.mark.parametrize("num_slices", [1, 7])
@pytest.mark.parametrize("slice_len", [1, 4])
def test_a_sample_holds_exactly_batch_size_over_slice_len_slices(slice_len, num_slices):
    ring = Ring(30, slice_len)
    ring.write(contiguous([6], 30))
    sample = ring.buffer.sample(num_slices * slice_len)
    assert sample.batch_size == (num_slices * slice_len,)
    assert (sample.reshape(-1, slice_len)["t"].diff() == 1).all()


def _is_uniform(counts: np.ndarray) -> bool:
    return len(counts) == 1 or bool(chisquare(counts).pvalue > 1e-4)


def test_trajectories_are_drawn_uniformly_and_then_starts_within_them():
    torch.manual_seed(0)
    ring = Ring(100, 3)
    lengths = [3, 8, 30]
    ring.write([(trajectory, step) for trajectory, length in enumerate(lengths) for step in range(length)])
    first = ring.draw(9000)[:, 0]
    borders = np.cumsum([0, *lengths])
    assert _is_uniform(np.histogram(first, borders)[0])
    for begin, length in zip(borders[:-1], lengths, strict=True):
        within = first[(first >= begin) & (first < begin + length)] - begin
        assert _is_uniform(np.bincount(within, minlength=length - 2))


def test_starts_are_drawn_uniformly_whatever_their_trajectory():
    torch.manual_seed(0)
    ring = Ring(100, 3, uniform_over="starts")
    lengths = [3, 8, 30]
    ring.write([(trajectory, step) for trajectory, length in enumerate(lengths) for step in range(length)])
    counts = np.bincount(ring.draw(9000)[:, 0], minlength=100)
    valid = sorted(rows[0] for rows in ring.every_valid_slice())
    assert counts.sum() == counts[valid].sum() == 9000
    assert _is_uniform(counts[valid])


@pytest.mark.parametrize(("uniform_over", "share"), [("episodes", 1 / 5), ("starts", 2 / 194)])
def test_the_running_episode_is_favoured_by_drawing_episodes_but_not_by_drawing_starts(uniform_over, share):
    torch.manual_seed(0)
    ring = Ring(500, 3, uniform_over=uniform_over)
    ring.write([(trajectory, step) for trajectory in range(4) for step in range(50)])
    ring.write([(4, step) for step in range(4)])
    drawn = (ring.draw(20_000)[:, 0] >= 200).mean()
    assert drawn == pytest.approx(share, rel=0.15)


def _through_state_dict(ring: Ring, fresh: Ring, path) -> None:
    torch.save(ring.buffer.state_dict(), path / "buffer.pt")
    fresh.buffer.load_state_dict(torch.load(path / "buffer.pt", weights_only=False))


def _through_dumps(ring: Ring, fresh: Ring, path) -> None:
    ring.buffer.dumps(path)
    fresh.buffer.loads(path)


@pytest.mark.parametrize("save_and_load", [_through_state_dict, _through_dumps])
@pytest.mark.parametrize("looked", [True, False], ids=["sampled-before", "not-sampled-before"])
@pytest.mark.parametrize("written", [14, 75], ids=["part", "full"])
def test_a_loaded_buffer_is_sampled_and_goes_on_as_the_saved_one(tmp_path, written, looked, save_and_load):
    rows = interleaved([7, 4, 11], 2, 150)
    ring, fresh = Ring(23, 3), Ring(23, 3)
    ring.write(rows[:written])
    if looked:
        ring.draw(1)
    save_and_load(ring, fresh, tmp_path)
    fresh.history = list(ring.history)
    valid = ring.every_valid_slice()
    assert ring.every_drawn_slice() == fresh.every_drawn_slice() == valid
    torch.manual_seed(3)
    expected = ring.draw(20)
    torch.manual_seed(3)
    assert (fresh.draw(20) == expected).all()
    for begin in range(written, written + 60, 4):
        fresh.write(rows[begin : begin + 4])
        assert fresh.every_drawn_slice() == fresh.every_valid_slice()
    assert ring.every_drawn_slice() == valid  # the saved one has not changed with it


def test_a_full_buffer_takes_the_state_of_one_whose_newest_row_stands_elsewhere():
    saved, full = Ring(20, 3), Ring(20, 3)
    for ring, written in ((saved, 33), (full, 27)):
        ring.write(contiguous([50], written))
        ring.draw(1)
    for part in ("storage", "writer", "sampler"):
        getattr(full.buffer, part).load_state_dict(getattr(saved.buffer, part).state_dict())
    assert full.every_drawn_slice() == saved.every_drawn_slice() == saved.every_valid_slice()


def test_a_snapshot_does_not_change_with_the_sampler():
    ring = Ring(30, 2)
    ring.write(contiguous([5], 12))
    ring.draw(1)
    snapshot = ring.sampler.state_dict()
    before = snapshot["written"], snapshot["segments"].clone(), dict(snapshot["open"])
    ring.write(contiguous([5], 60)[12:30])
    ring.draw(1)
    assert (snapshot["written"], snapshot["open"]) == (before[0], before[2])
    assert torch.equal(snapshot["segments"], before[1])


def test_a_sampler_keeps_no_storage_alive():
    ring = Ring(20, 3)
    ring.write(contiguous([5], 12))
    ring.draw(1)
    assert not any(isinstance(value, Storage) for value in vars(ring.sampler).values())


def test_a_sampler_serves_one_buffer_and_its_copy_another():
    sampler = StepSliceSampler(2)
    first, second = (TensorDictReplayBuffer(storage=LazyTensorStorage(50), sampler=sampler) for _ in range(2))
    first.extend(_rows([0, 0, 0, 1, 1]))
    assert _drawn(first, 2) == {(0, 1), (1, 2), (3, 4)}
    second.extend(_rows([0, 0, 1, 1, 1]))
    with pytest.raises(RuntimeError, match="^this StepSliceSampler follows the rows of another buffer already"):
        second.sample(4)
    copied = copy.deepcopy(sampler)
    copied.load_state_dict(StepSliceSampler(2).state_dict())
    third = TensorDictReplayBuffer(storage=LazyTensorStorage(50), sampler=copied)
    third.extend(_rows([0, 0, 1, 1, 1]))
    assert _drawn(third, 2) == {(0, 1), (2, 3), (3, 4)}


def test_draws_are_reproducible_by_torch_manual_seed():
    ring = Ring(60, 3)
    ring.write(contiguous([10], 60))
    torch.manual_seed(1)
    first = ring.draw(50)
    assert (ring.draw(50) != first).any()
    torch.manual_seed(1)
    assert (ring.draw(50) == first).all()


def test_a_generator_of_the_buffer_is_the_only_source_of_randomness():
    ring = Ring(60, 3)
    ring.write(contiguous([10], 60))
    ring.buffer.set_rng(torch.Generator().manual_seed(1))
    torch.manual_seed(0)
    state = torch.get_rng_state()
    first = ring.draw(50)
    assert torch.equal(torch.get_rng_state(), state)
    ring.buffer.set_rng(torch.Generator().manual_seed(1))
    assert (ring.draw(50) == first).all()


def test_an_emptied_buffer_starts_afresh():
    ring = Ring(12, 3)
    ring.write(contiguous([5], 31))
    ring.draw(1)
    ring.buffer.empty()
    ring.history.clear()
    assert ring.every_drawn_slice() == set()
    for row in contiguous([4], 17):
        ring.write([row])
    assert ring.every_drawn_slice() == ring.every_valid_slice()


def test_what_a_seed_draws_follows_from_the_order_of_writing_and_not_from_the_ids():
    drawn = []
    for ids in ([0, 1], [9, 4]):
        buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(20), sampler=StepSliceSampler(2), batch_size=40)
        episodes = torch.tensor(ids).repeat_interleave(torch.tensor([3, 7]))
        buffer.extend(TensorDict({"collector": {"traj_ids": episodes}, "t": torch.arange(10)}, [10]))
        torch.manual_seed(0)
        drawn.append(buffer.sample()["t"])
    assert torch.equal(*drawn)


def test_a_memory_mapped_storage_is_sampled_like_one_in_memory(tmp_path):
    ring = Ring(17, 3, storage=lambda capacity: LazyMemmapStorage(capacity, scratch_dir=tmp_path))
    for row in interleaved([5, 8], 2, 44):
        ring.write([row])
    assert ring.every_drawn_slice() == ring.every_valid_slice()


def test_the_trajectory_id_may_have_another_key_and_a_trailing_dimension():
    sampler = StepSliceSampler(2, traj_key=("data", "episode"))
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(20), sampler=sampler, batch_size=200)
    ids = torch.tensor([0, 0, 0, 1, 1, 2, 2, 2]).unsqueeze(-1)
    buffer.extend(TensorDict({"data": {"episode": ids}, "t": torch.arange(8)}, [8]))
    sample = buffer.sample().reshape(-1, 2)
    assert {tuple(pair) for pair in sample["t"].tolist()} == {(0, 1), (1, 2), (3, 4), (5, 6), (6, 7)}


def test_a_sample_may_be_asked_for_after_writing_a_reanalyzed_target():
    ring = Ring(20, 3)
    ring.write(contiguous([5], 20))
    sample = ring.buffer.sample(6)
    ring.buffer.update_if_present(
        index=sample["index"], generation=sample["index_generation"], patch={"t": sample["t"] + 100}
    )
    assert ring.every_drawn_slice() == ring.every_valid_slice()


def test_a_row_is_read_once_however_often_the_buffer_is_sampled():
    ring = Ring(20, 3)
    ring.write(contiguous([5], 20))
    ring.draw(1)
    ring.buffer.storage[:][TRAJ_KEY].fill_(-1)  # what a sampler that reads the column again would trip over
    ring.write(contiguous([5], 23)[20:])
    assert ring.every_drawn_slice() == ring.every_valid_slice()


def _table_size(sampler: StepSliceSampler) -> int:
    state = sampler.state_dict()
    return max(state["segments"].shape[1], len(state["open"]))


def _sizes_of_the_table(ring: Ring, rows: list[tuple[int, int]], chunk: int) -> list[int]:
    """Table sizes while the rows are written; the slices are compared when it shrinks and just after."""
    sizes, shrunk = [], []
    for begin in range(0, len(rows), chunk):
        ring.write(rows[begin : begin + chunk])
        ring.draw(1)
        sizes.append(_table_size(ring.sampler))
        shrunk.append(sizes[-1] < sizes[max(len(sizes) - 2, 0)])
        if any(shrunk[-2:]):
            assert ring.every_drawn_slice() == ring.every_valid_slice()
    assert any(shrunk)
    return sizes


@pytest.mark.parametrize("length", [3, 1])  # of every slice; with 1 the oldest row is a trajectory of its own
def test_the_table_of_trajectories_stays_bounded_after_hundreds_of_evicted_ones(length):
    sizes = _sizes_of_the_table(Ring(60, length), contiguous([length], 700 * length), 40)
    assert max(sizes) < 150  # 60 / length trajectories fit into the ring


def test_one_endless_trajectory_does_not_keep_the_table_from_shrinking():
    ring = Ring(60, 3)
    rows = [row for step in range(900) for row in ((0, step), (1 + step // 3, step % 3))]
    assert max(_sizes_of_the_table(ring, rows, 28)) < 150


def test_a_batch_size_that_is_no_multiple_of_the_slice_is_refused():
    ring = Ring(20, 3)
    ring.write(contiguous([5], 20))
    with pytest.raises(ValueError, match=r"batch_size must be a multiple of slice_len=3, got 7"):
        ring.buffer.sample(7)


def test_rows_without_a_trajectory_id_are_refused():
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(20), sampler=StepSliceSampler(3), batch_size=6)
    buffer.extend(TensorDict({"t": torch.arange(9)}, [9]))
    with pytest.raises(KeyError, match=r"needs the trajectory id \('collector', 'traj_ids'\) in every row"):
        buffer.sample()


@pytest.mark.parametrize("key", ["episode", "collector"], ids=["texts", "a dictionary"])
def test_trajectory_ids_that_are_no_numbers_are_refused(key):
    sampler = StepSliceSampler(3, traj_key=key)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(20), sampler=sampler, batch_size=6)
    buffer.extend(_rows([0] * 9).set("episode", NonTensorStack(*["a"] * 9)))
    with pytest.raises(TypeError, match=f"tells episodes apart by whole numbers, .* at '{key}'; number the episodes"):
        buffer.sample()


@pytest.mark.parametrize("before", [7, 10, 13], ids=["part", "just full", "around"])
@pytest.mark.parametrize("after", [(), (1,), (4, 6), (3, 9)])
def test_a_buffer_that_was_filled_before_it_got_the_sampler_is_sampled_whole(before, after):
    rows = interleaved([4, 3], 2, 40)
    ring = Ring(10, 3)
    ring.buffer.set_sampler(RandomSampler())
    for begin in range(before):
        ring.write(rows[begin : begin + 1])
    ring.buffer.set_sampler(ring.sampler)
    begin = before
    for number in after:
        ring.write(rows[begin : begin + number])
        begin += number
    assert ring.every_drawn_slice() == ring.every_valid_slice()
    ring.write(rows[begin : begin + 5])
    assert ring.every_drawn_slice() == ring.every_valid_slice()


@pytest.mark.parametrize("written", [12, 33])
def test_a_storage_loaded_without_its_sampler_is_sampled_once_its_oldest_row_is_known(tmp_path, written):
    ring, fresh = Ring(20, 3), Ring(20, 3)
    rows = contiguous([5], 40)
    for begin in range(0, written, 3):
        ring.write(rows[begin : begin + 3])
    ring.buffer.dumps(tmp_path)
    fresh.sampler = StepSliceSampler(3)
    fresh.buffer.loads(tmp_path)
    fresh.buffer.set_sampler(fresh.sampler)
    fresh.history = list(ring.history)
    if written > 20:
        with pytest.raises(RuntimeError, match="which row is the oldest is not known; write one row, or save and load"):
            fresh.draw(1)
        fresh.write(rows[written : written + 1])
    assert fresh.every_drawn_slice() == fresh.every_valid_slice()


def test_rows_that_were_written_past_the_sampler_are_noticed():
    ring = Ring(20, 3)
    ring.write(contiguous([5], 12))
    ring.draw(1)
    ring.buffer.set_sampler(RandomSampler())
    ring.write(contiguous([5], 4))
    ring.buffer.set_sampler(ring.sampler)
    with pytest.raises(
        RuntimeError, match="not hold the 12 writes that the sampler saw: it holds 16 of 20 rows; write through this"
    ):
        ring.draw(1)


@pytest.mark.parametrize("number", [1, 4, 23])
def test_rows_that_were_written_past_the_sampler_into_a_full_ring_are_noticed(number):
    ring = Ring(20, 3)
    ring.write(contiguous([5], 27))
    ring.draw(1)
    ring.write(contiguous([5], 6))
    ring.draw(1)
    ring.buffer.set_sampler(RandomSampler())
    ring.write(contiguous([5], number))
    ring.buffer.set_sampler(ring.sampler)
    with pytest.raises(RuntimeError, match="the 33 writes that the sampler saw: others have written to the full stor"):
        ring.draw(1)


def test_rows_of_a_writer_that_leaves_their_order_are_refused():
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(20),
        sampler=StepSliceSampler(3),
        writer=TensorDictMaxValueWriter(rank_key="reward"),
        batch_size=30,
    )
    buffer.extend(_rows([0] * 20, reward=torch.arange(20.0)))
    with pytest.raises(
        TypeError, match=r"TensorDictMaxValueWriter does not keep; .* writer=TensorDictRoundRobinWriter"
    ):
        buffer.sample()


def test_partial_slices_are_refused_by_a_buffer_that_leaves_the_mask_out():
    for kind in (ReplayBuffer, TensorDictReplayBuffer):
        buffer = kind(storage=LazyTensorStorage(20), sampler=StepSliceSampler(3, partial=True), batch_size=30)
        buffer.extend(_rows([0] * 5 + [1] * 5, done=[4, 9]))
        if kind is TensorDictReplayBuffer:
            assert ("collector", "mask") in buffer.sample().keys(True)
        else:
            with pytest.raises(TypeError, match="which ReplayBuffer leaves out; use TensorDictReplayBuffer"):
                buffer.sample()


def test_a_data_set_that_fills_its_storage_is_sampled_from_its_first_row_on():
    rows = _rows([0] * 6 + [1] * 7 + [2] * 7)
    buffer = TensorDictReplayBuffer(
        storage=TensorStorage(rows),
        sampler=StepSliceSampler(3, as_slices=True),
        writer=ImmutableDatasetWriter(),
        batch_size=6000,
    )
    starts = set(buffer.sample()["t"][:, 0].tolist())
    assert starts == {0, 1, 2, 3, *range(6, 11), *range(13, 18)}


def test_a_data_set_in_a_buffer_that_could_be_written_to_is_told_the_writer():
    buffer = TensorDictReplayBuffer(storage=TensorStorage(_rows([0] * 6)), sampler=StepSliceSampler(3), batch_size=6)
    with pytest.raises(RuntimeError, match=r"build the buffer with writer=ImmutableDatasetWriter\(\)"):
        buffer.sample()


def test_a_buffer_that_another_sampler_dumped_is_read_anew(tmp_path):
    other = TensorDictReplayBuffer(storage=LazyTensorStorage(50))
    other.extend(_rows([0] * 5 + [1] * 5))
    other.dumps(tmp_path)
    buffer = _buffer(3)
    buffer.loads(tmp_path)
    assert _drawn(buffer, 3) == {(t, t + 1, t + 2) for t in (0, 1, 2, 5, 6, 7)}


@pytest.mark.parametrize("steps", [1, 5])
def test_rows_that_are_batches_are_refused(steps):
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(20), sampler=StepSliceSampler(3), batch_size=6)
    buffer.extend(TensorDict({"collector": {"traj_ids": torch.zeros(4, steps, dtype=torch.int64)}}, [4, steps]))
    message = (
        rf"every row of the buffer is a batch \[{steps}\], .* write flat rows: buffer.extend\(batch.reshape\(-1\)\)"
    )
    with pytest.raises(ValueError, match=message):
        buffer.sample()


def test_rows_that_a_collector_of_several_environments_writes_by_itself_are_flat_with_the_named_argument():
    for options in ({}, {"postproc": lambda batch: batch.reshape(-1)}):
        buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(40), sampler=StepSliceSampler(3), batch_size=60)
        env = SerialEnv(2, partial(CountingEnv, max_steps=4))
        sizes = {"frames_per_batch": 20, "total_frames": 40, "auto_register_policy_transforms": True}
        list(Collector(env, CountingEnvCountPolicy(env.action_spec), replay_buffer=buffer, **sizes, **options))
        if not options:
            with pytest.raises(ValueError, match=r"postproc=lambda batch: batch\.reshape\(-1\)"):
                buffer.sample()
    slices = buffer.sample().reshape(-1, 3)
    assert (slices["observation"].diff(dim=1) == 1).all()
    assert len(slices["collector", "traj_ids"].unique()) > 2


def _starts_and_masks(buffer: TensorDictReplayBuffer, slice_len: int) -> dict[tuple[int, ...], tuple[bool, ...]]:
    sample = buffer.sample(3000 * slice_len).reshape(-1, slice_len)
    pairs = zip(sample["t"].tolist(), sample["collector", "mask"].tolist(), strict=True)
    return {tuple(steps): tuple(mask) for steps, mask in pairs}


def test_partial_slices_begin_at_every_step_of_an_episode_that_has_ended_and_repeat_its_last_step():
    buffer = _buffer(3, partial=True)
    buffer.extend(_rows([0] * 4 + [1] * 2 + [2] * 3, done=[3, 5]))
    assert _starts_and_masks(buffer, 3) == {
        (0, 1, 2): (True, True, True),
        (1, 2, 3): (True, True, True),
        (2, 3, 3): (True, True, False),
        (3, 3, 3): (True, False, False),
        (4, 5, 5): (True, True, False),
        (5, 5, 5): (True, False, False),
        (6, 7, 8): (True, True, True),  # the running episode begins nowhere later: how it goes on is not known yet
    }


def test_partial_slices_show_an_ending_at_every_depth_equally_often():
    torch.manual_seed(0)
    buffer = _buffer(3, partial=True, uniform_over="starts")
    buffer.extend(_rows([0] * 30, done=[9, 19, 29]))
    sample = buffer.sample(3 * 9000).reshape(-1, 3)
    seen = sample["next", "done"].squeeze(-1) & sample["collector", "mask"]
    assert _is_uniform(np.bincount(sample["t"][:, 0], minlength=30))
    assert _is_uniform(seen.sum(0).numpy())
    whole = _buffer(3, uniform_over="starts")
    whole.extend(_rows([0] * 30, done=[9, 19, 29]))
    assert whole.sample(3000).reshape(-1, 3)["next", "done"].sum((0, 2)).tolist()[:2] == [0, 0]


def test_whole_slices_are_drawn_as_before_and_have_no_mask():
    buffer = _buffer(3)
    buffer.extend(_rows([0] * 4, done=[3]))
    assert ("collector", "mask") not in buffer.sample(6).keys(True)


def test_the_mask_may_have_another_key_and_a_partial_sample_always_has_it():
    buffer = _buffer(2, partial=True, mask_key="valid")
    buffer.extend(_rows([0] * 4))
    assert buffer.sample(6)["valid"].tolist() == [True] * 6


@pytest.mark.parametrize("looked", [True, False], ids=["sampled-before", "not-sampled-before"])
def test_partial_slices_know_the_ends_after_loading_and_after_the_ring_has_turned(looked):
    buffer = _buffer(3, partial=True)
    for begin in range(0, 120, 4):
        buffer.extend(_rows([begin] * 4, done=[3], t=torch.arange(begin, begin + 4)))
    if looked:
        buffer.sample(3)  # what was followed is in the state, and not read again
    state = buffer.state_dict()
    buffer.extend(_rows([200, 200], t=torch.arange(120, 122)))
    again = _buffer(3, partial=True)
    again.load_state_dict(state)
    again.extend(_rows([200, 200], t=torch.arange(120, 122)))
    torch.manual_seed(0)
    expected = buffer.sample(9000)
    torch.manual_seed(0)
    assert torch.equal(again.sample(9000)["t"], expected["t"])
    first = expected["t"].reshape(-1, 3)[:, 0].unique().tolist()
    assert first == list(range(72, 120))


def test_partial_slices_know_the_ends_when_the_table_has_been_packed():
    buffer = _buffer(3, partial=True)
    for begin in range(0, 600, 4):  # past several packings
        buffer.extend(_rows([begin] * 4, done=[3], t=torch.arange(begin, begin + 4)))
        first = buffer.sample(4500)["t"].reshape(-1, 3)[:, 0].unique().tolist()
        assert first == list(range(max(begin - 46, 0), begin + 4))


def test_partial_slices_need_the_ends():
    buffer = _buffer(3, partial=True)
    buffer.extend(_rows([0] * 4).exclude("next"))
    with pytest.raises(KeyError, match=r"partial=True needs \('next', 'done'\) in every row"):
        buffer.sample(6)


def test_what_will_never_make_a_slice_says_so():
    buffer = _buffer(4)
    buffer.extend(_rows([0, 0, 1]))
    with pytest.raises(RuntimeError, match=r"has 4 steps yet \(3 rows, the longest has 2\); collect more before"):
        buffer.sample(4)
    buffer.extend(_rows([1, 2, 2, 2], done=[0, 3]))
    hint = (
        r"the longest has 3\); if episodes are that short, choose a smaller slice_len or partial=True, and if they are"
    )
    with pytest.raises(RuntimeError, match=hint + r" not, see that \('collector', 'traj_ids'\) stays the same"):
        buffer.sample(4)
    full = TensorDictReplayBuffer(storage=LazyTensorStorage(6), sampler=StepSliceSampler(4), batch_size=4)
    for batch in range(4):  # as if every batch were of other episodes
        full.extend(_rows([2 * batch, 2 * batch, 2 * batch + 1, 2 * batch + 1]))
    with pytest.raises(RuntimeError, match=r"6 rows, the longest has 2\); if episodes are that short"):
        full.sample()


def test_the_state_is_small_where_rows_come_in_turn():
    ring = Ring(2000, 3)
    ring.write(interleaved([50], 4, 2000))
    ring.draw(1)
    state = ring.sampler.state_dict()
    assert state["segments"].shape == (4, 40)


@pytest.mark.parametrize("storage", [ListStorage(20), LazyTensorStorage(20, ndim=2)], ids=["list", "two-dimensional"])
def test_a_storage_that_is_no_flat_tensor_storage_is_refused(storage):
    buffer = TensorDictReplayBuffer(storage=storage, sampler=StepSliceSampler(3), batch_size=6)
    data = TensorDict({"collector": {"traj_ids": torch.zeros(2, 6, dtype=torch.int64)}}, [2, 6])
    buffer.extend(data if storage.ndim == 2 else data.reshape(-1))
    with pytest.raises(TypeError, match="StepSliceSampler needs a one-dimensional tensor storage"):
        buffer.sample()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"slice_len": 0}, "slice_len must be at least 1, got 0"),
        ({"slice_len": 3, "traj_key": []}, r"traj_key must name at least one key, got \[\]"),
        ({"slice_len": 3, "uniform_over": "rows"}, "uniform_over must be one of episodes, starts, got 'rows'"),
    ],
)
def test_bad_arguments_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        StepSliceSampler(**arguments)


@pytest.mark.parametrize("partial", [False, True])
def test_a_sample_can_have_the_shape_that_the_losses_take(partial):
    samples = []
    for as_slices in (False, True):
        torch.manual_seed(0)
        sampler = StepSliceSampler(3, partial=partial, as_slices=as_slices)
        writer = TensorDictRoundRobinWriter(track_generations=True)
        buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(30), sampler=sampler, writer=writer, batch_size=12)
        done = torch.arange(20).remainder(5).eq(4).unsqueeze(-1)
        ids = {"traj_ids": torch.arange(20) // 5}
        buffer.extend(TensorDict({"t": torch.arange(20), "next": {"done": done}, "collector": ids}, [20]))
        samples.append(buffer.sample())
    flat, shaped = samples
    assert shaped.shape == (4, 3)
    assert set(flat.keys(True, True)) == set(shaped.keys(True, True)) >= {"index", "index_generation"}
    assert (flat.reshape(4, 3) == shaped).all()
    assert "as_slices=True" in repr(sampler)


@pytest.mark.parametrize("dtype", [torch.bool, torch.float32, torch.float16])
@pytest.mark.parametrize("first", [2**11, 2**24, 2**53])
def test_ids_beside_a_floating_flag_keep_their_last_digit(dtype, first):
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(40), sampler=StepSliceSampler(3), batch_size=300)
    ids = first + torch.arange(40) % 2  # two environments, row by row
    flags = torch.zeros(40, 1, dtype=dtype)
    buffer.extend(TensorDict({"collector": {"traj_ids": ids}, "next": {"done": flags}, "is_init": flags}, [40]))
    slices = buffer.sample()["collector", "traj_ids"].reshape(-1, 3)
    assert (slices == slices[:, :1]).all()


def test_ids_beside_a_floating_id_keep_their_last_digit():
    sampler = StepSliceSampler(3, traj_key=["worker", ("collector", "traj_ids")])
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(40), sampler=sampler, batch_size=300)
    ids = 2**24 + torch.arange(40) % 2
    buffer.extend(TensorDict({"collector": {"traj_ids": ids}, "worker": torch.zeros(40)}, [40]))
    slices = buffer.sample()["collector", "traj_ids"].reshape(-1, 3)
    assert (slices == slices[:, :1]).all()


@pytest.mark.parametrize("how", ["dumps", "state_dict"])
def test_a_full_buffer_is_rolled_back_in_the_process_that_filled_it(how, tmp_path):
    def write(buffer, begin, number):
        ids = torch.zeros(number, dtype=torch.int64)
        buffer.extend(TensorDict({"t": torch.arange(begin, begin + number), "collector": {"traj_ids": ids}}, [number]))

    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(20), sampler=StepSliceSampler(3), batch_size=300)
    for step in range(33):
        write(buffer, step, 1)
    buffer.dumps(tmp_path)
    kept = copy.deepcopy(buffer.state_dict())
    write(buffer, 33, 5)
    buffer.sample()
    _ = buffer.loads(tmp_path) if how == "dumps" else buffer.load_state_dict(kept)
    for newest in (32, 34):
        slices = buffer.sample()["t"].reshape(-1, 3)
        assert (slices.diff() == 1).all()
        assert (slices.min().item(), slices.max().item()) == (newest - 19, newest)
        write(buffer, 33, 2)
    buffer.writer._cursor += 1  # somebody else
    with pytest.raises(RuntimeError, match="others have written to the full storage"):
        buffer.storage.set(0, buffer.storage[0])
        buffer.sample()


@pytest.mark.parametrize("capacity", [60, 50])
def test_rows_are_drawn_whatever_the_default_device_is(capacity):
    rows = TensorDict({"t": torch.arange(60), "collector": {"traj_ids": torch.arange(60) // 20}}, [60])
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(capacity, device="cpu"), sampler=StepSliceSampler(3), batch_size=6
    )
    torch.set_default_device("meta")
    try:
        buffer.extend(rows[:50])
        buffer.extend(rows[50:])  # goes round in the smaller one
        drawn = buffer.sample()["t"].reshape(2, 3)
    finally:
        torch.set_default_device(None)
    assert (drawn.diff(dim=1) == 1).all()


def test_rows_that_were_written_past_the_sampler_are_noticed_when_a_loaded_buffer_was_added_to():
    def row(step: int) -> TensorDict:
        return TensorDict({"t": torch.tensor(step), "collector": {"traj_ids": torch.tensor(0)}})

    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(20), sampler=StepSliceSampler(3), batch_size=30)
    for step in range(33):
        buffer.add(row(step))
    buffer.load_state_dict(copy.deepcopy(buffer.state_dict()))
    buffer.add(row(33))
    buffer.sample()
    buffer.storage.set(0, buffer.storage[0])  # somebody else
    with pytest.raises(RuntimeError, match="others have written to the full storage"):
        buffer.sample()


def first_steps(mask: torch.Tensor, end: int | None = None) -> tuple[TensorDictReplayBuffer, Callable[[], list[int]]]:
    """A buffer of one episode, and what gives the steps that partial slices of it begin at."""
    rows = TensorDict({"t": torch.arange(len(mask)), "next": {"done": torch.zeros(len(mask), 1, dtype=torch.bool)}})
    rows["collector"] = {"traj_ids": torch.zeros(len(mask), dtype=torch.int64), "mask": mask}
    if end is not None:
        rows["next", "done"][end] = True
    sampler = StepSliceSampler(3, partial=True)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(20), sampler=sampler, batch_size=900)
    buffer.extend(rows.auto_batch_size_(1))
    return buffer, lambda: buffer.sample()["t"].reshape(-1, 3)[:, 0].unique().tolist()


def test_the_last_steps_of_an_episode_begin_slices_from_the_moment_that_it_is_ended():
    buffer, begins = first_steps(torch.ones(6, dtype=torch.bool))
    assert begins() == [0, 1, 2, 3]  # it goes on
    buffer.sampler.end_episodes(torch.tensor([5]), buffer.storage)
    assert begins() == [0, 1, 2, 3, 4, 5]


def test_the_last_steps_before_padding_begin_slices():
    assert first_steps(torch.arange(6) < 4, end=3)[1]() == [0, 1, 2, 3]
