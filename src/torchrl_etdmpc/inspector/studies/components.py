"""Principal components of points in latent space."""

from __future__ import annotations

from torch import Tensor

from torchrl_etdmpc.inspector.trace import principal_components


def components(points: Tensor) -> tuple[Tensor, Tensor]:
    """First two principal components of points ``[..., L]``: coordinates ``[..., 2]`` and shares of the variance.

    >>> import torch
    >>> coordinates, shares = components(torch.tensor([[3.0, 4.0], [-3.0, -4.0]]))
    >>> coordinates[:, 0].abs(), shares[0]
    (tensor([5., 5.], dtype=torch.float64), tensor(1., dtype=torch.float64))
    """
    points = points.double()
    found = principal_components(points.flatten(0, -2))
    return found.project(points)[..., :2], found.shares(points)[:2]
