"""Configuration of a run: frozen dataclasses, whose groups are the keyword arguments of the classes that they name.

A value's type and choices are checked here, and what concerns several parts; the range of one part's argument is
checked by that part alone.
"""

from __future__ import annotations

import dataclasses
import functools
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Literal

from torchrl_etdmpc.collectors.step import Insertion
from torchrl_etdmpc.envs import Task, get_task
from torchrl_etdmpc.modules.normed_linear import Activation
from torchrl_etdmpc.objectives.policy import KLDirection
from torchrl_etdmpc.planners import FirstAction, InitialPlan, ScoringDtype
from torchrl_etdmpc.planners.scores import ScoreName
from torchrl_etdmpc.replay.slices import UniformOver
from torchrl_etdmpc.runs import LoggerName
from torchrl_etdmpc.training.conversion import check_types, config_from_dict, require

TASK_SETTINGS = ("action_repeat", "episode_length", "terminates")
"""Written as ``task.action_repeat`` etc. on the command line; ``task`` itself is a name, not a group."""


def typed_name(name: str) -> str:
    """A setting as it is written on the command line.

    >>> typed_name("action_repeat"), typed_name("seed"), typed_name("task.action_repeat")
    ('task.action_repeat', 'seed', 'task.action_repeat')
    """
    return f"task.{name}" if name in TASK_SETTINGS else name


_LEAST_SEED_DECISIONS = 1000  # unless told
_FAILED_RESETS = 100  # that a buffer has room for
MOST_EPISODES = 10_000
"""Of one evaluation: each is an environment in memory."""


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
    activation: Activation = "mish"
    normalize_observations: bool = False
    """Whether observations are standardised by their running mean and variance. Not in the thesis."""
    action_values: bool = False
    """Whether the value heads read the action too, as in TD-MPC2: the policy then maximises them, its actions squashed
    by a tanh, and learns nothing from plans."""
    termination: bool | None = None
    """Whether there is a termination head. Default: if the task can end before its time limit. ``false`` on such a task
    bootstraps through its ends, as BMPC's code does."""


@dataclass(frozen=True)
class PlannerConfig:
    """Budget and score of one planner; see :class:`~torchrl_etdmpc.planners.EnsembleMPPIPlanner`."""

    horizon: int = 6
    num_samples: int = 512
    num_elites: int = 64
    """K, candidates to which the next Gaussian is fitted."""
    num_proposals: int = 24
    iterations: int = 6
    """How often candidates are drawn and the Gaussian is fitted."""
    extra_iterations: int = 2
    large_action_dim: int = 20
    """More dimensions than this count as many."""
    score: ScoreName | str = "mean"
    """What a candidate is worth by its table of returns; or a function of your own, ``module:function``."""
    beta: float = 0.0
    inverse_temperature: float = 0.5
    std_min: float = 0.05
    """Smallest standard deviation."""
    std_max: float = 2.0
    initial: InitialPlan = "wide"
    """Where a search begins: ``wide`` is around the last plan, with the largest deviation; ``policy``, which is not in
    the thesis, is where the policy is."""
    first_action: FirstAction = "elite"
    eval_first_action: FirstAction = "best"
    scoring_dtype: ScoringDtype | None = None
    """``bfloat16`` rolls and scores candidates in half precision; learning with it is measured on walker-stand only.
    Default: the dtype of the weights."""


@dataclass(frozen=True)
class ReanalyzeConfig(PlannerConfig):
    """The planner of reanalyze and when it runs; see :class:`~torchrl_etdmpc.replay.ReanalyzeTransform`."""

    horizon: int = 3
    num_samples: int = 64
    num_elites: int = 8
    num_proposals: int = 3
    score: ScoreName | str = "final"
    every: int = 10
    """Decision steps between two reanalyzed batches; 0 turns reanalyze off."""
    num_slices: int = 20
    proposal_log_std_min: float | None = -2.0
    proposal_log_std_max: float | None = 1.0


