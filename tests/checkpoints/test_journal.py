from __future__ import annotations

import json
import os

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.data import (
    LazyTensorStorage,
    ListStorage,
    TensorDictMaxValueWriter,
    TensorDictReplayBuffer,
    TensorDictRoundRobinWriter,
)

from torchrl_etdmpc import StepSliceSampler
from torchrl_etdmpc.checkpoints import ReplayJournal
from torchrl_etdmpc.checkpoints import journal as module
from torchrl_etdmpc.runs import DamagedFileError


def make_buffer(capacity: int = 50) -> TensorDictReplayBuffer:
    writer = TensorDictRoundRobinWriter(track_generations=True)
    return TensorDictReplayBuffer(storage=LazyTensorStorage(capacity), writer=writer, batch_size=4)


class Pipeline:
    """Writes rows and re-plans old ones, as a training run does; the model's version grows by one a step."""

    def __init__(self, buffer: TensorDictReplayBuffer, observation_dim: int = 3) -> None:
        self.buffer, self.observation_dim, self.version, self.rows = buffer, observation_dim, 0, 0

    def write(self, count: int, *, version: int | None = None) -> None:
        numbers = torch.arange(self.rows, self.rows + count)
        plan = {"loc": torch.randn(count, 2), "scale": torch.rand(count, 2), "value": torch.randn(count, 1)}
        plan["version"] = torch.full((count, 1), self.version if version is None else version)
        plan["fallback"] = torch.zeros(count, 1, dtype=torch.bool)
        rows = {"observation": torch.randn(count, self.observation_dim), "number": numbers, "plan": plan}
        self.buffer.extend(TensorDict(rows | {"next": {"done": numbers.unsqueeze(-1) % 7 == 0}}, [count]))
        self.rows += count
        self.version += 1

    def write_late(self, count: int) -> None:
        """Rows of an episode that was planned long ago, by the first weights."""
        self.write(count, version=0)

    def reset(self, count: int) -> None:
        """New weights: the next targets carry versions that older ones have, too."""
        self.version = 0

    def refresh(self, count: int) -> None:
        index = torch.randperm(len(self.buffer))[:count]
        patch = {("plan", "loc"): torch.randn(len(index), 2), ("plan", "scale"): torch.rand(len(index), 2)}
        patch |= {("plan", "value"): torch.randn(len(index), 1)}
        patch |= {("plan", "version"): torch.full((len(index), 1), self.version)}
        self.buffer.update_if_present(index=index, generation=self.buffer.writer.generations_of(index), patch=patch)
        self.version += 1


def assert_same(buffer: TensorDictReplayBuffer, other: TensorDictReplayBuffer) -> None:
    assert len(buffer) == len(other)
    if len(buffer):
        assert (buffer.storage[:] == other.storage[:]).all()
        assert set(buffer.storage[:].keys(True, True)) == set(other.storage[:].keys(True, True))
    state, wanted = other.writer.state_dict(), buffer.writer.state_dict()
    assert {key: torch.as_tensor(value).tolist() for key, value in state.items()} == {
        key: torch.as_tensor(value).tolist() for key, value in wanted.items()
    }


ACTIONS = ["write", "write_late", "refresh", "reset", "save", "reload"]
STEPS = st.lists(st.tuples(st.sampled_from(ACTIONS), st.integers(1, 12)), max_size=25)


@settings(max_examples=60, deadline=None)
@given(steps=STEPS, capacity=st.integers(5, 40), rewrite_at=st.sampled_from([0.0, 0.25, 10.0]))
def test_what_is_loaded_is_what_was_saved(tmp_path_factory, steps, capacity, rewrite_at):
    folder = tmp_path_factory.mktemp("journal")
    run, journal = Pipeline(make_buffer(capacity)), ReplayJournal(folder, rewrite_at=rewrite_at)
    run.write(3)
    for action, number in [*steps, ("save", 0)]:
        if action == "save":
            files = json.loads(json.dumps(journal.save(run.buffer)))
            copy = make_buffer(capacity)
            ReplayJournal(folder).load(copy, files)
            assert_same(run.buffer, copy)
        elif action == "reload":  # a run that goes on from its last state, in a new process
            files = journal.save(run.buffer)
            journal, copy = ReplayJournal(folder, rewrite_at=rewrite_at), make_buffer(capacity)
            journal.load(copy, files)
            run.buffer = copy
        else:
            getattr(run, action)(number)


