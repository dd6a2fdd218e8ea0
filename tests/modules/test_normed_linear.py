from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F
from torch import nn

from torchrl_etdmpc.modules import MLP, EnsembleLinear, NormedLinear
from torchrl_etdmpc.modules.normed_linear import INIT_STD


def identity(x: torch.Tensor) -> torch.Tensor:
    return x


def randomise(module: nn.Module) -> nn.Module:
    """Draws every parameter anew, so that neither zeros nor ones can hide a mistake."""
    with torch.no_grad():
        for parameter in module.parameters():
            parameter.normal_(0.0, 0.5)
    return module


def member(stack: MLP, index: int, alone: MLP) -> MLP:
    """Loads one member of a stack into a network built alone."""
    alone.load_state_dict({name: tensor[index] for name, tensor in stack.state_dict().items()})
    return alone


@pytest.mark.parametrize("num_members", [None, 1, 5])
@pytest.mark.parametrize("build", [EnsembleLinear, lambda *a, **k: NormedLinear(*a, activation=F.mish, **k)])
def test_every_members_weights_have_std_0_02_and_its_biases_are_zero(build, num_members):
    layer = build(200, 300, num_members=num_members)
    weights = layer.weight if num_members else layer.weight.unsqueeze(0)
    assert weights.shape == (num_members or 1, 200, 300)
    for weight in weights:
        assert weight.std().item() == pytest.approx(INIT_STD, rel=0.02)
        assert abs(weight.mean().item()) < 5 * INIT_STD / weight.numel() ** 0.5
    assert INIT_STD == 0.02
    assert layer.bias.count_nonzero() == 0


def test_members_start_with_different_weights():
    weight = EnsembleLinear(8, 8, num_members=3).weight
    for i, j in [(0, 1), (0, 2), (1, 2)]:
        assert (weight[i] != weight[j]).all()


def test_layer_norm_starts_as_the_identity():
    layer = NormedLinear(8, 16, activation=F.mish, num_members=3)
    assert torch.equal(layer.norm_weight, torch.ones(3, 16))
    assert torch.equal(layer.norm_bias, torch.zeros(3, 16))


def test_zero_init_starts_at_zero():
    layer = EnsembleLinear(8, 16, num_members=3, zero_init=True)
    assert layer.weight.count_nonzero() == layer.bias.count_nonzero() == 0


def test_a_linear_layer_equals_torchs():
    layer = randomise(EnsembleLinear(5, 7))
    x = torch.randn(2, 3, 5)
    torch.testing.assert_close(layer(x), F.linear(x, layer.weight.T, layer.bias))


@pytest.mark.parametrize("leading", [(), (3,), (2, 3)])
def test_a_stack_equals_torchs_linear_per_member(leading):
    layer = randomise(EnsembleLinear(5, 7, num_members=4))
    x = torch.randn(4, *leading, 5)
    out = layer(x)
    assert out.shape == (4, *leading, 7)
    for i in range(4):
        torch.testing.assert_close(out[i], F.linear(x[i], layer.weight[i].T, layer.bias[i]))


def test_a_normed_layer_is_linear_then_layer_norm_then_activation():
    layer = randomise(NormedLinear(5, 7, activation=F.mish))
    x = torch.randn(3, 5)
    linear = F.linear(x, layer.weight.T, layer.bias)
    expected = F.mish(F.layer_norm(linear, (7,), layer.norm_weight, layer.norm_bias))
    torch.testing.assert_close(layer(x), expected)


@pytest.mark.parametrize("leading", [(), (3,), (2, 3)])
def test_a_stacked_normed_layer_normalises_each_member_with_its_own_scale_and_shift(leading):
    layer = randomise(NormedLinear(5, 7, activation=F.silu, num_members=4))
    x = torch.randn(4, *leading, 5)
    out = layer(x)
    for i in range(4):
        linear = F.linear(x[i], layer.weight[i].T, layer.bias[i])
        expected = F.silu(F.layer_norm(linear, (7,), layer.norm_weight[i], layer.norm_bias[i]))
        torch.testing.assert_close(out[i], expected)


@pytest.mark.parametrize("num_members", [None, 3])
def test_an_empty_batch_gives_an_empty_output(num_members):
    stack = () if num_members is None else (num_members,)
    network = MLP(5, [8], 7, num_members=num_members)
    assert network(torch.zeros(*stack, 0, 5)).shape == (*stack, 0, 7)
    assert network(torch.zeros(*stack, 2, 0, 5)).shape == (*stack, 2, 0, 7)


def test_dropout_comes_before_the_layer_norm():
    layer = NormedLinear(5, 512, activation=identity, dropout=0.5)
    out = layer(torch.randn(8, 5), dropout=True)
    torch.testing.assert_close(out.mean(-1), torch.zeros(8), rtol=0, atol=1e-5)
    torch.testing.assert_close(out.var(-1, correction=0), torch.ones(8), rtol=0, atol=0.2)  # epsilon of the LayerNorm
    # Dropped outputs of the linear map are zeros, so they share one value per row after the norm.
    share = torch.stack([(row == row.mode().values).float().mean() for row in out])
    assert ((share > 0.4) & (share < 0.6)).all()


