from __future__ import annotations

from typing import Any

import pytest
import torch
from torchrl.data import LazyTensorStorage, PrioritizedSliceSampler, TensorDictReplayBuffer

from torchrl_etdmpc.objectives import imagined_value_target, latent_rollout
from torchrl_etdmpc.testing import random_slices
from torchrl_etdmpc.training import Updater

WEIGHTS = torch.tensor([0.2, 1.0, 0.0, 3.0])


def weighted(slices):
    slices["priority_weight"] = WEIGHTS.unsqueeze(-1).expand(4, 3).clone()
    return slices


@pytest.mark.parametrize("trailing", [(), (1,)])
def test_the_losses_are_weighted_by_slice(make_loss, kind, world_model, slices, run_seeded, terms_of, trailing):
    loss = make_loss(kind, world_model, reduction="none").eval()
    plain = run_seeded(loss, slices)
    slices["priority_weight"] = WEIGHTS.view(4, 1).expand(4, 3).reshape(4, 3, *trailing)
    out = {}
    for reduction in ("none", "sum", "mean"):
        loss.reduction = reduction
        out[reduction] = run_seeded(loss, slices)
    for key in (f"loss_{term}" for term in terms_of[kind]):
        expected = plain[key] * WEIGHTS.unsqueeze(-1)
        torch.testing.assert_close(out["none"][key], expected)
        torch.testing.assert_close(out["sum"][key], expected.sum())
        torch.testing.assert_close(out["mean"][key], expected.sum() / (3 * WEIGHTS.sum()))
    metrics = [key for key in plain.keys() if not key.startswith("loss_")]
    assert all(torch.equal(out["mean"][key], plain[key]) for key in metrics)


def test_the_weight_of_a_slice_is_that_of_the_row_that_was_drawn(loss, slices, run_seeded, assert_same_output):
    expected = run_seeded(loss.eval(), weighted(slices))
    slices["priority_weight"][:, 1:] = torch.rand(4, 2)  # of rows that came along
    assert_same_output(run_seeded(loss, slices), expected, rtol=0, atol=0)


def test_masks_and_weights_go_together(make_loss, kind, world_model, slices, run_seeded, terms_of):
    loss = make_loss(kind, world_model, reduction="none").eval()
    plain = run_seeded(loss, slices)
    weighted(slices)["collector", "mask"] = mask = torch.arange(3) < torch.tensor([[3], [1], [3], [0]])
    slices["priority_weight"][~mask] = torch.nan
    slices["priority_weight"][3] = 3.0
    loss.reduction = "mean"
    out = run_seeded(loss, slices)
    weights = WEIGHTS.unsqueeze(-1) * mask
    for key in (f"loss_{term}" for term in terms_of[kind]):
        torch.testing.assert_close(out[key], (plain[key] * weights).sum() / weights.sum())


def test_slices_that_count_for_nothing_are_a_loss_of_zero(make_loss, kind, world_model, slices, run_seeded, terms_of):
    loss = make_loss(kind, world_model).eval()
    for weight, counts in ((1.0, False), (0.0, True)):
        slices["priority_weight"] = torch.full((4, 3), weight)
        slices["collector", "mask"] = torch.full((4, 3), counts)
        out = run_seeded(loss, slices)
        assert [out[f"loss_{term}"].item() for term in terms_of[kind]] == [0] * len(terms_of[kind])


def test_the_weights_can_be_left_aside(loss, slices, run_seeded, assert_same_output):
    expected = run_seeded(loss.eval(), slices)
    loss.use_prioritized_weights = False
    assert_same_output(run_seeded(loss, weighted(slices)), expected, rtol=0, atol=0)


def test_priorities_are_written_whether_the_weights_count_or_not(make_loss, world_model, slices, run_seeded):
    loss = make_loss("whole", world_model).eval()
    run_seeded(loss, weighted(slices))
    expected = slices.pop("td_error")
    loss.use_prioritized_weights = False
    run_seeded(loss, slices)
    torch.testing.assert_close(slices["td_error"], expected, rtol=0, atol=0)


@pytest.mark.parametrize("kind", ["whole", "value"])
def test_a_priority_is_the_mean_distance_of_a_slice_s_values_from_their_targets(make_loss, world_model, slices, kind):
    loss = make_loss(kind, world_model).eval()
    with torch.no_grad():  # one head above the targets and one below
        world_model.value_head.output.bias[0, -1] += 2
        world_model.value_head.output.bias[1, 0] += 2
    torch.manual_seed(7)
    loss(weighted(slices))
    priority = slices["td_error"]
    assert priority.shape == (4, 3) and not priority.requires_grad
    read = loss.slices(slices)
    rollout = latent_rollout(world_model, read)

    def target_values(latent):
        with loss.target_value_params.to_module(world_model.value_head):
            return world_model.values(latent)

    torch.manual_seed(7)
    noise = torch.randn_like(read.action)
    target = imagined_value_target(world_model, target_values, rollout.encoded[:-1], noise, loss.discount)
    values = world_model.values(rollout.predicted[:-1])  # [T, F, B, V]
    expected = (values - target[:, None, :, None]).abs().mean((0, 1, 3))
    torch.testing.assert_close(priority, expected.unsqueeze(-1).expand(4, 3))


