"""Small builders and analytic worlds, for tests of this package and of pipelines that use it."""

from torchrl_etdmpc.testing.builders import random_slices

__all__ = ["random_slices"]
