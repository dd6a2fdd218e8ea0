"""Acting in environments: collection one step at a time, and evaluation."""

from torchrl_etdmpc.collectors.errors import NonFiniteError, SimulatorError
from torchrl_etdmpc.collectors.evaluate import Episodes, evaluate
from torchrl_etdmpc.collectors.seed_policy import SeedPolicy
from torchrl_etdmpc.collectors.step import StepCollector

__all__ = ["Episodes", "NonFiniteError", "SeedPolicy", "SimulatorError", "StepCollector", "evaluate"]
