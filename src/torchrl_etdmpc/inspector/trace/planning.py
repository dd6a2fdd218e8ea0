"""Planning a state again, keeping what the planner saw."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from torchrl_etdmpc.functional import (
    adaptive_mixture,
    elite_weights,
    ensemble_mean,
    ensemble_std,
    sample_elite,
    shift_plan,
)
from torchrl_etdmpc.inspector.settings import plain_settings
from torchrl_etdmpc.inspector.trace.latents import candidate_latents, rolled_out
from torchrl_etdmpc.inspector.trace.progress import watched
from torchrl_etdmpc.inspector.trace.trace import Trace, trace_of
from torchrl_etdmpc.modules.prediction import PredictionModel, has_policy
from torchrl_etdmpc.planners import AdaptiveScore, EnsembleMPPIPlanner, Plan, PlanNoise, PlanTrace
from torchrl_etdmpc.planners.imagination import propose_sequences


@torch.no_grad()
def trace_plan(
    planner: EnsembleMPPIPlanner,
    observation: Tensor | None = None,
    *,
    latent: Tensor | None = None,
    plan_mean: Tensor | None = None,
    explore: bool = False,
    seed: int = 0,
    like: Trace | None = None,
    progress: Callable[[int, int], None] | None = None,
    **about: Any,
) -> Trace:
    """Plans one state again and keeps what the planner saw.

    The plan is that of ``planner.plan`` with the noise of ``seed``. The planner stays as it is.

    Args:
        planner (EnsembleMPPIPlanner): of any :class:`~torchrl_etdmpc.modules.PredictionModel`; with other settings, see
            :func:`with_settings`.
        observation (Tensor, optional): ``[O]``, or whatever one observation is to the model.

    Keyword Args:
        latent (Tensor, optional): ``[L]``, instead of the observation.
        plan_mean (Tensor, optional): the warm start, ``[H, A]`` of any H: it is cut, or goes on with zeros. A planner
            without a warm start begins from zeros. Default: zeros.
        explore (bool): whether to choose as in training. Default: ``False``.
        seed (int): of the plan's noise. Default: 0.
        like (Trace, optional): of the same networks, whose principal components are taken, so that both can be drawn in
            one plane. Default: those of this trace's latents.
        progress (callable, optional): called between iterations with how many steps are done, of how many: an
            iteration is a step of planning and one of following its candidates through latent space. What it raises,
            e.g. :class:`Cancelled`, ends the call.
        **about: plain values for the manifest, e.g. ``task="mine"``; ``state`` and ``checkpoint`` are mappings.

    Raises:
        ValueError: if the state or the warm start has another size than the model's.

    >>> from torchrl_etdmpc import LatentEnv
    >>> from torchrl_etdmpc.testing import LineWorld
    >>> planner = EnsembleMPPIPlanner(LatentEnv(LineWorld(num_dynamics=2)), horizon=3, num_samples=32, num_elites=4)
    >>> trace = trace_plan(planner, torch.tensor([0.5]))
    >>> trace["points"].shape  # [I, N, H, F, C]
    (6, 32, 3, 2, 2)
    """
    started = time.perf_counter()
    model = planner.world_model
    device, dtype = planner.env.device_and_dtype()
    latent = _start(model, observation, latent, device, dtype)
    carried = _warm_start(planner, plan_mean, latent)
    noise = planner.draw_noise(1, generator=torch.Generator(device).manual_seed(seed))
    steps = 2 * planner.iterations
    told = planner if progress is None else watched(planner, lambda asked: progress(asked, steps))
    plan = told.plan(latent=latent[None], plan_mean=carried[None], explore=explore, noise=noise, trace=True)
    assert plan.trace is not None
    search = PlanTrace(*(field[0] for field in plan.trace))

    elites, weights = _elites(planner, search.scores)
    chosen, chosen_actions = _chosen(planner, plan, search, noise, elites, weights, explore)
    proposals = torch.arange(planner.num_samples) < planner.num_proposals
    tensors = {
        **search._asdict(),
        "elites": elites,
        "elite_weights": weights,
        "proposals": proposals,
        "latent": latent,
        "action": plan.action[0],
        "scale": plan.scale[0],
        "value": plan.value[0],
        "chosen": torch.tensor(chosen),
    }
    if planner.initial == "wide":  # "policy" does not read it
        tensors["warm_start"] = shift_plan(carried)
    if isinstance(observation, Tensor) and observation.ndim == 1:
        tensors["observation"] = observation
    if isinstance(planner.score, AdaptiveScore):
        tensors["mixture"] = _mixture(search, planner.score.beta)
    if has_policy(model):
        tensors |= _of_the_policy(planner, latent)
        if chosen_actions is None:
            chosen_actions = tensors["policy_actions"][0]
    if chosen_actions is None:  # no candidate had a finite score and there is no policy
        chosen_actions = plan.mean[0]
    tensors |= _of_the_chosen(planner, latent, chosen_actions)
    if chosen >= 0:
        tensors["chosen_returns"] = search.returns[-1, chosen]
    components, seen = candidate_latents(model, latent, search.actions, like, progress)
    tensors |= seen | {"chosen_points": components.project(rolled_out(model, latent, chosen_actions[None])[:, :, 0])}
    told = {"seed": seed, "explore": explore, "fallback": bool(plan.fallback[0])} | about
    return trace_of(planner, plain_settings(planner), tensors, started=started, **told)


def _start(
    model: PredictionModel, observation: Any, latent: Tensor | None, device: torch.device, dtype: torch.dtype
) -> Tensor:
    """The latent ``[L]`` of one state."""
    if (observation is None) == (latent is None):
        raise ValueError("trace_plan needs either an observation or a latent of one state, got both or neither.")
    if latent is None:
        if isinstance(observation, Tensor):
            wanted = model.observation_dim
            if wanted is not None and observation.shape != (wanted,):
                raise ValueError(
                    f"observation must be one state of size {wanted}, as the model was trained on, got shape "
                    f"{list(observation.shape)}; take it from the task of the checkpoint."
                )
            observation = observation.to(device, dtype if observation.is_floating_point() else None)
        latent = model.encode(observation[None])[0]
    if latent.shape != (model.latent_dim,):
        raise ValueError(f"latent must be one state of size {model.latent_dim}, got shape {list(latent.shape)}.")
    return latent.to(device, dtype)


def _warm_start(planner: EnsembleMPPIPlanner, plan_mean: Tensor | None, latent: Tensor) -> Tensor:
    carried = latent.new_zeros(planner.horizon, planner.world_model.action_dim)
    if plan_mean is None or not planner.warm_start:
        return carried
    if plan_mean.ndim != 2 or plan_mean.shape[1] != carried.shape[1]:
        raise ValueError(f"plan_mean must have shape [H, {carried.shape[1]}], got {list(plan_mean.shape)}.")
    steps = min(len(plan_mean), planner.horizon)
    carried[:steps] = plan_mean[:steps]
    return carried


def _elites(planner: EnsembleMPPIPlanner, scores: Tensor) -> tuple[Tensor, Tensor]:
    """Indices and weights ``[I, K]`` of the elites, as the planner selects them."""
    ranked, index = torch.where(scores.isfinite(), scores, -torch.inf).topk(planner.num_elites, dim=-1)
    return index, elite_weights(ranked, planner.inverse_temperature)


def _chosen(
    planner: EnsembleMPPIPlanner,
    plan: Plan,
    search: PlanTrace,
    noise: PlanNoise,
    elites: Tensor,
    weights: Tensor,
    explore: bool,
) -> tuple[int, Tensor | None]:
    """The candidate of the last iteration that acts (-1 if none) and its sequence ``[H, A]`` (``None`` on fallback)."""
    choice = planner.first_action if explore else planner.eval_first_action
    if plan.fallback[0]:
        return -1, None
    if choice == "mean":
        return -1, search.mean[-1]
    place = 0 if choice == "best" else int(sample_elite(weights[-1], noise.elite[0]))
    index = int(elites[-1, place])
    return index, search.actions[-1, index]


def _mixture(search: PlanTrace, beta: float) -> Tensor:
    """Weights ``[I, N, D]`` that the adaptive score gives the depths; NaN where it has no finite value."""
    weights = adaptive_mixture(ensemble_mean(search.returns), ensemble_std(search.returns), beta)[1]
    return weights.where(search.scores.isfinite()[..., None], torch.nan)


def _of_the_policy(planner: EnsembleMPPIPlanner, latent: Tensor) -> dict[str, Tensor]:
    """The policy's mean actions, followed by every head, and what they are worth to the planner's score."""
    model = planner.world_model
    assert has_policy(model)
    heads = model.num_dynamics
    still = latent.new_zeros(1, heads, planner.horizon, model.action_dim)
    actions = propose_sequences(model, latent[None], still)
    returns = planner.imagined_returns(latent[None], actions)[0]
    return {
        "policy_action": model.policy(latent)[0],
        "policy_actions": actions[0],
        "policy_returns": returns,
        "policy_scores": planner.score(returns),
    }


def _of_the_chosen(planner: EnsembleMPPIPlanner, latent: Tensor, actions: Tensor) -> dict[str, Tensor]:
    """The sequence with its return table and its rewards by each head."""
    model = planner.world_model
    latents = rolled_out(model, latent, actions[None])[:, :, 0]  # [H, F, L]
    before = torch.cat([latent.expand(1, *latents.shape[1:]), latents[:-1]])
    rewards = model.reward(before, actions[:, None].expand(*before.shape[:-1], -1))
    return {
        "chosen_actions": actions,
        "chosen_returns": planner.imagined_returns(latent[None], actions[None, None])[0, 0],
        "chosen_rewards": rewards,
    }
