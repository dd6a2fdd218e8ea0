"""Slice sampling from a ring buffer that is written one step at a time."""

from __future__ import annotations

import weakref
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from torch import Tensor
from torchrl.data import ImmutableDatasetWriter, ReplayBuffer, RoundRobinWriter, TensorDictReplayBuffer
from torchrl.data.replay_buffers.samplers import Sampler
from torchrl.data.replay_buffers.storages import Storage, TensorStorage

from torchrl_etdmpc.keys import DONE, ENV_INDEX, IS_INIT, MASK, NEXT, TRAJECTORY
from torchrl_etdmpc.replay.trajectories import Trajectories

UniformOver = Literal["episodes", "starts"]
"""What is drawn alike: first the episode, then the start in it, or any start."""


class StepSliceSampler(Sampler):
    """Samples slices of consecutive transitions of one episode, usable while the episode is still being written.

    Every sample holds exactly ``batch_size / slice_len`` slices. A slice never crosses the border of an episode nor
    the write head of a full ring buffer, and an episode can be sampled from its first complete slice on. The rows of
    several environments may come in any order, as long as those of one environment come in the order of its steps:
    interleaved, as :class:`~torchrl_etdmpc.collectors.StepCollector` writes them, or as batches ``[N, T]`` of TorchRL's
    collectors, flattened with ``batch.reshape(-1)``. A buffer that was filled before it got this sampler will do.

    **What must be unique**: among the episodes that run at the same time, no two may have the same id. An id may come
    back after its episode has ended, which is where ``("next", "done")`` is true or where the next row has ``is_init``
    (``torchrl.envs.InitTracker``). TorchRL's collectors number the episodes of all their workers together, but Ray's
    and the distributed ones number them per worker: write the worker's number into its rows and name both keys,
    ``traj_key=["worker", ("collector", "traj_ids")]``. Two collectors one after the other both begin with 0: let the
    rows have ``is_init``, so that the second one does not go on with the first one's last episode.

    The sampler follows the trajectories as they are written instead of searching the storage for borders, so the cost
    of a sample depends on the number of trajectories in the buffer (two thousand for a million DMC steps) and not on
    the number of rows.

    It draws as ``uniform_over`` says and takes no priorities; for those use TorchRL's ``PrioritizedSliceSampler`` in
    its place.

    Args:
        slice_len (int): T, transitions per slice.

    Keyword Args:
        traj_key (NestedKey or list of NestedKey): whole numbers that tell apart the episodes that run at the same time;
            of several keys, together. Default: ``("collector", "traj_ids")``, written by TorchRL's collectors, or
            ``"env_index"``, written by its ``AsyncBatchedCollector``, where rows have only that.
        done_key (NestedKey): the episode ends here. Rows may lack it. Default: ``("next", "done")``.
        init_key (NestedKey): the episode begins here. Rows may lack it. Default: ``"is_init"``.
        mask_key (NestedKey): rows where it is false are padding, which is never sampled; TorchRL's collectors write it
            with ``split_trajs=True``. Rows may lack it. Default: ``("collector", "mask")``.
        uniform_over (str): ``"episodes"`` draws a trajectory uniformly and then a start, which favours the
            running episode (what the public lineage does); ``"starts"`` draws uniformly over all starts. Default:
            ``"episodes"``.
        partial (bool): whether a slice may also begin in the last T - 1 steps of an episode that has ended (so that
            an ended episode shorter than T is sampled too). Beyond the end such a slice repeats the last step, and a
            sample of a ``TensorDictReplayBuffer`` has ``mask_key``, false there. Shapes stay as they are. Default:
            ``False``.
        as_slices (bool): whether a sample has the batch size ``[batch_size / T, T]``, as the losses take it, instead of
            ``[batch_size]``. TorchRL's ``ReplayBufferEnsemble`` counts rows and needs ``False``. Default: ``False``.

    Raises:
        ValueError: if an argument is out of range, a batch size is not a multiple of ``slice_len``, or the rows of the
            buffer are batches.
        TypeError: if the storage is not a flat tensor storage, the buffer's writer does not write round the ring, an id
            is no number, or, with ``partial``, the buffer does not add the mask to its samples.
        KeyError: if the rows lack ``traj_key``, or ``done_key`` where it is needed: with ``partial``, and where only
            ``env_index`` tells rows apart.
        RuntimeError: if there is no complete slice yet, the sampler missed writes, or it is that of another buffer.

    >>> from tensordict import TensorDict
    >>> from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
    >>> buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(100), sampler=StepSliceSampler(3), batch_size=6)
    >>> steps = TensorDict({"t": torch.arange(10), "collector": {"traj_ids": torch.zeros(10, dtype=torch.int64)}}, [10])
    >>> _ = buffer.extend(steps)
    >>> buffer.sample().reshape(-1, 3)["t"].diff(dim=-1).unique().tolist()
    [1]
    """

    def __init__(
        self,
        slice_len: int,
        *,
        traj_key: NestedKey | list[NestedKey] = TRAJECTORY,
        done_key: NestedKey = (NEXT, DONE),
        init_key: NestedKey = IS_INIT,
        mask_key: NestedKey = MASK,
        uniform_over: UniformOver = "episodes",
        partial: bool = False,
        as_slices: bool = False,
    ) -> None:
        if slice_len < 1:
            raise ValueError(f"slice_len must be at least 1, got {slice_len}.")
        if uniform_over not in get_args(UniformOver):
            raise ValueError(f"uniform_over must be one of {', '.join(get_args(UniformOver))}, got {uniform_over!r}.")
        if isinstance(traj_key, list) and not traj_key:
            raise ValueError("traj_key must name at least one key, got [].")
        self.slice_len = slice_len
        self.traj_keys = [unravel_key(key) for key in (traj_key if isinstance(traj_key, list) else [traj_key])]
        self.done_key = unravel_key(done_key)
        self.init_key = unravel_key(init_key)
        self.mask_key = unravel_key(mask_key)
        self.uniform_over = uniform_over
        self.partial = partial
        self.as_slices = as_slices
        self._empty()

    def _empty(self) -> None:
        self._written = 0  # rows ever written; row r of the storage holds write number r modulo the capacity
        self._newest: int | Tensor | None = None  # row of the last write, once there is one
        self._loaded = False  # and nothing written since
        self._followed = 0  # rows that are in the table
        self._trajectories = Trajectories()
        self._starts: tuple[np.ndarray, np.ndarray] | None = None  # of the rows that were followed
        self._storage: weakref.ref[Storage] | None = None  # whose rows these are

    def add(self, index: int) -> None:
        """Is called by the replay buffer after one row was written."""
        self._written += 1
        self._newest = index
        self._loaded = False

    def extend(self, index: Tensor) -> None:
        """Is called by the replay buffer after several rows were written."""
        self._written += len(index)
        self._newest = index[-1]
        self._loaded = False

    def end_episodes(self, rows: int | Tensor, storage: TensorStorage) -> None:
        """Is called after the last rows of running episodes were made their ends, as after a fault.

        Args:
            rows (int or Tensor): of the storage.
            storage (TensorStorage): what this sampler samples from.
        """
        if self._written:
            newest = self._written - 1 if self._newest is None else int(self._newest)  # not known after loading
            before = (newest - torch.as_tensor(rows).reshape(-1).cpu().numpy()) % storage.max_size
            self._trajectories.end(self._written - 1 - before)
            self._starts = None

    def sample(self, storage: Storage, batch_size: int) -> tuple[Tensor, dict[str, Any]]:
        """Draws the rows of ``batch_size / slice_len`` slices, slice after slice.

        Returns:
            tuple: the rows, ``[batch_size]``, or ``[batch_size / T, T]`` with ``as_slices``; and what the buffer adds
                to the sample.
        """
        if batch_size % self.slice_len:
            raise ValueError(
                f"batch_size must be a multiple of slice_len={self.slice_len}, got {batch_size}; "
                "pass batch_size = slices * slice_len."
            )
        first, counts = self._follow(storage)
        total = int(counts.sum())
        if total == 0:
            raise RuntimeError(self._nothing_to_sample(storage, first))
        draws = torch.rand(
            2, batch_size // self.slice_len, dtype=torch.float64, generator=self._rng, device="cpu"
        ).numpy()
        if self.uniform_over == "episodes":
            eligible = np.flatnonzero(counts)
            chosen = eligible[(draws[0] * len(eligible)).astype(np.int64)]
            offset = (draws[1] * counts[chosen]).astype(np.int64)
        else:
            ends = counts.cumsum()
            position = (draws[0] * total).astype(np.int64)
            chosen = np.searchsorted(ends, position, side="right")
            offset = position - (ends[chosen] - counts[chosen])
        shape = (-1, self.slice_len) if self.as_slices else (-1,)
        chosen, steps = chosen[:, None], (first[chosen] + offset)[:, None] + np.arange(self.slice_len)
        info: dict[str, Any] = {}
        if self.partial:
            # The last step again, so that what is masked is as finite and as far from zero as the rest.
            last = self._trajectories.lengths[chosen] - 1
            valid = _sent((steps <= last).reshape(shape), storage)
            info[self.mask_key] = valid  # pyright: ignore[reportArgumentType]  # nested keys are fine
            steps = np.minimum(steps, last)
        rows = self._trajectories.rows(chosen, steps) % storage.max_size
        return _sent(rows.reshape(shape), storage), info

    def _sampleable_count(self, storage: Storage, batch_size: int) -> int:
        return int(self._follow(storage)[1].sum())

    def _nothing_to_sample(self, storage: Storage, first: np.ndarray) -> str:
        rows = len(storage)  # pyright: ignore[reportArgumentType]
        longest = int((self._trajectories.lengths - first).max(initial=0))
        text = f"no trajectory in the buffer has {self.slice_len} steps yet ({rows} rows, the longest has {longest})"
        if rows < storage.max_size and not self._trajectories.ended.any():
            return f"{text}; collect more before sampling."
        keys = ", ".join(map(repr, self.traj_keys))
        return (
            f"{text}; if episodes are that short, choose a smaller slice_len or partial=True, and if they are not, see "
            f"that {keys} stays the same from one batch of an episode to the next."
        )

    def _follow(self, storage: Storage) -> tuple[np.ndarray, np.ndarray]:
        """Adds the rows written since the last call to the table.

        Returns the first step of each trajectory that is still stored, and how many slices start from there on.
        """
        if not isinstance(storage, TensorStorage) or storage.ndim > 1:
            raise TypeError(
                "StepSliceSampler needs a one-dimensional tensor storage, got "
                f"{type(storage).__name__}(ndim={storage.ndim}); use LazyTensorStorage(capacity) or "
                "LazyMemmapStorage(capacity) and write flat rows."
            )
        known = None if self._storage is None else self._storage()
        if known is not storage:
            if known is not None:
                raise RuntimeError(
                    "this StepSliceSampler follows the rows of another buffer already, and would cut these by the "
                    "episodes of those; make a sampler for each buffer."
                )
            self._check_buffer(storage)
            self._storage = weakref.ref(storage)
        self._check_written(storage)
        oldest = max(self._written - storage.max_size, 0)
        if self._starts is None or self._followed < self._written:
            begin = max(self._followed, oldest)
            if begin < self._written:
                self._read(storage, begin)
            self._followed = self._written
            self._trajectories.forget(oldest, len(storage))
            first = self._trajectories.first_alive(oldest)
            counts = self._trajectories.lengths - first
            beyond = self.slice_len - 1
            if self.partial:
                beyond = np.where(self._trajectories.ended, 0, beyond)
            self._starts = first, np.maximum(counts - beyond, 0)
        return self._starts

    def _buffer(self, storage: Storage) -> ReplayBuffer | None:
        """The buffer that samples from the storage by this sampler, where it is known."""
        attached = (entity for entity in storage._attached_entities if isinstance(entity, ReplayBuffer))
        return next((buffer for buffer in attached if buffer.sampler is self), None)

    def _check_buffer(self, storage: Storage) -> None:
        buffer = self._buffer(storage)
        if buffer is None:
            return
        if not isinstance(buffer.writer, (RoundRobinWriter, ImmutableDatasetWriter)):
            raise TypeError(
                "StepSliceSampler needs rows in the order of their writing, which "
                f"{type(buffer.writer).__name__} does not keep; build the buffer with "
                "writer=TensorDictRoundRobinWriter()."
            )
        if self.partial and not isinstance(buffer, TensorDictReplayBuffer):
            raise TypeError(
                f"partial=True needs the mask {self.mask_key!r} in every sample, which {type(buffer).__name__} leaves "
                "out; use TensorDictReplayBuffer."
            )

    def _check_written(self, storage: TensorStorage) -> None:
        """Compares what was seen with what is stored; a buffer that was filled before is read from its oldest row."""
        capacity, stored = storage.max_size, len(storage)
        if self._newest is None:
            self._newest = self._written - 1
        newest = self._newest = int(self._newest)  # waits once per write
        # In a full ring the number of rows no longer tells of foreign writes, but the storage's cursor does. After
        # loading it is not known, or still that of the rows before.
        cursor = storage._last_cursor_index if self._written >= capacity and not self._loaded else None
        missed = cursor is not None and int(cursor) != newest % capacity
        if stored == min(self._written, capacity) and not (newest + 1 - self._written) % capacity and not missed:
            return
        if self._followed:
            full = stored == capacity <= self._written
            found = "others have written to the full storage" if full else f"it holds {stored} of {capacity} rows"
            raise RuntimeError(
                f"the storage does not hold the {self._written} writes that the sampler saw: {found}; write through "
                "this buffer, in this process and in order, and save and load the sampler together with the storage."
            )
        if stored < capacity:
            newest = stored - 1
        elif newest < 0:
            newest = storage._last_cursor_index  # as TorchRL's samplers do
            buffer = self._buffer(storage)
            if newest is None and buffer is not None and isinstance(buffer.writer, ImmutableDatasetWriter):
                newest = capacity - 1  # a data set begins with its first row
            if newest is None:
                raise RuntimeError(
                    f"the buffer was full ({capacity} rows) before the sampler saw it, and which row is the oldest is "
                    "not known; write one row, or save and load the sampler together with the storage; of a data set "
                    "that begins with its first row, build the buffer with writer=ImmutableDatasetWriter()."
                )
        self._newest = int(newest)
        self._written = self._newest + 1 + (capacity if stored == capacity else 0)

    def _read(self, storage: TensorStorage, begin: int) -> None:
        """Adds the rows from write number ``begin`` on to the table."""
        stored: TensorDictBase = storage[:]
        if stored.batch_dims > 1:
            raise ValueError(
                f"every row of the buffer is a batch {list(stored.batch_size[1:])}, but StepSliceSampler needs one "
                "transition per row; write flat rows: buffer.extend(batch.reshape(-1)), or where a collector of more "
                "environments writes by itself, Collector(..., postproc=lambda batch: batch.reshape(-1))."
            )
        keys = self._id_keys(stored)
        if self.partial and stored.get(self.done_key, None) is None:
            raise KeyError(
                f"partial=True needs {self.done_key!r} in every row, to know which episodes have ended; store it, or "
                "pass done_key=..."
            )
        low, number = begin % storage.max_size, self._written - begin
        around = low + number > storage.max_size
        rows = torch.arange(low, low + number, device="cpu")  # whatever the default device is
        index = rows % storage.max_size if around else slice(low, low + number)
        values: dict[NestedKey, Any] = {}
        for key in (*keys, self.init_key, self.done_key, self.mask_key):
            column = stored.get(key, None)
            if key in keys and not isinstance(column, Tensor):
                raise TypeError(
                    f"StepSliceSampler tells episodes apart by whole numbers, got texts or a dictionary at {key!r}; "
                    "number the episodes in every row and pass that key as traj_key=..."
                )
            if column is not None:
                column = column[index].reshape(number, -1)
                # Joined to one table below, where a single float32 column would round the ids of the others.
                kind = torch.bool if key not in keys else torch.float64 if column.is_floating_point() else torch.int64
                values[key] = column.to(kind)
        table = torch.cat(list(values.values()), -1).cpu().numpy()  # one wait for the device
        begin_column = 0
        for key, column in values.items():
            values[key] = table[:, begin_column : begin_column + column.shape[1]]
            begin_column += column.shape[1]
        nothing = np.zeros((number, 1), dtype=bool)
        begins, ends = (values.get(key, nothing).any(-1) for key in (self.init_key, self.done_key))
        numbers = np.arange(begin, self._written)
        ids = np.concatenate([values[key] for key in keys], axis=1)
        if self.mask_key in values:
            valid = values[self.mask_key].any(-1)
            numbers, ids, begins, ends = numbers[valid], ids[valid], begins[valid], ends[valid]
        self._trajectories.extend(numbers, ids, begins, ends)

    def _id_keys(self, stored: TensorDictBase) -> list[NestedKey]:
        missing = [key for key in self.traj_keys if stored.get(key, None) is None]
        if not missing:
            return self.traj_keys
        if self.traj_keys == [TRAJECTORY] and stored.get(ENV_INDEX, None) is not None:
            if all(stored.get(key, None) is None for key in (self.done_key, self.init_key)):
                raise KeyError(
                    f"{ENV_INDEX!r} tells environments apart and not their episodes: rows need {self.done_key!r} or "
                    f"{self.init_key!r} as well; store one, or pass done_key=..."
                )
            return [ENV_INDEX]
        raise KeyError(
            f"StepSliceSampler needs the trajectory id {', '.join(map(repr, missing))} in every row; collect with "
            "StepCollector or a TorchRL collector (track_traj_ids=True), or pass traj_key=..."
        )

    def __getstate__(self) -> Any:
        return super().__getstate__() | {"_storage": None}  # a copy goes with a copy of the buffer

    def state_dict(self) -> dict[str, Any]:
        """The trajectories and the write count."""
        return {"written": self._written, "followed": self._followed, **self._trajectories.state_dict()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restores :meth:`state_dict`."""
        self._empty()
        self._written = int(state_dict["written"])
        self._followed = int(state_dict["followed"])
        self._trajectories.load_state_dict(state_dict)
        self._loaded = True

    def dumps(self, path: str | Path) -> None:
        """Writes :meth:`state_dict` to ``path/slices.pt``."""
        path = Path(path)
        path.mkdir(parents=True, exist_ok=True)
        torch.save(self.state_dict(), path / "slices.pt")

    def loads(self, path: str | Path) -> None:
        """Reads what :meth:`dumps` wrote; of a buffer that another sampler dumped, the rows are read anew."""
        file = Path(path) / "slices.pt"
        if file.exists():
            self.load_state_dict(torch.load(file, weights_only=True))
        else:
            self._empty()

    def __repr__(self) -> str:
        partial = ", partial=True" if self.partial else ""
        partial += ", as_slices=True" if self.as_slices else ""
        return f"{type(self).__name__}(slice_len={self.slice_len}, uniform_over={self.uniform_over!r}{partial})"


def _sent(array: np.ndarray, storage: Storage) -> Tensor:
    """The array on the storage's device; what is queued there is not waited for."""
    tensor, device = torch.from_numpy(array), getattr(storage, "device", "cpu")
    if device == "auto":
        return tensor
    pinned = torch.device(device).type == "cuda"
    return (tensor.pin_memory() if pinned else tensor).to(device, non_blocking=pinned)
