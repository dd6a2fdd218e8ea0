"""Configuration of a run: frozen, validated dataclasses and the named presets."""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from torchrl_etdmpc.envs.tasks import Task, get_task


def _require(condition: bool, message: str) -> None:
    if not condition:
        raise ValueError(message)


def _require_choice(name: str, value: str, choices: tuple[str, ...]) -> None:
    _require(value in choices, f"{name} must be one of {', '.join(choices)}, got {value!r}.")


def _require_positive(group: str, config: Any, *names: str) -> None:
    for name in names:
        _require(getattr(config, name) >= 1, f"{group}{name} must be at least 1, got {getattr(config, name)}.")


@dataclass(frozen=True)
class ModelConfig:
    """Sizes of the networks (thesis Table A.1); see :class:`~torchrl_etdmpc.modules.WorldModel`."""

    latent_dim: int = 512
    mlp_dim: int = 512
    encoder_dim: int = 256
    encoder_layers: int = 1
    num_dynamics: int = 4
    num_values: int = 2
    simnorm_dim: int = 8
    num_bins: int = 101
    bin_min: float = -10.0
    bin_max: float = 10.0
    dropout: float = 0.01
    log_std_min: float = -3.0
    log_std_max: float = 1.0
    activation: str = "mish"
    termination: bool = False

    def __post_init__(self) -> None:
        sizes = ("latent_dim", "mlp_dim", "encoder_dim", "encoder_layers", "num_dynamics", "num_values", "simnorm_dim")
        _require_positive("model.", self, *sizes)
        _require(
            self.latent_dim % self.simnorm_dim == 0,
            f"model.latent_dim must be a multiple of model.simnorm_dim={self.simnorm_dim}, got {self.latent_dim}.",
        )
        _require(self.num_bins >= 2, f"model.num_bins must be at least 2, got {self.num_bins}.")
        _require(self.bin_min < self.bin_max, "model.bin_min must be below model.bin_max.")
        _require(self.log_std_min < self.log_std_max, "model.log_std_min must be below model.log_std_max.")
        _require_choice("model.activation", self.activation, ("mish", "silu", "relu"))
        _require(0 <= self.dropout < 1, f"model.dropout must be in [0, 1), got {self.dropout}.")


@dataclass(frozen=True)
class PlannerConfig:
    """Budget and objective of one planner; see :class:`~torchrl_etdmpc.planners.EnsembleMPPIPlanner`."""

    horizon: int = 6
    num_samples: int = 512
    num_elites: int = 64
    num_proposals: int = 24
    iterations: int = 6
    extra_iterations: int = 2
    large_action_dim: int = 20
    score: str = "mean"
    beta: float = 0.0
    inverse_temperature: float = 0.5
    std_min: float = 0.05
    std_max: float = 2.0
    first_action: str = "elite"
    eval_first_action: str = "best"
    scoring_dtype: str = "float32"
    """``bfloat16`` rolls and scores candidates in half precision; learning with it is measured on walker-stand only."""

    def __post_init__(self) -> None:
        group = "reanalyze" if isinstance(self, ReanalyzeConfig) else "planner"
        _require_positive(f"{group}.", self, "horizon", "iterations", "num_elites")
        _require(
            self.num_elites <= self.num_samples,
            f"{group}.num_elites must be at most {group}.num_samples={self.num_samples}, got {self.num_elites}.",
        )
        _require(
            0 <= self.num_proposals < self.num_samples,
            f"{group}.num_proposals must be in [0, {self.num_samples}), got {self.num_proposals}.",
        )
        for name in ("extra_iterations", "inverse_temperature"):
            _require(getattr(self, name) >= 0, f"{group}.{name} must not be negative, got {getattr(self, name)}.")
        _require(
            0 < self.std_min <= self.std_max,
            f"{group}.std_min must be in (0, {group}.std_max={self.std_max}], got {self.std_min}.",
        )
        _require_choice(f"{group}.score", self.score, ("final", "mean", "adaptive"))
        _require(
            self.score != "adaptive" or self.beta >= 0,
            f"{group}.beta must not be negative with {group}.score=adaptive, got {self.beta}.",
        )
        for name in ("first_action", "eval_first_action"):
            _require_choice(f"{group}.{name}", getattr(self, name), ("elite", "mean", "best"))
        _require_choice(f"{group}.scoring_dtype", self.scoring_dtype, ("float32", "bfloat16"))


@dataclass(frozen=True)
class ReanalyzeConfig(PlannerConfig):
    """The planner of reanalyze and when it runs; see :class:`~torchrl_etdmpc.replay.ReanalyzeTransform`."""

    horizon: int = 3
    num_samples: int = 64
    num_elites: int = 8
    num_proposals: int = 3
    score: str = "final"
    every: int = 10
    """Decision steps between two reanalyzed batches; 0 turns reanalyze off."""
    num_slices: int = 20
    proposal_log_std_min: float = -2.0
    proposal_log_std_max: float = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        _require(self.every >= 0, f"reanalyze.every must not be negative, got {self.every}; 0 turns reanalyze off.")
        _require_positive("reanalyze.", self, "num_slices")
        _require(
            self.proposal_log_std_min < self.proposal_log_std_max,
            "reanalyze.proposal_log_std_min must be below reanalyze.proposal_log_std_max.",
        )


