"""The policy loss of an action-value critic: actions of the highest value, and entropy."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.func import functional_call

from torchrl_etdmpc.functional import gaussian_entropy, tanh_log_slope, two_hot_decode
from torchrl_etdmpc.modules import ActionValueWorldModel
from torchrl_etdmpc.objectives.action_value import draw_two_heads
from torchrl_etdmpc.objectives.latent_rollout import LatentRollout, head_rows, mean_of_head_rows
from torchrl_etdmpc.objectives.latent_rollout_loss import LatentRolloutLoss
from torchrl_etdmpc.objectives.running_scale import moved_scale
from torchrl_etdmpc.objectives.slices import Slices
from torchrl_etdmpc.objectives.terms import Term, require_not_negative


class PolicyValue(NamedTuple):
    """What a policy's actions are worth, and how spread they are.

    >>> from torchrl_etdmpc.modules import ActionValueWorldModel
    >>> world_model = ActionValueWorldModel(3, 2, latent_dim=16, mlp_dim=32)
    >>> found = policy_value(world_model, torch.zeros(4, 16), torch.zeros(4, 2), torch.tensor([0, 1]))
    >>> found.entropy.shape
    torch.Size([4])
    """

    value: Tensor
    """Of a sampled action, ``[...]``."""
    entropy: Tensor
    """Sum over action dimensions, ``[...]``."""


def policy_value(
    world_model: ActionValueWorldModel,
    latent: Tensor,
    noise: Tensor,
    heads: Tensor,
    *,
    squashed_entropy: bool = True,
    dropout: bool = False,
) -> PolicyValue:
    """Value and entropy of the policy's actions, with gradient into the policy alone (TD-MPC2, arXiv:2310.16828).

    ``mean_{j in heads} Q_j(z, a)`` with ``a = tanh(m + std eps)``; the entropy of the Gaussian in closed form, and for
    that of the squashed action the sample's ``ln(1 - a^2)`` beside it.

    Args:
        world_model (ActionValueWorldModel): policy and action values.
        latent (Tensor): latents z, detached here, ``[..., L]``.
        noise (Tensor): standard normal draws eps, ``[..., A]``.
        heads (Tensor): indices of the heads that are averaged.
        squashed_entropy (bool): whether the entropy is that of the squashed action, or of the Gaussian before it.
        dropout (bool): whether the action-value heads use dropout.

    Returns:
        PolicyValue: value and entropy, each ``[...]``.

    >>> from torchrl_etdmpc.modules import ActionValueWorldModel
    >>> world_model = ActionValueWorldModel(3, 2, latent_dim=16, mlp_dim=32)
    >>> policy_value(world_model, torch.zeros(4, 16), torch.zeros(4, 2), torch.tensor([0, 1])).value.shape
    torch.Size([4])
    """
    latent = latent.detach()
    mean, log_std = world_model.policy.before_tanh(latent)
    sample = mean + log_std.exp() * noise
    critic = world_model.value_head
    frozen = {name: parameter.detach() for name, parameter in critic.named_parameters()}
    logits = functional_call(critic, frozen, (latent, sample.tanh()), {"dropout": dropout})
    value = two_hot_decode(logits.index_select(0, heads), world_model.bins).mean(0)
    # Departure from TD-MPC2, which takes minus the log-probability of a sample for the entropy of the Gaussian: the
    # closed form has the same gradient and no noise.
    entropy = gaussian_entropy(log_std)
    # Departure from TD-MPC2, whose code rescales the entropy such that the effect of the tanh cancels: it is counted,
    # unless the published behaviour is asked for.
    if squashed_entropy:
        entropy = entropy + tanh_log_slope(sample)
    return PolicyValue(value, entropy.sum(-1))


def max_q_term(loss: LatentRolloutLoss, *, policy_coef: float, entropy_coef: float, squashed_entropy: bool) -> Term:
    """The term of the policy, for any loss with the running scale ``q_scale``.

    Raises:
        ValueError: if a coefficient is negative.
    """
    require_not_negative(policy_coef=policy_coef, entropy_coef=entropy_coef)
    return Term(
        "policy",
        partial(_max_q, loss, squashed_entropy),
        policy_coef,
        networks=("policy",),
        metrics=("policy_value", "policy_entropy", "q_scale"),
        scalars={"entropy_coef": entropy_coef},
    )


def _max_q(
    loss: LatentRolloutLoss, squashed_entropy: bool, world_model: Any, slices: Slices, rollout: LatentRollout
) -> tuple[Tensor, dict[str, Tensor]]:
    heads = world_model.num_dynamics
    # Departure from TD-MPC2, which trains the policy on the last latent of the rollout too, with a weight of rho^T: a
    # term has one error for every step.
    latent = head_rows(rollout.predicted[:-1])
    # Departure from the thesis, which takes the mean of all heads: of two, drawn anew each time, as in TD-MPC2's code.
    value, entropy = policy_value(
        world_model,
        latent,
        torch.randn(*latent.shape[:-1], world_model.action_dim, device=latent.device, dtype=latent.dtype),
        draw_two_heads(world_model.num_values, latent.device),
        squashed_entropy=squashed_entropy,
        dropout=loss.training,
    )
    first = None if slices.counts is None else slices.counts[0]
    scale = moved_scale(loss, "q_scale", value[0], first)
    error = -value / scale - loss.entropy_coef * slices.action.shape[-1] * entropy
    value, entropy = (mean_of_head_rows(rows, heads) for rows in (value, entropy))
    return mean_of_head_rows(error, heads), {"policy_value": value, "policy_entropy": entropy, "q_scale": scale}
