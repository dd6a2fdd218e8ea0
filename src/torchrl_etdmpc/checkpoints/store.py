"""The checkpoints of one run: each is whole or not there, and shares the files of the buffer with the others.

==========================  ================================================================================
``resume/<step>/``          one file for each part, and ``manifest.json``, which names every file with its
                            checksum, and has one itself
``replay/``                 the buffer, see :class:`~torchrl_etdmpc.checkpoints.ReplayJournal`
==========================  ================================================================================
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import warnings
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Protocol

from tensordict import NestedKey, TensorDictBase
from torchrl.data import TensorDictReplayBuffer

from torchrl_etdmpc.checkpoints.journal import ReplayJournal
from torchrl_etdmpc.keys import PLAN
from torchrl_etdmpc.runs.errors import first_line
from torchrl_etdmpc.runs.files import (
    DamagedFileError,
    link,
    read_tensors,
    read_whole,
    remove_partial_files,
    require_readable,
    sync,
    write_tensors,
    write_whole,
)

FORMAT = 4
_MANIFEST_BYTES = 2**26


class CheckpointError(RuntimeError):
    """A file that cannot be used as a checkpoint, and why."""


class DamagedBufferError(CheckpointError):
    """No checkpoint is whole, but of at least one it is only the buffer that is damaged."""


class Part(Protocol):
    """Anything that owns a state.

    >>> import torch
    >>> part: Part = torch.nn.Linear(2, 2)
    >>> sorted(part.state_dict())
    ['bias', 'weight']
    """

    def state_dict(self) -> Mapping[str, Any]:
        """Tensors and plain containers."""
        ...

    def load_state_dict(self, state_dict: Any) -> Any:
        """Goes back to where :meth:`state_dict` was called."""
        ...


class CheckpointStore:
    """Saves and restores named parts and one buffer under ``folder``.

    Args:
        folder (str or Path): made if missing.

    Keyword Args:
        keep (int): checkpoints that are kept; if the newest is damaged, the one before serves. Default: 2.
        plan_key (NestedKey): group of the planner's targets in the rows, which reanalyze writes anew; see
            :class:`ReplayJournal`. Default: ``"plan"``.

    >>> import tempfile, torch
    >>> from torchrl.data import LazyTensorStorage
    >>> layer, buffer = torch.nn.Linear(2, 1), TensorDictReplayBuffer(storage=LazyTensorStorage(10))
    >>> store = CheckpointStore(tempfile.mkdtemp())
    >>> _ = store.save(100, {"layer": layer}, buffer)
    >>> store.load({"layer": torch.nn.Linear(2, 1)}, buffer).name
    '000000000100'
    """

    def __init__(self, folder: str | Path, *, keep: int = 2, plan_key: NestedKey = PLAN) -> None:
        if keep < 1:
            raise ValueError(f"keep must be at least 1, got {keep}.")
        self.folder = Path(folder)
        self.keep = keep
        self.journal = ReplayJournal(self.folder / "replay", plan_key=plan_key)
        self._readable: set[str] = set()
        """Parts whose first state could be read back."""

    def save(
        self,
        step: int,
        parts: Mapping[str, Part],
        buffer: TensorDictReplayBuffer,
        *,
        links: Mapping[Path, str] | None = None,
    ) -> Path:
        """Writes a checkpoint; what was saved before stays usable until the new one is in place.

        Args:
            step (int): names the checkpoint; the highest is the newest. Those of higher steps go: a run that went on
                from an older one has lost them.
            parts (mapping): name to owner of a state; a name is a file name.
            buffer (TensorDictReplayBuffer): the same one at every call.

        Keyword Args:
            links (mapping, optional): path to the name of the part whose file it becomes, e.g. ``last.pt`` the agent's.

        Returns:
            Path: the checkpoint's folder.

        Raises:
            OSError: if it cannot be written; nothing is left of the attempt.
            TypeError: if the state of a part holds more than tensors and plain containers, which no load would read.
        """
        target = self.folder / "resume" / f"{step:012d}"
        partial = target.with_name(f".{target.name}.partial")
        before = self.journal.saved
        try:
            shutil.rmtree(partial, ignore_errors=True)
            partial.mkdir(parents=True)
            replay = self.journal.save(buffer)
            files = {}
            for name, part in parts.items():
                state = dict(part.state_dict())
                if name not in self._readable:
                    require_readable(state, f"the state of the part {name!r}")
                    self._readable.add(name)
                files[name] = write_tensors(partial / f"{name}.pt", state)
            manifest = {"format": FORMAT, "files": files, "replay": replay}
            write_whole(partial / "manifest.json", json.dumps(manifest | {"sha256": _checksum(manifest)}))
            for path, name in (links or {}).items():  # before the checkpoint: its parts may say that this was done
                link(partial / f"{name}.pt", path)
            if target.exists():  # the same step again, e.g. in pretraining
                os.replace(target, target.with_name(f".{target.name}.old"))
            os.replace(partial, target)
            sync(target.parent)
        except BaseException:
            self.journal.saved = before  # its new files belong to nothing, and the next save must write those rows
            shutil.rmtree(partial, ignore_errors=True)
            self._prune()
            raise
        for folder in self._folders():
            if folder.name > target.name:
                shutil.rmtree(folder, ignore_errors=True)
        self._prune()
        return target

    def load(self, parts: Mapping[str, Part], buffer: TensorDictReplayBuffer) -> Path:
        """Restores the buffer, then the parts in their order, from the newest checkpoint that is whole.

        Returns:
            Path: the checkpoint's folder.

        Raises:
            CheckpointError: if there is none; its text says what is wrong with each. It is a
                :class:`DamagedBufferError` where :meth:`salvage` may help.
            ValueError: if rows do not fit into the buffer; see :meth:`ReplayJournal.load`.
        """
        faults, kind = [], CheckpointError
        for folder in reversed(self._folders()):
            try:
                states, manifest = self._read(folder, parts)
                kind = DamagedBufferError
                self.journal.load(buffer, manifest["replay"])
            except (DamagedFileError, CheckpointError) as error:
                faults.append(str(error).rstrip("."))
                continue
            _restore(folder, parts, states)
            for fault in faults:
                warnings.warn(f"going on from {folder}, because {fault}.", stacklevel=2)
            return folder
        raise kind(f"cannot resume: {self._reason(faults)}.")

    def salvage(self, parts: Mapping[str, Part], buffer: TensorDictReplayBuffer) -> Path:
        """Restores parts from the newest checkpoint whose parts are whole, and what is left of its buffer.

        The buffer gets the longest stretch of rows that can be read, as if they were new. What is lost is a warning.

        Returns:
            Path: the checkpoint's folder.

        Raises:
            CheckpointError: if there is none.
        """
        faults = []
        for folder in reversed(self._folders()):
            try:
                states, manifest = self._read(folder, parts)
            except (DamagedFileError, CheckpointError) as error:
                faults.append(str(error).rstrip("."))
                continue
            damage = self.journal.salvage(buffer, manifest["replay"])
            saved = min(manifest["replay"]["written"], manifest["replay"]["capacity"])
            _restore(folder, parts, states)
            why = "".join(f"; {fault.rstrip('.')}" for fault in (*faults, *damage))
            warnings.warn(
                f"going on from {folder} with its weights and {len(buffer):,} of {saved:,} rows of its buffer{why}.",
                stacklevel=2,
            )
            return folder
        raise CheckpointError(f"cannot resume: {self._reason(faults)}.")

    def _read(self, folder: Path, parts: Iterable[str]) -> tuple[dict[str, Any], dict[str, Any]]:
        """The states of a checkpoint's parts, and its manifest."""
        manifest = _read_manifest(folder)
        missing = sorted(set(parts) - manifest["files"].keys())
        if missing:
            raise CheckpointError(f"{folder} lacks {', '.join(missing)}")
        return {name: read_tensors(folder / f"{name}.pt", manifest["files"][name]) for name in parts}, manifest

    def _reason(self, faults: list[str]) -> str:
        return "; ".join(faults) or f"there is no checkpoint under {self.folder}"

    def buffer_rows(self) -> int:
        """How many rows the newest checkpoint's buffer holds; 0 without a checkpoint. Changes nothing.

        Raises:
            CheckpointError: if its manifest is damaged.
        """
        files = self._newest_buffer()
        return 0 if files is None else min(files["written"], files["capacity"])

    def read_row(self, row: int) -> TensorDictBase:
        """A row of the newest checkpoint's buffer, see :meth:`ReplayJournal.read_row`. Changes nothing.

        Raises:
            CheckpointError: if there is no checkpoint, or it is damaged.
            IndexError: if there is no such row.
        """
        files = self._newest_buffer()
        if files is None:
            raise CheckpointError(f"there is no checkpoint under {self.folder}, so no buffer to read.")
        try:
            return self.journal.read_row(files, row)
        except DamagedFileError as error:
            raise CheckpointError(str(error)) from error

    def _newest_buffer(self) -> Mapping[str, Any] | None:
        folders = sorted((self.folder / "resume").glob("[0-9]*"))
        return _read_manifest(folders[-1])["replay"] if folders else None

    def exists(self) -> bool:
        """Whether there is something to go on from. Changes nothing: another process may be training here."""
        return self.newest_step() is not None

    def newest_step(self) -> int | None:
        """Step of the newest checkpoint, whole or not; ``None`` if there is none. Changes nothing, either."""
        names = [path.name for pattern in ("[0-9]*", ".*.old") for path in (self.folder / "resume").glob(pattern)]
        steps = [name.removeprefix(".").removesuffix(".old") for name in names]
        return max((int(step) for step in steps if step.isdecimal()), default=None)

    def _folders(self) -> list[Path]:
        for old in (self.folder / "resume").glob(".*.old"):  # moved aside for one of the same step
            target = old.with_name(old.name[1:].removesuffix(".old"))
            if target.exists():
                shutil.rmtree(old, ignore_errors=True)
            else:
                os.replace(old, target)
        return sorted((self.folder / "resume").glob("[0-9]*"))

    def _prune(self) -> None:
        """Removes old checkpoints, and the replay files that no checkpoint needs."""
        folders = self._folders()
        for folder in [*folders[: -self.keep], *(self.folder / "resume").glob(".*.partial")]:
            shutil.rmtree(folder, ignore_errors=True)
        remove_partial_files(self.folder)
        kept = []
        for folder in folders[-self.keep :]:
            try:
                kept.append(_read_manifest(folder)["replay"])
            except CheckpointError:
                return  # better too many files than too few
        self.journal.prune(kept)


def _restore(folder: Path, parts: Mapping[str, Part], states: Mapping[str, Any]) -> None:
    for name, part in parts.items():
        try:
            part.load_state_dict(states[name])
        except (RuntimeError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise CheckpointError(f"{folder}/{name}.pt does not fit this run: {first_line(error)}") from error


def _read_manifest(folder: Path) -> dict[str, Any]:
    try:
        manifest = json.loads(read_whole(folder / "manifest.json", _MANIFEST_BYTES))
        number = manifest["format"]
    except (ValueError, KeyError, TypeError, RecursionError, DamagedFileError) as error:
        raise CheckpointError(f"{folder}/manifest.json is missing or damaged") from error
    if number != FORMAT:
        raise CheckpointError(f"{folder} has checkpoint format {number}; this version resumes from {FORMAT}")
    if manifest.pop("sha256", None) != _checksum(manifest):
        raise CheckpointError(f"{folder}/manifest.json is missing or damaged")
    return manifest


def _checksum(manifest: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(manifest, sort_keys=True).encode()).hexdigest()
