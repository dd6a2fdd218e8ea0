"""How long a run will take on a CPU, from the arithmetic of its settings and a moment of this machine's speed."""

from __future__ import annotations

import timeit

import torch

from torchrl_etdmpc.training.config import ModelConfig, PlannerConfig, TrainConfig

# What a decision costs beside arithmetic (simulator, collector, buffer), and an update: with these numbers the run of
# `make train` was said to take 10 minutes where it took 585 s beside compilation, of 25,000 env steps, one thread.
_DECISION_S, _UPDATE_S = 0.0045, 0.0045
_SHARE_OF_SPEED = 0.45  # what planning and learning reach of the speed of their largest matrix products
_ACTION_DIM = 6  # of walker; another one makes no difference here


def decision_flops(config: TrainConfig) -> tuple[float, float]:
    """Floating-point operations of one plan, and of what else a decision calls for: updates and reanalyze.

    >>> plan, rest = decision_flops(TrainConfig())
    >>> 1e11 < plan < 1e12
    True
    """
    model, loss, optim, again = config.model, config.loss, config.optim, config.reanalyze
    plan = _plan_flops(model, config.planner)
    rows = optim.batch_size * loss.slice_len
    update = 3 * rows * (model.num_dynamics * (_step_flops(model) + _value_flops(model)) + _value_flops(model))
    reanalyzed = config.refreshed_states * _plan_flops(model, again) / again.every if again.every else 0.0
    return plan, (optim.updates_per_decision * update + reanalyzed)


def estimated_seconds(config: TrainConfig) -> float:
    """Seconds of the whole run on the CPU, without compilation; right within a factor of two or three.

    Args:
        config (TrainConfig): its task and preset, sizes, budgets and threads count.

    >>> from torchrl_etdmpc.training import preset
    >>> 10 < estimated_seconds(preset("cpu")) < 100_000
    True
    """
    plan, rest = decision_flops(config)
    speed = _SHARE_OF_SPEED * _flops_per_second(config)
    repeat = config.task_spec.action_repeat
    learning = max(config.total_env_steps / repeat - config.seed_decisions, 0)
    evaluations = config.total_env_steps // config.eval_every + 1
    played = evaluations * config.eval_episodes * config.task_spec.decision_steps_per_episode
    update_s = _UPDATE_S * config.optim.updates_per_decision + rest / speed
    return (
        learning * (_DECISION_S + plan / speed + update_s)
        + config.pretrain_updates * update_s
        + played * (_DECISION_S / 3 + plan / speed)
    )


def what_it_takes(config: TrainConfig, device: torch.device, env_steps: int = 0, *, compiled: bool = True) -> str:
    """How long the run will take on this machine, and what to do about it if that is long.

    Args:
        config (TrainConfig): the run.
        device (torch.device): its device.
        env_steps (int): what it has behind it, if it goes on. Default: 0.
        compiled (bool): whether anything is compiled. Default: ``True``.

    >>> from torchrl_etdmpc.training import preset
    >>> "on this CPU" in what_it_takes(preset("cpu"), torch.device("cpu"))
    True
    """
    if device.type == "cuda":
        return f"on {torch.cuda.get_device_name(device)}"
    seconds = estimated_seconds(config) * (1 - env_steps / config.total_env_steps)
    first = ", and before it some minutes to compile the first time" if compiled else ""
    line = f"about {_duration(seconds)} on this CPU{first}"
    small = "tdmpc2-cpu" if config.model.action_values else "cpu"
    if config.preset not in ("cpu", "tdmpc2-cpu") and seconds > 3600:
        line += f"; preset={config.preset} is made for a GPU and there is none here: preset={small} is made for a CPU"
    return line


def _duration(seconds: float) -> str:
    """A time in words, rounded as an estimate is.

    >>> _duration(40), _duration(400), _duration(20_000), _duration(2_000_000)
    ('1 minute', '7 minutes', '6 hours', '23 days')
    """
    for unit, length in (("day", 86_400), ("hour", 3_600)):
        if seconds >= 1.5 * length:
            return f"{seconds / length:.0f} {unit}s"
    minutes = max(round(seconds / 60), 1)
    return f"{minutes} minute{'s' * (minutes > 1)}"


def _plan_flops(model: ModelConfig, planner: PlannerConfig) -> float:
    depths = 1 if planner.score == "final" else planner.horizon
    path = planner.horizon * _step_flops(model) + depths * model.num_values * _value_flops(model)
    candidates = planner.iterations * (planner.num_samples - planner.num_proposals) + planner.num_proposals
    return float(model.num_dynamics) * candidates * path


def _step_flops(model: ModelConfig) -> float:
    """The next latent and the reward of one row, by one head."""
    first, middle = model.latent_dim + _ACTION_DIM, model.mlp_dim
    return 2.0 * middle * (2 * first + 2 * middle + model.latent_dim + model.num_bins)


def _value_flops(model: ModelConfig) -> float:
    """One value head on one row."""
    return 2.0 * model.mlp_dim * (model.latent_dim + model.mlp_dim + model.num_bins)


def _flops_per_second(config: TrainConfig) -> float:
    """Of matrix products such as the planner's, on this machine and now."""
    rows = min(config.planner.num_samples * config.model.num_dynamics, 2048)
    left, right = torch.ones(rows, config.model.mlp_dim), torch.ones(config.model.mlp_dim, config.model.mlp_dim)
    # The first product of a process loads its library, which may take seconds. Where other processes are busy, threads
    # wait for each other, many products in a row: one alone does not.
    threads, seconds = torch.get_num_threads(), []
    try:
        for number in {threads, 1}:
            torch.set_num_threads(number)
            seconds += timeit.repeat(lambda: left @ right, number=1, repeat=10)
    finally:
        torch.set_num_threads(threads)
    return 2.0 * rows * config.model.mlp_dim**2 / min(seconds)
