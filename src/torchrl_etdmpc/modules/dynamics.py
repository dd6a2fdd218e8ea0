"""The dynamics ensemble f_i: latent and action to next latent."""

from __future__ import annotations

from functools import partial

import torch
from torch import Tensor

from torchrl_etdmpc.functional import simnorm
from torchrl_etdmpc.modules.normed_linear import MLP, Activation


class DynamicsEnsemble(MLP):
    """``F`` independent dynamics heads, ``z' = f_i(z, a)`` (thesis 3.4.1). Members share nothing.

    Args:
        latent_dim (int): L.
        action_dim (int): A.
        num_heads (int): F.
        hidden_dim (int): size of both hidden layers.
        simnorm_dim (int): group size of SimNorm.
        activation (str): of the hidden layers.

    >>> heads = DynamicsEnsemble(16, 2, num_heads=4, hidden_dim=32)
    >>> heads(torch.zeros(4, 7, 16), torch.zeros(7, 2)).shape
    torch.Size([4, 7, 16])
    """

    def __init__(
        self,
        latent_dim: int,
        action_dim: int,
        *,
        num_heads: int = 4,
        hidden_dim: int = 512,
        simnorm_dim: int = 8,
        activation: Activation = "mish",
    ) -> None:
        super().__init__(
            latent_dim + action_dim,
            [hidden_dim] * 2,
            latent_dim,
            activation=activation,
            output_activation=partial(simnorm, group_size=simnorm_dim),
            num_members=num_heads,
        )
        self.num_heads = num_heads

    def forward(self, latent: Tensor, action: Tensor) -> Tensor:
        """Steps every head once.

        Args:
            latent (Tensor): head i's own latent, shape ``[F, ..., L]`` (or ``[1, ..., L]``: the same for all heads).
            action (Tensor): broadcastable to ``[F, ..., A]``.

        Returns:
            Tensor: next latents, shape ``[F, ..., L]``.
        """
        latent = latent.expand(self.num_heads, *latent.shape[1:])
        action = action.expand(*latent.shape[:-1], action.shape[-1])
        return super().forward(torch.cat([latent, action], dim=-1))
