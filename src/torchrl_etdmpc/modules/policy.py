"""The policy prior: latent to a diagonal Gaussian over actions."""

from __future__ import annotations

from torch import Tensor

from torchrl_etdmpc.functional import bounded_log_std, tanh_log_slope
from torchrl_etdmpc.modules.normed_linear import Activation, LayerStack


class GaussianPolicy(LayerStack):
    """Latent to ``mean = tanh(m)`` and a bounded log standard deviation (thesis 2.4, BMPC).

    An action is ``clip(mean + std * eps, -1, 1)``; the density is that of the unclipped Gaussian.

    Args:
        latent_dim (int): L.
        action_dim (int): A.
        hidden_dim (int): size of both hidden layers.
        log_std_min (float): smallest log standard deviation.
        log_std_max (float): largest log standard deviation.
        activation (str): of the hidden layers.

    Raises:
        ValueError: if ``log_std_min`` is not below ``log_std_max``, or one of them beyond 40.

    >>> import torch
    >>> mean, log_std = GaussianPolicy(16, 2)(torch.zeros(7, 16))
    >>> mean.shape, log_std.shape
    (torch.Size([7, 2]), torch.Size([7, 2]))
    """

    def __init__(
        self,
        latent_dim: int,
        action_dim: int,
        *,
        hidden_dim: int = 512,
        log_std_min: float = -3.0,
        log_std_max: float = 1.0,
        activation: Activation = "mish",
    ) -> None:
        if log_std_min >= log_std_max:
            raise ValueError(f"log_std_min must be below log_std_max={log_std_max}, got {log_std_min}.")
        for name, bound in {"log_std_min": log_std_min, "log_std_max": log_std_max}.items():
            if not abs(bound) <= 40:
                raise ValueError(
                    f"{name} must be in [-40, 40], where exp of it and its square are numbers, got {bound}."
                )
        super().__init__(latent_dim, [hidden_dim] * 2, 2 * action_dim, activation=activation)
        self.log_std_bounds = (log_std_min, log_std_max)

    def forward(self, latent: Tensor, log_std_bounds: tuple[float, float] | None = None) -> tuple[Tensor, Tensor]:
        """Mean and log std of the action distribution.

        Args:
            latent (Tensor): shape ``[..., L]``.
            log_std_bounds (tuple of float, optional): other bounds for this call (BMPC widens them to [-2, 1] when the
                policy proposes trajectories to the reanalyze planner). Default: the policy's own.

        Returns:
            tuple[Tensor, Tensor]: mean in (-1, 1) and log std, both of shape ``[..., A]``.
        """
        mean, log_std = self.before_tanh(latent, log_std_bounds)
        return mean.tanh(), log_std

    def before_tanh(self, latent: Tensor, log_std_bounds: tuple[float, float] | None = None) -> tuple[Tensor, Tensor]:
        """Mean before its tanh and log std, both of shape ``[..., A]``."""
        mean, raw = self.through(latent).chunk(2, dim=-1)
        return mean, bounded_log_std(raw, *(log_std_bounds or self.log_std_bounds))


class SquashedGaussianPolicy(GaussianPolicy):
    """Latent to a Gaussian that a tanh squashes into [-1, 1] (TD-MPC2, arXiv:2310.16828).

    An action is ``tanh(m + std * eps)``. Called, it answers as every policy does, with the action without noise,
    ``mean = tanh(m)``, and the log standard deviation of actions, ``std (1 - mean^2)`` for a small ``std``.

    Args:
        latent_dim (int): L.
        action_dim (int): A.
        **options: as of :class:`GaussianPolicy`.

    >>> import torch
    >>> policy = SquashedGaussianPolicy(16, 2, log_std_min=-10.0, log_std_max=2.0)
    >>> mean, log_std = policy.before_tanh(torch.zeros(7, 16))
    >>> torch.equal(policy(torch.zeros(7, 16))[0], mean.tanh())
    True
    """

    def forward(self, latent: Tensor, log_std_bounds: tuple[float, float] | None = None) -> tuple[Tensor, Tensor]:
        """Mean and log std of actions, to first order in the std before the tanh, to which the bounds apply."""
        mean, log_std = self.before_tanh(latent, log_std_bounds)
        return mean.tanh(), log_std + tanh_log_slope(mean)
