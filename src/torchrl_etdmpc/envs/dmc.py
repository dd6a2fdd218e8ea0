"""DeepMind Control tasks as TorchRL environments: one flat observation, actions in [-1, 1], action repeat."""

from __future__ import annotations

import contextlib
import importlib.metadata
import importlib.util
import os
import re
import signal
import sys
import warnings
from collections.abc import Iterator
from functools import partial

import torch
from torch import Tensor
from torchrl.envs import DMControlEnv, EnvBase, ParallelEnv, SerialEnv, TransformedEnv

from torchrl_etdmpc.envs.episode import RecordedDMControlEnv
from torchrl_etdmpc.envs.tasks import Task, get_task

__all__ = ["make_dmc_env", "render_frame"]

# How long a worker process outlives a signal to stop, in seconds.
_GRACE_S = 10
# The last dm_control release known to need MuJoCo 3.
_LAST_FOR_MUJOCO_3 = (1, 0, 50)
# Camera 0 of the quadruped looks from straight above; 2 follows it from the side.
_CAMERAS = {"quadruped": 2}


def make_dmc_env(
    task: str | Task,
    *,
    seed: int | None = None,
    num_envs: int = 1,
    parallel: bool = True,
    device: torch.device | str = "cpu",
) -> EnvBase:
    """Makes a DeepMind Control task an environment of the shape that the planner and the losses expect.

    The environment has these entries, all with a trailing dimension:

    - ``observation`` ``[O]`` float32: the task's observations, joined in the order in which dm_control lists them
      (walker: orientations, height, velocity). This is the order of TD-MPC2 and BMPC, not TorchRL's default
      alphabetical one; weights that were trained on one order are useless on another.
    - ``action`` ``[A]`` float32 in [-1, 1] for every task. Bounds that differ (quadruped) are rescaled linearly, per
      dimension. Values outside are not clipped here; MuJoCo limits them to each actuator's range.
    - ``reward`` ``[1]`` float32: the sum over the env steps of one decision; ``episode_reward`` ``[1]`` adds it up
      since the last reset.
    - ``terminated``, ``truncated``, ``done`` ``[1]`` bool: the time limit truncates and never terminates.
    - ``is_init`` ``[1]`` bool: true on the first entry of an episode.

    Args:
        task: a name from :data:`~torchrl_etdmpc.envs.DMC_TASKS`, or a :class:`~torchrl_etdmpc.envs.Task` of the
            suite ``"dm_control"``.
        seed: seeds the initial states, in [0, 2**32 - 1]; ``None`` draws them from the operating system. With several
            environments each gets its own seed, derived from this one.
        num_envs: how many copies, at least 1. One is the environment itself, with batch size ``[]``. More are
            processes of a :class:`~torchrl.envs.ParallelEnv` with batch size ``[num_envs]``; a script that makes them
            needs the usual ``if __name__ == "__main__":`` guard, and should close them.
            They outlive SIGINT, SIGTERM and SIGUSR1 by ten seconds, so that their owner can save first.
        parallel: ``False`` steps several environments one after the other in this process instead
            (:class:`~torchrl.envs.SerialEnv`); on few cores that is faster.
        device: where the tensors go; the physics runs on the CPU.

    Returns:
        The environment.

    Raises:
        ImportError: if dm-control is missing, or if it cannot work with the installed MuJoCo.
        ValueError: if the task is unknown or of another suite, or if ``num_envs`` is below 1.

    Examples:
        >>> from torchrl_etdmpc.envs import make_dmc_env
        >>> env = make_dmc_env("walker-walk", seed=0)
        >>> env.observation_spec["observation"].shape, env.action_spec.shape
        (torch.Size([24]), torch.Size([6]))
        >>> rollout = env.rollout(3)
        >>> rollout["next", "reward"].shape
        torch.Size([3, 1])
        >>> rollout["is_init"].squeeze(-1).tolist()
        [True, False, False]
    """
    task = get_task(task) if isinstance(task, str) else task
    if task.suite != "dm_control":
        raise ValueError(f"make_dmc_env needs a task of suite 'dm_control', got {task.name!r} of suite {task.suite!r}.")
    if num_envs < 1:
        raise ValueError(f"num_envs must be at least 1, got {num_envs}.")
    _require_dm_control()
    if num_envs == 1:
        env = _make_one(task, device)
    elif not parallel:
        env = SerialEnv(num_envs, partial(_make_one, task, "cpu"), device=device, num_threads=torch.get_num_threads())
    else:
        # Left alone, ParallelEnv would change this process' own number of threads.
        make = partial(_make_in_worker, task, os.getpid())
        env = ParallelEnv(num_envs, make, device=device, num_threads=torch.get_num_threads())
    if seed is not None:
        env.set_seed(seed)
    return env


