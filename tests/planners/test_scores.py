from __future__ import annotations

import dataclasses
import math
from statistics import fmean

import pytest
import torch

from torchrl_etdmpc.planners import AdaptiveScore, FinalScore, MeanScore, make_score


def penalised(estimates: list[float], beta: float) -> float:
    """``mean - beta * sigma`` with the variance of the mean, written out (thesis Eq. 3.2 and 3.3)."""
    mean, members = fmean(estimates), len(estimates)
    variance = sum((q - mean) ** 2 for q in estimates) / (members * (members - 1)) if members > 1 else 0.0
    return mean - beta * math.sqrt(variance)


def table(*leading: int, depths: int = 3, dynamics: int = 4, values: int = 2) -> torch.Tensor:
    return torch.randn(*leading, depths, dynamics, values, dtype=torch.float64)


@pytest.mark.parametrize("beta", [0.0, 1.5, -1.0])
def test_final_is_the_penalised_mean_at_the_last_depth(beta):
    returns = table(5)
    expected = [penalised(row[-1].flatten().tolist(), beta) for row in returns]
    assert FinalScore(beta)(returns).tolist() == pytest.approx(expected)


@pytest.mark.parametrize("beta", [0.0, 1.5, -1.0])
def test_mean_averages_over_depths_before_it_measures_disagreement(beta):
    returns = table(5)
    expected = [penalised([fmean(row[:, i, j].tolist()) for i in range(4) for j in range(2)], beta) for row in returns]
    assert MeanScore(beta)(returns).tolist() == pytest.approx(expected)


def test_adaptive_without_penalty_is_the_best_depth():
    returns = table(5)
    expected = [max(fmean(depth.flatten().tolist()) for depth in row) for row in returns]
    assert AdaptiveScore(0.0)(returns).tolist() == pytest.approx(expected)


def test_adaptive_is_at_least_as_good_as_every_mixture_of_depths():
    returns, beta = table(20), 2.0
    mean = returns.mean((-2, -1))
    sigma = returns.flatten(-2).std(-1) / math.sqrt(8)
    mixtures = torch.distributions.Dirichlet(torch.full((3,), 0.5, dtype=torch.float64)).sample((2000,))
    mixtures = torch.cat([mixtures, torch.eye(3, dtype=torch.float64)])[:, None]
    bounds = (mixtures * mean).sum(-1) - beta * (mixtures * sigma).square().sum(-1).sqrt()
    score = AdaptiveScore(beta)(returns)
    assert (score >= bounds.amax(0) - 1e-9).all()
    assert (score <= bounds.amax(0) + 0.02).all()  # and the random mixtures come close to it


@pytest.mark.parametrize("beta", [0.0, 3.0])
@pytest.mark.parametrize("score", [MeanScore, AdaptiveScore])
def test_with_one_depth_every_score_is_final(score, beta):
    returns = table(6, depths=1)
    torch.testing.assert_close(score(beta)(returns), FinalScore(beta)(returns))


@pytest.mark.parametrize("score", [FinalScore, MeanScore])
def test_a_single_estimate_has_no_penalty(score):
    returns = table(6, dynamics=1, values=1)
    assert torch.equal(score(10.0)(returns), score(0.0)(returns))


@pytest.mark.parametrize("score", [FinalScore, MeanScore, AdaptiveScore])
def test_a_penalty_lowers_the_score_where_heads_disagree(score):
    returns = table(6)
    assert (score(2.0)(returns) < score(0.5)(returns)).all()
    agreed = returns[..., :1, :1].expand_as(returns)
    torch.testing.assert_close(score(2.0)(agreed), score(0.0)(agreed), atol=1e-5, rtol=0)


@pytest.mark.parametrize("score", [FinalScore, MeanScore])
def test_a_negative_penalty_is_optimism(score):
    returns = table(6)
    assert (score(-1.0)(returns) > score(0.0)(returns)).all()


@pytest.mark.parametrize("leading", [(), (7,), (2, 3)])
@pytest.mark.parametrize("score", [FinalScore(1.0), MeanScore(1.0), AdaptiveScore(1.0)])
def test_any_leading_batch_is_scored_row_by_row(score, leading):
    returns = table(*leading)
    scores = score(returns)
    assert scores.shape == leading
    rows = [score(row) for row in returns.reshape(-1, 3, 4, 2)]
    torch.testing.assert_close(scores.flatten(), torch.stack(rows))


@pytest.mark.parametrize("score", [FinalScore(1.0), MeanScore(1.0), AdaptiveScore(1.0)])
def test_a_non_finite_estimate_spoils_its_own_row_only(score):
    returns = table(3)
    spoilt = returns.clone()
    spoilt[1, -1, 0, 0] = torch.nan
    scores = score(spoilt)
    assert scores.isfinite().tolist() == [True, False, True]
    assert torch.equal(scores[[0, 2]], score(returns)[[0, 2]])


def test_only_final_does_without_the_other_depths():
    assert (FinalScore().depths, MeanScore().depths, AdaptiveScore().depths) == ("last", "all", "all")
    returns = table(4)
    assert torch.equal(FinalScore(1.0)(returns), FinalScore(1.0)(returns[..., -1:, :, :]))


def test_scores_are_made_by_name():
    assert make_score("final") == FinalScore(0.0)
    assert make_score("mean", 10) == MeanScore(10.0)
    assert make_score("adaptive", 0.5) == AdaptiveScore(0.5)


def test_a_callable_is_its_own_score():
    def own(returns):
        return returns[..., 0, 0, 0]

    returns = table(3)
    score = make_score(own)
    assert score.depths == "all"
    assert torch.equal(score(returns), own(returns))
    own.depths = "last"
    for score in (own, MeanScore(3.0)):
        assert make_score(score) is score


def test_a_score_with_weights_of_its_own_keeps_them_in_sight():
    weighted = torch.nn.Linear(2, 1)
    assert set(make_score(weighted).parameters()) == set(weighted.parameters())


def test_depths_that_no_planner_knows_are_refused():
    def own(returns):
        return returns[..., 0, 0, 0]

    own.depths = "first"
    with pytest.raises(ValueError, match=r"^depths of a score must be one of last, all, got 'first'\.$"):
        make_score(own)


def test_a_score_cannot_be_changed():
    with pytest.raises(dataclasses.FrozenInstanceError):
        FinalScore().beta = 1.0
