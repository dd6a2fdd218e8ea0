"""Evaluation: returns of whole episodes, without exploration."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.envs import EnvBase, ExplorationType
from torchrl.envs.utils import set_exploration_type

from torchrl_etdmpc.modules import WorldModel
from torchrl_etdmpc.training.agent import Agent


class BarePolicy(TensorDictModuleBase):
    """The policy network without the planner: acts with its mean.

    Args:
        world_model (WorldModel): encoder and policy.

    >>> from tensordict import TensorDict
    >>> policy = BarePolicy(WorldModel(3, 2, latent_dim=16, mlp_dim=32))
    >>> policy(TensorDict({"observation": torch.zeros(5, 3)}, batch_size=[5]))["action"].shape
    torch.Size([5, 2])
    """

    def __init__(self, world_model: WorldModel) -> None:
        super().__init__()
        self.world_model = world_model
        self.in_keys = ["observation"]
        self.out_keys = ["action"]

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the mean action."""
        mean, _ = self.world_model.policy(self.world_model.encode(tensordict.get("observation")))
        return tensordict.set("action", mean)


@torch.no_grad()
def evaluate(
    env: EnvBase,
    policy: nn.Module,
    *,
    episodes: int,
    policy_device: torch.device | str | None = None,
    on_step: Callable[[TensorDictBase], None] | None = None,
) -> Tensor:
    """Undiscounted returns of whole episodes, acting without exploration noise.

    A batched environment runs its episodes side by side: one planning call per step serves all of them.

    Args:
        env (EnvBase): batch size [] or [n]; reset at the start.
        policy (nn.Module): TensorDict module that writes the action; a warm start it carries must be in the
            environment's specs (``env.append_transform(planner.make_tensordict_primer())``).
        episodes (int): how many episodes. With n environments they run in rounds of n.
        policy_device (torch.device, optional): where the policy's inputs go. Default: the environment's device.
        on_step (callable, optional): called with the tensordict of every step, e.g. to render a frame.

    Returns:
        Tensor: the return of each episode, shape ``[episodes]``.

    Raises:
        ValueError: if ``episodes`` is not positive.
    """
    if episodes < 1:
        raise ValueError(f"episodes must be at least 1, got {episodes}.")
    num_envs = max(env.batch_size.numel(), 1)
    if policy_device is not None and torch.device(policy_device) == env.device:
        policy_device = None
    returns: list[Tensor] = []
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        while len(returns) * num_envs < episodes:
            returns.append(_round(env, policy, num_envs, policy_device, on_step))
    return torch.cat(returns)[:episodes]


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
            bare = self._play(BarePolicy(self.agent.world_model), on_step)
        return result._replace(policy_return=bare.mean().item())

    def _play(self, policy: nn.Module, on_step: Callable[[TensorDictBase], None] | None) -> Tensor:
        torch.manual_seed(self.seed)
        self.env.set_seed(self.seed)
        return evaluate(self.env, policy, episodes=self.episodes, policy_device=self.agent.device, on_step=on_step)

    def close(self) -> None:
        """Closes the environment."""
        self.env.close(raise_if_closed=False)


def _round(
    env: EnvBase,
    policy: nn.Module,
    num_envs: int,
    policy_device: torch.device | str | None,
    on_step: Callable[[TensorDictBase], None] | None,
) -> Tensor:
    """The first episode of every environment."""
    tensordict = env.reset()
    total = torch.zeros(num_envs)
    running = torch.ones(num_envs, dtype=torch.bool)
    while running.any():
        if policy_device is None:
            tensordict = policy(tensordict)
        else:
            inputs = tensordict.select(*policy.in_keys, strict=False).to(policy_device)
            outputs = policy(inputs).select(*policy.out_keys, strict=False)
            tensordict = tensordict.update(outputs.to(env.device or "cpu"))
        stepped, tensordict = env.step_and_maybe_reset(tensordict)
        total += torch.where(running, stepped.get(("next", "reward")).reshape(num_envs).cpu(), 0)
        running &= ~stepped.get(("next", "done")).reshape(num_envs).cpu()
        if on_step is not None:
            on_step(stepped)
    return total
