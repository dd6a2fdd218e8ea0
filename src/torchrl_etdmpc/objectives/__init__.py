"""Losses: TorchRL loss modules and the formulas behind them."""

from torchrl_etdmpc.objectives.efficient_tdmpc import EfficientTDMPCLoss
from torchrl_etdmpc.objectives.latent_rollout import LatentRollout, Slices, latent_rollout
from torchrl_etdmpc.objectives.policy import EfficientTDMPCPolicyLoss, KLDirection, distillation
from torchrl_etdmpc.objectives.terms import LatentRolloutLoss, Reduction, Term, TermFunction
from torchrl_etdmpc.objectives.value import EfficientTDMPCValueLoss, imagined_value_target, td_error, value_error
from torchrl_etdmpc.objectives.world_model import (
    EfficientTDMPCModelLoss,
    consistency_error,
    reward_error,
    termination_error,
)

__all__ = [
    "EfficientTDMPCLoss",
    "EfficientTDMPCModelLoss",
    "EfficientTDMPCPolicyLoss",
    "EfficientTDMPCValueLoss",
    "KLDirection",
    "LatentRollout",
    "LatentRolloutLoss",
    "Reduction",
    "Slices",
    "Term",
    "TermFunction",
    "consistency_error",
    "distillation",
    "imagined_value_target",
    "latent_rollout",
    "reward_error",
    "td_error",
    "termination_error",
    "value_error",
]
