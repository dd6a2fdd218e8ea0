from __future__ import annotations

import pytest
import torch

from torchrl_etdmpc.objectives import LatentRollout, Slices, consistency_error, latent_rollout

pytestmark = pytest.mark.usefixtures("double_precision")


def _time_first(slices) -> Slices:
    return Slices(
        observation=slices["observation"][:, 0],
        next_observation=slices["next", "observation"].transpose(0, 1),
        action=slices["action"].transpose(0, 1),
        reward=slices["next", "reward"].transpose(0, 1).squeeze(-1),
        terminated=slices["next", "terminated"].transpose(0, 1).squeeze(-1),
        plan_loc=None,
        plan_scale=None,
    )


def test_the_terms_equal_a_plain_reference_written_head_by_head_and_step_by_step(
    make_world_model, make_loss, slices, plain_errors, depth_mean
):
    loss = make_loss("model", make_world_model(termination=True))
    errors = plain_errors(loss, slices)
    out = loss(slices)
    torch.testing.assert_close(out["loss_consistency"], 20 * depth_mean(errors["consistency"]))
    torch.testing.assert_close(out["loss_reward"], 0.1 * depth_mean(errors["reward"]))
    torch.testing.assert_close(out["loss_termination"], errors["termination"].mean())
    for term in ("consistency", "reward", "termination"):  # the metrics know neither coefficient nor rho
        torch.testing.assert_close(out[f"{term}_error"], errors[term].mean().detach())


@pytest.mark.parametrize(
    ("term", "coefficient", "rho"), [("consistency", 20, 0.5), ("reward", 0.1, 0.5), ("termination", 1, 1.0)]
)
def test_the_gradient_of_each_term_is_that_of_the_plain_reference(
    make_world_model,
    make_loss,
    slices,
    plain_errors,
    depth_mean,
    gradients,
    assert_same_gradients,
    term,
    coefficient,
    rho,
):
    world_model = make_world_model(termination=True)
    loss = make_loss("model", world_model)
    expected = gradients(coefficient * depth_mean(plain_errors(loss, slices)[term], rho), world_model)
    actual = gradients(loss(slices)[f"loss_{term}"], world_model)
    assert_same_gradients(actual, expected)


@pytest.mark.parametrize("term", ["consistency", "reward", "value", "termination"])
def test_what_one_head_learns_does_not_depend_on_any_other_head(
    make_world_model, make_loss, slices, gradients, run_seeded, term
):
    world_model = make_world_model(termination=True, num_dynamics=3)
    loss = make_loss("whole", world_model).eval()
    loss.discount = 0.0  # value targets average the heads: leave them the reward alone
    before = gradients(run_seeded(loss, slices)[f"loss_{term}"], world_model)["dynamics"]
    with torch.no_grad():
        for parameter in world_model.dynamics.parameters():
            parameter[1].add_(0.2 * torch.randn_like(parameter[1]))
    after = gradients(run_seeded(loss, slices)[f"loss_{term}"], world_model)["dynamics"]
    for name in before:
        torch.testing.assert_close(after[name][[0, 2]], before[name][[0, 2]])
        assert not torch.allclose(after[name][1], before[name][1])


def test_the_consistency_error_of_a_head_reaches_the_dynamics_weights_of_that_head_only(make_world_model, slices):
    world_model = make_world_model(num_dynamics=3)
    rollout = latent_rollout(world_model, _time_first(slices))
    alone = LatentRollout(rollout.encoded, rollout.predicted[:, 1:2])
    parameters = list(world_model.dynamics.parameters())
    for gradient in torch.autograd.grad(consistency_error(alone).sum(), parameters):
        assert gradient[1].abs().max() > 0
        assert gradient[[0, 2]].abs().max() == 0


def test_every_head_starts_at_the_encoding_of_the_first_observation(make_world_model, slices):
    world_model = make_world_model(num_dynamics=3)
    rollout = latent_rollout(world_model, _time_first(slices))
    first = world_model.encode(slices["observation"][:, 0])
    for head in range(3):
        torch.testing.assert_close(rollout.predicted[0, head], first)
    torch.testing.assert_close(rollout.encoded[0], first)
    torch.testing.assert_close(rollout.encoded[1:], world_model.encode(slices["next", "observation"]).transpose(0, 1))


def test_every_head_rolls_its_own_latent_on(make_world_model, slices):
    world_model = make_world_model(num_dynamics=3)
    rollout = latent_rollout(world_model, _time_first(slices))
    for k in range(3):
        stepped = world_model.next(rollout.predicted[k], slices["action"][:, k])
        torch.testing.assert_close(rollout.predicted[k + 1], stepped)
    assert not torch.allclose(rollout.predicted[1, 0], rollout.predicted[1, 1])


