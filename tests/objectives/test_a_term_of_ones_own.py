"""How to add a term to the loss, with and without a network of its own: one file, and one line."""

from __future__ import annotations

import copy
import inspect

import pytest
import torch
from torch import Tensor, nn
from torchrl.objectives import SoftUpdate

from torchrl_etdmpc import EfficientTDMPCLoss, WorldModel
from torchrl_etdmpc.modules import ActionValueWorldModel
from torchrl_etdmpc.objectives import (
    LatentRollout,
    LatentRolloutLoss,
    Slices,
    TDMPC2Loss,
    Term,
    latent_rollout,
)
from torchrl_etdmpc.testing import random_slices
from torchrl_etdmpc.training import Updater


# The file:
def full_throttle(world_model: WorldModel, slices: Slices, rollout: LatentRollout) -> Tensor:
    """How far the policy's mean is from an action of 1 in every dimension, ``[T, B]``."""
    mean, _ = world_model.policy(rollout.encoded[:-1])
    return (mean - 1).square().mean(-1)


# The file:
class Reconstruction(nn.Module):
    """Squared error of the next observation as a new network reads it from the predicted latents, ``[T, B]``."""

    def __init__(self, latent_dim: int, observation_dim: int) -> None:
        super().__init__()
        self.decoder = nn.Linear(latent_dim, observation_dim)

    def forward(self, world_model: WorldModel, slices: Slices, rollout: LatentRollout) -> Tensor:
        predicted = self.decoder(rollout.predicted[1:])  # [T, F, B, O]
        return (predicted - slices.next_observation.unsqueeze(1)).square().mean((1, -1))


def test_a_new_loss_term_with_a_network_is_one_file_and_one_line(make_world_model):
    world_model = make_world_model()
    term = Term("reconstruction", Reconstruction(16, 5), coef=2.0)
    loss = EfficientTDMPCLoss(world_model, discount=0.9, extra_terms=[term])  # the line

    updater, batch = Updater(loss, lr=1e-2), random_slices(5, 3, num_slices=8)
    errors = [updater.step(batch)["reconstruction_error"].item() for _ in range(60)]
    assert errors[-1] < 0.8 * errors[0]
    decoder = term.function.decoder
    assert any(parameter is decoder.weight for parameter in loss.parameters())
    assert updater.optimizer.param_groups[1]["params"]
    frozen = decoder.weight.clone()
    updater.step(batch)
    assert not torch.equal(decoder.weight, frozen)  # the decoder itself moves, not only what it reads


def test_the_recipes_are_short():
    def lines(recipe) -> int:
        return len([line for line in inspect.getsource(recipe).splitlines() if line.strip()])

    assert lines(full_throttle) + 2 <= 10
    assert lines(Reconstruction) + 2 <= 20


@pytest.fixture
def with_decoder(make_loss, world_model):
    """The whole loss with a term that brings a network."""
    return make_loss("whole", world_model, extra_terms=[Term("reconstruction", Reconstruction(16, 5))])


def test_a_term_s_network_is_saved_moved_cast_and_put_into_the_mode_of_the_loss(
    with_decoder, make_loss, make_world_model, slices, run_seeded, assert_same_output
):
    other = make_loss(
        "whole", make_world_model(termination=True), extra_terms=[Term("reconstruction", Reconstruction(16, 5))]
    )
    keys = other.load_state_dict(with_decoder.state_dict())
    assert not keys.missing_keys and not keys.unexpected_keys
    assert "reconstruction.decoder.weight" in with_decoder.state_dict()
    assert_same_output(run_seeded(other.eval(), slices), run_seeded(with_decoder.eval(), slices), rtol=0, atol=0)
    assert not with_decoder.reconstruction.training
    other.double()
    assert other(slices.to(torch.float64))["loss_reconstruction"].dtype == torch.float64


def test_a_copy_of_the_loss_has_a_copy_of_the_term_s_network(with_decoder, slices, run_seeded):
    other = copy.deepcopy(with_decoder.eval())
    assert torch.equal(run_seeded(other, slices)["loss_value"], run_seeded(with_decoder, slices)["loss_value"])
    with torch.no_grad():
        other.reconstruction.decoder.bias.add_(100)
    assert other(slices)["reconstruction_error"] > 100 * with_decoder(slices)["reconstruction_error"]
    assert {id(p) for p in other.parameters()}.isdisjoint(id(p) for p in with_decoder.parameters())


