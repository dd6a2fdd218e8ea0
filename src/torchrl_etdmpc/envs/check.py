"""The contract of an environment, as a check that says how to meet it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
from tensordict import NestedKey, unravel_key
from torchrl.data import Bounded, Composite, TensorSpec, Unbounded
from torchrl.envs import DTypeCastTransform, EnvBase, FrameSkipTransform

from torchrl_etdmpc.envs.layers import transforms_by_layer

UNLIMITED = 1e10
"""MuJoCo's bound of an actuator that has none (mjMAXVAL)."""


def check_env(env: EnvBase, model: Any = None) -> None:
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

    It looks at the environment's specs and transforms and takes no step; whether the values agree with the specs is
    what :func:`torchrl.envs.check_env_specs` tests.

    Args:
        env (EnvBase): any TorchRL environment, batched or not, with any transforms around it.
        model (nn.Module, optional): a world model that the environment is for: O and A must be its ``observation_dim``
            and ``action_dim``, and their dtype that of its weights. Where ``observation_dim`` is not a number, the
            model encodes what it likes and the observation is not checked. Default: any size, float32.

    Raises:
        ValueError: if anything is missing or wrong; names all of it, each with the transform that mends it.

    >>> from torchrl.envs import GymEnv
    >>> check_env(GymEnv("Pendulum-v1"))
    Traceback (most recent call last):
        ...
    ValueError: this environment cannot be used as it is: action has bounds of -2 and 2 instead of -1 and 1 (append
    ActionScaling()); is_init is missing (append InitTracker()); episode_reward is missing (append RewardSum()).
    """
    sizes = model_sizes(model) if model is not None else {}
    faults = [*_spaces(env, **sizes), *_reward(env), *_flags(env), *_written_by_transforms(env)]
    if faults:
        raise ValueError(f"this environment cannot be used as it is: {'; '.join(faults)}.")


def check_spaces(
    env: EnvBase,
    *,
    observation_dim: int | None,
    action_dim: int | None,
    dtype: torch.dtype = torch.float32,
    observation_key: NestedKey = "observation",
    action_key: NestedKey = "action",
) -> None:
    """The part of :func:`check_env` that is between an environment and what acts in it.

    Args:
        env (EnvBase): as for :func:`check_env`.

    Keyword Args:
        observation_dim (int, optional): O that the model takes; ``None`` if it encodes what it likes, which is not
            checked.
        action_dim (int, optional): A that the model takes; ``None`` if what acts writes another action, which is not
            checked.
        dtype (torch.dtype): of both. Default: float32.
        observation_key (NestedKey): Default: ``"observation"``.
        action_key (NestedKey): Default: ``"action"``.

    Raises:
        ValueError: if the action is not continuous, not bounded by exactly -1 and 1 or of another size or dtype, or the
            observation is no vector of the size and dtype; each with what mends it.

    >>> from torchrl.envs import GymEnv
    >>> check_spaces(GymEnv("Pendulum-v1"), observation_dim=3, action_dim=1)
    Traceback (most recent call last):
        ...
    ValueError: this environment does not fit the model: action has bounds of -2 and 2 instead of -1 and 1 (append
    ActionScaling()).
    """
    keys = {"observation_key": observation_key, "action_key": action_key}
    faults = [*_spaces(env, observation_dim=observation_dim, action_dim=action_dim, dtype=dtype, **keys)]
    if faults:
        raise ValueError(f"this environment does not fit the model: {'; '.join(faults)}.")


def model_sizes(model: Any) -> dict[str, Any]:
    """The arguments of :func:`check_spaces` that a world model decides."""
    size = getattr(model, "observation_dim", None)
    dtypes = (tensor.dtype for tensor in (*model.parameters(), *model.buffers()) if tensor.is_floating_point())
    return {
        "observation_dim": size if isinstance(size, int) else None,
        "action_dim": model.action_dim,
        "dtype": next(dtypes, torch.get_default_dtype()),
    }


def env_sizes(env: EnvBase) -> dict[str, int]:
    """The sizes that a model of an environment is built with.

    Args:
        env (EnvBase): one that :func:`make_env` made, or with its keys.

    Returns:
        dict: ``observation_dim`` and ``action_dim``.

    >>> from torchrl_etdmpc.envs import make_env
    >>> env_sizes(make_env("gym/Pendulum-v1"))
    {'observation_dim': 3, 'action_dim': 1}
    """
    return {
        "observation_dim": env.observation_spec["observation"].shape[-1],
        "action_dim": env.action_spec.shape[-1],
    }


_ANY_SIZE = -1


def _spaces(
    env: EnvBase,
    *,
    observation_dim: int | None = _ANY_SIZE,
    action_dim: int | None = _ANY_SIZE,
    dtype: torch.dtype = torch.float32,
    observation_key: NestedKey = "observation",
    action_key: NestedKey = "action",
) -> Iterator[str]:
    if observation_dim is not None:
        yield from _observation(env, unravel_key(observation_key), observation_dim, dtype)
    if action_dim is not None:
        yield from _action(env, unravel_key(action_key), action_dim, dtype)


def _observation(env: EnvBase, key: NestedKey, size: int, dtype: torch.dtype) -> Iterator[str]:
    specs = env.full_observation_spec
    spec = specs.get(key, None)
    name = _text(key)
    if spec is None:
        entries = [(key, leaf) for key, leaf in specs.items(True, True) if leaf.dtype and key != "episode_reward"]
        vectors = [key for key, leaf in entries if leaf.dtype.is_floating_point and len(_shape(env, leaf)) < 2]
        if vectors:
            for number in (each for each in vectors if not _shape(env, specs[each])):
                yield f"{_text(number)} is a single number (append UnsqueezeTransform(-1, in_keys=[{number!r}]))"
            if len({specs[each].dtype for each in vectors}) > 1:  # CatTensors' spec has the first one's
                for each in vectors:
                    yield from _dtype(each, specs[each], dtype, "in_keys")
            yield f"{name} is missing (append CatTensors(in_keys={vectors}, out_key={key!r}))"
        elif any(_is_pixels(env, leaf) for _, leaf in entries):
            yield f"{name} is missing, and pixel observations are not supported"
        else:
            yield f"{name} is missing"
    elif isinstance(spec, Composite):
        yield f"{name} is a dictionary, which is not supported"
    elif _is_pixels(env, spec):
        yield f"{name} holds pixels {list(_shape(env, spec))}, which are not supported"
    elif not isinstance(spec, (Bounded, Unbounded)):
        yield f"{name} is discrete ({type(spec).__name__}), which is not supported"
    else:
        yield from _dtype(key, spec, dtype, "in_keys")
        shape = _shape(env, spec)
        if len(shape) == 0:
            yield f"{name} is a single number (append UnsqueezeTransform(-1, in_keys=[{key!r}]))"
        elif len(shape) > 1:
            flatten = f"FlattenObservation({-len(shape)}, -1, in_keys=[{key!r}])"
            yield f"{name} has {len(shape)} dimensions instead of 1 (append {flatten})"
        elif size not in (_ANY_SIZE, shape[0]):
            yield (
                f"{name} has {shape[0]} entries instead of the model's {size} (build the model with "
                f"observation_dim={shape[0]}, or append CatTensors if the environment writes more than one vector)"
            )


def _action(env: EnvBase, key: NestedKey, size: int, dtype: torch.dtype) -> Iterator[str]:
    keys = list(env.action_keys)
    if keys != [key]:
        rename = f"RenameTransform(in_keys=[], out_keys=[], in_keys_inv={keys}, out_keys_inv=[{key!r}])"
        remedy = f" (append {rename})" if len(keys) == 1 else ""
        yield f"the actions are {keys} instead of one {key!r}{remedy}"
        return
    spec = env.full_action_spec[key]
    yield from action_faults(spec, dtype, key)
    yield from _repeats(env, key)
    shape = _shape(env, spec)
    if spec.domain != "continuous":
        return
    if len(shape) != 1:
        flatten = f" (append FlattenAction({-len(shape)}, -1, in_keys_inv=[{key!r}]))" if shape else ""
        yield f"{_text(key)} has the shape {list(shape)} instead of [A]{flatten}"
    elif size not in (_ANY_SIZE, shape[0]):
        yield (
            f"{_text(key)} has {shape[0]} entries instead of the model's {size} (build the model with "
            f"action_dim={shape[0]})"
        )


def _repeats(env: EnvBase, key: NestedKey) -> Iterator[str]:
    """TorchRL's FrameSkipTransform repeats what the transforms before it have made of an action, through them again."""
    for layer in transforms_by_layer(env):
        before: list[str] = []
        for transform in layer:
            if isinstance(transform, FrameSkipTransform) and transform.frame_skip > 1 and before:
                name, first = type(transform).__name__, ", ".join(before)
                yield f"{_text(key)} is changed once more by each of its repeats (append {name} before {first})"
            elif transform.in_keys_inv and not isinstance(transform, DTypeCastTransform):
                before.append(type(transform).__name__)


