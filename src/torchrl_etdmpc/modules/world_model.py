"""The world model: encoder, dynamics ensemble, reward, value ensemble, policy, and (optionally) termination."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.utils.spectral_norm import SpectralNorm

from torchrl_etdmpc.functional import clipped_sample, two_hot_decode
from torchrl_etdmpc.modules.dynamics import DynamicsEnsemble
from torchrl_etdmpc.modules.encoder import Encoder
from torchrl_etdmpc.modules.heads import RewardHead, TerminationHead, ValueEnsemble
from torchrl_etdmpc.modules.new_weights import draw_new_weights
from torchrl_etdmpc.modules.normed_linear import Activation
from torchrl_etdmpc.modules.policy import GaussianPolicy


class WorldModel(nn.Module):
    """All networks of EfficientTDMPC in one module (thesis Table 3.1 and Table A.1); prediction only.

    It is a :class:`~torchrl_etdmpc.modules.PredictionModel`: planners ask nothing else of it.

    One instance is shared by the planner, the losses and the reanalyze transform, so there is one set of weights and
    nothing to synchronise within a process. Ensembles are stacked; latents of several heads carry the head dimension
    first, ``[F, ..., L]``.

    Args:
        observation_dim (int, optional): O, size of the flat observation; ``None`` with an encoder of one's own.
        action_dim (int): A.
        latent_dim (int): L, a multiple of ``simnorm_dim``. Default: 512.
        mlp_dim (int): hidden size of dynamics, reward, value, policy and termination. Default: 512.
        encoder_dim (int): hidden size of the encoder. Default: 256.
        encoder_layers (int): hidden layers of the encoder; thesis Table A.1 counts the output layer too. Default: 1.
        num_dynamics (int): F, dynamics heads. Default: 4.
        num_values (int): V, value heads. Default: 2.
        simnorm_dim (int): group size of SimNorm. Default: 8.
        num_bins (int): M, bins of the reward and value distributions. Default: 101.
        bin_min (float): first bin centre, in symlog space. Default: -10.
        bin_max (float): last bin centre, in symlog space. Default: 10.
        dropout (float): of the first hidden layer of the value heads, in [0, 1). Default: 0.01.
        log_std_min (float): smallest log standard deviation of the policy. Default: -3.
        log_std_max (float): largest log standard deviation of the policy. Default: 1.
        activation (str): ``"mish"``, ``"silu"`` or ``"relu"``. Default: ``"mish"``.
        termination (bool): whether to build a termination head. Default: ``False`` (DMC never terminates).
        normalize_observations (bool): whether observations are standardised by their running mean and variance, which
            the losses move in training mode (:class:`~torchrl_etdmpc.modules.RunningNorm`). Default: ``False``.
        encoder (nn.Module, optional): an encoder of one's own, which owns its input: from whatever the observation is,
            with any leading batch, to the latent ``[..., L]``. The predictions are in the range of SimNorm (groups of
            ``simnorm_dim`` that sum to 1), so the encoder should end with it. Default: an
            :class:`~torchrl_etdmpc.modules.Encoder` of vectors.

    Raises:
        ValueError: if an argument is out of range, L is not a multiple of ``simnorm_dim``, or the encoder has dropout
            or batch normalisation in training mode.

    >>> model = WorldModel(24, 6, latent_dim=32, mlp_dim=64)
    >>> latent = model.encode(torch.zeros(7, 24))
    >>> model.next(latent.unsqueeze(0), torch.zeros(7, 6)).shape
    torch.Size([4, 7, 32])
    """

    bins: Tensor
    version: Tensor

    def __init__(
        self,
        observation_dim: int | None,
        action_dim: int,
        *,
        latent_dim: int = 512,
        mlp_dim: int = 512,
        encoder_dim: int = 256,
        encoder_layers: int = 1,
        num_dynamics: int = 4,
        num_values: int = 2,
        simnorm_dim: int = 8,
        num_bins: int = 101,
        bin_min: float = -10.0,
        bin_max: float = 10.0,
        dropout: float = 0.01,
        log_std_min: float = -3.0,
        log_std_max: float = 1.0,
        activation: Activation = "mish",
        termination: bool = False,
        normalize_observations: bool = False,
        encoder: nn.Module | None = None,
    ) -> None:
        super().__init__()
        if observation_dim is None and encoder is None:
            raise ValueError("observation_dim must be given, got None; or pass an encoder that owns its input.")
        sizes = {
            "observation_dim": 1 if observation_dim is None else observation_dim,
            "action_dim": action_dim,
            "latent_dim": latent_dim,
            "mlp_dim": mlp_dim,
            "encoder_dim": encoder_dim,
            "encoder_layers": encoder_layers,
            "num_dynamics": num_dynamics,
            "num_values": num_values,
            "simnorm_dim": simnorm_dim,
        }
        for name, size in sizes.items():
            if size < 1:
                raise ValueError(f"{name} must be at least 1, got {size}.")
        for name in ("mlp_dim", "encoder_dim", "simnorm_dim"):
            if sizes[name] < 2:
                raise ValueError(f"{name} must be at least 2, got 1: what is normalised over one number is a constant.")
        if latent_dim % simnorm_dim:
            raise ValueError(
                f"latent_dim must be a multiple of simnorm_dim={simnorm_dim}, got {latent_dim}; "
                f"the nearest is {max(round(latent_dim / simnorm_dim), 1) * simnorm_dim}."
            )
        if num_bins < 2:
            raise ValueError(f"num_bins must be at least 2, got {num_bins}.")
        if bin_min >= bin_max:
            raise ValueError(f"bin_min must be below bin_max={bin_max}, got {bin_min}.")
        for name, bound in {"bin_min": bin_min, "bin_max": bin_max}.items():
            if not abs(bound) <= 80:
                raise ValueError(
                    f"{name} must be in [-80, 80], where single precision holds symexp of it, got {bound}."
                )
        self.observation_dim = observation_dim
        self.action_dim = action_dim
        self.latent_dim = latent_dim
        self.num_dynamics = num_dynamics
        self.num_values = num_values
        if encoder is None:
            encoder = Encoder(
                sizes["observation_dim"],
                latent_dim,
                hidden_dim=encoder_dim,
                num_layers=encoder_layers,
                simnorm_dim=simnorm_dim,
                activation=activation,
                normalize=normalize_observations,
            )
        else:
            if normalize_observations:
                raise ValueError(
                    "normalize_observations is for the encoder that is built here; put a RunningNorm into your own, "
                    "and a method observe(observation, counts) that moves it."
                )
            _refuse_training_mode(encoder)
        self.encoder = encoder
        self.dynamics = DynamicsEnsemble(
            latent_dim,
            action_dim,
            num_heads=num_dynamics,
            hidden_dim=mlp_dim,
            simnorm_dim=simnorm_dim,
            activation=activation,
        )
        self.reward_head = RewardHead(
            latent_dim, action_dim, num_bins=num_bins, hidden_dim=mlp_dim, activation=activation
        )
        self.value_head = ValueEnsemble(
            latent_dim,
            num_heads=num_values,
            num_bins=num_bins,
            hidden_dim=mlp_dim,
            dropout=dropout,
            activation=activation,
        )
        self.policy = GaussianPolicy(
            latent_dim,
            action_dim,
            hidden_dim=mlp_dim,
            log_std_min=log_std_min,
            log_std_max=log_std_max,
            activation=activation,
        )
        self.termination_head = (
            TerminationHead(latent_dim, hidden_dim=mlp_dim, activation=activation) if termination else None
        )
        self._bin_ends = (bin_min, bin_max)
        self.register_buffer("bins", torch.linspace(bin_min, bin_max, num_bins))
        self.register_buffer("version", torch.zeros((), dtype=torch.int64))
        """How many gradient updates made these weights, skipped ones included; stamped on every planner target."""

    def train(self, mode: bool = True) -> WorldModel:
        """Sets the mode of all networks; what an encoder of yours has frozen (dropout, batch statistics) stays so."""
        super().train(mode)
        for _, layer in _unlike_in_training(self.encoder):
            layer.eval()
        return self

    def reset_parameters_recursive(self) -> None:
        """Draws new weights in every network (the hook that TorchRL's losses call)."""
        for network in self.children():
            draw_new_weights(network)
        self._place_bins()  # made on the meta device they have no values
        self.version.zero_()

    def _place_bins(self) -> None:
        """Puts them where they belong, as exactly as their dtype can say."""
        dtype = torch.promote_types(self.bins.dtype, torch.float32)
        self.bins.copy_(torch.linspace(*self._bin_ends, len(self.bins), dtype=dtype, device="cpu"))

    def _apply(self, fn, recurse: bool = True):
        super()._apply(fn, recurse)
        if not self.bins.is_meta:  # a cast to half precision and back would leave them rounded
            self._place_bins()
        return self

    def _load_from_state_dict(self, state_dict, prefix, *args):  # pyright: ignore[reportIncompatibleMethodOverride]
        super()._load_from_state_dict(state_dict, prefix, *args)
        if f"{prefix}bins" not in state_dict or self.bins.is_meta:
            return
        ends = state_dict[f"{prefix}bins"][[0, -1]].tolist()
        # Weights and bins belong together; those of a state in half precision are rounded to within 2^-8.
        if not all(math.isclose(*pair, rel_tol=2**-8) for pair in zip(ends, self._bin_ends, strict=True)):
            self._bin_ends = (ends[0], ends[1])
        self._place_bins()

    def encode(self, observation: Any) -> Tensor:
        """Observation ``[..., O]``, or whatever the encoder takes with a leading batch, to latent ``[..., L]``."""
        latent = self.encoder(observation)
        if latent.shape[-1:] != (self.latent_dim,):
            raise ValueError(
                f"the encoder must write latents [..., L], here L = latent_dim = {self.latent_dim}, got "
                f"{list(latent.shape)}."
            )
        return latent

    def next(self, latent: Tensor, action: Tensor) -> Tensor:
        """Steps every dynamics head on its own latent.

        Args:
            latent (Tensor): ``[F, ..., L]``, or ``[1, ..., L]`` where all heads start from the same latent; a further
                dimension of size 1 stands for many actions in one latent.
            action (Tensor): broadcastable to ``[F, ..., A]``.

        Returns:
            Tensor: ``[F, ..., L]``.
        """
        return self.dynamics(latent, action)

    def reward(self, latent: Tensor, action: Tensor) -> Tensor:
        """Expected reward of ``action [..., A]`` in ``latent [..., L]``, shape ``[...]``."""
        return two_hot_decode(self.reward_head(latent, action).to(self.bins.dtype), self.bins)

    def values(self, latent: Tensor) -> Tensor:
        """Expected value of ``latent [..., L]`` by each value head, shape ``[..., V]``; never with dropout."""
        return two_hot_decode(self.value_head(latent).to(self.bins.dtype), self.bins).movedim(0, -1)

    def termination(self, latent: Tensor) -> Tensor | None:
        """Probability that the episode terminated on reaching ``latent [..., L]``, shape ``[...]``.

        ``None`` without a termination head.
        """
        if self.termination_head is None:
            return None
        return self.termination_head(latent).to(self.bins.dtype).sigmoid()

    def act(self, latent: Tensor, noise: Tensor, log_std_bounds: tuple[float, float] | None = None) -> Tensor:
        """Samples the policy: ``clip(mean + std * noise, -1, 1)``, shape ``[..., A]``.

        Args:
            latent (Tensor): ``[..., L]``.
            noise (Tensor): standard normal draws, ``[..., A]``.
            log_std_bounds (tuple of float, optional): other bounds of the log std for this call.
        """
        mean, log_std = self.policy(latent, log_std_bounds)
        return clipped_sample(mean, log_std.exp(), noise)


def _unlike_in_training(encoder: nn.Module) -> Iterator[tuple[str, nn.Module]]:
    """Layers that act differently in training, with their names."""
    for name, layer in encoder.named_modules():
        random = isinstance(layer, nn.RReLU) or (isinstance(layer, nn.modules.dropout._DropoutNd) and layer.p > 0)
        random |= isinstance(layer, nn.MultiheadAttention | nn.RNNBase) and layer.dropout > 0
        moving = isinstance(layer, nn.modules.batchnorm._NormBase) and layer.track_running_stats
        moving |= isinstance(layer, nn.utils.parametrizations._SpectralNorm)
        moving |= any(isinstance(hook, SpectralNorm) for hook in layer._forward_pre_hooks.values())
        if random or moving:
            yield name, layer


def _refuse_training_mode(encoder: nn.Module) -> None:
    """Raises where an encoder acts differently in training: planning and evaluations use the same one, in that mode."""
    for name, layer in _unlike_in_training(encoder):
        if layer.training:
            raise ValueError(
                f"the encoder's {type(layer).__name__} {name!r} acts differently in training, and planning would use "
                "it so; leave it, or its dropout, out (LayerNorm and GroupNorm are fine), or freeze it by .eval()."
            )
