from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize

from torchrl_etdmpc.functional import adaptive_mixture, ensemble_mean, ensemble_std, ensemble_variance
from torchrl_etdmpc.functional.horizon import SIGMA_FLOOR


def normal(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def uniform(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def attained(weights: torch.Tensor, mean: torch.Tensor, std: torch.Tensor, beta: float) -> torch.Tensor:
    """The lower confidence bound of a mixture, in float64."""
    weights, mean, std = weights.double(), mean.double(), std.double().clamp_min(SIGMA_FLOOR)
    offset = mean.max(-1, keepdim=True).values  # weights sum to one: keeps a large offset out of the rounding
    bound = (weights * (mean - offset)).sum(-1) - beta * (weights * std).square().sum(-1).sqrt()
    return bound + offset.squeeze(-1)


def best_by_slsqp(mean: torch.Tensor, std: torch.Tensor, beta: float) -> float:
    """The best lower confidence bound that a generic constrained optimiser finds from two starts."""
    q, sigma = mean.numpy(), std.numpy()
    horizon = len(q)
    scale = max(np.ptp(q), beta * sigma.max())  # the optimiser's tolerances are absolute

    def negative_bound(w):
        spread = np.sqrt(np.sum((w * sigma) ** 2))
        return -(w @ (q - q[0]) - beta * spread) / scale, -((q - q[0]) - beta * w * sigma**2 / spread) / scale

    best_depth = np.eye(horizon)[np.argmax(q - beta * sigma)]
    starts = [np.full(horizon, 1 / horizon), 0.9 * best_depth + 0.1 / horizon]
    best = -math.inf
    for start in starts:
        result = minimize(
            negative_bound,
            start,
            jac=True,
            method="SLSQP",
            bounds=[(0, 1)] * horizon,
            constraints={"type": "eq", "fun": lambda w: w.sum() - 1, "jac": np.ones_like},
            options={"ftol": 1e-12, "maxiter": 200},
        )
        weights = np.clip(result.x, 0, None)
        best = max(best, -negative_bound(weights / weights.sum())[0])
    return best * scale + q[0]


def tables(horizon: int) -> dict[str, tuple[torch.Tensor, torch.Tensor]]:
    """Name -> (mean, std), each of shape [3, H]."""
    mean, std = 3 * normal(3, horizon, seed=horizon), 0.02 + uniform(3, horizon, seed=horizon + 100)
    dominating = mean.clone()
    dominating[:, horizon // 2] += 100
    certain = std.clone()
    certain[:, horizon // 2] *= 1e-3
    return {
        "random": (mean, std),
        "close": (0.1 * mean, std),
        "rounded, with ties": (mean.round(), std),
        "all tied": (torch.full_like(mean, -2.0), std),
        "equal sigmas": (mean, torch.full_like(std, 0.7)),
        "one dominating depth": (dominating, std),
        "one nearly certain depth": (mean, certain),
        "uncertainty grows with depth": (mean, std[:, :1] * 3.0 ** torch.arange(horizon)),
    }


@pytest.mark.parametrize(("heads", "values"), [(2, 1), (1, 2), (4, 2), (3, 5)])
def test_ensemble_mean_and_variance_are_those_of_all_pairs_of_heads(heads, values):
    returns = normal(5, 3, heads, values)
    members = returns.flatten(-2)
    torch.testing.assert_close(ensemble_mean(returns), members.mean(-1))
    variance = members.var(-1, correction=1) / (heads * values)  # of the mean (thesis Eq. 3.3)
    torch.testing.assert_close(ensemble_variance(returns), variance)


def test_ensemble_variance_of_one_member_or_of_agreeing_members_is_zero():
    single = ensemble_variance(normal(5, 3, 1, 1))
    assert single.shape == (5, 3)
    assert single.count_nonzero() == 0
    assert ensemble_variance(torch.full((5, 3, 4, 2), 7.0)).count_nonzero() == 0


def test_where_members_agree_the_gradient_of_the_std_is_zero_and_elsewhere_that_of_the_root():
    returns = normal(3, 4, 2)
    returns[1] = 7.0
    leaf, other = returns.clone().requires_grad_(), returns[[0, 2]].clone().requires_grad_()
    ensemble_std(leaf).sum().backward()
    ensemble_variance(other).sqrt().sum().backward()
    assert leaf.grad[1].count_nonzero() == 0
    torch.testing.assert_close(leaf.grad[[0, 2]], other.grad)


def test_ensemble_variance_shifts_and_scales_as_a_variance_and_survives_a_large_offset():
    returns = normal(6, 4, 2)
    variance = ensemble_variance(returns)
    torch.testing.assert_close(ensemble_variance(3 * returns + 5), 9 * variance)
    torch.testing.assert_close(ensemble_variance((returns + 1e4).float()).double(), variance, rtol=1e-2, atol=0)


@pytest.mark.parametrize("horizon", range(1, 9))
def test_the_adaptive_mixture_attains_what_a_generic_constrained_optimiser_finds(horizon):
    for beta in (0.01, 0.3, 1.0, 10.0, 100.0):
        for name, (mean, std) in tables(horizon).items():
            value, weights = adaptive_mixture(mean, std, beta)
            torch.testing.assert_close(attained(weights, mean, std, beta), value, rtol=1e-9, atol=1e-9, msg=name)
            for found, q, sigma in zip(value.tolist(), mean, std, strict=True):
                reference = best_by_slsqp(q, sigma, beta)
                assert found == pytest.approx(reference, rel=1e-4, abs=1e-5), (name, beta)
                assert found >= reference - 1e-9 * max(1, abs(reference)), (name, beta)


@settings(deadline=None, max_examples=60)
@given(
    st.lists(st.tuples(st.floats(-50, 50), st.floats(1e-3, 20)), min_size=1, max_size=8),
    st.floats(0.01, 100),
)
def test_the_adaptive_mixture_satisfies_the_optimality_conditions(depths, beta):
    mean, std = torch.tensor(depths, dtype=torch.float64).unbind(-1)
    value, weights = adaptive_mixture(mean, std, beta)
    torch.testing.assert_close(weights.sum().item(), 1.0)
    assert (weights >= 0).all()
    torch.testing.assert_close(attained(weights, mean, std, beta), value, rtol=1e-7, atol=1e-7)
    # The problem is concave: no direction of the simplex ascends at the optimum, w.grad = value.
    gradient = mean - beta * std.square() * weights / (weights * std).square().sum().sqrt()
    assert gradient.max() <= value + 1e-6 * (1 + beta * std.max())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("beta", [0.01, 1.0, 100.0])
def test_the_weights_lie_in_the_simplex_and_attain_the_value(dtype, beta):
    mean, std = (4 * normal(500, 6)).to(dtype), uniform(500, 6, seed=1).to(dtype)
    value, weights = adaptive_mixture(mean, std, beta)
    assert value.dtype == weights.dtype == dtype
    assert (weights >= 0).all()
    tolerance = 1e-5 if dtype == torch.float32 else 1e-12
    torch.testing.assert_close(weights.sum(-1), torch.ones(500, dtype=dtype), rtol=0, atol=tolerance)
    torch.testing.assert_close(attained(weights, mean, std, beta), value.double(), rtol=tolerance, atol=tolerance)


def test_equally_good_depths_are_weighted_by_their_inverse_variance():
    std = torch.tensor([1.0, 2.0, 4.0], dtype=torch.float64)
    value, weights = adaptive_mixture(torch.full((3,), 5.0, dtype=torch.float64), std, 2.0)
    torch.testing.assert_close(weights, torch.tensor([16, 4, 1], dtype=torch.float64) / 21)
    torch.testing.assert_close(value.item(), 5 - 2 * (16 / 21) ** 0.5)  # 5 - beta / sqrt(1 + 1/4 + 1/16)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("beta", [0.0, 1e-30, 1e-6])
def test_with_a_vanishing_beta_the_value_is_that_of_the_best_depth(beta, dtype):
    mean, std = normal(100, 6).to(dtype), uniform(100, 6, seed=1).to(dtype) + 0.1
    value, weights = adaptive_mixture(mean, std, beta)
    torch.testing.assert_close(value, mean.max(-1).values, rtol=0, atol=1e-5)
    assert torch.equal(weights.argmax(-1), mean.argmax(-1))
    torch.testing.assert_close(weights.max(-1).values, torch.ones(100, dtype=dtype))


def test_with_beta_zero_the_value_is_exactly_the_best_and_the_weight_one_hot():
    mean = torch.tensor([[1.0, 3.0, 2.0], [4.0, 4.0, 4.0]])
    value, weights = adaptive_mixture(mean, torch.ones(2, 3), 0.0)
    assert value.tolist() == [3.0, 4.0]
    assert weights[0].tolist() == [0.0, 1.0, 0.0]
    assert (weights[1].sum(), weights[1].max()) == (1, 1)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_without_uncertainty_the_value_is_that_of_the_best_depth(dtype):
    mean = 10 * normal(100, 6).to(dtype)
    value, weights = adaptive_mixture(mean, torch.zeros_like(mean), 10.0)
    torch.testing.assert_close(value, mean.max(-1).values, rtol=0, atol=11 * SIGMA_FLOOR)
    assert torch.equal(weights.argmax(-1), mean.argmax(-1))


def test_a_growing_beta_never_raises_the_value_and_ends_at_the_smallest_variance():
    mean, std = normal(6), 0.1 + uniform(6)
    values = torch.stack([adaptive_mixture(mean, std, beta)[0] for beta in (0, 0.01, 0.1, 1, 10, 100, 1000)])
    assert (values.diff() < 0).all()
    _, weights = adaptive_mixture(mean, std, 1e7)
    precision = std.square().reciprocal()
    torch.testing.assert_close(weights, precision / precision.sum(), rtol=1e-4, atol=0)


@pytest.mark.parametrize("offset", [1e4, -1e4])
@pytest.mark.parametrize("beta", [0.1, 1.0, 10.0])
def test_a_large_common_offset_costs_no_accuracy_in_float32(offset, beta):
    # Multiples of 1/64 are exact next to 1e4, so the only error can be the solver's own.
    gaps, std = (64 * normal(500, 6)).round() / 64, 0.01 + uniform(500, 6, seed=1)
    expected, expected_weights = adaptive_mixture(gaps, std, beta)
    value, weights = adaptive_mixture((gaps + offset).float(), std.float(), beta)
    assert value.dtype == torch.float32
    torch.testing.assert_close(value.double() - offset, expected, rtol=0, atol=1e-3)  # float32's step at 1e4
    torch.testing.assert_close(weights.double(), expected_weights, rtol=0, atol=2e-4)


@pytest.mark.parametrize(
    ("shift", "scale", "beta"), [(7.0, 1.0, 2.0), (0.0, 0.01, 2.0), (0.0, 100.0, 2.0), (0.0, 1.0, 0.5), (7.0, 3.0, 8.0)]
)
def test_the_value_follows_the_units_of_returns_and_only_beta_times_std_matters(shift, scale, beta):
    mean, std = normal(50, 6), 0.1 + uniform(50, 6)
    value, weights = adaptive_mixture(mean, std, 2.0)
    other_value, other_weights = adaptive_mixture(scale * mean + shift, scale * std * 2.0 / beta, beta)
    torch.testing.assert_close(other_value, scale * value + shift)
    torch.testing.assert_close(other_weights, weights)


def test_permuting_the_depths_permutes_the_weights_and_keeps_the_value():
    mean, std = normal(50, 6), 0.1 + uniform(50, 6)
    mean[:, 3] = mean[:, 1]  # a tie
    permutation = torch.tensor([3, 0, 5, 1, 2, 4])
    value, weights = adaptive_mixture(mean, std, 2.0)
    permuted_value, permuted_weights = adaptive_mixture(mean[:, permutation], std[:, permutation], 2.0)
    torch.testing.assert_close(permuted_value, value)
    torch.testing.assert_close(permuted_weights, weights[:, permutation])


def test_any_leading_batch_gives_the_result_of_its_parts_and_inputs_are_left_alone():
    mean, std = normal(3, 5, 6), uniform(3, 5, 6)
    before = mean.clone(), std.clone()
    value, weights = adaptive_mixture(mean, std, 1.0)
    assert (value.shape, weights.shape) == ((3, 5), (3, 5, 6))
    for i in range(3):
        for j in range(5):
            single_value, single_weights = adaptive_mixture(mean[i, j], std[i, j], 1.0)
            torch.testing.assert_close(single_value, value[i, j])
            torch.testing.assert_close(single_weights, weights[i, j])
    assert torch.equal(mean, before[0])
    assert torch.equal(std, before[1])


def test_the_weights_are_the_derivative_of_the_value_by_the_depths_means():
    # The envelope theorem: at the optimum, a change of the weights is of second order.
    mean, std = normal(6).requires_grad_(), 0.3 + uniform(6)
    value, weights = adaptive_mixture(mean, std, 1.0)
    value.backward()
    torch.testing.assert_close(mean.grad, weights.detach())


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_non_finite_depth_never_gives_a_finite_value_to_rank_by_nor_reaches_other_candidates(bad):
    mean, std = normal(2, 6), 0.1 + uniform(2, 6)
    expected, _ = adaptive_mixture(mean, std, 1.0)
    mean[0, 2] = bad
    value, _ = adaptive_mixture(mean, std, 1.0)
    assert not value[0].isfinite()
    torch.testing.assert_close(value[1], expected[1])


def test_a_negative_beta_is_refused_with_the_remedy():
    with pytest.raises(ValueError) as error:
        adaptive_mixture(torch.zeros(3), torch.ones(3), -0.5)
    assert str(error.value) == (
        "adaptive_mixture needs a finite beta >= 0, got -0.5; use the final or mean score for optimism."
    )


@pytest.mark.parametrize("beta", [math.nan, math.inf])
def test_a_beta_that_is_not_finite_is_refused(beta):
    with pytest.raises(ValueError, match="needs a finite beta"):
        adaptive_mixture(torch.zeros(3), torch.ones(3), beta)


def test_half_precision_gives_what_single_precision_does():
    mean, std = (100 * normal(20, 6)).half(), torch.cat([torch.zeros(10, 6), uniform(10, 6)]).half()
    value, weights = adaptive_mixture(mean, std, 1.0)
    assert value.dtype == weights.dtype == torch.float16
    for got, expected in zip((value, weights), adaptive_mixture(mean.float(), std.float(), 1.0), strict=True):
        torch.testing.assert_close(got, expected.half())


def test_a_depth_that_is_beta_deviations_ahead_of_a_certain_one_is_worth_as_much():
    # Where the two are all but equal, the discriminant of the quadratic is zero, which rounding may take below it.
    std, beta = torch.linspace(0.1, 3, 10_000), 10.0
    mean = torch.stack([torch.zeros_like(std), beta * std], -1)
    value, weights = adaptive_mixture(mean, torch.stack([torch.full_like(std, 1e-4), std], -1), beta)
    torch.testing.assert_close(value, torch.zeros_like(std), atol=1e-3, rtol=0)
    torch.testing.assert_close(weights.sum(-1), torch.ones_like(std))


@pytest.mark.parametrize("certain", [0, 1])
def test_what_is_left_of_a_depth_that_is_all_but_given_up_counts_in_float32(certain):
    # w mean - beta sqrt(s^2 + w^2 r^2), w and r of the uncertain depth, s the floor, is at most -beta s sqrt(3/4).
    mean, std = torch.full((2,), 1000.0), torch.full((2,), 200.0)
    mean[certain] = std[certain] = 0.0
    value, weights = adaptive_mixture(mean, std, 10.0)
    assert value.item() == pytest.approx(-10 * SIGMA_FLOOR * math.sqrt(1 - 0.5**2), rel=1e-3)
    assert 0 < weights[1 - certain].item() < 1e-3
    torch.testing.assert_close(value.double(), attained(weights, mean, std, 10.0), rtol=0, atol=1e-4)
