"""Slice sampling from a ring buffer that is written one step at a time."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import torch
from tensordict import NestedKey, unravel_key
from torch import Tensor
from torchrl.data.replay_buffers.samplers import Sampler
from torchrl.data.replay_buffers.storages import Storage, TensorStorage

from torchrl_etdmpc.keys import TRAJECTORY

UniformOver = Literal["episodes", "starts"]


class _Segments:
    """Runs of rows of one trajectory, as arithmetic progressions of write counts (amortised O(1) to append)."""

    fields = ("start", "stride", "length", "trajectory")

    def __init__(self) -> None:
        self.table = np.zeros((len(self.fields), 64), dtype=np.int64)
        self.size = 0

    def append(self, start: int, trajectory: int) -> int:
        if self.size == self.table.shape[1]:
            self.table = np.concatenate([self.table, np.zeros_like(self.table)], axis=1)
        self.table[:, self.size] = (start, 1, 1, trajectory)
        self.size += 1
        return self.size - 1

    def view(self) -> np.ndarray:
        return self.table[:, : self.size]

    def keep(self, mask: np.ndarray) -> None:
        self.table = np.pad(self.view()[:, mask], ((0, 0), (0, 64)))
        self.size = int(mask.sum())


class StepSliceSampler(Sampler):
    """Samples slices of consecutive transitions of one trajectory, usable while an episode is still being written.

    Every sample holds exactly ``batch_size / slice_len`` slices. A slice never crosses the border of a trajectory nor
    the write head of a full ring buffer, and a trajectory can be sampled from its first complete slice on. Rows of
    several environments may be interleaved, as :class:`~torchrl_etdmpc.collectors.StepCollector` writes them.

    The sampler follows the trajectories as they are written instead of searching the storage for borders, so the cost
    of a sample depends on the number of trajectories in the buffer (two thousand for a million DMC steps) and not on
    the number of rows. A trajectory is cut where the spacing of its rows changes, so flatten the batches ``[N, T]``
    that TorchRL's collectors make of N environments time first: ``batch.transpose(0, 1).reshape(-1)``.

    Args:
        slice_len (int): T, transitions per slice.

    Keyword Args:
        traj_key (NestedKey): where the storage holds the trajectory's id, written by TorchRL's collectors. Default:
            ``("collector", "traj_ids")``.
        uniform_over (str): ``"episodes"`` draws a trajectory uniformly and then a start, which favours the
            running episode (what the public lineage does); ``"starts"`` draws uniformly over all starts. Default:
            ``"episodes"``.

    Raises:
        ValueError: if an argument is out of range, or a batch size is not a multiple of ``slice_len``.
        TypeError: if the storage is not a flat tensor storage.
        RuntimeError: if there is no complete slice yet, or the sampler missed writes.

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
        traj_key: NestedKey = TRAJECTORY,
        uniform_over: UniformOver = "episodes",
    ) -> None:
        if slice_len < 1:
            raise ValueError(f"slice_len must be at least 1, got {slice_len}.")
        if uniform_over not in get_args(UniformOver):
            raise ValueError(f"uniform_over must be one of {', '.join(get_args(UniformOver))}, got {uniform_over!r}.")
        self.slice_len = slice_len
        self.traj_key = unravel_key(traj_key)
        self.uniform_over = uniform_over
        self._empty()

    def _empty(self) -> None:
        self._written = 0  # rows ever written; row r of the storage holds write number r modulo the capacity
        self._newest: int | Tensor | None = None  # row of the last write, once there is one
        self._followed = 0  # rows whose trajectory is in the table
        self._segments = _Segments()
        self._open: dict[int, int] = {}  # trajectory id -> its last segment

    def add(self, index: int) -> None:
        """Is called by the replay buffer after one row was written."""
        self._written += 1
        self._newest = index

    def extend(self, index: Tensor) -> None:
        """Is called by the replay buffer after several rows were written."""
        self._written += len(index)
        self._newest = index[-1]

    def sample(self, storage: Storage, batch_size: int) -> tuple[Tensor, dict[str, Any]]:
        """Draws the rows of ``batch_size / slice_len`` slices, slice after slice, shape ``[batch_size]``."""
        if batch_size % self.slice_len:
            raise ValueError(
                f"batch_size must be a multiple of slice_len={self.slice_len}, got {batch_size}; "
                "pass batch_size = slices * slice_len."
            )
        first, counts = self._starts(storage)
        total = int(counts.sum())
        if total == 0:
            rows = len(storage)  # pyright: ignore[reportArgumentType]
            raise RuntimeError(
                f"no trajectory in the buffer has {self.slice_len} steps yet ({rows} rows); collect more before "
                "sampling."
            )
        start, stride, _, _ = self._segments.view()
        draws = torch.rand(2, batch_size // self.slice_len, dtype=torch.float64, generator=self._rng).numpy()
        if self.uniform_over == "episodes":
            eligible = np.flatnonzero(counts)
            chosen = eligible[(draws[0] * len(eligible)).astype(np.int64)]
            offset = (draws[1] * counts[chosen]).astype(np.int64)
        else:
            ends = counts.cumsum()
            position = (draws[0] * total).astype(np.int64)
            chosen = np.searchsorted(ends, position, side="right")
            offset = position - (ends[chosen] - counts[chosen])
        steps = (first[chosen] + offset)[:, None] + np.arange(self.slice_len)
        rows = (start[chosen, None] + steps * stride[chosen, None]) % storage.max_size
        return torch.from_numpy(rows.reshape(-1)).to(_device(storage)), {}

    def _sampleable_count(self, storage: Storage, batch_size: int) -> int:
        return int(self._starts(storage)[1].sum())

    def _starts(self, storage: Storage) -> tuple[np.ndarray, np.ndarray]:
        """First step of each segment that is still stored and complete, and how many slices start from there on."""
        self._follow(storage)
        start, stride, length, _ = self._segments.view()
        overwritten = self._written - storage.max_size
        first = np.maximum(-((start - overwritten) // stride), 0)  # ceil((overwritten - start) / stride)
        return first, np.maximum(length - self.slice_len + 1 - first, 0)

    def _follow(self, storage: Storage) -> None:
        """Adds the rows written since the last call to the table and forgets segments that were overwritten."""
        if not isinstance(storage, TensorStorage) or storage.ndim > 1:
            raise TypeError(
                "StepSliceSampler needs a one-dimensional tensor storage, got "
                f"{type(storage).__name__}(ndim={storage.ndim}); use LazyTensorStorage(capacity) or "
                "LazyMemmapStorage(capacity) and write flat rows."
            )
        capacity = storage.max_size
        newest = self._newest = self._written - 1 if self._newest is None else int(self._newest)  # waits once per write
        if len(storage) != min(self._written, capacity) or (newest + 1 - self._written) % capacity:
            raise RuntimeError(
                f"the sampler saw {self._written} writes but the storage holds {len(storage)} of {capacity} rows; "
                "attach the sampler before the first write, and save and load it together with the storage."
            )
        oldest = self._written - capacity
        begin = max(self._followed, oldest)
        if begin < self._written:
            for count, trajectory in zip(
                range(begin, self._written), self._trajectories(storage, begin, capacity), strict=True
            ):
                self._append(count, trajectory, oldest)
            self._followed = self._written
        self._forget(oldest)

    def _trajectories(self, storage: Storage, begin: int, capacity: int) -> list[int]:
        column = storage[:].get(self.traj_key, None)
        if column is None:
            raise KeyError(
                f"StepSliceSampler needs the trajectory id {self.traj_key!r} in every row; collect with StepCollector "
                "or a TorchRL collector (track_traj_ids=True), or pass traj_key=..."
            )
        rows = torch.arange(begin, self._written, device=column.device) % capacity
        return column[rows].reshape(-1).tolist()

    def _append(self, count: int, trajectory: int, oldest: int) -> None:
        """Adds write number ``count`` to the last segment of its trajectory, or opens a new segment with it."""
        # A segment is an arithmetic progression of write numbers. Its second row sets the stride (how many environments
        # write in turn), and a row that does not continue the progression begins a new segment: a stride that changes
        # in mid-episode costs the few slices across the seam, and no slice can skip a row.
        # A lone row may set a stride only while it is still stored: then every row after it is stored too and was seen,
        # so this one is its successor. Once it is overwritten, rows between the two may have come and gone unseen, and
        # the stride would be wrong. A longer segment needs no such check, because its next write number is known.
        position = self._open.get(trajectory)
        if position is not None:
            start, stride, length, _ = self._segments.table[:, position]
            if length == 1 and start >= oldest:
                self._segments.table[1, position] = count - start
                self._segments.table[2, position] = 2
                return
            if count == start + stride * length:
                self._segments.table[2, position] += 1
                return
        self._open[trajectory] = self._segments.append(count, trajectory)

    def _forget(self, oldest: int) -> None:
        start, stride, length, _ = self._segments.view()
        alive = start + stride * (length - 1) >= oldest
        if len(alive) - alive.sum() > max(64, len(alive) // 2):
            moved = alive.cumsum() - 1
            self._open = {key: int(moved[position]) for key, position in self._open.items() if alive[position]}
            self._segments.keep(alive)

    def state_dict(self) -> dict[str, Any]:
        """The table of trajectories and the write count."""
        return {
            "written": self._written,
            "followed": self._followed,
            "segments": torch.from_numpy(self._segments.view().copy()),
            "open": dict(self._open),
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restores :meth:`state_dict`."""
        self._empty()
        self._written = int(state_dict["written"])
        self._followed = int(state_dict["followed"])
        table = np.asarray(state_dict["segments"], dtype=np.int64)
        self._segments.table = np.concatenate([table, np.zeros((len(_Segments.fields), 64), np.int64)], axis=1)
        self._segments.size = table.shape[1]
        self._open = {int(key): int(position) for key, position in state_dict["open"].items()}

    def dumps(self, path: str | Path) -> None:
        """Writes :meth:`state_dict` to ``path/slices.pt``."""
        path = Path(path)
        path.mkdir(parents=True, exist_ok=True)
        torch.save(self.state_dict(), path / "slices.pt")

    def loads(self, path: str | Path) -> None:
        """Reads what :meth:`dumps` wrote."""
        self.load_state_dict(torch.load(Path(path) / "slices.pt", weights_only=True))

    def __repr__(self) -> str:
        return f"{type(self).__name__}(slice_len={self.slice_len}, uniform_over={self.uniform_over!r})"


def _device(storage: Storage) -> torch.device | str:
    device = getattr(storage, "device", "cpu")
    return "cpu" if device == "auto" else device
