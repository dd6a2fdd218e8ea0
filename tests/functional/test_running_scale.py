from __future__ import annotations

import numpy as np
import pytest
import torch

from torchrl_etdmpc.functional import updated_scale


def spread_of(batch: torch.Tensor) -> float:
    low, high = np.percentile(batch.numpy(), [5, 95])
    return high - low


@pytest.mark.parametrize("size", [2, 7, 256, 1000])
def test_with_rate_one_the_scale_is_the_spread_between_the_5th_and_the_95th_percentile(size):
    batch = 10 * torch.randn(size, generator=torch.Generator().manual_seed(size), dtype=torch.float64)
    scale = updated_scale(torch.tensor(3.0, dtype=torch.float64), batch, tau=1.0)
    assert scale.item() == pytest.approx(max(spread_of(batch), 1.0), rel=1e-12)


def test_the_scale_is_an_exponential_moving_average():
    batch = torch.linspace(0, 100, 101, dtype=torch.float64)  # spread 90
    scale = torch.tensor(2.0, dtype=torch.float64)
    expected = 2.0
    for _ in range(5):
        scale = updated_scale(scale, batch, tau=0.1)
        expected = 0.9 * expected + 0.1 * 90
        assert scale.item() == pytest.approx(expected, rel=1e-12)


def test_a_batch_of_little_spread_counts_as_a_spread_of_one():
    scale = torch.tensor(1.0, dtype=torch.float64)
    expected = 1.0
    for spread in (0.2, 2.2) * 50:
        scale = updated_scale(scale, torch.linspace(0, spread / 0.9, 101, dtype=torch.float64), tau=0.1)
        expected = 0.9 * expected + 0.1 * max(spread, 1.0)
        assert scale.item() == pytest.approx(expected, rel=1e-12)
    assert scale > 1.5  # its average; 1.2 is that of the spreads themselves


def test_the_scale_depends_on_neither_the_batchs_offset_nor_its_shape_nor_its_order():
    batch = torch.linspace(0, 100, 120, dtype=torch.float64)
    scale = torch.tensor(5.0, dtype=torch.float64)
    expected = updated_scale(scale, batch, 0.3)
    torch.testing.assert_close(updated_scale(scale, batch + 1e4, 0.3), expected)
    assert torch.equal(updated_scale(scale, batch.flip(0).view(2, 3, 20), 0.3), expected)


def test_no_gradient_passes_and_the_old_scale_is_left_alone():
    old = torch.tensor(5.0)
    batch = torch.linspace(0, 100, 101, requires_grad=True)
    new = updated_scale(old, batch, 0.5)
    assert not new.requires_grad
    assert old == 5
    assert new != 5
    assert new.shape == ()


def test_the_scale_keeps_its_own_dtype():
    assert updated_scale(torch.tensor(1.0), torch.linspace(0, 9, 10, dtype=torch.float64), 0.5).dtype == torch.float32


@pytest.mark.parametrize("junk", [0.0, 1e9, float("nan"), float("inf")])
def test_what_does_not_count_has_no_influence(junk):
    batch = 10 * torch.randn(30, dtype=torch.float64)
    counts = torch.arange(30) % 3 > 0
    expected = updated_scale(torch.tensor(2.0, dtype=torch.float64), batch[counts], 0.5)
    padded = torch.where(counts, batch, junk)
    torch.testing.assert_close(updated_scale(torch.tensor(2.0, dtype=torch.float64), padded, 0.5, counts), expected)


def test_a_batch_in_which_nothing_counts_leaves_the_scale_where_it_is():
    nothing = torch.zeros(9, dtype=torch.bool)
    assert updated_scale(torch.tensor(7.0), torch.linspace(0, 1000, 9), 0.5, nothing) == 7


@pytest.mark.parametrize("size", [9, 101])
@pytest.mark.parametrize("some", [False, True], ids=["all-count", "some-count"])
@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_value_that_counts_and_is_not_finite_leaves_the_scale_where_it_is(value, some, size):
    batch = torch.linspace(0, 1000, size)
    batch[3] = value
    counts = torch.arange(size) < size - 1 if some else None
    assert updated_scale(torch.tensor(7.0), batch, 0.5, counts) == 7


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_half_precision_has_a_scale_too(dtype):
    scale = updated_scale(torch.tensor(1.0, dtype=dtype), torch.linspace(0, 100, 101, dtype=dtype), tau=1.0)
    assert scale.dtype == dtype
    assert scale.item() == pytest.approx(90, abs=1)


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_the_ranks_of_half_precision_are_those_of_single_precision(dtype):
    scale, batch = torch.tensor(1.0), torch.linspace(0, 1000, 37, dtype=dtype)
    assert updated_scale(scale, batch, tau=1.0) == updated_scale(scale, batch.float(), tau=1.0)


def test_an_empty_batch_leaves_it_where_it_is():
    assert updated_scale(torch.tensor(3.0), torch.zeros(0), tau=0.5).item() == 3


@pytest.mark.parametrize("counts", [None, torch.tensor([False, True, False])])
def test_one_value_has_no_spread(counts):
    batch = torch.tensor([5.0]) if counts is None else torch.tensor([-90.0, 5.0, 90.0])
    assert updated_scale(torch.tensor(3.0), batch, 0.5, counts).item() == 2
