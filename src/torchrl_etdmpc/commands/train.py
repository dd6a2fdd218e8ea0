"""``train``: any task, from an empty directory, or from where a run was stopped, to its summary."""

from __future__ import annotations

import contextlib
import sys

from torchrl_etdmpc.commands.command_line import as_typed, explicit_settings, hydra_main
from torchrl_etdmpc.training import (
    EXIT_CODE,
    RunInterrupted,
    TrainConfig,
    launch,
    with_stored_settings,
)


@hydra_main("train", complete=with_stored_settings)
def main(config: TrainConfig) -> None:
    """Trains EfficientTDMPC on any task: DMC's, Gymnasium's, or an environment of your own."""
    train(config)


def train(config: TrainConfig) -> None:
    """One run, with one closing line on what came out."""
    try:
        print(launch(config, explicit_settings()))
    except RunInterrupted as stop:
        with contextlib.suppress(OSError):  # the exit code is still read, e.g. after Ctrl-C in `train | tee log`
            print(as_typed(str(stop)))
        sys.exit(EXIT_CODE)
