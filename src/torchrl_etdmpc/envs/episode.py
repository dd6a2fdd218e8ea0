"""Simulators that can be saved in the middle of an episode, by what led there."""

from __future__ import annotations

import abc
import contextlib
import copy
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torch.nn.parameter import UninitializedBuffer
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase
from torchrl.envs.batched_envs import BatchedEnvBase

from torchrl_etdmpc.envs.check import UNLIMITED
from torchrl_etdmpc.envs.layers import simulator_of, transforms_of

_TRANSFORMS = "transforms"
"""Where a state has what the transforms around the simulator remember, by their place."""
_PAID = "episode_reward"
_PLACE = "fingerprint"


class RecordedEnv(EnvBase):
    """What the environments of all suites share: their entries, and a record of the running episode.

    A simulator's full state is spread over its parts; but an episode follows from the random state before its reset
    and from the actions since, so those are kept (some tens of kilobytes). That place is the environment's extra
    state, so it is in its ``state_dict`` and in that of a TorchRL environment of several copies.

    It writes one float32 ``observation``, ``is_init`` and ``episode_reward`` itself and takes actions in [-1, 1], so
    that a step goes through no transforms. A suite's class puts this one in front of TorchRL's wrapper of the suite.
    """

    _random: Tensor | None = None  # as it was before the reset; None: nothing to come back to
    _actions: list[np.ndarray]
    _episode_reward: Tensor
    restored: tuple[Tensor, bool]
    """The place that :meth:`set_extra_state` or :meth:`go_on` led to: observation, and whether the episode is over."""

    @abc.abstractmethod
    def _advance(self, action: np.ndarray) -> tuple[Any, float, bool, bool]:
        """One env step: the suite's own observation, reward, terminated, truncated."""

    @abc.abstractmethod
    def _random_state(self, **kwargs: Any) -> Tensor | None:
        """From which a reset with ``kwargs`` draws; ``None`` if it cannot be repeated."""

    @abc.abstractmethod
    def _set_random_state(self, state: Tensor) -> None:
        """Brings :meth:`_random_state` back."""

    @abc.abstractmethod
    def _fingerprint(self) -> np.ndarray:
        """Numbers that tell whether a repeated episode led to the same place."""

    def _write_specs(self, observation_size: int, low: np.ndarray, high: np.ndarray) -> None:
        """The specs, all but those of the flags; ``low`` and ``high`` bound the suite's own actions, float64 [A]."""
        self.observation_spec = Composite(
            observation=Unbounded(observation_size, dtype=torch.float32, device=self.device),
            is_init=Binary(1, dtype=torch.bool, device=self.device),
            episode_reward=Unbounded(1, device=self.device),
            device=self.device,
        )
        self.reward_spec = Unbounded(1, dtype=torch.float32, device=self.device)
        if not (np.abs([low, high]) < UNLIMITED).all():
            raise ValueError(
                f"actions have no finite bounds (they reach from {low.min():g} to {high.max():g}), so they cannot be "
                "rescaled to [-1, 1]; give every actuator a range."
            )
        self._middle, self._half_width = (high + low) / 2, (high - low) / 2
        # Rounding may lead past the bounds by a bit, where a simulator that checks its actions fails.
        past = (self._middle + self._half_width > high) | (self._middle - self._half_width < low)
        self._half_width = self._half_width - past * np.spacing(np.maximum(abs(low), abs(high)))
        self.action_spec = Bounded(-1, 1, shape=low.shape, dtype=torch.float32, device=self.device)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        self._random, self._actions = self._random_state(**kwargs), []
        self._episode_reward = torch.zeros(1, device="cpu")  # whatever the default device is
        first = super()._reset(tensordict, **kwargs)
        return first.update(
            {"is_init": torch.ones_like(self._episode_reward, dtype=torch.bool), "episode_reward": self._episode_reward}
        )

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = self._middle + self._half_width * tensordict.get(self.action_key).numpy(force=True)  # float64
        observation, reward, terminated, truncated = self._decide(action)
        flags = {
            "is_init": False,
            "truncated": truncated,
            "terminated": terminated,
            "done": terminated or truncated,
        }
        return TensorDict(
            self.read_obs(observation)
            | {"reward": reward, "episode_reward": self._episode_reward}
            | {name: torch.full((1,), bool(flag), device="cpu") for name, flag in flags.items()},
            batch_size=self.batch_size,
            device=self.device,
        )

    def _decide(self, action: np.ndarray) -> tuple[Any, Tensor, bool, bool]:
        """The last env step of an action that is repeated, with the sum of the rewards on the way."""
        self._actions.append(action)
        total = 0.0
        for _ in range(self.wrapper_frame_skip):
            observation, reward, terminated, truncated = self._advance(action)
            total += reward
            if terminated or truncated:
                break
        reward = torch.tensor([total], dtype=torch.float32, device="cpu")
        self._episode_reward = self._episode_reward + reward
        return observation, reward, terminated, truncated

    def get_extra_state(self) -> dict[str, Tensor] | None:
        """Random state before the reset, the actions since, and what tells the place and the rewards they led to.

        The rewards so far are kept as bits: they may be drawn by chance where the place is not.
        """
        if self._random is None:
            return None
        return {
            "random": self._random,
            "actions": torch.from_numpy(np.array(self._actions).reshape(-1, *self.action_spec.shape)),
            _PLACE: torch.from_numpy(np.array(self._fingerprint())),
            _PAID: self._episode_reward.clone().view(torch.int32),
        }

    def set_extra_state(self, state: dict[str, Tensor] | None) -> None:
        """Goes through the episode again, up to where the simulator failed if it did.

        Afterwards :meth:`get_extra_state` equals ``state`` if the simulator is as deterministic here as it was there.
        """
        if state is None:
            return
        with contextlib.suppress(Exception):  # what failed there fails here, too, and a worker process must outlive it
            self._set_random_state(state["random"])
            self.restored = self._reset().get("observation"), False
            self.go_on(state["actions"])

    def go_on(self, actions: Tensor) -> None:
        """Takes more actions of a recorded episode, the suite's own, float64 [T, A]."""
        for action in actions.numpy():
            observation, _, terminated, truncated = self._decide(action.copy())
            self.restored = self.read_obs(observation)["observation"], terminated or truncated

    def bookmark(self) -> Callable[[], None] | None:
        """A function that leads back to here, exactly and without the episode, as often as it is called.

        It holds until the next reset. ``None`` where the suite has no such thing.
        """
        back = self._simulator_bookmark()
        if back is None:
            return None
        random, actions, episode_reward = self._random, list(self._actions), self._episode_reward

        def lead_back() -> None:
            back()
            self._random, self._actions, self._episode_reward = random, list(actions), episode_reward

        return lead_back

    def _simulator_bookmark(self) -> Callable[[], None] | None:
        """:meth:`bookmark` of the suite's part."""
        return None


