"""How to add a term to the loss that needs no network of its own: one function in one file, and one line."""

from __future__ import annotations

import copy

import pytest
import torch
from torch import Tensor

from torchrl_etdmpc import EfficientTDMPCLoss, WorldModel
from torchrl_etdmpc.objectives import ExtraTerm, LatentRollout, Slices, latent_rollout
from torchrl_etdmpc.testing import random_slices
from torchrl_etdmpc.training import Updater


# The file:
def full_throttle(world_model: WorldModel, slices: Slices, rollout: LatentRollout) -> Tensor:
    """How far the policy's mean is from an action of 1 in every dimension, ``[T, B]``."""
    mean, _ = world_model.policy(rollout.encoded[:-1])
    return (mean - 1).square().mean(-1)


def test_a_new_loss_term_without_a_network_is_one_file_and_one_line(make_world_model):
    world_model = make_world_model()
    usual = copy.deepcopy(world_model)
    term = {"full_throttle": ExtraTerm(full_throttle, coef=1.0)}
    loss = EfficientTDMPCLoss(world_model, discount=0.9, extra_terms=term)  # the line

    updater, plain = Updater(loss, lr=3e-3), Updater(EfficientTDMPCLoss(usual, discount=0.9), lr=3e-3)
    for _ in range(30):
        batch = random_slices(5, 3, num_slices=8)
        out = updater.step(batch)
        assert out["loss_full_throttle"].isfinite()
        assert "loss_full_throttle" not in plain.step(batch).keys()
    loss.eval(), plain.loss.eval()
    slices = loss.slices(random_slices(5, 3, num_slices=64))
    ours, theirs = (
        full_throttle(model, slices, latent_rollout(model, slices)).mean() for model in (world_model, usual)
    )
    assert ours < 0.5 * theirs  # the updates make the term smaller


def test_the_term_is_weighted_once_and_decays_with_the_step(make_loss, world_model, slices):
    def ones(world_model, slices, rollout):
        return torch.ones_like(slices.reward)

    loss = make_loss("whole", world_model, extra_terms={"ones": ExtraTerm(ones, 3.0)}, rho=0.5)
    out = loss(slices)
    assert out["loss_ones"].item() == pytest.approx(3 * (1 + 0.5 + 0.25) / 3)
    assert out["ones_error"].item() == 1
    assert list(out.keys()) == loss.out_keys
    loss.ones_coef.fill_(6.0)
    assert loss(slices)["loss_ones"].item() == pytest.approx(2 * out["loss_ones"].item())
    assert "ones_coef" in loss.state_dict()
    unreduced = make_loss("whole", world_model, extra_terms={"ones": ExtraTerm(ones, 3.0)}, reduction="none")
    assert unreduced(slices)["loss_ones"].shape == slices.batch_size


def test_the_other_terms_stay_as_they_are_to_the_last_bit(make_loss, world_model, slices, run_seeded):
    loss = make_loss("whole", world_model, extra_terms={"full_throttle": ExtraTerm(full_throttle, 1.0)})
    plain = make_loss("whole", world_model, updater=False)
    plain.load_state_dict(loss.state_dict(), strict=False)
    loss.eval(), plain.eval()
    out = run_seeded(loss, slices)
    with pytest.warns(UserWarning, match="No target network updater"):
        expected = run_seeded(plain, slices)
    for key, value in expected.items():
        assert torch.equal(out[key], value), key


def test_the_gradient_goes_where_the_term_sends_it(make_loss, world_model, slices, gradients):
    loss = make_loss("whole", world_model, extra_terms={"full_throttle": ExtraTerm(full_throttle, 1.0)})
    found = gradients(loss(slices)["loss_full_throttle"], world_model)
    trained = {name for name, parameters in found.items() if any(g is not None for g in parameters.values())}
    assert trained == {"policy"}


# tensordict reads a switch that torch deprecates
@pytest.mark.filterwarnings("ignore:torch._dynamo.config.inline_inbuilt_nn_modules:FutureWarning")
def test_the_term_is_part_of_the_one_compiled_graph(make_loss, make_world_model, slices, gradients):
    world_model = make_world_model(termination=True, dropout=0.0)
    loss = make_loss("whole", world_model, extra_terms={"full_throttle": ExtraTerm(full_throttle, 2.0)})
    torch.compiler.reset()
    compiled = torch.compile(loss.evaluate, fullgraph=True, backend="eager")
    inputs = loss.slices(slices), loss.target_values()
    torch.manual_seed(0)
    expected = loss.evaluate(*inputs)
    torch.manual_seed(0)
    actual = compiled(*inputs)
    assert actual.keys() == expected.keys()
    torch.testing.assert_close(actual["loss_full_throttle"], expected["loss_full_throttle"])
    ours, theirs = (gradients(out["loss_full_throttle"], world_model) for out in (actual, expected))
    torch.testing.assert_close(ours["policy"], theirs["policy"])


def test_a_copied_loss_calls_the_term_with_its_own_world_model(make_loss, world_model, slices):
    def bias(world_model, slices, rollout):
        return world_model.dynamics.output.bias.sum() + torch.zeros_like(slices.reward)

    loss = make_loss("whole", world_model, extra_terms={"bias": ExtraTerm(bias, 1.0)})
    other = copy.deepcopy(loss)
    with torch.no_grad():
        other.world_model.dynamics.output.bias.add_(1)
    assert other(slices)["bias_error"] > loss(slices)["bias_error"] + 1


@pytest.mark.parametrize("name", ["value", "consistency", "policy", "entropy", "termination"])
def test_a_name_that_is_taken_is_refused(make_loss, name):
    with pytest.raises(
        ValueError, match=rf"^extra_terms must have names of their own, got '{name}'; choose another one\.$"
    ):
        make_loss("whole", extra_terms={name: ExtraTerm(full_throttle, 1.0)})


def test_a_term_without_its_coefficient_is_refused(make_loss):
    with pytest.raises(TypeError, match=r"^extra_terms must be of type ExtraTerm\(function, coef\), got <function"):
        make_loss("whole", extra_terms={"full_throttle": full_throttle})


def test_a_term_of_another_shape_is_answered_with_the_right_one(make_loss, slices):
    loss = make_loss("whole", extra_terms={"scalar": ExtraTerm(lambda *inputs: inputs[1].reward.mean(), 1.0)})
    with pytest.raises(
        ValueError, match=r"^extra_terms\['scalar'\] must return an error of shape \[T, B\]=\[3, 4\], got \[\]\.$"
    ):
        loss(slices)