@dataclass(frozen=True)
class LossConfig:
    """Weights of the loss; see :class:`~torchrl_etdmpc.objectives.EfficientTDMPCLoss`."""

    slice_len: int = 3
    """Transitions per replayed slice."""
    rho: float = 0.5
    consistency_coef: float = 20.0
    """Weight of predicting the next latent."""
    reward_coef: float = 0.1
    """Weight of predicting the reward."""
    value_coef: float = 0.1
    """Weight of the values' error."""
    value_beta: float = 0.0
    """Pessimism of the value targets: the weight of the standard deviation of the mean over dynamics and value heads.
    Not of action values, whose targets are the least of two heads."""
    value_replayed: float = 0.0
    """How much of the value targets, from 0 to 1, is what was paid in the rest of the replayed slice, and not what the
    model imagines of the next step. Not in the thesis, and not of action values, which learn from replayed steps
    anyway."""
    value_expectile: float = 0.5
    """Which expectile of their targets values learn: above 0.5 the better of what was done in a state counts more. Not
    in the thesis, and not of action values."""
    termination_coef: float = 1.0
    """Weight of predicting the end of an episode, where there is a termination head."""
    entropy_coef: float = 1e-4
    """Weight of the policy's entropy."""
    kl_direction: KLDirection = "backward"
    squashed_entropy: bool = True
    """With action values: whether the entropy is that of the squashed actions; ``false`` is that of the Gaussian before
    the tanh, as in TD-MPC2's code."""
    tau: float = 0.01
    """Rate of the target values and of the running scale."""
    discount: float | None = None
    """Default: from the episode length (0.99 for DMC)."""
    extra_terms: str | None = None
    """Terms of your own, ``module:function``: a function of the world model that returns a list of Term."""


@dataclass(frozen=True)
class OptimConfig:
    """Optimisation (thesis Table A.1); see :class:`~torchrl_etdmpc.training.Updater`."""

    batch_size: int = 256
    """Slices per update."""
    updates_per_decision: int = 1
    """The UTD ratio: model, value and policy updates per decision step."""
    lr: float = 3e-4
    encoder_lr_scale: float = 0.3
    lr_halved_after: float | None = None
    grad_clip_norm: float = 20.0
    average_decay: float = 0.0


@dataclass(frozen=True)
class ReplayConfig:
    """The buffer and its random phase."""

    capacity: int = 1_000_000
    """Transitions; never more than the budget."""
    insertion: Insertion = "step"
    """Whether a transition can be sampled at once or after its episode."""
    uniform_over: UniformOver = "episodes"
    """Whether a slice is drawn by its episode first, which favours the running one, or from all alike."""
    partial: bool | None = None
    """Whether a slice may also begin in the last steps of an ended episode; what is beyond the end counts for nothing.
    Default: if the task can end before its time limit, so that the last steps before an end are learned from as often
    as others."""
    device: Literal["auto", "cpu", "run"] = "auto"
    """Where the storage lives: ``cpu``; ``run``, the run's device; ``auto``, the run's device if the full buffer takes
    at most half of its free memory."""
    seed_decisions: int | None = None
    """Length of the random phase: decisions of uniform random actions. Default: max(1000, 5 episodes)."""
    seed_hold: float = 1.0
    """For how many decisions a random action is held in the mean. Not in the thesis, whose actions are all new."""
    pretrain_updates: int | None = None
    """Updates after the random phase. Default: as many as it had decisions."""
    pretrain_policy: bool = False
    """Whether these train the policy too, as in TD-MPC2; from random plans it would learn to be random."""