@pytest.mark.parametrize("capacity", [50, 12])
def test_targets_of_new_rows_are_saved_however_old_the_version_that_made_them_is(tmp_path, capacity):
    """An episode may be written after the save that its targets came before."""
    run, journal = Pipeline(make_buffer(capacity)), ReplayJournal(tmp_path)
    run.version = 7
    run.write(10)
    journal.save(run.buffer)
    run.write(5, version=2)
    files = journal.save(run.buffer)
    copy = make_buffer(capacity)
    ReplayJournal(tmp_path).load(copy, files)
    assert_same(run.buffer, copy)


@pytest.mark.parametrize("version", [0, 1, 5, 9])
def test_targets_of_weights_that_began_anew_are_saved(tmp_path, version):
    """After a reset, or from weights that were loaded, versions go back, and may be those of the targets before."""
    run, journal = Pipeline(make_buffer()), ReplayJournal(tmp_path)
    run.write(10, version=5)
    run.version = 9
    journal.save(run.buffer)
    run.version = version
    run.refresh(10)
    copy = make_buffer()
    ReplayJournal(tmp_path).load(copy, journal.save(run.buffer))
    assert_same(run.buffer, copy)


@pytest.mark.parametrize("name", ["version", "value", "scale"])
def test_targets_may_lack_what_no_part_reads(tmp_path, name):
    run, journal = Pipeline(make_buffer()), ReplayJournal(tmp_path)
    run.write(10)
    rows = run.buffer.storage[:].clone().exclude(("plan", name))
    buffer = make_buffer()
    buffer.extend(rows)
    journal.save(buffer)
    buffer.storage[:]["plan", "loc"][3] = 7.0
    copy = make_buffer()
    ReplayJournal(tmp_path).load(copy, journal.save(buffer))
    assert_same(buffer, copy)


def test_targets_of_two_bytes_or_one_are_saved_as_well(tmp_path):
    run, journal = Pipeline(make_buffer()), ReplayJournal(tmp_path)
    run.write(10)
    rows = run.buffer.storage[:].clone()
    rows["plan", "loc"] = torch.randn(10, 3).bfloat16()
    rows["plan", "version"] = rows["plan", "version"].to(torch.int8)
    buffer = make_buffer()
    buffer.extend(rows)
    journal.save(buffer)
    buffer.storage[:]["plan", "loc"][3] = 7.0
    buffer.storage[:]["plan", "version"][4] += 1
    copy = make_buffer()
    ReplayJournal(tmp_path).load(copy, journal.save(buffer))
    assert_same(buffer, copy)


@pytest.mark.parametrize("again", [False, True])
def test_what_has_not_changed_is_not_written_again(tmp_path, again):
    run, journal = Pipeline(make_buffer(12)), ReplayJournal(tmp_path)
    run.write(20)
    run.refresh(5)
    first = journal.save(run.buffer)
    if again:  # a run that goes on
        journal, run.buffer = ReplayJournal(tmp_path), make_buffer(12)
        journal.load(run.buffer, first)
    assert journal.save(run.buffer) == first
    assert len([*tmp_path.iterdir()]) == len(first["rows"]) + len(first["targets"])


