from __future__ import annotations

import pytest
import torch

from torchrl_etdmpc.modules import WorldModel

O, A, L = 5, 2, 16  # noqa: E741


def test_every_weight_of_every_member_has_std_0_02_but_the_zero_outputs_of_reward_and_value():
    model = WorldModel(64, 64, latent_dim=128, mlp_dim=128, encoder_dim=64, num_dynamics=3, termination=True)
    zero = {"reward_head.output.weight", "value_head.output.weight"}
    weights = {name: w for name, w in model.named_parameters() if name.endswith(".weight")}
    assert zero < weights.keys()
    assert len(weights) == 2 + 5 * 3
    for name, weight in weights.items():
        for member in weight if weight.ndim == 3 else weight.unsqueeze(0):
            expected = 0.0 if name in zero else 0.02
            # Four standard errors of a sample standard deviation.
            tolerance = 4 / (2 * member.numel()) ** 0.5
            assert member.std().item() == pytest.approx(expected, rel=tolerance), name


def test_every_bias_starts_at_zero_and_every_layer_norm_as_the_identity(build):
    for name, parameter in build(termination=True).named_parameters():
        if name.endswith("bias"):
            assert parameter.count_nonzero() == 0, name
        elif name.endswith("norm_weight"):
            assert (parameter == 1).all(), name


def test_a_new_model_predicts_no_reward_and_no_value(build):
    model = build()
    latent, action = model.encode(torch.randn(7, O)), torch.rand(7, A)
    assert model.reward_head(latent, action).count_nonzero() == 0
    assert model.value_head(latent).count_nonzero() == 0
    # The decoded bins cancel up to rounding.
    torch.testing.assert_close(model.reward(latent, action), torch.zeros(7), rtol=0, atol=1e-6)
    torch.testing.assert_close(model.values(latent), torch.zeros(7, 2), rtol=0, atol=1e-6)


def test_dynamics_heads_start_different(build):
    model = build(num_dynamics=4)
    latent = model.next(model.encode(torch.randn(7, O)).unsqueeze(0), torch.rand(7, A))
    for i in range(4):
        for j in range(i):
            assert (latent[i] != latent[j]).any()


def test_the_default_sizes_are_the_papers():
    model = WorldModel(24, 6)
    assert (model.latent_dim, model.num_dynamics, model.num_values, model.bins.shape) == (512, 4, 2, (101,))
    assert (model.bins[0], model.bins[-1]) == (-10, 10)
    shapes = {name: tuple(p.shape) for name, p in model.named_parameters() if name.endswith(".weight")}
    assert shapes == {
        "encoder.hidden.0.weight": (24, 256),
        "encoder.output.weight": (256, 512),
        "dynamics.hidden.0.weight": (4, 518, 512),
        "dynamics.hidden.1.weight": (4, 512, 512),
        "dynamics.output.weight": (4, 512, 512),
        "reward_head.hidden.0.weight": (518, 512),
        "reward_head.hidden.1.weight": (512, 512),
        "reward_head.output.weight": (512, 101),
        "value_head.hidden.0.weight": (2, 512, 512),
        "value_head.hidden.1.weight": (2, 512, 512),
        "value_head.output.weight": (2, 512, 101),
        "policy.hidden.0.weight": (512, 512),
        "policy.hidden.1.weight": (512, 512),
        "policy.output.weight": (512, 12),
    }
    assert [layer.dropout for layer in model.value_head.hidden] == [0.01, 0.0]
    assert model.policy.log_std_bounds == (-3.0, 1.0)
