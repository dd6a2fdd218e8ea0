from __future__ import annotations

import pytest
import torch

from torchrl_etdmpc.functional import simnorm
from torchrl_etdmpc.modules import MLP

O, A, L = 5, 2, 16  # noqa: E741
LEADING = [(), (7,), (3, 7)]


# Ensembles


@pytest.mark.parametrize("leading", LEADING)
def test_a_dynamics_head_equals_the_same_network_built_alone(leading, randomised):
    stack = randomised(num_dynamics=3).dynamics
    latent, action = simnorm(torch.randn(3, *leading, L)), torch.rand(*leading, A)
    out = stack(latent, action)
    for i in range(3):
        alone = MLP(L + A, [32, 32], L, output_activation=simnorm)
        alone.load_state_dict({name: tensor[i] for name, tensor in stack.state_dict().items()})
        torch.testing.assert_close(out[i], alone(torch.cat([latent[i], action], dim=-1)), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("leading", LEADING)
def test_a_value_head_equals_the_same_network_built_alone(leading, randomised):
    stack = randomised(num_values=3).value_head
    latent = simnorm(torch.randn(*leading, L))
    out = stack(latent)
    for j in range(3):
        alone = MLP(L, [32, 32], 101)
        alone.load_state_dict({name: tensor[j] for name, tensor in stack.state_dict().items()})
        torch.testing.assert_close(out[j], alone(latent), rtol=1e-4, atol=1e-4)


def test_one_latent_for_all_heads_equals_a_copy_per_head(randomised):
    model = randomised(num_dynamics=3)
    latent, action = simnorm(torch.randn(1, 7, L)), torch.rand(7, A)
    torch.testing.assert_close(model.next(latent, action), model.next(latent.repeat(3, 1, 1), action))
    assert (model.next(latent, action)[0] != model.next(latent, action)[1]).any()


def test_heads_may_take_their_own_actions(randomised):
    model = randomised(num_dynamics=3)
    latent, action = simnorm(torch.randn(1, 7, L)), torch.rand(3, 7, A)
    out = model.next(latent, action)
    for i in range(3):
        torch.testing.assert_close(out[i], model.next(latent, action[i])[i])


@pytest.mark.parametrize("states", [(), (1,), (3,), (4,)])  # 4: as many as heads
@pytest.mark.parametrize("own", ["the same for all states", "of each state", "of each head"])
def test_many_actions_in_one_latent_are_those_of_a_copy_of_the_latent_for_each(states, own, randomised):
    model = randomised(num_dynamics=4)
    latent = simnorm(torch.randn(1, *states, 1, L))
    shapes = {"the same for all states": (7, A), "of each state": (*states, 7, A), "of each head": (4, *states, 7, A)}
    action = torch.rand(shapes[own])
    copies = latent.expand(1, *states, 7, L)
    torch.testing.assert_close(model.next(latent, action), model.next(copies, action))


# Dropout


@pytest.mark.parametrize("training", [True, False])
def test_value_dropout_acts_only_when_asked_for_and_never_through_the_training_mode(training, randomised):
    model = randomised(dropout=0.5).train(training)
    latent = simnorm(torch.randn(7, L))
    assert torch.equal(model.values(latent), model.values(latent))
    assert torch.equal(model.value_head(latent), model.value_head(latent))
    dropped = model.value_head(latent, dropout=True)
    assert not torch.equal(dropped, model.value_head(latent, dropout=True))
    assert not torch.equal(dropped, model.value_head(latent))


def test_values_do_not_depend_on_the_dropout_rate(randomised):
    model, other = randomised(dropout=0.0), randomised(dropout=0.9)
    other.load_state_dict(model.state_dict())
    latent = simnorm(torch.randn(7, L))
    assert torch.equal(other.values(latent), model.values(latent))


def test_value_heads_drop_independently(randomised):
    head = randomised(dropout=0.5).value_head
    with torch.no_grad():
        for parameter in head.parameters():
            parameter[1] = parameter[0]
    latent = simnorm(torch.randn(7, L))
    first, second = head(latent)
    torch.testing.assert_close(first, second)
    first, second = head(latent, dropout=True)
    assert (first != second).all()


def test_no_other_network_drops(randomised):
    model = randomised(dropout=0.5, termination=True)
    dropouts = {name: m.dropout for name, m in model.named_modules() if getattr(m, "dropout", 0.0)}
    assert dropouts == {"value_head.hidden.0": 0.5}
