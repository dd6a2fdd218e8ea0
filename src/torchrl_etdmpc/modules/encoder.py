"""The encoder h: observation to latent."""

from __future__ import annotations

from functools import partial

import torch
from torch import Tensor

from torchrl_etdmpc.functional import simnorm
from torchrl_etdmpc.modules.normed_linear import Activation, LayerStack
from torchrl_etdmpc.modules.running_norm import RunningNorm


class Encoder(LayerStack):
    """Observation to latent, ``z = h(s)`` (thesis Table 3.1): hidden layers, then Linear, LayerNorm, SimNorm.

    Args:
        observation_dim (int): O.
        latent_dim (int): L, a multiple of ``simnorm_dim``.
        hidden_dim (int): size of each hidden layer.
        num_layers (int): number of hidden layers.
        simnorm_dim (int): group size of SimNorm.
        activation (str): of the hidden layers.
        normalize (bool): whether observations are standardised first, by a
            :class:`~torchrl_etdmpc.modules.RunningNorm`. Default: ``False``.

    Raises:
        TypeError: if an observation has another dtype than the weights.
        ValueError: if it has another size than O.

    >>> Encoder(24, 512)(torch.zeros(2, 24)).shape
    torch.Size([2, 512])
    """

    def __init__(
        self,
        observation_dim: int,
        latent_dim: int,
        *,
        hidden_dim: int = 256,
        num_layers: int = 1,
        simnorm_dim: int = 8,
        activation: Activation = "mish",
        normalize: bool = False,
    ) -> None:
        super().__init__(
            observation_dim,
            [hidden_dim] * num_layers,
            latent_dim,
            activation=activation,
            output_activation=partial(simnorm, group_size=simnorm_dim),
        )
        self.observation_dim = observation_dim
        self.norm = RunningNorm(observation_dim) if normalize else None

    def reset_parameters_recursive(self) -> None:
        """Draws new weights in every layer, and forgets the observations' statistics."""
        super().reset_parameters_recursive()
        if self.norm is not None:
            self.norm.reset_parameters()

    def observe(self, observation: Tensor, counts: Tensor | None = None) -> None:
        """Moves the statistics that observations ``[..., O]`` are standardised by, if they are.

        The losses call it in training mode with every batch, before they encode it.

        Args:
            observation (Tensor): ``[..., O]``.
            counts (Tensor, optional): which of them count, bool, ``[...]``. Default: all.
        """
        if self.norm is not None:
            self.norm.observe(observation, counts)

    def forward(self, observation: Tensor) -> Tensor:
        """``[..., O] -> [..., L]``."""
        dtype = self.output.weight.dtype
        if observation.dtype != dtype and not torch.is_autocast_enabled(observation.device.type):
            raise TypeError(
                f"observations are {observation.dtype} and the weights {dtype}; append torchrl.envs."
                f"DTypeCastTransform({observation.dtype}, {dtype}) to the environment, or cast one of the two with "
                ".to(dtype)."
            )
        if observation.shape[-1:] != (self.observation_dim,):
            raise ValueError(
                f"observations must be of shape [..., {self.observation_dim}], got {list(observation.shape)}; build "
                "the world model with their size, or flatten them."
            )
        return self.through(observation if self.norm is None else self.norm(observation))
