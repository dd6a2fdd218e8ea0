"""Prediction heads: reward, value ensembles, termination."""

from __future__ import annotations

import torch
from torch import Tensor

from torchrl_etdmpc.modules.normed_linear import Activation, LayerStack


class RewardHead(LayerStack):
    """Latent and action to the logits of the reward's symlog two-hot distribution (thesis Table 3.1).

    Args:
        latent_dim (int): L.
        action_dim (int): A.
        num_bins (int): M.
        hidden_dim (int): size of both hidden layers.
        activation (str): of the hidden layers.

    >>> RewardHead(16, 2)(torch.zeros(7, 16), torch.zeros(7, 2)).shape
    torch.Size([7, 101])
    """

    def __init__(
        self,
        latent_dim: int,
        action_dim: int,
        *,
        num_bins: int = 101,
        hidden_dim: int = 512,
        activation: Activation = "mish",
    ) -> None:
        super().__init__(
            latent_dim + action_dim, [hidden_dim] * 2, num_bins, activation=activation, zero_init_output=True
        )

    def forward(self, latent: Tensor, action: Tensor) -> Tensor:
        """``latent [..., L]`` and ``action`` (broadcastable to ``[..., A]``) to logits ``[..., M]``."""
        action = action.expand(*latent.shape[:-1], action.shape[-1])
        return self.through(torch.cat([latent, action], dim=-1))


class ValueEnsemble(LayerStack):
    """``V`` independent state-value heads, latent to symlog two-hot logits (thesis Table 3.1; BMPC).

    Args:
        latent_dim (int): L.
        num_heads (int): V.
        num_bins (int): M.
        hidden_dim (int): size of both hidden layers.
        dropout (float): of the first hidden layer, when ``forward`` is asked for it.
        activation (str): of the hidden layers.

    >>> ValueEnsemble(16, num_heads=2)(torch.zeros(7, 16)).shape
    torch.Size([2, 7, 101])
    """

    def __init__(
        self,
        latent_dim: int,
        *,
        num_heads: int = 2,
        num_bins: int = 101,
        hidden_dim: int = 512,
        dropout: float = 0.01,
        activation: Activation = "mish",
    ) -> None:
        super().__init__(
            latent_dim,
            [hidden_dim] * 2,
            num_bins,
            activation=activation,
            num_members=num_heads,
            dropout=dropout,
            zero_init_output=True,
        )
        self.num_heads = num_heads

    def forward(self, latent: Tensor, *, dropout: bool = False) -> Tensor:
        """``latent [..., L]`` to logits ``[V, ..., M]``; dropout (independent per head) only when asked for."""
        return self.through(latent.expand(self.num_heads, *latent.shape), dropout=dropout)


class ActionValueEnsemble(LayerStack):
    """``V`` independent action-value heads, latent and action to symlog two-hot logits (TD-MPC2, arXiv:2310.16828).

    Args:
        latent_dim (int): L.
        action_dim (int): A.
        num_heads (int): V.
        num_bins (int): M.
        hidden_dim (int): size of both hidden layers.
        dropout (float): of the first hidden layer, when ``forward`` is asked for it.
        activation (str): of the hidden layers.

    >>> ActionValueEnsemble(16, 2, num_heads=5)(torch.zeros(7, 16), torch.zeros(7, 2)).shape
    torch.Size([5, 7, 101])
    """

    def __init__(
        self,
        latent_dim: int,
        action_dim: int,
        *,
        num_heads: int = 5,
        num_bins: int = 101,
        hidden_dim: int = 512,
        dropout: float = 0.01,
        activation: Activation = "mish",
    ) -> None:
        super().__init__(
            latent_dim + action_dim,
            [hidden_dim] * 2,
            num_bins,
            activation=activation,
            num_members=num_heads,
            dropout=dropout,
            zero_init_output=True,
        )
        self.num_heads = num_heads

    def forward(self, latent: Tensor, action: Tensor, *, dropout: bool = False) -> Tensor:
        """``latent [..., L]`` and ``action [..., A]`` to logits ``[V, ..., M]``.

        Args:
            latent (Tensor): ``[..., L]``.
            action (Tensor): broadcastable to ``[..., A]``.
            dropout (bool): whether to use it, independently per head.
        """
        rows = torch.cat([latent, action.expand(*latent.shape[:-1], action.shape[-1])], dim=-1)
        return self.through(rows.expand(self.num_heads, *rows.shape), dropout=dropout)


class TerminationHead(LayerStack):
    """Latent to the logit of the probability that the episode terminated on reaching it.

    Args:
        latent_dim (int): L.
        hidden_dim (int): size of both hidden layers.
        activation (str): of the hidden layers.

    >>> TerminationHead(16)(torch.zeros(7, 16)).shape
    torch.Size([7])
    """

    def __init__(self, latent_dim: int, *, hidden_dim: int = 512, activation: Activation = "mish") -> None:
        super().__init__(latent_dim, [hidden_dim] * 2, 1, activation=activation)

    def forward(self, latent: Tensor) -> Tensor:
        """``latent [..., L]`` to logits ``[...]``."""
        return self.through(latent).squeeze(-1)
