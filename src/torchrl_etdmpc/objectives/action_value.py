"""The action-value loss: TD targets of replayed rewards, and the least of two target heads."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from torch import Tensor

from torchrl_etdmpc.functional import two_hot_cross_entropy
from torchrl_etdmpc.modules import ActionValueWorldModel, WorldModel
from torchrl_etdmpc.objectives.latent_rollout import LatentRollout, head_rows, mean_of_head_rows
from torchrl_etdmpc.objectives.latent_rollout_loss import LatentRolloutLoss
from torchrl_etdmpc.objectives.slices import Slices
from torchrl_etdmpc.objectives.terms import PRIORITY, Term, require_discount, require_not_negative
from torchrl_etdmpc.objectives.value import target_heads


def draw_two_heads(num_heads: int, device: torch.device) -> Tensor:
    """Indices of two different heads, all pairs alike; of the only one if there is no second, shape ``[2]`` or ``[1]``.

    >>> len(set(draw_two_heads(5, torch.device("cpu")).tolist()))
    2
    """
    return torch.rand(num_heads, device=device).topk(min(2, num_heads)).indices


@torch.no_grad()
def action_value_target(
    world_model: ActionValueWorldModel,
    target_values: Callable[[Tensor, Tensor], Tensor],
    latent: Tensor,
    reward: Tensor,
    terminated: Tensor | None,
    noise: Tensor,
    heads: Tensor,
    discount: float | Tensor,
) -> Tensor:
    """TD target of a replayed step (TD-MPC2, arXiv:2310.16828).

    ``y = r + gamma (1 - d) min_{j in heads} Qbar_j(z', a')``, ``a' ~ pi(z')``, at the encoded next latent z'.

    Args:
        world_model (ActionValueWorldModel): the policy.
        target_values (callable): the target heads, latents ``[..., L]`` and actions ``[..., A]`` to values
            ``[..., V]``.
        latent (Tensor): the encoded next latents z', ``[..., L]``.
        reward (Tensor): replayed rewards r, ``[...]``.
        terminated (Tensor, optional): whether the step ended its episode, d, ``[...]``. Default: it never does.
        noise (Tensor): standard normal draws for the policy's action, ``[..., A]``.
        heads (Tensor): indices of the heads of which the least counts.
        discount (float or Tensor): gamma.

    Returns:
        Tensor: targets in the units of the return, without gradient, ``[...]``.

    >>> world_model = ActionValueWorldModel(3, 2, latent_dim=16, mlp_dim=32)
    >>> latent, reward, heads = world_model.encode(torch.zeros(4, 3)), torch.ones(4), torch.tensor([0, 3])
    >>> values = world_model.action_values  # new ones are 0, so that the reward is left
    >>> action_value_target(world_model, values, latent, reward, None, torch.randn(4, 2), heads, 0.99).round().tolist()
    [1.0, 1.0, 1.0, 1.0]
    """
    bootstrap = target_values(latent, world_model.act(latent, noise)).index_select(-1, heads).amin(-1)
    if terminated is not None:
        bootstrap = torch.where(terminated, 0, bootstrap)
    return reward + discount * bootstrap


def action_value_error(
    world_model: ActionValueWorldModel, rollout: LatentRollout, slices: Slices, target: Tensor, *, dropout: bool
) -> Tensor:
    """Cross-entropy of every head for the replayed action on every rollout, ``CE(Q_j(zhat_{k,i}, a_k), y_k)``.

    Args:
        world_model (ActionValueWorldModel): the action-value heads.
        rollout (LatentRollout): T steps of F heads.
        slices (Slices): the replayed actions.
        target (Tensor): y, ``[T, B]``.
        dropout (bool): whether the action-value heads use dropout.

    Returns:
        Tensor: mean over value and dynamics heads, ``[T, B]``.

    >>> from torchrl_etdmpc.objectives import TDMPC2Loss
    >>> from torchrl_etdmpc.objectives.latent_rollout import latent_rollout
    >>> from torchrl_etdmpc.testing import random_slices
    >>> world_model = ActionValueWorldModel(3, 2, latent_dim=16, mlp_dim=32)
    >>> slices = TDMPC2Loss(world_model, discount=0.99).slices(random_slices(3, 2))
    >>> rollout = latent_rollout(world_model, slices)
    >>> action_value_error(world_model, rollout, slices, torch.zeros(3, 4), dropout=False).shape
    torch.Size([3, 4])
    """
    heads = world_model.num_dynamics
    rows = head_rows(rollout.predicted[:-1]), head_rows(slices.action, heads)
    # Departure from the thesis, whose Eq. 2.14 has the squared error: the cross-entropy over bins, as in TD-MPC2's
    # code.
    logits = world_model.value_head(*rows, dropout=dropout)  # [V, 1 + (T - 1) F, B, M]
    error = two_hot_cross_entropy(logits, head_rows(target, heads), world_model.bins)
    return mean_of_head_rows(error.mean(0), heads)


@torch.no_grad()
def action_td_error(
    world_model: ActionValueWorldModel, rollout: LatentRollout, slices: Slices, target: Tensor
) -> Tensor:
    """Distance of the action values from their targets, ``mean_{i,j} |Q_j(zhat_{k,i}, a_k) - y_k|``.

    Args:
        world_model (ActionValueWorldModel): the networks, N_Q heads.
        rollout (LatentRollout): of these slices, F dynamics heads.
        slices (Slices): B slices of T steps.
        target (Tensor): y, shape ``[T, B]``.

    Returns:
        Tensor: not negative, shape ``[T, B]``.

    >>> from torchrl_etdmpc.objectives import TDMPC2Loss
    >>> from torchrl_etdmpc.objectives.latent_rollout import latent_rollout
    >>> from torchrl_etdmpc.testing import random_slices
    >>> world_model = ActionValueWorldModel(3, 2, latent_dim=16, mlp_dim=32)
    >>> slices = TDMPC2Loss(world_model, discount=0.99).slices(random_slices(3, 2))
    >>> action_td_error(world_model, latent_rollout(world_model, slices), slices, torch.zeros(3, 4)).shape
    torch.Size([3, 4])
    """
    heads = world_model.num_dynamics
    values = world_model.action_values(head_rows(rollout.predicted[:-1]), head_rows(slices.action, heads))
    return mean_of_head_rows((values - head_rows(target, heads).unsqueeze(-1)).abs().mean(-1), heads)


def action_value_term(loss: LatentRolloutLoss, world_model: WorldModel, *, value_coef: float, discount: float) -> Term:
    """The term of the action-value heads, for any loss.

    Raises:
        TypeError: if the world model has no action values.
        ValueError: if the coefficient or the discount is out of range.
    """
    if not isinstance(world_model, ActionValueWorldModel):
        raise TypeError(
            f"world_model must have action values, got {type(world_model).__name__}; build an ActionValueWorldModel."
        )
    require_not_negative(value_coef=value_coef)
    require_discount(discount)
    return Term(
        "value",
        partial(_action_value, loss),
        value_coef,
        networks=("encoder", "dynamics", "value"),
        targets=("value",),
        keys=("reward",) if world_model.termination_head is None else ("reward", "terminated"),
        metrics=("value_error", "value_target"),
        scalars={"discount": discount},
    )


def _action_value(
    loss: LatentRolloutLoss, world_model: Any, slices: Slices, rollout: LatentRollout
) -> tuple[Tensor, dict[str, Tensor]]:
    assert slices.reward is not None
    target = action_value_target(
        world_model,
        target_heads(loss, world_model, rollout),
        rollout.encoded[1:],
        slices.reward,
        slices.terminated if world_model.termination_head is not None else None,  # a term of one's own may read it
        torch.randn_like(slices.action),
        draw_two_heads(world_model.num_values, slices.action.device),
        loss.discount,
    )
    metrics = {"value_target": target}
    if slices.prioritised:
        metrics[PRIORITY] = action_td_error(world_model, rollout, slices, target)
    return action_value_error(world_model, rollout, slices, target, dropout=loss.training), metrics
