"""Tasks of HumanoidBench (arXiv:2403.10506) as TorchRL environments, with the physics that it was published with."""

from __future__ import annotations

import contextlib
import importlib.metadata
import importlib.util
import sys
import types
from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_etdmpc.envs.gymnasium import RecordedGymnasiumEnv
from torchrl_etdmpc.envs.random_states import pack_mt19937, unpack_mt19937
from torchrl_etdmpc.envs.tasks import Maker, Task

MUJOCO = "3.1.6"
"""The release that HumanoidBench asks for; others simulate other dynamics, which shows at the first step."""
_RECIPE = "make humanoidbench makes an environment that has it"
_PCG64 = 6  # integers of one state


class RecordedHumanoidBenchEnv(RecordedGymnasiumEnv):
    """A :class:`RecordedGymnasiumEnv` whose task also draws from NumPy's global generator.

    Some tasks do at a reset (reach its goals, sit its starts). Each environment has a state of that generator to
    itself, which follows from its seed, so that it neither depends on what else runs in the process nor disturbs it.
    """

    _numbers: Any = None
    _renderer: Any = None

    def frame(self, height: int, width: int) -> np.ndarray:
        """What the task's camera sees, uint8 [height, width, 3].

        The package's own renderer opens with the environment, on machines that train and cannot render too; this one
        opens with the first frame.
        """
        import mujoco

        simulator = self._env.unwrapped
        if self._renderer is None or (self._renderer.height, self._renderer.width) != (height, width):
            if self._renderer is not None:
                self._renderer.close()
            self._renderer = mujoco.Renderer(simulator.model, height, width)
        self._renderer.update_scene(simulator.data, camera=simulator.camera_name)
        return self._renderer.render()

    def close(self, *, raise_if_closed: bool = True) -> None:
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
        super().close(raise_if_closed=raise_if_closed)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        seed = kwargs.get("seed")
        if seed is not None:
            self._numbers = np.random.RandomState(seed).get_state()
        with self._own_numbers():
            return super()._reset(tensordict, **kwargs)

    def _advance(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool]:
        with self._own_numbers():
            return super()._advance(action)

    @contextlib.contextmanager
    def _own_numbers(self) -> Iterator[None]:
        before = _numpy_state()
        np.random.set_state(self._numbers or np.random.RandomState().get_state())
        try:
            yield
        finally:
            self._numbers = _numpy_state()
            np.random.set_state(before)

    def _random_state(self, seed: int | None = None, options: dict | None = None) -> Tensor | None:
        gymnasium_s = super()._random_state(seed, options)
        return None if gymnasium_s is None else torch.cat([gymnasium_s, pack_mt19937(_numpy_state())])

    def _set_random_state(self, state: Tensor) -> None:
        super()._set_random_state(state[:_PCG64])
        self._numbers = unpack_mt19937(state[_PCG64:])


def _numpy_state() -> Any:
    return np.random.get_state()  # of the MT19937 that it always is, a tuple; its type has a dictionary as well


def gymnasium_id(name: str) -> str:
    """The id under which the package registers a task.

    >>> gymnasium_id("h1hand-sit-simple")
    'h1hand-sit_simple-v0'
    """
    robot, _, goal = name.partition("-")
    return f"{robot}-{goal.replace('-', '_')}-v0"


def humanoid_bench_maker(task: Task) -> Maker:
    """The maker of the suite's environments.

    Raises:
        ImportError: if the package is missing, or MuJoCo is another release than the one that it was published with.
        ValueError: if it has no such task.
    """
    if importlib.util.find_spec("humanoid_bench") is None:
        raise ImportError(f"task {task.name!r} needs humanoid_bench, which is missing; {_RECIPE}.")
    mujoco = importlib.metadata.version("mujoco")
    if mujoco != MUJOCO:
        raise ImportError(
            f"HumanoidBench's dynamics are those of mujoco {MUJOCO}, got mujoco {mujoco}, which simulates others; "
            f"{_RECIPE}."
        )
    known = _registered()
    if gymnasium_id(task.name) not in known:
        names = sorted(name.removesuffix("-v0").replace("_", "-") for name in known)
        raise ValueError(f"HumanoidBench has no task {task.name!r}; it has {', '.join(names)}.")
    return partial(_make, known[gymnasium_id(task.name)])


def humanoid_bench_success_return(task: Task) -> float:
    """The return that the package draws as a task's success (arXiv:2403.10506, dashed lines)."""
    humanoid_bench_maker(task)  # what is missing is said as it is when the task is made
    from humanoid_bench.env import TASKS  # pyright: ignore[reportMissingImports]

    return float(TASKS[task.name.partition("-")[2].replace("-", "_")].success_bar)


def _registered() -> dict[str, Any]:
    """Gymnasium's specs of the package's tasks."""
    import gymnasium

    _import_package()
    return {key: spec for key, spec in gymnasium.registry.items() if "humanoid_bench" in str(spec.entry_point)}


def _import_package() -> None:
    """Imports it without jax, which it needs for policies of its own alone; nothing here loads them."""
    with _stand_in_for_jax():
        import humanoid_bench  # noqa: F401  # pyright: ignore[reportMissingImports]


@contextlib.contextmanager
def _stand_in_for_jax() -> Iterator[None]:
    missing = [name for name in ("jax", "jax.numpy") if importlib.util.find_spec("jax") is None]
    for name in missing:
        sys.modules[name] = types.ModuleType(name)
    if missing:
        sys.modules["jax"].numpy = sys.modules["jax.numpy"]  # pyright: ignore[reportAttributeAccessIssue]
    try:
        yield
    finally:
        for name in missing:
            del sys.modules[name]


def _make(spec: Any, task: Task, *, device: torch.device | str) -> RecordedHumanoidBenchEnv:
    import gymnasium

    _import_package()  # a worker process has not done so
    # A task that may be filmed opens its renderer at once, which most machines that train cannot.
    try:
        env = gymnasium.make(spec, max_episode_steps=task.episode_length, disable_env_checker=True, render_mode=None)
    except (ValueError, OSError) as error:  # MuJoCo's, of a model or a picture that the clone lacks
        raise ValueError(f"{task.name} cannot be made: {' '.join(str(error).split()).rstrip('.')}.") from error
    return RecordedHumanoidBenchEnv(env, frame_skip=task.action_repeat, device=device)
