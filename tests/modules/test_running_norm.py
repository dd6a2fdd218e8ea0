from __future__ import annotations

import pytest
import torch
from torch import nn

from torchrl_etdmpc.modules import Encoder, RunningNorm, WorldModel

O, A = 5, 2  # noqa: E741


def test_before_anything_was_seen_vectors_stay_as_they_are():
    x = torch.randn(7, O)
    torch.testing.assert_close(RunningNorm(O)(x), x, rtol=1e-6, atol=0)


def test_what_was_seen_has_mean_zero_and_deviation_one():
    norm = RunningNorm(3)
    seen = torch.randn(10, 64, 3) * torch.tensor([0.01, 1.0, 50.0]) + torch.tensor([1.0, 0.0, 9.0])
    for batch in seen:
        norm.observe(batch)
    standardised = norm(seen).reshape(-1, 3)
    torch.testing.assert_close(standardised.mean(0), torch.zeros(3), atol=1e-4, rtol=0)
    torch.testing.assert_close(standardised.std(0, correction=0), torch.ones(3), atol=0.01, rtol=0)


def test_an_entry_that_never_moved_does_not_explode():
    norm = RunningNorm(1)
    norm.observe(torch.full((64, 1), 3.0))
    assert norm(torch.tensor([3.0])) == 0
    torch.testing.assert_close(norm(torch.tensor([3.002])), torch.tensor([2.0]), rtol=1e-3, atol=0)


def test_what_is_far_out_is_clipped():
    norm = RunningNorm(1)
    norm.observe(torch.randn(64, 1))
    assert norm(torch.tensor([1e6])) == 10
    assert norm(torch.tensor([-1e6])) == -10


@pytest.mark.parametrize("dtype", [torch.uint8, torch.int64])
def test_whole_numbers_are_standardised_to_fractions(dtype):
    norm, x = RunningNorm(1), torch.tensor([[10], [11], [13]], dtype=dtype)
    norm.observe(x)
    torch.testing.assert_close(norm(x), norm(x.float()), rtol=0, atol=0)


@pytest.mark.parametrize("wrong", [torch.nan, torch.inf, 1e30])
@pytest.mark.parametrize("masked", [False, True])
def test_a_batch_that_is_not_finite_is_no_batch_also_where_it_is_the_first(wrong, masked):
    norm, rows = RunningNorm(2), torch.randn(8, 2)
    rows[3, 1] = wrong
    counts = torch.arange(8) < 5 if masked else None
    norm.observe(rows, counts)
    assert norm.batches == 0
    assert (norm.mean.tolist(), norm.variance.tolist()) == ([0, 0], [1, 1])
    seen = 100 + torch.randn(64, 2)
    norm.observe(seen)
    torch.testing.assert_close(norm.mean, seen.mean(0))
    torch.testing.assert_close(norm.variance, seen.var(0, correction=0))
    norm.observe(rows, torch.arange(8) != 3)  # what does not count may be anything
    assert norm.batches == 2


def test_a_batch_of_which_nothing_counts_is_no_batch():
    first, second = torch.randn(8, 2), torch.randn(8, 2) + 3
    plain, padded = RunningNorm(2), RunningNorm(2)
    for norm in (plain, padded):
        norm.observe(first)
    padded.observe(torch.zeros(8, 2), torch.zeros(8, dtype=torch.bool))
    for norm in (plain, padded):
        norm.observe(second)
        assert norm.batches == 2
    torch.testing.assert_close(padded.mean, plain.mean)


def test_an_encoder_sees_a_small_entry_beside_a_large_one_only_if_it_standardises():
    """As in DMC's reacher: an angle of tens of radians beside the way to the target, a tenth of a metre."""
    observations = torch.randn(256, 2) * torch.tensor([30.0, 0.1])
    moved = observations + torch.tensor([0.0, 0.1])
    change = {}
    for normalize in (False, True):
        torch.manual_seed(1)
        encoder = Encoder(2, 16, hidden_dim=64, normalize=normalize)
        encoder.observe(observations)
        change[normalize] = (encoder(moved) - encoder(observations)).norm(dim=-1).median()
    assert change[True] > 10 * change[False]


def test_the_statistics_are_in_the_state_and_a_reset_forgets_them(build):
    model, other = build(normalize_observations=True), build(normalize_observations=True)
    observations = 3 + 2 * torch.randn(64, O)
    model.encoder.observe(observations)
    other.load_state_dict(model.state_dict())
    assert torch.equal(other.encode(observations), model.encode(observations))
    other.reset_parameters_recursive()
    assert (other.encoder.norm.batches, other.encoder.norm.mean.abs().sum()) == (0, 0)
    assert torch.equal(other.encoder.norm.variance, torch.ones(O))


def test_without_the_option_nothing_is_seen_and_nothing_is_in_the_state(build):
    model = build()
    before = model.encode(torch.ones(O))
    model.encoder.observe(100 * torch.randn(64, O))
    assert torch.equal(model.encode(torch.ones(O)), before)
    assert not [name for name in model.state_dict() if name.startswith("encoder.norm.")]


def test_an_encoder_of_ones_own_standardises_by_itself():
    with pytest.raises(ValueError) as error:
        WorldModel(None, A, encoder=nn.Linear(O, 512), normalize_observations=True)
    assert str(error.value) == (
        "normalize_observations is for the encoder that is built here; put a RunningNorm into your own, and a method "
        "observe(observation, counts) that moves it."
    )


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_statistics_move_on_where_the_module_is_cast_to_half_precision(dtype):
    exact, cast = RunningNorm(2), RunningNorm(2)
    cast.to(dtype)
    assert cast(torch.zeros(2, dtype=dtype)).dtype == dtype
    for batch in torch.randn(300, 32, 2) + torch.linspace(0, 10, 300)[:, None, None]:
        exact.observe(batch)
        cast.observe(batch.to(dtype))
    torch.testing.assert_close(cast.mean, exact.mean, rtol=1e-3, atol=0)
    torch.testing.assert_close(cast.variance, exact.variance, rtol=1e-2, atol=0)