def test_one_bit_of_a_target_is_a_change(tmp_path):
    run, journal = Pipeline(make_buffer()), ReplayJournal(tmp_path, rewrite_at=1.0)
    run.write(10)
    loc = run.buffer.storage[:]["plan", "loc"]
    loc[0, 1], loc[1, 1] = 0.0, float("nan")
    journal.save(run.buffer)
    loc[0, 1], loc[1, 1], loc[2, 1] = -0.0, float("nan"), float("inf")
    loc[4, 0] = torch.nextafter(loc[4, 0], torch.tensor(9.0))
    loc[6] = loc[6].flip(0)
    files = journal.save(run.buffer)
    assert [entry["rows"] for entry in files["targets"]] == [10, 4]  # rows 0, 2, 4 and 6


def test_older_states_stay_loadable_until_they_are_pruned(tmp_path):
    run, journal = Pipeline(make_buffer(30)), ReplayJournal(tmp_path)
    states = []
    for _ in range(5):
        run.write(9)
        run.refresh(4)
        states.append((journal.save(run.buffer), run.buffer.storage[:].clone()))
    for files, wanted in states:
        copy = make_buffer(30)
        ReplayJournal(tmp_path).load(copy, files)
        assert (copy.storage[:] == wanted).all()
    journal.prune([states[-1][0]])
    assert {file.name for file in tmp_path.iterdir()} == {
        entry["file"] for part in ("rows", "targets") for entry in states[-1][0][part]
    }
    copy = make_buffer(30)
    ReplayJournal(tmp_path).load(copy, states[-1][0])
    assert_same(run.buffer, copy)
    with pytest.raises(DamagedFileError):
        ReplayJournal(tmp_path).load(make_buffer(30), states[0][0])


@pytest.mark.parametrize("count", [0, 1, 9, 10, 11, 25, 59, 60])
def test_a_buffer_that_was_emptied_is_saved_as_it_is_now(tmp_path, count):
    run, journal = Pipeline(make_buffer()), ReplayJournal(tmp_path)
    run.write(10)
    journal.save(run.buffer)
    run.buffer.empty()
    if count:
        run.write(count)
        run.refresh(3)
    files = journal.save(run.buffer)
    copy = make_buffer()
    ReplayJournal(tmp_path).load(copy, files)
    assert len(copy) == min(count, 50)
    assert not count or (copy.storage[:] == run.buffer.storage[:]).all()


def test_a_loaded_buffer_that_is_emptied_is_saved_as_it_is_then(tmp_path):
    run, journal = Pipeline(make_buffer()), ReplayJournal(tmp_path)
    run.write(10)
    files = journal.save(run.buffer)
    run.buffer, journal = make_buffer(), ReplayJournal(tmp_path)
    journal.load(run.buffer, files)
    run.buffer.empty()
    run.write(15)
    copy = make_buffer()
    ReplayJournal(tmp_path).load(copy, journal.save(run.buffer))
    assert (copy.storage[:] == run.buffer.storage[:]).all()


def test_a_last_row_that_becomes_the_end_of_its_episode_is_still_the_same_row(tmp_path):
    run, journal = Pipeline(make_buffer()), ReplayJournal(tmp_path)
    run.write(10)
    run.buffer.storage[:]["observation"][9, 0] = float("nan")
    kept = journal.save(run.buffer)["rows"]
    run.buffer.storage[:]["next", "done"][9] = True
    run.write(1)
    assert journal.save(run.buffer)["rows"][: len(kept)] == kept


@pytest.mark.parametrize("saved", [0, 4, 33])
@pytest.mark.parametrize("salvage", [False, True])
def test_a_buffer_that_holds_rows_goes_back_to_what_was_saved(tmp_path, saved, salvage):
    """A run that is rolled back in the process that made it; the sampler hears of it."""
    run, journal = Pipeline(make_buffer(20)), ReplayJournal(tmp_path)
    sampler = StepSliceSampler(2, traj_key="number", done_key=("next", "none"))
    run.buffer.set_sampler(sampler)
    if saved:
        run.write(saved)
    wanted, files = run.buffer.storage[:].clone() if saved else None, journal.save(run.buffer)
    run.write(13)
    if salvage:
        assert not journal.salvage(run.buffer, files)
    else:
        journal.load(run.buffer, files)
    assert len(run.buffer) == min(saved, 20)
    held = run.buffer.storage[:]["number"] if saved else torch.zeros(0)
    assert sorted(held.tolist()) == sorted(wanted["number"].tolist() if saved else [])
    run.write(2)
    with pytest.raises(RuntimeError, match="no trajectory in the buffer has 2 steps"):
        run.buffer.sample()


