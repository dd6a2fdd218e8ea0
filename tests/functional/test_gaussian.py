from __future__ import annotations

import math

import pytest
import torch
from torch.distributions import Normal, kl_divergence

from torchrl_etdmpc.functional import (
    bounded_log_std,
    clipped_sample,
    gaussian_entropy,
    gaussian_kl,
    tanh_log_slope,
)

MEAN_P = torch.tensor([0.0, 0.5, -0.9, 0.3], dtype=torch.float64)
STD_P = torch.tensor([0.05, 1.0, 0.4, 2.0], dtype=torch.float64)
MEAN_Q = torch.tensor([0.2, 0.5, 0.9, -0.3], dtype=torch.float64)
STD_Q = torch.tensor([2.0, 0.3, 0.1, 2.7], dtype=torch.float64)


def test_kl_equals_torchs_in_both_directions_and_they_differ():
    p, q = Normal(MEAN_P, STD_P), Normal(MEAN_Q, STD_Q)
    forward = gaussian_kl(MEAN_P, STD_P, MEAN_Q, STD_Q)
    backward = gaussian_kl(MEAN_Q, STD_Q, MEAN_P, STD_P)
    torch.testing.assert_close(forward, kl_divergence(p, q))
    torch.testing.assert_close(backward, kl_divergence(q, p))
    assert ((forward - backward).abs() > 1e-3).all()


def test_kl_forgives_a_narrow_first_argument_and_punishes_a_wide_one():
    narrow, wide, zero = torch.tensor(0.05), torch.tensor(1.0), torch.tensor(0.0)
    assert gaussian_kl(zero, narrow, zero, wide) < 3
    assert gaussian_kl(zero, wide, zero, narrow) > 100


def test_entropy_equals_torchs():
    torch.testing.assert_close(gaussian_entropy(STD_P.log()), Normal(MEAN_P, STD_P).entropy())


def test_a_sample_without_noise_is_the_mean_and_noise_is_scaled_by_the_std():
    assert torch.equal(clipped_sample(MEAN_P, STD_P, torch.zeros(4, dtype=torch.float64)), MEAN_P)
    sample = clipped_sample(torch.tensor([0.1, -0.2]), torch.tensor([0.5, 2.0]), torch.tensor([1.0, 0.25]))
    torch.testing.assert_close(sample, torch.tensor([0.6, 0.3]))


def test_a_sample_is_clipped_at_both_ends():
    sample = clipped_sample(torch.tensor([0.5, -0.5]), torch.ones(2), torch.tensor([9.0, -9.0]))
    assert sample.tolist() == [1.0, -1.0]


def test_a_sample_passes_the_reparametrised_gradient_and_none_where_it_is_clipped():
    mean = torch.tensor([0.1, 0.1], requires_grad=True)
    std = torch.tensor([0.5, 0.5], requires_grad=True)
    clipped_sample(mean, std, torch.tensor([1.2, 4.0])).sum().backward()
    torch.testing.assert_close(mean.grad, torch.tensor([1.0, 0.0]))
    torch.testing.assert_close(std.grad, torch.tensor([1.2, 0.0]))


@pytest.mark.parametrize(("low", "high"), [(-3.0, 1.0), (0.5, 0.6)])
def test_log_std_is_the_formula_of_the_thesis_and_never_leaves_its_bounds(low, high):
    raw = [-1e30, -20.0, -1.0, 0.0, 0.7, 20.0, 1e30]
    log_std = bounded_log_std(torch.tensor(raw, dtype=torch.float64), low, high)
    expected = [low + (high - low) / 2 * (math.tanh(x) + 1) for x in raw]
    assert log_std.tolist() == pytest.approx(expected, abs=1e-12)
    assert (log_std.min(), log_std.max()) == pytest.approx((low, high), abs=1e-12)


def test_the_log_slope_of_the_tanh_is_its_derivative_and_finite_where_it_is_saturated():
    x = torch.linspace(-5, 5, 11, dtype=torch.float64)
    torch.testing.assert_close(tanh_log_slope(x), (1 - x.tanh().square()).log())
    far = torch.tensor([-1e3, 1e3], requires_grad=True)
    slopes = tanh_log_slope(far)
    slopes.sum().backward()
    assert slopes.isfinite().all()
    torch.testing.assert_close(far.grad, torch.tensor([2.0, -2.0]))
