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

    def shares(self, *parts: Tensor) -> Tensor:
        """Which share of the variance of latents ``[..., L]`` each shows, ``[C]``; of those that are finite."""
        shown, total = self.basis.new_zeros(len(self.basis)), self.basis.new_zeros(())
        for latents in parts:
            finite = latents[latents.isfinite().all(-1)]
            shown = shown + self.project(finite).square().sum(0)
            total = total + (finite - self.centre).square().sum()
        return shown / total.clamp_min(1e-30)


def principal_components(latents: Tensor) -> Components:
    """The components of rows ``[M, L]``, at most three; of those that are finite.

    >>> components = principal_components(torch.tensor([[0.0, 0.0], [2.0, 2.0], [4.0, 4.0]]))
    >>> components.project(torch.tensor([2.0, 2.0])).abs().max().item() < 1e-6
    True
    """
    rows = latents[:: math.ceil(len(latents) / _BASIS_ROWS)].double()
    rows = rows[rows.isfinite().all(-1)]
    if not len(rows):  # everything is drawn at no place, which a figure leaves out
        rows = latents.new_zeros(1, latents.shape[-1]).double()
    centre = rows.mean(0)
    _, vectors = torch.linalg.eigh((rows - centre).mT @ (rows - centre))  # in ascending order
    basis = vectors.mT.flip(0)[:COMPONENTS]
    largest = basis.gather(1, basis.abs().argmax(1, keepdim=True))
    basis = basis * torch.where(largest < 0, -1.0, 1.0)
    return Components(centre.to(latents.dtype), basis.to(latents.dtype))


def rolled_out(model: PredictionModel, latent: Tensor, actions: Tensor) -> Tensor:
    """Latents ``[H, F, ..., N, L]`` along sequences ``[..., N, H, A]`` from ``[..., L]``, every head on its own."""
    before, latents = latent[None, ..., None, :], []
    for step in range(actions.shape[-2]):
        before = model.next(before, actions[..., step, :])
        latents.append(before)
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
    spread = torch.stack([head_spread(latents).mT for latents in rolled])
    return components, {
        **components._asdict(),
        "explained": components.shares(*rolled),
        "start_point": components.project(start),
        "points": points,
        "latent_spread": spread,
    }


def head_spread(latents: Tensor) -> Tensor:
    """Root mean square distance ``[..., N]`` of the heads' latents ``[..., F, N, L]`` from their mean.

    By hand: on a CPU, ``Tensor.std`` over a dimension that is not the last takes longer than all of the planning.

    >>> head_spread(torch.tensor([[[1.0, 2.0]], [[1.0, 4.0]]]))  # two heads, one latent
    tensor([1.])
    """
    apart = latents - latents.mean(-3, keepdim=True)
    return apart.square().sum(-1).mean(-2).sqrt()


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
