from __future__ import annotations

from functools import partial

import pytest
import torch

from torchrl_etdmpc.functional import bounded_log_std, clipped_sample, simnorm, two_hot_decode, two_hot_encode
from torchrl_etdmpc.modules import MLP

O, A, L = 5, 2, 16  # noqa: E741
LEADING = [(), (7,), (3, 7)]


# Shapes and ranges


@pytest.mark.parametrize("leading", LEADING)
@pytest.mark.parametrize(("heads", "values"), [(1, 1), (4, 2)])
def test_every_prediction_has_its_documented_shape(heads, values, leading, randomised):
    model = randomised(num_dynamics=heads, num_values=values, termination=True)
    latent, action = model.encode(torch.randn(*leading, O)), torch.rand(*leading, A)
    assert latent.shape == (*leading, L)
    step = model.next(latent.unsqueeze(0), action)
    assert step.shape == (heads, *leading, L)
    assert model.next(step, action).shape == (heads, *leading, L)
    assert model.reward(latent, action).shape == leading
    assert model.reward(step, action).shape == (heads, *leading)
    assert model.values(latent).shape == (*leading, values)
    assert model.values(step).shape == (heads, *leading, values)
    assert model.termination(step).shape == (heads, *leading)
    mean, log_std = model.policy(latent)
    assert mean.shape == log_std.shape == (*leading, A)
    assert model.act(latent, torch.randn(*leading, A)).shape == (*leading, A)


def test_an_empty_batch_gives_empty_predictions(randomised):
    model = randomised(termination=True)
    latent, action = model.encode(torch.zeros(0, O)), torch.zeros(0, A)
    assert model.next(latent.unsqueeze(0), action).shape == (4, 0, L)
    assert model.reward(latent, action).shape == (0,)
    assert model.values(latent).shape == (0, 2)
    assert model.termination(latent).shape == (0,)
    assert model.act(latent, action).shape == (0, A)


@pytest.mark.parametrize("simnorm_dim", [4, 8])
def test_latents_lie_on_the_simplices(simnorm_dim, randomised, assert_on_the_simplices):
    model = randomised(simnorm_dim=simnorm_dim)
    latent = model.encode(10 * torch.randn(50, O))
    assert_on_the_simplices(latent, simnorm_dim)
    for _ in range(3):
        latent = model.next(latent if latent.ndim == 3 else latent.unsqueeze(0), torch.rand(50, A) * 2 - 1)
        assert_on_the_simplices(latent, simnorm_dim)


def test_a_batch_gives_the_predictions_of_its_parts(randomised):
    model = randomised(termination=True)
    observation, action = torch.randn(3, 7, O), torch.rand(3, 7, A)
    latent = model.encode(observation)
    close = partial(torch.testing.assert_close, rtol=1e-4, atol=1e-4)
    close(latent[1, 4], model.encode(observation[1, 4]))
    close(model.next(latent.unsqueeze(0), action)[:, 1, 4], model.next(latent[1, 4].unsqueeze(0), action[1, 4]))
    close(model.reward(latent, action)[1, 4], model.reward(latent[1, 4], action[1, 4]))
    close(model.values(latent)[1, 4], model.values(latent[1, 4]))
    close(model.termination(latent)[1, 4], model.termination(latent[1, 4]))


@pytest.mark.parametrize("bounds", [None, (-2.0, 1.0), (-0.5, 0.25)])
def test_the_policy_stays_within_its_bounds_and_reaches_them(bounds, randomised):
    model = randomised()
    with torch.no_grad():
        model.policy.output.weight.mul_(10)
        model.policy.output.bias.zero_()
    mean, log_std = model.policy(simnorm(100 * torch.randn(200, L)), bounds)
    low, high = bounds or (-3.0, 1.0)
    assert mean.abs().max() <= 1
    assert log_std.min() >= low - 1e-6
    assert log_std.max() <= high + 1e-6
    assert log_std.min() < low + 0.01 * (high - low)
    assert log_std.max() > high - 0.01 * (high - low)


def test_a_new_policy_is_centred_strictly_inside_the_action_range(build):
    mean, log_std = build().policy(simnorm(torch.randn(50, L)))
    assert mean.abs().max() < 1
    torch.testing.assert_close(mean, torch.zeros(50, A), rtol=0, atol=0.4)
    torch.testing.assert_close(log_std, torch.full((50, A), -1.0), rtol=0, atol=0.8)


