"""What goes into a plan and what comes out: frozen containers with a shape per field."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor


class PlanNoise(NamedTuple):
    """Every random number of one planning call.

    >>> from torchrl_etdmpc import EnsembleMPPIPlanner, LatentEnv
    >>> from torchrl_etdmpc.testing import LineWorld
    >>> planner = EnsembleMPPIPlanner(LatentEnv(LineWorld()), horizon=3, num_samples=32, num_elites=8, num_proposals=4)
    >>> planner.draw_noise(5).candidates.shape  # of five states
    torch.Size([5, 6, 28, 3, 1])
    """

    proposals: Tensor
    """Standard normal, ``[..., P, H, A]``."""
    candidates: Tensor
    """Standard normal, ``[..., I, N - P, H, A]``, one block per iteration."""
    elite: Tensor
    """Uniform on [0, 1), ``[..., K]``, in single precision at least: picks the elite."""
    action: Tensor
    """Standard normal, ``[..., A]``: the exploration of a training action."""
    bootstrap: Tensor
    """Standard normal, ``[..., I, N, D, F, A]``: the policy's action at every latent where an
    :class:`~torchrl_etdmpc.modules.ActionValueModel` bootstraps. Any other model draws nothing: ``[..., 0]``."""
    heads: Tensor
    """Uniform on [0, 1), ``[..., I, V]``: the largest pick the heads that bootstrap; likewise ``[..., 0]``."""


class PlanTrace(NamedTuple):
    """Every iteration of a planning call, for inspection.

    >>> import torch
    >>> from torchrl_etdmpc import EnsembleMPPIPlanner, LatentEnv
    >>> from torchrl_etdmpc.testing import LineWorld
    >>> planner = EnsembleMPPIPlanner(LatentEnv(LineWorld()), horizon=3, num_samples=32, num_elites=8, num_proposals=4)
    >>> planner.plan(torch.zeros(5, 1), trace=True).trace.scores.shape
    torch.Size([5, 6, 32])
    """

    actions: Tensor
    """Candidates, the policy's proposals first, ``[..., I, N, H, A]``."""
    scores: Tensor
    """``[..., I, N]``"""
    returns: Tensor
    """Return table, ``[..., I, N, D, F, V]``."""
    mean: Tensor
    """Mean after each iteration, ``[..., I, H, A]``."""
    std: Tensor
    """Standard deviation after each iteration, ``[..., I, H, A]``."""


class Plan(NamedTuple):
    """Result of a planning call.

    >>> import torch
    >>> from torchrl_etdmpc import EnsembleMPPIPlanner, LatentEnv
    >>> from torchrl_etdmpc.testing import LineWorld
    >>> planner = EnsembleMPPIPlanner(LatentEnv(LineWorld()), horizon=3, num_samples=32, num_elites=8, num_proposals=4)
    >>> plan = planner.plan(torch.zeros(5, 1))
    >>> plan.action.shape, plan.mean.shape, plan.trace
    (torch.Size([5, 1]), torch.Size([5, 3, 1]), None)
    """

    action: Tensor
    """Action to take: a sample in training, ``loc`` in evaluation, ``[..., A]``."""
    loc: Tensor
    """Mean of the policy target, ``[..., A]``."""
    scale: Tensor
    """Standard deviation of the policy target, ``[..., A]``."""
    value: Tensor
    """Score of the chosen sequence (elite-weighted score with ``first_action="mean"``), ``[...]``; NaN on fallback."""
    mean: Tensor
    """Mean of the last iteration, the next call's warm start, ``[..., H, A]``."""
    fallback: Tensor
    """Whether no candidate of the last iteration had a finite score, ``[...]``: the policy acted instead, or, where
    there is none, the last plan with finite scores, which may be the warm start."""
    trace: PlanTrace | None
    """Every iteration, if asked for."""
