from __future__ import annotations

import pytest
import torch

from torchrl_etdmpc.modules import (
    ActionValueWorldModel,
    SquashedGaussianPolicy,
    WorldModel,
    has_action_values,
    require_prediction_model,
)
from torchrl_etdmpc.modules.normed_linear import INIT_STD

O, A, L = 5, 2, 16  # noqa: E741
SIZES = {"latent_dim": L, "mlp_dim": 32, "encoder_dim": 24}


def build(**options) -> ActionValueWorldModel:
    return ActionValueWorldModel(O, A, **SIZES | options)


def disturbed(**options) -> ActionValueWorldModel:
    model = build(**options)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.normal_(0.0, 0.5)
    return model


def test_it_is_a_prediction_model_with_action_values_and_the_other_one_is_not():
    require_prediction_model(build())
    assert has_action_values(build())
    assert not has_action_values(WorldModel(O, A))


def test_its_sizes_are_tdmpc2_s():
    model = ActionValueWorldModel(O, A)
    assert (model.num_dynamics, model.num_values, model.value_head.num_heads) == (1, 5, 5)
    assert model.policy.log_std_bounds == (-10.0, 2.0)
    assert [layer.dropout for layer in model.value_head.hidden] == [0.01, 0.0]
    assert model.value_head.hidden[0].weight.shape == (5, 512 + A, 512)


def test_every_member_starts_with_the_lineage_s_weights_and_worthless():
    model = build(mlp_dim=256)
    weights = model.value_head.hidden[0].weight
    assert all(abs(member.std() - INIT_STD) < 0.002 for member in weights)
    assert len({member.sum().item() for member in weights}) == 5
    assert (model.value_head.output.weight == 0).all()
    torch.testing.assert_close(model.action_values(torch.rand(7, L), torch.rand(7, A)), torch.zeros(7, 5))


def test_the_value_of_a_latent_is_that_of_the_mean_action():
    model = disturbed()
    latent = torch.rand(3, 7, L)
    mean, _ = model.policy(latent)
    torch.testing.assert_close(model.values(latent), model.action_values(latent, mean))
    assert model.values(latent).shape == (3, 7, 5)
    assert not torch.equal(model.action_values(latent, -mean), model.action_values(latent, mean))


def test_one_action_for_all_latents_is_spread_over_them():
    model = disturbed()
    latent, action = torch.rand(3, 7, L), torch.rand(A)
    torch.testing.assert_close(model.action_values(latent, action), model.action_values(latent, action.expand(3, 7, A)))


def test_dropout_changes_the_logits_only_when_asked_for_and_each_head_by_itself():
    model = disturbed(dropout=0.5).train()
    latent, action = torch.rand(7, L), torch.rand(7, A)
    plain = model.value_head(latent, action)
    assert torch.equal(plain, model.value_head(latent, action))
    assert (model.value_head(latent, action, dropout=True) != plain).flatten(1).any(1).all()
    with torch.no_grad():
        for parameter in model.value_head.parameters():
            parameter[1:] = parameter[0]
    heads = model.value_head(latent, action, dropout=True)
    assert (heads[1:] != heads[:-1]).flatten(1).any(1).all()


def test_an_action_is_a_squashed_sample():
    model = disturbed()
    latent, noise = torch.rand(7, L), torch.randn(7, A)
    mean, log_std = model.policy.before_tanh(latent)
    torch.testing.assert_close(model.act(latent, noise), torch.tanh(mean + log_std.exp() * noise))
    torch.testing.assert_close(model.act(latent, torch.zeros(7, A)), model.policy(latent)[0])
    wide = model.policy.before_tanh(latent, (1.0, 1.5))[1]
    assert ((wide > 1) & (wide < 1.5)).all()
    torch.testing.assert_close(model.act(latent, noise, (1.0, 1.5)), torch.tanh(mean + wide.exp() * noise))


def test_both_policies_answer_alike():
    policy = SquashedGaussianPolicy(L, A, hidden_dim=8)
    mean, log_std = policy(torch.rand(7, L))
    before, same = policy.before_tanh(torch.rand(1, L).expand(7, L))
    assert mean.shape == log_std.shape == before.shape == same.shape == (7, A)
    assert (mean.abs() < 1).all()


def test_a_squashed_policy_keeps_the_bounds_that_a_call_asks_for():
    policy = SquashedGaussianPolicy(L, A, hidden_dim=8)
    torch.nn.init.zeros_(policy.output.weight)  # halfway between the bounds, and at a mean of 0 tanh has a slope of 1
    assert policy(torch.zeros(1, L), (-1.0, -0.5))[1].tolist() == [[-0.75] * A]


def test_the_deviation_of_a_squashed_policy_is_that_of_its_actions():
    torch.manual_seed(0)
    policy = SquashedGaussianPolicy(L, A, hidden_dim=8, log_std_min=-6.0, log_std_max=-5.0).double()
    with torch.no_grad():
        for parameter in policy.parameters():
            parameter.add_(0.5 * torch.randn_like(parameter))
    latent = torch.rand(7, L).double()
    before, narrow = policy.before_tanh(latent)
    mean, log_std = policy(latent)
    assert before.abs().max() > 1  # where the tanh is far from the identity
    actions = torch.tanh(before + narrow.exp() * torch.randn(20_000, 7, A).double())
    torch.testing.assert_close(actions.mean(0), mean, rtol=0, atol=3e-4)
    torch.testing.assert_close(actions.std(0), log_std.exp(), rtol=0.03, atol=0)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"num_values": 0}, r"^num_values must be at least 1, got 0\.$"),
        ({"dropout": 1.0}, r"^dropout must be in \[0, 1\), got 1\.0\.$"),
        ({"log_std_min": 3.0}, "^log_std_min must be"),
        ({"activation": "tanh"}, "^activation must be one of"),
    ],
)
def test_an_impossible_size_is_refused_as_by_the_other_model(options, message):
    with pytest.raises(ValueError, match=message):
        build(**options)


def test_new_weights_are_drawn_for_every_network():
    model = disturbed()
    before = {name: value.clone() for name, value in model.named_parameters()}
    model.version.fill_(3)
    model.reset_parameters_recursive()
    assert model.version == 0
    assert not any(torch.equal(value, before[name]) for name, value in model.named_parameters())
