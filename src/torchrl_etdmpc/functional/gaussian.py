"""The clipped diagonal Gaussian of the policy and of the planner.

The density used everywhere is that of the *unclipped* Gaussian (BMPC, arXiv:2503.18871; thesis 2.4): clipping happens
to the sampled action only.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import softplus


def bounded_log_std(raw: Tensor, low: float, high: float) -> Tensor:
    """Maps a raw network output to ``low + (high - low) / 2 * (tanh(raw) + 1)`` (thesis 2.4).

    Args:
        raw (Tensor): unbounded outputs, any shape.
        low (float): smallest log standard deviation.
        high (float): largest log standard deviation.

    Returns:
        Tensor: log standard deviations in (low, high), same shape.

    >>> bounded_log_std(torch.tensor(0.0), -3.0, 1.0).item()
    -1.0
    """
    return low + 0.5 * (high - low) * (torch.tanh(raw) + 1)


def clipped_sample(mean: Tensor, std: Tensor, noise: Tensor) -> Tensor:
    """Draws ``clip(mean + std * noise, -1, 1)`` (thesis 2.4).

    Args:
        mean (Tensor): shape ``[..., A]``.
        std (Tensor): shape ``[..., A]``, positive.
        noise (Tensor): standard normal draws, broadcastable to ``[..., A]``.

    Returns:
        Tensor: actions in [-1, 1], shape ``[..., A]``.

    >>> clipped_sample(torch.zeros(2), torch.ones(2), torch.tensor([0.5, -3.0])).tolist()
    [0.5, -1.0]
    """
    return (mean + std * noise).clamp(-1, 1)


def gaussian_kl(mean_p: Tensor, std_p: Tensor, mean_q: Tensor, std_q: Tensor) -> Tensor:
    """``KL(p || q)`` of diagonal Gaussians in closed form, per dimension.

    ``ln(std_q / std_p) + (std_p^2 + (mean_p - mean_q)^2) / (2 std_q^2) - 1/2``.

    Args:
        mean_p (Tensor): shape ``[..., A]``.
        std_p (Tensor): shape ``[..., A]``, positive.
        mean_q (Tensor): shape ``[..., A]``.
        std_q (Tensor): shape ``[..., A]``, positive.

    Returns:
        Tensor: divergence in nats of each dimension, shape ``[..., A]``.

    >>> gaussian_kl(torch.zeros(1), torch.ones(1), torch.ones(1), torch.ones(1)).tolist()
    [0.5]
    """
    variance_q = std_q.square()
    return std_q.log() - std_p.log() + (std_p.square() + (mean_p - mean_q).square()) / (2 * variance_q) - 0.5


def tanh_log_slope(x: Tensor) -> Tensor:
    """``ln(1 - tanh(x)^2)``, elementwise, exact where the tanh is saturated: what a tanh does to a log density.

    ``2 (ln 2 - x - softplus(-2 x))``. The entropy of ``tanh(x)`` is that of x plus the mean of this.

    Args:
        x (Tensor): before the tanh, any shape.

    Returns:
        Tensor: at most 0, same shape.

    >>> tanh_log_slope(torch.tensor([0.0, 100.0])).tolist()
    [0.0, -198.61370849609375]
    """
    return 2 * (math.log(2) - x - softplus(-2 * x))


def gaussian_entropy(log_std: Tensor) -> Tensor:
    """Differential entropy ``log_std + (1 + ln 2 pi) / 2`` of each dimension of a diagonal Gaussian.

    Args:
        log_std (Tensor): log standard deviations, shape ``[..., A]``.

    Returns:
        Tensor: entropy in nats, shape ``[..., A]``.

    >>> round(gaussian_entropy(torch.zeros(1)).item(), 4)
    1.4189
    """
    return log_std + 0.5 * (1 + math.log(2 * math.pi))
