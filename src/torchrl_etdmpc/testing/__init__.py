"""Small builders and analytic worlds, for tests of this package and of pipelines that use it."""

from torchrl_etdmpc.testing.builders import random_slices
from torchrl_etdmpc.testing.worlds import AnalyticWorld, LineWorld, LQRWorld

__all__ = ["AnalyticWorld", "LQRWorld", "LineWorld", "random_slices"]