def test_a_copy_of_the_loss_reads_its_own_numbers(make_loss, world_model, slices, run_seeded):
    loss = make_loss("whole", world_model, scale_tau=1.0)
    other = copy.deepcopy(loss)
    other(slices)
    assert loss.kl_scale == 1
    assert other.kl_scale > 1
    other.discount = 0.0
    assert run_seeded(other.eval(), slices)["value_target"] != run_seeded(loss.eval(), slices)["value_target"]


def test_a_reset_draws_new_weights_for_the_term_s_network(with_decoder):
    weight = with_decoder.reconstruction.decoder.weight
    with torch.no_grad():
        weight.fill_(1000)
    with_decoder.reset_parameters_recursive()
    assert weight is with_decoder.reconstruction.decoder.weight and weight.abs().max() < 1


def test_torchrl_s_target_update_leaves_the_term_s_network_alone(with_decoder, slices, total):
    update, weight = SoftUpdate(with_decoder, tau=0.5), with_decoder.reconstruction.decoder.weight
    total(with_decoder(slices)).backward()
    assert weight.grad.any()
    before = weight.clone()
    update.step()
    assert torch.equal(weight, before) and list(with_decoder.targets()) == ["value"]


def test_a_term_reads_keys_of_its_own(make_loss, world_model, slices):
    def brightness(world_model, slices, rollout):
        return slices.extra["next", "pixels"].mean((-3, -2, -1))

    loss = make_loss("whole", world_model, extra_terms=[Term("brightness", brightness, keys=(("next", "pixels"),))])
    assert ("next", "pixels") in loss.in_keys
    with pytest.raises(KeyError, match=r"needs the key \('next', 'pixels'\) in its input; rename it with Term\(keys="):
        loss(slices)
    slices["next", "pixels"] = torch.rand(4, 3, 3, 8, 8)
    assert loss(slices)["brightness_error"] == slices["next", "pixels"].mean()
    slices["collector", "mask"] = torch.tensor([[True, False, False]]).expand(4, 3)
    slices["next", "pixels"][:, 1:] = torch.nan
    torch.testing.assert_close(loss(slices)["brightness_error"], slices["next", "pixels"][:, 0].mean())


def test_a_loss_is_its_list_of_terms(make_world_model, slices, run_seeded):
    whole = EfficientTDMPCLoss(make_world_model(), discount=0.9, ignore_termination=True).eval()
    assert [term.name for term in whole.terms] == ["consistency", "reward", "value", "policy"]
    model_only = LatentRolloutLoss(whole.world_model, whole.terms[:2]).eval()
    assert model_only.out_keys == ["loss_consistency", "loss_reward", "consistency_error", "reward_error"]
    assert run_seeded(model_only, slices)["loss_reward"] == model_only(slices)["loss_reward"]
    assert {name for name, _ in model_only.named_children()} == {"encoder_params", "dynamics_params", "reward_params"}


def test_a_new_loss_term_without_a_network_is_one_file_and_one_line(make_world_model):
    world_model = make_world_model()
    usual = copy.deepcopy(world_model)
    term = Term("full_throttle", full_throttle, coef=1.0)
    loss = EfficientTDMPCLoss(world_model, discount=0.9, extra_terms=[term])  # the line

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

    loss = make_loss("whole", world_model, extra_terms=[Term("ones", ones, 3.0)], rho=0.5)
    out = loss(slices)
    assert out["loss_ones"].item() == pytest.approx(3 * (1 + 0.5 + 0.25) / 3)
    assert out["ones_error"].item() == 1
    assert list(out.keys()) == loss.out_keys
    loss.ones_coef.fill_(6.0)
    assert loss(slices)["loss_ones"].item() == pytest.approx(2 * out["loss_ones"].item())
    loss.ones_coef = 9.0
    assert loss(slices)["loss_ones"].item() == pytest.approx(3 * out["loss_ones"].item())
    assert "ones_coef" in loss.state_dict()
    unreduced = make_loss("whole", world_model, extra_terms=[Term("ones", ones, 3.0)], reduction="none")
    assert unreduced(slices)["loss_ones"].shape == slices.batch_size


def test_the_other_terms_stay_as_they_are_to_the_last_bit(make_loss, world_model, slices, run_seeded):
    loss = make_loss("whole", world_model, extra_terms=[Term("full_throttle", full_throttle, 1.0)])
    plain = make_loss("whole", world_model, updater=False)
    plain.load_state_dict(loss.state_dict(), strict=False)
    loss.eval(), plain.eval()
    out = run_seeded(loss, slices)
    with pytest.warns(UserWarning, match="No target network updater"):
        expected = run_seeded(plain, slices)
    for key, value in expected.items():
        assert torch.equal(out[key], value), key


