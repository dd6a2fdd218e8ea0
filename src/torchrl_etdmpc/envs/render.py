"""One frame of what an environment looks like now."""

from __future__ import annotations

import os
import sys
from typing import Any

import torch
from torch import Tensor
from torchrl.envs import DMControlEnv, EnvBase, GymWrapper

from torchrl_etdmpc.envs.humanoid_bench import RecordedHumanoidBenchEnv
from torchrl_etdmpc.envs.layers import simulator_of
from torchrl_etdmpc.envs.tasks import INSTALL_GYMNASIUM

_DMC_SIZE = 384  # HumanoidBench, too
# Camera 0 of the quadruped looks from straight above; 2 follows it from the side.
_CAMERAS = {"quadruped": 2}
# What MUJOCO_GL may say for "no rendering".
_NO_BACKEND = {"disable", "disabled", "off", "false", "0"}


def render_frame(
    env: EnvBase, height: int | None = None, width: int | None = None, *, camera_id: int | None = None
) -> Tensor:
    """Renders the present state of an environment that :func:`~torchrl_etdmpc.envs.make_env` made.

    Args:
        env (EnvBase): a single environment of dm_control, Gymnasium or HumanoidBench, possibly with more transforms
            around it.
        height (int, optional): height of the frame in pixels. dm_control and HumanoidBench: up to the model's limit
            (480 unless the model says otherwise), 384 by default. Gymnasium draws in a size of its own, which is the
            default, and is resized.
        width (int, optional): likewise; the model's limit is 640 unless it says otherwise.
        camera_id (int, optional): which camera of dm_control's model; ``None`` is one that follows the body.

    Returns:
        Tensor: the frame, uint8 [height, width, 3], on the CPU.

    Raises:
        ValueError: if ``env`` is not a single environment of these suites, was not made to be filmed, or lacks this
            size or camera.
        RuntimeError: if this process cannot render.

    >>> from torchrl_etdmpc.envs import make_env, render_frame
    >>> env = make_env("cheetah-run", seed=0)
    >>> _ = env.reset()
    >>> frame = render_frame(env, height=240, width=320)  # doctest: +SKIP
    >>> frame.shape  # doctest: +SKIP
    torch.Size([240, 320, 3])
    """
    base = simulator_of(env)
    if isinstance(base, DMControlEnv):
        return _dm_control_frame(base, *_size(height, width, (_DMC_SIZE, _DMC_SIZE)), camera_id)
    if not isinstance(base, GymWrapper):
        kind = type(base).__name__
        raise ValueError(f"render_frame needs one environment of dm_control, Gymnasium or HumanoidBench, got {kind}.")
    if isinstance(base, RecordedHumanoidBenchEnv):
        return _humanoid_frame(base, *_size(height, width, (_DMC_SIZE, _DMC_SIZE)), camera_id)
    if camera_id is not None:
        raise ValueError(f"camera_id is for dm_control; Gymnasium chooses its own camera, got camera_id={camera_id}.")
    return _gymnasium_frame(base, height, width)


def _dm_control_frame(base: DMControlEnv, height: int, width: int, camera_id: int | None) -> Tensor:
    camera_id = _CAMERAS.get(base.env_name, 0) if camera_id is None else camera_id
    _require_size(base.env_name, base.physics.model.vis.global_, height, width)
    _require_backend()
    try:
        frame = base.physics.render(height=height, width=width, camera_id=camera_id)
    except ValueError:  # a camera that the model lacks
        raise
    except Exception as error:  # every GL backend has its own error types
        raise RuntimeError(_cannot_render(str(error).rstrip("."))) from error
    return torch.from_numpy(frame.copy())


def _humanoid_frame(base: RecordedHumanoidBenchEnv, height: int, width: int, camera_id: int | None) -> Tensor:
    if camera_id is not None:
        raise ValueError(f"camera_id is for dm_control; HumanoidBench's tasks name theirs, got camera_id={camera_id}.")
    limits = base._env.unwrapped.model.vis.global_
    _require_size(base._env.unwrapped.spec.id, limits, height, width)
    _require_backend()
    try:
        return torch.from_numpy(base.frame(height, width).copy())
    except Exception as error:  # every GL backend has its own error types
        raise RuntimeError(_cannot_render(str(error).rstrip("."))) from error


def _require_size(name: str, limits: Any, height: int, width: int) -> None:
    if not (1 <= height <= limits.offheight and 1 <= width <= limits.offwidth):
        raise ValueError(
            f"frames of {name} must be 1 to {limits.offheight} pixels high and 1 to {limits.offwidth} wide, "
            f"got height={height}, width={width}."
        )


def _gymnasium_frame(base: GymWrapper, height: int | None, width: int | None) -> Tensor:
    from gymnasium.error import DependencyNotInstalled

    name = getattr(base._env.spec, "id", type(base._env.unwrapped).__name__)
    if base._env.render_mode != "rgb_array":
        raise ValueError(f"{name} cannot be filmed: it was not made with render_mode='rgb_array'.")
    if hasattr(base._env.unwrapped, "mujoco_renderer"):
        _require_backend()  # a renderer that fails to begin makes noise when it is deleted
    try:
        pixels = torch.from_numpy(base._env.render().copy())
    except DependencyNotInstalled as error:
        reason = " ".join(str(error).split(",")[0].split())
        raise RuntimeError(f"cannot render {name}: {reason}; run: {INSTALL_GYMNASIUM}") from error
    except Exception as error:  # every GL backend has its own error types
        raise RuntimeError(_cannot_render(str(error).rstrip("."))) from error
    size = _size(height, width, tuple(pixels.shape[:2]))
    if min(size) < 1:
        raise ValueError(f"a frame must be at least 1 pixel high and wide, got height={height}, width={width}.")
    if size == pixels.shape[:2]:
        return pixels
    images = pixels.permute(2, 0, 1)[None].float()
    resized = torch.nn.functional.interpolate(images, size, mode="bilinear", antialias=True)
    return resized[0].round().clamp(0, 255).byte().permute(1, 2, 0).contiguous()


def _size(height: int | None, width: int | None, own: tuple[int, int]) -> tuple[int, int]:
    return own[0] if height is None else height, own[1] if width is None else width


def _require_backend() -> None:
    backend = os.environ.get("MUJOCO_GL", "")
    if backend.lower() in _NO_BACKEND:
        raise RuntimeError(_cannot_render(f"MUJOCO_GL is {backend!r}"))
    # Without a display and without MUJOCO_GL, MuJoCo's libraries pick GLFW, which fails noisily.
    if sys.platform.startswith("linux") and not any(
        os.environ.get(name) for name in ("MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY")
    ):
        raise RuntimeError(_cannot_render("there is no display"))


def _cannot_render(reason: str) -> str:
    reason = " ".join(reason.split())
    return (
        f"cannot render: {reason}; set MUJOCO_GL=egl before Python starts "
        "(Debian: apt-get install libegl1 libegl-mesa0 libgl1-mesa-dri libopengl0)."
    )
