from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F
from torch import nn

from torchrl_etdmpc.modules import MLP, EnsembleLinear, NormedLinear


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


def test_a_dropout_of_zero_changes_nothing():
    network = MLP(5, [64], 7, dropout=0.0)
    x = torch.randn(3, 5)
    assert torch.equal(network(x, dropout=True), network(x))


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


def test_the_printed_layer_shows_its_sizes():
    assert "4x3x5" in repr(EnsembleLinear(3, 5, num_members=4))
