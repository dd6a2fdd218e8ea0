"""Planners and their objectives."""

from torchrl_etdmpc.planners.ensemble_mppi import EnsembleMPPIPlanner
from torchrl_etdmpc.planners.plan import Plan, PlanNoise, PlanTrace
from torchrl_etdmpc.planners.scores import AdaptiveScore, FinalScore, MeanScore, Score, make_score

__all__ = [
    "AdaptiveScore",
    "EnsembleMPPIPlanner",
    "FinalScore",
    "MeanScore",
    "Plan",
    "PlanNoise",
    "PlanTrace",
    "Score",
    "make_score",
]