@pytest.mark.parametrize("training", [True, False])
def test_dropout_acts_only_when_asked_for_whatever_the_training_mode(training):
    network = MLP(5, [64, 64], 7, dropout=0.5).train(training)
    x = torch.randn(3, 5)
    assert torch.equal(network(x), network(x))
    assert not torch.equal(network(x, dropout=True), network(x, dropout=True))
    assert not torch.equal(network(x, dropout=True), network(x))


def test_a_dropout_of_zero_changes_nothing():
    network = MLP(5, [64], 7, dropout=0.0)
    x = torch.randn(3, 5)
    assert torch.equal(network(x, dropout=True), network(x))


def test_only_the_first_hidden_layer_drops():
    network = MLP(5, [8, 8, 8], 7, dropout=0.3, output_activation=F.mish)
    assert [layer.dropout for layer in (*network.hidden, network.output)] == [0.3, 0.0, 0.0, 0.0]


def test_dropout_is_drawn_for_each_member():
    network = MLP(5, [64], 7, num_members=2, dropout=0.5)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter[1] = parameter[0]
    x = torch.randn(3, 5).expand(2, 3, 5)
    first, second = network(x)
    torch.testing.assert_close(first, second)
    first, second = network(x, dropout=True)
    assert (first != second).all()


@pytest.mark.parametrize("output_activation", [None, F.silu])
@pytest.mark.parametrize("leading", [(), (3,), (2, 3)])
def test_a_member_of_a_stack_equals_the_same_network_built_alone(output_activation, leading):
    options = {"output_activation": output_activation, "activation": "silu"}
    stack = randomise(MLP(5, [16, 12], 7, num_members=4, **options))
    x = torch.randn(4, *leading, 5)
    out = stack(x)
    for i in range(4):
        alone = member(stack, i, MLP(5, [16, 12], 7, **options))
        torch.testing.assert_close(out[i], alone(x[i]), rtol=1e-5, atol=1e-5)


def test_members_share_nothing():
    stack = randomise(MLP(5, [16], 7, num_members=3, output_activation=F.mish))
    out = stack(torch.randn(3, 4, 5))
    for i in range(3):
        gradients = torch.autograd.grad(out[i].square().sum(), list(stack.parameters()), retain_graph=True)
        for gradient in gradients:
            for j in range(3):
                assert (gradient[j].count_nonzero() > 0) == (i == j)


@pytest.mark.parametrize(("activation", "function"), [("mish", F.mish), ("silu", F.silu), ("relu", F.relu)])
def test_an_activation_is_chosen_by_name_and_absent_from_a_linear_output(activation, function):
    network = MLP(5, [16], 7, activation=activation)
    hidden, x = network.hidden[0], torch.randn(3, 5)
    expected = function(F.layer_norm(F.linear(x, hidden.weight.T, hidden.bias), (16,)))
    expected = F.linear(expected, network.output.weight.T, network.output.bias)
    torch.testing.assert_close(network(x), expected)


def test_the_default_activation_is_mish():
    network = MLP(5, [16], 7)
    other = MLP(5, [16], 7, activation="mish")
    other.load_state_dict(network.state_dict())
    x = torch.randn(3, 5)
    assert torch.equal(network(x), other(x))


def test_an_unknown_activation_is_refused_with_the_choices():
    with pytest.raises(ValueError, match=r"^activation must be one of mish, silu, relu, got 'tanh'\.$"):
        MLP(5, [16], 7, activation="tanh")


@pytest.mark.parametrize("num_members", [None, 3])
def test_a_reset_draws_new_weights_and_restores_zeros_and_the_layer_norm(num_members):
    network = MLP(5, [16], 7, num_members=num_members, zero_init_output=True)
    before = network.hidden[0].weight.clone()
    randomise(network)
    network.reset_parameters_recursive()
    hidden, output = network.hidden[0], network.output
    assert (hidden.weight != before).all()
    assert hidden.weight.abs().max() < 0.2
    assert hidden.bias.count_nonzero() == hidden.norm_bias.count_nonzero() == 0
    assert torch.equal(hidden.norm_weight, torch.ones_like(hidden.norm_weight))
    assert output.weight.count_nonzero() == output.bias.count_nonzero() == 0


def test_a_reset_of_a_normed_output_layer_restores_its_layer_norm():
    network = randomise(MLP(5, [16], 7, output_activation=F.mish))
    network.reset_parameters_recursive()
    assert torch.equal(network.output.norm_weight, torch.ones(7))
    assert network.output.norm_bias.count_nonzero() == 0
    assert network.output.weight.std() < 0.05


def test_every_parameter_receives_a_gradient():
    stack = randomise(MLP(5, [16, 16], 7, num_members=2, output_activation=F.mish))
    stack(torch.randn(2, 4, 5)).square().sum().backward()
    for name, parameter in stack.named_parameters():
        assert parameter.grad.count_nonzero() > 0, name


def test_the_printed_layer_shows_its_sizes():
    assert "4x3x5" in repr(EnsembleLinear(3, 5, num_members=4))
