"""Networks: plain tensors in, plain tensors out."""

from torchrl_etdmpc.modules.dynamics import DynamicsEnsemble
from torchrl_etdmpc.modules.encoder import Encoder
from torchrl_etdmpc.modules.heads import RewardHead, TerminationHead, ValueEnsemble
from torchrl_etdmpc.modules.normed_linear import MLP, EnsembleLinear, NormedLinear
from torchrl_etdmpc.modules.policy import GaussianPolicy
from torchrl_etdmpc.modules.world_model import WorldModel

__all__ = [
    "MLP",
    "DynamicsEnsemble",
    "Encoder",
    "EnsembleLinear",
    "GaussianPolicy",
    "NormedLinear",
    "RewardHead",
    "TerminationHead",
    "ValueEnsemble",
    "WorldModel",
]
