from __future__ import annotations

import pytest
import torch

from torchrl_etdmpc.objectives import Slices, latent_rollout

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


@pytest.mark.parametrize(
    ("term", "coefficient", "rho"), [("consistency", 20, 0.5), ("reward", 0.1, 0.5), ("termination", 1, 1.0)]
)
def test_each_term_and_its_gradient_equal_a_plain_reference_written_head_by_head_and_step_by_step(
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
    error, out = plain_errors(loss, slices)[term], loss(slices)
    expected = coefficient * depth_mean(error, rho)
    torch.testing.assert_close(out[f"loss_{term}"], expected)
    torch.testing.assert_close(out[f"{term}_error"], error.mean().detach())  # knows neither coefficient nor rho
    assert_same_gradients(gradients(out[f"loss_{term}"], world_model), gradients(expected, world_model))


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
