"""The checkpoints of one run: each is whole or not there, and shares the replay files with the others.

==========================  ================================================================================
``last.pt``                 the agent of the newest checkpoint, see :func:`save_checkpoint`
``best.pt``                 the agent of the checkpoint with the best evaluation before it
``resume/<env steps>/``     ``agent.pt``; ``run.pt``, everything else that the continuation depends on; and
                            ``manifest.json``, which names every file with its checksum
``replay/``                 the buffer, see :class:`~torchrl_etdmpc.replay.ReplayJournal`
==========================  ================================================================================
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from torchrl.data import TensorDictReplayBuffer

from torchrl_etdmpc.replay.journal import DamagedFileError, ReplayJournal, read_checked, write_checked
from torchrl_etdmpc.training.atomic_file import replacing
from torchrl_etdmpc.training.builders import Agent
from torchrl_etdmpc.training.checkpoint import CheckpointError, load_state, read_checkpoint, save_checkpoint
from torchrl_etdmpc.training.config import TrainConfig
from torchrl_etdmpc.training.versions import library_versions

FORMAT = 2


class Restored(NamedTuple):
    """A checkpoint that was found whole."""

    folder: Path
    counters: dict[str, int | float]
    state: dict[str, Any]


class CheckpointStore:
    """Saves and restores a run under ``folder``.

    Args:
        folder (str or Path): ``RUN_DIR/checkpoints``.

    Keyword Args:
        keep (int): checkpoints to go on from that are kept; if the newest is damaged, the one before serves.
    """

    def __init__(self, folder: str | Path, *, keep: int = 2) -> None:
        self.folder = Path(folder)
        self.keep = keep
        self.journal = ReplayJournal(self.folder / "replay")

    def save(
        self,
        agent: Agent,
        config: TrainConfig,
        counters: Mapping[str, int | float],
        buffer: TensorDictReplayBuffer,
        state: Mapping[str, Any],
        *,
        best: bool = False,
    ) -> Path:
        """Writes a checkpoint; what was saved before stays usable until the new one is in place.

        Args:
            agent (Agent): weights and optimiser.
            config (TrainConfig): the run.
            counters (mapping): with ``env_steps``, which names the checkpoint.
            buffer (TensorDictReplayBuffer): the run's.
            state (mapping): the rest, tensors and plain containers.

        Keyword Args:
            best (bool): whether this agent is the best so far.

        Returns:
            Path: the checkpoint's folder.

        Raises:
            OSError: if it cannot be written; nothing is left of the attempt.
        """
        target = self.folder / "resume" / f"{counters['env_steps']:012d}"
        partial = target.with_name(f".{target.name}.partial")
        before = dict(self.journal.state)
        try:
            shutil.rmtree(partial, ignore_errors=True)
            partial.mkdir(parents=True)
            version = int(agent.world_model.version)
            manifest = {
                "format": FORMAT,
                "counters": dict(counters),
                "config": config.to_dict(),
                "versions": library_versions(),
                "replay": self.journal.save(buffer, version=version),
            }
            save_checkpoint(partial / "agent.pt", agent, config, dict(counters))
            with (partial / "agent.pt").open("rb") as file:
                agent_sha = hashlib.file_digest(file, "sha256").hexdigest()
            manifest["files"] = {"agent.pt": agent_sha, "run.pt": write_checked(partial / "run.pt", dict(state))}
            (partial / "manifest.json").write_text(json.dumps(manifest), encoding="utf-8")
            for name in ("manifest.json", "agent.pt"):
                _sync(partial / name)
            if best:  # before the checkpoint that says so
                _link(partial / "agent.pt", self.folder / "best.pt")
            if target.exists():  # the same step again, e.g. in pretraining
                os.replace(target, target.with_name(f".{target.name}.old"))
            os.replace(partial, target)
            _sync(target.parent)
            _link(target / "agent.pt", self.folder / "last.pt")
        except BaseException:
            self.journal.state = before
            shutil.rmtree(partial, ignore_errors=True)
            self._prune()
            raise
        self._prune()
        return target

    def load(self, agent: Agent, buffer: TensorDictReplayBuffer) -> Restored:
        """Restores agent and buffer from the newest checkpoint that is whole, and returns the rest.

        Raises:
            CheckpointError: if there is none; its text says what is wrong with each.
        """
        faults = []
        for folder in reversed(self._folders()):
            try:
                manifest = self._manifest(folder)
                content = self._agent(folder, manifest)
                state = read_checked(folder / "run.pt", manifest["files"]["run.pt"])
                self.journal.load(buffer, manifest["replay"])
            except (DamagedFileError, CheckpointError, KeyError, OSError) as error:
                faults.append(str(error) if str(error) else type(error).__name__)
                continue
            load_state(agent, content)
            for fault in faults:
                warnings.warn(f"going on from {folder}, because {fault}", stacklevel=2)
            return Restored(folder, manifest["counters"], state)
        reason = "; ".join(faults) or f"there is no checkpoint under {self.folder}"
        raise CheckpointError(f"cannot resume: {reason.rstrip('.')}.")

    def exists(self) -> bool:
        """Whether there is something to go on from. Changes nothing: another process may be training here."""
        return any((self.folder / "resume").glob("[0-9]*")) or any((self.folder / "resume").glob(".*.old"))

    def _folders(self) -> list[Path]:
        for old in (self.folder / "resume").glob(".*.old"):  # moved aside for one of the same step
            target = old.with_name(old.name[1:].removesuffix(".old"))
            if target.exists():
                shutil.rmtree(old, ignore_errors=True)
            else:
                os.replace(old, target)
        return sorted((self.folder / "resume").glob("[0-9]*"))

    @staticmethod
    def _manifest(folder: Path) -> dict[str, Any]:
        try:
            manifest = json.loads((folder / "manifest.json").read_text(encoding="utf-8"))
            number = manifest["format"]
        except (ValueError, KeyError, TypeError, OSError) as error:
            raise CheckpointError(f"{folder}/manifest.json is missing or damaged") from error
        if number != FORMAT:
            raise CheckpointError(f"{folder} has checkpoint format {number}; this version resumes from {FORMAT}")
        return manifest

    @staticmethod
    def _agent(folder: Path, manifest: dict[str, Any]) -> dict[str, Any]:
        path = folder / "agent.pt"
        with path.open("rb") as file:
            if hashlib.file_digest(file, "sha256").hexdigest() != manifest["files"]["agent.pt"]:
                raise DamagedFileError(f"{path} is not the file that was written: it is cut off or damaged")
        return read_checkpoint(path)

    def _prune(self) -> None:
        """Removes old checkpoints, and the replay files that no checkpoint needs."""
        folders = self._folders()
        for folder in [*folders[: -self.keep], *(self.folder / "resume").glob(".*.partial")]:
            shutil.rmtree(folder, ignore_errors=True)
        for file in self.folder.glob(".*.partial"):  # of a process that was killed
            file.unlink(missing_ok=True)
        kept = []
        for folder in folders[-self.keep :]:
            try:
                kept.append(self._manifest(folder)["replay"])
            except (CheckpointError, KeyError):
                return  # better too many files than too few
        self.journal.prune(kept)


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _link(source: Path, target: Path) -> None:
    """Makes ``target`` the same file, or a copy where the file system has no links."""
    with replacing(target) as partial:
        try:
            os.link(source, partial)
        except OSError:
            shutil.copyfile(source, partial)