@dataclass(frozen=True)
class LossConfig:
    """Weights of the loss; see :class:`~torchrl_etdmpc.objectives.EfficientTDMPCLoss`."""

    slice_len: int = 3
    rho: float = 0.5
    consistency_coef: float = 20.0
    reward_coef: float = 0.1
    value_coef: float = 0.1
    termination_coef: float = 1.0
    entropy_coef: float = 1e-4
    kl_direction: str = "backward"
    tau: float = 0.01
    """Rate of the target values and of the running scale."""
    discount: float | None = None
    """Default: from the episode length (0.99 for DMC)."""

    def __post_init__(self) -> None:
        _require_positive("loss.", self, "slice_len")
        _require(0 < self.rho <= 1, f"loss.rho must be in (0, 1], got {self.rho}.")
        _require(0 <= self.tau <= 1, f"loss.tau must be in [0, 1], got {self.tau}.")
        _require(
            self.discount is None or 0 < self.discount <= 1, f"loss.discount must be in (0, 1], got {self.discount}."
        )
        _require_choice("loss.kl_direction", self.kl_direction, ("backward", "forward"))


@dataclass(frozen=True)
class OptimConfig:
    """Optimisation (thesis Table A.1); see :class:`~torchrl_etdmpc.training.Updater`."""

    batch_size: int = 256
    """Slices per update."""
    updates_per_decision: int = 1
    """The UTD ratio: model, value and policy updates per decision step."""
    lr: float = 3e-4
    encoder_lr_scale: float = 0.3
    grad_clip_norm: float = 20.0

    def __post_init__(self) -> None:
        _require_positive("optim.", self, "batch_size", "updates_per_decision")
        for name in ("lr", "grad_clip_norm"):
            _require(getattr(self, name) > 0, f"optim.{name} must be positive, got {getattr(self, name)}.")
        _require(
            self.encoder_lr_scale >= 0, f"optim.encoder_lr_scale must not be negative, got {self.encoder_lr_scale}."
        )


@dataclass(frozen=True)
class ReplayConfig:
    """The buffer and its seed phase."""

    capacity: int = 1_000_000
    """Transitions; never more than the budget."""
    insertion: str = "step"
    uniform_over: str = "episodes"
    device: str = "auto"
    """Where the storage lives: ``cpu``; ``run``, the run's device; ``auto``, the run's device if the full buffer takes
    at most half of its free memory."""
    seed_decisions: int | None = None
    """Decisions of uniform random actions. Default: max(1000, 5 episodes)."""
    pretrain_updates: int | None = None
    """Updates without the policy loss after the seed phase. Default: as many as there were seed decisions."""

    def __post_init__(self) -> None:
        _require_positive("replay.", self, "capacity")
        _require(
            self.pretrain_updates is None or self.pretrain_updates >= 0,
            f"replay.pretrain_updates must not be negative, got {self.pretrain_updates}.",
        )
        _require_choice("replay.insertion", self.insertion, ("step", "episode"))
        _require_choice("replay.uniform_over", self.uniform_over, ("episodes", "starts"))
        _require_choice("replay.device", self.device, ("auto", "cpu", "run"))