def render_frame(env: EnvBase, height: int = 384, width: int = 384, *, camera_id: int | None = None) -> Tensor:
    """Renders the present state of an environment that :func:`make_dmc_env` made.

    Args:
        env: a single environment, possibly with more transforms around it.
        height: height of the frame in pixels, up to the model's limit (480 unless the model says otherwise).
        width: width of the frame in pixels, up to the model's limit (640 unless the model says otherwise).
        camera_id: which camera of the model; ``None`` is one that follows the body.

    Returns:
        The frame, uint8 ``[height, width, 3]``, on the CPU.

    Raises:
        ValueError: if ``env`` is not a single DeepMind Control environment, or the model lacks this size or camera.
        RuntimeError: if this process cannot render.

    Examples:
        >>> from torchrl_etdmpc.envs import make_dmc_env, render_frame
        >>> env = make_dmc_env("cheetah-run", seed=0)
        >>> _ = env.reset()
        >>> frame = render_frame(env, height=240, width=320)  # doctest: +SKIP
        >>> frame.shape  # doctest: +SKIP
        torch.Size([240, 320, 3])
    """
    base = env
    while isinstance(base, TransformedEnv):
        base = base.base_env
    if not isinstance(base, DMControlEnv):
        raise ValueError(f"render_frame needs one environment made by make_dmc_env, got {type(base).__name__}.")
    camera_id = _CAMERAS.get(base.env_name, 0) if camera_id is None else camera_id
    limits = base.physics.model.vis.global_
    if not (1 <= height <= limits.offheight and 1 <= width <= limits.offwidth):
        raise ValueError(
            f"frames of {base.env_name} must be 1 to {limits.offheight} pixels high and 1 to {limits.offwidth} wide, "
            f"got height={height}, width={width}."
        )
    if not _has_display_or_backend():
        raise RuntimeError(_cannot_render("there is no display"))
    try:
        frame = base.physics.render(height=height, width=width, camera_id=camera_id)
    except ValueError:  # a camera that the model lacks
        raise
    except Exception as error:  # every GL backend has its own error types
        raise RuntimeError(_cannot_render(str(error).rstrip("."))) from error
    return torch.from_numpy(frame.copy())


def _make_one(task: Task, device: torch.device | str) -> RecordedDMControlEnv:
    with _quiet_dm_control():
        return RecordedDMControlEnv(
            task.domain,
            task.task,
            frame_skip=task.action_repeat,
            device=device,
            # One array from dm_control itself is cheaper than CatTensors over up to nine entries.
            environment_kwargs={"flat_observation": True},
        )


def _make_in_worker(task: Task, owner: int) -> RecordedDMControlEnv:
    """In a worker process, leaves the ``owner`` time to finish its step and save after a signal to stop.

    Ctrl-C and job schedulers signal all processes of a job at once. TorchRL calls this once in the owner's process too.
    """
    if os.getpid() != owner and hasattr(signal, "SIGALRM"):
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1):
            signal.signal(number, lambda *_: signal.alarm(_GRACE_S))
    return _make_one(task, "cpu")


def _require_dm_control() -> None:
    if importlib.util.find_spec("dm_control") is None:
        raise ImportError("dm_control tasks need dm-control, which is missing; run: pip install torchrl_etdmpc[dmc]")
    mujoco = importlib.metadata.version("mujoco")
    dm_control = importlib.metadata.version("dm-control")
    if _release(mujoco) >= (4,) and _release(dm_control) <= _LAST_FOR_MUJOCO_3:
        # MuJoCo 4 shares files with packages that a downgrade leaves behind, hence the fresh environment.
        raise ImportError(
            f"dm-control {dm_control} does not work with mujoco {mujoco}; "
            "run in a fresh virtual environment: pip install torchrl_etdmpc[dmc]"
        )


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


def _has_display_or_backend() -> bool:
    # Without a display and without MUJOCO_GL, dm_control has picked GLFW, which fails noisily.
    names = ("MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY")
    return not sys.platform.startswith("linux") or any(os.environ.get(name) for name in names)


def _cannot_render(reason: str) -> str:
    reason = " ".join(reason.split())
    return (
        f"cannot render: {reason}; set MUJOCO_GL=egl before Python starts "
        "(Debian: apt-get install libegl1 libegl-mesa0 libgl1-mesa-dri libopengl0)."
    )
