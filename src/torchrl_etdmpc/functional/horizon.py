"""Reductions of the return table: mean, variance of the mean and lower bound of the ensemble, mixture of depths."""

from __future__ import annotations

import math

import torch
from torch import Tensor

SIGMA_FLOOR = 1e-6  # standard deviations below this count as this


def ensemble_mean(returns: Tensor) -> Tensor:
    """Mean over dynamics and value heads (thesis Eq. 3.2).

    Args:
        returns (Tensor): return estimates, shape ``[..., F, V]``.

    Returns:
        Tensor: shape ``[...]``.

    >>> ensemble_mean(torch.tensor([[1.0, 3.0]])).item()
    2.0
    """
    return returns.mean((-2, -1))


def ensemble_variance(returns: Tensor) -> Tensor:
    """Estimated variance of the ensemble mean, ``sum (Q - mean)^2 / (M (M - 1))`` with M = F V (thesis Eq. 3.3).

    Args:
        returns (Tensor): return estimates, shape ``[..., F, V]``.

    Returns:
        Tensor: variances, shape ``[...]``; zero when M = 1.

    >>> ensemble_variance(torch.tensor([[1.0, 3.0]])).item()
    1.0
    """
    members = returns.shape[-2] * returns.shape[-1]
    if members == 1:
        return torch.zeros_like(returns[..., 0, 0])
    deviation = returns - returns.mean((-2, -1), keepdim=True)
    return deviation.square().sum((-2, -1)) / (members * (members - 1))


def ensemble_std(returns: Tensor) -> Tensor:
    """Standard deviation of the heads' mean, the root of :func:`ensemble_variance` (thesis Eq. 3.3).

    Its gradient is 0, and not infinite, where all members agree, as new value heads do.

    Args:
        returns (Tensor): return estimates, shape ``[..., F, V]``.

    Returns:
        Tensor: shape ``[...]``; zero when M = 1.

    >>> ensemble_std(torch.tensor([[1.0, 5.0]])).item()
    2.0
    """
    variance = ensemble_variance(returns)
    agree = variance == 0
    return torch.where(agree, 0.0, torch.where(agree, 1.0, variance).sqrt())


def lower_confidence_bound(returns: Tensor, beta: float) -> Tensor:
    """``mean - beta * sigma`` over the heads (thesis 3.4.3); beta < 0 is optimism.

    Args:
        returns (Tensor): return estimates, shape ``[..., F, V]``.
        beta (float): weight of the standard deviation of the mean (thesis Eq. 3.3).

    Returns:
        Tensor: shape ``[...]``.

    >>> lower_confidence_bound(torch.tensor([[1.0, 3.0]]), beta=1.0).item()  # of two heads the lesser one
    1.0
    """
    mean = ensemble_mean(returns)
    return mean if beta == 0 else mean - beta * ensemble_std(returns)


def adaptive_mixture(mean: Tensor, std: Tensor, beta: float) -> tuple[Tensor, Tensor]:
    r"""Best lower confidence bound over convex mixtures of depths, exactly (thesis Eq. 4.14).

    Maximises ``w.q - beta sqrt(sum_h w_h^2 sigma_h^2)`` over the simplex. The thesis proposes a gradient-based
    solver; the optimum has a closed form. Stationarity gives ``w_h ~ max(q_h - lambda, 0) / sigma_h^2``, where the
    optimal value lambda is the unique root of ``sum_h (max(q_h - lambda, 0) / sigma_h)^2 = beta^2``. The left side
    falls in lambda, so the depths in the support are those h at which it is at most ``beta^2`` when lambda = q_h;
    the root over a known support is that of a quadratic.

    Args:
        mean (Tensor): q, mean return estimate of each depth, shape ``[..., H]``.
        std (Tensor): sigma, its standard deviation, shape ``[..., H]``; floored at ``SIGMA_FLOOR``.
        beta (float): weight of the standard deviation, >= 0; 0 gives ``max_h q_h``.

    Returns:
        tuple[Tensor, Tensor]: the optimal value, shape ``[...]``, and the weights, shape ``[..., H]``.

    Raises:
        ValueError: if beta is negative (the problem is then not concave) or not finite.

    >>> value, weights = adaptive_mixture(torch.tensor([1.0, 1.0]), torch.tensor([1.0, 1.0]), beta=1.0)
    >>> weights.tolist(), round(value.item(), 4)
    ([0.5, 0.5], 0.2929)
    """
    if not 0 <= beta < math.inf:
        raise ValueError(
            f"adaptive_mixture needs a finite beta >= 0, got {beta}; use the final or mean score for optimism."
        )
    if mean.dtype == torch.float16:  # in which the floor's square is 0
        value, weights = adaptive_mixture(mean.float(), std.float(), beta)
        return value.to(mean.dtype), weights.to(mean.dtype)
    best, best_depth = mean.max(-1, keepdim=True)
    one_hot = torch.zeros_like(mean).scatter(-1, best_depth, 1.0)
    if beta == 0:
        return best.squeeze(-1), one_hot
    precision = std.clamp_min(SIGMA_FLOOR).square().reciprocal()
    # Departure from the thesis, which proposes a gradient-based inner solver: the optimum has this closed form.
    excess = (mean.unsqueeze(-2) - mean.unsqueeze(-1)).clamp_min(0)  # [..., h, g] = max(q_g - q_h, 0)
    support = (precision.unsqueeze(-2) * excess.square()).sum(-1) <= beta**2
    weight = precision * support
    # Sums are relative to the support's most certain depth, whose small gap float32 would lose next to a large one.
    anchor = mean.gather(-1, weight.argmax(-1, keepdim=True))
    gap = mean - anchor
    total = weight.sum(-1, keepdim=True)
    centre = (weight * gap).sum(-1, keepdim=True) / total
    spread = (weight * (gap - centre).square()).sum(-1, keepdim=True)
    root = centre - ((beta**2 - spread).clamp_min(0) / total).sqrt()
    weights = (gap - root).clamp_min(0) * precision
    norm = weights.sum(-1, keepdim=True)
    weights = torch.where(norm > 0, weights / norm.clamp_min(torch.finfo(norm.dtype).tiny), one_hot)
    return (anchor + root).squeeze(-1), weights
