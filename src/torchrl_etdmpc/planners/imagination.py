"""Rollouts of the world model for planning: the policy's proposals and the return table of candidates."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from torchrl_etdmpc.functional import return_table
from torchrl_etdmpc.modules import WorldModel


def propose_sequences(
    world_model: WorldModel, latent: Tensor, noise: Tensor, log_std_bounds: tuple[float, float] | None = None
) -> Tensor:
    """Rolls the policy; proposal p is rolled with dynamics head p mod F.

    Args:
        world_model (WorldModel): policy and dynamics.
        latent (Tensor): states, ``[B, L]``.
        noise (Tensor): standard normal draws for the policy, ``[B, P, H, A]``.
        log_std_bounds (tuple of float, optional): of the policy's log std. Default: the policy's own.

    Returns:
        Tensor: action sequences in [-1, 1], ``[B, P, H, A]``.
    """
    # Departure from BMPC, which has one head: the texts on the ensemble do not say which head rolls the policy.
    heads, (proposals, horizon) = world_model.num_dynamics, noise.shape[1:3]
    rounds = -(-proposals // heads)
    noise = F.pad(noise, (0, 0, 0, 0, 0, rounds * heads - proposals))
    noise = noise.unflatten(1, (rounds, heads)).permute(2, 3, 0, 1, 4)  # [F, H, B, rounds, A]
    latent = latent[None, :, None].expand(heads, -1, rounds, -1)
    actions = []
    for step in range(horizon):
        actions.append(world_model.act(latent, noise[:, step], log_std_bounds))
        if step + 1 < horizon:
            latent = world_model.next(latent, actions[-1])
    sequences = torch.stack(actions, dim=-2)  # [F, B, rounds, H, A]
    return sequences.permute(1, 2, 0, 3, 4).flatten(1, 2)[:, :proposals]


def imagined_returns(
    world_model: WorldModel, latent: Tensor, actions: Tensor, *, discount: float, all_depths: bool
) -> Tensor:
    """Return table of candidates, each dynamics head on its own rollout (thesis Eq. 3.1).

    With a termination head, rewards and values are weighted by the predicted probability of being alive.

    Args:
        world_model (WorldModel): dynamics, reward, values and termination.
        latent (Tensor): states, ``[B, L]``.
        actions (Tensor): candidates, ``[B, N, H, A]``.
        discount (float): gamma.
        all_depths (bool): whether to bootstrap at every depth, or at the last one only.

    Returns:
        Tensor: ``[B, N, D, F, V]`` with D = H, or 1 for the last depth only.
    """
    horizon = actions.shape[2]
    latent = latent[None, :, None].expand(1, -1, actions.shape[1], -1)
    rewards, values, alive = [], [], []
    for step in range(horizon):
        action = actions[:, :, step]
        reward = world_model.reward(latent, action)  # at the first step all heads stand on the same latent
        rewards.append(reward.expand(world_model.num_dynamics, -1, -1))
        latent = world_model.next(latent, action)
        if all_depths or step + 1 == horizon:
            values.append(world_model.values(latent))
        ended = world_model.termination(latent)
        if ended is not None:
            alive.append((1 - ended) * (alive[-1] if alive else 1))
    return return_table(
        torch.stack(rewards).permute(2, 3, 0, 1),
        torch.stack(values).permute(2, 3, 0, 1, 4),
        discount,
        torch.stack(alive).permute(2, 3, 0, 1) if alive else None,
    )
