"""Which rows of a ring buffer belong to which trajectory, followed as they are written."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

_COLUMNS = _BEGIN, _LENGTH, _ROOM, _FIRST, _LAST, _ENDED = range(6)
_MIN_ROOM = 16


class Trajectories:
    """The rows of each trajectory, in the order of their writing and known by their write numbers.

    Write number r stands in row r modulo the capacity of the buffer. Every trajectory has a block of one shared array,
    so that the rows of many slices are one gather; blocks grow by doubling, so that a write costs what is new.
    """

    def __init__(self) -> None:
        self._pool = np.zeros(64, dtype=np.int64)  # write numbers
        self._used = 0
        self._table = np.zeros((len(_COLUMNS), 64), dtype=np.int64)
        self._size = 0
        self._open: dict[tuple[int, ...], int] = {}  # id -> its running trajectory

    @property
    def lengths(self) -> np.ndarray:
        """Rows per trajectory, those that were overwritten included."""
        return self._table[_LENGTH, : self._size]

    @property
    def ended(self) -> np.ndarray:
        """Whether a trajectory's last row is the end of its episode."""
        return self._table[_ENDED, : self._size].astype(bool)

    def extend(self, numbers: np.ndarray, ids: np.ndarray, begins: np.ndarray, ends: np.ndarray) -> None:
        """Adds rows in the order of their writing.

        Args:
            numbers (ndarray): write numbers, increasing, ``[n]``.
            ids (ndarray): what tells the trajectories that run at the same time apart, ``[n, K]``.
            begins (ndarray): whether a row is the first one of an episode, ``[n]``.
            ends (ndarray): whether it is the last one, ``[n]``.
        """
        runs = [(0, len(numbers))] if len(numbers) else []
        if len(numbers) > 1:
            # Sorted by id, and by time within it, the rows fall into runs of one trajectory each.
            order = np.lexsort(ids.T)
            numbers, ids, begins, ends = numbers[order], ids[order], begins[order], ends[order]
            border = (ids[1:] != ids[:-1]).any(-1) | begins[1:] | ends[:-1]
            cuts = [0, *(np.flatnonzero(border) + 1).tolist(), len(order)]
            runs = [(cuts[k], cuts[k + 1]) for k in np.argsort(numbers[cuts[:-1]])]
        identities = ids[[begin for begin, _ in runs]].tolist()
        for (begin, end), identity in zip(runs, map(tuple, identities), strict=True):
            position = None if begins[begin] else self._open.get(identity)
            if position is None:
                position = self._open[identity] = self._new()
            self._append(position, numbers[begin:end])
            if ends[end - 1]:
                self._table[_ENDED, position] = 1
                del self._open[identity]

    def end(self, numbers: np.ndarray) -> None:
        """Ends the running trajectories whose last rows are among these.

        Args:
            numbers (ndarray): write numbers, ``[n]``.
        """
        for identity, position in list(self._open.items()):
            if self._table[_LAST, position] in numbers:
                self._table[_ENDED, position] = 1
                del self._open[identity]

    def _new(self) -> int:
        if self._size == self._table.shape[1]:
            self._table = np.concatenate([self._table, np.zeros_like(self._table)], axis=1)
        self._table[:, self._size] = 0
        self._table[_BEGIN, self._size] = self._used
        self._size += 1
        return self._size - 1

    def _append(self, position: int, numbers: np.ndarray) -> None:
        begin, length, room = self._table[:_FIRST, position].tolist()
        needed = length + len(numbers)
        if needed > room:
            room = max(2 * needed, _MIN_ROOM)
            target = begin if begin + self._table[_ROOM, position] == self._used else self._used
            if target + room > len(self._pool):
                self._pool = np.concatenate([self._pool, np.zeros(max(room, len(self._pool)), dtype=np.int64)])
            self._pool[target : target + length] = self._pool[begin : begin + length]
            self._used, begin = target + room, target
            self._table[[_BEGIN, _ROOM], position] = begin, room
        self._pool[begin + length : begin + needed] = numbers
        self._table[_LENGTH, position] = needed
        self._table[_LAST, position] = numbers[-1]

    def first_alive(self, oldest: int) -> np.ndarray:
        """First step of each trajectory whose write number is at least ``oldest``; its length if there is none."""
        begin, length, _, first, last, _ = self._table[:, : self._size]
        dead = last < oldest
        first[dead] = length[dead]
        behind = np.flatnonzero((self._pool[begin + np.minimum(first, length - 1)] < oldest) & ~dead)
        first[behind] += 1  # what a step of every environment overwrites
        for position in behind[self._pool[begin[behind] + first[behind]] < oldest].tolist():
            rows = self._pool[begin[position] : begin[position] + length[position]]
            first[position] = rows.searchsorted(oldest)
        return first

    def rows(self, positions: np.ndarray, steps: np.ndarray) -> np.ndarray:
        """Write numbers of steps of trajectories, broadcast against each other."""
        return self._pool[self._table[_BEGIN][positions] + steps]

    def forget(self, oldest: int, stored: int) -> None:
        """Frees what was overwritten, once there is much of it; the order of the others stays."""
        alive = self._table[_LAST, : self._size] >= oldest
        if self._size - alive.sum() > max(64, self._size // 2):
            moved = alive.cumsum() - 1
            self._open = {key: int(moved[position]) for key, position in self._open.items() if alive[position]}
            self._table = np.pad(self._table[:, : self._size][:, alive], ((0, 0), (0, 64)))
            self._size = int(alive.sum())
        if self._used > 4 * stored + 1024:
            self._set(*self._alive_rows(), self.ended)

    def _alive_rows(self) -> tuple[np.ndarray, np.ndarray]:
        """Write numbers and lengths of the trajectories; of one that was overwritten, the last row."""
        begin, length, _, first, _, _ = self._table[:, : self._size]
        skipped = np.minimum(first, length - 1)
        lengths = length - skipped
        within = np.arange(lengths.sum()) - np.repeat(lengths.cumsum() - lengths, lengths)
        return self._pool[np.repeat(begin + skipped, lengths) + within], lengths

    def _set(self, numbers: np.ndarray, lengths: np.ndarray, ended: np.ndarray) -> None:
        ends = lengths.cumsum()
        self._pool = np.pad(numbers, (0, 64))
        self._used, self._size = len(numbers), len(lengths)
        last = numbers[ends - 1] if len(numbers) else lengths
        table = np.stack([ends - lengths, lengths, lengths, np.zeros_like(lengths), last, ended.astype(np.int64)])
        self._table = np.pad(table, ((0, 0), (0, 64)))

    def state_dict(self) -> dict[str, Any]:
        """The trajectories as runs of equally spaced rows: few, however many rows there are, where writes are regular.

        Column by column, ``segments`` holds first write number, spacing, rows and place of the trajectory.
        """
        numbers, lengths = self._alive_rows()
        place = np.repeat(np.arange(self._size), lengths)
        gap = np.diff(numbers, prepend=numbers[:1])
        fresh = np.diff(place, prepend=-1) != 0
        second = np.roll(fresh, 1) & ~fresh  # sets the spacing of its run
        cut = fresh | ((np.diff(gap, prepend=0) != 0) & ~second)
        begin = np.flatnonzero(cut)
        length = np.diff(begin, append=len(numbers))
        following = np.minimum(begin + 1, max(len(numbers) - 1, 0))
        stride = np.where(length > 1, gap[following], 1) if len(begin) else length
        segments = np.stack([numbers[begin], stride, length, place[begin]])
        opened = {key[0] if len(key) == 1 else key: position for key, position in self._open.items()}
        return {"segments": torch.from_numpy(segments), "ended": torch.from_numpy(self.ended), "open": opened}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restores :meth:`state_dict`."""
        start, stride, length, place = np.asarray(state_dict["segments"], dtype=np.int64)
        ended = np.asarray(state_dict["ended"], dtype=bool)
        within = np.arange(length.sum()) - np.repeat(length.cumsum() - length, length)
        numbers = np.repeat(start, length) + within * np.repeat(stride, length)
        self._set(numbers, np.bincount(place, weights=length, minlength=len(ended)).astype(np.int64), ended)
        opened = state_dict["open"].items()
        self._open = {key if isinstance(key, tuple) else (int(key),): int(position) for key, position in opened}
