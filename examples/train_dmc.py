"""Trains EfficientTDMPC on one of the 28 DeepMind Control tasks of the benchmarks; train.py takes any task.

    python examples/train_dmc.py task=walker-walk preset=efficient-tdmpc-utd4 seed=1 total_env_steps=200000

Settings and `--help` are those of train.py; the code is `torchrl_etdmpc/commands/train_dmc.py`.
"""

from __future__ import annotations

from torchrl_etdmpc.commands import main

if __name__ == "__main__":
    main("train_dmc")
