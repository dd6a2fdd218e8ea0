"""What is wrong with a batch is said by name, before anything is learned from it."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import MultiStep
from torchrl.objectives import SoftUpdate

from torchrl_etdmpc.modules import WorldModel
from torchrl_etdmpc.objectives import EfficientTDMPCLoss
from torchrl_etdmpc.testing import random_slices


def test_a_flat_batch_is_answered_with_the_reshape_that_it_needs(loss, slices):
    with pytest.raises(
        ValueError, match=r"needs a batch of slices \[B, T\].*\[12, 5\].*sample.reshape\(-1, slice_len\)"
    ):
        loss(slices.reshape(-1))
    with pytest.raises(ValueError, match=r"needs a batch of slices \[B, T\].*\[3, 5\]"):
        loss(slices[0])
    with pytest.raises(ValueError, match=r"needs a batch of slices \[B, T\].*\[1, 4, 3, 5\]"):
        loss(slices[None])


def test_a_reward_without_its_trailing_dimension_is_refused(make_loss, slices):
    slices["next", "reward"] = slices["next", "reward"].squeeze(-1)
    with pytest.raises(ValueError, match=r"features\], got \('next', 'reward'\) of shape \[4, 3\]"):
        make_loss("model")(slices)


def test_a_missing_key_is_named_together_with_the_way_to_rename_it(make_loss, slices):
    with pytest.raises(KeyError, match=r"needs the key \('next', 'observation'\).*set_keys\(observation="):
        make_loss("model")(slices.exclude(("next", "observation")))
    with pytest.raises(KeyError, match=r"needs the key \('plan', 'scale'\).*set_keys\(plan_scale="):
        make_loss("policy")(slices.exclude(("plan", "scale")))


@pytest.mark.parametrize("training", [True, False])
def test_no_slices_at_all_are_refused(make_loss, training):
    loss = make_loss("whole").train(training)
    batch = random_slices(5, 3)[:0]
    with pytest.raises(ValueError, match=r"needs at least one step, got \[0, 3\] slices\.$"):
        loss(batch)


@pytest.mark.parametrize(
    ("key", "change", "message"),
    [
        ("observation", lambda x: x[..., :2], r"needs 5 features in the last dimension of 'observation', got 2"),
        (("next", "observation"), lambda x: x.double(), r"needs \('next', 'observation'\) in torch.float32, .*float64"),
        ("action", lambda x: x[..., :1], r"needs 3 features in the last dimension of 'action', got 1"),
        ("action", lambda x: x.double(), r"needs 'action' in torch.float32, as the weights are, got torch.float64"),
        ("action", lambda x: x.long(), r"needs continuous actions in \[-1, 1\], got 'action' of torch.int64"),
        (
            ("next", "reward"),
            lambda x: x.expand(*x.shape[:-1], 2),
            r"needs 1 features .* \('next', 'reward'\), got 2",
        ),
    ],
)
def test_an_entry_that_does_not_fit_is_named(make_loss, slices, key, change, message):
    slices[key] = change(slices[key])
    with pytest.raises(ValueError, match=message):
        make_loss("whole")(slices)


@pytest.mark.parametrize("key", ["loc", "scale"])
def test_a_plan_of_another_action_is_refused(make_loss, slices, key):
    slices["plan", key] = slices["plan", key][..., :1]
    with pytest.raises(ValueError, match=rf"needs 3 features .* of \('plan', '{key}'\), got 1"):
        make_loss("policy")(slices)


def test_an_entry_of_more_bits_than_the_weights_is_named_in_half_precision_too(make_loss, slices):
    loss, half = make_loss("whole").bfloat16(), slices.apply(lambda x: x.bfloat16() if x.is_floating_point() else x)
    half["action"] = half["action"].float()
    with pytest.raises(ValueError, match=r"needs 'action' in torch.bfloat16, as the weights are, got torch.float32; c"):
        loss(half)


@pytest.mark.parametrize(
    "key", [("next", "reward"), ("plan", "loc"), ("plan", "scale"), ("next", "observation"), "observation"]
)
@pytest.mark.parametrize("index", [slice(1), (slice(None), slice(1))], ids=["one slice", "one step"])
def test_an_entry_of_other_slices_is_not_spread_over_the_batch(key, index):
    loss = EfficientTDMPCLoss(WorldModel(5, 3, latent_dim=16, mlp_dim=16, encoder_dim=16), discount=0.9)
    SoftUpdate(loss, tau=0.01)
    batch = random_slices(5, 3, num_slices=4, slice_len=3)
    short = TensorDict({name: value for name, value in batch.items(True, True)}, [])
    short[key] = short[key][index]
    with pytest.raises(ValueError, match=r"entries of shape \[B, T, features\], got .* of shape \[(1, 3|4, 1), "):
        loss(short)


def test_steps_that_are_n_steps_in_one_are_refused(make_loss, slices):
    loss = make_loss("whole")
    slices["steps_to_next_obs"] = torch.ones(*slices.shape, 1, dtype=torch.int64)
    loss(slices)
    slices["steps_to_next_obs"][1, 0] = 3
    with pytest.raises(ValueError, match="^'steps_to_next_obs' is not 1 everywhere: these losses learn single steps"):
        loss(slices)


def test_what_torchrl_s_multi_step_makes_of_an_episode_is_refused(make_loss, slices):
    episode = slices.reshape(-1).clone()
    episode["next", "done"][:] = False
    batch = MultiStep(gamma=0.9, n_steps=3)(episode[None])
    with pytest.raises(ValueError, match="leave MultiStep out"):
        make_loss("model")(batch)


def test_an_episode_that_ends_inside_a_slice_is_refused_unless_the_rest_is_masked(make_loss, slices, run_seeded):
    loss = make_loss("whole").eval()
    slices["next", "done"][:] = False
    expected = run_seeded(loss, slices)
    slices["next", "done"][2, 1] = True  # of three steps
    with pytest.raises(
        ValueError, match=r"^\('next', 'done'\) is True before the last step of a slice, so that another"
    ):
        loss(slices)
    slices["collector", "mask"] = torch.ones(slices.shape, dtype=torch.bool)
    slices["collector", "mask"][2, 2] = False
    assert run_seeded(loss, slices)["loss_value"] != expected["loss_value"]
    del slices["collector"]
    slices["next", "done"][2, 1], slices["next", "done"][2, 2] = False, True  # the last step of a slice may be that
    assert run_seeded(loss, slices)["loss_value"] == expected["loss_value"]


@pytest.mark.parametrize("name", ["terminated", "done"])
@pytest.mark.parametrize(
    "change", [lambda flags: flags.expand(-1, -1, 2), lambda flags: flags[:, :1]], ids=["one an agent", "one a slice"]
)
def test_flags_that_are_not_one_for_each_step_are_refused(make_loss, slices, name, change):
    flags = slices["next", "terminated"].zero_()
    batch = TensorDict({key: value for key, value in slices.items(True, True)}, [])
    batch["next", name] = change(flags)
    message = rf"'{name}'\) must hold one flag for each step, here of shape \[4, 3, 1\], got \[4, .*; reduce it"
    with pytest.raises(ValueError, match=message):
        make_loss("model", ignore_termination=False)(batch)


def test_rows_that_do_not_follow_each_other_are_a_warning(make_loss, slices):
    loss = make_loss("whole")
    slices["observation"][1, 1] += 1
    with pytest.warns(
        UserWarning,
        match=r"^\('next', 'observation'\) of a step is not 'observation' of the next: the slices join rows",
    ):
        loss(slices)
    slices["collector", "mask"] = torch.ones(slices.shape, dtype=torch.bool)
    slices["collector", "mask"][1, 1:] = False
    loss(slices)
    loss(slices[2:, :1])


def test_actions_beyond_what_planner_and_policy_know_are_a_warning(make_loss, slices):
    loss = make_loss("whole")
    slices["action"][0, 0] = 1.0
    loss(slices)
    slices["action"][0, 0] = -1.5
    with pytest.warns(
        UserWarning, match=r"^'action' leaves \[-1, 1\], where planner and policy look for actions; scale"
    ):
        loss(slices)


@pytest.mark.parametrize("where", ["done", "last"])
def test_a_next_observation_that_is_missing_at_the_end_of_a_slice_is_refused(make_loss, slices, where):
    loss = make_loss("model")
    slices["observation"][0, 1] = slices["next", "observation"][0, 0] = float("nan")  # no hole, whatever it is
    loss(slices)
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
