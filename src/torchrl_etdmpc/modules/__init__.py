"""Networks: plain tensors in, plain tensors out."""

from torchrl_etdmpc.modules.action_value_model import ActionValueWorldModel
from torchrl_etdmpc.modules.dynamics import DynamicsEnsemble
from torchrl_etdmpc.modules.encoder import Encoder
from torchrl_etdmpc.modules.heads import ActionValueEnsemble, RewardHead, TerminationHead, ValueEnsemble
from torchrl_etdmpc.modules.normed_linear import MLP, Activation, EnsembleLinear, NormedLinear
from torchrl_etdmpc.modules.policy import GaussianPolicy, SquashedGaussianPolicy
from torchrl_etdmpc.modules.prediction import (
    ActionValueModel,
    PolicyModel,
    PredictionModel,
    device_and_dtype,
    has_action_values,
    has_policy,
    require_prediction_model,
)
from torchrl_etdmpc.modules.running_norm import RunningNorm
from torchrl_etdmpc.modules.world_model import WorldModel

__all__ = [
    "MLP",
    "ActionValueEnsemble",
    "ActionValueModel",
    "ActionValueWorldModel",
    "Activation",
    "DynamicsEnsemble",
    "Encoder",
    "EnsembleLinear",
    "GaussianPolicy",
    "NormedLinear",
    "PolicyModel",
    "PredictionModel",
    "RewardHead",
    "RunningNorm",
    "SquashedGaussianPolicy",
    "TerminationHead",
    "ValueEnsemble",
    "WorldModel",
    "device_and_dtype",
    "has_action_values",
    "has_policy",
    "require_prediction_model",
]
