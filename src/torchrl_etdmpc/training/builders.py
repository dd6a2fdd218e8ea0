"""From a configuration to the parts of an agent."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer, TensorDictRoundRobinWriter

from torchrl_etdmpc.collectors import SeedPolicy, StepCollector
from torchrl_etdmpc.functional import discount_from_episode_length
from torchrl_etdmpc.modules import WorldModel
from torchrl_etdmpc.objectives import EfficientTDMPCLoss
from torchrl_etdmpc.planners import EnsembleMPPIPlanner, LatentEnv
from torchrl_etdmpc.replay import ReanalyzeTransform, StepSliceSampler
from torchrl_etdmpc.training.compilation import compile_call, resolve_compile
from torchrl_etdmpc.training.config import ModelConfig, PlannerConfig, TrainConfig
from torchrl_etdmpc.training.updater import Updater

# What an environment or a policy writes and nothing reads from a stored row: less to write at every step.
UNREAD = (
    *("plan_mean", "is_init", "episode_reward", "done", "terminated", "truncated"),
    *(("next", "plan_mean"), ("next", "is_init")),
)


@dataclass(frozen=True)
class Agent:
    """The parts that learn and act; all of them share one world model."""

    world_model: WorldModel
    planner: EnsembleMPPIPlanner
    eval_planner: EnsembleMPPIPlanner
    reanalyze_planner: EnsembleMPPIPlanner
    loss: EfficientTDMPCLoss
    updater: Updater
    compile_mode: str | None = None

    def make_eager(self) -> None:
        """Gives up compilation."""
        for planner in (self.planner, self.eval_planner, self.reanalyze_planner):
            planner.compiled_plan = None
        self.updater.make_eager()


def resolve_device(name: str) -> torch.device:
    """The device behind ``auto``, ``cpu``, ``cuda`` or ``cuda:N``.

    Raises:
        ValueError: if CUDA is asked for and not there.
    """
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    device = torch.device(name)
    if device.type == "cuda" and not torch.cuda.is_available():
        raise ValueError(
            f"device={name} needs a CUDA device and this PyTorch sees none; use device=cpu or device=auto."
        )
    return device


def build_world_model(config: ModelConfig, observation_dim: int, action_dim: int) -> WorldModel:
    """The networks for an environment's sizes."""
    return WorldModel(
        observation_dim,
        action_dim,
        latent_dim=config.latent_dim,
        mlp_dim=config.mlp_dim,
        encoder_dim=config.encoder_dim,
        encoder_layers=config.encoder_layers,
        num_dynamics=config.num_dynamics,
        num_values=config.num_values,
        simnorm_dim=config.simnorm_dim,
        num_bins=config.num_bins,
        bin_min=config.bin_min,
        bin_max=config.bin_max,
        dropout=config.dropout,
        log_std_min=config.log_std_min,
        log_std_max=config.log_std_max,
        activation=config.activation,
        termination=config.termination,
    )


def build_planner(
    world_model: WorldModel,
    config: PlannerConfig,
    *,
    discount: float,
    warm_start: bool,
    proposal_log_std_min: float | None = None,
    proposal_log_std_max: float | None = None,
    compile_mode: str | None = None,
) -> EnsembleMPPIPlanner:
    """A planner on shared networks; ``compile_mode`` compiles its ``plan``."""
    planner = EnsembleMPPIPlanner(
        LatentEnv(world_model),
        horizon=config.horizon,
        num_samples=config.num_samples,
        num_elites=config.num_elites,
        num_proposals=config.num_proposals,
        iterations=config.iterations,
        extra_iterations=config.extra_iterations,
        large_action_dim=config.large_action_dim,
        score=config.score,
        beta=config.beta,
        discount=discount,
        inverse_temperature=config.inverse_temperature,
        std_min=config.std_min,
        std_max=config.std_max,
        first_action=config.first_action,
        eval_first_action=config.eval_first_action,
        warm_start=warm_start,
        scoring_dtype=config.scoring_dtype,
        proposal_log_std_min=proposal_log_std_min,
        proposal_log_std_max=proposal_log_std_max,
    )
    if compile_mode is not None:
        planner.compiled_plan = compile_call(planner.plan, compile_mode)
    return planner


