"""What the planner saw: episodes to look at, and the true simulator beside the imagined one."""

from __future__ import annotations

from torchrl_etdmpc.inspector.episodes import Episode, Rolled, Simulator, play_episode

__all__ = ["Episode", "Rolled", "Simulator", "play_episode"]
