from __future__ import annotations

import pytest
import torch

from torchrl_etdmpc.functional import simnorm


def normal(*shape: int) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


@pytest.mark.parametrize("group_size", [1, 4, 8, 32])
def test_simnorm_is_a_softmax_over_each_strided_group(group_size):
    x = normal(5, 32)
    groups = 32 // group_size
    expected = torch.empty_like(x)
    for group in range(groups):
        expected[:, group::groups] = x[:, group::groups].softmax(-1)
    torch.testing.assert_close(simnorm(x, group_size), expected)


def test_simnorm_is_td_mpc2s_adjacent_groups_up_to_a_fixed_permutation():
    x = normal(5, 32)
    # Channel k of adjacent group g is channel g + k G here.
    permutation = torch.arange(32).view(8, 4).T.flatten()
    adjacent = x[:, permutation].view(5, 4, 8).softmax(-1).view(5, 32)
    torch.testing.assert_close(simnorm(x, 8)[:, permutation], adjacent)


def test_large_inputs_stay_finite_and_become_one_hot():
    x = torch.zeros(16)
    x[[0, 3]] = 1e30
    out = simnorm(x, 8)
    assert out.tolist() == [1.0 if i in (0, 3) else 0.0 for i in range(16)]


def test_any_leading_batch_gives_the_result_of_its_parts():
    x = normal(2, 3, 16)
    out = simnorm(x, 8)
    assert out.shape == x.shape
    torch.testing.assert_close(out[1, 2], simnorm(x[1, 2], 8))
    assert simnorm(x[:0], 8).shape == (0, 3, 16)


def test_a_latent_size_that_no_group_size_divides_is_refused_with_the_remedy():
    with pytest.raises(ValueError) as error:
        simnorm(torch.zeros(2, 20), 8)
    assert str(error.value) == (
        "simnorm needs a latent size divisible by group_size=8, got 20; choose latent_dim as a multiple of group_size."
    )
