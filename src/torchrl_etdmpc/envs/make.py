"""The one door: any task as a TorchRL environment."""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from torchrl.envs import EnvBase, InitTracker, ParallelEnv, RewardSum, SerialEnv, VecNorm
from torchrl.envs.transforms import VecNormV2

from torchrl_etdmpc.envs.check import check_env
from torchrl_etdmpc.envs.dmc import dmc_maker
from torchrl_etdmpc.envs.gymnasium import gymnasium_maker
from torchrl_etdmpc.envs.humanoid_bench import humanoid_bench_maker
from torchrl_etdmpc.envs.layers import transforms_of, wrappers_of
from torchrl_etdmpc.envs.tasks import Maker, Task, get_task, registered_maker
from torchrl_etdmpc.envs.worker import make_in_worker, start_workers

# Each says which function makes one environment of a task, or why it cannot be made on this machine.
_SUITES: dict[str, Callable[[Task], Maker]] = {
    "dm_control": dmc_maker,
    "gymnasium": gymnasium_maker,
    "humanoid_bench": humanoid_bench_maker,
}

# How long closed processes may take to end by themselves, in seconds. They often hang in their last moment, and TorchRL
# would wait for 10.
_SHUTDOWN_S = 2


def make_env(
    task: str | Task,
    *,
    seed: int | None = None,
    num_envs: int = 1,
    parallel: bool = True,
    device: torch.device | str = "cpu",
) -> EnvBase:
    """Makes a task of any suite an environment of the shape that planners, collectors and losses expect.

    The environment keeps the contract of :func:`~torchrl_etdmpc.envs.check_env`. A decision repeats its action for the
    task's ``action_repeat`` env steps, or up to the end of the episode, and its reward is their sum.

    Args:
        task (str or Task): a name that :func:`~torchrl_etdmpc.envs.get_task` knows, or a task.
        seed (int, optional): seeds the initial states, in [0, 2**32 - 1]; ``None`` draws them from the operating
            system. With several environments each gets its own seed, derived from this one.
        num_envs (int): how many copies, at least 1. One is the environment itself, with batch size []. More are
            processes of a :class:`~torchrl.envs.ParallelEnv` with batch size [num_envs]; a script that makes them needs
            the usual ``if __name__ == "__main__":`` guard, and should close them. SIGINT, SIGTERM, SIGUSR1 and
            SIGHUP do not end them: their owner saves first and ends them. If it dies, they end within ten seconds.
        parallel (bool): ``False`` steps several environments one after the other in this process instead
            (:class:`~torchrl.envs.SerialEnv`); on few cores that is faster.
        device (torch.device or str): where the tensors go; the physics runs on the CPU.

    Returns:
        EnvBase: the environment.

    Raises:
        ImportError: if the suite is missing, or cannot work with what is installed.
        ValueError: if the task or its suite is unknown, if its environment does not keep the contract or normalises by
            statistics that move, or if ``num_envs`` is below 1.
        RuntimeError: if a process ended before its environment was made.

    >>> from torchrl_etdmpc.envs import make_env
    >>> env = make_env("walker-walk", seed=0)
    >>> env.observation_spec["observation"].shape, env.action_spec.shape
    (torch.Size([24]), torch.Size([6]))
    >>> rollout = env.rollout(3)
    >>> rollout["next", "reward"].shape
    torch.Size([3, 1])
    >>> rollout["is_init"].squeeze(-1).tolist()
    [True, False, False]
    """
    task = get_task(task) if isinstance(task, str) else task
    if num_envs < 1:
        raise ValueError(f"num_envs must be at least 1, got {num_envs}.")
    make = partial(_make_one, find_maker(task), task)
    if num_envs == 1:
        env = make(device=device)
    elif not parallel:
        env = SerialEnv(num_envs, partial(make, device="cpu"), device=device, num_threads=torch.get_num_threads())
    else:
        # Left alone, ParallelEnv would change this process' own number of threads.
        in_worker = partial(make_in_worker, make, os.getpid())
        env = ParallelEnv(
            num_envs, in_worker, device=device, num_threads=torch.get_num_threads(), shutdown_timeout=_SHUTDOWN_S
        )
        try:
            start_workers(env)
        except EOFError:
            raise RuntimeError(
                f"a process of task {task.name!r} ended before its environment was made; its own error is above."
            ) from None
    if seed is not None:
        env.set_seed(seed)
    return env


def find_maker(task: Task) -> Maker:
    """The function that makes one environment of a task: the task's own, or its suite's.

    Raises:
        ImportError: if the suite is missing, or cannot work with what is installed.
        ValueError: if there is none.
    """
    if task.observation != "vector":
        raise ValueError(f"observation of task {task.name!r} must be 'vector', got {task.observation!r}.")
    own = registered_maker(task)
    if own is not None:
        return own
    if task.suite not in _SUITES:
        raise ValueError(
            f"nothing makes the suite {task.suite!r} of task {task.name!r}; suites are {', '.join(_SUITES)}, and "
            "register_task(task, make) takes a maker of your own."
        )
    return _SUITES[task.suite](task)


def _make_one(make: Maker, task: Task, *, device: torch.device | str) -> EnvBase:
    env = make(task, device=device)
    if not isinstance(env, EnvBase):
        raise ValueError(f"the maker of task {task.name!r} must return a TorchRL environment, got {env!r}.")
    if env.batch_size:
        raise ValueError(f"task {task.name!r} must be a single environment, got batch size {list(env.batch_size)}.")
    moving = [(layer, "freeze() them") for layer in transforms_of(env) if _moves(layer)]
    moving += [(layer, "set update_running_mean = False") for layer in wrappers_of(env) if _moves(layer)]
    if moving:
        layer, remedy = moving[0]
        raise ValueError(
            f"task {task.name!r}: {type(layer).__name__} has statistics that move, other ones in every copy of the "
            f"environment, so training and evaluation would see different numbers; {remedy}, or leave it out and set "
            "model.normalize_observations=true, whose statistics are the agent's."
        )
    # The two entries that can be added without guessing; a sum of rewards that transforms have changed is another one.
    changed = _rewards_change(env)
    for key, transform in (("is_init", InitTracker), ("episode_reward", RewardSum)):
        if env.full_observation_spec.get(key, None) is None or (transform is RewardSum and changed):
            env = env.append_transform(transform())
    try:
        check_env(env)
    except ValueError as error:
        raise ValueError(f"task {task.name!r}: {error}") from None
    return env


def _moves(layer: Any) -> bool:
    """Whether a transform, or a wrapper of Gymnasium, has statistics that its steps move."""
    if isinstance(layer, VecNorm | VecNormV2):
        return not layer.frozen
    return getattr(layer, "update_running_mean", None) is True


def _rewards_change(env: EnvBase) -> bool:
    """Whether transforms change rewards of which the simulator itself writes the sum, as those of the suites do."""
    transforms = transforms_of(env)
    if any(isinstance(transform, RewardSum) for transform in transforms):
        return False
    return any(key in (transform.out_keys or ()) for transform in transforms for key in env.reward_keys)
