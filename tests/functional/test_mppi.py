from __future__ import annotations

import math

import pytest
import torch

from torchrl_etdmpc.functional import (
    Gaussian,
    elite_weights,
    fit_gaussian,
    sample_elite,
    sample_sequences,
    select_elites,
    shift_plan,
)

NON_FINITE = [math.nan, math.inf, -math.inf]


def normal(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def labelled(num_candidates: int, horizon: int = 2, action_dim: int = 1) -> torch.Tensor:
    """Candidates whose every entry is the candidate's own index plus one."""
    return (torch.arange(num_candidates) + 1.0).view(-1, 1, 1).expand(-1, horizon, action_dim)


@pytest.mark.parametrize("horizon", [1, 4])
def test_shift_plan_drops_the_first_action_appends_zeros_and_leaves_its_input_alone(horizon):
    mean = normal(3, 5, horizon, 2)
    before = mean.clone()
    shifted = shift_plan(mean)
    assert torch.equal(shifted, torch.cat([before[..., 1:, :], torch.zeros(3, 5, 1, 2)], -2))
    assert torch.equal(mean, before)


def test_sequences_without_noise_are_the_mean():
    mean = normal(5, 3, 2).clamp(-1, 1)
    sequences = sample_sequences(Gaussian(mean, torch.ones_like(mean)), torch.zeros(5, 7, 3, 2))
    assert torch.equal(sequences, mean.unsqueeze(1).expand(5, 7, 3, 2))


def test_sequences_scale_the_noise_per_step_and_action_and_clip_to_the_action_range():
    plan = Gaussian(torch.tensor([[0.0, 0.5], [-0.5, 0.0]]), torch.tensor([[0.1, 0.2], [1.0, 2.0]]))
    noise = torch.tensor([[[1.0, -1.0], [0.25, 0.125]], [[20.0, 9.0], [-9.0, -0.6]]])
    expected = torch.tensor([[[0.1, 0.3], [-0.25, 0.25]], [[1.0, 1.0], [-1.0, -1.0]]])
    torch.testing.assert_close(sample_sequences(plan, noise), expected)


def test_elites_are_the_highest_scores_in_descending_order_with_their_own_actions():
    scores = torch.tensor([0.3, -5.0, 2.0, 1.0, -0.1])
    elites = select_elites(labelled(5), scores, 3)
    assert elites.scores.tolist() == pytest.approx([2.0, 1.0, 0.3])
    assert elites.actions[:, 0, 0].tolist() == [3.0, 4.0, 1.0]
    assert elites.actions.shape == (3, 2, 1)


@pytest.mark.parametrize("bad", NON_FINITE)
def test_a_non_finite_candidate_is_never_an_elite_while_enough_finite_ones_exist(bad):
    scores = torch.tensor([-1e30, bad, -7.0, bad, -8.0])  # all negative: a bad score replaced by 0 would win
    elites = select_elites(labelled(5), scores, 3)
    assert elites.scores.tolist() == pytest.approx([-7.0, -8.0, -1e30])
    assert elites.actions[:, 0, 0].tolist() == [3.0, 5.0, 1.0]


@pytest.mark.parametrize("bad", NON_FINITE)
def test_where_finite_candidates_run_out_the_remaining_places_are_zero_actions_of_weight_zero(bad):
    actions = labelled(4).clone()
    actions[[0, 2, 3]] = bad  # what made the score non-finite
    elites = select_elites(actions, torch.tensor([bad, -3.0, bad, bad]), 3)
    assert elites.scores.tolist() == [-3.0, -torch.inf, -torch.inf]
    assert elites.actions[:, 0, 0].tolist() == [2.0, 0.0, 0.0]
    weights = elite_weights(elites.scores, 0.5)
    assert weights.tolist() == [1.0, 0.0, 0.0]
    plan = fit_gaussian(elites.actions, weights, std_min=0.05, std_max=2.0)
    torch.testing.assert_close(plan.mean, torch.full((2, 1), 2.0))
    torch.testing.assert_close(plan.std, torch.full((2, 1), 0.05))


@pytest.mark.parametrize("bad", NON_FINITE)
def test_with_no_finite_candidate_everything_stays_finite(bad):
    elites = select_elites(torch.full((4, 2, 1), bad), torch.full((4,), bad), 2)
    assert elites.scores.tolist() == [-torch.inf, -torch.inf]
    assert elites.actions.count_nonzero() == 0
    weights = elite_weights(elites.scores, 0.5)
    assert weights.tolist() == [0.5, 0.5]
    plan = fit_gaussian(elites.actions, weights, std_min=0.05, std_max=2.0)
    assert plan.mean.isfinite().all()
    assert plan.std.isfinite().all()


def test_mixed_non_finite_scores_in_one_batch_entry_leave_the_others_alone():
    scores, actions = normal(3, 8), normal(3, 8, 2, 1, seed=1)
    expected = select_elites(actions, scores, 4)
    spoilt = scores.clone()
    spoilt[1, :3] = torch.tensor(NON_FINITE)
    elites = select_elites(actions, spoilt, 4)
    for b in (0, 2):
        assert torch.equal(elites.actions[b], expected.actions[b])
        assert torch.equal(elites.scores[b], expected.scores[b])
    remaining = select_elites(actions[1, 3:], scores[1, 3:], 4)
    assert torch.equal(elites.actions[1], remaining.actions)
    assert elites.scores.isfinite().all()


def test_selection_of_a_batch_is_the_selection_of_its_parts_and_inputs_are_left_alone():
    scores, actions = normal(2, 3, 9), normal(2, 3, 9, 4, 2, seed=1)
    scores[0, 1, 2] = math.nan
    before = scores.clone(), actions.clone()
    elites = select_elites(actions, scores, 4)
    single = select_elites(actions[0, 1], scores[0, 1], 4)
    assert torch.equal(elites.actions[0, 1], single.actions)
    assert torch.equal(elites.scores[0, 1], single.scores)
    torch.testing.assert_close(scores, before[0], rtol=0, atol=0, equal_nan=True)
    assert torch.equal(actions, before[1])


def test_weights_are_a_softmax_of_the_scores_times_the_inverse_temperature():
    scores = normal(5, 8)
    expected = (0.5 * scores).exp()
    torch.testing.assert_close(elite_weights(scores, 0.5), expected / expected.sum(-1, keepdim=True))


def test_an_empty_place_has_weight_zero_at_inverse_temperature_zero_too():
    assert elite_weights(torch.tensor([3.0, 1.0, -torch.inf]), 0.0).tolist() == [0.5, 0.5, 0.0]


@pytest.mark.parametrize("offset", [1e6, -1e6])
def test_large_scores_give_the_weights_of_their_differences(offset):
    scores = torch.tensor([0.0, -1.0, -4.0])
    weights = elite_weights(scores + offset, 0.5)
    assert weights.isfinite().all()
    torch.testing.assert_close(weights, elite_weights(scores, 0.5))


def test_fit_gaussian_is_the_weighted_mean_and_standard_deviation():
    actions = torch.tensor([0.0, 1.0, -1.0]).view(3, 1, 1)
    plan = fit_gaussian(actions, torch.tensor([0.5, 0.3, 0.2]), std_min=0.05, std_max=2.0)
    torch.testing.assert_close(plan.mean.item(), 0.1)
    torch.testing.assert_close(plan.std.item(), (0.5 * 0.1**2 + 0.3 * 0.9**2 + 0.2 * 1.1**2) ** 0.5)


def test_fit_gaussian_of_one_certain_elite_is_that_elite_with_the_smallest_std():
    actions = normal(4, 3, 2)
    plan = fit_gaussian(actions, torch.tensor([0.0, 0.0, 1.0, 0.0]), std_min=0.05, std_max=2.0)
    assert torch.equal(plan.mean, actions[2])
    assert torch.equal(plan.std, torch.full((3, 2), 0.05))


def test_the_std_is_clipped_at_both_ends():
    actions = torch.tensor([[-1.0, 0.3], [1.0, 0.3]]).view(2, 1, 2)
    plan = fit_gaussian(actions, torch.tensor([0.5, 0.5]), std_min=0.05, std_max=0.7)
    torch.testing.assert_close(plan.std, torch.tensor([[0.7, 0.05]]))


def test_the_fit_of_a_batch_is_the_fit_of_its_parts():
    actions, weights = normal(2, 5, 8, 3, 2), normal(2, 5, 8, seed=1).softmax(-1)
    plan = fit_gaussian(actions, weights, std_min=0.05, std_max=2.0)
    single = fit_gaussian(actions[1, 3], weights[1, 3], std_min=0.05, std_max=2.0)
    torch.testing.assert_close(plan.mean[1, 3], single.mean)
    torch.testing.assert_close(plan.std[1, 3], single.std)


def test_elites_are_sampled_as_often_as_their_weights_say():
    weights = torch.tensor([0.5, 0.25, 0.15, 0.08, 0.02])
    draws = 20_000
    uniform = torch.rand(draws, 5, generator=torch.Generator().manual_seed(0))
    index = sample_elite(weights.expand(draws, 5), uniform)
    assert index.dtype == torch.int64
    expected = draws * weights
    chi_square = ((index.bincount(minlength=5) - expected).square() / expected).sum()
    assert chi_square < 18.5  # the 99.9 % quantile at four degrees of freedom


def test_a_place_of_weight_zero_is_never_sampled():
    weights = torch.tensor([0.0, 0.3, 0.0, 0.7, 0.0]).expand(5000, 5)
    uniform = torch.rand(5000, 5, generator=torch.Generator().manual_seed(0))
    uniform[0] = torch.tensor([1.0, 0.0, 1.0, 0.0, 1.0])  # the extreme draws, all in favour of the empty places
    assert set(sample_elite(weights, uniform).tolist()) == {1, 3}


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_draw_of_exactly_zero_or_one_gives_a_valid_elite(dtype):
    weights = torch.tensor([0.2, 0.8], dtype=dtype)
    assert sample_elite(weights, torch.zeros(2, dtype=dtype)) == 1
    assert sample_elite(weights, torch.tensor([0.0, 0.5], dtype=dtype)) == 1
    assert sample_elite(weights, torch.tensor([1.0, 0.0], dtype=dtype)) == 0
    assert sample_elite(torch.tensor([1.0, 0.0], dtype=dtype), torch.zeros(2, dtype=dtype)) == 0


def test_equal_draws_choose_the_heaviest_elite():
    weights = normal(6, 8).softmax(-1)
    assert torch.equal(sample_elite(weights, torch.full((6, 8), 0.4)), weights.argmax(-1))
