"""Environments: the benchmark tasks as TorchRL environments."""

from __future__ import annotations

from torchrl_etdmpc.envs.dmc import make_dmc_env, render_frame
from torchrl_etdmpc.envs.episode import load_simulator_state, simulator_state
from torchrl_etdmpc.envs.tasks import DMC_TASKS, EASY_DMC, HARD_DMC, Task, get_task

__all__ = [
    "DMC_TASKS",
    "EASY_DMC",
    "HARD_DMC",
    "Task",
    "get_task",
    "load_simulator_state",
    "make_dmc_env",
    "render_frame",
    "simulator_state",
]
