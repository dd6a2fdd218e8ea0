"""Return estimates of imagined rollouts, and the discount that a task's length suggests."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def return_table(rewards: Tensor, values: Tensor, discount: float | Tensor, alive: Tensor | None = None) -> Tensor:
    """Every return estimate of a rollout at once: depth h, dynamics head i, value head j (thesis Eq. 3.1).

    ``Q_h(i, j) = sum_{u<h} gamma^u R(zhat_{u,i}, a_u) + gamma^h V_j(zhat_{h,i})`` for h = 1..H. With ``alive``, each
    reward and value is weighted by the predicted probability that the episode has not terminated before it.

    Args:
        rewards (Tensor): predicted reward of step u on head i's rollout, shape ``[..., H, F]``.
        values (Tensor): value of head j at ``zhat_{h,i}``, shape ``[..., D, F, V]`` for the D deepest depths
            (``D = H`` for all of them, 1 for the last only).
        discount (float or Tensor): gamma, a scalar.
        alive (Tensor, optional): probability of being alive at ``zhat_h``, h = 1..H, shape ``[..., H, F]``. Default: 1.

    Returns:
        Tensor: the table Q, shape ``[..., D, F, V]``, ordered by depth.

    Raises:
        ValueError: if D is larger than H or the head counts differ.

    >>> return_table(torch.ones(2, 1), torch.zeros(2, 1, 1), 0.5).flatten().tolist()
    [1.0, 1.5]
    """
    horizon, depths = rewards.shape[-2], values.shape[-3]
    if depths > horizon or rewards.shape[-1] != values.shape[-2]:
        raise ValueError(
            f"return_table needs rewards [..., H, F] and values [..., D, F, V] with D <= H, got {tuple(rewards.shape)} "
            f"and {tuple(values.shape)}."
        )
    powers = discount ** torch.arange(horizon + 1, device=rewards.device, dtype=rewards.dtype)
    rewards = rewards * powers[:-1, None]
    values = values * powers[horizon - depths + 1 :, None, None]
    if alive is not None:
        before = torch.cat([torch.ones_like(alive[..., :1, :]), alive[..., :-1, :]], dim=-2)
        rewards = rewards * before
        values = values * alive[..., horizon - depths :, :, None]
    return rewards.cumsum(-2)[..., horizon - depths :, :, None] + values


def bootstrapped_returns(
    rewards: Tensor,
    values: Tensor,
    discount: float | Tensor,
    *,
    terminated: Tensor | None = None,
    counts: Tensor | None = None,
) -> Tensor:
    """The n-step return of every step of a slice to the slice's end, bootstrapped with the value of its last state.

    ``G_k = r_k + gamma (1 - d_k) G_{k+1}``, with ``G_T = V(s_T)``: n is the number of steps that are left at step k.

    Args:
        rewards (Tensor): of T steps, time first, shape ``[T, ...]``.
        values (Tensor): of the states that the steps lead to, ``[T, ...]``.
        discount (float or Tensor): gamma, a scalar.
        terminated (Tensor, optional): whether a step led to a terminal state, which is worth nothing, bool
            ``[T, ...]``. Default: none did.
        counts (Tensor, optional): the steps that count, bool ``[T, ...]``, the first ones of their slice: the slice
            ends with the last of them. Default: all of them.

    Returns:
        Tensor: ``[T, ...]``.

    >>> bootstrapped_returns(torch.ones(3), torch.tensor([0.0, 0.0, 8.0]), 0.5).tolist()
    [2.75, 3.5, 5.0]
    """
    following, returns = values[-1], []
    for k in reversed(range(len(rewards))):
        if counts is not None and k + 1 < len(rewards):
            following = torch.where(counts[k + 1], following, values[k])
        if terminated is not None:
            following = torch.where(terminated[k], 0, following)
        following = rewards[k] + discount * following
        returns.append(following)
    return torch.stack(returns[::-1])


def discount_from_episode_length(
    decision_steps: float, *, discount_min: float = 0.95, discount_max: float = 0.995, denominator: float = 5.0
) -> float:
    """Discount heuristic of TD-MPC2 (arXiv:2310.16828, appendix; thesis Table A.1).

    ``clip((E / 5 - 1) / (E / 5), discount_min, discount_max)`` with E the episode length in decision steps.

    Args:
        decision_steps (float): episode length E in decision steps, positive; infinite without a time limit.
        discount_min (float): lower bound.
        discount_max (float): upper bound.
        denominator (float): the 5 of the formula.

    Returns:
        float: the discount.

    Raises:
        ValueError: if the length is not positive.

    >>> discount_from_episode_length(500)
    0.99
    """
    if not decision_steps > 0:
        raise ValueError(
            f"decision_steps must be positive, got {decision_steps}; pass the episode length in decisions."
        )
    fraction = decision_steps / denominator
    discount = 1.0 if math.isinf(fraction) else (fraction - 1) / fraction
    return min(max(discount, discount_min), discount_max)
