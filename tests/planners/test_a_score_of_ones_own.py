"""How to add an objective: one function in one file, and one line where the planner is built."""

from __future__ import annotations

import torch
from tensordict import TensorDict
from torch import Tensor

from torchrl_etdmpc import EnsembleMPPIPlanner, LatentEnv
from torchrl_etdmpc.testing import LineWorld


# The file:
def cautious(returns: Tensor) -> Tensor:
    """What the most pessimistic pair of heads expects, averaged over depths: ``[..., D, F, V]`` to ``[...]``."""
    return returns.mean(-3).amin((-2, -1))


def test_a_new_score_is_one_file_and_one_line():
    # Head 0 believes that actions around -0.5 earn a fortune; the other three know better.
    world = LineWorld(goal=0.3, num_dynamics=4, trap=(-0.75, -0.25))
    budget = {"horizon": 3, "num_samples": 256, "num_elites": 32, "warm_start": False}
    state = TensorDict({"observation": torch.zeros(1, 1)}, batch_size=[1])
    torch.manual_seed(0)
    planner = EnsembleMPPIPlanner(LatentEnv(world), score=cautious, **budget)  # the line
    torch.testing.assert_close(planner(state.clone())["plan", "loc"], torch.tensor([[0.6]]), atol=0.1, rtol=0)
    trapped = EnsembleMPPIPlanner(LatentEnv(world), score="mean", **budget)
    assert -0.75 <= trapped(state.clone())["plan", "loc"].item() <= -0.25
