"""Replay: slice sampling and reanalyze."""

from torchrl_etdmpc.replay.reanalyze import ReanalyzeTransform
from torchrl_etdmpc.replay.slices import StepSliceSampler, UniformOver

__all__ = ["ReanalyzeTransform", "StepSliceSampler", "UniformOver"]
