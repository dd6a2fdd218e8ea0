"""EfficientTDMPC for TorchRL: a world model with a dynamics ensemble, planned over and distilled into a policy.

Dimensions, everywhere in the package: ``B`` batch, ``T`` steps of a replayed slice, ``N`` candidates, ``P`` proposals,
``K`` elites, ``I`` iterations, ``H`` horizon, ``D`` depths of the return table, ``F`` dynamics heads, ``V`` value
heads, ``A`` action, ``L`` latent, ``O`` observation, ``M`` bins. ``[..., N, H, A]`` reads "any leading batch, then
candidates, steps, action dimensions".
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torchrl_etdmpc.collectors import NonFiniteError, SeedPolicy, SimulatorError, StepCollector
    from torchrl_etdmpc.modules import ActionValueWorldModel, PredictionModel, WorldModel
    from torchrl_etdmpc.objectives import (
        EfficientTDMPCLoss,
        EfficientTDMPCModelLoss,
        EfficientTDMPCPolicyLoss,
        EfficientTDMPCValueLoss,
        TDMPC2Loss,
    )
    from torchrl_etdmpc.planners import (
        AdaptiveScore,
        EnsembleMPPIPlanner,
        FinalScore,
        LatentEnv,
        MeanScore,
        Plan,
        PlanTrace,
        export_planner,
        export_policy,
    )
    from torchrl_etdmpc.replay import ReanalyzeTransform, StepSliceSampler

__version__ = "0.2.0.dev0"

__all__ = [
    "ActionValueWorldModel",
    "AdaptiveScore",
    "EfficientTDMPCLoss",
    "EfficientTDMPCModelLoss",
    "EfficientTDMPCPolicyLoss",
    "EfficientTDMPCValueLoss",
    "EnsembleMPPIPlanner",
    "FinalScore",
    "LatentEnv",
    "MeanScore",
    "NonFiniteError",
    "Plan",
    "PlanTrace",
    "PredictionModel",
    "ReanalyzeTransform",
    "SeedPolicy",
    "SimulatorError",
    "StepCollector",
    "StepSliceSampler",
    "TDMPC2Loss",
    "WorldModel",
    "export_planner",
    "export_policy",
]

_PARTS = ("collectors", "functional", "modules", "objectives", "planners", "replay")


def __getattr__(name: str) -> Any:
    """Imports what is asked for when it is asked for: a command can answer Ctrl-C before PyTorch is there."""
    if name in _PARTS:
        return importlib.import_module(f"{__name__}.{name}")
    if name in __all__:
        for part in _PARTS:
            module = importlib.import_module(f"{__name__}.{part}")
            if name in module.__all__:
                return getattr(module, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
