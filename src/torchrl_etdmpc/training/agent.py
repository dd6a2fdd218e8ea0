"""The agent: the parts that learn and act, and how a configuration makes them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch

from torchrl_etdmpc.functional import discount_from_episode_length
from torchrl_etdmpc.keys import PLAN
from torchrl_etdmpc.modules import ActionValueWorldModel, WorldModel
from torchrl_etdmpc.objectives import EfficientTDMPCLoss, LatentRolloutLoss, TDMPC2Loss
from torchrl_etdmpc.planners import EnsembleMPPIPlanner, LatentEnv
from torchrl_etdmpc.training.compilation import compile_call, resolve_compile
from torchrl_etdmpc.training.config import (
    LossConfig,
    ModelConfig,
    PlannerConfig,
    TrainConfig,
    arguments,
    named_settings,
)
from torchrl_etdmpc.training.own_code import own_code
from torchrl_etdmpc.training.updater import Updater


@dataclass(frozen=True)
class Agent:
    """The parts that learn and act; all of them share one world model, or its average where weights are averaged.

    >>> from torchrl_etdmpc.training import build_agent, preset
    >>> agent = build_agent(preset("cpu"), observation_dim=3, action_dim=1)
    >>> agent.planner.world_model is agent.loss.world_model
    True
    """

    world_model: WorldModel
    planner: EnsembleMPPIPlanner
    eval_planner: EnsembleMPPIPlanner
    reanalyze_planner: EnsembleMPPIPlanner
    loss: LatentRolloutLoss
    updater: Updater
    compile_mode: str | None = None

    @property
    def device(self) -> torch.device:
        """Where the networks live."""
        return self.world_model.version.device

    @property
    def acting_model(self) -> WorldModel:
        """The networks that act: the world model, or its average."""
        return self.updater.acting_model

    def make_eager(self) -> None:
        """Gives up compilation."""
        for planner in (self.planner, self.eval_planner, self.reanalyze_planner):
            planner.compiled_plan = None
        self.updater.make_eager()

    def state_dict(self) -> dict[str, Any]:
        """Weights, target weights, running scale, and the optimiser's state."""
        # The loss shares its storage with the world model, so a file holds the weights once.
        parts = {"world_model": self.world_model, "loss": self.loss, "updater": self.updater}
        return {name: part.state_dict() for name, part in parts.items()}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Restores :meth:`state_dict`."""
        self.world_model.load_state_dict(state_dict["world_model"])
        self.loss.load_state_dict(state_dict["loss"])
        self.updater.load_state_dict(state_dict["updater"])


def build_world_model(
    config: ModelConfig, observation_dim: int, action_dim: int, *, terminates: bool = False
) -> WorldModel:
    """The networks for an environment's sizes.

    Args:
        config (ModelConfig): the group.
        observation_dim (int): O.
        action_dim (int): A.

    Keyword Args:
        terminates (bool): whether the task's episodes can end before their time limit. Default: ``False``.

    >>> build_world_model(ModelConfig(latent_dim=16, mlp_dim=32), observation_dim=3, action_dim=2).num_dynamics
    4
    """
    termination = terminates if config.termination is None else config.termination
    sizes = arguments(config, "termination", "action_values")
    with named_settings("model", config):
        made_of = ActionValueWorldModel if config.action_values else WorldModel
        return made_of(observation_dim, action_dim, termination=termination, **sizes)


def build_loss(
    world_model: WorldModel, config: LossConfig, *, discount: float, ignore_termination: bool
) -> LatentRolloutLoss:
    """The loss that trains a world model: :class:`TDMPC2Loss` if it has action values.

    Args:
        world_model (WorldModel): the networks.
        config (LossConfig): the group.

    Keyword Args:
        discount (float): gamma.
        ignore_termination (bool): whether to accept rows that terminate without a termination head.

    Raises:
        ValueError: if a setting is out of range, or is changed although this kind of values has no use for it.
    """
    path = config.extra_terms
    options: dict[str, Any] = {"discount": discount, "scale_tau": config.tau, "ignore_termination": ignore_termination}
    options["extra_terms"] = [] if path is None else own_code("loss.extra_terms", path)(world_model)
    elsewhere = ("slice_len", "tau", "discount", "extra_terms")
    action_values = isinstance(world_model, ActionValueWorldModel)
    unused = (
        ("kl_direction", "value_beta", "value_replayed", "value_expectile") if action_values else ("squashed_entropy",)
    )
    for name in unused:
        if getattr(config, name) != getattr(LossConfig, name):
            raise ValueError(
                f"loss.{name} has no effect with model.action_values={str(action_values).lower()}, got "
                f"{getattr(config, name)}; leave it at {getattr(LossConfig, name)}."
            )
    with named_settings("loss", config, scale_tau="tau"):
        if isinstance(world_model, ActionValueWorldModel):
            return TDMPC2Loss(world_model, **options, **arguments(config, *elsewhere, *unused))
        return EfficientTDMPCLoss(world_model, **options, **arguments(config, *elsewhere, *unused))


def build_planner(
    world_model: WorldModel,
    config: PlannerConfig,
    *,
    discount: float,
    warm_start: bool,
    compile_mode: str | None = None,
    group: str = "planner",
) -> EnsembleMPPIPlanner:
    """A planner on shared networks; ``compile_mode`` compiles its plans.

    Args:
        world_model (WorldModel): the networks.
        config (PlannerConfig): the group.

    Keyword Args:
        discount (float): gamma.
        warm_start (bool): whether to carry the plan from step to step.
        compile_mode (str, optional): of ``torch.compile``. Default: ``None``, eager.
        group (str): the group's name, for messages. Default: ``"planner"``.

    >>> from torchrl_etdmpc.training import preset
    >>> world_model = build_world_model(preset("cpu").model, observation_dim=3, action_dim=1)
    >>> build_planner(world_model, preset("cpu").planner, discount=0.99, warm_start=True).horizon
    3
    """
    schedule = ("every", "num_slices") if group == "reanalyze" else ()  # of ReanalyzeTransform
    if schedule and config.eval_first_action != PlannerConfig.eval_first_action:
        raise ValueError(
            "reanalyze.eval_first_action has no effect, since plans are made anew as in training, got "
            f"{config.eval_first_action!r}; leave it out, or set reanalyze.first_action."
        )
    values = arguments(config, *schedule)
    if ":" in config.score:
        values["score"] = own_code(f"{group}.score", config.score)
    with named_settings(group, config):
        planner = EnsembleMPPIPlanner(LatentEnv(world_model), discount=discount, warm_start=warm_start, **values)
    if compile_mode is not None:
        planner.compiled_plan = compile_call(planner.plan, compile_mode)
    return planner


def build_agent(
    config: TrainConfig, observation_dim: int, action_dim: int, device: torch.device | str = "cpu"
) -> Agent:
    """World model, planners, loss and updater.

    Args:
        config (TrainConfig): the run.
        observation_dim (int): O.
        action_dim (int): A.
        device (torch.device or str): where the networks live. Default: ``"cpu"``.

    Raises:
        ValueError: if a setting is out of range; the text begins with its name.

    >>> from torchrl_etdmpc.training import preset
    >>> build_agent(preset("cpu"), observation_dim=3, action_dim=1).planner.horizon
    3
    """
    device, task = torch.device(device), config.task_spec
    compile_mode = resolve_compile(config.compile, device, config.total_decisions - config.seed_decisions)
    discount = config.loss.discount
    if discount is None:
        discount = discount_from_episode_length(task.decision_steps_per_episode)
    world_model = build_world_model(config.model, observation_dim, action_dim, terminates=task.terminates).to(device)
    ignore = config.model.termination is False
    loss = build_loss(world_model, config.loss, discount=discount, ignore_termination=ignore)
    if config.reanalyze.every and not any(key[0] == PLAN for key in loss.in_keys):
        raise ValueError(
            "reanalyze.every must be 0 where no term of the loss reads a plan, as with model.action_values, got "
            f"{config.reanalyze.every}."
        )
    with named_settings("optim", config.optim):
        optim = arguments(config.optim, "batch_size", "updates_per_decision")
        updater = Updater(loss, tau=config.loss.tau, compile_mode=compile_mode, **optim)
    common = {"discount": discount, "compile_mode": compile_mode}
    model = updater.acting_model
    planner, eval_planner = (build_planner(model, config.planner, warm_start=True, **common) for _ in range(2))
    reanalyze_planner = build_planner(model, config.reanalyze, warm_start=False, group="reanalyze", **common)
    return Agent(world_model, planner, eval_planner, reanalyze_planner, loss, updater, compile_mode)
