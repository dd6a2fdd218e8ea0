"""Saving a run, and going on with one that was saved."""

from __future__ import annotations

import time
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torchrl import torchrl_logger
from torchrl.checkpoint import GlobalRNGState

from torchrl_etdmpc.checkpoints import CheckpointError, CheckpointStore, DamagedBufferError, Part
from torchrl_etdmpc.runs import RunDirectory
from torchrl_etdmpc.training.agent_file import BestAgent, read_agent_file
from torchrl_etdmpc.training.config import TrainConfig
from torchrl_etdmpc.training.learner import Learner


class RandomState(GlobalRNGState):
    """The generators of Python, NumPy and PyTorch; a run may go on where there are fewer GPUs, or none.

    >>> state = RandomState().state_dict()
    >>> RandomState().load_state_dict(state | {"torch_cuda": []})
    """

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Restores the generators of what is here, and warns of a GPU's that is not."""
        states = dict(state_dict)
        saved = states.pop("torch_cuda", [])
        here = saved[: torch.cuda.device_count()] if torch.cuda.is_available() else []
        if len(here) < len(saved):
            warnings.warn(
                f"the run was saved on a machine with {len(saved)} GPUs, here are {len(here)}: it goes on with other "
                "random numbers.",
                stacklevel=2,
            )
        super().load_state_dict(states | ({"torch_cuda": here} if here else {}))


class RunCheckpoints:
    """The checkpoints of one run: its parts and its buffer, written when asked and restored.

    Args:
        config (TrainConfig): how often, how many, and what may be gone on with.
        directory (RunDirectory): of the run.
        learner (Learner): has the buffer and the counts.
        best (BestAgent): its file is written here if the disk did not take it before.
        parts (mapping): what is saved and restored, in this order.
    """

    def __init__(
        self,
        config: TrainConfig,
        directory: RunDirectory,
        learner: Learner,
        best: BestAgent,
        parts: Mapping[str, Part],
    ) -> None:
        self.config, self.learner, self.best, self.parts = config, learner, best, parts
        self.store = CheckpointStore(directory.checkpoints, keep=config.checkpoint_keep)
        self._directory = directory
        self._links = {directory.last_agent: "agent"}
        self._agents = directory.last_agent, directory.best_agent
        self._saved_at, self._saved_step = time.perf_counter(), -1

    @property
    def overdue(self) -> bool:
        """Whether more than ``checkpoint_minutes`` have passed since the last one."""
        minutes = self.config.checkpoint_minutes
        return minutes is not None and time.perf_counter() - self._saved_at > 60 * minutes

    def save(self) -> bool:
        """Writes a checkpoint; one that cannot be written is a warning, and the next one is tried in its time.

        Returns:
            bool: whether it was written.

        Raises:
            OSError: if the first one cannot be: there would be nothing to go on from, and nothing is lost yet. Or if
                the directory is not this run's any more.
        """
        self._directory.require_held()
        try:
            self._write()
        except OSError as error:
            reason, steps = error.strerror or str(error), self.learner.env_steps
            if not steps:
                raise OSError(
                    f"no checkpoint can be written into {self.store.folder} ({reason}); make room, or choose another "
                    "run_dir."
                ) from error
            warnings.warn(f"no checkpoint at {steps} env steps ({reason}); training goes on.", stacklevel=2)
            return False
        return True

    def save_end(self) -> None:
        """Writes a checkpoint unless the newest one is of this step.

        Raises:
            OSError: if it cannot be written.
        """
        if self._saved_step != self.learner.env_steps:
            self._write()

    def _write(self) -> None:
        self._saved_at = time.perf_counter()
        self.best.write()
        learner = self.learner
        self.store.save(learner.env_steps, self.parts, learner.replay, links=self._links)
        self._saved_step = learner.env_steps

    def restore(self) -> None:
        """Goes on from the newest checkpoint, exactly as if nothing had happened.

        With ``resume=weights``, where no checkpoint is whole: from the newest weights and what is left of the buffer,
        in a fresh episode.

        Raises:
            CheckpointError: if there is none to go on from.
        """
        try:
            folder = self.store.load(self.parts, self.learner.replay)
        except DamagedBufferError as error:
            if self.config.resume != "weights":
                raise CheckpointError(
                    f"{error} resume=weights goes on with the weights and what is left of the buffer."
                ) from error
            folder = self._salvage()
        except CheckpointError as error:
            left = [str(path) for path in self._agents if _is_whole(path)]
            if not left:
                raise
            raise CheckpointError(
                f"{error} Start a new run; the agents of this one can still be evaluated: {', '.join(left)}."
            ) from error
        if self.learner.collector.begins_fresh:
            self._begin_elsewhere()
        self._saved_step = self.learner.env_steps
        torchrl_logger.info(f"going on from {folder} ({self._saved_step} env steps)")

    def _salvage(self) -> Path:
        replay, collector = self.learner.replay, self.learner.collector
        parts = {name: part for name, part in self.parts.items() if name != "sampler"}  # it follows the new rows
        folder = self.store.salvage(parts, replay)
        least = min(self.config.seed_decisions, collector.frames)
        if len(replay) < least:
            raise CheckpointError(
                f"cannot resume: {len(replay)} rows of the buffer are left, fewer than the {least} that learning "
                "begins with; start a new run."
            )
        self._begin_elsewhere()  # the buffer may end in another episode
        return folder

    def _begin_elsewhere(self) -> None:
        """Gives the environment another seed: with the run's own it would begin as the run did, at every resume.

        Not that of the evaluations either, which is 10,000 after the run's.
        """
        collector = self.learner.collector
        collector.set_seed((self.config.seed + 20_000 + collector.frames) % 2**32)


def _is_whole(path: Path) -> bool:
    try:
        read_agent_file(path)
    except (CheckpointError, OSError):
        return False
    return True