def build_agent(
    config: TrainConfig, observation_dim: int, action_dim: int, device: torch.device | str = "cpu"
) -> Agent:
    """World model, both planners, loss and updater.

    Args:
        config (TrainConfig): the run.
        observation_dim (int): O.
        action_dim (int): A.
        device (torch.device or str): where the networks live. Default: ``"cpu"``.
    """
    device = torch.device(device)
    compile_mode = resolve_compile(config.compile, device)
    discount = config.loss.discount
    if discount is None:
        discount = discount_from_episode_length(config.task_spec.decision_steps_per_episode)
    world_model = build_world_model(config.model, observation_dim, action_dim).to(device)
    loss = EfficientTDMPCLoss(
        world_model,
        discount=discount,
        consistency_coef=config.loss.consistency_coef,
        reward_coef=config.loss.reward_coef,
        value_coef=config.loss.value_coef,
        termination_coef=config.loss.termination_coef,
        entropy_coef=config.loss.entropy_coef,
        scale_tau=config.loss.tau,
        kl_direction=config.loss.kl_direction,
        rho=config.loss.rho,
    )
    updater = Updater(
        loss,
        lr=config.optim.lr,
        encoder_lr_scale=config.optim.encoder_lr_scale,
        grad_clip_norm=config.optim.grad_clip_norm,
        tau=config.loss.tau,
        compile_mode=compile_mode,
    )
    planner = build_planner(world_model, config.planner, discount=discount, warm_start=True, compile_mode=compile_mode)
    eval_planner = build_planner(
        world_model, config.planner, discount=discount, warm_start=True, compile_mode=compile_mode
    )
    reanalyze_planner = build_planner(
        world_model,
        config.reanalyze,
        discount=discount,
        warm_start=False,
        proposal_log_std_min=config.reanalyze.proposal_log_std_min,
        proposal_log_std_max=config.reanalyze.proposal_log_std_max,
        compile_mode=compile_mode,
    )
    return Agent(world_model, planner, eval_planner, reanalyze_planner, loss, updater, compile_mode)


def row_bytes(observation_dim: int, action_dim: int) -> int:
    """Bytes of one stored transition: observation before and after, action, reward, planner's target and labels."""
    floats = 2 * observation_dim + 3 * action_dim + 3  # action, loc and scale; reward, its sum and the plan's value
    integers = 4  # trajectory, model version, number and generation of the row
    flags = 4  # done, terminated and truncated after; fallback
    return 4 * floats + 8 * integers + flags


def replay_device(config: TrainConfig, device: torch.device | str, needed: int) -> torch.device:
    """Where ``replay.device`` puts the storage.

    Args:
        config (TrainConfig): the run.
        device (torch.device or str): the run's device.
        needed (int): bytes of the full buffer.
    """
    device = torch.device(device)
    if config.replay.device == "cpu" or device.type != "cuda":
        return torch.device("cpu")
    if config.replay.device == "run":
        return device
    free, _ = torch.cuda.mem_get_info(device)
    return device if needed <= free / 2 else torch.device("cpu")


def build_replay(
    config: TrainConfig, device: torch.device | str = "cpu", *, sizes: tuple[int, int] = (0, 0)
) -> TensorDictReplayBuffer:
    """The buffer: as many rows as the budget can fill, sampled by slices of ``loss.slice_len``.

    Args:
        config (TrainConfig): the run.
        device (torch.device or str): the run's device, where batches go. Default: ``"cpu"``.

    Keyword Args:
        sizes (tuple of int): O and A, for the rule of ``replay.device=auto``. Default: rows of no size, which fit.
    """
    decisions = math.ceil(config.total_env_steps / config.task_spec.action_repeat) + config.num_envs
    rows = min(config.replay.capacity, decisions)
    return TensorDictReplayBuffer(
        storage=LazyTensorStorage(rows, device=replay_device(config, device, rows * row_bytes(*sizes))),
        sampler=StepSliceSampler(config.loss.slice_len, uniform_over=config.replay.uniform_over),
        writer=TensorDictRoundRobinWriter(track_generations=True),
        batch_size=config.optim.batch_size * config.loss.slice_len,
    )


def build_reanalyze(config: TrainConfig, agent: Agent, replay: TensorDictReplayBuffer) -> ReanalyzeTransform | None:
    """Reanalyze attached to the buffer, or ``None`` if ``reanalyze.every`` is 0."""
    if config.reanalyze.every == 0:
        return None
    reanalyze = ReanalyzeTransform(
        agent.reanalyze_planner,
        slice_len=config.loss.slice_len,
        interval=config.reanalyze.every * config.optim.updates_per_decision,
        num_slices=config.reanalyze.num_slices,
    )
    return reanalyze.attach(replay)


def build_collector(config: TrainConfig, agent: Agent, env, replay: TensorDictReplayBuffer) -> StepCollector:
    """The collector with its seed phase, on an environment with ``config.num_envs`` rows."""
    return StepCollector(
        env,
        agent.planner,
        replay_buffer=replay,
        total_frames=math.ceil(config.total_env_steps / config.task_spec.action_repeat),
        init_random_frames=config.seed_decisions,
        seed_policy=SeedPolicy(env.action_spec),
        insertion=config.replay.insertion,
        exclude_keys=UNREAD,
        policy_device=agent.world_model.bins.device,
    )
