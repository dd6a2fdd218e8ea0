"""Checkpoints: what a run goes on from, as named parts and one buffer."""

from torchrl_etdmpc.checkpoints.journal import ReplayJournal
from torchrl_etdmpc.checkpoints.store import CheckpointError, CheckpointStore, DamagedBufferError, Part

__all__ = ["CheckpointError", "CheckpointStore", "DamagedBufferError", "Part", "ReplayJournal"]
