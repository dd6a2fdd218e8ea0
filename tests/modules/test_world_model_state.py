from __future__ import annotations

import copy

import pytest
import torch

from torchrl_etdmpc.functional import simnorm
from torchrl_etdmpc.modules import DynamicsEnsemble, Encoder, GaussianPolicy, ValueEnsemble, WorldModel

O, A, L = 5, 2, 16  # noqa: E741


# State


def test_a_state_dict_carries_everything(build, randomised):
    model, other = randomised(termination=True), build(termination=True, bin_min=-5.0, bin_max=5.0)
    model.version.fill_(41)
    result = other.load_state_dict(model.state_dict())
    assert not result.missing_keys
    assert not result.unexpected_keys
    assert other.version == 41
    observation, action = torch.randn(7, O), torch.rand(7, A)
    latent = model.encode(observation)
    assert torch.equal(other.encode(observation), latent)
    assert torch.equal(other.next(latent.unsqueeze(0), action), model.next(latent.unsqueeze(0), action))
    assert torch.equal(other.reward(latent, action), model.reward(latent, action))
    assert torch.equal(other.values(latent), model.values(latent))
    assert torch.equal(other.termination(latent), model.termination(latent))
    assert torch.equal(other.act(latent, action), model.act(latent, action))


def test_a_reset_draws_every_network_anew_and_keeps_what_starts_at_zero(build):
    model = build(termination=True)
    before = {name: p.detach().clone() for name, p in model.named_parameters()}
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(1.0)
    model.version.fill_(41)
    model.reset_parameters_recursive()
    assert model.version == 0
    for name, parameter in model.named_parameters():
        if name.endswith(".weight") and name not in ("reward_head.output.weight", "value_head.output.weight"):
            assert (parameter != before[name]).all(), name
            assert parameter.abs().max() < 0.2, name
        else:  # zeros, and the ones of a LayerNorm
            assert torch.equal(parameter, before[name]), name


def test_a_model_that_is_made_on_no_device_has_its_bins_after_a_reset(build):
    with torch.device("meta"):
        model = build(num_bins=21, bin_min=-5.0, bin_max=5.0)
    model = model.to_empty(device="cpu")
    model.reset_parameters_recursive()
    assert torch.equal(model.bins, torch.linspace(-5.0, 5.0, 21))


def test_models_of_equal_seed_are_equal(build):
    torch.manual_seed(3)
    first = build().state_dict()
    torch.manual_seed(3)
    second = build().state_dict()
    assert all(torch.equal(first[name], second[name]) for name in first)


def test_double_precision_works_throughout_and_agrees_with_single(randomised):
    model = randomised(termination=True)
    observation, action, noise = torch.randn(7, O), torch.rand(7, A), torch.randn(7, A)

    def predictions(observation, action, noise):
        latent = model.encode(observation)
        step = model.next(latent.unsqueeze(0), action)
        policy = model.policy(latent)
        heads = model.reward(step, action), model.values(step), model.termination(step)
        return latent, step, *policy, *heads, model.act(latent, noise)

    single = predictions(observation, action, noise)
    model.double()
    double = predictions(observation.double(), action.double(), noise.double())
    assert {x.dtype for x in double} == {torch.float64}
    for a, b in zip(single, double, strict=True):
        torch.testing.assert_close(a.double(), b, rtol=1e-3, atol=1e-4)


def test_predictions_send_gradients_to_their_own_networks_only(randomised):
    model = randomised(termination=True)
    latent, action = simnorm(torch.randn(7, L)), torch.rand(7, A)
    predictions = {
        "dynamics": lambda: model.next(latent.unsqueeze(0), action).square(),
        "reward_head": lambda: model.reward(latent, action),
        "value_head": lambda: model.values(latent),
        "policy": lambda: model.act(latent, torch.zeros(7, A)),
        "termination_head": lambda: model.termination(latent),
    }
    for name, predict in predictions.items():
        model.zero_grad()
        predict().sum().backward()
        assert {n.split(".")[0] for n, p in model.named_parameters() if p.grad is not None} == {name}


def test_inputs_are_left_alone(randomised):
    model = randomised(termination=True)
    latent, action, noise = simnorm(torch.randn(4, 7, L)), torch.rand(7, A), torch.randn(4, 7, A)
    before = latent.clone(), action.clone(), noise.clone()
    model.next(latent, action), model.reward(latent, action), model.values(latent), model.act(latent, noise)
    assert all(torch.equal(a, b) for a, b in zip((latent, action, noise), before, strict=True))


# The networks on their own


def test_the_encoder_has_as_many_hidden_layers_as_asked_for(assert_on_the_simplices):
    encoder = Encoder(O, L, hidden_dim=24, num_layers=3)
    assert [tuple(layer.weight.shape) for layer in encoder.hidden] == [(O, 24), (24, 24), (24, 24)]
    assert_on_the_simplices(encoder(torch.randn(7, O)))


def test_the_networks_work_outside_a_world_model():
    latent = simnorm(torch.randn(7, L))
    assert DynamicsEnsemble(L, A, num_heads=3, hidden_dim=8)(latent.unsqueeze(0), torch.rand(7, A)).shape == (3, 7, L)
    assert ValueEnsemble(L, num_heads=3, num_bins=21, hidden_dim=8)(latent).shape == (3, 7, 21)
    mean, log_std = GaussianPolicy(L, A, hidden_dim=8, log_std_min=0.0, log_std_max=0.5)(latent)
    assert ((log_std > 0) & (log_std < 0.5)).all()
    assert mean.shape == (7, A)


def test_bins_come_back_from_half_precision_as_they_were():
    model = WorldModel(3, 2, latent_dim=16, mlp_dim=16, bin_min=-7.3, bin_max=5.0)
    exact = model.bins.clone()
    model.to(torch.bfloat16)
    assert model.bins.dtype == torch.bfloat16
    assert not torch.equal(model.bins.float(), exact)
    rounded = copy.deepcopy(model.state_dict())
    model.float()
    assert torch.equal(model.bins, exact)
    model.load_state_dict(rounded)
    assert torch.equal(model.bins, exact)


@pytest.mark.parametrize("ends", [(-5.0, 8.0), (-5.0, 10.0), (-10.0, 8.0)])
def test_bins_of_a_state_with_other_ends_are_taken_over_for_good(ends):
    model = WorldModel(3, 2, latent_dim=16, mlp_dim=16)
    other = WorldModel(3, 2, latent_dim=16, mlp_dim=16, bin_min=ends[0], bin_max=ends[1])
    model.load_state_dict(other.state_dict())
    model.to(torch.float16).float()
    model.reset_parameters_recursive()
    assert torch.equal(model.bins, other.bins)