@pytest.mark.parametrize(
    ("storage", "writer"),
    [
        (LazyTensorStorage(20, ndim=2), TensorDictRoundRobinWriter()),
        (ListStorage(20), TensorDictRoundRobinWriter()),
        (LazyTensorStorage(20), TensorDictMaxValueWriter(rank_key="number")),
    ],
)
def test_a_buffer_that_is_no_ring_of_rows_is_refused(tmp_path, storage, writer):
    buffer = TensorDictReplayBuffer(storage=storage, writer=writer, batch_size=4)
    rows = TensorDict({"number": torch.arange(16)}, [16])
    buffer.extend(rows.reshape(2, 8) if storage.ndim > 1 else rows)
    with pytest.raises(TypeError, match="cannot be saved row by row; use LazyTensorStorage"):
        ReplayJournal(tmp_path).save(buffer)


def test_a_write_count_that_is_not_the_buffer_s_is_refused(tmp_path):
    run = Pipeline(make_buffer())
    run.write(10)
    run.buffer.empty(empty_write_count=False)
    run.write(5)
    with pytest.raises(ValueError, match="15 rows were written to the buffer, but it holds 5 of 50 and goes"):
        ReplayJournal(tmp_path).save(run.buffer)


def test_a_save_writes_what_is_new_and_not_the_buffer(tmp_path):
    run, journal = Pipeline(make_buffer(5000), observation_dim=48), ReplayJournal(tmp_path)
    run.write(4000)
    journal.save(run.buffer)
    before = {file: file.stat().st_size for file in tmp_path.iterdir()}
    run.write(10)
    run.refresh(20)
    files = journal.save(run.buffer)
    added = sum(file.stat().st_size for file in tmp_path.iterdir() if file not in before)
    assert added < 0.05 * sum(before.values())
    assert all(file.stat().st_size == size for file, size in before.items())
    assert sum(entry["rows"] for entry in files["targets"]) == pytest.approx(4000 + 30, abs=10)


def test_many_changes_are_gathered_so_that_the_files_stay_about_as_large_as_the_buffer(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "ROWS_PER_FILE", 1000)
    run, journal = Pipeline(make_buffer(20_000), observation_dim=48), ReplayJournal(tmp_path)
    run.write(20_000)
    for _ in range(30):
        run.refresh(1500)
        run.write(250)
        files = journal.save(run.buffer)
        journal.prune([files])
    size = sum(file.stat().st_size for file in tmp_path.iterdir())
    assert size < 1.2 * run.buffer.storage[:].bytes()


def test_one_part_of_the_targets_is_gathered_in_a_save(tmp_path):
    run, journal = Pipeline(make_buffer(90)), ReplayJournal(tmp_path)
    run.write(90)
    journal.save(run.buffer)
    run.refresh(90)
    assert [len(journal.save(run.buffer)["targets"]) for _ in range(3)] == [5, 4, 3]  # bases and changes of three parts


def test_a_large_buffer_is_split_into_files(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "ROWS_PER_FILE", 16)
    run, journal = Pipeline(make_buffer(100)), ReplayJournal(tmp_path)
    run.write(70)
    files = journal.save(run.buffer)
    assert [(entry["begin"], entry["end"]) for entry in files["rows"]] == [
        (0, 16),
        (16, 32),
        (32, 48),
        (48, 64),
        (64, 70),
    ]
    run.refresh(70)  # of the rows of every file
    files = journal.save(run.buffer)
    copy = make_buffer(100)
    ReplayJournal(tmp_path).load(copy, files)
    assert_same(run.buffer, copy)


