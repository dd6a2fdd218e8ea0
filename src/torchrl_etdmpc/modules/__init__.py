"""Networks: plain tensors in, plain tensors out."""

from torchrl_etdmpc.modules.dynamics import DynamicsEnsemble
from torchrl_etdmpc.modules.encoder import Encoder
from torchrl_etdmpc.modules.heads import RewardHead, TerminationHead, ValueEnsemble
from torchrl_etdmpc.modules.normed_linear import MLP, Activation, EnsembleLinear, NormedLinear
from torchrl_etdmpc.modules.policy import GaussianPolicy
from torchrl_etdmpc.modules.prediction import PolicyModel, PredictionModel, device_and_dtype
from torchrl_etdmpc.modules.world_model import WorldModel

__all__ = [
    "MLP",
    "Activation",
    "DynamicsEnsemble",
    "Encoder",
    "EnsembleLinear",
    "GaussianPolicy",
    "NormedLinear",
    "PolicyModel",
    "PredictionModel",
    "RewardHead",
    "TerminationHead",
    "ValueEnsemble",
    "WorldModel",
    "device_and_dtype",
]