def test_other_bounds_change_the_log_std_of_that_call_only(randomised):
    model = randomised()
    latent = simnorm(torch.randn(20, L))
    mean, log_std = model.policy(latent)
    widened_mean, widened = model.policy(latent, (-2.0, 1.0))
    assert torch.equal(widened_mean, mean)
    torch.testing.assert_close(widened, -2 + (log_std + 3) * 3 / 4)
    assert torch.equal(model.policy(latent)[1], log_std)


def test_the_policys_first_outputs_are_the_mean_and_its_last_the_log_std(randomised):
    model = randomised()
    latent = simnorm(torch.randn(20, L))
    raw = MLP.forward(model.policy, latent)
    mean, log_std = model.policy(latent)
    torch.testing.assert_close(mean, raw[:, :A].tanh())
    torch.testing.assert_close(log_std, bounded_log_std(raw[:, A:], -3.0, 1.0))


def test_act_without_noise_is_the_mean_and_with_noise_the_clipped_sample(randomised):
    model = randomised()
    latent, noise = simnorm(torch.randn(20, L)), 3 * torch.randn(20, A)
    mean, log_std = model.policy(latent)
    assert torch.equal(model.act(latent, torch.zeros(20, A)), mean)
    assert torch.equal(model.act(latent, noise), clipped_sample(mean, log_std.exp(), noise))
    assert model.act(latent, noise).abs().max() == 1
    bounds = (-2.0, 1.0)
    wide = clipped_sample(mean, model.policy(latent, bounds)[1].exp(), noise)
    assert torch.equal(model.act(latent, noise, bounds), wide)


# Heads


def test_reward_and_values_are_the_decoded_distributions_of_their_heads(randomised):
    model = randomised()
    latent, action = simnorm(torch.randn(7, L)), torch.rand(7, A)
    torch.testing.assert_close(
        model.reward(latent, action), two_hot_decode(model.reward_head(latent, action), model.bins)
    )
    values = model.values(latent)
    for j, logits in enumerate(model.value_head(latent)):
        torch.testing.assert_close(values[:, j], two_hot_decode(logits, model.bins))
    assert (values[:, 0] != values[:, 1]).all()


@pytest.mark.parametrize("scalar", [-40.0, 0.0, 0.7, 900.0])
def test_a_head_that_outputs_a_two_hot_distribution_predicts_its_scalar(scalar, build):
    model = build()
    logits = two_hot_encode(torch.tensor(scalar), model.bins).clamp_min(1e-30).log()
    with torch.no_grad():
        model.reward_head.output.bias.copy_(logits)
        model.value_head.output.bias[1] = logits
    latent, action = simnorm(torch.randn(7, L)), torch.rand(7, A)
    close = partial(torch.testing.assert_close, rtol=1e-4, atol=1e-4)
    close(model.reward(latent, action), torch.full((7,), scalar))
    close(model.values(latent), torch.tensor([0.0, scalar]).expand(7, 2))


def test_the_reward_depends_on_the_action_and_one_action_serves_all_heads(randomised):
    model = randomised()
    latent, action = simnorm(torch.randn(4, 7, L)), torch.rand(7, A)
    torch.testing.assert_close(model.reward(latent, action), model.reward(latent, action.expand(4, 7, A)))
    assert (model.reward(latent, action) != model.reward(latent, -action)).all()


def test_without_a_termination_head_there_is_no_termination(build):
    model = build()
    assert model.termination(torch.rand(7, L)) is None
    assert not any("termination" in name for name in model.state_dict())


def test_termination_is_a_probability_from_the_heads_logit(build, randomised):
    model = randomised(termination=True)
    latent = simnorm(torch.randn(7, L))
    torch.testing.assert_close(model.termination(latent), torch.sigmoid(model.termination_head(latent)))
    fresh = build(termination=True).termination(latent)
    torch.testing.assert_close(fresh, torch.full((7,), 0.5), rtol=0, atol=0.1)
    with torch.autocast("cpu", dtype=torch.bfloat16):  # whose steps near 1 are 1/256: survival would go in jumps
        assert model.termination_head(latent).dtype == torch.bfloat16
        assert model.termination(latent).dtype == torch.float32


def test_observations_of_another_dtype_say_how_to_cast_them(build):
    model, observation = build(), torch.zeros(4, build().observation_dim, dtype=torch.float64)
    with pytest.raises(
        TypeError, match=r"observations are torch.float64 and the weights torch.float32; append torchrl"
    ):
        model.encode(observation)
    assert model.double().encode(observation).dtype == torch.float64


def test_autocast_takes_observations_in_half_precision(build):
    model = build()
    observation = torch.randn(4, model.observation_dim).bfloat16()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        latent = model.encode(observation)
    torch.testing.assert_close(latent.float(), model.encode(observation.float()), rtol=0, atol=0.02)
