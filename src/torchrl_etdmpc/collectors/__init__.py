"""Collection, one step at a time."""

from torchrl_etdmpc.collectors.seed_policy import SeedPolicy
from torchrl_etdmpc.collectors.step import NonFiniteError, SimulatorError, StepCollector

__all__ = ["NonFiniteError", "SeedPolicy", "SimulatorError", "StepCollector"]
