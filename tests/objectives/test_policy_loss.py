from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch.distributions import Normal, kl_divergence

from torchrl_etdmpc.objectives import distillation

pytestmark = pytest.mark.usefixtures("double_precision")

_MEAN = torch.tensor([0.9, -0.95, 0.2], dtype=torch.float64)
_STD = torch.tensor([0.4, 0.1, 1.5], dtype=torch.float64)
_RHO_MEAN = (1 + 0.5 + 0.25) / 3


def _set_plan(slices, loc, scale):
    slices["plan", "loc"] = loc.expand(*slices.shape, 3).clone()
    slices["plan", "scale"] = scale.expand(*slices.shape, 3).clone()


@pytest.mark.parametrize("kind", ["policy", "whole"])
@pytest.mark.parametrize("kl_direction", ["backward", "forward"])
def test_the_loss_and_its_gradient_equal_a_plain_reference_written_head_by_head_and_step_by_step(
    make_loss, slices, plain_errors, depth_mean, gradients, assert_same_gradients, kind, kl_direction
):
    loss = make_loss(kind, kl_direction=kl_direction, entropy_coef=0.05).eval()
    loss.kl_scale.fill_(3.0)
    errors = plain_errors(loss, slices, kl_direction=kl_direction)
    expected = depth_mean(errors["kl"] / 3.0 - 0.05 * 3 * errors["entropy"])
    actual, world_model = loss(slices)["loss_policy"], loss.world_model
    torch.testing.assert_close(actual, expected)
    assert_same_gradients(gradients(actual, world_model), gradients(expected, world_model))


@pytest.mark.parametrize("kl_direction", ["backward", "forward"])
def test_the_divergence_of_a_constant_policy_is_the_closed_form_of_its_direction(
    make_world_model, make_loss, slices, constant_policy, kl_direction
):
    world_model = make_world_model()
    constant_policy(world_model, _MEAN, _STD)
    loss = make_loss("policy", world_model, entropy_coef=0.0, kl_direction=kl_direction).eval()
    _set_plan(slices, torch.tensor([0.1, 0.3, -0.5]), torch.tensor([0.7, 0.2, 0.3]))
    pi, plan = Normal(_MEAN, _STD), Normal(torch.tensor([0.1, 0.3, -0.5]), torch.tensor([0.7, 0.2, 0.3]))
    backward, forward = kl_divergence(pi, plan).mean(), kl_divergence(plan, pi).mean()
    assert (backward - forward).abs() > 1
    expected = forward if kl_direction == "forward" else backward
    out = loss(slices)
    torch.testing.assert_close(out["policy_kl"], expected)
    torch.testing.assert_close(out["loss_policy"], _RHO_MEAN * expected)


def test_a_policy_that_equals_the_plan_pays_the_entropy_times_its_coefficient_and_a_once(
    make_world_model, make_loss, slices, constant_policy
):
    world_model = make_world_model()
    constant_policy(world_model, _MEAN, _STD)
    loss = make_loss("policy", world_model, entropy_coef=0.1).eval()
    loss.kl_scale.fill_(17.0)
    _set_plan(slices, _MEAN, _STD)
    entropy = Normal(_MEAN, _STD).entropy().sum().item()
    out = loss(slices)
    torch.testing.assert_close(out["loss_policy"].item(), -0.1 * entropy * 3 * _RHO_MEAN)
    torch.testing.assert_close(out["policy_entropy"].item(), entropy)
    torch.testing.assert_close(out["policy_kl"].item(), 0.0)


def test_the_density_is_that_of_the_unclipped_gaussian_at_the_border_of_the_box(
    make_world_model, make_loss, slices, constant_policy
):
    # Half of the mass of either Gaussian lies outside of [-1, 1]; no correction may notice.
    world_model = make_world_model()
    border = torch.tensor([0.999999, -0.999999, 0.999999])
    constant_policy(world_model, border, torch.full((3,), 2.5))
    loss = make_loss("policy", world_model, entropy_coef=0.1).eval()
    _set_plan(slices, torch.tensor([1.0, -1.0, 1.0]), torch.full((3,), 2.0))
    ratio = 2.5 / 2.0
    divergence = -math.log(ratio) + ratio**2 / 2 - 1 / 2
    entropy = 3 * (0.5 * math.log(2 * math.pi * math.e) + math.log(2.5))
    expected = _RHO_MEAN * (divergence - 0.1 * 3 * entropy)
    torch.testing.assert_close(loss(slices)["loss_policy"].item(), expected, rtol=1e-6, atol=0)


def test_distillation_detaches_the_latents_that_it_is_given(make_world_model, slices):
    latent = torch.rand(3, 2, 4, 16, requires_grad=True)
    plan = (slices["plan", key].transpose(0, 1).unsqueeze(1) for key in ("loc", "scale"))
    out = distillation(make_world_model(), latent, *plan)
    assert out.kl.shape == out.entropy.shape == (3, 2, 4)
    assert torch.autograd.grad(out.kl.sum() + out.entropy.sum(), [latent], allow_unused=True) == (None,)


def test_the_running_scale_follows_the_spread_of_the_first_steps_divergence(
    make_world_model, make_loss, make_slices, plain_errors
):
    slices = make_slices(num_slices=30)
    loss = make_loss("policy", make_world_model(num_dynamics=1), scale_tau=0.25)
    first = plain_errors(loss, slices)["kl"][:, 0].detach().numpy()
    spread = np.percentile(first, 95) - np.percentile(first, 5)
    assert spread > 2
    expected = 1.0
    for _ in range(3):
        out = loss(slices)
        expected += 0.25 * (spread - expected)
        torch.testing.assert_close(out["kl_scale"].item(), expected)
        torch.testing.assert_close(loss.kl_scale.item(), expected)


