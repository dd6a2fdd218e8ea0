"""The dynamics ensemble f_i: latent and action to next latent."""

from __future__ import annotations

from functools import partial

import torch
from torch import Tensor

from torchrl_etdmpc.functional import simnorm
from torchrl_etdmpc.modules.normed_linear import Activation, LayerStack


class DynamicsEnsemble(LayerStack):
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
            latent (Tensor): head i's own latent, shape ``[F, ..., L]`` (or ``[1, ..., L]``: the same for all heads). A
                dimension of size 1 that ``action`` has in full is computed once in the first layer: many actions in
                one latent.
            action (Tensor): broadcastable to ``[F, ..., A]``.

        Returns:
            Tensor: next latents, shape ``[F, ..., L]``.
        """
        first = self.hidden[0]
        shape = torch.broadcast_shapes(latent.shape[1:-1], action.shape[max(0, action.ndim - latent.ndim + 1) : -1])
        if latent.shape[1:-1] == shape:
            latent = latent.expand(self.num_heads, *latent.shape[1:])
            action = action.expand(*latent.shape[:-1], action.shape[-1])
            x = first(torch.cat([latent, action], dim=-1))
        else:
            of_latent, of_action = first.weight.split([latent.shape[-1], action.shape[-1]], dim=-2)
            bias = first.bias.view(-1, *(1,) * len(shape), first.bias.shape[-1])
            action = action[(None,) * (latent.ndim - action.ndim)]
            x = first.finish(_product(latent, of_latent) + (_product(action, of_action) + bias))
        for layer in self.hidden[1:]:
            x = layer(x)
        return self.output(x)


def _product(x: Tensor, weight: Tensor) -> Tensor:
    """``[1 or E, ..., in]`` times ``[E, in, out]``: ``[E, ..., out]``."""
    rows = x.reshape(x.shape[0], -1, x.shape[-1]).expand(weight.shape[0], -1, -1)
    return torch.bmm(rows, weight).view(weight.shape[0], *x.shape[1:-1], weight.shape[-1])
