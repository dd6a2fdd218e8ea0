"""DeepMind Control environments that can be saved in the middle of an episode, by what led there."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import DMControlEnv, EnvBase, Transform, TransformedEnv
from torchrl.envs.batched_envs import BatchedEnvBase

__all__ = ["EpisodeState", "RecordedDMControlEnv", "load_simulator_state", "simulator_state"]


class RecordedDMControlEnv(DMControlEnv):
    """A :class:`~torchrl.envs.DMControlEnv` that remembers how its episode came to be where it is.

    MuJoCo's full state is spread over the physics, the task and dm_control's own counters; but an episode follows from
    the task's random state before its reset and from the actions since, so those are kept (some tens of kilobytes).
    """

    _before_reset: tuple | None = None
    _actions: list[np.ndarray]

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        self._before_reset = self._env.task.random.get_state()
        self._actions = []
        return super()._reset(tensordict, **kwargs)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self._actions.append(tensordict.get(self.action_key).detach().cpu().numpy().copy())
        return super()._step(tensordict)

    def episode_state(self) -> dict[str, Tensor]:
        """Random state before the reset, the actions since, and a fingerprint of the physics that they led to."""
        if self._before_reset is None:
            return {}
        return {
            "random": _pack(self._before_reset),
            "actions": torch.from_numpy(np.array(self._actions).reshape(-1, *self.action_spec.shape)),
            "physics": torch.from_numpy(self.physics.get_state().copy()),
        }

    def restore_episode(self, state: dict[str, Tensor]) -> None:
        """Goes through the episode again.

        Afterwards :meth:`episode_state` equals ``state`` if the simulator is as deterministic here as it was there.
        """
        if not state:
            return
        self._env.task.random.set_state(_unpack(state["random"]))
        self._reset()
        for action in state["actions"].numpy():
            self._actions.append(action.copy())
            for _ in range(self.wrapper_frame_skip):
                if self._env.step(action).last():
                    break


class EpisodeState(Transform):
    """Carries a :class:`RecordedDMControlEnv`'s episode in the ``state_dict`` of the environment around it.

    TorchRL's batched environments pass state dicts to and from their workers, and the state dict of a transformed
    environment is that of its transforms.
    """

    def get_extra_state(self) -> dict[str, Tensor]:
        """See :meth:`RecordedDMControlEnv.episode_state`."""
        return self._base().episode_state()

    def set_extra_state(self, state: dict[str, Tensor]) -> None:
        """See :meth:`RecordedDMControlEnv.restore_episode`."""
        self._base().restore_episode(state)

    def _base(self) -> RecordedDMControlEnv:
        env = self.parent
        while isinstance(env, TransformedEnv):
            env = env.base_env
        return env


def simulator_state(env: EnvBase) -> dict[str, Any] | None:
    """What :func:`load_simulator_state` needs to bring an environment back to where it is now.

    Args:
        env (EnvBase): batched or not, with any transforms around it.

    Returns:
        dict, optional: tensors only, or ``None`` if the environment cannot be restored.
    """
    state = _simulator(env).state_dict()
    workers = list(state.values()) if isinstance(_simulator(env), BatchedEnvBase) else [state]
    episodes = [[value for key, value in worker.items() if key.endswith("_extra_state")] for worker in workers]
    return dict(state) if all(episodes) else None


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
    """The batched environment, or the innermost environment with transforms."""
    while isinstance(env, TransformedEnv) and isinstance(env.base_env, TransformedEnv | BatchedEnvBase):
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