def test_only_the_predicted_latents_carry_a_gradient(make_world_model, slices):
    rollout = latent_rollout(make_world_model(), _time_first(slices))
    assert rollout.predicted.requires_grad
    assert not rollout.encoded.requires_grad


@pytest.mark.parametrize("term", ["consistency", "reward", "value", "termination"])
def test_the_encoder_learns_from_the_first_observation_only(make_world_model, make_loss, slices, term):
    loss = make_loss("whole", make_world_model(termination=True))
    observation = slices["observation"].requires_grad_()
    following = slices["next", "observation"].requires_grad_()
    out = loss(slices)[f"loss_{term}"]
    gradient, none = torch.autograd.grad(out, [observation, following], allow_unused=True)
    assert (gradient[:, 0].abs().amax(-1) > 0).all()
    assert gradient[:, 1:].abs().max() == 0
    assert none is None or none.abs().max() == 0


def test_a_head_that_predicts_every_encoding_has_no_consistency_loss(make_world_model, make_loss, slices):
    world_model = make_world_model()
    with torch.no_grad():  # a constant encoding, which the dynamics predict whatever the action
        for network in (world_model.encoder, world_model.dynamics):
            network.output.norm_weight.zero_()
        world_model.dynamics.output.norm_bias.copy_(world_model.encoder.output.norm_bias.expand(2, -1))
    assert make_loss("model", world_model)(slices)["loss_consistency"].item() < 1e-25


@pytest.mark.parametrize(("reward", "bin_index"), [(1e12, -1), (-1e12, 0), (1e4, -4), (0.0, 10)])
def test_a_reward_beyond_the_bins_is_classified_in_the_end_bin(make_world_model, make_loss, slices, reward, bin_index):
    world_model = make_world_model()  # 21 bins on [-10, 10]: the reward 1e4 lies between the bins 9 and 10
    loss = make_loss("model", world_model, reward_coef=1.0, rho=1.0, reduction="none")
    slices["next", "reward"] = torch.full_like(slices["next", "reward"], reward)
    rollout = latent_rollout(world_model, _time_first(slices))
    logits = world_model.reward_head(rollout.predicted[:-1], slices["action"].transpose(0, 1).unsqueeze(1))
    negative_log_probability = -logits.log_softmax(-1).mean(1).transpose(0, 1)
    actual = loss(slices)["loss_reward"]
    if reward == 1e4:  # ln(10001) = 9.2104
        low, high = negative_log_probability[..., -2], negative_log_probability[..., -1]
        torch.testing.assert_close(actual, low + 0.2104403669 * (high - low))
    else:
        torch.testing.assert_close(actual, negative_log_probability[..., bin_index])


@pytest.mark.parametrize("term", ["consistency", "reward"])
def test_step_k_counts_rho_to_the_k_with_k_from_zero(make_world_model, make_loss, make_slices, term):
    world_model = make_world_model()
    slices = make_slices(slice_len=4)
    decayed = make_loss("model", world_model, rho=0.3, reduction="none")(slices)[f"loss_{term}"]
    plain = make_loss("model", world_model, rho=1.0, reduction="none")(slices)[f"loss_{term}"]
    torch.testing.assert_close(decayed / plain, torch.tensor([1.0, 0.3, 0.09, 0.027]).expand(4, 4))


def test_the_termination_term_is_not_decayed(make_world_model, make_loss, slices):
    world_model = make_world_model(termination=True)
    decayed = make_loss("model", world_model, rho=0.3, reduction="none")(slices)["loss_termination"]
    plain = make_loss("model", world_model, rho=1.0, reduction="none")(slices)["loss_termination"]
    torch.testing.assert_close(decayed, plain)


@pytest.mark.parametrize("term", ["consistency", "reward", "termination"])
def test_each_term_is_its_error_times_its_coefficient_once(make_world_model, make_loss, slices, term):
    loss = make_loss("model", make_world_model(termination=True), rho=1.0, **{f"{term}_coef": 7.0})
    out = loss(slices)
    torch.testing.assert_close(out[f"loss_{term}"].detach(), 7.0 * out[f"{term}_error"])
    loss_off = make_loss("model", make_world_model(termination=True), **{f"{term}_coef": 0.0})
    assert loss_off(slices)[f"loss_{term}"] == 0


