"""Trains EfficientTDMPC on one of the 28 DeepMind Control tasks of the benchmarks; train.py takes any task.

    python examples/train_dmc.py task=walker-walk preset=efficient-tdmpc-utd4 seed=1 total_env_steps=200000

Every setting of a preset can be overridden (`planner.horizon=4 optim.lr=1e-3`); `--cfg job` prints them all.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

os.environ.setdefault("MUJOCO_GL", "disable")  # MuJoCo looks for a renderer when it is imported; training needs none

from torchrl_etdmpc.envs import DMC_TASKS  # noqa: E402
from torchrl_etdmpc.training import (  # noqa: E402
    EXIT_CODE,
    RunInterrupted,
    TrainConfig,
    explicit_settings,
    hydra_main,
    launch,
)


@hydra_main(config_path=str(Path(__file__).resolve().parent / "config"), config_name="train")
def main(config: TrainConfig) -> None:
    """One run, from an empty directory, or from where it was stopped, to `summary.json`."""
    if config.task not in DMC_TASKS:
        raise ValueError(f"train_dmc.py knows the 28 DMC tasks, not {config.task!r}; use examples/train.py.")
    try:
        print(launch(config, explicit_settings()))
    except RunInterrupted as stop:
        print(stop)
        sys.exit(EXIT_CODE)


if __name__ == "__main__":
    main()