@pytest.mark.parametrize("kind", ["policy", "whole"])
def test_the_scale_that_a_call_reports_divides_the_divergence_of_that_call(make_loss, slices, plain_errors, kind):
    loss = make_loss(kind, rho=1.0, entropy_coef=0.0, scale_tau=0.5)
    kl = plain_errors(loss, slices)["kl"].mean()
    out = loss(slices)
    assert out["kl_scale"] > 1.1
    torch.testing.assert_close(out["loss_policy"], kl / out["kl_scale"])
    torch.testing.assert_close(out["policy_kl"], kl.detach())


def test_the_scale_divides_as_a_constant(make_world_model, make_loss, slices, gradients):
    world_model = make_world_model()
    loss = make_loss("policy", world_model, entropy_coef=0.0, scale_tau=1.0)
    scaled = loss(slices)
    found = gradients(scaled["loss_policy"], world_model)["policy"]
    loss.eval().kl_scale.fill_(1.0)
    plain = gradients(loss(slices)["loss_policy"], world_model)["policy"]
    assert scaled["kl_scale"] > 1.1
    for name in plain:
        torch.testing.assert_close(found[name] * scaled["kl_scale"], plain[name])


def test_the_scale_is_never_below_one(make_world_model, make_loss, slices, constant_policy):
    world_model = make_world_model()
    constant_policy(world_model, _MEAN, _STD)
    _set_plan(slices, _MEAN, _STD)  # no divergence, no spread
    loss = make_loss("policy", world_model, scale_tau=1.0)
    loss(slices)
    assert loss.kl_scale == 1


@pytest.mark.parametrize("kind", ["policy", "whole"])
def test_the_scale_moves_in_training_mode_only(make_loss, slices, kind):
    loss = make_loss(kind, scale_tau=1.0).eval()
    loss(slices)
    assert loss.kl_scale == 1
    loss.train()(slices)
    assert loss.kl_scale > 1


def test_the_scale_rests_while_distillation_is_off(make_loss, slices):
    loss = make_loss("whole", scale_tau=1.0, distill=False)
    loss(slices)
    assert loss.kl_scale == 1


def test_a_reported_scale_does_not_change_with_later_calls(make_loss, make_slices):
    loss = make_loss("policy", scale_tau=0.5)
    first = loss(make_slices())["kl_scale"]
    value = first.item()
    loss(make_slices())
    assert first.item() == value


@pytest.mark.parametrize("kind", ["policy", "whole"])
@pytest.mark.parametrize("loc", [0.0, float("nan")])
def test_a_step_without_a_plan_has_no_error_and_moves_no_scale(make_loss, make_slices, kind, loc):
    slices = make_slices(num_slices=30)
    loss = make_loss(kind, reduction="none", scale_tau=0.5)
    planned = torch.rand(slices.shape) < 0.6
    planned[:5, 0] = True
    expected = loss(slices[planned[:, 0]])["kl_scale"]
    errors = loss.eval()(slices)["loss_policy"]
    loss.train().kl_scale.fill_(1)
    for entry in slices["plan"].values():
        entry[~planned] = 0  # as a collector fills what its random policy does not write
    slices["plan", "loc"][~planned] = loc
    out = loss(slices)
    torch.testing.assert_close(out["kl_scale"], expected)
    assert not out["loss_policy"][~planned].any()
    torch.testing.assert_close(out["loss_policy"][planned], errors[planned])
    loss.kl_scale.fill_(1)
    masked = loss(slices.clone().set(("collector", "mask"), torch.ones(slices.shape, dtype=torch.bool)))
    for name in ("kl_scale", "policy_kl"):  # a mask says nothing of plans
        torch.testing.assert_close(masked[name], out[name])
    policy = [*loss.world_model.policy.parameters()]
    found = torch.autograd.grad(out["loss_policy"].sum(), policy)
    slices["plan", "loc"][~planned], slices["plan", "scale"][~planned] = 0.5, 2.0
    wanted = torch.autograd.grad(loss.eval()(slices)["loss_policy"][planned].sum(), policy)
    torch.testing.assert_close(found, wanted)


def test_a_batch_without_plans_is_a_policy_loss_of_zero(make_loss, slices):
    loss = make_loss("policy")
    _set_plan(slices, torch.zeros(3), torch.zeros(3))
    out = loss(slices)
    out["loss_policy"].backward()
    assert (out["loss_policy"], out["policy_kl"], out["kl_scale"]) == (0, 0, 1)
    assert not any(parameter.grad.any() for parameter in loss.world_model.policy.parameters())


def test_a_scale_that_is_no_number_is_not_taken_for_a_missing_plan(make_loss, slices):
    slices["plan", "scale"][0, 0, 1] = torch.nan
    assert make_loss("policy")(slices)["loss_policy"].isnan()


@pytest.mark.parametrize("scale", [0.0, -1.0])
def test_a_plan_without_a_deviation_in_one_dimension_is_none(make_loss, slices, scale):
    slices["plan", "scale"][0, 0, 1] = scale
    loss = make_loss("policy", reduction="none")(slices)["loss_policy"]
    assert loss.isfinite().all()
    assert loss[0, 0] == 0
    assert (loss != 0).sum() == loss.numel() - 1


def test_a_policy_loss_that_distils_nothing_is_empty_for_several_processes_too(
    make_loss, make_world_model, make_slices, monkeypatch
):
    loss = make_loss("policy", make_world_model())
    loss.distill = False
    monkeypatch.setattr(torch.distributed, "is_initialized", lambda: True)
    assert list(loss(make_slices()).keys()) == []
