"""The settings that commands on a trained agent share: which agent, the task that it plays, and its planner."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from torchrl_etdmpc.envs import Task, get_task
from torchrl_etdmpc.inspector.trace import checksum
from torchrl_etdmpc.planners import EnsembleMPPIPlanner
from torchrl_etdmpc.training import (
    TASK_SETTINGS,
    Agent,
    TrainConfig,
    build_planner,
    config_of,
    load_agent,
    read_agent_file,
)
from torchrl_etdmpc.training.config import PlannerConfig


@dataclass(frozen=True, kw_only=True)
class AgentCommandConfig:
    """Which agent, on which task."""

    checkpoint: str
    """An agent file, e.g. runs/walker-walk/cpu/seed1/checkpoints/best.pt."""
    task: str | None = None
    """Default: the task of the checkpoint. One of your own, ``module:function``, must be named, and what it trained
    plays no other."""
    action_repeat: int | None = None
    """Environment steps per decision (``task.action_repeat`` on the command line). Default: as it was trained."""
    episode_length: int | None = None
    """Environment steps until the time limit (``task.episode_length``). Default: as it was trained."""
    terminates: bool | None = None
    """Whether episodes can end before their time limit (``task.terminates``). Default: as it was trained."""
    score: str | None = None
    """A ``planner.score`` of your own, ``module:function``, must be named as it was to train with it."""
    reanalyze_score: str | None = None
    """Likewise a ``reanalyze.score``."""
    extra_terms: str | None = None
    """Likewise ``loss.extra_terms``."""

    @functools.cached_property
    def stored(self) -> TrainConfig:
        """The run that the agent is of; read once, since a run that goes on replaces the file."""
        return trained_with(self.checkpoint)

    @property
    def task_spec(self) -> Task:
        """The task that is named, or the one that the agent was trained on, with what its run changed about it."""
        stored = self.stored
        if self.task is not None and self.task != stored.task:
            return get_task(self.task, **(_task_settings(stored) | _task_settings(self)))
        return dataclasses.replace(stored.task_spec, **_task_settings(self))

    def load(self, **options: Any) -> tuple[Agent, TrainConfig, dict[str, Any]]:
        """The agent, as :func:`~torchrl_etdmpc.training.load_agent` loads it.

        Args:
            **options: of that function.

        Raises:
            ValueError: if code is named that the agent was not trained with, which would change nothing.
        """
        stored = self.stored
        own = {"score": stored.planner.score, "reanalyze_score": stored.reanalyze.score}
        for name, trained in (own | {"extra_terms": stored.loss.extra_terms}).items():
            given = getattr(self, name)
            if given not in (None, trained):
                another = (
                    f", or plan with another score: planner.score={given}"
                    if name == "score" and hasattr(self, "planner")
                    else ""
                )
                raise ValueError(
                    f"{name} must be what the agent was trained with, {trained or 'null'}, got {given}; leave it "
                    f"out{another}."
                )
        return load_agent(self.checkpoint, compile_setting="off", **options)

    def load_known(self, **options: Any) -> tuple[Agent, dict[str, Any], str]:
        """The agent, its counters, and the sha256 of the very file that it was loaded from.

        Args:
            **options: as of :meth:`load`.
        """
        while True:  # a run that goes on replaces the file
            digest = checksum(self.checkpoint)
            agent, _, counters = self.load(**options)
            if checksum(self.checkpoint) == digest:
                return agent, counters, digest

    @property
    def changed_task(self) -> dict[str, Any]:
        """The settings of the task that are not those of the agent's training."""
        stored = self.stored.task_spec
        return {name: value for name, value in _task_settings(self).items() if getattr(stored, name) != value}


@dataclass(frozen=True, kw_only=True)
class PlannerCommandConfig(AgentCommandConfig):
    """The same, with settings of the planner: what is not named is as the agent was trained with it."""

    planner: PlannerConfig = field(default_factory=PlannerConfig)

    def planner_of(self, agent: Agent) -> EnsembleMPPIPlanner:
        """A planner on the agent's networks with these settings, as the agent evaluates with."""
        discount = agent.eval_planner.discount
        return build_planner(agent.acting_model, self.planner, discount=discount, warm_start=True)

    @property
    def changed(self) -> dict[str, Any]:
        """The planner's settings that are not those of the agent's training."""
        stored = self.stored.planner
        now = dataclasses.asdict(self.planner)
        return {name: value for name, value in now.items() if getattr(stored, name) != value}


def _task_settings(config: AgentCommandConfig | TrainConfig) -> dict[str, Any]:
    """Those that are not the task's own."""
    told = {name: getattr(config, name) for name in TASK_SETTINGS}
    return {name: value for name, value in told.items() if value is not None}


def trained_with(checkpoint: str) -> TrainConfig:
    """The run that an agent file is of."""
    return config_of(checkpoint, read_agent_file(checkpoint)["config"])


def with_the_agent_s_planner(values: dict[str, Any], explicit: list[str]) -> dict[str, Any]:
    """A command's settings, with those of the planner that it does not name as the agent was trained with them."""
    stored = dataclasses.asdict(trained_with(values["checkpoint"]).planner)
    named: Mapping[str, Any] = values["planner"]
    return {**values, "planner": stored | {name: named[name] for name in named if f"planner.{name}" in explicit}}
