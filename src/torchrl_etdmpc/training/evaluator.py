"""Evaluation of a run: the same episodes every time."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.envs import EnvBase

from torchrl_etdmpc.collectors import evaluate
from torchrl_etdmpc.planners import BarePolicy
from torchrl_etdmpc.training.agent import Agent


class EvaluationResult(NamedTuple):
    """What one evaluation measured, as ``eval.csv`` names it."""

    return_mean: float
    return_std: float
    episodes: int
    policy_return: float = math.nan
    """Mean return of the policy without the planner, if it was asked for."""


class Evaluator:
    """Plays the same episodes every time, so that what differs between two evaluations of a run is the agent.

    Initial states and random numbers follow from ``seed`` alone, and those of the caller stay as they are: training is
    the same whether it is evaluated or not, and a run that goes on needs nothing of its former evaluations.

    Args:
        env (EnvBase): batch size [] or [n], without the planner's warm start; closed by :meth:`close`.
        agent (Agent): its ``eval_planner`` acts.

    Keyword Args:
        episodes (int): how many.
        seed (int): of the episodes.
        with_policy (bool): whether the policy without the planner plays them too. Default: ``False``.
    """

    def __init__(self, env: EnvBase, agent: Agent, *, episodes: int, seed: int, with_policy: bool = False) -> None:
        self.env = env.append_transform(agent.eval_planner.make_tensordict_primer())
        self.agent = agent
        self.episodes = episodes
        self.seed = seed
        self.with_policy = with_policy

    def __call__(self, on_step: Callable[[TensorDictBase], None] | None = None) -> EvaluationResult:
        """Evaluates the agent as it is now.

        Args:
            on_step (callable, optional): called with the tensordict of every step; an exception ends the evaluation.
        """
        device = self.agent.device
        with torch.random.fork_rng([device] if device.type == "cuda" else []):
            returns = self._play(self.agent.eval_planner, on_step)
            result = EvaluationResult(returns.mean().item(), returns.std(correction=0).item(), len(returns))
            if not self.with_policy:
                return result
            bare = self._play(BarePolicy(self.agent.acting_model), on_step)
        return result._replace(policy_return=bare.mean().item())

    def _play(self, policy: nn.Module, on_step: Callable[[TensorDictBase], None] | None) -> Tensor:
        torch.manual_seed(self.seed)
        self.env.set_seed(self.seed)
        return evaluate(self.env, policy, episodes=self.episodes, policy_device=self.agent.device, on_step=on_step)

    def close(self) -> None:
        """Closes the environment."""
        self.env.close(raise_if_closed=False)
