"""The contract of an environment, as a check that says how to meet it."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torchrl.data import Bounded, Composite, TensorSpec, Unbounded
from torchrl.envs import EnvBase

__all__ = ["check_env"]


def check_env(env: EnvBase) -> None:
    """Checks that an environment has the entries that planners, collectors and losses expect.

    ======================================= ==============================================================
    entry                                   contract
    ======================================= ==============================================================
    ``observation``                         float32 [O]
    ``action``                              float32 [A], bounded by exactly -1 and 1
    ``reward``                              float32 [1]
    ``terminated``, ``truncated``, ``done`` bool [1]; the time limit truncates
    ``is_init``                             bool [1]; true on the first entry of an episode
    ``episode_reward``                      float32 [1]; the sum of the rewards since the reset
    ======================================= ==============================================================

    It looks at the environment's specs and takes no step; whether the values agree with the specs is what
    :func:`torchrl.envs.utils.check_env_specs` tests.

    Args:
        env (EnvBase): any TorchRL environment, batched or not, with any transforms around it.

    Raises:
        ValueError: if anything is missing or wrong; names all of it, each with the transform that mends it.

    >>> from torchrl.envs import GymEnv
    >>> check_env(GymEnv("Pendulum-v1"))
    Traceback (most recent call last):
        ...
    ValueError: this environment cannot be used as it is: action has bounds of -2 and 2 instead of -1 and 1 (append
    ActionScaling()); is_init is missing (append InitTracker()); episode_reward is missing (append RewardSum()).
    """
    checks = (_observation, _action, _reward, _flags, _written_by_transforms)
    wrong = [fault for check in checks for fault in check(env)]
    if wrong:
        raise ValueError(f"this environment cannot be used as it is: {'; '.join(wrong)}.")


def _observation(env: EnvBase) -> Iterator[str]:
    specs = env.full_observation_spec
    spec = specs.get("observation", None)
    if spec is None:
        entries = [(key, leaf) for key, leaf in specs.items(True, True) if key != "episode_reward"]
        vectors = [key for key, leaf in entries if leaf.dtype.is_floating_point and len(_shape(env, leaf)) < 2]
        if vectors:
            yield f"observation is missing (append CatTensors(in_keys={vectors}, out_key='observation'))"
        elif any(_is_pixels(env, leaf) for _, leaf in entries):
            yield "observation is missing, and pixel observations are not supported"
        else:
            yield "observation is missing"
    elif isinstance(spec, Composite):
        yield "observation is a dictionary, which is not supported"
    elif _is_pixels(env, spec):
        yield f"observation holds pixels {list(_shape(env, spec))}, which are not supported"
    elif not isinstance(spec, (Bounded, Unbounded)):
        yield f"observation is discrete ({type(spec).__name__}), which is not supported"
    else:
        yield from _float32("observation", spec, "in_keys")
        dims = len(_shape(env, spec))
        if dims == 0:
            yield "observation is a single number (append UnsqueezeTransform(-1, in_keys=['observation']))"
        elif dims > 1:
            flatten = f"FlattenObservation({-dims}, -1, in_keys=['observation'])"
            yield f"observation has {dims} dimensions instead of 1 (append {flatten})"


def _action(env: EnvBase) -> Iterator[str]:
    keys = list(env.action_keys)
    if keys != ["action"]:
        rename = f"RenameTransform(in_keys=[], out_keys=[], in_keys_inv={keys}, out_keys_inv=['action'])"
        remedy = f" (append {rename})" if len(keys) == 1 else ""
        yield f"the actions are {keys} instead of one 'action'{remedy}"
        return
    spec = env.action_spec
    if spec.domain != "continuous":
        yield f"action is discrete ({type(spec).__name__}); only continuous actions are supported"
        return
    if not isinstance(spec, Bounded) or not (spec.space.low.isfinite().all() and spec.space.high.isfinite().all()):
        yield "action has no finite bounds, so it cannot be rescaled (give the environment's action_spec some)"
    else:
        bounds = torch.stack([spec.space.low.flatten(), spec.space.high.flatten()], -1)
        for low, high in bounds[(bounds != bounds.new_tensor([-1, 1])).any(-1)].tolist()[:1]:
            yield f"action has bounds of {low:g} and {high:g} instead of -1 and 1 (append ActionScaling())"
    yield from _float32("action", spec, "in_keys_inv")
    if len(_shape(env, spec)) != 1:
        yield f"action has the shape {list(_shape(env, spec))} instead of [A]"


def _reward(env: EnvBase) -> Iterator[str]:
    keys = list(env.reward_keys)
    if keys != ["reward"]:
        remedy = f" (append RenameTransform(in_keys={keys}, out_keys=['reward']))" if len(keys) == 1 else ""
        yield f"the rewards are {keys} instead of one 'reward'{remedy}"
        return
    yield from _float32("reward", env.reward_spec, "in_keys")
    yield from _one_number(env, "reward", env.reward_spec)


def _flags(env: EnvBase) -> Iterator[str]:
    for key in ("terminated", "truncated", "done"):
        spec = env.full_done_spec.get(key, None)
        if spec is None:
            remedy = " (append StepCounter(max_steps=...), the time limit)" if key == "truncated" else ""
            yield f"{key} is missing{remedy}"
        else:
            yield from _one_number(env, key, spec)


def _written_by_transforms(env: EnvBase) -> Iterator[str]:
    for key, dtype, transform in (
        ("is_init", torch.bool, "InitTracker"),
        ("episode_reward", torch.float32, "RewardSum"),
    ):
        spec = env.full_observation_spec.get(key, None)
        if spec is None:
            yield f"{key} is missing (append {transform}())"
        elif spec.dtype != dtype:
            yield f"{key} is {_name(spec)} instead of {str(dtype).removeprefix('torch.')}"
        else:
            yield from _one_number(env, key, spec)


def _float32(key: str, spec: TensorSpec, argument: str) -> Iterator[str]:
    if spec.dtype == torch.float32:
        return
    if spec.dtype == torch.float64:
        remedy = f"DoubleToFloat({argument}=['{key}'])"
    else:
        remedy = f"DTypeCastTransform({spec.dtype}, torch.float32, {argument}=['{key}'])"
    yield f"{key} is {_name(spec)} instead of float32 (append {remedy})"


def _one_number(env: EnvBase, key: str, spec: TensorSpec) -> Iterator[str]:
    if _shape(env, spec) != (1,):
        yield f"{key} has the shape {list(_shape(env, spec))} instead of [1]"


def _shape(env: EnvBase, spec: TensorSpec) -> torch.Size:
    """Without the environment's batch."""
    return spec.shape[len(env.batch_size) :]


def _is_pixels(env: EnvBase, spec: TensorSpec) -> bool:
    return len(_shape(env, spec)) == 3 or (spec.dtype == torch.uint8 and len(_shape(env, spec)) > 1)


def _name(spec: TensorSpec) -> str:
    return str(spec.dtype).removeprefix("torch.")
