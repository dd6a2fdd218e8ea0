from __future__ import annotations

import pytest
import torch

from torchrl_etdmpc.objectives import latent_rollout

pytestmark = pytest.mark.usefixtures("double_precision")


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


@pytest.mark.parametrize(("reward", "bin_index"), [(1e12, -1), (-1e12, 0)])
def test_a_reward_beyond_the_bins_is_classified_in_the_end_bin(make_world_model, make_loss, slices, reward, bin_index):
    world_model = make_world_model()
    loss = make_loss("model", world_model, reward_coef=1.0, rho=1.0, reduction="none")
    slices["next", "reward"] = torch.full_like(slices["next", "reward"], reward)
    read = loss.slices(slices)
    logits = world_model.reward_head(latent_rollout(world_model, read).predicted[:-1], read.action.unsqueeze(1))
    expected = -logits.log_softmax(-1)[..., bin_index].mean(1).transpose(0, 1)
    torch.testing.assert_close(loss(slices)["loss_reward"], expected)
