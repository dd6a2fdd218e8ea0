"""Studies of a planner: each a function from planner and states to arrays, a table, a figure and a few lines of text.

Every module has ``table(result)``, ``lines(result)`` and ``figure(result)`` beside the function of its name.
"""

from __future__ import annotations

from torchrl_etdmpc.inspector.studies.states import Interval, States, TrueWorld, choose_states, episode_interval

__all__ = ["Interval", "States", "TrueWorld", "choose_states", "episode_interval"]
