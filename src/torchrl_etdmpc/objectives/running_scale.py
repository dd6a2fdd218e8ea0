"""The running scale of a loss, by which its policy term is divided."""

from __future__ import annotations

import torch
from torch import Tensor

from torchrl_etdmpc.functional import updated_scale
from torchrl_etdmpc.objectives.latent_rollout_loss import LatentRolloutLoss


def register_scale(loss: LatentRolloutLoss, name: str, scale_tau: float) -> None:
    """Checks the rate and registers the scale, a buffer of this name, on the loss."""
    if not 0 <= scale_tau <= 1:
        raise ValueError(f"scale_tau must be in [0, 1], got {scale_tau}.")
    loss.scale_tau = scale_tau
    loss.register_buffer(name, torch.ones_like(loss.rho))


def moved_scale(loss: LatentRolloutLoss, name: str, batch: Tensor, counts: Tensor | None) -> Tensor:
    """The scale, in training mode moved towards the spread of a batch's values, of which those count."""
    scale = loss.get_buffer(name)
    # Departure from BMPC, which moves the scale in every policy step: an evaluation of the loss must not change it.
    if loss.training:
        scale.copy_(updated_scale(scale, batch, loss.scale_tau, counts))
    return scale.clone()  # the next call moves the buffer, perhaps before this one's backward pass
