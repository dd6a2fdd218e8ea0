"""Any Gymnasium id as a TorchRL environment: one flat observation, actions in [-1, 1], action repeat."""

from __future__ import annotations

import contextlib
import importlib.util
import inspect
import sys
from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torchrl.envs import GymWrapper

from torchrl_etdmpc.envs.check import UNLIMITED
from torchrl_etdmpc.envs.episode import RecordedEnv
from torchrl_etdmpc.envs.random_states import pack_pcg64, unpack_pcg64
from torchrl_etdmpc.envs.tasks import INSTALL_GYMNASIUM, Maker, Task


class RecordedGymnasiumEnv(RecordedEnv, GymWrapper):
    """A :class:`~torchrl.envs.GymWrapper` that remembers how its episode came to be where it is.

    An observation of any shape and dtype becomes one float32 vector. Actions are rescaled linearly, per dimension, from
    [-1, 1] to the bounds of the environment, in float64; values outside are not clipped here. Reaching a state that
    ends the task terminates, the time limit truncates.

    An environment whose random numbers are not drawn from Gymnasium's generator, or whose id is registered as
    nondeterministic, cannot be brought back.

    >>> import gymnasium
    >>> env = RecordedGymnasiumEnv(gymnasium.make("Pendulum-v1"), frame_skip=4)
    >>> env.rollout(3)["next", "observation"].shape
    torch.Size([3, 3])
    """

    def _make_specs(self, env: Any, batch_size: torch.Size | None = None) -> None:
        super()._make_specs(env, batch_size)
        space = env.action_space
        self._action_shape, self._action_dtype = space.shape, space.dtype
        low, high = (bound.astype(np.float64).ravel() for bound in (space.low, space.high))
        self._write_specs(int(np.prod(env.observation_space.shape)), low, high)

    def read_obs(self, observations: np.ndarray) -> dict[str, Tensor]:
        """Gymnasium's observation as a float32 vector, in memory of its own."""
        self._observation = observations
        return {"observation": torch.from_numpy(np.array(observations, dtype=np.float32).ravel())}

    def _advance(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool]:
        action = action.astype(self._action_dtype).reshape(self._action_shape)
        self._observation, reward, terminated, truncated, _ = self._env.step(action)
        # TorchRL's own wrapper takes arrays of one entry too, which float does not.
        return self._observation, float(np.asarray(reward).item()), bool(terminated), bool(truncated)

    def _random_state(self, seed: int | None = None, options: dict | None = None) -> Tensor | None:
        from gymnasium.utils import seeding

        # A seeded reset draws from a new generator.
        generator = self._env.unwrapped.np_random if seed is None else seeding.np_random(seed)[0]
        repeatable = options is None and not getattr(self._env.unwrapped.spec, "nondeterministic", False)
        bits = getattr(generator, "bit_generator", None)
        return pack_pcg64(bits.state) if repeatable and isinstance(bits, np.random.PCG64) else None

    def _set_random_state(self, state: Tensor) -> None:
        self._env.unwrapped.np_random.bit_generator.state = unpack_pcg64(state)

    def _fingerprint(self) -> np.ndarray:
        data = getattr(self._env.unwrapped, "data", None)
        if all(hasattr(data, name) for name in ("qpos", "qvel", "time")):  # MuJoCo
            # And goals, and what wrappers have made of all this, by random numbers of their own, or remember.
            return np.concatenate([data.qpos, data.qvel, [data.time], np.ravel(self._observation)])
        return self._observation


def gymnasium_maker(task: Task) -> Maker:
    """The maker of the environments of a Gymnasium id.

    The id is looked up here and now: a worker process may not know what this one has registered.

    Raises:
        ImportError: if gymnasium is missing.
        ValueError: if the id is unknown.
    """
    if importlib.util.find_spec("gymnasium") is None:
        raise ImportError(f"task {task.name!r} needs gymnasium, which is missing; run: {INSTALL_GYMNASIUM}")
    import gymnasium

    spec = gymnasium.registry.get(task.name.removeprefix("gym/"))
    if spec is None:
        raise ValueError(
            f"the task {task.name!r} of suite 'gymnasium' must be called gym/<id>, by an id that Gymnasium knows in "
            "this process; register it where every process imports it, or give register_task a maker of your own."
        )
    return partial(_make, spec)