def test_a_flag_is_read_at_the_latent_that_its_step_reached(make_world_model, make_loss, slices):
    world_model = make_world_model(termination=True)
    loss = make_loss("model", world_model, reduction="none")
    slices["next", "terminated"] = torch.zeros_like(slices["next", "terminated"])
    logits = world_model.termination_head(latent_rollout(world_model, _time_first(slices)).predicted)
    before = loss(slices)["loss_termination"]
    slices["next", "terminated"][:, 1] = True
    change = loss(slices)["loss_termination"] - before
    assert change[:, [0, 2]].abs().max() == 0
    # BCE of a logit x goes from softplus(x) to softplus(-x): it changes by -x.
    torch.testing.assert_close(change[:, 1], -logits[2].mean(0))
    assert not torch.allclose(change[:, 1], -logits[1].mean(0))


def test_flags_are_neither_read_nor_needed_without_a_termination_head(make_loss, slices, assert_same_output):
    loss = make_loss("model")
    expected = loss(slices)
    del slices["next", "terminated"]
    assert_same_output(loss(slices), expected)
    assert "loss_termination" not in expected.keys()


@pytest.mark.parametrize("name", ["terminated", "done"])
def test_flags_in_another_place_than_the_loss_looks_are_named(make_loss, slices, name):
    loss = make_loss("model", ignore_termination=False)
    flags = slices["next"].pop("terminated").zero_()
    slices["next"].pop("done", None)
    loss(slices.clone())
    slices["next", "agent", name] = flags
    there = rf"\('next', 'agent', '{name}'\)"
    message = rf"\('next', '{name}'\) is not in the batch, but {there} is; name it: loss.set_keys\({name}="
    with pytest.raises(ValueError, match=message):
        loss(slices)
    loss.set_keys(**{name: ("agent", name)})
    loss(slices)
    slices["next", "agent", name][:, 0] = True
    with pytest.raises(ValueError, match=rf"{there} (holds True|is True before the last step)"):
        loss(slices)


def test_the_default_device_stops_no_check_of_a_batch(make_loss, slices):
    loss = make_loss("model")
    slices["next", "done"] = torch.zeros_like(slices["next", "terminated"])
    torch.set_default_device("meta")
    try:
        assert loss(slices)["loss_reward"].isfinite()
    finally:
        torch.set_default_device(None)


@pytest.mark.parametrize("where", ["done", "last"])
def test_a_next_observation_that_is_missing_at_the_end_of_a_slice_is_refused(make_loss, slices, where):
    loss = make_loss("model")
    slices["next", "observation"][1, -1] = float("nan")
    slices["next", "done"] = torch.zeros_like(slices["next", "terminated"])
    slices["next", "done"][1, -1] = where == "done"
    message = "where .* is True: .*auto_reset" if where == "done" else "at the last step of a slice: .*compact_obs=True"
    with pytest.raises(ValueError, match=message):
        loss(slices)
    slices["collector", "mask"] = torch.ones(slices.shape, dtype=torch.bool)
    slices["collector", "mask"][1, -1] = False
    loss(slices)
    slices["next", "observation"][1, -2] = float("nan")  # of the last step that counts
    with pytest.raises(ValueError, match="at the last step of a slice"):
        loss(slices)


def test_a_termination_head_needs_the_flags(make_world_model, make_loss, slices):
    del slices["next", "terminated"]
    with pytest.raises(KeyError, match="EfficientTDMPCModelLoss needs the key .*terminated.*set_keys"):
        make_loss("model", make_world_model(termination=True))(slices)


@pytest.mark.parametrize("termination", [False, True])
@pytest.mark.parametrize("flag", ["truncated", "done"])
def test_truncation_and_done_change_nothing(
    make_world_model, make_loss, slices, run_seeded, assert_same_output, termination, flag
):
    loss = make_loss("whole", make_world_model(termination=termination)).eval()
    expected = run_seeded(loss, slices)
    slices["next", flag][:, -1] = ~slices["next", flag][:, -1]
    assert_same_output(run_seeded(loss, slices), expected, rtol=0, atol=0)


def test_the_last_step_teaches_the_model_too(make_loss, slices):
    loss = make_loss("model", reduction="none")
    before = loss(slices)
    for key in (("next", "observation"), ("next", "reward")):
        slices[key] = slices[key].clone()
        slices[key][:, -1] += 1
    after = loss(slices)
    for term in ("loss_consistency", "loss_reward"):
        assert (after[term][:, -1] != before[term][:, -1]).all()
        torch.testing.assert_close(after[term][:, :-1], before[term][:, :-1], rtol=0, atol=0)
