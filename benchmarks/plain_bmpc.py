"""BMPC's plan written as one would at first: one head after the other, proposals scored again in every iteration.

The baseline of the benchmarks; equal to our planner with the same weights and noise up to rounding.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from torchrl_etdmpc.functional import bounded_log_std, simnorm, symexp
from torchrl_etdmpc.planners import Plan


def _layer(layer, x: Tensor, member: int | None) -> Tensor:
    pick = (lambda weight: weight) if member is None else (lambda weight: weight[member])
    x = F.linear(x, pick(layer.weight).T, pick(layer.bias))
    if not hasattr(layer, "norm_weight"):
        return x
    return layer.activation(F.layer_norm(x, x.shape[-1:], pick(layer.norm_weight), pick(layer.norm_bias)))


def _network(network, x: Tensor, member: int | None = None) -> Tensor:
    for layer in (*network.hidden, network.output):
        x = _layer(layer, x, member)
    return x


def _decode(logits: Tensor, bins: Tensor) -> Tensor:
    return symexp((logits.softmax(-1) * bins).sum(-1))


def _policy(model, latent: Tensor) -> tuple[Tensor, Tensor]:
    mean, raw = _network(model.policy, latent).chunk(2, dim=-1)
    return mean.tanh(), bounded_log_std(raw, *model.policy.log_std_bounds).exp()


def plan(planner, observation: Tensor, noise) -> Plan:
    """One state ``[1, O]``, one dynamics head, the final objective, the best candidate of BMPC's training action."""
    model = planner.world_model
    assert model.num_dynamics == 1 and simnorm(torch.zeros(1, 8)).shape == (1, 8)
    start = _network(model.encoder, observation)
    horizon, samples, proposals = planner.horizon, planner.num_samples, planner.num_proposals

    latent, tried = start.expand(proposals, -1), []
    for step in range(horizon):
        mean, std = _policy(model, latent)
        tried.append((mean + std * noise.proposals[0, :, step]).clamp(-1, 1))
        latent = _network(model.dynamics, torch.cat([latent, tried[-1]], -1), 0)
    proposed = torch.stack(tried, 1)  # [P, H, A]

    mean = torch.zeros(horizon, model.action_dim, device=start.device)
    std = torch.full_like(mean, planner.std_max)
    for iteration in range(planner.iterations):
        free = (mean + std * noise.candidates[0, iteration]).clamp(-1, 1)
        actions = torch.cat([proposed, free])
        latent, score, weight = start.expand(samples, -1), 0.0, 1.0
        for step in range(horizon):
            rows = torch.cat([latent, actions[:, step]], -1)
            score = score + weight * _decode(_network(model.reward_head, rows), model.bins)
            latent = _network(model.dynamics, rows, 0)
            weight *= planner.discount
        values = [_decode(_network(model.value_head, latent, member), model.bins) for member in range(model.num_values)]
        score = score + weight * torch.stack(values).mean(0)
        top, index = score.topk(planner.num_elites)
        weights = torch.softmax(planner.inverse_temperature * top, 0)[:, None, None]
        elites = actions[index]
        mean = (weights * elites).sum(0)
        std = (weights * (elites - mean).square()).sum(0).sqrt().clamp(planner.std_min, planner.std_max)
    chosen = torch.multinomial(weights.flatten(), 1)
    loc = elites[chosen, 0]
    action = (loc + std[:1] * noise.action).clamp(-1, 1)
    return Plan(action, loc, std[:1], top[chosen], mean[None], torch.zeros(1, dtype=torch.bool), None)
