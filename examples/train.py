"""Trains EfficientTDMPC on any task: a DMC benchmark task, a Gymnasium id, or an environment of your own.

    python examples/train.py task=walker-walk preset=cpu
    python examples/train.py task=gym/Pendulum-v1 preset=cpu total_env_steps=10000
    python examples/train.py task=mypackage.mymodule:make_my_env task.episode_length=500 preset=cpu

Every setting of a preset can be overridden (`planner.horizon=4 optim.lr=1e-3`); `--cfg job` prints them all.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

os.environ.setdefault("MUJOCO_GL", "disable")  # MuJoCo looks for a renderer when it is imported; training needs none

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
    try:
        print(launch(config, explicit_settings()))
    except RunInterrupted as stop:
        print(stop)
        sys.exit(EXIT_CODE)


if __name__ == "__main__":
    main()
