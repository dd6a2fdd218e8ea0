"""Training: configuration, assembly, updates, evaluation, checkpoints and logs."""

from torchrl_etdmpc.training.builders import (
    Agent,
    build_agent,
    build_collector,
    build_planner,
    build_reanalyze,
    build_replay,
    build_world_model,
    resolve_device,
    row_bytes,
)
from torchrl_etdmpc.training.checkpoint import CheckpointError, load_agent, read_checkpoint, save_checkpoint
from torchrl_etdmpc.training.command_line import explicit_settings, hydra_main, one_line_errors
from torchrl_etdmpc.training.config import TrainConfig
from torchrl_etdmpc.training.curve import plot_curve
from torchrl_etdmpc.training.evaluate import BarePolicy, evaluate
from torchrl_etdmpc.training.presets import PRESETS, preset
from torchrl_etdmpc.training.progress import progress_bar
from torchrl_etdmpc.training.resume import read_run_config, resumed_config
from torchrl_etdmpc.training.run_log import RunLog
from torchrl_etdmpc.training.signals import EXIT_CODE, RunInterrupted
from torchrl_etdmpc.training.store import CheckpointStore
from torchrl_etdmpc.training.train import TrainingRun
from torchrl_etdmpc.training.updater import Updater
from torchrl_etdmpc.training.versions import library_versions
from torchrl_etdmpc.training.video import write_mp4

__all__ = [
    "EXIT_CODE",
    "PRESETS",
    "Agent",
    "BarePolicy",
    "CheckpointError",
    "CheckpointStore",
    "RunInterrupted",
    "RunLog",
    "TrainConfig",
    "TrainingRun",
    "Updater",
    "build_agent",
    "build_collector",
    "build_planner",
    "build_reanalyze",
    "build_replay",
    "build_world_model",
    "evaluate",
    "explicit_settings",
    "hydra_main",
    "library_versions",
    "load_agent",
    "one_line_errors",
    "plot_curve",
    "preset",
    "progress_bar",
    "read_checkpoint",
    "read_run_config",
    "resolve_device",
    "resumed_config",
    "row_bytes",
    "save_checkpoint",
    "write_mp4",
]
