"""Evaluation of a run: the same episodes every time."""

from __future__ import annotations

import contextlib
import random
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import nn
from torchrl.envs import EnvBase

from torchrl_etdmpc.collectors import Episodes, evaluate
from torchrl_etdmpc.envs.seeding import seed_everything
from torchrl_etdmpc.planners import BarePolicy
from torchrl_etdmpc.training.agent import Agent


@contextlib.contextmanager
def _forked_global_generators() -> Iterator[None]:
    """Gives Python's and NumPy's global generators back as they were; simulators may draw from them."""
    ours, numpys = random.getstate(), np.random.get_state()
    try:
        yield
    finally:
        random.setstate(ours)
        np.random.set_state(numpys)


class EvaluationResult(NamedTuple):
    """What one evaluation measured, as ``eval.csv`` names it; ``None``: it was not asked for.

    >>> EvaluationResult(return_mean=800.0, return_std=20.0, episodes=10).return_mean
    800.0
    """

    return_mean: float
    return_std: float
    episodes: int
    length_mean: float | None = None
    """Mean number of decisions of an episode."""
    success: float | None = None
    """Share of the episodes whose return reaches that of a success."""
    policy_return: float | None = None
    """Mean return of the policy without the planner."""


class Evaluator:
    """Plays the same episodes every time, so that what differs between two evaluations of a run is the agent.

    Initial states and random numbers follow from ``seed`` alone, unless several environments play more than an episode
    each and episodes end early: when the next ones begin is then the agent's doing. The random numbers of the caller
    stay as they are, PyTorch's and those of the generators that Python and NumPy share with simulators of this process:
    training is the same whether it is evaluated or not, and a run that goes on needs nothing of its former evaluations.

    Args:
        env (EnvBase): batch size [] or [n], without the planner's warm start; closed by :meth:`close`.
        agent (Agent): its ``eval_planner`` acts.

    Keyword Args:
        episodes (int): how many.
        seed (int): of the episodes.
        with_policy (bool): whether the policy without the planner plays them too. Default: ``False``.
        with_lengths (bool): whether the episodes' lengths are reported. Default: ``False``.
        success_return (float, optional): the return from which an episode is a success; see
            :func:`~torchrl_etdmpc.envs.success_return`. Default: ``None``, no success is reported.

    >>> from torchrl_etdmpc.envs import make_env
    >>> from torchrl_etdmpc.training import build_agent, preset
    >>> env = make_env("gym/Pendulum-v1", num_envs=2, parallel=False)
    >>> agent = build_agent(preset("cpu"), observation_dim=3, action_dim=1)
    >>> evaluator = Evaluator(env, agent, episodes=2, seed=0)  # evaluator() plays them
    >>> evaluator.close()
    """

    def __init__(
        self,
        env: EnvBase,
        agent: Agent,
        *,
        episodes: int,
        seed: int,
        with_policy: bool = False,
        with_lengths: bool = False,
        success_return: float | None = None,
    ) -> None:
        self.env = env.append_transform(agent.eval_planner.make_tensordict_primer())
        self.agent = agent
        self.episodes = episodes
        self.seed = seed
        self.with_policy = with_policy
        self.with_lengths = with_lengths
        self.success_return = success_return

    def __call__(self, on_step: Callable[[TensorDictBase], None] | None = None) -> EvaluationResult:
        """Evaluates the agent as it is now.

        Args:
            on_step (callable, optional): called with the tensordict of every step; an exception ends the evaluation.
        """
        device = self.agent.device
        with torch.random.fork_rng([device] if device.type == "cuda" else []), _forked_global_generators():
            played = self._play(self.agent.eval_planner, on_step)
            bare = self._play(BarePolicy(self.agent.acting_model), on_step) if self.with_policy else None
        returns, least = played.returns, self.success_return
        return EvaluationResult(
            returns.mean().item(),
            returns.std(correction=0).item(),
            len(returns),
            length_mean=played.lengths.float().mean().item() if self.with_lengths else None,
            success=None if least is None else (returns >= least).float().mean().item(),
            policy_return=None if bare is None else bare.returns.mean().item(),
        )

    def _play(self, policy: nn.Module, on_step: Callable[[TensorDictBase], None] | None) -> Episodes:
        seed_everything(self.seed)
        self.env.set_seed(self.seed)
        return evaluate(self.env, policy, episodes=self.episodes, policy_device=self.agent.device, on_step=on_step)

    def close(self) -> None:
        """Closes the environment."""
        self.env.close(raise_if_closed=False)