def simulator_state(env: EnvBase) -> dict[str, Any] | None:
    """What :func:`load_simulator_state` needs to bring an environment back to where it is now.

    What transforms remember beside the tensordict is part of it (the frames of ``CatFrames``, the statistics of
    ``VecNormV2``), if their ``state_dict`` has it.

    Args:
        env (EnvBase): batched or not, with any transforms around it.

    Returns:
        dict, optional: tensors and plain numbers only, or ``None`` if the environment cannot be restored.

    >>> from torchrl_etdmpc.envs import make_env
    >>> env = make_env("gym/Pendulum-v1", seed=0)
    >>> _ = env.rollout(3)
    >>> state = simulator_state(env)
    >>> load_simulator_state(make_env("gym/Pendulum-v1", seed=0), state)
    True
    """
    simulator = simulator_of(env)
    if isinstance(simulator, BatchedEnvBase):
        # Workers with transforms have none, and must not be asked: before its first step, TorchRL's ActionScaling
        # cannot tell its state, and a worker process that fails to is lost.
        about = simulator.meta_data if isinstance(simulator.meta_data, list) else [simulator.meta_data]
        if any(worker.env_str.startswith("TransformedEnv") for worker in about):
            return None
    state = simulator.state_dict()
    workers = list(state.values()) if isinstance(simulator, BatchedEnvBase) else [state]
    remembered = transform_states(env)
    if not is_plain(remembered) or any(worker.get("_extra_state") is None for worker in workers):
        return None
    return {**state, _TRANSFORMS: remembered} if remembered else dict(state)


