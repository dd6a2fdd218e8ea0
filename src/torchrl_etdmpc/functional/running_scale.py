"""The running scale that normalises the distillation loss."""

from __future__ import annotations

import torch
from torch import Tensor


def updated_scale(scale: Tensor, batch: Tensor, tau: float) -> Tensor:
    """Moves a running scale towards the spread between a batch's 5th and 95th percentile, never below 1.

    ``S <- max((1 - tau) S + tau (p95 - p5), 1)`` (TD-MPC2, arXiv:2310.16828; BMPC applies it to the KL).

    Args:
        scale (Tensor): the present scale, a scalar.
        batch (Tensor): values of one batch, any shape.
        tau (float): rate of the exponential moving average, in [0, 1].

    Returns:
        Tensor: the new scale, a scalar without gradient. A batch whose spread is not finite leaves it where it is.

    >>> updated_scale(torch.tensor(1.0), torch.linspace(0, 100, 101), tau=1.0).item()
    90.0
    """
    quantiles = torch.quantile(
        batch.detach().flatten(), torch.tensor([0.05, 0.95], dtype=batch.dtype, device=batch.device)
    )
    spread = (quantiles[1] - quantiles[0]).to(scale.dtype)
    return torch.lerp(scale, torch.where(spread.isfinite(), spread, scale), tau).clamp_min(1.0)
