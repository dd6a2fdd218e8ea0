"""What a run needs in memory, by arithmetic, before anything is allocated."""

from __future__ import annotations

import torch

from torchrl_etdmpc.runs import machine_memory
from torchrl_etdmpc.training.builders import replay_device, row_bytes
from torchrl_etdmpc.training.config import ModelConfig, PlannerConfig, TrainConfig

_FLOAT = 4  # bytes


def require_memory(config: TrainConfig, observation_dim: int, action_dim: int, device: torch.device) -> None:
    """Refuses sizes that cannot fit, naming the part that is too large; what just fits is not looked at closely.

    Args:
        config (TrainConfig): the run.
        observation_dim (int): O.
        action_dim (int): A.
        device (torch.device): the run's.

    Raises:
        ValueError: if a part alone needs more than its device has in all.
    """
    model = config.model
    replay = config.replay_rows * row_bytes(observation_dim, action_dim)
    weights = 5 * _FLOAT * _parameters(model, observation_dim, action_dim)  # targets, gradient and two moments as well
    parts = {
        "replay.capacity": (replay, replay_device(config, device, replay)),
        "model.*": (weights, device),
        "planner.*": (_plan_bytes(model, config.planner, max(config.num_envs, config.eval_episodes)), device),
        "reanalyze.*": (_plan_bytes(model, config.reanalyze, config.refreshed_states), device),
        "optim.batch_size": (_batch_bytes(config, observation_dim), device),
    }
    for name, (needed, where) in parts.items():
        there = _memory_bytes(where)
        if there is not None and needed > there:
            raise ValueError(
                f"{name} would take {needed / 1e9:,.1f} GB with these settings, and {where} has {there / 1e9:,.1f}; "
                "choose smaller sizes."
            )


def _memory_bytes(device: torch.device) -> int | None:
    """All the memory of a device; ``None`` where it cannot be told."""
    return torch.cuda.mem_get_info(device)[1] if device.type == "cuda" else machine_memory()


def _parameters(model: ModelConfig, observation_dim: int, action_dim: int) -> int:
    """Roughly: every matrix, no biases."""
    encoder = model.encoder_dim * (observation_dim + (model.encoder_layers - 1) * model.encoder_dim + model.latent_dim)
    dynamics = model.mlp_dim * (2 * model.latent_dim + action_dim + model.mlp_dim)
    head = model.mlp_dim * (model.latent_dim + action_dim + model.mlp_dim + model.num_bins)
    policy = model.mlp_dim * (model.latent_dim + model.mlp_dim + 2 * action_dim)
    return encoder + model.num_dynamics * dynamics + (1 + model.num_values) * head + policy


def _plan_bytes(model: ModelConfig, planner: PlannerConfig, states: int) -> int:
    """Latents and one hidden layer of all candidates in all heads at one step, and the table of their returns."""
    candidates = states * planner.num_samples * model.num_dynamics
    width = model.latent_dim + model.mlp_dim + model.num_bins
    return _FLOAT * candidates * (width + planner.horizon * model.num_values)


def _batch_bytes(config: TrainConfig, observation_dim: int) -> int:
    """A batch, and what its rollout keeps for the gradient: two hidden layers of every head."""
    model, rows = config.model, config.optim.batch_size * config.loss.slice_len
    kept = model.num_dynamics * (model.latent_dim + 2 * model.mlp_dim + model.num_bins)
    return _FLOAT * rows * (2 * observation_dim + kept)
