"""Principal components of points in latent space."""

from __future__ import annotations

import torch
from torch import Tensor


def components(points: Tensor) -> tuple[Tensor, Tensor]:
    """First two principal components of points ``[..., L]``: coordinates ``[..., 2]`` and shares of the variance.

    >>> coordinates, shares = components(torch.tensor([[3.0, 4.0], [-3.0, -4.0]]))
    >>> coordinates[:, 0].abs().tolist(), shares[0].item()
    ([5.0, 5.0], 1.0)
    """
    flat = points.flatten(0, -2).double()
    _, strengths, directions = torch.linalg.svd(flat - flat.mean(0), full_matrices=False)
    shares = strengths.square() / strengths.square().sum().clamp_min(torch.finfo(flat.dtype).tiny)
    return (points.double() - flat.mean(0)) @ directions[:2].mT, shares[:2]
