"""The mixture of depths by gradient steps on its weights, as the thesis proposes it (thesis 4.7).

The package solves it in closed form (:func:`~torchrl_etdmpc.functional.adaptive_mixture`); these are to compare with.
"""

from __future__ import annotations

import torch
from torch import Tensor


def objective(weights: Tensor, mean: Tensor, std: Tensor, beta: float) -> Tensor:
    """Thesis Eq. 4.14 without the maximum, ``[...]``, of weights ``[..., H]``."""
    return (weights * mean).sum(-1) - beta * (weights * std).norm(dim=-1)


def _gradient(weights: Tensor, mean: Tensor, std: Tensor, beta: float) -> Tensor:
    return mean - beta * std.square() * weights / (weights * std).norm(dim=-1, keepdim=True)


def _scale(mean: Tensor, std: Tensor, beta: float) -> Tensor:
    """So that one step size means the same for returns of any size."""
    return (mean.amax(-1) - mean.amin(-1) + beta * std.amax(-1)).clamp_min(1e-12).unsqueeze(-1)


def softmax_ascent(mean: Tensor, std: Tensor, beta: float, iterations: int, rate: float) -> Tensor:
    """Weights ``[..., H]`` after gradient steps on their logits, from equal weights."""
    logits = torch.zeros_like(mean)
    scale = _scale(mean, std, beta)
    for _ in range(iterations):
        weights = logits.softmax(-1)
        gradient = _gradient(weights, mean, std, beta)
        logits = (
            logits + rate * mean.shape[-1] * weights * (gradient - (weights * gradient).sum(-1, keepdim=True)) / scale
        )
    return logits.softmax(-1)


def projected_ascent(mean: Tensor, std: Tensor, beta: float, iterations: int, rate: float) -> Tensor:
    """Weights ``[..., H]`` after gradient steps, each projected onto the simplex, from equal weights."""
    weights = torch.full_like(mean, 1 / mean.shape[-1])
    scale = _scale(mean, std, beta)
    for _ in range(iterations):
        weights = project(weights + rate * _gradient(weights, mean, std, beta) / scale)
    return weights


def project(points: Tensor) -> Tensor:
    """Nearest points of the simplex, ``[..., H]``.

    >>> project(torch.tensor([0.6, 1.0, -3.0])).tolist()
    [0.30000001192092896, 0.699999988079071, 0.0]
    """
    ordered = points.sort(dim=-1, descending=True).values
    count = torch.arange(1, points.shape[-1] + 1, dtype=points.dtype)
    excess = (ordered.cumsum(-1) - 1) / count
    support = (ordered > excess).sum(-1, keepdim=True)
    return (points - excess.gather(-1, support - 1)).clamp_min(0)
