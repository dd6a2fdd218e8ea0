"""The latent rollout of replayed slices, which all terms of a loss share."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from torchrl_etdmpc.modules import WorldModel
from torchrl_etdmpc.objectives.slices import Slices


class LatentRollout(NamedTuple):
    """Encoded and predicted latents of replayed slices.

    >>> rollout = LatentRollout(encoded=torch.zeros(4, 8, 16), predicted=torch.zeros(4, 2, 8, 16))
    >>> (rollout.predicted[1:] - rollout.encoded[1:].unsqueeze(1)).shape  # T = 3, F = 2, B = 8, L = 16
    torch.Size([3, 2, 8, 16])
    """

    encoded: Tensor
    """Encodings z_0..z_T of the real observations, without gradient, ``[T + 1, B, L]``."""
    predicted: Tensor
    """Head i's own rollout zhat_0..zhat_T of the replayed actions, with gradient, ``[T + 1, F, B, L]``. All heads start
    from the same zhat_0."""
    targets: Mapping[str, Mapping[str, Tensor]] | None = None
    """Parameters of the target networks, by network and name."""


def latent_rollout(world_model: WorldModel, slices: Slices) -> LatentRollout:
    """Encodes every observation and rolls every dynamics head from the first one (BMPC; thesis appendix B).

    ``zhat_{0,i} = h(s_0)`` with gradient into the encoder, ``zhat_{k+1,i} = f_i(zhat_{k,i}, a_k)``; the encodings of
    the later observations carry no gradient.

    Args:
        world_model (WorldModel): encoder and dynamics.
        slices (Slices): T transitions of B slices.

    Returns:
        LatentRollout: ``[T + 1, B, L]`` and ``[T + 1, F, B, L]``.

    >>> from torchrl_etdmpc.objectives import EfficientTDMPCLoss
    >>> from torchrl_etdmpc.testing import random_slices
    >>> world_model = WorldModel(3, 2, latent_dim=16, mlp_dim=32, num_dynamics=2)
    >>> slices = EfficientTDMPCLoss(world_model, discount=0.99).slices(random_slices(3, 2, num_slices=4, slice_len=3))
    >>> latent_rollout(world_model, slices).predicted.shape
    torch.Size([4, 2, 4, 16])
    """
    first = world_model.encode(slices.observation)
    with torch.no_grad():
        later = world_model.encode(slices.next_observation)
    shape = *slices.action.shape[:2], world_model.latent_dim
    if (first.shape, later.shape) != (shape[1:], shape):
        raise ValueError(
            "the encoder must keep every leading dimension of observations: of [B, ...] and [T, B, ...] it must make "
            f"{list(shape[1:])} and {list(shape)}, got {list(first.shape)} and {list(later.shape)}."
        )
    latents = [first.expand(world_model.num_dynamics, *first.shape)]
    for action in slices.action.unbind(0):
        latents.append(world_model.next(latents[-1], action))
    return LatentRollout(torch.cat([first.detach().unsqueeze(0), later]), torch.stack(latents))


def head_rows(steps: Tensor, num_heads: int | None = None) -> Tensor:
    """One row for every step and head of a rollout; step 0, on which the heads agree, has one row for all of them.

    Args:
        steps (Tensor): T steps, ``[T, F, B, ...]``, or ``[T, B, ...]`` with ``num_heads``: the same for all heads.
        num_heads (int, optional): F, for an entry without a head dimension.

    Returns:
        Tensor: ``[1 + (T - 1) F, B, ...]``.
    """
    # Departure from BMPC and the thesis, which read every head's rollout at step 0 as well, where they are equal: the
    # same average from fewer rows, but one dropout mask there instead of one per head, and the percentiles of the
    # running scale count each slice once.
    if num_heads is not None:
        steps = steps.unsqueeze(1).expand(-1, num_heads, *steps.shape[1:])
    return torch.cat([steps[0, :1], steps[1:].flatten(0, 1)])


def mean_of_head_rows(answers: Tensor, num_heads: int) -> Tensor:
    """Mean over heads of what was computed on :func:`head_rows`, ``[1 + (T - 1) F, B]`` to ``[T, B]``."""
    return torch.cat([answers[:1], answers[1:].unflatten(0, (-1, num_heads)).mean(1)]) if len(answers) > 1 else answers


def counted_mean(values: Tensor, counts: Tensor | None) -> Tensor:
    """Mean over the steps that count, 0 if none does.

    Args:
        values (Tensor): ``[T, B]``.
        counts (Tensor, optional): bool, ``[T, B]``. Default: every step counts.

    Returns:
        Tensor: a scalar.

    >>> counted_mean(torch.tensor([[1.0, 5.0]]), torch.tensor([[True, False]])).item()
    1.0
    """
    if counts is None:
        return values.mean()
    return torch.where(counts, values, 0).sum() / counts.sum().clamp_min(1)
