from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torchrl.objectives import two_hot_encode as torchrl_two_hot_encode

from torchrl_etdmpc.functional import symexp, symlog, two_hot_cross_entropy, two_hot_decode, two_hot_encode

BINS = torch.linspace(-10, 10, 101)
BINS64 = torch.linspace(-10, 10, 101, dtype=torch.float64)
SCALARS = torch.cat([torch.linspace(-2e4, 2e4, 801), torch.linspace(-3, 3, 601), torch.logspace(-6, 4, 50)])


def position_of(x: float) -> float:
    """The fractional index of a scalar among the bins, from the definition."""
    return (math.copysign(math.log1p(abs(x)), x) + 10) / 0.2


@settings(deadline=None, max_examples=50)
@given(st.floats(-1e5, 1e5, width=32))
def test_symexp_inverts_symlog(x):
    x = torch.tensor(x, dtype=torch.float64)
    torch.testing.assert_close(symexp(symlog(x)), x, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("function", [symlog, symexp])
def test_symlog_and_symexp_are_odd_and_keep_the_sign(function):
    x = torch.linspace(-9, 9, 181)
    assert torch.equal(function(-x), -function(x))
    assert torch.equal(function(x).sign(), x.sign())


def test_symlog_is_the_identity_near_zero_and_a_logarithm_far_from_it():
    small, large = torch.tensor(1e-5, dtype=torch.float64), torch.tensor(1e9, dtype=torch.float64)
    torch.testing.assert_close(symlog(small), small, rtol=1e-5, atol=0)
    torch.testing.assert_close(symlog(large), large.log(), rtol=1e-9, atol=0)


def test_two_hot_weights_sum_to_one_and_lie_between_zero_and_one():
    weights = two_hot_encode(SCALARS, BINS)
    assert weights.shape == (*SCALARS.shape, 101)
    torch.testing.assert_close(weights.sum(-1), torch.ones_like(SCALARS), rtol=0, atol=2e-5)
    assert weights.min() >= 0
    assert weights.max() <= 1


@pytest.mark.parametrize("x", [1e5, 1e30, math.inf, math.expm1(10) * 1.0001])
def test_a_value_beyond_an_end_puts_all_its_mass_in_that_end_and_none_in_the_other(x):
    above, below = two_hot_encode(torch.tensor([x, -x]), BINS)
    assert above[-1] == 1
    assert above[:-1].count_nonzero() == 0
    assert below[0] == 1
    assert below[1:].count_nonzero() == 0


def test_decoding_an_encoded_value_returns_it_over_the_whole_range():
    decoded = two_hot_decode(two_hot_encode(SCALARS, BINS).log(), BINS)
    torch.testing.assert_close(decoded, SCALARS, rtol=5e-5, atol=1e-5)
    x = SCALARS.double()
    torch.testing.assert_close(two_hot_decode(two_hot_encode(x, BINS64).log(), BINS64), x, rtol=1e-11, atol=1e-11)


def test_decoding_averages_in_symlog_space_and_not_over_the_scalars():
    logits = torch.full((101,), -torch.inf)
    logits[[50, 80]] = 0.0  # symlog 0 and 6
    torch.testing.assert_close(two_hot_decode(logits, BINS).item(), math.expm1(3), rtol=1e-5, atol=0)


def test_decoding_ignores_a_constant_added_to_the_logits():
    logits = torch.randn(5, 101, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    torch.testing.assert_close(two_hot_decode(logits + 1000, BINS64), two_hot_decode(logits, BINS64))


@pytest.mark.parametrize(("low", "high", "num_bins"), [(-10, 10, 101), (-20, 20, 255), (-1, 3, 5), (0, 1, 2)])
def test_two_hot_equals_torchrls_in_symlog_space(low, high, num_bins):
    bins = torch.linspace(low, high, num_bins, dtype=torch.float64)
    x = SCALARS.double()
    torch.testing.assert_close(two_hot_encode(x, bins), torchrl_two_hot_encode(symlog(x), bins), rtol=0, atol=1e-10)


@settings(deadline=None, max_examples=30)
@given(st.floats(-2e4, 2e4, width=32))
def test_two_hot_has_the_scalar_as_its_mean_in_symlog_space(x):
    weights = two_hot_encode(torch.tensor(x, dtype=torch.float64), BINS64)
    mean_index = (weights * torch.arange(101)).sum().item()
    assert mean_index == pytest.approx(position_of(x), abs=1e-9)


def test_a_nan_stays_nan_and_does_not_reach_its_neighbours():
    weights = two_hot_encode(torch.tensor([1.0, math.nan]), BINS)
    assert weights[1].isnan().all()
    assert torch.equal(weights[0], two_hot_encode(torch.tensor(1.0), BINS))
    losses = two_hot_cross_entropy(torch.zeros(2, 101), torch.tensor([1.0, math.nan]), BINS)
    assert losses.isfinite().tolist() == [True, False]


def test_cross_entropy_is_minimal_at_the_targets_own_distribution():
    target = torch.tensor(2.7, dtype=torch.float64)
    own = two_hot_encode(target, BINS64)
    least = two_hot_cross_entropy(own.clamp_min(1e-30).log(), target, BINS64)
    torch.testing.assert_close(least, -torch.special.xlogy(own, own).sum())
    generator = torch.Generator().manual_seed(0)
    others = own.clamp_min(1e-30).log() + torch.randn(100, 101, generator=generator, dtype=torch.float64)
    assert (two_hot_cross_entropy(others, target, BINS64) > least).all()


def test_the_gradient_of_the_cross_entropy_is_softmax_minus_target():
    logits = torch.randn(4, 101, generator=torch.Generator().manual_seed(1), dtype=torch.float64, requires_grad=True)
    target = torch.tensor([-300.0, 0.0, 0.35, 1e9], dtype=torch.float64)
    two_hot_cross_entropy(logits, target, BINS64).sum().backward()
    torch.testing.assert_close(logits.grad, logits.detach().softmax(-1) - two_hot_encode(target, BINS64))


def test_cross_entropy_broadcasts_one_target_over_heads():
    logits = torch.randn(2, 3, 101, generator=torch.Generator().manual_seed(2))
    target = torch.tensor([-1.0, 0.5, 40.0])
    loss = two_hot_cross_entropy(logits, target, BINS)
    assert loss.shape == (2, 3)
    torch.testing.assert_close(loss[1, 2], two_hot_cross_entropy(logits[1, 2], target[2], BINS))


def test_under_autocast_a_value_is_still_the_fixed_point_of_its_own_targets():
    # A critic that fits each target as far as its logits can: rewards of 1 for ever, discounted by 0.99.
    values = []
    for autocast in (False, True):
        value = torch.tensor(0.0)
        with torch.autocast("cpu", torch.bfloat16, enabled=autocast):
            for _ in range(1_500):
                logits = two_hot_encode(1 + 0.99 * value, BINS).float().clamp_min(1e-30).log()
                value = two_hot_decode(logits, BINS)
            assert value.dtype == torch.float32
        values.append(value.item())
    assert values == pytest.approx([100, 100], abs=0.1)
    with torch.autocast("cpu", torch.bfloat16):
        decoded = two_hot_decode(logits.bfloat16(), BINS)
    torch.testing.assert_close(decoded, two_hot_decode(logits.bfloat16().float(), BINS))


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_scalars_in_half_precision_are_placed_as_exactly_as_they_are_given(dtype):
    x = torch.tensor([0.03, 3.0, 50.0, 700.0]).to(dtype)
    torch.testing.assert_close(two_hot_encode(x, BINS), two_hot_encode(x.float(), BINS), rtol=0, atol=0)


def test_autocast_leaves_the_cross_entropy_of_half_precision_logits_in_single_precision():
    logits = torch.randn(5, 101, generator=torch.Generator().manual_seed(3)).bfloat16()
    target = torch.linspace(-3, 3, 5)
    with torch.autocast("cpu", torch.bfloat16):
        error = two_hot_cross_entropy(logits, target, BINS)
    torch.testing.assert_close(error, two_hot_cross_entropy(logits.float(), target, BINS), rtol=0, atol=0)


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_bins_in_half_precision_mean_what_they_mean_in_single(dtype):
    bins, x = torch.linspace(-10, 10, 21), torch.tensor([0.0, 1.0, 7.0, 100.0])
    weights = two_hot_encode(x, bins.to(dtype))
    torch.testing.assert_close(weights, two_hot_encode(x, bins), rtol=0, atol=1e-6)
    rounded = two_hot_encode(x.to(dtype), bins.to(dtype))  # these four are numbers of half precision too
    torch.testing.assert_close(rounded, weights, rtol=0, atol=1e-6)


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_logits_and_bins_in_half_precision_are_decoded_as_exactly_as_the_result_is_rounded(dtype):
    logits = two_hot_encode(torch.linspace(300, 500, 201), BINS).clamp_min(1e-9).log().to(dtype)
    exact = two_hot_decode(logits.double(), BINS.double())
    decoded = two_hot_decode(logits, BINS.to(dtype))
    assert decoded.dtype == dtype
    torch.testing.assert_close(decoded.double(), exact, rtol=0.51 * torch.finfo(dtype).eps + 1e-5, atol=0)
