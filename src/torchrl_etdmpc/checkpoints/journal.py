"""A replay buffer on disk, written in steps whose cost is what is new."""

from __future__ import annotations

import secrets
from collections.abc import Iterable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple, cast

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, unravel_key
from torch import Tensor
from torchrl.data import RoundRobinWriter, TensorDictReplayBuffer, TensorStorage

from torchrl_etdmpc.keys import PLAN, TARGETS
from torchrl_etdmpc.runs.files import DamagedFileError, read_tensors, remove_partial_files, write_tensors

ROWS_PER_FILE = 16_384
PARTS = 3


class _Saved(NamedTuple):
    """What was written so far."""

    files: Mapping[str, Any] = MappingProxyType({"written": 0, "rows": [], "targets": []})
    last: tuple[int, TensorDictBase] | None = None
    """Write number and content of the last row."""
    fingerprints: Tensor = torch.zeros(0, dtype=torch.int64)
    """Of the targets, row by row of the buffer."""


class ReplayJournal:
    """Writes a buffer's rows once, and the planner targets that reanalyze rewrites as a base with changes.

    A transition never changes except for its targets. So every :meth:`save` appends a file with the rows written since
    the last one, and files with the targets that have changed since then, which their fingerprints tell, 8 bytes a row.
    The targets are kept in three parts; the one with the most changes is written anew if they exceed a third of it, one
    part in a save. Files are never modified. What belongs to one state of the buffer is listed in the dictionary that
    :meth:`save` returns; several such lists share files, and :meth:`prune` removes what no list names.

    The buffer must be written in order (``add`` and ``extend``, one storage dimension), as
    :class:`~torchrl_etdmpc.collectors.StepCollector` does. One that was emptied is written whole again.

    Args:
        folder (str or Path): made if missing.

    Keyword Args:
        plan_key (NestedKey): group of the planner's targets. Rows without it are written once and never again. Default:
            ``"plan"``.
        rewrite_at (float): share of changed targets at which a part is written anew. Default: 1/3.

    >>> import tempfile
    >>> from torchrl.data import LazyTensorStorage
    >>> def buffer():
    ...     return TensorDictReplayBuffer(storage=LazyTensorStorage(10))
    >>> first, second = buffer(), buffer()
    >>> _ = first.extend(TensorDict({"x": torch.arange(7)}, [7]))
    >>> journal = ReplayJournal(tempfile.mkdtemp())
    >>> files = journal.save(first)
    >>> journal.load(second, files)
    >>> second[:]["x"].tolist()
    [0, 1, 2, 3, 4, 5, 6]
    """

    def __init__(self, folder: str | Path, *, plan_key: NestedKey = PLAN, rewrite_at: float = 1 / 3) -> None:
        self.folder = Path(folder)
        self.rewrite_at = rewrite_at
        self._target_keys = [unravel_key((plan_key, name)) for name in TARGETS]
        self.saved = _Saved()
        """What the next :meth:`save` goes on from; to put an earlier one back undoes the saves since."""

    def save(self, buffer: TensorDictReplayBuffer) -> dict[str, Any]:
        """Writes what is new.

        Args:
            buffer (TensorDictReplayBuffer): the same one at every call.

        Returns:
            dict: what :meth:`load` needs, JSON-serialisable.

        Raises:
            OSError: if a file cannot be written; the journal stays as it was.
            TypeError: if the storage is not a flat tensor storage, or its writer does not write round the ring.
            ValueError: if rows were not written in order.
        """
        capacity, written = buffer.storage.max_size, _write_count(buffer)
        self.folder.mkdir(parents=True, exist_ok=True)
        saved = _Saved() if self._was_emptied(buffer, written) else self.saved
        old, fingerprints = saved.files, saved.fingerprints
        new: dict[str, Any] = {"capacity": capacity, "written": written}
        new["rows"] = [entry for entry in old["rows"] if entry["end"] > written - capacity]
        new["targets"] = old["targets"]
        if written:
            stored: TensorDictBase = buffer.storage[:]
            targets = [key for key in self._target_keys if key in stored.keys(True, True)]
            begin = max(old["written"], written - capacity)
            for start in range(begin, written, ROWS_PER_FILE):
                end = min(start + ROWS_PER_FILE, written)
                # Write number r stands in row r modulo the capacity, so this also reads across the ring's end.
                position = torch.arange(start, end, device=stored.device) % capacity
                entry = self._write(f"rows-{start:012d}", _rows(stored.exclude("index", *targets), position))
                new["rows"] = [*new["rows"], entry | {"begin": start, "end": end}]
            if targets:
                targets_now = stored.select(*targets)
                fingerprints = _fingerprints(targets_now)
                changed = torch.ones_like(fingerprints, dtype=torch.bool)
                before = saved.fingerprints.to(changed.device)
                changed[: len(before)] = fingerprints[: len(before)] != before
                new["targets"] = self._save_targets(targets_now, changed, old, written, capacity)
        # Last: a failed save must leave the journal where it was, or those rows are never written.
        self.saved = _Saved(new, self._last_row(buffer, written), fingerprints)
        return new

    def _last_row(self, buffer: TensorDictReplayBuffer, written: int) -> tuple[int, TensorDictBase] | None:
        return (written - 1, self._row(buffer, written - 1).clone()) if written else None

    def _row(self, buffer: TensorDictReplayBuffer, number: int) -> TensorDictBase:
        """What never changes of the row of a write number."""
        row = cast(TensorDictBase, buffer.storage[number % buffer.storage.max_size])
        return row.exclude("index", *self._target_keys)

    def _was_emptied(self, buffer: TensorDictReplayBuffer, written: int) -> bool:
        """Whether the last row that was saved is gone, though nothing has overwritten it.

        Flags do not count: a fault may have made that row the end of its episode.
        """
        last = self.saved.last
        if last is None or last[0] < written - buffer.storage.max_size:
            return False
        number, row = last
        if number >= written:
            return True
        now = self._row(buffer, number)
        return any(
            value.dtype != torch.bool and not torch.equal(value.nan_to_num(), now.get(key).nan_to_num())
            for key, value in row.items(True, True)
        )

    def _save_targets(
        self, stored: TensorDictBase, changed: Tensor, old: Mapping[str, Any], written: int, capacity: int
    ) -> list[dict[str, Any]]:
        """Writes the targets that changed since the last save, or a whole part where too many have piled up."""
        size = -(-capacity // PARTS)
        # In a larger buffer than before, where parts have other bounds, all of them are written anew.
        known = old["targets"] if old.get("capacity") == capacity else []
        entries = {part: [entry for entry in known if entry["part"] == part] for part in range(PARTS)}
        indices, shares = {}, {}
        for part in range(PARTS):
            low, high = part * size, min((part + 1) * size, len(stored))
            if low < high:
                indices[part] = changed[low:high].nonzero().squeeze(-1) + low
                pending = sum(entry["rows"] for entry in entries[part][1:]) + len(indices[part])
                shares[part] = pending / (high - low) if entries[part] else float("inf")
        fullest = max(shares, key=shares.__getitem__)
        for part, index in indices.items():
            low, high = part * size, min((part + 1) * size, len(stored))
            name = f"targets-{written:012d}-{part}"
            if not entries[part] or (part == fullest and shares[part] > self.rewrite_at):
                entry = self._write(name, stored[low:high].clone())
                entries[part] = [entry | {"part": part, "rows": high - low, "begin": low}]
            elif len(index):
                entry = self._write(name, _rows(stored, index).set("index", index.to(torch.int32)))
                entries[part] = [*entries[part], entry | {"part": part, "rows": len(index)}]
        return [entry for part in range(PARTS) for entry in entries[part]]

    def _write(self, name: str, content: TensorDictBase) -> dict[str, Any]:
        # A run that goes on from an older state must not meet the files of the future that it lost.
        file = f"{name}-{secrets.token_hex(4)}.pt"
        return {"file": file, **write_tensors(self.folder / file, content.cpu().to_dict())}

    def load(self, buffer: TensorDictReplayBuffer, files: Mapping[str, Any]) -> None:
        """Brings a buffer to where it was saved, and goes on from there at the next :meth:`save`.

        Args:
            buffer (TensorDictReplayBuffer): with the capacity of the saved one, or a larger one if the saved one was
                not full yet. It is emptied first, of which its sampler hears.
            files (mapping): what :meth:`save` returned.

        Raises:
            ValueError: if the capacity does not fit.
            DamagedFileError: if a file is missing or has changed.
        """
        capacity, written = buffer.storage.max_size, files["written"]
        if capacity != files["capacity"] and (capacity < written or written > files["capacity"]):
            raise ValueError(
                f"the saved buffer has capacity {files['capacity']} and {written} rows were written to it; it cannot "
                f"be loaded into one of capacity {capacity}."
            )
        rows, position = TensorDict(), torch.arange(max(written - capacity, 0), written) % capacity
        fingerprints = _Saved().fingerprints
        if written:
            rows = self._read_rows(files)
            targets = self._read_targets(files["targets"], len(rows))
            if targets is not None:
                fingerprints = _fingerprints(targets)
                rows.update(_rows(targets, position))
            rows.set("index", position)  # TensorDict buffers number their rows
        if len(buffer):  # it may hold more than was saved
            buffer.empty()
        if written:
            device = _device(buffer)
            buffer.storage.set(position.to(device), rows.to(device))  # pyright: ignore[reportArgumentType]
            state = {"_cursor": written % capacity, "_write_count": written}
            if buffer.writer.tracks_generations:  # how often each row has been written, from 0; -1 for never
                times = (written - 1 - torch.arange(capacity)).div(capacity, rounding_mode="floor")
                state["_generation"] = times.clamp(min=-1)
            buffer.writer.load_state_dict(state)
        state = {key: files[key] for key in ("capacity", "written", "rows", "targets")}
        self.saved = _Saved(state, self._last_row(buffer, written), fingerprints)

    def read_row(self, files: Mapping[str, Any], row: int) -> TensorDictBase:
        """One row, without its targets; of the files, the one that holds it is read.

        Args:
            files (mapping): what :meth:`save` returned.
            row (int): from 0, the oldest that is still in the buffer.

        Raises:
            IndexError: if there is no such row.
            DamagedFileError: if the file is missing or has changed.
        """
        count = min(files["written"], files["capacity"])
        if not 0 <= row < count:
            raise IndexError(f"row must be in [0, {count}), the rows of the saved buffer, got {row}.")
        number = files["written"] - count + row
        entry = next(entry for entry in files["rows"] if entry["begin"] <= number < entry["end"])
        return cast(TensorDictBase, self._read(entry)[number - entry["begin"]])

    def salvage(self, buffer: TensorDictReplayBuffer, files: Mapping[str, Any]) -> list[str]:
        """Fills a buffer with the longest stretch of rows that can still be read, as if they were new.

        The next :meth:`save` writes all of them again.

        Args:
            buffer (TensorDictReplayBuffer): of the capacity of the saved one. It is emptied first.
            files (mapping): what :meth:`save` returned.

        Returns:
            list of str: what is wrong with the files of the others.
        """
        capacity, written, faults = files["capacity"], files["written"], []
        numbers = torch.arange(max(written - capacity, 0), written)  # the rows, in the order of their writing
        first, position = written - len(numbers), numbers % capacity
        readable = torch.zeros(len(numbers), dtype=torch.bool)
        content: TensorDictBase | None = None
        for entry in files["rows"]:
            try:
                rows = self._read(entry)
            except DamagedFileError as error:
                faults.append(str(error))
                continue
            content = cast(TensorDictBase, rows.new_zeros(torch.Size([len(numbers)]))) if content is None else content
            begin, end = max(entry["begin"], first), entry["end"]
            content[begin - first : end - first] = _rows(rows, slice(begin - entry["begin"], None))
            readable[begin - first : end - first] = True
        targets: TensorDictBase | None = None
        for part in sorted({entry["part"] for entry in files["targets"]}):
            entries = [entry for entry in files["targets"] if entry["part"] == part]
            try:
                targets = self._read_targets(entries, len(numbers), targets)
            except DamagedFileError as error:  # which rows of this part it holds is not known
                faults.append(str(error))
                readable &= position // -(-capacity // PARTS) != part  # also those that came after its base
        begin, end = _longest(readable)
        if len(buffer):
            buffer.empty()
        if content is not None and end > begin:
            if targets is not None:
                content.update(_rows(targets, position))
            buffer.extend(_rows(content, slice(begin, end)))
        self.saved = _Saved()
        return faults

    def _read_rows(self, files: Mapping[str, Any]) -> TensorDictBase:
        """The rows that are still in the buffer, in the order of their writing, without their targets."""
        rows = cast(TensorDictBase, torch.cat([self._read(entry) for entry in files["rows"]]))
        overwritten = max(files["written"] - files["capacity"], 0) - files["rows"][0]["begin"]  # of the oldest file
        return _rows(rows, slice(overwritten, None))

    def _read_targets(
        self, entries: Iterable[Mapping[str, Any]], count: int, content: TensorDictBase | None = None
    ) -> TensorDictBase | None:
        """The targets of every row of the buffer, or ``None`` if it has none: each part's base, then its changes."""
        for entry in entries:
            change = self._read(entry)
            begin = entry.get("begin")  # a base is a range of rows, a change lists them
            index = change.pop("index").long() if begin is None else slice(begin, begin + entry["rows"])
            if content is None:
                content = cast(TensorDictBase, change.new_zeros(torch.Size([count])))
            content[index] = change
        return content

    def _read(self, entry: Mapping[str, Any]) -> TensorDict:
        if Path(entry["file"]).name != entry["file"]:
            raise DamagedFileError(f"{self.folder} has no file {entry['file']!r}: that is not a name.")
        content = read_tensors(self.folder / entry["file"], entry)
        return TensorDict(content, [len(next(iter(_leaves(content))))])

    def prune(self, kept: Iterable[Mapping[str, Any]]) -> None:
        """Removes the files that none of the lists names.

        Args:
            kept (iterable of mapping): what :meth:`save` returned, for every state that should stay loadable.
        """
        named = {entry["file"] for files in kept for part in ("rows", "targets") for entry in files[part]}
        remove_partial_files(self.folder)
        for file in self.folder.glob("*.pt"):
            if file.name not in named:
                file.unlink(missing_ok=True)


def _longest(flags: Tensor) -> tuple[int, int]:
    """Begin and end of the longest stretch of true flags."""
    edges = torch.cat([flags.new_zeros(1), flags, flags.new_zeros(1)]).long().diff()
    begins, ends = (edges == 1).nonzero().flatten(), (edges == -1).nonzero().flatten()
    if not len(begins):
        return 0, 0
    best = (ends - begins).argmax()
    return int(begins[best]), int(ends[best])


def _leaves(content: Mapping[str, Any]) -> Iterable[Tensor]:
    for value in content.values():
        yield from _leaves(value) if isinstance(value, Mapping) else (value,)


def _rows(stored: TensorDictBase, index: Tensor | slice) -> TensorDictBase:
    return stored[index]  # pyright: ignore[reportReturnType]  # typed as if it could be a leaf


def _fingerprints(targets: TensorDictBase) -> Tensor:
    """One int64 for the bits of every row: their sum with odd weights, modulo 2^64.

    Of rows that differ in one number they always differ; in several, but for one chance in 2^32 or less.
    """
    draws = torch.Generator().manual_seed(0)
    total = torch.zeros(len(targets), dtype=torch.int64, device=targets.device)
    for key in sorted(targets.keys(True, True), key=str):
        bits = targets.get(key).reshape(len(targets), -1).contiguous()
        bits = bits.view(torch.int32 if bits.element_size() % 4 == 0 else torch.uint8)
        odd = (torch.randint(-(2**62), 2**62, bits.shape[1:], generator=draws) * 2 + 1).to(bits.device)
        for start in range(0, len(bits), ROWS_PER_FILE):  # products are twice as large as what they are of
            total[start : start + ROWS_PER_FILE] += (bits[start : start + ROWS_PER_FILE] * odd).sum(-1)
    return total


def _write_count(buffer: TensorDictReplayBuffer) -> int:
    """How many rows were ever written to the buffer, round the ring: what a writer stores of itself."""
    storage, writer = buffer.storage, buffer.writer
    if not isinstance(storage, TensorStorage) or storage.ndim > 1 or not isinstance(writer, RoundRobinWriter):
        raise TypeError(
            f"a buffer of {type(storage).__name__}(ndim={storage.ndim}) and {type(writer).__name__} cannot be saved "
            "row by row; use LazyTensorStorage(capacity) or LazyMemmapStorage(capacity), TensorDictRoundRobinWriter."
        )
    state = writer.state_dict()
    written, capacity = int(state["_write_count"]), storage.max_size
    if len(storage) != min(written, capacity) or state["_cursor"] != written % capacity:
        raise ValueError(
            f"{written} rows were written to the buffer, but it holds {len(storage)} of {capacity} and goes on at row "
            f"{state['_cursor']}; write to it by add and extend alone, and empty it by empty()."
        )
    return written


def _device(buffer: TensorDictReplayBuffer) -> torch.device | str:
    device = getattr(buffer.storage, "device", "cpu")
    return "cpu" if device == "auto" else device
