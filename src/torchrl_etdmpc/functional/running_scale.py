"""The running scale that normalises the policy's loss."""

from __future__ import annotations

import torch
from torch import Tensor


def updated_scale(scale: Tensor, batch: Tensor, tau: float, counts: Tensor | None = None) -> Tensor:
    """Moves a running scale towards the spread between a batch's 5th and 95th percentile, or towards 1 if that is less.

    ``S <- (1 - tau) S + tau max(p95 - p5, 1)`` (TD-MPC2, arXiv:2310.16828; BMPC applies it to the KL).

    Args:
        scale (Tensor): the present scale, a scalar, at least 1.
        batch (Tensor): values of one batch, any shape.
        tau (float): rate of the exponential moving average, in [0, 1].
        counts (Tensor, optional): which values count, bool, the batch's shape. Default: all of them.

    Returns:
        Tensor: the new scale, a scalar without gradient. A batch whose spread is not finite, or in which nothing
        counts, leaves it where it is.

    >>> updated_scale(torch.tensor(1.0), torch.linspace(0, 100, 101), tau=1.0).item()
    90.0
    """
    batch = batch.detach().flatten()
    if not batch.numel():
        return scale
    if batch.dtype != torch.float64:  # half precision is too coarse for ranks
        batch = batch.float()
    levels = torch.linspace(0.05, 0.95, 2, dtype=batch.dtype, device=batch.device)  # made there, not sent there
    counts = torch.ones_like(batch, dtype=torch.bool) if counts is None else counts.flatten()
    # torch.nanquantile, in operations that every supported PyTorch compiles. What does not count comes last; a value
    # that counts and is not finite makes every quantile infinite, and the spread NaN.
    finite = (batch.isfinite() | ~counts).all()
    ordered = torch.where(counts & finite, batch, torch.inf).sort().values
    ranks = levels * (counts.sum() - 1).clamp_min(0)
    below = ranks.floor()
    quantiles = torch.lerp(ordered[below.long()], ordered[ranks.ceil().long()], ranks - below)
    spread = (quantiles[1] - quantiles[0]).to(scale.dtype).clamp_min(1.0)
    return torch.lerp(scale, torch.where(spread.isfinite(), spread, scale), tau)
