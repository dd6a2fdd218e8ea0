from __future__ import annotations

import pytest
import torch
from torchrl.objectives import SoftUpdate

from torchrl_etdmpc.objectives import LatentRollout, imagined_value_target, td_error, value_error

pytestmark = pytest.mark.usefixtures("double_precision")


@pytest.mark.parametrize("kind", ["value", "whole"])
@pytest.mark.parametrize("termination", [False, True])
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"value_beta": 1.5},
        {"value_replayed": 1.0},
        {"value_expectile": 0.8},
        {"value_beta": 1.5, "value_replayed": 0.4, "value_expectile": 0.3},
    ],
    ids=str,
)
def test_the_loss_equals_a_plain_reference_written_head_by_head_and_step_by_step(
    make_world_model,
    make_loss,
    slices,
    run_seeded,
    plain_errors,
    depth_mean,
    kind,
    termination,
    options,
):
    loss = make_loss(kind, make_world_model(termination=termination), **options).eval()
    errors = plain_errors(loss, slices, **options)
    out = run_seeded(loss, slices)
    torch.testing.assert_close(out["value_target"], errors["value_target"].mean())
    torch.testing.assert_close(out["value_error"], errors["value"].mean().detach())  # knows neither coefficient nor rho
    torch.testing.assert_close(out["loss_value"], 0.1 * depth_mean(errors["value"]))


def test_the_gradient_is_that_of_the_plain_reference(
    make_world_model, make_loss, slices, run_seeded, plain_errors, depth_mean, gradients, assert_same_gradients
):
    world_model = make_world_model()
    loss = make_loss("value", world_model).eval()
    expected = gradients(0.1 * depth_mean(plain_errors(loss, slices)["value"]), world_model)
    actual = gradients(run_seeded(loss, slices)["loss_value"], world_model)
    assert_same_gradients(actual, expected)


def test_the_target_is_the_expected_reward_and_the_discounted_mean_over_all_heads(make_world_model):
    world_model = make_world_model(num_dynamics=3)
    latent = world_model.encode(torch.randn(7, 5))
    noise = torch.randn(7, 3)
    target = imagined_value_target(world_model, world_model.values, latent, noise, 0.9)
    mean, log_std = world_model.policy(latent)
    action = (mean + log_std.exp() * noise).clamp(-1, 1)
    values = world_model.values(world_model.next(latent.unsqueeze(0), action))
    assert values.shape == (3, 7, 2)
    torch.testing.assert_close(target, world_model.reward(latent, action) + 0.9 * values.mean((0, 2)))


def test_the_bootstrap_comes_from_the_target_heads_that_are_passed(make_world_model):
    world_model = make_world_model(num_dynamics=3)
    latent, noise = world_model.encode(torch.randn(7, 5)), torch.randn(7, 3)

    def heads_that_say_one_and_five(latent):
        return torch.tensor([1.0, 5.0]).expand(*latent.shape[:-1], 2)

    target = imagined_value_target(world_model, heads_that_say_one_and_five, latent, noise, 0.5)
    reward = world_model.reward(latent, world_model.act(latent, noise))
    torch.testing.assert_close(target, reward + 0.5 * 3.0)


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


def test_the_target_takes_the_policys_clipped_action(make_world_model):
    world_model = make_world_model()
    latent = world_model.encode(torch.randn(7, 5))
    target = imagined_value_target(world_model, world_model.values, latent, torch.full((7, 3), 1e6), 0.9)
    corner = torch.ones(7, 3)
    values = world_model.values(world_model.next(latent.unsqueeze(0), corner)).mean((0, 2))
    torch.testing.assert_close(target, world_model.reward(latent, corner) + 0.9 * values)


def test_the_target_has_no_gradient_and_asks_for_none(make_world_model):
    world_model = make_world_model()
    latent = torch.rand(7, 16, requires_grad=True)
    assert not imagined_value_target(world_model, world_model.values, latent, torch.zeros(7, 3), 0.9).requires_grad


def test_a_sure_termination_leaves_the_reward_and_a_sure_survival_the_whole_bootstrap(make_world_model):
    world_model = make_world_model(termination=True)
    latent, noise = world_model.encode(torch.randn(7, 5)), torch.randn(7, 3)
    action = world_model.act(latent, noise)
    reward = world_model.reward(latent, action)
    imagined = world_model.next(latent.unsqueeze(0), action)
    survival = 1 - world_model.termination(imagined).unsqueeze(-1)
    expected = reward + 0.9 * (survival * world_model.values(imagined)).mean((0, 2))
    torch.testing.assert_close(imagined_value_target(world_model, world_model.values, latent, noise, 0.9), expected)
    with torch.no_grad():
        world_model.termination_head.output.bias.fill_(1e4)
    torch.testing.assert_close(imagined_value_target(world_model, world_model.values, latent, noise, 0.9), reward)
    with torch.no_grad():
        world_model.termination_head.output.bias.fill_(-1e4)
    expected = reward + 0.9 * world_model.values(imagined).mean((0, 2))
    torch.testing.assert_close(imagined_value_target(world_model, world_model.values, latent, noise, 0.9), expected)


@pytest.mark.parametrize("termination", [False, True])
def test_targets_bootstrap_whatever_the_replayed_flags_say(
    make_world_model, make_loss, slices, run_seeded, termination
):
    loss = make_loss("whole", make_world_model(termination=termination)).eval()
    before = run_seeded(loss, slices)
    for flag in ("terminated", "truncated"):
        slices["next", flag] = torch.ones_like(slices["next", flag])
    after = run_seeded(loss, slices)
    assert before["value_target"] == after["value_target"]
    assert before["loss_value"] == after["loss_value"]
    if termination:
        assert before["loss_termination"] != after["loss_termination"]


