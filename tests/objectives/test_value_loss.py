from __future__ import annotations

import pytest
import torch
from torchrl.objectives import SoftUpdate

from torchrl_etdmpc.objectives import imagined_value_target

pytestmark = pytest.mark.usefixtures("double_precision")


@pytest.mark.parametrize("kind", ["value", "whole"])
@pytest.mark.parametrize("termination", [False, True])
@pytest.mark.parametrize("options", [{}, {"value_beta": 1.5, "value_replayed": 0.4, "value_expectile": 0.3}], ids=str)
def test_the_loss_and_its_gradient_equal_a_plain_reference_written_head_by_head_and_step_by_step(
    make_world_model,
    make_loss,
    slices,
    run_seeded,
    plain_errors,
    depth_mean,
    gradients,
    assert_same_gradients,
    kind,
    termination,
    options,
):
    loss = make_loss(kind, make_world_model(termination=termination), **options).eval()
    errors = plain_errors(loss, slices, **options)
    out = run_seeded(loss, slices)
    torch.testing.assert_close(out["value_target"], errors["value_target"].mean())
    torch.testing.assert_close(out["value_error"], errors["value"].mean().detach())  # knows neither coefficient nor rho
    expected = 0.1 * depth_mean(errors["value"])
    torch.testing.assert_close(out["loss_value"], expected)
    world_model = loss.world_model
    assert_same_gradients(gradients(out["loss_value"], world_model), gradients(expected, world_model))


def test_a_beta_of_one_bootstraps_from_the_lesser_of_two_heads(make_world_model):
    world_model = make_world_model(num_dynamics=1)
    latent, noise = world_model.encode(torch.randn(7, 5)), torch.randn(7, 3)
    action = world_model.act(latent, noise)
    lesser = world_model.values(world_model.next(latent.unsqueeze(0), action)).amin((0, 2))
    target = imagined_value_target(world_model, world_model.values, latent, noise, 0.9, beta=1.0)
    torch.testing.assert_close(target, world_model.reward(latent, action) + 0.9 * lesser)


def test_a_single_head_has_no_spread_to_be_pessimistic_about(make_world_model):
    world_model = make_world_model(num_dynamics=1, num_values=1)
    latent, noise = world_model.encode(torch.randn(7, 5)), torch.randn(7, 3)
    plain, pessimistic = (
        imagined_value_target(world_model, world_model.values, latent, noise, 0.9, beta=beta) for beta in (0.0, 10.0)
    )
    assert torch.equal(plain, pessimistic)


def test_every_call_samples_new_imagined_actions_even_in_evaluation_mode(make_loss, slices):
    loss = make_loss("value").eval()
    assert loss(slices)["value_target"] != loss(slices)["value_target"]


def test_dropout_touches_the_online_heads_in_training_mode_only(make_world_model, make_loss, slices, run_seeded):
    world_model = make_world_model(dropout=0.5)
    loss = make_loss("whole", world_model)
    world_model.eval()  # the mode of the loss decides
    training = run_seeded(loss, slices)
    world_model.train()
    evaluation = run_seeded(loss.eval(), slices)
    assert training["value_error"] != evaluation["value_error"]
    assert training["value_target"] == evaluation["value_target"]
    for term in ("loss_consistency", "loss_reward"):
        assert training[term] == evaluation[term]
    without = make_loss("value", make_world_model(dropout=0.0))
    assert run_seeded(without, slices)["value_error"] == run_seeded(without.eval(), slices)["value_error"]


@pytest.mark.parametrize("kind", ["value", "whole"])
def test_the_updater_moves_the_targets_by_exactly_tau(make_loss, kind):
    loss = make_loss(kind, updater=False)
    updater = SoftUpdate(loss, tau=0.1)
    source, target = loss.value_params, loss.target_value_params
    assert all((target[key] == source[key]).all() for key in source.keys(True, True))
    before = target.clone()
    with torch.no_grad():
        for parameter in loss.world_model.value_head.parameters():
            parameter.add_(torch.randn_like(parameter))
    updater.step()
    for key in source.keys(True, True):
        torch.testing.assert_close(target[key], before[key] + 0.1 * (source[key].data - before[key]))
        assert not torch.equal(target[key], before[key])


@pytest.mark.parametrize("kind", ["value", "whole"])
def test_the_targets_never_ask_for_a_gradient_not_even_after_use(make_loss, slices, kind):
    loss = make_loss(kind)
    sum(value for key, value in loss(slices).items() if key.startswith("loss_")).backward()
    targets = list(loss.target_value_params.values(True, True))
    assert len(targets) == len(list(loss.world_model.value_head.parameters()))
    assert not any(target.requires_grad or target.grad is not None for target in targets)
    assert {id(target) for target in targets} == {id(buffer) for buffer in loss.target_value_params.buffers()}


def test_an_updater_can_be_built_after_the_first_call(make_loss, slices):
    loss = make_loss("value", updater=False)
    with pytest.warns(UserWarning, match="No target network updater"):
        loss(slices)
    SoftUpdate(loss, tau=0.01).step()
    loss(slices)
