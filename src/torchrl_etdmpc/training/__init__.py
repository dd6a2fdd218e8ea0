"""Training: configuration, assembly, updates, evaluation, and one run from a command to its summary."""

from torchrl_etdmpc.checkpoints import CheckpointError
from torchrl_etdmpc.training.agent import Agent, build_agent, build_planner, build_world_model
from torchrl_etdmpc.training.agent_file import AgentFile, BestAgent, config_of, load_agent, read_agent_file, save_agent
from torchrl_etdmpc.training.builders import (
    build_collector,
    build_reanalyze,
    build_replay,
    resolve_device,
    row_bytes,
)
from torchrl_etdmpc.training.config import TASK_SETTINGS, TrainConfig, config_from_dict
from torchrl_etdmpc.training.distributed import DistributedConfig, WorkerCollector
from torchrl_etdmpc.training.estimate import estimated_seconds, what_it_takes
from torchrl_etdmpc.training.evaluator import EvaluationResult, Evaluator
from torchrl_etdmpc.training.launch import (
    CHANGEABLE,
    Launch,
    launch,
    plan_launch,
    read_run_config,
    resumed_config,
    with_stored_settings,
)
from torchrl_etdmpc.training.learner import Learner
from torchrl_etdmpc.training.own_code import follow_own_code
from torchrl_etdmpc.training.presets import PRESETS, preset
from torchrl_etdmpc.training.signals import EXIT_CODE, RunInterrupted
from torchrl_etdmpc.training.stepper import UpdateStepper
from torchrl_etdmpc.training.train import TrainingRun
from torchrl_etdmpc.training.updater import Updater

__all__ = [
    "CHANGEABLE",
    "TASK_SETTINGS",
    "config_from_dict",
    "config_of",
    "follow_own_code",
    "EXIT_CODE",
    "PRESETS",
    "Agent",
    "AgentFile",
    "BestAgent",
    "CheckpointError",
    "DistributedConfig",
    "EvaluationResult",
    "Evaluator",
    "Launch",
    "Learner",
    "RunInterrupted",
    "TrainConfig",
    "TrainingRun",
    "UpdateStepper",
    "Updater",
    "WorkerCollector",
    "build_agent",
    "build_collector",
    "build_planner",
    "build_reanalyze",
    "build_replay",
    "build_world_model",
    "estimated_seconds",
    "launch",
    "load_agent",
    "plan_launch",
    "preset",
    "read_agent_file",
    "read_run_config",
    "resolve_device",
    "resumed_config",
    "row_bytes",
    "save_agent",
    "what_it_takes",
    "with_stored_settings",
]
