from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("dm_control")

import numpy as np  # noqa: E402
import torch  # noqa: E402
from torchrl.envs import GymEnv  # noqa: E402

from torchrl_etdmpc.envs import make_env, render_frame  # noqa: E402

needs_humanoid_bench = pytest.mark.skipif(
    importlib.util.find_spec("humanoid_bench") is None, reason="needs the environment of make humanoidbench"
)
_NAMES = ("MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY")


def test_rendering_a_batch_of_environments_is_refused():
    env = make_env("pendulum-swingup", num_envs=2, parallel=False)
    with pytest.raises(ValueError, match=r"^render_frame needs one environment of dm_control, .*Bench, got SerialEnv"):
        render_frame(env)


@pytest.mark.parametrize("size", [(0, 64), (64, 10_000)])
def test_a_frame_beyond_the_models_limit_is_refused(size):
    env = make_env("pendulum-swingup", seed=0)
    with pytest.raises(ValueError, match=r"^frames of pendulum must be 1 to 480 pixels high and 1 to 640 wide, got"):
        render_frame(env, *size)


@pytest.mark.parametrize(
    ("task", "options", "height", "width", "camera_id"),
    [
        ("pendulum-swingup", {}, 384, 384, 0),
        ("pendulum-swingup", {"height": 480, "width": 640}, 480, 640, 0),
        ("quadruped-walk", {"width": 64}, 384, 64, 2),
        ("quadruped-walk", {"camera_id": 1}, 384, 384, 1),
    ],
)
def test_dm_control_draws_what_was_asked_for(monkeypatch, task, options, height, width, camera_id):
    env, asked, pixels = make_env(task, seed=0), [], np.full((2, 2, 3), 7, dtype=np.uint8)
    monkeypatch.setattr(type(env.physics), "render", lambda _, **drawn: asked.append(drawn) or pixels)
    monkeypatch.setenv("MUJOCO_GL", "egl")
    frame = render_frame(env, **options)
    assert asked == [{"height": height, "width": width, "camera_id": camera_id}]
    pixels.fill(0)  # a renderer may draw into the same memory again
    assert (frame == 7).all()


@pytest.mark.parametrize("backend", ["disable", "Off", "egl", None])
@pytest.mark.parametrize("name", ["pendulum-swingup", "gym/InvertedPendulum-v5"])
def test_a_process_that_cannot_render_says_so_in_one_line(name, backend, monkeypatch):
    if name.startswith("gym/"):
        pytest.importorskip("imageio")
    env = make_env(name, seed=0)

    def fail(*args, **kwargs):
        raise RuntimeError("No OpenGL rendering\nbackend is available.")

    if name.startswith("gym/"):
        monkeypatch.setattr(env._env.unwrapped, "render", fail)
    else:
        monkeypatch.setattr(type(env.physics), "render", fail)
    for variable in _NAMES:
        monkeypatch.delenv(variable, raising=False)
    if backend:
        monkeypatch.setenv("MUJOCO_GL", backend)
    with pytest.raises(RuntimeError) as error:
        render_frame(env)
    reason = {
        "disable": "MUJOCO_GL is 'disable'",
        "Off": "MUJOCO_GL is 'Off'",
        "egl": "No OpenGL rendering backend is available",
        None: "there is no display",
    }[backend]
    assert str(error.value).startswith(f"cannot render: {reason}; set MUJOCO_GL=egl before Python starts")
    assert "\n" not in str(error.value)


def test_a_gymnasium_environment_that_was_not_made_to_be_filmed_says_so():
    pytest.importorskip("gymnasium")
    with pytest.raises(ValueError, match=r"^Pendulum-v1 cannot be filmed: it was not made with render_mode='rgb_array"):
        render_frame(GymEnv("Pendulum-v1"))


def test_a_missing_pygame_is_one_line_that_says_what_to_install(monkeypatch):
    pytest.importorskip("gymnasium")
    monkeypatch.setitem(sys.modules, "pygame", None)
    env = make_env("gym/Pendulum-v1", seed=0)
    with pytest.raises(RuntimeError) as error:
        render_frame(env)
    assert str(error.value) == (
        "cannot render Pendulum-v1: pygame is not installed; run: "
        "pip install 'gymnasium[mujoco,classic-control]>=1.4,<2' 'mujoco<4'"
    )


def test_a_camera_of_gymnasium_is_refused():
    pytest.importorskip("gymnasium")
    with pytest.raises(ValueError, match=r"^camera_id is for dm_control; .* got camera_id=1\.$"):
        render_frame(make_env("gym/Pendulum-v1"), camera_id=1)


def _frame(task: str, options: str) -> str:
    script = (
        "from torchrl_etdmpc.envs import make_env, render_frame\n"
        f"env = make_env({task!r}, seed=0)\n"
        "env.reset()\n"
        f"frame = render_frame(env, {options})\n"
        "print(tuple(frame.shape), frame.dtype, bool(frame.float().std() > 1))\n"
        "env.close()\n"
    )
    path = os.pathsep.join([str(Path(__file__).parents[2] / "src"), os.environ.get("PYTHONPATH", "")])
    environment = os.environ | {"MUJOCO_GL": "egl", "PYTHONPATH": path}
    run = subprocess.run([sys.executable, "-c", script], env=environment, capture_output=True, text=True)
    if run.returncode:
        pytest.skip(f"no EGL on this machine: {run.stderr.strip().splitlines()[-1]}")
    return run.stdout.strip().splitlines()[-1]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("task", "options", "shape"),
    [
        ("quadruped-walk", "height=48, width=64", (48, 64, 3)),
        ("pendulum-swingup", "", (384, 384, 3)),
        ("gym/Hopper-v5", "height=48, width=64", (48, 64, 3)),
        ("gym/InvertedPendulum-v5", "", (480, 480, 3)),
        pytest.param("h1hand-walk", "height=48, width=64", (48, 64, 3), marks=needs_humanoid_bench),
    ],
)
def test_a_frame_is_a_uint8_image_of_the_asked_size(task, options, shape):
    if task.startswith("gym/"):
        pytest.importorskip("imageio")
    assert _frame(task, options) == f"{shape} torch.uint8 True"


def test_classic_control_needs_no_gl_and_is_resized_when_asked():
    pytest.importorskip("pygame")
    env = make_env("gym/Pendulum-v1", seed=0)
    env.reset()
    for size, shape in (({}, (500, 500, 3)), ({"height": 48, "width": 64}, (48, 64, 3)), ({"width": 50}, (500, 50, 3))):
        frame = render_frame(env, **size)
        assert (frame.shape, frame.dtype) == (shape, torch.uint8)
        assert frame.float().std() > 1
    with pytest.raises(ValueError, match=r"^a frame must be at least 1 pixel high and wide, got height=0, width=None"):
        render_frame(env, height=0)
    env.close()