def test_padding_has_no_part_in_a_priority(make_loss, world_model, slices, run_seeded):
    loss = make_loss("whole", world_model).eval()
    short = weighted(slices)[:, :1].clone()
    slices["collector", "mask"] = torch.arange(3) < torch.tensor([[1], [3], [2], [0]])
    run_seeded(loss, slices)
    first = slices["td_error"].clone()
    run_seeded(loss, short)
    torch.testing.assert_close(first[0, 0], short["td_error"][0, 0])  # of its one step, with the same noise
    slices["observation"][0, 1:] = 30.0
    slices["next", "observation"][0, 1:] = -30.0
    run_seeded(loss, slices)
    assert torch.equal(slices["td_error"], first)
    assert (first[3] == 0).all() and (first[:3] > 0).all()


def test_the_keys_can_be_renamed(make_loss, world_model, slices, run_seeded):
    loss = make_loss("whole", world_model).eval()
    expected = run_seeded(loss, weighted(slices.clone()))
    loss.set_keys(priority_weight=("replay", "weight"), priority=("replay", "priority"))
    slices["replay", "weight"] = WEIGHTS.unsqueeze(-1).expand(4, 3)
    assert (run_seeded(loss, slices) == expected).all()
    assert slices["replay", "priority"].shape == (4, 3)
    assert "td_error" not in slices.keys()


def test_a_batch_without_weights_gets_no_priority(loss, slices):
    loss(slices)
    assert "td_error" not in slices.keys()


def test_an_update_weighs_and_writes_priorities_too(make_loss, make_world_model):
    loss, batch = make_loss("whole", make_world_model()), random_slices(5, 3)
    plain, expected = (loss(each.clone())["loss_reward"].detach() for each in (batch.clone(), weighted(batch)))
    out = Updater(loss).step(batch)
    assert batch["td_error"].shape == (4, 3)
    torch.testing.assert_close(out["loss_reward"], expected)
    assert not torch.isclose(expected, plain)
    assert all(value.shape == () for value in out.values())


@pytest.mark.usefixtures("segment_trees")
def test_torchrl_s_prioritised_slices_are_drawn_by_the_errors_that_the_loss_writes(make_loss, make_world_model):
    loss = make_loss("whole", make_world_model())
    sampler = PrioritizedSliceSampler(
        max_capacity=60, alpha=1.0, beta=1.0, slice_len=3, traj_key="trajectory", strict_length=True, truncated_key=None
    )
    buffer: Any = TensorDictReplayBuffer(
        storage=LazyTensorStorage(60), sampler=sampler, batch_size=24, priority_key="td_error"
    )
    rows = random_slices(5, 3, num_slices=6, slice_len=10)
    rows["trajectory"] = torch.arange(6).unsqueeze(-1).expand(6, 10)
    buffer.extend(rows.reshape(-1))
    for _ in range(5):
        batch = buffer.sample().reshape(-1, 3)
        assert batch["priority_weight"].shape == (8, 3)
        loss(batch)
        starts = batch[:, 0]
        buffer.update_tensordict_priority(starts)
        index = starts["index"].reshape(-1).contiguous()  # the trees read memory, whatever the strides
        once = (index == index.unsqueeze(-1)).sum(-1) == 1  # of a row that was drawn twice either error counts
        stored = torch.as_tensor(sampler._sum_tree[index.numpy()])
        errors = starts["td_error"].reshape(-1)
        torch.testing.assert_close(stored[once].float(), errors[once], rtol=1e-4, atol=1e-6)
        assert errors.unique().numel() > 1


def test_one_weight_for_each_slice_will_do_and_other_numbers_are_refused(make_loss, make_world_model, make_slices):
    loss, slices = make_loss("whole", make_world_model()).eval(), make_slices()
    weights = torch.rand(slices.batch_size[0])
    found = []
    for shape in ((-1, 1), (-1,)):
        data = slices.clone()
        data.batch_size = data.batch_size[:1]
        data["priority_weight"] = weights.reshape(shape)
        torch.manual_seed(0)
        found.append(loss(data)["loss_value"])
    wide = slices.clone()
    wide["priority_weight"] = weights[:, None].expand(wide.batch_size)
    torch.manual_seed(0)
    torch.testing.assert_close(loss(wide)["loss_value"], found[0])
    assert torch.equal(*found)
    data["priority_weight"] = torch.rand(len(weights), 2)
    with pytest.raises(ValueError, match=r"needs one weight for each slice or each step at 'priority_weight'"):
        loss(data)
