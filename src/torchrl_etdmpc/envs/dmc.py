"""DeepMind Control tasks as TorchRL environments: one flat observation, actions in [-1, 1], action repeat."""

from __future__ import annotations

import contextlib
import copy
import importlib.metadata
import importlib.util
import re
import sys
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torchrl.envs import DMControlEnv

from torchrl_etdmpc.envs.episode import RecordedEnv
from torchrl_etdmpc.envs.random_states import pack_mt19937, unpack_mt19937
from torchrl_etdmpc.envs.tasks import Maker, Task

_INSTALL = "pip install 'dm-control==1.0.50' 'mujoco>=3.17,<4'"
# dm-control asks for labmaze, of which the suite has no need and Python 3.13 no wheel: the others, then itself alone.
_INSTALL_WITHOUT_LABMAZE = (
    "pip install 'mujoco>=3.17,<4' absl-py dm-env dm-tree glfw lxml protobuf pyopengl pyparsing requests scipy tqdm && "
    "pip install --no-deps 'dm-control==1.0.50'"
)
# The last dm_control release known to need MuJoCo 3.
_LAST_FOR_MUJOCO_3 = (1, 0, 50)
# The benchmark tables shorten one domain name.
_DOMAINS = {"cup": "ball_in_cup"}
# The name that dm_control gives to its own concatenation of a task's observations.
_FLAT_OBSERVATION = "observations"


class RecordedDMControlEnv(RecordedEnv, DMControlEnv):
    """A :class:`~torchrl.envs.DMControlEnv` that remembers how its episode came to be where it is.

    dm_control's ``flat_observation`` must be on; it joins a task's observations in the order in which dm_control lists
    them (walker: orientations, height, velocity). This is the order of TD-MPC2 and BMPC, not TorchRL's default
    alphabetical one; weights that were trained on one order are useless on another.

    Bounds of actions that differ from [-1, 1] (quadruped) are rescaled linearly, per dimension. Values outside are not
    clipped here; MuJoCo limits them to each actuator's range.
    """

    def _make_specs(self, env: Any) -> None:
        super()._make_specs(env)
        bounds = env.action_spec()
        self._write_specs(self.observation_spec[_FLAT_OBSERVATION].shape[-1], bounds.minimum, bounds.maximum)

    def read_obs(self, observations: dict[str, np.ndarray]) -> dict[str, Tensor]:
        """dm_control's flat observation as a float32 tensor."""
        return {"observation": torch.from_numpy(observations[_FLAT_OBSERVATION].astype(np.float32))}

    def _advance(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool]:
        timestep = self._env.step(action)
        last = timestep.last()
        truncated = last and timestep.discount == 1
        return timestep.observation, timestep.reward, last and not truncated, truncated

    def _random_state(self) -> Tensor:
        return pack_mt19937(self._env.task.random.get_state())

    def _set_random_state(self, state: Tensor) -> None:
        self._env.task.random.set_state(unpack_mt19937(state))

    def _fingerprint(self) -> np.ndarray:
        return self.physics.get_state()

    def _simulator_bookmark(self) -> Callable[[], None]:
        import mujoco

        # All of MjData, not physics.get_state(): the solver begins from its last solution, and sensors of forces show
        # what the last step left there.
        data, model = self.physics.data.ptr, self.physics.model.ptr
        saved, steps, ended = copy.copy(data), self._env._step_count, self._env._reset_next_step
        task = copy.deepcopy(vars(self._env.task))

        def lead_back() -> None:
            mujoco.mj_copyData(data, model, saved)
            self._env._step_count, self._env._reset_next_step = steps, ended
            vars(self._env.task).update(copy.deepcopy(task))

        return lead_back


def dmc_maker(task: Task) -> Maker:
    """The maker of the suite's environments.

    Raises:
        ImportError: if dm-control is missing, or if it cannot work with the installed MuJoCo.
    """
    if importlib.util.find_spec("dm_control") is None:
        raise ImportError(f"dm_control tasks need dm-control, which is missing; run: {_install()}")
    mujoco = importlib.metadata.version("mujoco")
    dm_control = importlib.metadata.version("dm-control")
    if _release(mujoco) >= (4,) and _release(dm_control) <= _LAST_FOR_MUJOCO_3:
        # MuJoCo 4 shares files with packages that a downgrade leaves behind, hence the fresh environment.
        raise ImportError(
            f"dm-control {dm_control} does not work with mujoco {mujoco}; "
            f"run in a fresh virtual environment: {_install()}"
        )
    return _make


def _install() -> str:
    return _INSTALL if sys.version_info < (3, 13) else _INSTALL_WITHOUT_LABMAZE


def domain_and_task(name: str) -> tuple[str, str]:
    """dm_control's own names of the body and of the goal.

    >>> domain_and_task("cup-catch"), domain_and_task("cartpole-swingup-sparse")
    (('ball_in_cup', 'catch'), ('cartpole', 'swingup_sparse'))
    """
    domain, _, task = name.partition("-")
    return _DOMAINS.get(domain, domain), task.replace("-", "_")


def _make(task: Task, *, device: torch.device | str) -> RecordedDMControlEnv:
    with _quiet_dm_control():
        env = RecordedDMControlEnv(
            *domain_and_task(task.name),
            frame_skip=task.action_repeat,
            device=device,
            # One array from dm_control itself is cheaper than CatTensors over up to nine entries.
            environment_kwargs={"flat_observation": True},
        )
    # dm_control takes its time limit in seconds of a step length that only the task knows, and offers no other name.
    env._env._step_limit = task.episode_length
    return env


def _release(version: str) -> tuple[int, ...]:
    return tuple(int(number) for number in re.findall(r"\d+", version)[:3])


@contextlib.contextmanager
def _quiet_dm_control() -> Iterator[None]:
    """Hides, for its duration, notices that a user can do nothing about: GL look-ups and old attributes in models."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from absl import logging as absl_logging
        from dm_control import suite  # noqa: F401  (the import itself is what must be quiet)

        def drop(record: object) -> bool:
            return False

        logger = absl_logging.get_absl_logger()
        logger.addFilter(drop)
        try:
            yield
        finally:
            logger.removeFilter(drop)