@dataclass(frozen=True)
class TrainConfig:
    """A whole run. Steps that users see are environment steps; one decision is ``action_repeat`` of them.

    >>> TrainConfig(task="gym/Pendulum-v1", total_env_steps=10_000).seed_decisions
    1000
    """

    task: str = "walker-walk"
    """A task of DMC or HumanoidBench, gym/ID for one of Gymnasium, or module:function for your own."""
    preset: str = "efficient-tdmpc"
    """The values to begin with: efficient-tdmpc, efficient-tdmpc-utd2, efficient-tdmpc-utd4, humanoidbench, bmpc and
    tdmpc2 are for a GPU, cpu and tdmpc2-cpu learn on a CPU in minutes."""
    seed: int = 1
    """Of all random numbers."""
    total_env_steps: int = 200_000
    """The budget; steps of all environments count."""
    run_dir: str | None = None
    """Where the run's files go. Default: runs/TASK/PRESET/seedSEED."""
    action_repeat: int | None = None
    """Environment steps per decision (``task.action_repeat`` on the command line). Default: the task's own."""
    episode_length: int | None = None
    """Environment steps until the time limit (``task.episode_length``). Default: the task's own."""
    terminates: bool | None = None
    """Whether episodes can end before their time limit (``task.terminates``). Default: what is known of the task."""
    num_envs: int = 1
    """Environments that step side by side, each in a process of its own."""
    overlap: bool = False
    """Whether updates come between planning and the simulator's step, so that a device computes while it steps; the
    sampled data is one decision older."""
    device: str = "auto"
    """auto, cpu, cuda or cuda:N."""
    compile: Literal["auto", "off", "default", "max"] = "auto"
    """``auto`` compiles planner and gradients where it can, which takes two minutes the first time; on a CPU, in runs
    of at least 6,000 decisions after the random phase, for which that pays."""
    logger: LoggerName = "none"
    """Where the numbers go besides the run's own files."""
    eval_every: int = 50_000
    """Environment steps between two evaluations of learning; the one before it is of the untrained agent."""
    eval_episodes: int = 10
    """Episodes of an evaluation."""
    eval_policy: bool = False
    """Whether evaluations also report the policy without the planner."""
    checkpoint_every: int = 50_000
    """Environment steps between two checkpoints of learning; before it ``checkpoint_minutes`` counts alone."""
    log_every: int = 1_000
    """Environment steps between two rows of ``train.csv``."""
    checkpoint_minutes: float | None = 15.0
    """A checkpoint is also written when the last one is this old; ``null`` for never."""
    max_faults: int = 10
    """Failures of the simulator or of the policy, without a finished episode in between, before the run stops."""
    max_skipped: int = 100
    """Updates in a row without a finite gradient, which are skipped, before the run stops."""
    checkpoint_keep: int = 2
    """Checkpoints to go on from that are kept."""
    resume: Literal["off", "on", "auto", "weights"] = "off"
    """``on`` (or ``true``) goes on from the run directory's newest checkpoint, ``auto`` does if there is one;
    ``weights`` does with the weights and what is left of the buffer if no checkpoint is whole."""
    threads: int | None = None
    """CPU threads of PyTorch. Default: PyTorch's own choice."""
    model: ModelConfig = field(default_factory=ModelConfig)
    planner: PlannerConfig = field(default_factory=PlannerConfig)
    reanalyze: ReanalyzeConfig = field(default_factory=ReanalyzeConfig)
    loss: LossConfig = field(default_factory=LossConfig)
    optim: OptimConfig = field(default_factory=OptimConfig)
    replay: ReplayConfig = field(default_factory=ReplayConfig)

    _step_setting = "num_envs"
    """The setting that says how many decisions come together; a class attribute and no setting itself."""

    def __post_init__(self) -> None:
        check_types(self)
        check_device(self.device)
        require(
            self.checkpoint_minutes is None or self.checkpoint_minutes > 0,
            f"checkpoint_minutes must be positive or null, got {self.checkpoint_minutes}.",
        )
        require(0 <= self.seed < 2**32, f"seed must be in [0, 2**32 - 1], got {self.seed}.")
        counts = ("num_envs", "eval_every", "eval_episodes", "checkpoint_every", "checkpoint_keep", "log_every")
        least_one = {name: getattr(self, name) for name in (*counts, "max_faults", "max_skipped", "threads")}
        least_one |= {"optim.batch_size": self.optim.batch_size, "replay.capacity": self.replay.capacity}
        least_one |= {"optim.updates_per_decision": self.optim.updates_per_decision}
        least_one |= {"replay.seed_hold": self.replay.seed_hold}
        for name, number in least_one.items():
            require(number is None or number >= 1, f"{name} must be at least 1, got {number}.")
        coefficients = {f"loss.{name}": value for name, value in vars(self.loss).items() if name.endswith("_coef")}
        for name, number in {
            "replay.seed_decisions": self.seed_decisions,
            "replay.pretrain_updates": self.pretrain_updates,
            "reanalyze.every": self.reanalyze.every,
            **coefficients,
        }.items():
            require(number >= 0, f"{name} must not be negative, got {number}.")
        for name, most in {
            "num_envs": 4096,
            "threads": 4096,
            "eval_episodes": MOST_EPISODES,
        }.items():  # each is one in memory
            require((getattr(self, name) or 0) <= most, f"{name} must be at most {most}, got {getattr(self, name)}.")
        betas = {"planner.beta": self.planner.beta, "loss.value_beta": self.loss.value_beta}
        if self.reanalyze.every:
            betas["reanalyze.beta"] = self.reanalyze.beta
        for name, beta in betas.items():
            require(
                not beta or (self.model.num_dynamics, self.model.num_values) != (1, 1),
                f"{name} has no effect with one dynamics head and one value head, got {beta}; set it to 0, or raise "
                "model.num_dynamics or model.num_values.",
            )
        self._check_against_the_episode(self.task_spec)

    def _check_against_the_episode(self, task: Task) -> None:
        episode, slice_len = task.decision_steps_per_episode, self.loss.slice_len
        require(
            slice_len <= episode,
            f"loss.slice_len must fit into an episode of {episode} decisions (task.episode_length="
            f"{task.episode_length}, task.action_repeat={task.action_repeat}), got {slice_len}.",
        )
        per_episode = episode * self.num_envs if self.replay.insertion == "episode" else 0
        # Fewer rows may hold nothing but the end of one episode and the beginning of the next.
        least = max(per_episode, 2 * slice_len * self.num_envs)
        require(
            self.replay.capacity >= least,
            f"replay.capacity must be at least {least} with these settings, got {self.replay.capacity}.",
        )
        together = max(self.decisions_per_step, 1)
        seed_env_steps = -(-self.seed_decisions // together) * together * task.action_repeat
        lower = "replay.seed_decisions"
        if self.episode_length and self.replay.seed_decisions is None and self.seed_decisions > _LEAST_SEED_DECISIONS:
            lower += " or task.episode_length"
        if together > self.seed_decisions:
            lower = self._step_setting
        require(
            self.total_env_steps > seed_env_steps,
            f"total_env_steps must exceed the random phase of {seed_env_steps} env steps, got {self.total_env_steps}; "
            f"raise the budget or lower {lower}.",
        )
        require(
            self.seed_decisions >= slice_len * self.num_envs,
            f"replay.seed_decisions must be at least loss.slice_len * num_envs={slice_len * self.num_envs}, "
            f"got {self.seed_decisions}.",
        )
        require(
            self.seed_decisions >= per_episode,
            f"replay.seed_decisions must cover an episode of every environment ({per_episode} decisions) with "
            f"replay.insertion=episode, got {self.seed_decisions}.",
        )

    @functools.cached_property
    def task_spec(self) -> Task:
        """The task behind the name, with what this run changes about it."""
        return get_task(
            self.task,
            action_repeat=self.action_repeat,
            episode_length=self.episode_length,
            terminates=self.terminates,
        )

    @property
    def seed_decisions(self) -> int:
        """Length of the random phase in decisions (default: max(1000, 5 episodes))."""
        if self.replay.seed_decisions is not None:
            return self.replay.seed_decisions
        return max(_LEAST_SEED_DECISIONS, 5 * self.task_spec.decision_steps_per_episode)

    @property
    def refreshed_states(self) -> int:
        """States that a reanalyze plans for, which a batch must have; 0 without reanalyze."""
        slices = min(self.reanalyze.num_slices, self.optim.batch_size) if self.reanalyze.every else 0
        return slices * self.loss.slice_len

    @property
    def replay_rows(self) -> int:
        """Rows of the buffer: as many as the budget can fill, at most its capacity.

        Steps before a reset that failed are stored beside the budget.
        """
        return min(self.replay.capacity, self.total_decisions + self.num_envs * (1 + _FAILED_RESETS))

    @property
    def partial_slices(self) -> bool:
        """Whether slices may begin in the last steps of an ended episode, so that batches are masked."""
        # Departure from BMPC, whose slices lie within an episode: its last steps then never begin a slice, and what is
        # learned of them has the least weight.
        return self.task_spec.terminates if self.replay.partial is None else self.replay.partial

    @property
    def pretrain_updates(self) -> int:
        """Updates between the random phase and learning."""
        return self.seed_decisions if self.replay.pretrain_updates is None else self.replay.pretrain_updates

    @property
    def decisions_per_step(self) -> int:
        """Decisions that come together."""
        return getattr(self, self._step_setting)

    @property
    def total_decisions(self) -> int:
        """The budget in decisions, all environments together."""
        return -(-self.total_env_steps // self.task_spec.action_repeat)

    def to_dict(self) -> dict[str, Any]:
        """Nested plain dictionary, as it is written to ``config.yaml``."""
        return dataclasses.asdict(self)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> TrainConfig:
        """Inverse of :meth:`to_dict`; missing entries take the default.

        That is so whatever ``preset`` says, which is a name here; ``dataclasses.replace(preset("cpu"), ...)`` begins
        with the values of a preset.

        Raises:
            ValueError: if a key is unknown, or a value has the wrong type or is out of range.
        """
        return config_from_dict(cls, values)


def arguments(group: Any, *without: str) -> dict[str, Any]:
    """A group's settings as keyword arguments, but for those that belong elsewhere.

    >>> arguments(OptimConfig(), "batch_size", "updates_per_decision")
    {'lr': 0.0003, 'encoder_lr_scale': 0.3, 'lr_halved_after': None, 'grad_clip_norm': 20.0, 'average_decay': 0.0}
    """
    values = dataclasses.asdict(group)
    for name in without:
        del values[name]
    return values


@contextmanager
def named_settings(group: str, config: Any, **renamed: str) -> Iterator[None]:
    """Names the setting in what a class says of its argument: ``horizon must ...`` becomes ``planner.horizon must``.

    Args:
        group (str): e.g. ``"planner"``.
        config (dataclass): the group.
        **renamed (str): the setting behind an argument of another name.
    """
    try:
        yield
    except ValueError as error:
        argument, _, rest = str(error).partition(" ")
        setting = renamed.get(argument, argument)
        raise ValueError(f"{group}{'.' if hasattr(config, setting) else ': '}{setting} {rest}") from error


def check_device(name: str) -> None:
    """Refuses what is none of the devices that a run or a command can be on."""
    require(
        re.fullmatch(r"auto|cpu|cuda(:\d+)?", name) is not None,
        f"device must be one of auto, cpu, cuda, cuda:N, got {name!r}.",
    )
