"""A model behind the Protocol that returns another shape, or another precision, than it is asked for."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from torchrl_etdmpc import EnsembleMPPIPlanner, LatentEnv
from torchrl_etdmpc.testing import LineWorld


class FlatValues(LineWorld):
    def values(self, latent: Tensor) -> Tensor:
        return super().values(latent)[..., 0]


class KeptEnds(LineWorld):
    def termination(self, latent: Tensor) -> Tensor:
        return torch.zeros_like(latent[..., :1])


class KeptRewards(LineWorld):
    def reward(self, latent: Tensor, action: Tensor) -> Tensor:
        return super().reward(latent, action).unsqueeze(-1)


class OneHead(LineWorld):
    def next(self, latent: Tensor, action: Tensor) -> Tensor:
        return super().next(latent, action)[:1]


@pytest.mark.parametrize(
    ("world", "text"),
    [
        (FlatValues, r"FlatValues\.values must return .* here \[2, 2, 5, 16, 16\], got \[2, 2, 5, 16\]\."),
        (
            KeptEnds,
            r"KeptEnds\.termination must return \[\.\.\.\] for latents .*, here \[2, 5, 16\], got \[2, 5, 16, 1\]\.",
        ),
        (KeptRewards, r"KeptRewards\.reward must return \[\.\.\.\] for latents .*, here \[240\], got \[240, 1\]\."),
        (
            OneHead,
            r"OneHead\.next must return \[F, \.\.\., L\] for latents .*, here \[2, 5, 16, 2\], got \[1, 5, 16, 2\]\.",
        ),
    ],
)
def test_a_wrong_shape_is_named_with_its_method(world, text):
    model = world(num_dynamics=2)
    planner = EnsembleMPPIPlanner(
        LatentEnv(model), horizon=2, num_samples=16, num_elites=4, num_proposals=0, warm_start=False
    )
    with pytest.raises(ValueError, match=text):
        planner.plan(torch.zeros(5, model.observation_dim))


def test_returns_of_a_model_scored_in_half_precision_are_summed_in_full():
    class Rich(LineWorld):
        """Answers in bfloat16, and pays 100.5 for every step, of which three are no number of bfloat16."""

        def reward(self, latent: Tensor, action: Tensor) -> Tensor:
            return torch.full_like(super().reward(latent, action), 100.5, dtype=torch.bfloat16)

        def values(self, latent: Tensor) -> Tensor:
            return torch.zeros_like(super().values(latent), dtype=torch.bfloat16)

    options = {"num_proposals": 0, "warm_start": False, "scoring_dtype": "bfloat16", "discount": 1.0}
    planner = EnsembleMPPIPlanner(LatentEnv(Rich()), horizon=3, **options)
    plan = planner.plan(torch.zeros(4, planner.world_model.observation_dim), trace=True)
    assert plan.value.dtype == torch.float32
    assert plan.trace is not None
    returns = plan.trace.returns
    assert returns.dtype == torch.float32
    assert torch.equal(returns, torch.tensor([100.5, 201.0, 301.5]).view(3, 1, 1).expand_as(returns))