@pytest.mark.parametrize(
    ("written", "capacity", "fits"),
    [(8, 30, True), (8, 8, True), (10, 30, True), (8, 7, False), (12, 30, False)],
)
def test_a_buffer_that_was_not_full_fits_into_a_larger_one(tmp_path, written, capacity, fits):
    run = Pipeline(make_buffer(10))
    run.write(written)
    files = ReplayJournal(tmp_path).save(run.buffer)
    copy = make_buffer(capacity)
    if fits:
        ReplayJournal(tmp_path).load(copy, files)
        assert (copy.storage[:] == run.buffer.storage[:]).all()
        return
    with pytest.raises(ValueError, match=rf"^the saved buffer has capacity 10 and {written} rows were written to it"):
        ReplayJournal(tmp_path).load(copy, files)


@settings(max_examples=30, deadline=None)
@given(steps=STEPS, more=st.integers(1, 40), written=st.integers(1, 30))
def test_what_goes_on_in_a_larger_buffer_is_loaded_as_it_was_saved(tmp_path_factory, steps, more, written):
    folder = tmp_path_factory.mktemp("journal")
    run = Pipeline(make_buffer(30))
    run.write(written)
    files, capacity = ReplayJournal(folder).save(run.buffer), 30 + more
    journal, run.buffer = ReplayJournal(folder), make_buffer(capacity)
    journal.load(run.buffer, files)
    for action, number in [*steps, ("refresh", 30), ("save", 0)]:
        if action in ("save", "reload"):
            files, copy = journal.save(run.buffer), make_buffer(capacity)
            ReplayJournal(folder).load(copy, files)
            assert_same(run.buffer, copy)
        else:
            getattr(run, action)(number)


def test_of_a_file_whose_first_rows_were_overwritten_the_others_are_salvaged(tmp_path):
    run, journal = Pipeline(make_buffer(20)), ReplayJournal(tmp_path)
    for count in (15, 10):
        run.write(count)
        files = journal.save(run.buffer)
    copy = make_buffer(20)
    assert ReplayJournal(tmp_path).salvage(copy, files) == []
    wanted = run.buffer[:][torch.arange(5, 25) % 20]
    for key in ("number", "observation", ("plan", "loc"), ("plan", "version")):
        assert torch.equal(copy[:][key], wanted[key])


@pytest.mark.parametrize("lost", ["base", "change"])
def test_rows_that_came_after_a_part_s_base_are_not_salvaged_without_their_targets(tmp_path, lost):
    run, journal = Pipeline(make_buffer(90)), ReplayJournal(tmp_path)
    run.write(24)  # parts of 30 rows
    journal.save(run.buffer)
    run.write(10)
    files = journal.save(run.buffer)
    base, change, _ = files["targets"]
    assert [(entry["part"], entry["rows"]) for entry in files["targets"]] == [(0, 24), (0, 6), (1, 4)]
    (tmp_path / {"base": base, "change": change}[lost]["file"]).unlink()
    copy = make_buffer(90)
    assert len(ReplayJournal(tmp_path).salvage(copy, files)) == 1
    wanted = run.buffer[30:34]
    assert len(copy) == 4
    for key in ("number", ("plan", "loc"), ("plan", "scale"), ("plan", "version")):
        assert torch.equal(copy[:][key], wanted[key])


def test_a_file_that_cannot_be_written_leaves_nothing_and_the_journal_as_it_was(tmp_path, monkeypatch):
    run, journal = Pipeline(make_buffer()), ReplayJournal(tmp_path)
    run.write(10)
    first = journal.save(run.buffer)
    run.write(10)

    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        journal.save(run.buffer)
    monkeypatch.undo()
    assert {file.name for file in tmp_path.iterdir()} == {e["file"] for p in ("rows", "targets") for e in first[p]}
    copy = make_buffer()
    ReplayJournal(tmp_path).load(copy, journal.save(run.buffer))
    assert_same(run.buffer, copy)
