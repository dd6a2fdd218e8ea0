"""The running mean and variance by which observations are standardised."""

from __future__ import annotations

import torch
from torch import Tensor


def updated_moments(
    mean: Tensor, variance: Tensor, rows: Tensor, rate: float | Tensor, counts: Tensor | None = None
) -> tuple[Tensor, Tensor, Tensor]:
    """Moves a running mean and variance towards those of some rows.

    What results are the moments of a mixture, ``1 - rate`` of what was seen before and ``rate`` of the rows: with
    ``rate = 1 / n`` at the n-th batch of equal size those of all batches together (Chan et al., 1979).

    Args:
        mean (Tensor): present mean, ``[O]``.
        variance (Tensor): present variance, of a whole population, ``[O]``.
        rows (Tensor): ``[..., O]``.
        rate (float or Tensor): weight of the rows, in [0, 1].
        counts (Tensor, optional): which rows count, bool, ``[...]``. Default: all of them.

    Returns:
        tuple of Tensor: mean and variance, each ``[O]``, without gradient; the present ones where a row that counts is
            not finite, or none counts. And whether they moved, a bool scalar.

    >>> mean, variance, moved = updated_moments(torch.zeros(1), torch.ones(1), torch.tensor([[2.0], [4.0]]), rate=0.5)
    >>> mean.item(), variance.item(), moved.item()  # half at 0 and half at 3, each with a variance of 1
    (1.5, 3.25, True)
    """
    rows = rows.detach().reshape(-1, rows.shape[-1]).to(mean.dtype)
    if counts is None:
        rows_mean = rows.mean(0)
        rows_variance = (rows - rows_mean).square().mean(0)
    else:
        counts = counts.reshape(-1, 1)
        total = counts.sum()  # of none the mean is NaN
        rows_mean = torch.where(counts, rows, 0).sum(0) / total
        rows_variance = torch.where(counts, rows - rows_mean, 0).square().sum(0) / total
    apart = rows_mean - mean
    within = (1 - rate) * variance + rate * rows_variance
    mixed = within + rate * (1 - rate) * apart.square()
    finite = mixed.isfinite().all()
    return torch.where(finite, mean + rate * apart, mean), torch.where(finite, mixed, variance), finite
