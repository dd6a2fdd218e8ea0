"""Traces of TorchRL's own planners: what they have, and nothing in the place of what they lack."""

from __future__ import annotations

import copy
import time
from typing import Any

import torch
from tensordict import TensorDictBase, unravel_key
from torch import Tensor
from torchrl.modules import CEMPlanner, MPPIPlanner

from torchrl_etdmpc.inspector.trace.latents import latent_views
from torchrl_etdmpc.inspector.trace.trace import Trace, trace_of

__all__ = ["trace_torchrl_planner"]

_ADVANTAGE = "advantage"


@torch.no_grad()
def trace_torchrl_planner(
    planner: CEMPlanner | MPPIPlanner, state: TensorDictBase, *, seed: int = 0, **about: Any
) -> Trace:
    """Plans one state again with a planner of TorchRL and keeps what it saw.

    It has candidates, scores (:class:`~torchrl.modules.CEMPlanner`: the imagined rewards' sum, which is a return table
    of one depth and one head too; :class:`~torchrl.modules.MPPIPlanner`: the advantage), elites, the Gaussian, and the
    imagined observations in their principal components. It has no proposals, heads, mixture, policy or warm start. The
    planner stays as it is, and so does PyTorch's global random state, from which the planner draws.

    Args:
        planner (CEMPlanner or MPPIPlanner): with actions of one dimension ``[A]``.
        state (TensorDictBase): one state as the planner's environment takes it, batch size [].

    Keyword Args:
        seed (int): of the plan's noise. Default: 0.
        **about: plain values for the manifest.

    Raises:
        TypeError: if it is another planner.
        ValueError: if ``state`` has a batch.

    >>> from tensordict import TensorDict
    >>> from torchrl_etdmpc import LatentEnv
    >>> from torchrl_etdmpc.testing import LineWorld
    >>> env = LatentEnv(LineWorld())
    >>> planner = CEMPlanner(env, planning_horizon=3, optim_steps=2, num_candidates=16, top_k=4)
    >>> state = env.reset(TensorDict({"observation": torch.tensor([0.5])}, []))
    >>> trace = trace_torchrl_planner(planner, state)
    >>> trace["actions"].shape, trace.get("policy_action")  # [I, N, H, A]; it has no policy
    ((2, 16, 3, 1), None)
    """
    if not isinstance(planner, CEMPlanner | MPPIPlanner):
        raise TypeError(
            f"planner must be TorchRL's CEMPlanner or MPPIPlanner, got {type(planner).__name__}; trace_plan traces an "
            "EnsembleMPPIPlanner."
        )
    if state.batch_size:
        raise ValueError(f"state must be one state, got the batch size {list(state.batch_size)}; pass state[0].")
    started = time.perf_counter()
    recorder = _Recorder(planner.env)
    watched = copy.copy(planner)
    vars(watched)["env"] = recorder  # of the copy alone: what is in the object comes before its modules
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        action = planner.action_spec.project(watched.planning(state[None]))[0]

    actions = torch.stack([actions for actions, _ in recorder.seen])  # [I, N, H, A]
    scores = torch.stack([_scores(planner, rolled) for _, rolled in recorder.seen])
    ranked, elites = scores.topk(planner.top_k, dim=-1)
    mppi = isinstance(planner, MPPIPlanner)
    # As the planner has them, without a shift: where the exponential overflows, its plan is NaN.
    weights = (planner.temperature * ranked).exp() if mppi else torch.ones_like(ranked)
    weights = weights / weights.sum(-1, keepdim=True)
    best = actions.gather(1, elites[..., None, None].expand(-1, -1, *actions.shape[2:]))  # [I, K, H, A]
    mean = (weights[..., None, None] * best).sum(1)
    squares = (weights[..., None, None] * (best - mean[:, None]).square()).sum(1)
    std = squares.sqrt() if mppi else best.std(1)
    tensors = {
        "actions": actions,
        "scores": scores,
        "mean": mean,
        "std": std,
        "elites": elites,
        "elite_weights": weights,
        "proposals": torch.zeros(planner.num_candidates, dtype=torch.bool),
        "action": action,
        "value": (weights[-1] * ranked[-1]).sum(),
        "chosen": torch.tensor(-1),  # the mean acts
        "chosen_actions": mean[-1],
    }
    if not mppi:
        tensors["returns"] = scores[..., None, None, None]
    keys = [unravel_key(key) for key in planner.env.observation_spec.keys(True, True)]
    seen = [key for key in keys if (value := state.get(key, None)) is not None and value.is_floating_point()]
    if seen:
        start = torch.cat([state.get(key).flatten() for key in seen])
        rolled = [_observations(rolled, seen) for _, rolled in recorder.seen]
        tensors |= {"latent": start} | latent_views(rolled, start)[1]
    told = {"seed": seed, "explore": False, "fallback": False} | about
    return trace_of(planner, _settings(planner), tensors, started=started, **told)


class _Recorder:
    """An environment that keeps what is rolled out in it."""

    def __init__(self, env: Any) -> None:
        self.env = env
        self.seen: list[tuple[Tensor, TensorDictBase]] = []

    def __getattr__(self, name: str) -> Any:
        return getattr(self.env, name)

    def rollout(self, **options: Any) -> TensorDictBase:
        rolled = self.env.rollout(**options)
        self.seen.append((options["policy"].actions[0], rolled))  # the planner writes its advantage into the rollout
        return rolled


def _scores(planner: CEMPlanner | MPPIPlanner, rolled: TensorDictBase) -> Tensor:
    """``[N]``, of a rollout of batch size [1, N, H]."""
    if isinstance(planner, MPPIPlanner):
        return rolled.get(_ADVANTAGE)[0, :, 0, 0]
    done = rolled.get(("next", "done"))[0].int()
    before = done.cumsum(1) - done > 0  # rewards after an episode's end count for nothing
    return torch.where(before, 0, rolled.get(planner.reward_key)[0]).sum((1, 2))


def _observations(rolled: TensorDictBase, keys: list[Any]) -> Tensor:
    """``[H, 1, N, L]``, one head."""
    parts = [rolled.get(("next", *key) if isinstance(key, tuple) else ("next", key))[0].flatten(2) for key in keys]
    return torch.cat(parts, -1).transpose(0, 1).unsqueeze(1)


def _settings(planner: CEMPlanner | MPPIPlanner) -> dict[str, Any]:
    names = ("planning_horizon", "optim_steps", "num_candidates", "top_k")
    settings: dict[str, Any] = {name: getattr(planner, name) for name in names}
    if isinstance(planner, MPPIPlanner):
        settings["temperature"] = float(planner.temperature)
    return settings
