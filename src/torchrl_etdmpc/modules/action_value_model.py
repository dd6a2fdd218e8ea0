"""The world model with a critic of actions: Q heads and a squashed policy in the place of state values."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchrl_etdmpc.functional import two_hot_decode
from torchrl_etdmpc.modules.heads import ActionValueEnsemble
from torchrl_etdmpc.modules.normed_linear import Activation
from torchrl_etdmpc.modules.policy import SquashedGaussianPolicy
from torchrl_etdmpc.modules.world_model import WorldModel


class ActionValueWorldModel(WorldModel):
    """All networks of TD-MPC2 in one module (arXiv:2310.16828): its value heads read the action too.

    It differs from :class:`WorldModel` in two networks: ``value_head`` is an
    :class:`~torchrl_etdmpc.modules.ActionValueEnsemble`, and ``policy`` a
    :class:`~torchrl_etdmpc.modules.SquashedGaussianPolicy`. Being an
    :class:`~torchrl_etdmpc.modules.ActionValueModel`, it is planned over as TD-MPC2 does.

    Args:
        observation_dim (int, optional): O, size of the flat observation; ``None`` with an encoder of one's own.
        action_dim (int): A.
        mlp_dim (int): hidden size of dynamics, reward, value, policy and termination.
        num_dynamics (int): F, dynamics heads. Default: 1.
        num_values (int): V, action-value heads. Default: 5.
        dropout (float): of the first hidden layer of the value heads, in [0, 1).
        log_std_min (float): smallest log standard deviation before the tanh. Default: -10.
        log_std_max (float): largest log standard deviation before the tanh. Default: 2.
        activation (str): ``"mish"``, ``"silu"`` or ``"relu"``.
        **options: the others of :class:`WorldModel`.

    Raises:
        ValueError: as :class:`WorldModel`.

    >>> model = ActionValueWorldModel(24, 6, latent_dim=32, mlp_dim=64)
    >>> model.action_values(torch.zeros(7, 32), torch.zeros(7, 6)).shape
    torch.Size([7, 5])
    """

    value_head: ActionValueEnsemble  # pyright: ignore[reportIncompatibleVariableOverride]
    policy: SquashedGaussianPolicy  # pyright: ignore[reportIncompatibleVariableOverride]

    def __init__(
        self,
        observation_dim: int | None,
        action_dim: int,
        *,
        mlp_dim: int = 512,
        num_dynamics: int = 1,
        num_values: int = 5,
        dropout: float = 0.01,
        log_std_min: float = -10.0,
        log_std_max: float = 2.0,
        activation: Activation = "mish",
        **options: Any,
    ) -> None:
        super().__init__(
            observation_dim,
            action_dim,
            mlp_dim=mlp_dim,
            num_dynamics=num_dynamics,
            num_values=num_values,
            dropout=dropout,
            log_std_min=log_std_min,
            log_std_max=log_std_max,
            activation=activation,
            **options,
        )
        self.value_head = ActionValueEnsemble(
            self.latent_dim,
            action_dim,
            num_heads=num_values,
            num_bins=len(self.bins),
            hidden_dim=mlp_dim,
            dropout=dropout,
            activation=activation,
        )
        self.policy = SquashedGaussianPolicy(
            self.latent_dim,
            action_dim,
            hidden_dim=mlp_dim,
            log_std_min=log_std_min,
            log_std_max=log_std_max,
            activation=activation,
        )

    def action_values(self, latent: Tensor, action: Tensor) -> Tensor:
        """Expected return of ``action [..., A]`` in ``latent [..., L]`` by each head, ``[..., V]``, without dropout."""
        return two_hot_decode(self.value_head(latent, action).to(self.bins.dtype), self.bins).movedim(0, -1)

    def values(self, latent: Tensor) -> Tensor:
        """Expected value of ``latent [..., L]``, shape ``[..., V]``: each head's for the policy's mean action."""
        return self.action_values(latent, self.policy(latent)[0])

    def act(self, latent: Tensor, noise: Tensor, log_std_bounds: tuple[float, float] | None = None) -> Tensor:
        """Samples the policy: ``tanh(m + std * noise)``, shape ``[..., A]``; as :meth:`WorldModel.act`."""
        mean, log_std = self.policy.before_tanh(latent, log_std_bounds)
        return torch.tanh(mean + log_std.exp() * noise)
