"""``distributed``: a run whose decisions are made by workers, in processes of this machine or of a Ray cluster."""

from __future__ import annotations

from functools import partial

from torchrl_etdmpc.commands.command_line import hydra_main
from torchrl_etdmpc.commands.train import train
from torchrl_etdmpc.training import DistributedConfig, with_stored_settings


@hydra_main("distributed", DistributedConfig, complete=partial(with_stored_settings, kind=DistributedConfig))
def main(config: DistributedConfig) -> None:
    """Trains EfficientTDMPC with workers that plan and step while one learner updates, on one machine or with Ray."""
    train(config)
