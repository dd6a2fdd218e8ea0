"""The policy loss: distillation of the planner's Gaussian into the policy."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple, get_args

import torch
from torch import Tensor

from torchrl_etdmpc.functional import gaussian_entropy, gaussian_kl
from torchrl_etdmpc.modules import WorldModel
from torchrl_etdmpc.objectives.latent_rollout import (
    LatentRollout,
    counted_mean,
    head_rows,
    mean_of_head_rows,
)
from torchrl_etdmpc.objectives.latent_rollout_loss import LatentRolloutLoss, Reduction
from torchrl_etdmpc.objectives.running_scale import moved_scale, register_scale
from torchrl_etdmpc.objectives.slices import Slices
from torchrl_etdmpc.objectives.terms import KLDirection, Term, require_not_negative

_DIRECTIONS = get_args(KLDirection)


class Distillation(NamedTuple):
    """Divergence from the planner's target and entropy of the policy."""

    kl: Tensor
    """Mean over action dimensions, ``[...]``."""
    entropy: Tensor
    """Entropy of the (unclipped) policy, sum over action dimensions, ``[...]``."""


def distillation(
    world_model: WorldModel,
    latent: Tensor,
    plan_loc: Tensor,
    plan_scale: Tensor,
    *,
    kl_direction: KLDirection = "backward",
) -> Distillation:
    """KL between the policy and the planner's target, in closed form (thesis Eq. 2.17).

    ``"backward"`` is ``KL(pi || plan)``, which BMPC's code uses; ``"forward"`` is ``KL(plan || pi)``.

    Args:
        world_model (WorldModel): the policy.
        latent (Tensor): latents, detached here, shape ``[..., L]``.
        plan_loc (Tensor): mean of the target, shape ``[..., A]``.
        plan_scale (Tensor): standard deviation of the target, shape ``[..., A]``.
        kl_direction (str): ``"backward"`` or ``"forward"``.

    Returns:
        Distillation: KL and entropy, each ``[...]``.

    >>> world_model = WorldModel(3, 2, latent_dim=16, mlp_dim=32)
    >>> latent = world_model.encode(torch.zeros(4, 3))
    >>> mean, log_std = world_model.policy(latent)
    >>> distillation(world_model, latent, mean, log_std.exp()).kl.tolist()  # it is the plan already
    [0.0, 0.0, 0.0, 0.0]
    """
    _check_direction(kl_direction)
    mean, log_std = world_model.policy(latent.detach())
    policy = (mean, log_std.exp())
    plan = (plan_loc, plan_scale)
    # Departure from section 3.2 of the thesis, which has KL(plan || policy): its Eq. 2.17 and BMPC have the other one.
    kl = gaussian_kl(*policy, *plan) if kl_direction == "backward" else gaussian_kl(*plan, *policy)
    # Departure from BMPC and TD-MPC2, which take minus the log-probability of a sample for the entropy: the closed form
    # has the same gradient and no noise.
    return Distillation(kl.mean(-1), gaussian_entropy(log_std).sum(-1))


class EfficientTDMPCPolicyLoss(LatentRolloutLoss):
    """Distils the planner into the policy (thesis Eq. 2.17; BMPC, arXiv:2503.18871).

    On the detached rollout latents, ``KL(pi || plan) / S - entropy_coef * entropy * A`` with the KL averaged over
    action dimensions; S is a running scale of the KL (5th to 95th percentile at k = 0, at least 1), moved only
    in training mode. Trains the policy alone. A step without a plan, whose ``plan_scale`` is zero as that of a
    collector's random frames is, has no error here.

    Args:
        world_model (WorldModel): the networks, shared with the caller.

    Keyword Args:
        entropy_coef (float): weight of the entropy. Default: 1e-4.
        policy_coef (float): weight of the whole term. Default: 1.
        scale_tau (float): rate of the running scale, in [0, 1]. Default: 0.01.
        kl_direction (str): ``"backward"`` (default) or ``"forward"``.
        rho (float): weight decay per step of the rollout, in (0, 1]. Default: 0.5.
        reduction (str): ``"mean"`` (default), ``"sum"`` or ``"none"`` (``[B, T]``).

    Raises:
        ValueError: if an argument is out of range.

    >>> from torchrl_etdmpc.testing import random_slices
    >>> loss = EfficientTDMPCPolicyLoss(WorldModel(3, 2, latent_dim=16, mlp_dim=32))
    >>> sorted(loss(random_slices(3, 2)).keys())
    ['kl_scale', 'loss_policy', 'policy_entropy', 'policy_kl']
    """

    def __init__(
        self,
        world_model: WorldModel,
        *,
        entropy_coef: float = 1e-4,
        policy_coef: float = 1.0,
        scale_tau: float = 0.01,
        kl_direction: KLDirection = "backward",
        rho: float = 0.5,
        reduction: Reduction | None = None,
    ) -> None:
        term = policy_term(self, policy_coef=policy_coef, entropy_coef=entropy_coef, kl_direction=kl_direction)
        super().__init__(world_model, [term], rho=rho, reduction=reduction)
        register_scale(self, "kl_scale", scale_tau)


def _check_direction(kl_direction: str) -> None:
    if kl_direction not in _DIRECTIONS:
        raise ValueError(f"kl_direction must be one of {', '.join(_DIRECTIONS)}, got {kl_direction!r}.")


def policy_term(loss: LatentRolloutLoss, *, policy_coef: float, entropy_coef: float, kl_direction: KLDirection) -> Term:
    """The term of the policy, for any loss with the running scale ``kl_scale``.

    Raises:
        ValueError: if a coefficient is negative, or the direction unknown.
    """
    require_not_negative(policy_coef=policy_coef, entropy_coef=entropy_coef)
    _check_direction(kl_direction)
    vars(loss).update(kl_direction=kl_direction)
    return Term(
        "policy",
        partial(_policy, loss),
        policy_coef,
        networks=("policy",),
        keys=("plan_loc", "plan_scale"),
        metrics=("policy_kl", "policy_entropy", "kl_scale"),
        scalars={"entropy_coef": entropy_coef},
    )


def _policy(
    loss: LatentRolloutLoss,
    world_model: WorldModel,
    slices: Slices,
    rollout: LatentRollout,
) -> tuple[Tensor, dict[str, Tensor]]:
    assert slices.plan_loc is not None and slices.plan_scale is not None
    heads = world_model.num_dynamics
    latent = head_rows(rollout.predicted[:-1])
    # Random actions of a collector have no plan, and zeros in its place: a scale of zero would make every gradient NaN.
    planned = ~(slices.plan_scale <= 0).any(-1)  # what is no number is no missing plan either
    plan_loc = torch.where(planned.unsqueeze(-1), slices.plan_loc, 0)
    plan_scale = torch.where(planned.unsqueeze(-1), slices.plan_scale, 1)
    plan = head_rows(plan_loc, heads), head_rows(plan_scale, heads)
    kl, entropy = distillation(world_model, latent, *plan, kl_direction=loss.kl_direction)
    counts = planned if slices.counts is None else planned & slices.counts
    scale = moved_scale(loss, "kl_scale", kl[0], counts[0])
    error = kl / scale - loss.entropy_coef * slices.action.shape[-1] * entropy
    policy_kl, policy_entropy = (counted_mean(mean_of_head_rows(value, heads), counts) for value in (kl, entropy))
    metrics = {"policy_kl": policy_kl, "policy_entropy": policy_entropy, "kl_scale": scale}
    return torch.where(planned, mean_of_head_rows(error, heads), 0), metrics
