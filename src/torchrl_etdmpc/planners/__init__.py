"""Planners, their scores, and the imagined environment that they plan in."""

from torchrl_etdmpc.planners.arguments import FirstAction, InitialPlan, ScoringDtype
from torchrl_etdmpc.planners.bare_policy import BarePolicy
from torchrl_etdmpc.planners.ensemble_mppi import EnsembleMPPIPlanner
from torchrl_etdmpc.planners.export import export_planner, export_policy
from torchrl_etdmpc.planners.latent_env import LatentEnv
from torchrl_etdmpc.planners.plan import Plan, PlanNoise, PlanTrace
from torchrl_etdmpc.planners.scores import (
    AdaptiveScore,
    Depths,
    FinalScore,
    FunctionScore,
    MeanScore,
    Score,
    ScoreFunction,
    ScoreName,
    make_score,
)
from torchrl_etdmpc.planners.torchrl_model import TorchRLModel

__all__ = [
    "AdaptiveScore",
    "BarePolicy",
    "Depths",
    "EnsembleMPPIPlanner",
    "FinalScore",
    "FirstAction",
    "FunctionScore",
    "InitialPlan",
    "LatentEnv",
    "MeanScore",
    "Plan",
    "PlanNoise",
    "PlanTrace",
    "Score",
    "ScoreFunction",
    "ScoreName",
    "ScoringDtype",
    "TorchRLModel",
    "export_planner",
    "export_policy",
    "make_score",
]
