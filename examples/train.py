"""Trains EfficientTDMPC on any task: a DMC benchmark task, a Gymnasium id, or an environment of your own.

    python examples/train.py task=walker-walk preset=cpu
    python examples/train.py task=gym/Pendulum-v1 preset=cpu total_env_steps=10000
    python examples/train.py task=mypackage.mymodule:make_my_env task.episode_length=500 preset=cpu

Every setting of a preset can be overridden (`planner.horizon=4 optim.lr=1e-3`); `--help` explains the main ones,
`--help planner` those of a group, `--cfg job` prints them all, `task=list` the tasks. The code is
`torchrl_etdmpc/commands/train.py`; installed from a wheel, the command is `torchrl-etdmpc train`.
"""

from __future__ import annotations

from torchrl_etdmpc.commands import main

if __name__ == "__main__":
    main("train")