def action_faults(spec: TensorSpec, dtype: torch.dtype = torch.float32, key: NestedKey = "action") -> Iterator[str]:
    """What keeps an action's spec, whatever its size, from being continuous in [-1, 1]."""
    name = _text(key)
    if spec.domain != "continuous":
        yield f"{name} is discrete ({type(spec).__name__}); only continuous actions are supported"
        return
    if not isinstance(spec, Bounded) or not (torch.stack([spec.space.low, spec.space.high]).abs() < UNLIMITED).all():
        yield f"{name} has no finite bounds, so it cannot be rescaled (give the environment's action_spec some)"
    else:
        bounds = torch.stack([spec.space.low.flatten(), spec.space.high.flatten()], -1)
        for low, high in bounds[(bounds != bounds.new_tensor([-1, 1])).any(-1)].tolist()[:1]:
            yield f"{name} has bounds of {low:g} and {high:g} instead of -1 and 1 (append ActionScaling())"
    yield from _dtype(key, spec, dtype, "in_keys_inv")


def _reward(env: EnvBase) -> Iterator[str]:
    keys = list(env.reward_keys)
    if keys != ["reward"]:
        remedy = f" (append RenameTransform(in_keys={keys}, out_keys=['reward']))" if len(keys) == 1 else ""
        yield f"the rewards are {keys} instead of one 'reward'{remedy}"
        return
    yield from _dtype("reward", env.reward_spec, torch.float32, "in_keys")
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
            yield f"{key} is {_name(spec.dtype)} instead of {_name(dtype)}"
        else:
            yield from _one_number(env, key, spec)