def load_simulator_state(env: EnvBase, state: dict[str, Any] | None) -> bool:
    """Brings the environment to a saved place; ``False`` if it did not get there exactly.

    Args:
        env (EnvBase): made as the one that was saved; another one does not get there.
        state (dict, optional): of :func:`simulator_state`; ``None`` is ``False``.

    Returns:
        bool: whether the environment is where the saved one was, to the last bit.

    >>> from torchrl_etdmpc.envs import make_env
    >>> env = make_env("gym/Pendulum-v1", seed=0)
    >>> state, first = simulator_state(env), env.rollout(3)
    >>> load_simulator_state(env, state)
    True
    """
    if state is None:
        return False
    simulator = simulator_of(env)
    saved = {name: part for name, part in state.items() if name != _TRANSFORMS}
    workers = range(simulator.num_workers) if isinstance(simulator, BatchedEnvBase) else ()
    if {name for name in saved if name.startswith("worker")} != {f"worker{number}" for number in workers}:
        return False  # of another number of environments; TorchRL would load some and fail at the others
    simulator.load_state_dict(saved)
    # TorchRL 0.14: a ParallelEnv's workers report that they are done twice, and the next step would not wait for them.
    flags = simulator.__dict__.get("_shm_done_flags")
    if flags is not None:
        for worker in range(len(flags)):
            flags[worker] = 0
    try:
        load_transform_states(env, state.get(_TRANSFORMS, {}))
    except (RuntimeError, LookupError):  # made in another way than the one that was saved
        return False
    return equal_states(_as_old_as(state, simulator_state(env)), state)


def _as_old_as(saved: Any, now: Any) -> Any:
    """The state of now without what the version that saved the other one did not keep."""
    if not isinstance(saved, dict) or not isinstance(now, dict):
        return now
    kept = {name: _as_old_as(saved.get(name), part) for name, part in now.items() if name in saved or name != _PAID}
    if _PLACE in kept and isinstance(saved.get(_PLACE), Tensor):
        kept[_PLACE] = kept[_PLACE][: len(saved[_PLACE])]  # it is told by more numbers now
    return kept


def transform_states(env: EnvBase) -> dict[str, Any]:
    """What the transforms remember, of those that do: buffers and extra state, not the weights of networks."""
    states = {}
    for place, transform in enumerate(transforms_of(env)):
        if any(isinstance(buffer, UninitializedBuffer) for buffer in transform.buffers()):
            continue  # it holds nothing before the first step, and cannot tell so
        weights = {name for name, _ in transform.named_parameters()}
        state = {name: part for name, part in transform.state_dict().items() if name not in weights}
        if any(part is not None for part in state.values()):
            states[str(place)] = copy.deepcopy(state)  # statistics move on in place
    return states


def load_transform_states(env: EnvBase, states: dict[str, Any]) -> None:
    """Restores :func:`transform_states`.

    Raises:
        RuntimeError, LookupError: if the environment has other transforms.
    """
    transforms = transforms_of(env)
    for place, state in states.items():
        transform = transforms[int(place)]
        for name, buffer in transform.named_buffers():
            if isinstance(buffer, UninitializedBuffer):
                buffer.materialize(state[name].shape, device=env.device, dtype=state[name].dtype)
        unknown = transform.load_state_dict(copy.deepcopy(state), strict=False).unexpected_keys  # its weights stay
        if unknown:
            raise LookupError(f"{type(transform).__name__} remembers no {', '.join(unknown)}.")


def is_plain(state: Any) -> bool:
    """Whether a file of weights alone may hold it."""
    if isinstance(state, dict):
        return all(is_plain(part) for part in state.values())
    return state is None or isinstance(state, Tensor | str | int | float)


def equal_states(one: Any, other: Any) -> bool:
    """Whether two states hold the same, to the last bit."""
    if isinstance(one, dict):
        return (
            isinstance(other, dict) and one.keys() == other.keys() and all(equal_states(one[k], other[k]) for k in one)
        )
    return torch.equal(one, other) if isinstance(one, Tensor) else one == other
