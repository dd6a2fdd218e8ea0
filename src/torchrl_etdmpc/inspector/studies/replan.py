"""Plans, rollouts and return estimates of many states, whatever the device; everything comes back to the CPU."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchrl_etdmpc.inspector.trace import rolled_out
from torchrl_etdmpc.planners import EnsembleMPPIPlanner, Plan, PlanTrace
from torchrl_etdmpc.planners.imagination import imagined_returns

__all__ = [
    "best_sequences",
    "encode",
    "generator_of",
    "imagine",
    "policy_sequences",
    "replan",
    "return_estimates",
    "true_returns",
    "values",
]

_AT_ONCE = 64  # states; bounds the memory of a trace


def generator_of(planner: EnsembleMPPIPlanner, seed: int) -> torch.Generator:
    """Random numbers where the planner is."""
    return torch.Generator(planner.env.device_and_dtype()[0]).manual_seed(seed)


@torch.no_grad()
def replan(
    planner: EnsembleMPPIPlanner,
    observation: Tensor,
    plan_mean: Tensor | None = None,
    *,
    generator: torch.Generator,
    trace: bool = False,
) -> Plan:
    """Plans without exploration for observations ``[S, O]``, from warm starts ``[S, H, A]`` if it has one."""
    device, _ = planner.env.device_and_dtype()
    parts = []
    for start in range(0, len(observation), _AT_ONCE):
        rows = slice(start, start + _AT_ONCE)
        states = observation[rows].to(device)
        warm = None if plan_mean is None or not planner.warm_start else plan_mean[rows].to(device)
        noise = planner.draw_noise(len(states), generator=generator)
        parts.append(planner.plan(states, warm, explore=False, noise=noise, trace=trace))
    joined = [torch.cat(fields).cpu() for fields in zip(*(part[:-1] for part in parts), strict=True)]
    traces = [part.trace for part in parts if part.trace is not None]
    steps = PlanTrace(*(torch.cat(fields).cpu() for fields in zip(*traces, strict=True))) if traces else None
    return Plan(*joined, trace=steps)


def best_sequences(plan: Plan) -> Tensor:
    """The candidate with the highest score of the last iteration, ``[S, H, A]``."""
    assert plan.trace is not None
    scores = plan.trace.scores[:, -1]
    best = scores.where(scores.isfinite(), -torch.inf).argmax(-1)
    return plan.trace.actions[torch.arange(len(best)), -1, best]


@torch.no_grad()
def policy_sequences(planner: EnsembleMPPIPlanner, observation: Tensor, horizon: int) -> Tensor:
    """The policy's mean actions along the average of the heads' predictions, ``[S, H, A]``."""
    model: Any = planner.world_model
    latent, actions = model.encode(observation.to(planner.env.device_and_dtype()[0])), []
    for step in range(horizon):
        if step:
            latent = model.next(latent.unsqueeze(0), actions[-1]).mean(0)
        actions.append(model.policy(latent)[0])
    return torch.stack(actions, dim=1).cpu()


@torch.no_grad()
def encode(planner: EnsembleMPPIPlanner, observation: Tensor) -> Tensor:
    """Latents ``[..., L]`` of observations ``[..., O]``."""
    return planner.world_model.encode(observation.to(planner.env.device_and_dtype()[0])).cpu()


@torch.no_grad()
def values(planner: EnsembleMPPIPlanner, observation: Tensor) -> Tensor:
    """Mean value over the heads ``[...]`` of observations ``[..., O]``."""
    model = planner.world_model
    return model.values(model.encode(observation.to(planner.env.device_and_dtype()[0]))).mean(-1).cpu()


@torch.no_grad()
def imagine(planner: EnsembleMPPIPlanner, observation: Tensor, actions: Tensor) -> Tensor:
    """Latents of every head on its own rollout, the first one included, ``[S, F, H + 1, L]``."""
    model, device = planner.world_model, planner.env.device_and_dtype()[0]
    start = model.encode(observation.to(device))
    following = rolled_out(model, start, actions.unsqueeze(1).to(device)).squeeze(3)  # [H, F, S, L]
    return torch.cat([start.expand(1, *following.shape[1:]), following]).permute(2, 1, 0, 3).cpu()


@torch.no_grad()
def return_estimates(planner: EnsembleMPPIPlanner, observation: Tensor, actions: Tensor) -> Tensor:
    """The return table of all depths, ``[S, N, H, F, V]``, of sequences ``[S, N, H, A]``."""
    model, device = planner.world_model, planner.env.device_and_dtype()[0]
    options: dict[str, Any] = {"discount": planner.discount, "all_depths": True}
    parts = []
    for rows in torch.arange(len(observation)).split(_AT_ONCE):
        latent = model.encode(observation[rows].to(device))
        parts.append(imagined_returns(model, latent, actions[rows].to(device), **options).cpu())
    return torch.cat(parts)


def true_returns(planner: EnsembleMPPIPlanner, observation: Tensor, reward: Tensor, alive: Tensor) -> Tensor:
    """Discounted real rewards up to each depth, and the value where they led, ``[S, H]`` (thesis A.3.1).

    Args:
        planner (EnsembleMPPIPlanner): its value heads and discount.
        observation (Tensor): ``[S, H + 1, O]``.
        reward (Tensor): ``[S, H]``.
        alive (Tensor): whether the task had not ended, ``[S, H + 1]``.
    """
    powers = planner.discount ** torch.arange(reward.shape[1] + 1)
    earned = (reward * powers[:-1]).cumsum(1)
    return earned + powers[1:] * values(planner, observation[:, 1:]).where(alive[:, 1:], 0.0)
