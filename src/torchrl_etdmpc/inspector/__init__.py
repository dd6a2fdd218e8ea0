"""What the planner saw: traces of single decisions, episodes to take them from, and a page to look at them."""

from __future__ import annotations

from torchrl_etdmpc.inspector.episodes import Episode, Rolled, Simulator, play_episode
from torchrl_etdmpc.inspector.settings import planner_settings, settings_of_class, with_settings
from torchrl_etdmpc.inspector.torchrl_planners import trace_torchrl_planner
from torchrl_etdmpc.inspector.trace import Cancelled, Trace, TraceError, add_simulation, load_trace, trace_plan

__all__ = [
    "Cancelled",
    "Episode",
    "Rolled",
    "Simulator",
    "Trace",
    "TraceError",
    "add_simulation",
    "load_trace",
    "planner_settings",
    "play_episode",
    "settings_of_class",
    "trace_plan",
    "trace_torchrl_planner",
    "with_settings",
]
