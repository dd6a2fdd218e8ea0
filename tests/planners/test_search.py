"""The iterations of MPPI alone: no model, no environment."""

from __future__ import annotations

import torch
from torch import Tensor

from torchrl_etdmpc.functional import Gaussian
from torchrl_etdmpc.planners.search import chosen_sequence, search

BUDGET = {"num_elites": 16, "inverse_temperature": 0.5, "std_min": 0.05, "std_max": 2.0, "trace": True}


def test_a_search_goes_where_scores_are_high_whatever_gives_them():
    def evaluate(actions: Tensor, iteration: int) -> tuple[Tensor, Tensor]:
        asked.append(actions.shape[1])
        scores = -10 * (actions - 0.3).square().sum((-2, -1))
        return scores, scores[..., None, None, None]

    torch.manual_seed(0)
    wide, asked = Gaussian(torch.zeros(2, 3, 1), torch.full((2, 3, 1), 2.0)), []
    proposals, noise = torch.zeros(2, 4, 3, 1), torch.randn(2, 6, 252, 3, 1)
    found = search(wide, proposals, noise, evaluate, iterations=6, **BUDGET)
    assert asked == [256, *[252] * 5]  # the proposals once
    assert {step.scores.shape[1] for step in found.steps} == {256}
    assert not found.fallback.any()
    for choice in ("elite", "mean", "best"):
        action, _ = chosen_sequence(found, choice, torch.rand(2, 16))
        torch.testing.assert_close(action, torch.full((2, 1), 0.3), atol=0.15, rtol=0)


def test_the_last_iteration_alone_decides_on_the_fallback_and_what_was_fitted_before_it_stays():
    def evaluate(actions: Tensor, iteration: int) -> tuple[Tensor, Tensor]:
        scores = -(actions - 0.3).square().sum((-2, -1))
        scores[iteration] = torch.nan  # of the first state at first, of the second one at last
        return scores, scores[..., None, None, None]

    torch.manual_seed(0)
    wide = Gaussian(torch.zeros(2, 3, 1), torch.full((2, 3, 1), 2.0))
    found = search(wide, torch.zeros(2, 0, 3, 1), torch.randn(2, 2, 64, 3, 1), evaluate, iterations=2, **BUDGET)
    assert found.fallback.tolist() == [False, True]
    for now, first, before in zip(found.gaussian, found.steps[0][3:], wide, strict=True):
        assert torch.equal(first[0], before[0]) and (now[0] != before[0]).all()
        assert torch.equal(now[1], first[1]) and (first[1] != before[1]).all()
