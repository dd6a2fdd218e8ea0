"""Losses: TorchRL loss modules and the formulas behind them."""

from torchrl_etdmpc.objectives.action_value import action_td_error, action_value_error, action_value_target
from torchrl_etdmpc.objectives.efficient_tdmpc import EfficientTDMPCLoss
from torchrl_etdmpc.objectives.latent_rollout import LatentRollout, latent_rollout
from torchrl_etdmpc.objectives.latent_rollout_loss import LatentRolloutLoss, Reduction
from torchrl_etdmpc.objectives.max_q import PolicyValue, policy_value
from torchrl_etdmpc.objectives.policy import EfficientTDMPCPolicyLoss, KLDirection, distillation
from torchrl_etdmpc.objectives.slices import Slices
from torchrl_etdmpc.objectives.tdmpc2 import TDMPC2Loss
from torchrl_etdmpc.objectives.terms import Term, TermFunction
from torchrl_etdmpc.objectives.value import (
    EfficientTDMPCValueLoss,
    imagined_value_target,
    replayed_value_target,
    td_error,
    value_error,
)
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
    "PolicyValue",
    "Reduction",
    "Slices",
    "TDMPC2Loss",
    "Term",
    "TermFunction",
    "action_td_error",
    "action_value_error",
    "action_value_target",
    "consistency_error",
    "distillation",
    "imagined_value_target",
    "latent_rollout",
    "policy_value",
    "replayed_value_target",
    "reward_error",
    "td_error",
    "termination_error",
    "value_error",
]
