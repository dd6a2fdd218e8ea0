"""The value loss: imagined and replayed targets, from encoded latents, read on every head's rollout."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch.func import functional_call

from torchrl_etdmpc.functional import (
    bootstrapped_returns,
    lower_confidence_bound,
    two_hot_cross_entropy,
    two_hot_decode,
)
from torchrl_etdmpc.modules import ActionValueWorldModel, WorldModel
from torchrl_etdmpc.objectives.latent_rollout import LatentRollout, head_rows, mean_of_head_rows
from torchrl_etdmpc.objectives.latent_rollout_loss import LatentRolloutLoss, Reduction
from torchrl_etdmpc.objectives.slices import Slices
from torchrl_etdmpc.objectives.terms import PRIORITY, Term, require_discount, require_not_negative


@torch.no_grad()
def imagined_value_target(
    world_model: WorldModel,
    target_values: Callable[[Tensor], Tensor],
    latent: Tensor,
    noise: Tensor,
    discount: float | Tensor,
    beta: float = 0.0,
) -> Tensor:
    """One-step imagined TD target at encoded latents (thesis Eq. 2.16, and 3.2 with H = 1).

    ``y = R(z, a) + gamma mean_{i,j} (1 - p(f_i(z, a))) Vbar_j(f_i(z, a))``, ``a ~ pi(z)``; p is the predicted
    probability of termination, 0 without a termination head. With ``beta``, the mean gives way to the lower bound
    ``mean - beta sigma`` that planners have (thesis 3.4.3): with one dynamics head, two value heads and ``beta=1`` to
    the lesser of two values (clipped double Q-learning, arXiv:1802.09477).

    Args:
        world_model (WorldModel): policy, reward and dynamics.
        target_values (callable): the target value heads, latents ``[..., L]`` to values ``[..., V]``.
        latent (Tensor): encoded latents z, shape ``[..., L]``.
        noise (Tensor): standard normal draws for the policy's action, shape ``[..., A]``.
        discount (float or Tensor): gamma.
        beta (float): weight of the standard deviation of the mean (thesis Eq. 3.3). Default: 0.

    Returns:
        Tensor: targets in the units of the return, without gradient, shape ``[...]``.

    >>> world_model = WorldModel(3, 2, latent_dim=16, mlp_dim=32)
    >>> latent = world_model.encode(torch.zeros(4, 3))
    >>> imagined_value_target(world_model, world_model.values, latent, torch.randn(4, 2), 0.99).shape
    torch.Size([4])
    """
    action = world_model.act(latent, noise)
    imagined = world_model.next(latent.unsqueeze(0), action)
    bootstrap = target_values(imagined)  # [F, ..., V]
    ended = world_model.termination(imagined)
    if ended is not None:
        bootstrap = bootstrap * (1 - ended).unsqueeze(-1)
    return world_model.reward(latent, action) + discount * lower_confidence_bound(bootstrap.movedim(0, -2), beta)


@torch.no_grad()
def replayed_value_target(
    target_values: Callable[[Tensor], Tensor],
    following: Tensor,
    reward: Tensor,
    discount: float | Tensor,
    beta: float = 0.0,
    *,
    terminated: Tensor | None = None,
    counts: Tensor | None = None,
) -> Tensor:
    """TD target of replayed rewards: the n-step return from every step to the end of its slice.

    ``y_k = r_k + gamma r_{k+1} + ... + gamma^{T-k} mean_j Vbar_j(z_T)``. No predicted reward or latent enters, so
    errors of the model cannot keep a value high. It is the value of the replayed behaviour, old and new, with no
    correction for being off-policy.

    Args:
        target_values (callable): the target value heads, latents ``[..., L]`` to values ``[..., V]``.
        following (Tensor): encoded latents that the T steps lead to, ``[T, ..., L]``.
        reward (Tensor): ``[T, ...]``.
        discount (float or Tensor): gamma.
        beta (float): as in :func:`imagined_value_target`, over the value heads. Default: 0.

    Keyword Args:
        terminated (Tensor, optional): whether a step led to a terminal state, bool ``[T, ...]``. Default: none did.
        counts (Tensor, optional): the steps of the slice that count, bool ``[T, ...]``. Default: all of them.

    Returns:
        Tensor: targets in the units of the return, without gradient, ``[T, ...]``.

    >>> world_model = WorldModel(3, 2, latent_dim=16, mlp_dim=32)  # values are 0 before training
    >>> latents = world_model.encode(torch.zeros(3, 4, 3))
    >>> replayed_value_target(world_model.values, latents, torch.ones(3, 4), 0.5)[:, 0].tolist()
    [1.75, 1.5, 1.0]
    """
    values = lower_confidence_bound(target_values(following).unsqueeze(-2), beta)
    return bootstrapped_returns(reward, values, discount, terminated=terminated, counts=counts)


def value_error(
    world_model: WorldModel, rollout: LatentRollout, target: Tensor, *, dropout: bool, expectile: float = 0.5
) -> Tensor:
    """Cross-entropy of every value head on every dynamics head's rollout, ``CE(V_j(zhat_{k,i}), y_k)``.

    With an expectile above 0.5 a target counts more where it is above the value, so that of what was done in a state
    the better counts more (implicit Q-learning, arXiv:2110.06169, whose squared error is the cross-entropy here).

    Args:
        world_model (WorldModel): the value heads.
        rollout (LatentRollout): T steps of F heads.
        target (Tensor): y, shape ``[T, B]``.
        dropout (bool): whether the value heads use dropout.
        expectile (float): errors count ``2 expectile`` where the target is above the value and ``2 (1 - expectile)``
            elsewhere. Default: 0.5, all alike.

    Returns:
        Tensor: mean over value and dynamics heads, shape ``[T, B]``.

    >>> world_model = WorldModel(3, 2, latent_dim=16, mlp_dim=32)
    >>> rollout = LatentRollout(torch.zeros(4, 5, 16), torch.zeros(4, world_model.num_dynamics, 5, 16))
    >>> value_error(world_model, rollout, torch.zeros(3, 5), dropout=False).shape
    torch.Size([3, 5])
    """
    heads = world_model.num_dynamics
    logits = world_model.value_head(head_rows(rollout.predicted[:-1]), dropout=dropout)  # [V, 1 + (T - 1) F, B, M]
    target = head_rows(target, heads)
    error = two_hot_cross_entropy(logits, target, world_model.bins)
    if expectile != 0.5:
        above = target > two_hot_decode(logits.detach().to(world_model.bins.dtype), world_model.bins)
        error = torch.where(above, 2 * expectile * error, 2 * (1 - expectile) * error)  # in the dtype of the error
    return mean_of_head_rows(error.mean(0), heads)


@torch.no_grad()
def td_error(world_model: WorldModel, rollout: LatentRollout, target: Tensor) -> Tensor:
    """Distance of the values from their targets, ``mean_{i,j} |V_j(zhat_{k,i}) - y_k|``, the priority of TD-MPC.

    Args:
        world_model (WorldModel): the value heads.
        rollout (LatentRollout): T steps of F heads.
        target (Tensor): y, shape ``[T, B]``.

    Returns:
        Tensor: without gradient and dropout, shape ``[T, B]``.

    >>> world_model = WorldModel(3, 2, latent_dim=16, mlp_dim=32)  # new values are 0
    >>> rollout = LatentRollout(torch.zeros(3, 1, 16), torch.zeros(3, world_model.num_dynamics, 1, 16))
    >>> td_error(world_model, rollout, torch.full((2, 1), 5.0)).round().tolist()
    [[5.0], [5.0]]
    """
    heads = world_model.num_dynamics
    values = world_model.values(head_rows(rollout.predicted[:-1]))
    return mean_of_head_rows((values - head_rows(target, heads).unsqueeze(-1)).abs().mean(-1), heads)


class EfficientTDMPCValueLoss(LatentRolloutLoss):
    """Value loss with one-step imagined targets (thesis Eq. 2.16; BMPC, arXiv:2503.18871), or with replayed ones.

    Trains the value heads, and encoder and dynamics through the rollout. The target heads are an exponential moving
    average: pass this loss to :class:`torchrl.objectives.SoftUpdate` (``tau=0.01``) and step it after every update.

    Args:
        world_model (WorldModel): the networks, shared with the caller.

    Keyword Args:
        discount (float): gamma, in (0, 1].
        value_coef (float): weight of the term. Default: 0.1.
        value_beta (float): pessimism of the targets, the weight of the standard deviation of the heads' mean, >= 0.
            Default: 0, the mean.
        value_replayed (float): weight of :func:`replayed_value_target` beside :func:`imagined_value_target`, in
            [0, 1]. Default: 0.
        value_expectile (float): which expectile of the targets the values learn, in (0, 1); see :func:`value_error`.
            Default: 0.5, their mean.
        rho (float): weight decay per step of the rollout, in (0, 1]. Default: 0.5.
        ignore_termination (bool): whether to accept rows that terminate although the world model has no termination
            head: values are then bootstrapped through the end of an episode. Otherwise such a row on the CPU is an
            error; on CUDA, where looking would wait for the device, nothing is checked. Default: ``False``.
        reduction (str): ``"mean"`` (default), ``"sum"`` or ``"none"`` (``[B, T]``).

    Raises:
        ValueError: if an argument is out of range.

    >>> from torchrl.objectives import SoftUpdate
    >>> from torchrl_etdmpc.testing import random_slices
    >>> loss = EfficientTDMPCValueLoss(WorldModel(3, 2, latent_dim=16, mlp_dim=32), discount=0.99)
    >>> updater = SoftUpdate(loss, tau=0.01)
    >>> sorted(loss(random_slices(3, 2)).keys())
    ['loss_value', 'value_error', 'value_target']
    """

    def __init__(
        self,
        world_model: WorldModel,
        *,
        discount: float,
        value_coef: float = 0.1,
        value_beta: float = 0.0,
        value_replayed: float = 0.0,
        value_expectile: float = 0.5,
        rho: float = 0.5,
        ignore_termination: bool = False,
        reduction: Reduction | None = None,
    ) -> None:
        term = value_term(
            self,
            world_model,
            value_coef=value_coef,
            value_beta=value_beta,
            value_replayed=value_replayed,
            value_expectile=value_expectile,
            discount=discount,
        )
        super().__init__(
            world_model,
            [term],
            rho=rho,
            reduction=reduction,
            ignore_termination=ignore_termination,
        )


def value_term(
    loss: LatentRolloutLoss,
    world_model: WorldModel,
    *,
    value_coef: float,
    value_beta: float,
    value_replayed: float,
    value_expectile: float,
    discount: float,
) -> Term:
    """The term of the value heads, for any loss.

    Raises:
        TypeError: if the value heads read actions.
        ValueError: if the coefficient, the discount or an option of the targets is out of range.
    """
    if isinstance(world_model, ActionValueWorldModel):
        raise TypeError(
            f"world_model must have state values, got {type(world_model).__name__}; train its action values with "
            "TDMPC2Loss."
        )
    require_not_negative(value_coef=value_coef)
    require_discount(discount)
    if not 0 <= value_beta < math.inf:
        raise ValueError(f"value_beta must be finite and not negative, got {value_beta}; 0 is the mean of the heads.")
    if not 0 <= value_replayed <= 1:
        raise ValueError(f"value_replayed must be in [0, 1], got {value_replayed}.")
    if not 0 < value_expectile < 1:
        raise ValueError(f"value_expectile must be in (0, 1), got {value_expectile}; 0.5 is the mean.")
    paid = ("reward",) if world_model.termination_head is None else ("reward", "terminated")
    # Plain numbers, which the target is built by: a tensor would be waited for at every step.
    vars(loss).update(value_beta=value_beta, value_replayed=value_replayed, value_expectile=value_expectile)
    return Term(
        "value",
        partial(_value, loss),
        value_coef,
        networks=("encoder", "dynamics", "value"),
        targets=("value",),
        keys=paid if value_replayed else (),
        metrics=("value_error", "value_target"),
        scalars={"discount": discount},
    )


def target_heads(loss: Any, world_model: WorldModel, rollout: LatentRollout) -> Callable[..., Tensor]:
    """The target value heads of a loss that trains them: what the heads read, ``[..., *]``, to values ``[..., V]``."""
    targets: Any = rollout.targets

    def values(*read: Tensor) -> Tensor:
        logits = functional_call(loss._target_value, targets["value"], read)
        return two_hot_decode(logits, world_model.bins).movedim(0, -1)

    return values


def _value(
    loss: Any,
    world_model: WorldModel,
    slices: Slices,
    rollout: LatentRollout,
) -> tuple[Tensor, dict[str, Tensor]]:
    values = target_heads(loss, world_model, rollout)
    # The targets stand on the encoded latents, never on the rollout: the rollout's errors must not enter them.
    target = torch.zeros_like(rollout.encoded[:-1, :, 0])
    value_beta, value_replayed = loss.value_beta, loss.value_replayed
    if value_replayed < 1:
        latent, noise = rollout.encoded[:-1], torch.randn_like(slices.action)
        imagined = imagined_value_target(world_model, values, latent, noise, loss.discount, value_beta)
        target = target + (1 - value_replayed) * imagined
    if value_replayed:
        if slices.reward is None:
            raise ValueError("value_replayed can leave 0 only where the loss was built with it above 0.")
        terminated = None if world_model.termination_head is None else slices.terminated
        ends: Any = {"terminated": terminated, "counts": slices.counts}
        paid = replayed_value_target(values, rollout.encoded[1:], slices.reward, loss.discount, value_beta, **ends)
        target = target + value_replayed * paid
    metrics = {"value_target": target}
    if slices.prioritised:
        metrics[PRIORITY] = td_error(world_model, rollout, target)
    error = value_error(world_model, rollout, target, dropout=loss.training, expectile=loss.value_expectile)
    return error, metrics
