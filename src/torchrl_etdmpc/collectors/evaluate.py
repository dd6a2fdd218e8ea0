"""Whole episodes, without exploration."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor, nn
from torchrl.envs import EnvBase, ExplorationType, TensorDictPrimer
from torchrl.envs.utils import set_exploration_type

from torchrl_etdmpc.collectors.errors import NonFiniteError


class Episodes(NamedTuple):
    """What the episodes of an evaluation came to.

    >>> Episodes(returns=torch.tensor([90.0, 110.0]), lengths=torch.tensor([200, 200])).returns.mean().item()
    100.0
    """

    returns: Tensor
    """Undiscounted return of each, float32 ``[episodes]``."""
    lengths: Tensor
    """Decisions of each, int64 ``[episodes]``."""


@torch.no_grad()
def evaluate(
    env: EnvBase,
    policy: nn.Module,
    *,
    episodes: int,
    policy_device: torch.device | str | None = None,
    on_step: Callable[[TensorDictBase], None] | None = None,
) -> Episodes:
    """Plays whole episodes, acting without exploration noise.

    A batched environment runs its episodes side by side: one planning call per step serves all of them. Those that end
    first go on meanwhile, which counts for nothing. A single one is reset once for every episode, as by ``rollout``.

    Args:
        env (EnvBase): batch size [] or [n]; reset at the start.
        policy (nn.Module): TensorDict module that writes the action; a warm start it carries must be in the
            environment's specs (``env.append_transform(planner.make_tensordict_primer())``).
        episodes (int): how many episodes. With n environments they run in rounds of n.
        policy_device (torch.device, optional): where the policy's inputs go. Default: the environment's device.
        on_step (callable, optional): called with the tensordict of every step, e.g. to render a frame.

    Returns:
        Episodes: the return and the length of each, shape ``[episodes]``.

    Raises:
        NonFiniteError: if the environment returns a reward or an observation that is not finite, or the policy an
            action.
        ValueError: if ``episodes`` is not positive, or the environment has several rewards, or it does not fit the
            planner's model, e.g. because its actions have other bounds, or the planner was told to explore.

    >>> from torchrl.envs import GymEnv, RewardSum, TransformedEnv
    >>> from torchrl.envs.utils import RandomPolicy
    >>> env = TransformedEnv(GymEnv("Pendulum-v1"), RewardSum())
    >>> evaluate(env, RandomPolicy(env.action_spec), episodes=2).returns.shape
    torch.Size([2])
    """
    if episodes < 1:
        raise ValueError(f"episodes must be at least 1, got {episodes}.")
    fitting_primers(env, policy)
    planners = [part for part in _parts(policy) if hasattr(part, "make_tensordict_primer")]  # else it may mean anything
    if any(getattr(planner, "explore", None) is True for planner in planners):
        raise ValueError(
            "the planner was told to explore (planner.explore = True), and would here, too; set it to False or None, "
            "or evaluate another planner over the same world model where this one collects in a thread."
        )
    if len(env.reward_keys) != 1:
        raise ValueError(f"a return is the sum of one reward, the environment has {env.reward_keys}; keep one of them.")
    num_envs = max(env.batch_size.numel(), 1)
    if policy_device is not None and torch.device(policy_device) == env.device:
        policy_device = None
    rounds: list[Episodes] = []
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        while len(rounds) * num_envs < episodes:
            rounds.append(_round(env, policy, num_envs, policy_device, on_step))
    returns, lengths = (torch.cat(parts)[:episodes] for parts in zip(*rounds, strict=True))
    return Episodes(returns, lengths)


def fitting_primers(env: EnvBase, policy: nn.Module) -> list[TensorDictPrimer]:
    """The primers of the policy and of the modules in it; what knows what its model takes compares it first.

    Raises:
        ValueError: if environment and model do not fit.
    """
    modules = _parts(policy)
    for part in modules:
        if hasattr(part, "check_env"):
            part.check_env(env, alone=part is policy)
    parts = [part for part in modules if hasattr(part, "make_tensordict_primer")]
    primers = [part.make_tensordict_primer() for part in parts]
    for part, primer in zip(parts, primers, strict=True):
        if hasattr(primer, "check"):
            primer.check(env, alone=part is policy)
    return [primer for part, primer in zip(parts, primers, strict=True) if getattr(part, "warm_start", True)]


def _parts(policy: Any) -> list[Any]:
    return [*policy.modules()] if isinstance(policy, nn.Module) else [policy]


def decided(
    policy: Callable[[TensorDictBase], TensorDictBase],
    tensordict: TensorDictBase,
    policy_device: torch.device | str | None,
    env_device: torch.device | None,
) -> TensorDictBase:
    """The states with what the policy makes of them, which may come in a tensordict of its own."""
    if policy_device is None:
        outputs = policy(tensordict)
        return tensordict if outputs is tensordict else tensordict.update(outputs)
    module: Any = policy
    outputs = module(tensordict.select(*module.in_keys, strict=False).to(policy_device))
    return tensordict.update(outputs.select(*module.out_keys, strict=False).to(env_device or "cpu"))


def _round(
    env: EnvBase,
    policy: nn.Module,
    num_envs: int,
    policy_device: torch.device | str | None,
    on_step: Callable[[TensorDictBase], None] | None,
) -> Episodes:
    """The first episode of every environment."""
    observed = env.observation_spec.keys(include_nested=True, leaves_only=True)
    reward, done = env.reward_keys[0], next(key for key in env.done_keys if "done" in (key, key[-1]))
    actions = env.action_keys
    tensordict = env.reset()
    total = torch.zeros(num_envs, device="cpu")  # whatever the default device is
    length = torch.zeros_like(total, dtype=torch.int64)
    running = torch.ones_like(total, dtype=torch.bool)
    decisions = 0
    _require_finite(tensordict, observed, running, "the environment", decisions)
    while running.any():
        decisions += 1
        tensordict = decided(policy, tensordict, policy_device, env.device)
        _require_finite(tensordict, actions, running, "the policy", decisions)
        if env.batch_size:
            stepped, tensordict = env.step_and_maybe_reset(tensordict)
        else:  # the next episode begins with the next round's reset
            stepped = env.step(tensordict)
            tensordict = env.step_mdp(stepped)
        following = stepped.get("next")
        _require_finite(following, (reward, *observed), running, "the environment", decisions)
        total += torch.where(running, following.get(reward).reshape(num_envs).cpu(), 0)
        length += running
        running &= ~following.get(done).reshape(num_envs).cpu()
        if on_step is not None:
            on_step(stepped)
    return Episodes(total, length)


def _require_finite(
    tensordict: TensorDictBase, keys: Iterable[NestedKey], running: Tensor, source: str, decisions: int
) -> None:
    """Of the environments whose episode counts still; what the others do is thrown away."""
    for key in keys:
        value = tensordict.get(key)
        if value is None or not value.is_floating_point():
            continue
        finite = value.isfinite().reshape(len(running), -1).all(-1).cpu()
        if not finite[running].all():
            raise NonFiniteError(f"{source} returned a non-finite {key!r} at decision step {decisions}")
