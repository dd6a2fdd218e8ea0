"""Replay: slice sampling and reanalyze."""

from torchrl_etdmpc.replay.reanalyze import ReanalyzeTransform
from torchrl_etdmpc.replay.slices import StepSliceSampler

__all__ = ["ReanalyzeTransform", "StepSliceSampler"]
