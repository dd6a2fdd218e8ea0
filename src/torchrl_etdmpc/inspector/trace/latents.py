"""Where candidates lead: latents in the principal components of latent space."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from torchrl_etdmpc.inspector.trace.trace import COMPONENTS, Trace
from torchrl_etdmpc.modules.prediction import PredictionModel

_BASIS_ROWS = 8192  # latents that the principal components are fitted to, evenly spread over all


class Components(NamedTuple):
    """Principal components of latent space."""

    centre: Tensor
    """``[L]``"""
    basis: Tensor
    """``[C, L]``, orthonormal, the first explains most; the largest entry of each is positive."""

    def project(self, latents: Tensor) -> Tensor:
        """``[..., L]`` to ``[..., C]``."""
        return (latents - self.centre) @ self.basis.mT


def principal_components(latents: Tensor) -> Components:
    """The components of rows ``[M, L]``, at most three.

    >>> components = principal_components(torch.tensor([[0.0, 0.0], [2.0, 2.0], [4.0, 4.0]]))
    >>> components.project(torch.tensor([2.0, 2.0])).abs().max().item() < 1e-6
    True
    """
    rows = latents[:: math.ceil(len(latents) / _BASIS_ROWS)].double()
    centre = rows.mean(0)
    _, vectors = torch.linalg.eigh((rows - centre).mT @ (rows - centre))  # in ascending order
    basis = vectors.mT.flip(0)[:COMPONENTS]
    largest = basis.gather(1, basis.abs().argmax(1, keepdim=True))
    basis = basis * torch.where(largest < 0, -1.0, 1.0)
    return Components(centre.to(latents.dtype), basis.to(latents.dtype))


def rolled_out(model: PredictionModel, latent: Tensor, actions: Tensor) -> Tensor:
    """Latents ``[H, F, N, L]`` along sequences ``[N, H, A]``, every head on its own rollout."""
    before, latents = latent[None, None, None], []
    for step in range(actions.shape[1]):
        before = model.next(before, actions[None, :, step])
        latents.append(before[:, 0])
    return torch.stack(latents)


def latent_views(
    rolled: list[Tensor], start: Tensor, like: Trace | None = None
) -> tuple[Components, dict[str, Tensor]]:
    """Latents of every iteration's candidates, ``[H, F, N, L]`` each, as the arrays of a trace that show them."""
    if like is None or like.get("basis") is None:
        components = principal_components(torch.cat([latents.flatten(0, 2) for latents in rolled]))
    else:
        components = Components(*(torch.from_numpy(like[name]).to(start) for name in ("centre", "basis")))
    points = torch.stack([components.project(latents).permute(2, 0, 1, 3) for latents in rolled])
    spread = torch.stack([_spread(latents).mT for latents in rolled])
    total = sum((latents - components.centre).square().sum() for latents in rolled)
    return components, {
        **components._asdict(),
        "explained": points.square().sum((0, 1, 2, 3)) / torch.as_tensor(total).clamp_min(1e-30),
        "start_point": components.project(start),
        "points": points,
        "latent_spread": spread,
    }


def _spread(latents: Tensor) -> Tensor:
    """Root mean square distance ``[H, N]`` of the heads' latents ``[H, F, N, L]`` from their mean.

    By hand: on a CPU, ``Tensor.std`` over a dimension that is not the last takes longer than all of the planning.
    """
    apart = latents - latents.mean(1, keepdim=True)
    return apart.square().sum(-1).mean(1).sqrt()


def candidate_latents(
    model: PredictionModel,
    latent: Tensor,
    actions: Tensor,
    like: Trace | None,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[Components, dict[str, Tensor]]:
    """Where the candidates ``[I, N, H, A]`` lead, in principal components, and how far the heads are apart."""
    rolled = []  # of each iteration [H, F, N, L]
    for number, candidates in enumerate(actions, start=1):
        rolled.append(rolled_out(model, latent, candidates))
        if progress is not None:
            progress(len(actions) + number, 2 * len(actions))
    return latent_views(rolled, latent, like)