def test_the_gradient_goes_where_the_term_sends_it(make_loss, world_model, slices, gradients):
    loss = make_loss("whole", world_model, extra_terms=[Term("full_throttle", full_throttle, 1.0)])
    found = gradients(loss(slices)["loss_full_throttle"], world_model)
    trained = {name for name, parameters in found.items() if any(g is not None for g in parameters.values())}
    assert trained == {"policy"}


def test_a_copied_loss_calls_the_term_with_its_own_world_model(make_loss, world_model, slices):
    def bias(world_model, slices, rollout):
        return world_model.dynamics.output.bias.sum() + torch.zeros_like(slices.reward)

    loss = make_loss("whole", world_model, extra_terms=[Term("bias", bias, 1.0)])
    other = copy.deepcopy(loss)
    with torch.no_grad():
        other.world_model.dynamics.output.bias.add_(1)
    assert other(slices)["bias_error"] > loss(slices)["bias_error"] + 1


@pytest.mark.parametrize("name", ["value", "consistency", "policy", "entropy", "termination"])
def test_a_name_that_is_taken_is_refused(make_loss, name):
    with pytest.raises(
        ValueError, match=rf"^extra_terms must have names of their own, got '{name}'; choose another one\.$"
    ):
        make_loss("whole", extra_terms=[Term(name, full_throttle, 1.0)])


def test_a_metric_or_a_number_that_is_taken_is_refused(make_loss):
    for further in ({"metrics": ("value_target",)}, {"scalars": {"discount": 0.5}}):
        with pytest.raises(ValueError, match="names of their own, got '(value_target|discount)' of the term 'mine'"):
            make_loss("whole", extra_terms=[Term("mine", full_throttle, **further)])


def test_a_function_alone_is_refused(make_loss):
    with pytest.raises(TypeError, match=r"^extra_terms must be a list of Term\(name, function, coef\), got <function"):
        make_loss("whole", extra_terms=[full_throttle])


def test_metrics_other_than_the_named_ones_are_refused(make_loss, slices):
    def named(world_model, slices, rollout):
        return torch.zeros_like(slices.reward), {"norm": slices.reward}

    loss = make_loss("whole", extra_terms=[Term("mine", named)])
    with pytest.raises(
        ValueError, match=r"must return the metrics \['mine_error'\], got \['mine_error', 'norm'\]; name"
    ):
        loss(slices)
    loss = make_loss("whole", extra_terms=[Term("mine", named, metrics=("norm", "mine_error"))])
    torch.testing.assert_close(loss(slices)["norm"], slices["next", "reward"].mean())
    assert list(loss(slices).keys()) == loss.out_keys


def test_a_term_of_another_shape_is_answered_with_the_right_one(make_loss, slices):
    loss = make_loss("whole", extra_terms=[Term("scalar", lambda *inputs: inputs[1].reward.mean())])
    with pytest.raises(
        ValueError, match=r"^the term 'scalar' must return an error of shape \[T, B\]=\[3, 4\], got \[\]\.$"
    ):
        loss(slices)


@pytest.mark.parametrize(
    ("metric", "kind"), [(lambda error: error > 0, "torch.bool"), (lambda error: 3.0, "float")], ids=["bool", "number"]
)
def test_a_metric_that_has_no_mean_is_refused(make_loss, slices, metric, kind):
    def term(world_model, slices, rollout):
        error = slices.action.square().mean(-1)
        return error, {"seen": metric(error)}

    loss = make_loss("whole", extra_terms=[Term("mine", term, metrics=("mine_error", "seen"))])
    with pytest.raises(ValueError, match=f"the metric 'seen' of the term 'mine' must be a floating .* got {kind};"):
        loss(slices)


def test_a_metric_of_another_shape_is_refused_with_a_mask_and_without(make_loss, slices):
    def term(world_model, slices, rollout):
        error = slices.action.square().mean(-1)
        return error, {"seen": error.expand(5, *error.shape)}  # a head first

    loss = make_loss("whole", extra_terms=[Term("mine", term, metrics=("mine_error", "seen"))])
    for masked in (slices, slices.clone().set(("collector", "mask"), torch.ones(4, 3, dtype=torch.bool))):
        with pytest.raises(
            ValueError,
            match=r"the metric 'seen' of .* must be of shape \[T, B\]=\[3, 4\] or a scalar, got \[5, 3",
        ):
            loss(masked)


