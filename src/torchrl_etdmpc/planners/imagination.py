"""Rollouts of the world model for planning: the policy's proposals and the return table of candidates."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from torchrl_etdmpc.functional import Gaussian, return_table
from torchrl_etdmpc.modules.prediction import ActionValueModel, PolicyModel, PredictionModel


def propose_sequences(
    world_model: PolicyModel, latent: Tensor, noise: Tensor, log_std_bounds: tuple[float, float] | None = None
) -> Tensor:
    """Rolls the policy; proposal p is rolled with dynamics head p mod F.

    Args:
        world_model (PolicyModel): policy and dynamics.
        latent (Tensor): states, ``[B, L]``.
        noise (Tensor): standard normal draws for the policy, ``[B, P, H, A]``.
        log_std_bounds (tuple of float, optional): of the policy's log std. Default: the policy's own.

    Returns:
        Tensor: action sequences in [-1, 1], ``[B, P, H, A]``.
    """
    # Departure from BMPC, which has one head: round-robin, so that every head's opinion of the policy is heard at no
    # cost; the thesis does not say which head rolls the policy.
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


def policy_gaussian(
    world_model: PolicyModel, latent: Tensor, horizon: int, log_std_bounds: tuple[float, float] | None = None
) -> Gaussian:
    """The policy's Gaussian along its own mean actions, rolled by every dynamics head.

    Mean and standard deviation are those of the mixture over heads.

    Args:
        world_model (PolicyModel): policy and dynamics.
        latent (Tensor): states, ``[B, L]``.
        horizon (int): H.
        log_std_bounds (tuple of float, optional): of the policy's log std. Default: the policy's own.

    Returns:
        Gaussian: over action sequences, ``[B, H, A]``.
    """
    latent = latent.unsqueeze(0).expand(world_model.num_dynamics, -1, -1)
    means, variances = [], []
    for step in range(horizon):
        mean, log_std = world_model.policy(latent, log_std_bounds)
        means.append(mean)
        variances.append((2 * log_std).exp())
        if step + 1 < horizon:
            latent = world_model.next(latent, mean)
    mean, variance = torch.stack(means, dim=-2), torch.stack(variances, dim=-2)  # [F, B, H, A]
    centre = mean.mean(0)
    return Gaussian(centre, (variance + (mean - centre).square()).mean(0).sqrt())


def imagined_returns(
    world_model: PredictionModel,
    latent: Tensor,
    actions: Tensor,
    *,
    discount: float,
    all_depths: bool,
    bootstrap: tuple[Tensor, Tensor] | None = None,
    dtype: torch.dtype | None = None,
) -> Tensor:
    """Return table of candidates, each dynamics head on its own rollout (thesis Eq. 3.1).

    With a termination head, rewards and values are weighted by the predicted probability of being alive.

    Args:
        world_model (PredictionModel): dynamics, reward, values and termination.
        latent (Tensor): states, ``[B, L]``.
        actions (Tensor): candidates, ``[B, N, H, A]``.
        discount (float): gamma.
        all_depths (bool): whether to bootstrap at every depth, or at the last one only.
        bootstrap (tuple of Tensor, optional): with an :class:`~torchrl_etdmpc.modules.ActionValueModel`, what
            :func:`sampled_values` draws with. Default: the model's own values.
        dtype (torch.dtype, optional): in which returns are summed. Default: that of the model's rewards.

    Returns:
        Tensor: ``[B, N, D, F, V]`` with D = H, or 1 for the last depth only; V = 2 with ``bootstrap``.
    """
    latents = _rolled(world_model, latent, actions)
    reached = torch.stack(latents if all_depths else latents[-1:])
    if bootstrap is None:
        values = world_model.values(reached)  # [D, F, B, N, V]
        _check_shape(world_model, "values", values.shape, (*reached.shape[:-1], *values.shape[-1:]), "[..., V]")
    else:
        values = sampled_values(cast("ActionValueModel", world_model), reached, *bootstrap)
    rewards = _rewards_along(world_model, latent, latents, actions)
    alive = _survival(world_model, latents)
    if dtype is not None:
        rewards, values = rewards.to(dtype), values.to(dtype)
        alive = None if alive is None else alive.to(dtype)
    return return_table(rewards.permute(2, 3, 0, 1), values.permute(2, 3, 0, 1, 4), discount, alive)


class Imagination(nn.Module):
    """:func:`imagined_returns` as a module, so that ``functional_call`` can give it other weights."""

    def __init__(self, world_model: PredictionModel) -> None:
        super().__init__()
        self.world_model = world_model

    def forward(self, latent: Tensor, actions: Tensor, **options: Any) -> Tensor:
        """The return table."""
        return imagined_returns(self.world_model, latent, actions, **options)


def sampled_values(world_model: ActionValueModel, latent: Tensor, noise: Tensor, heads: Tensor) -> Tensor:
    """Values of latents by two of the action-value heads, for actions of the policy (TD-MPC2, arXiv:2310.16828).

    ``Q_j(z, a)`` with ``a ~ pi(z)``; a score's mean over heads is the average of the two.

    Args:
        world_model (ActionValueModel): policy and action values.
        latent (Tensor): ``[D, F, B, N, L]``.
        noise (Tensor): standard normal draws for the policy, ``[B, N, D, F, A]``.
        heads (Tensor): uniform draws, ``[B, V]``; the two largest pick the heads of a state.

    Returns:
        Tensor: ``[D, F, B, N, 2]``, or all heads if there are fewer.
    """
    action = world_model.act(latent, noise.permute(2, 3, 0, 1, 4))
    values = world_model.action_values(latent, action)
    picked = heads.topk(min(2, heads.shape[-1])).indices  # [B, 2]
    return values.gather(-1, picked.unsqueeze(1).expand(*values.shape[:-1], -1))


def _rolled(world_model: PredictionModel, latent: Tensor, actions: Tensor) -> list[Tensor]:
    """Latents ``[F, B, N, L]`` after each of H actions ``[B, N, H, A]``, every head on its own rollout."""
    before, latents = latent[None, :, None], []  # at the first step all heads and candidates stand on the same latent
    for step in range(actions.shape[2]):
        before = world_model.next(before, actions[:, :, step])
        heads = world_model.num_dynamics, *actions.shape[:2], world_model.latent_dim
        _check_shape(world_model, "next", before.shape, heads, "[F, ..., L]")
        latents.append(before)
    return latents


def _rewards_along(world_model: PredictionModel, latent: Tensor, latents: list[Tensor], actions: Tensor) -> Tensor:
    """Reward of every step on every head's rollout, ``[H, F, B, N]``, asked of the network in one call.

    The rewards of the first step do not depend on the head and are asked once.
    """
    heads, (states, candidates, horizon) = world_model.num_dynamics, actions.shape[:3]
    steps = actions.permute(2, 0, 1, 3)  # [H, B, N, A]
    rows = [latent.unsqueeze(1).expand(-1, candidates, -1).flatten(0, 1)]
    rows += [later.flatten(0, -2) for later in latents[:-1]]
    tried = [steps[0].flatten(0, 1), steps[1:].unsqueeze(1).expand(-1, heads, -1, -1, -1).flatten(0, -2)]
    asked = torch.cat(rows)
    rewards = world_model.reward(asked, torch.cat(tried))
    _check_shape(world_model, "reward", rewards.shape, asked.shape[:-1], "[...]")
    first, later = rewards[: states * candidates], rewards[states * candidates :]
    return torch.cat(
        [
            first.view(1, 1, states, candidates).expand(1, heads, -1, -1),
            later.view(horizon - 1, heads, states, candidates),
        ]
    )


def _survival(world_model: PredictionModel, latents: list[Tensor]) -> Tensor | None:
    """Probability ``[B, N, H, F]`` of being alive at each latent ``[F, B, N, L]``; ``None``: nothing terminates."""
    # Departure from TD-MPC2, whose episodic mode cuts a rollout where the probability passes a threshold: as a weight,
    # a calibrated probability counts for what it is.
    predicted = [world_model.termination(latent) for latent in latents]
    ended = [probability for probability in predicted if probability is not None]
    for probability in ended:
        _check_shape(world_model, "termination", probability.shape, latents[0].shape[:-1], "[...]")
    return (1 - torch.stack(ended)).cumprod(0).permute(2, 3, 0, 1) if ended else None


def _check_shape(model: PredictionModel, method: str, found: torch.Size, shape: Sequence[int], text: str) -> None:
    """Names the method of a model that returns another shape than the Protocol says, which would fail far from it."""
    if found != tuple(shape):
        raise ValueError(
            f"{type(model).__name__}.{method} must return {text} for latents [..., L], here {list(shape)}, got "
            f"{list(found)}."
        )
