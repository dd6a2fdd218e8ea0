"""Real environments: any task as a TorchRL environment, by one door with a written contract."""

from __future__ import annotations

from torchrl_etdmpc.envs.check import check_env, check_spaces, env_sizes
from torchrl_etdmpc.envs.episode import load_simulator_state, simulator_state
from torchrl_etdmpc.envs.make import make_env
from torchrl_etdmpc.envs.render import render_frame
from torchrl_etdmpc.envs.success import success_return
from torchrl_etdmpc.envs.tasks import (
    DMC_TASKS,
    EASY_DMC,
    HARD_DMC,
    HUMANOIDBENCH_HARD,
    Task,
    get_task,
    list_tasks,
    register_task,
)
from torchrl_etdmpc.envs.user_task import import_attribute, import_task

__all__ = [
    "DMC_TASKS",
    "EASY_DMC",
    "HARD_DMC",
    "HUMANOIDBENCH_HARD",
    "Task",
    "check_env",
    "check_spaces",
    "env_sizes",
    "get_task",
    "import_attribute",
    "import_task",
    "list_tasks",
    "load_simulator_state",
    "make_env",
    "register_task",
    "render_frame",
    "simulator_state",
    "success_return",
]
