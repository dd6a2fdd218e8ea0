"""Replay: slice sampling, reanalyze, and a buffer on disk."""

from torchrl_etdmpc.replay.journal import ReplayJournal
from torchrl_etdmpc.replay.reanalyze import ReanalyzeTransform
from torchrl_etdmpc.replay.slices import StepSliceSampler, UniformOver

__all__ = ["ReanalyzeTransform", "ReplayJournal", "StepSliceSampler", "UniformOver"]
