"""Figures of a trace with plotly (``plotly.graph_objects.Figure``): each is made from the trace alone.

Marks differ in shape as well as in colour, and the colours (cividis, and those of Okabe and Ito) are told apart by
colour-blind people. Backgrounds are transparent, so that a page can be light, dark or printed.
"""

from __future__ import annotations

from torchrl_etdmpc.inspector.figures.drawing import Drawing, empty, plain
from torchrl_etdmpc.inspector.figures.heads import disagreement, mixture_weights, return_table
from torchrl_etdmpc.inspector.figures.plane import latent_plane
from torchrl_etdmpc.inspector.figures.plans import (
    compare_plans,
    plan_and_policy,
    plan_gaussian,
    reward_check,
    score_spread,
)

__all__ = [
    "FIGURES",
    "Drawing",
    "compare_plans",
    "disagreement",
    "empty",
    "latent_plane",
    "mixture_weights",
    "plain",
    "plan_and_policy",
    "plan_gaussian",
    "return_table",
    "reward_check",
    "score_spread",
]

FIGURES = {
    "latent_plane": "Where the candidates lead, by each head",
    "return_table": "Return table: depth x head",
    "disagreement": "Disagreement of the heads by depth",
    "plan_gaussian": "Plan: mean and standard deviation",
    "score_spread": "Scores over the iterations",
    "plan_and_policy": "Plan against policy",
    "mixture_weights": "Weights of the depths (adaptive score)",
    "reward_check": "Rewards: predicted and in the simulator",
}
