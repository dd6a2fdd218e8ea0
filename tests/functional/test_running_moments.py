from __future__ import annotations

import numpy as np
import pytest
import torch

from torchrl_etdmpc.functional import updated_moments


def test_at_the_rate_of_one_over_n_the_moments_are_those_of_all_batches_together():
    batches = torch.randn(20, 7, 3, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    batches = batches * torch.tensor([0.1, 1.0, 30.0, 1e-4]) + torch.tensor([5.0, 0.0, -100.0, 1e3])
    mean, variance = torch.zeros(4, dtype=torch.float64), torch.ones(4, dtype=torch.float64)
    for n, batch in enumerate(batches, start=1):
        mean, variance, _ = updated_moments(mean, variance, batch, 1 / n)
        seen = batches[:n].reshape(-1, 4).numpy()
        np.testing.assert_allclose(mean, seen.mean(0), rtol=1e-10)
        np.testing.assert_allclose(variance, seen.var(0), rtol=1e-9)


def test_with_rate_zero_nothing_moves_and_with_rate_one_the_batch_is_all():
    mean, variance, rows = torch.tensor([3.0]), torch.tensor([5.0]), torch.tensor([[0.0], [4.0]])
    assert [x.item() for x in updated_moments(mean, variance, rows, 0.0)] == [3, 5, True]
    assert [x.item() for x in updated_moments(mean, variance, rows, 1.0)] == [2, 4, True]


def test_a_small_spread_far_from_zero_is_kept_in_single_precision():
    generator = torch.Generator().manual_seed(1)
    mean, variance = torch.zeros(1), torch.ones(1)
    for n in range(1, 201):
        rows = 1000 + 0.1 * torch.randn(64, 1, generator=generator)
        mean, variance, _ = updated_moments(mean, variance, rows, 1 / n)
    assert mean.item() == pytest.approx(1000, abs=0.01)
    assert variance.sqrt().item() == pytest.approx(0.1, rel=0.05)


@pytest.mark.parametrize("poison", [float("nan"), float("inf")])
def test_rows_that_are_not_finite_leave_the_moments_as_they_are(poison):
    mean, variance = torch.tensor([3.0, 1.0]), torch.tensor([5.0, 2.0])
    moved = updated_moments(mean, variance, torch.tensor([[0.0, 1.0], [poison, 1.0]]), 0.5)
    assert torch.equal(moved[0], mean)
    assert torch.equal(moved[1], variance)
    assert not moved[2]


def test_no_gradient_reaches_the_rows_and_what_was_passed_is_not_changed():
    rows = torch.randn(5, 2, requires_grad=True)
    mean, variance = torch.zeros(2), torch.ones(2)
    moved = updated_moments(mean, variance, rows, 0.5)
    assert not any(moment.requires_grad for moment in moved)
    assert torch.equal(mean, torch.zeros(2))
    assert torch.equal(variance, torch.ones(2))


def test_rows_that_do_not_count_are_as_if_they_were_not_there():
    generator = torch.Generator().manual_seed(0)
    rows, counts = torch.randn(9, 4, 2, generator=generator), torch.rand(9, 4, generator=generator) > 0.4
    mean, variance = torch.tensor([3.0, 1.0]), torch.tensor([5.0, 2.0])
    expected = updated_moments(mean, variance, rows[counts], 0.25)
    torch.testing.assert_close(updated_moments(mean, variance, rows, 0.25, counts), expected)
    rows[~counts] = torch.nan
    torch.testing.assert_close(updated_moments(mean, variance, rows, 0.25, counts), expected)
    moved = updated_moments(mean, variance, rows, 0.25, torch.zeros_like(counts))
    assert torch.equal(moved[0], mean) and torch.equal(moved[1], variance)


def test_rows_in_half_precision_are_counted_in_that_of_the_moments():
    rows = torch.tensor([[-1000.0], [1000.0]], dtype=torch.float16)  # the square of which it does not hold
    mean, variance, _ = updated_moments(torch.zeros(1), torch.ones(1), rows, 1.0)
    assert (mean.item(), variance.item()) == (0, 1_000_000)
    assert mean.dtype == variance.dtype == torch.float32
