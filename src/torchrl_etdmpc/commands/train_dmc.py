"""``train``, restricted to the DMC tasks of the benchmarks."""

from __future__ import annotations

from torchrl_etdmpc.commands.command_line import hydra_main
from torchrl_etdmpc.commands.train import train
from torchrl_etdmpc.envs import DMC_TASKS
from torchrl_etdmpc.training import TrainConfig, with_stored_settings


@hydra_main("train", complete=with_stored_settings)
def main(config: TrainConfig) -> None:
    """Trains EfficientTDMPC on one of the 28 DeepMind Control tasks of the benchmarks; train.py takes any task."""
    if config.task not in DMC_TASKS:
        raise ValueError(f"train_dmc.py knows the 28 DMC tasks, not {config.task!r}; use examples/train.py.")
    train(config)