def gymnasium_success_return(task: Task) -> float | None:
    """The return that Gymnasium calls solved; ``None`` for a task without one."""
    import gymnasium

    return gymnasium.spec(task.name.removeprefix("gym/")).reward_threshold


def _takes_render_mode(creator: Any) -> bool:
    """What its signature says; compiled code may have none, and is asked as gymnasium's own environments are."""
    try:
        parameters = inspect.signature(creator).parameters.values()
    except (TypeError, ValueError):
        return True
    return any(each.name == "render_mode" or each.kind is each.VAR_KEYWORD for each in parameters)


def _make(spec: Any, task: Task, *, device: torch.device | str) -> RecordedGymnasiumEnv:
    import gymnasium
    from gymnasium.envs.registration import load_env_creator

    try:
        creator = spec.entry_point if callable(spec.entry_point) else load_env_creator(spec.entry_point)
        # To be asked for at once, by an environment that may be filmed; nothing is loaded before the first frame.
        modes = getattr(creator, "metadata", {})
        filmable = isinstance(modes, dict) and "rgb_array" in (modes.get("render_modes") or ())
        filmable = filmable and _takes_render_mode(creator)
        with _quiet_mujoco():
            env = gymnasium.make(
                spec,
                max_episode_steps=task.episode_length,
                disable_env_checker=True,
                **({"render_mode": "rgb_array"} if filmable else {}),
            )
    except (gymnasium.error.DependencyNotInstalled, ImportError) as error:
        reason = " ".join(str(error).split()).rstrip(".")
        hint = f"for MuJoCo and classic control run: {INSTALL_GYMNASIUM}"
        raise ImportError(f"{task.name} cannot be made: {reason} ({hint}).") from error
    _require_vectors(task.name, env)
    return RecordedGymnasiumEnv(env, frame_skip=task.action_repeat, device=device)


@contextlib.contextmanager
def _quiet_mujoco() -> Iterator[None]:
    """Hides, for its duration, notices of old attributes in models, which MuJoCo would also write to a file here."""
    mujoco = sys.modules.get("mujoco")
    if mujoco is None:
        yield
        return
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda message: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)


def _require_vectors(name: str, env: Any) -> None:
    """Refuses in one line what cannot be turned into a vector of the right kind without guessing."""
    from gymnasium.spaces import Box, Dict, Tuple

    observations, actions = env.observation_space, env.action_space
    if not isinstance(observations, Box):
        raise ValueError(
            f"{name} has observations of type {type(observations).__name__}; only vectors are supported, which "
            "gymnasium.wrappers.FlattenObservation makes of them in a function of your own (task=MODULE:FUNCTION)."
        )
    if observations.dtype == np.uint8 and len(observations.shape) > 1 or len(observations.shape) == 3:
        raise ValueError(f"{name} has pixel observations {list(observations.shape)}; only vectors are supported.")
    if isinstance(actions, Dict | Tuple):
        raise ValueError(f"{name} has actions of type {type(actions).__name__}; only one vector of them is supported.")
    if not isinstance(actions, Box) or not np.issubdtype(actions.dtype, np.floating):
        kind = type(actions).__name__ if not isinstance(actions, Box) else f"dtype {actions.dtype}"
        raise ValueError(f"{name} has discrete actions ({kind}); only continuous actions are supported.")
    if not (np.abs([actions.low, actions.high]) < UNLIMITED).all():
        raise ValueError(f"{name} has actions without finite bounds, so they cannot be rescaled to [-1, 1].")