@pytest.mark.parametrize("kind", ["value", "whole"])
def test_a_rollout_that_goes_astray_leaves_the_targets_alone(make_loss, slices, run_seeded, kind):
    # Replayed actions drive the rollout but no encoding: the targets must not notice them.
    loss = make_loss(kind).eval()
    before = run_seeded(loss, slices)
    slices["action"] = -slices["action"].roll(1, 0)
    after = run_seeded(loss, slices)
    assert before["value_target"] == after["value_target"]
    assert (before["loss_value"] - after["loss_value"]).abs() > 1e-6


def test_the_targets_stand_on_the_encodings_of_the_steps_own_observations(make_loss, slices, run_seeded):
    loss = make_loss("value").eval()
    before = run_seeded(loss, slices)["value_target"]
    last = slices["next", "observation"].clone()
    last[:, -1] += 1  # the encoding that the last step reaches has no target of its own
    slices["next", "observation"] = last
    assert run_seeded(loss, slices)["value_target"] == before
    earlier = last.clone()
    earlier[:, 0] += 1
    slices["next", "observation"], slices["observation"][:, 1] = earlier, earlier[:, 0]
    assert run_seeded(loss, slices)["value_target"] != before


def test_targets_come_from_the_target_heads_and_errors_from_the_online_heads(make_loss, slices, run_seeded):
    loss = make_loss("value").eval()
    before = run_seeded(loss, slices)
    with torch.no_grad():
        loss.world_model.value_head.output.bias.add_(torch.randn(2, 21))
    online = run_seeded(loss, slices)
    assert online["value_target"] == before["value_target"]
    assert online["loss_value"] != before["loss_value"]
    loss.target_value_params.data["output", "bias"].add_(torch.randn(2, 21))
    assert run_seeded(loss, slices)["value_target"] != online["value_target"]


def test_every_call_samples_new_imagined_actions_even_in_evaluation_mode(make_loss, slices):
    loss = make_loss("value").eval()
    assert loss(slices)["value_target"] != loss(slices)["value_target"]


@pytest.mark.parametrize(("bias_bin", "decoded"), [(-1, 1e30), (0, -1e30)])
def test_a_target_beyond_the_bins_is_classified_in_the_end_bin(make_world_model, bias_bin, decoded):
    world_model = make_world_model()
    predicted = world_model.encode(torch.randn(4, 2, 7, 5))
    predicted[0] = predicted[0, 0]  # both heads start from the same latent
    rollout = LatentRollout(predicted[:, 0], predicted)
    error = value_error(world_model, rollout, torch.full((3, 7), decoded), dropout=False)
    expected = -world_model.value_head(predicted[:-1]).log_softmax(-1)[..., bias_bin].mean((0, 2))
    torch.testing.assert_close(error, expected)


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


def test_step_k_counts_rho_to_the_k_with_k_from_zero(make_world_model, make_loss, make_slices, run_seeded):
    slices = make_slices(slice_len=4)
    loss = make_loss("value", rho=0.3, reduction="none").eval()
    decayed = run_seeded(loss, slices)["loss_value"]
    loss.rho.fill_(1.0)
    plain = run_seeded(loss, slices)["loss_value"]
    torch.testing.assert_close(decayed / plain, torch.tensor([1.0, 0.3, 0.09, 0.027]).expand(4, 4))


def test_the_term_is_its_error_times_its_coefficient_once(make_loss, slices):
    out = make_loss("value", rho=1.0, value_coef=7.0)(slices)
    torch.testing.assert_close(out["loss_value"].detach(), 7.0 * out["value_error"])
    assert make_loss("value", value_coef=0.0)(slices)["loss_value"] == 0


def test_the_distance_from_a_target_is_the_mean_of_each_value_s_and_not_that_of_their_mean(make_world_model):
    world_model = make_world_model()
    predicted = torch.rand(3, 2, 7, 16)
    predicted[0] = predicted[0, 0]  # all heads begin at the encoding
    rollout = LatentRollout(torch.rand(3, 7, 16), predicted)
    values = world_model.values(rollout.predicted[:-1])  # [T, F, B, V]
    target = values.mean((1, 3))  # between the values
    expected = (values - target[:, None, :, None]).abs().mean((1, 3))
    assert expected.min() > 1e-3
    torch.testing.assert_close(td_error(world_model, rollout, target), expected)


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


def test_the_online_heads_are_in_place_again_after_a_call(make_loss, slices):
    loss = make_loss("value")
    head = loss.world_model.value_head
    before = [(name, parameter, parameter.clone()) for name, parameter in head.named_parameters()]
    loss(slices)
    after = list(head.named_parameters())
    assert len(before) == len(after)
    for (name, parameter, value), (name_after, parameter_after) in zip(before, after, strict=True):
        assert name == name_after
        assert parameter is parameter_after
        assert torch.equal(parameter, value)


def test_steps_without_dynamics_send_the_value_error_to_the_encoder_alone(make_loss, make_slices, gradients):
    loss = make_loss("value")
    found = gradients(loss(make_slices(slice_len=1))["loss_value"], loss.world_model)
    assert all(gradient is None or not gradient.any() for gradient in found["dynamics"].values())
    assert all(gradient.any() for gradient in found["encoder"].values())
