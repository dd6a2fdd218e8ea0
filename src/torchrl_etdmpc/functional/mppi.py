"""The pieces of model predictive path integral control (MPPI; thesis 3.2 and Table A.1, details from TD-MPC2)."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchrl_etdmpc.functional.gaussian import clipped_sample


class Gaussian(NamedTuple):
    """Diagonal Gaussian over action sequences.

    >>> plan = Gaussian(mean=torch.zeros(3, 2), std=torch.ones(3, 2))  # H = 3, A = 2
    >>> plan.mean.shape
    torch.Size([3, 2])
    """

    mean: Tensor
    """``[..., H, A]``"""
    std: Tensor
    """``[..., H, A]``"""


class Elites(NamedTuple):
    """The best candidates and their scores, in descending order.

    >>> Elites(actions=torch.zeros(8, 3, 2), scores=torch.zeros(8)).scores.shape  # K = 8
    torch.Size([8])
    """

    actions: Tensor
    """``[..., K, H, A]``"""
    scores: Tensor
    """``[..., K]``; minus infinity where a candidate's score was not finite."""


def shift_plan(mean: Tensor) -> Tensor:
    """Moves a plan one step ahead: drops its first action, appends zeros (TD-MPC2's warm start).

    Args:
        mean (Tensor): the previous plan, shape ``[..., H, A]``.

    Returns:
        Tensor: shape ``[..., H, A]``.

    >>> shift_plan(torch.tensor([[1.0], [2.0]])).tolist()
    [[2.0], [0.0]]
    """
    return torch.cat([mean[..., 1:, :], torch.zeros_like(mean[..., :1, :])], dim=-2)


def sample_sequences(plan: Gaussian, noise: Tensor) -> Tensor:
    """Draws candidate action sequences, clipped to [-1, 1].

    Args:
        plan (Gaussian): mean and std of shape ``[..., H, A]``.
        noise (Tensor): standard normal draws, shape ``[..., N, H, A]``.

    Returns:
        Tensor: actions, shape ``[..., N, H, A]``.

    >>> plan = Gaussian(torch.zeros(1, 1), torch.ones(1, 1))
    >>> sample_sequences(plan, torch.tensor([[[0.5]], [[4.0]]])).flatten().tolist()
    [0.5, 1.0]
    """
    return clipped_sample(plan.mean.unsqueeze(-3), plan.std.unsqueeze(-3), noise)


def select_elites(actions: Tensor, scores: Tensor, num_elites: int) -> Elites:
    """The candidates with the highest scores; a non-finite score counts as the worst score.

    Where fewer than ``num_elites`` scores are finite, the remaining places have a score of minus infinity (weight zero)
    and zero actions, so that nothing non-finite can enter an average.

    Args:
        actions (Tensor): candidate action sequences, shape ``[..., N, H, A]``.
        scores (Tensor): shape ``[..., N]``.
        num_elites (int): K, at most N.

    Returns:
        Elites: actions ``[..., K, H, A]`` and scores ``[..., K]``.

    >>> select_elites(torch.zeros(3, 1, 1), torch.tensor([1.0, float("nan"), 2.0]), 2).scores.tolist()
    [2.0, 1.0]
    """
    # Departure from BMPC and TD-MPC2, whose code replaces a non-finite score by 0: where returns are negative, 0 beats
    # every candidate.
    scores = torch.where(scores.isfinite(), scores, -torch.inf)
    top, index = scores.topk(num_elites, dim=-1)
    index = index[..., None, None].expand(*index.shape, *actions.shape[-2:])
    elites = actions.gather(-3, index)
    return Elites(torch.where(top.isfinite()[..., None, None], elites, 0), top)


def elite_weights(scores: Tensor, inverse_temperature: float) -> Tensor:
    """Weights of the elites, ``softmax(inverse_temperature * score)``.

    Args:
        scores (Tensor): elite scores, minus infinity for a place without a candidate, shape ``[..., K]``.
        inverse_temperature (float): >= 0. TD-MPC2 calls it ``temperature``.

    Returns:
        Tensor: shape ``[..., K]``; uniform where no score is finite.

    >>> elite_weights(torch.tensor([0.0, -torch.inf]), 0.5).tolist()
    [1.0, 0.0]
    """
    finite = scores.isfinite()
    logits = torch.where(finite, inverse_temperature * scores, -torch.inf)  # scaled first: 0 * -inf is NaN
    return torch.softmax(torch.where(finite.any(-1, keepdim=True), logits, 0), dim=-1)


def fit_gaussian(actions: Tensor, weights: Tensor, *, std_min: float, std_max: float) -> Gaussian:
    """Weighted mean and standard deviation of the elites.

    Args:
        actions (Tensor): elite action sequences, shape ``[..., K, H, A]``.
        weights (Tensor): summing to one over K, shape ``[..., K]``.
        std_min (float): lower bound of the standard deviation.
        std_max (float): upper bound of the standard deviation.

    Returns:
        Gaussian: mean and std of shape ``[..., H, A]``.

    >>> fit_gaussian(torch.tensor([[[0.0]], [[1.0]]]), torch.tensor([0.5, 0.5]), std_min=0.05, std_max=2.0).std.item()
    0.5
    """
    weights = weights[..., None, None]
    mean = (weights * actions).sum(-3)
    variance = (weights * (actions - mean.unsqueeze(-3)).square()).sum(-3)
    return Gaussian(mean, variance.sqrt().clamp(std_min, std_max))


def sample_elite(weights: Tensor, uniform: Tensor) -> Tensor:
    """Index of one elite, drawn with its weight by the Gumbel-max trick.

    Args:
        weights (Tensor): shape ``[..., K]``.
        uniform (Tensor): draws from U[0, 1), shape ``[..., K]``.

    Returns:
        Tensor: int64 index, shape ``[...]``; never a place of weight zero.

    >>> sample_elite(torch.tensor([0.0, 1.0]), torch.rand(2)).item()
    1
    """
    tiny = torch.finfo(uniform.dtype).tiny
    gumbel = -(-uniform.clamp_min(tiny).log()).clamp_min(tiny).log()
    return (weights.log() + gumbel).argmax(-1)