@dataclass(frozen=True)
class TrainConfig:
    """A whole run. Steps that users see are environment steps; one decision is ``action_repeat`` of them."""

    task: str = "walker-walk"
    preset: str = "efficient-tdmpc"
    seed: int = 1
    total_env_steps: int = 200_000
    run_dir: str | None = None
    num_envs: int = 1
    overlap: bool = False
    """Whether the simulator steps while the device updates, which makes the sampled data one decision older."""
    device: str = "auto"
    compile: str = "auto"
    logger: str = "none"
    eval_every: int = 50_000
    eval_episodes: int = 10
    eval_policy: bool = False
    """Whether evaluations also report the policy without the planner."""
    checkpoint_every: int = 50_000
    log_every: int = 1_000
    checkpoint_minutes: float | None = 15.0
    """A checkpoint is also written when the last one is this old; ``null`` for never."""
    max_faults: int = 10
    """Failures of the simulator or of the policy, without a finished episode in between, before the run stops."""
    max_skipped: int = 100
    """Updates in a row without a finite gradient, which are skipped, before the run stops."""
    checkpoint_keep: int = 2
    """Checkpoints to go on from that are kept."""
    resume: str = "off"
    """``on`` (or ``true``) goes on from the run directory's newest checkpoint, ``auto`` does if there is one."""
    threads: int | None = None
    """CPU threads of PyTorch. Default: PyTorch's own choice."""
    model: ModelConfig = field(default_factory=ModelConfig)
    planner: PlannerConfig = field(default_factory=PlannerConfig)
    reanalyze: ReanalyzeConfig = field(default_factory=ReanalyzeConfig)
    loss: LossConfig = field(default_factory=LossConfig)
    optim: OptimConfig = field(default_factory=OptimConfig)
    replay: ReplayConfig = field(default_factory=ReplayConfig)

    def __post_init__(self) -> None:
        task = get_task(self.task)
        _require_choice("resume", self.resume, ("off", "on", "auto"))
        _require(
            self.checkpoint_minutes is None or self.checkpoint_minutes > 0,
            f"checkpoint_minutes must be positive or null, got {self.checkpoint_minutes}.",
        )
        _require_positive("", self, "checkpoint_keep", "max_faults", "max_skipped")
        _require_choice("device", self.device.split(":")[0], ("auto", "cpu", "cuda"))
        _require_choice("compile", self.compile, ("auto", "off", "default", "max"))
        _require_choice("logger", self.logger, ("none", "tensorboard", "wandb"))
        _require_positive("", self, "num_envs", "eval_every", "eval_episodes", "checkpoint_every", "log_every")
        _require(self.threads is None or self.threads >= 1, f"threads must be at least 1, got {self.threads}.")
        episode = task.decision_steps_per_episode
        _require(
            self.loss.slice_len <= episode,
            f"loss.slice_len must fit into an episode of {episode} decisions, got {self.loss.slice_len}.",
        )
        # Fewer rows may hold nothing but the end of one episode and the beginning of the next.
        least = episode * self.num_envs if self.replay.insertion == "episode" else 0
        least = max(least, 2 * self.loss.slice_len * self.num_envs)
        _require(
            self.replay.capacity >= least,
            f"replay.capacity must be at least {least} with these settings, got {self.replay.capacity}.",
        )
        seed_env_steps = self.seed_decisions * task.action_repeat
        _require(
            self.total_env_steps > seed_env_steps,
            f"total_env_steps must exceed the seed phase of {seed_env_steps} env steps, got {self.total_env_steps}; "
            "raise the budget or lower replay.seed_decisions.",
        )
        _require(
            self.seed_decisions >= self.loss.slice_len * self.num_envs,
            f"replay.seed_decisions must be at least loss.slice_len * num_envs={self.loss.slice_len * self.num_envs}, "
            f"got {self.seed_decisions}.",
        )
        if self.replay.insertion == "episode":
            per_episode = episode * self.num_envs
            _require(
                self.seed_decisions >= per_episode,
                f"replay.seed_decisions must cover an episode of every environment ({per_episode} decisions) with "
                f"replay.insertion=episode, got {self.seed_decisions}.",
            )

    @property
    def task_spec(self) -> Task:
        """The task behind the name."""
        return get_task(self.task)

    @property
    def seed_decisions(self) -> int:
        """Length of the seed phase in decisions (spec: max(1000, 5 episodes))."""
        if self.replay.seed_decisions is not None:
            return self.replay.seed_decisions
        return max(1000, 5 * self.task_spec.decision_steps_per_episode)

    @property
    def pretrain_updates(self) -> int:
        """Updates without the policy loss after the seed phase."""
        return self.seed_decisions if self.replay.pretrain_updates is None else self.replay.pretrain_updates

    def to_dict(self) -> dict[str, Any]:
        """Nested plain dictionary, as it is written to ``config.yaml``."""
        return dataclasses.asdict(self)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> TrainConfig:
        """Inverse of :meth:`to_dict`; missing entries take the default.

        Raises:
            ValueError: if a key is unknown, or a value has the wrong type or is out of range.
        """
        return config_from_dict(cls, values)


def config_from_dict(cls: type, values: Mapping[str, Any], prefix: str = "") -> Any:
    """A (nested) configuration dataclass from a dictionary, with every value's type checked.

    Args:
        cls (type): the dataclass.
        values (mapping): its fields, nested dataclasses as mappings; missing fields take their default.
        prefix (str): path of the group, for messages.

    Raises:
        ValueError: if a key is unknown, or a value has the wrong type or is out of range.
    """
    hints = typing.get_type_hints(cls)
    unknown = sorted(set(values) - set(hints))
    _require(not unknown, f"unknown setting {prefix}{unknown[0] if unknown else ''}; known: {', '.join(hints)}.")
    converted = {}
    for name, value in values.items():
        hint = hints[name]
        if dataclasses.is_dataclass(hint):
            _require(isinstance(value, Mapping), f"{prefix}{name} must be a group of settings, got {value!r}.")
            converted[name] = config_from_dict(hint, value, f"{prefix}{name}.")
        else:
            converted[name] = _convert(hint, value, f"{prefix}{name}")
    return cls(**converted)


def _convert(hint: Any, value: Any, name: str) -> Any:
    if isinstance(hint, types.UnionType):
        if value is None:
            return None
        hint = next(option for option in typing.get_args(hint) if option is not type(None))
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if hint is int and isinstance(value, float) and value.is_integer():
        return int(value)  # 2e5 is a natural way to write a budget
    if hint is str and isinstance(value, bool):
        return "off" if value is False else "on"  # YAML reads a bare off as a boolean
    if type(value) is not hint:
        raise ValueError(f"{name} must be of type {hint.__name__}, got {value!r}.")
    return value
