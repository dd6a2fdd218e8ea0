"""DeepMind Control environments that can be saved in the middle of an episode, by what led there."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import DMControlEnv, EnvBase, TransformedEnv
from torchrl.envs.batched_envs import BatchedEnvBase

__all__ = ["RecordedDMControlEnv", "load_simulator_state", "simulator_state"]


# The name that dm_control gives to its own concatenation of a task's observations.
_FLAT_OBSERVATION = "observations"


class RecordedDMControlEnv(DMControlEnv):
    """A :class:`~torchrl.envs.DMControlEnv` that remembers how its episode came to be where it is.

    MuJoCo's full state is spread over the physics, the task and dm_control's own counters; but an episode follows from
    the task's random state before its reset and from the actions since, so those are kept (some tens of kilobytes).

    That place is the environment's extra state, so it is in its ``state_dict`` and in that of a TorchRL environment of
    several copies.

    It writes one float32 ``observation`` (dm_control's ``flat_observation``, which must be on), ``is_init`` and
    ``episode_reward`` itself and takes actions in [-1, 1], so that a step goes through no transforms.
    """

    _before_reset: tuple | None = None
    _actions: list[np.ndarray]
    _episode_reward: Tensor

    def _make_specs(self, env: Any) -> None:
        super()._make_specs(env)
        self.observation_spec = Composite(
            observation=self.observation_spec[_FLAT_OBSERVATION].to(torch.float32),
            is_init=Binary(1, dtype=torch.bool),
            episode_reward=Unbounded(1),
            device=self.device,
        )
        self.reward_spec = self.reward_spec.to(torch.float32)
        bounds = env.action_spec()
        self._middle, self._half_width = (bounds.maximum + bounds.minimum) / 2, (bounds.maximum - bounds.minimum) / 2
        self.action_spec = Bounded(-1, 1, shape=bounds.shape, dtype=torch.float32, device=self.device)

    def read_obs(self, observations: dict[str, np.ndarray]) -> dict[str, Tensor]:
        """dm_control's flat observation as a float32 tensor."""
        return {"observation": torch.from_numpy(observations[_FLAT_OBSERVATION].astype(np.float32))}

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        self._before_reset = self._env.task.random.get_state()
        self._actions = []
        self._episode_reward = torch.zeros(1)
        first = super()._reset(tensordict, **kwargs)
        return first.update({"is_init": torch.ones(1, dtype=torch.bool), "episode_reward": self._episode_reward})

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = self._middle + self._half_width * tensordict.get(self.action_key).numpy(force=True)  # float64
        timestep, reward = self._decide(action)
        truncated = timestep.last() and timestep.discount == 1
        flags = {
            "is_init": False,
            "truncated": truncated,
            "terminated": timestep.last() and not truncated,
            "done": timestep.last(),
        }
        return TensorDict(
            self.read_obs(timestep.observation)
            | {"reward": reward, "episode_reward": self._episode_reward}
            | {name: torch.full((1,), bool(flag)) for name, flag in flags.items()},
            batch_size=self.batch_size,
            device=self.device,
        )

    def _decide(self, action: np.ndarray) -> tuple[Any, Tensor]:
        """The last time step of an action that is repeated, and the sum of the rewards on the way."""
        self._actions.append(action)
        total = 0.0
        for _ in range(self.wrapper_frame_skip):
            timestep = self._env.step(action)
            total += timestep.reward
            if timestep.last():
                break
        reward = torch.tensor([total], dtype=torch.float32)
        self._episode_reward = self._episode_reward + reward
        return timestep, reward

    def get_extra_state(self) -> dict[str, Tensor]:
        """Random state before the reset, the actions since, and a fingerprint of the physics that they led to."""
        if self._before_reset is None:
            return {}
        return {
            "random": _pack(self._before_reset),
            "actions": torch.from_numpy(np.array(self._actions).reshape(-1, *self.action_spec.shape)),
            "physics": torch.from_numpy(self.physics.get_state().copy()),
        }

    def set_extra_state(self, state: dict[str, Tensor]) -> None:
        """Goes through the episode again.

        Afterwards :meth:`get_extra_state` equals ``state`` if the simulator is as deterministic here as it was there.
        """
        if not state:
            return
        self._env.task.random.set_state(_unpack(state["random"]))
        self._reset()
        for action in state["actions"].numpy():
            self._decide(action.copy())


def simulator_state(env: EnvBase) -> dict[str, Any] | None:
    """What :func:`load_simulator_state` needs to bring an environment back to where it is now.

    Args:
        env (EnvBase): batched or not, with any transforms around it.

    Returns:
        dict, optional: tensors only, or ``None`` if the environment cannot be restored.
    """
    state = _simulator(env).state_dict()
    workers = list(state.values()) if isinstance(_simulator(env), BatchedEnvBase) else [state]
    return dict(state) if all("_extra_state" in worker for worker in workers) else None


def load_simulator_state(env: EnvBase, state: dict[str, Any]) -> bool:
    """Brings the environment to a saved place; ``False`` if it did not get there exactly."""
    simulator = _simulator(env)
    simulator.load_state_dict(state)
    # TorchRL 0.14: a ParallelEnv's workers report that they are done twice, and the next step would not wait for them.
    flags = simulator.__dict__.get("_shm_done_flags")
    if flags is not None:
        for worker in range(len(flags)):
            flags[worker] = 0
    return _equal(simulator_state(env), state)


def _simulator(env: EnvBase) -> EnvBase:
    """The environment below all transforms."""
    while isinstance(env, TransformedEnv):
        env = env.base_env
    return env


def _equal(one: Any, other: Any) -> bool:
    if isinstance(one, dict):
        return isinstance(other, dict) and one.keys() == other.keys() and all(_equal(one[k], other[k]) for k in one)
    return torch.equal(one, other) if isinstance(one, Tensor) else one == other


def _pack(state: tuple) -> Tensor:
    """NumPy's random state as integers; the cached normal number by its bits."""
    _, keys, position, has_gauss, cached = state
    tail = np.array([position, has_gauss, np.float64(cached).view(np.int64)], dtype=np.int64)
    return torch.from_numpy(np.concatenate([keys.astype(np.int64), tail]))


def _unpack(packed: Tensor) -> tuple:
    values = packed.numpy()
    keys, (position, has_gauss, cached) = values[:-3].astype(np.uint32), values[-3:]
    return "MT19937", keys, int(position), int(has_gauss), float(cached.view(np.float64))
