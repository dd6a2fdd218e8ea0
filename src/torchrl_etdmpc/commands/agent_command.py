"""The settings that every command on a trained agent has: which agent, and the task that it plays."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

from torchrl_etdmpc.envs import Task, get_task
from torchrl_etdmpc.training import TrainConfig, read_agent_file


@dataclass(frozen=True, kw_only=True)
class AgentCommandConfig:
    """Which agent, on which task."""

    checkpoint: str
    """An agent file, e.g. runs/walker-walk/cpu/seed1/checkpoints/best.pt."""
    task: str | None = None
    """Default: the task of the checkpoint. One of your own, ``module:function``, must be named."""
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

    @property
    def task_spec(self) -> Task:
        """The task that is named, or the one that the agent was trained on, with what its run changed about it."""
        changes = {name: getattr(self, name) for name in ("action_repeat", "episode_length", "terminates")}
        told = {name: value for name, value in changes.items() if value is not None}
        stored = read_agent_file(self.checkpoint)["config"]
        if self.task is not None and self.task != stored["task"]:
            return get_task(self.task, **told)
        return dataclasses.replace(TrainConfig.from_dict(stored).task_spec, **told)