@pytest.mark.parametrize("name", ["rho", "scale_tau", "kl_direction"])
def test_a_scalar_cannot_have_the_name_of_the_loss_s_own(world_model, name):
    with pytest.raises(ValueError, match=f"metrics and scalars must have names of their own, got '{name}'"):
        EfficientTDMPCLoss(world_model, discount=0.99, extra_terms=[Term("mine", lambda *_: None, scalars={name: 0.3})])


@pytest.mark.parametrize("coef", [float("nan"), float("inf")])
def test_a_coefficient_that_is_not_finite_is_refused(world_model, coef):
    with pytest.raises(ValueError, match=f"reward_coef must be finite, got {coef}"):
        EfficientTDMPCLoss(world_model, discount=0.99, reward_coef=coef)


@pytest.mark.parametrize("name", ["loss_mine", "loss_value", "loss_other"])
def test_a_metric_cannot_take_the_place_of_a_loss(make_loss, name):
    with pytest.raises(ValueError, match=f"must have names of their own, got '{name}' of the term 'mine'"):
        make_loss("whole", extra_terms=[Term("mine", full_throttle, metrics=(name,))])


@pytest.mark.parametrize("name", ["target_mine", "value_params", "world_model", "terms", "forward"])
def test_a_term_is_not_called_like_a_part_of_the_loss(make_loss, name):
    with pytest.raises(ValueError, match=f"^extra_terms must have names of their own, got '{name}'; choose"):
        make_loss("whole", extra_terms=[Term(name, Reconstruction(16, 5))])


def test_the_own_terms_of_a_loss_are_looked_at_like_extra_ones(world_model):
    twice = [Term("mine", full_throttle), Term("mine", full_throttle, coef=2.0)]
    with pytest.raises(ValueError, match=r"^terms must have names of their own, got 'mine'; choose another one\.$"):
        LatentRolloutLoss(world_model, twice)
    shared = [Term("mine", full_throttle), Term("other", full_throttle, metrics=("mine_error",))]
    with pytest.raises(ValueError, match="names of their own, got 'mine_error' of the term 'other'"):
        LatentRolloutLoss(world_model, shared)
    with pytest.raises(ValueError, match="^terms must have names of their own, got 'value'"):
        LatentRolloutLoss(world_model, [Term("value", Reconstruction(16, 5))])
    with pytest.raises(TypeError, match=r"^terms must be a list of Term\(name, function, coef\), got <function"):
        LatentRolloutLoss(world_model, [full_throttle])
    reward = Term("reward", full_throttle, networks=("encoder", "policy"))
    assert LatentRolloutLoss(world_model, [reward])(random_slices(5, 3))["loss_reward"] > 0


@pytest.mark.parametrize(
    ("named", "message"),
    [
        ({"networks": ("encoder", "dynamic")}, "networks of the term 'mine' must be some of encoder, .* got 'dynamic'"),
        ({"networks": "encoder"}, r"networks of the term 'mine' must be a tuple of names, .* write \('encoder',\)"),
        ({"targets": ("valu",)}, "targets of the term 'mine' must be some of encoder, .*, got 'valu'"),
        ({"targets": ("policy",)}, "the target 'policy' of the term 'mine' is of a network that no term trains"),
        ({"keys": "bonus"}, r"keys of the term 'mine' must be a tuple of names, got 'bonus'; write \('bonus',\)"),
        ({"metrics": "norm"}, "metrics of the term 'mine' must be a tuple of names, got 'norm'"),
    ],
)
def test_a_network_or_a_key_that_is_not_there_is_refused(world_model, named, message):
    with pytest.raises(ValueError, match=f"^{message}"):
        LatentRolloutLoss(world_model, [Term("mine", full_throttle, **named)])


@pytest.mark.parametrize("name", ["consistency", "reward", "value", "policy", "entropy"])
def test_a_coefficient_of_the_method_is_not_negative(world_model, name):
    with_actions = ActionValueWorldModel(5, 3, latent_dim=16, mlp_dim=16)
    for kind, model in ((EfficientTDMPCLoss, world_model), (TDMPC2Loss, with_actions)):
        with pytest.raises(ValueError, match=rf"^{name}_coef must not be negative, got -1\.0; 0 leaves"):
            kind(model, discount=0.99, **{f"{name}_coef": -1.0})


def test_a_metric_cannot_be_called_as_the_priorities_are(make_world_model):
    term = Term("mine", lambda world_model, slices, rollout: slices.reward, metrics=("priority",))
    with pytest.raises(ValueError, match=r"^metrics and scalars must have names of their own, got 'priority'"):
        EfficientTDMPCLoss(make_world_model(), discount=0.99, extra_terms=[term])