def _dtype(key: NestedKey, spec: TensorSpec, dtype: torch.dtype, argument: str) -> Iterator[str]:
    if spec.dtype == dtype:
        return
    if (spec.dtype, dtype) == (torch.float64, torch.float32):
        remedy = f"DoubleToFloat({argument}=[{key!r}])"
    else:
        remedy = f"DTypeCastTransform({spec.dtype}, {dtype}, {argument}=[{key!r}])"
    yield f"{_text(key)} is {_name(spec.dtype)} instead of {_name(dtype)} (append {remedy})"


def _one_number(env: EnvBase, key: str, spec: TensorSpec) -> Iterator[str]:
    if _shape(env, spec) != (1,):
        yield f"{key} has the shape {list(_shape(env, spec))} instead of [1]"


def _shape(env: EnvBase, spec: TensorSpec) -> torch.Size:
    """Without the environment's batch."""
    return spec.shape[len(env.batch_size) :]


def _is_pixels(env: EnvBase, spec: TensorSpec) -> bool:
    return len(_shape(env, spec)) == 3 or (spec.dtype == torch.uint8 and len(_shape(env, spec)) > 1)


def _name(dtype: torch.dtype) -> str:
    return str(dtype).removeprefix("torch.")


def _text(key: NestedKey) -> str:
    return key if isinstance(key, str) else repr(key)
