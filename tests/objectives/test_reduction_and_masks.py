from __future__ import annotations

import copy

import pytest
import torch
from tensordict import LazyStackedTensorDict, TensorDict
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs import TransformedEnv
from torchrl.objectives import SoftUpdate

from torchrl_etdmpc import EfficientTDMPCLoss, EnsembleMPPIPlanner, LatentEnv, WorldModel
from torchrl_etdmpc.envs import make_env
from torchrl_etdmpc.functional import simnorm
from torchrl_etdmpc.testing import random_slices
from torchrl_etdmpc.training import Updater


def test_the_reductions_agree_with_each_other(make_loss, world_model, kind, slices, run_seeded, terms_of, metrics_of):
    out = {}
    for reduction in ("none", "mean", "sum", None):
        loss = make_loss(kind, world_model, reduction=reduction).eval()
        if kind in ("whole", "value"):
            loss.target_value_params.data.update_(loss.value_params.data)
        out[reduction] = run_seeded(loss, slices)
    for term in terms_of[kind]:
        key = f"loss_{term}"
        assert out["none"][key].shape == (4, 3)
        assert out["none"][key].unique().numel() == 12
        assert out["mean"][key].shape == out["sum"][key].shape == ()
        torch.testing.assert_close(out["none"][key].mean(), out["mean"][key])
        torch.testing.assert_close(out["none"][key].sum(), out["sum"][key])
        assert torch.equal(out[None][key], out["mean"][key])
        for metric in metrics_of[term]:
            assert out["none"][metric].shape == ()
            assert torch.equal(out["none"][metric], out["sum"][metric])


def test_entry_b_k_of_an_unreduced_term_belongs_to_slice_b(make_loss, world_model, kind, slices, run_seeded, terms_of):
    loss = make_loss(kind, world_model, reduction="none").eval()
    before = run_seeded(loss, slices)
    for key in ("observation", ("next", "observation"), "action", ("next", "reward"), ("plan", "loc")):
        slices[key] = slices[key].clone()
        slices[key][2] *= 0.9
    slices["next", "terminated"][2] ^= True
    after = run_seeded(loss, slices)
    for term in terms_of[kind]:
        changed = before[f"loss_{term}"] != after[f"loss_{term}"]
        assert changed[2].all()
        assert not changed[[0, 1, 3]].any()


@pytest.mark.parametrize(("mask_key", "trailing"), [(("collector", "mask"), ()), ("shifted_valid", (1,))])
def test_masked_steps_do_not_count(make_loss, world_model, kind, slices, run_seeded, mask_key, trailing, terms_of):
    mask = torch.arange(3) < torch.tensor([[3], [1], [0], [2]])
    loss = make_loss(kind, world_model, reduction="none").eval()
    unmasked = run_seeded(loss, slices)
    slices[mask_key] = mask.view(4, 3, *trailing)
    masked = {}
    for reduction in ("none", "mean", "sum"):
        loss.reduction = reduction
        masked[reduction] = run_seeded(loss, slices)
    for key in (f"loss_{term}" for term in terms_of[kind]):
        torch.testing.assert_close(masked["none"][key], unmasked[key] * mask)
        torch.testing.assert_close(masked["sum"][key], unmasked[key][mask].sum())
        torch.testing.assert_close(masked["mean"][key], unmasked[key][mask].mean())
    loss.loss_mask_key = None
    loss.reduction = "none"
    again = run_seeded(loss, slices)
    assert all(torch.equal(again[key], unmasked[key]) for key in unmasked.keys())


def test_a_step_behind_a_masked_one_does_not_count_since_its_rollout_goes_through_it(
    loss, slices, run_seeded, assert_same_output
):
    slices["collector", "mask"] = torch.tensor([[1, 1, 1], [1, 0, 1], [0, 1, 1], [0, 0, 1]]).bool()
    with_gaps = run_seeded(loss.eval(), slices)
    slices["collector", "mask"] = torch.tensor([[1, 1, 1], [1, 0, 0], [0, 0, 0], [0, 0, 0]]).bool()
    assert_same_output(with_gaps, run_seeded(loss, slices), rtol=0, atol=0)


def _pad(slices, fill):
    """Masks the last two steps of slice 1, the last of slice 2 and the whole of slice 3, and fills them."""
    mask = torch.ones(4, 3, 1, dtype=torch.bool)
    mask[1, 1:] = mask[2, 2:] = mask[3] = False
    padded = slices.clone()
    padded["collector", "mask"] = mask
    for key in (
        "observation",
        "action",
        ("next", "observation"),
        ("next", "reward"),
        ("plan", "loc"),
        ("plan", "scale"),
    ):
        padded[key] = torch.where(mask, padded[key], fill)
    padded["next", "terminated"] &= mask
    return padded


@pytest.mark.parametrize("fill", [0.0, float("nan"), float("inf")])
def test_padded_steps_influence_neither_terms_nor_metrics_nor_gradients_nor_the_running_scale(
    make_loss, world_model, kind, slices, run_seeded, gradients, assert_same_output, total, fill
):
    loss = make_loss(kind, world_model)
    other = copy.deepcopy(loss)
    assert loss.training
    expected, actual = run_seeded(loss, _pad(slices, 0.5)), run_seeded(other, _pad(slices, fill))
    assert_same_output(actual, expected, rtol=0, atol=0)
    assert all(value.isfinite().all() for value in actual.values())
    if kind in ("whole", "policy"):
        assert torch.equal(loss.kl_scale, other.kl_scale)
    expected, actual = gradients(total(expected), world_model), gradients(total(actual), other.world_model)
    for network, parameters in expected.items():
        for name, gradient in parameters.items():
            if gradient is None:
                assert actual[network][name] is None
            else:
                assert gradient.isfinite().all()
                assert torch.equal(actual[network][name], gradient), (network, name)


@pytest.mark.usefixtures("double_precision")
@pytest.mark.parametrize("kind", ["model", "policy"])  # their training draws nothing
def test_slices_of_padding_alone_are_as_good_as_not_there(
    make_loss, make_world_model, make_slices, kind, gradients, assert_same_output, total
):
    slices = make_slices(num_slices=20)
    slices["plan", "scale"] *= 0.05
    world_model = make_world_model(termination=True)
    loss = make_loss(kind, world_model, **({"scale_tau": 0.5} if kind == "policy" else {}))
    other = copy.deepcopy(loss)
    expected = loss(slices[:12])
    slices["collector", "mask"] = (torch.arange(20) < 12).unsqueeze(-1).expand(20, 3)
    for key in (("plan", "loc"), ("plan", "scale"), ("next", "reward")):
        slices[key][12:] = 0
    actual = other(slices)
    assert_same_output(actual, expected)
    if kind == "policy":
        assert loss.kl_scale > 1.1
    expected, actual = gradients(total(expected), world_model), gradients(total(actual), other.world_model)
    torch.testing.assert_close(actual, expected)


def test_a_batch_of_padding_alone_is_a_loss_of_zero_and_moves_nothing(make_loss, world_model, kind, slices, total):
    loss = make_loss(kind, world_model)
    slices["collector", "mask"] = torch.zeros(4, 3, dtype=torch.bool)
    for key in ("observation", ("next", "observation"), "action", ("next", "reward")):
        slices[key].fill_(torch.nan)
    out = loss(slices)
    assert total(out) == 0
    total(out).backward()
    assert not any(p.grad.any() for p in loss.parameters() if p.grad is not None)
    if kind in ("whole", "policy"):
        assert loss.kl_scale == 1


def test_an_update_reads_the_mask_too(make_loss, make_world_model, slices):
    loss = make_loss("whole", make_world_model())
    updaters = [Updater(copy.deepcopy(loss)) for _ in range(2)]
    for updater, fill in zip(updaters, (0.5, float("nan")), strict=True):
        torch.manual_seed(3)
        out = updater.step(_pad(slices, fill))
        assert all(value.isfinite() for value in out.values())
    for ours, theirs in zip(*(updater.loss.parameters() for updater in updaters), strict=True):
        assert torch.equal(ours, theirs)


def test_what_terminates_in_the_padding_is_not_refused(make_loss, make_world_model, slices):
    loss = make_loss("whole", make_world_model(), ignore_termination=False)
    slices["collector", "mask"] = torch.tensor([[True, True, False]]).expand(4, 3)
    slices["next", "terminated"] = ~slices["collector", "mask"].unsqueeze(-1)
    loss(slices)
    slices["next", "terminated"] = ~slices["next", "terminated"]
    with pytest.raises(ValueError, match="holds True, but the world model has no termination head"):
        loss(slices)


def test_a_mask_of_another_shape_is_refused_in_a_sentence(loss, slices):
    slices["collector", "mask"] = torch.ones(4, 3, 2, dtype=torch.bool)
    with pytest.raises(
        ValueError,
        match=r"^the mask \('collector', 'mask'\) must have the shape \[B, T\]=\[4, 3\], got \[4, 3, 2\]; set",
    ):
        loss(slices)


def test_the_padded_trajectories_of_torchrl_s_collector_train_the_agent(make_loss, make_world_model, total):
    model = make_world_model(observation_dim=4, action_dim=1, termination=True)
    planner = EnsembleMPPIPlanner(
        LatentEnv(model), horizon=2, num_samples=8, num_elites=2, num_proposals=1, iterations=1
    )
    env = TransformedEnv(make_env("gym/InvertedPendulum-v5", seed=0), planner.make_tensordict_primer())
    with pytest.warns(UserWarning, match="zero-padded"):
        collector = Collector(env, planner, frames_per_batch=60, total_frames=60, split_trajs=True, use_buffers=False)
    batch = next(iter(collector))
    collector.shutdown()
    mask = batch["collector", "mask"]
    assert mask.any() and not mask.all()
    loss = make_loss("whole", model)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
    out = loss(batch)
    total(out).backward()
    optimizer.step()
    assert all(parameter.isfinite().all() for parameter in model.parameters())
    assert all(value.isfinite() for value in out.values())
    assert model.policy.output.weight.grad.any()
    reference = loss.eval()(batch)
    junk = batch.clone()
    for key in ("observation", "action", ("next", "observation"), ("next", "reward"), ("plan", "loc")):
        junk[key][~mask] = 1e4
    torch.manual_seed(0)
    expected = loss(batch)
    torch.manual_seed(0)
    assert torch.equal(loss(junk)["loss_policy"], expected["loss_policy"])
    assert reference["policy_kl"].isfinite()


@pytest.mark.filterwarnings("ignore:.*auto_register_policy_transforms.*:FutureWarning")
def test_random_frames_of_torchrl_s_collector_leave_the_policy_finite(make_loss, make_world_model, total):
    model = make_world_model(observation_dim=3, action_dim=1)
    planner = EnsembleMPPIPlanner(
        LatentEnv(model), horizon=2, num_samples=8, num_elites=2, num_proposals=1, iterations=1
    )
    frames = {"frames_per_batch": 30, "total_frames": 60, "init_random_frames": 30}
    collector = Collector(make_env("gym/Pendulum-v1", seed=0), planner, **frames, auto_register_policy_transforms=True)
    random_frames, planned_frames = (frames.clone().unflatten(0, (-1, 3)) for frames in collector)
    collector.shutdown()
    assert not random_frames["plan", "scale"].any()
    assert planned_frames["plan", "scale"].all()
    loss = make_loss("whole", model)
    out = loss(torch.cat([random_frames, planned_frames]))
    total(out).backward()
    assert all(value.isfinite() for value in out.values())
    assert all(parameter.grad.isfinite().all() for parameter in model.parameters() if parameter.grad is not None)
    assert model.policy.output.weight.grad.any()
    torch.testing.assert_close(out["policy_kl"], loss.eval()(planned_frames)["policy_kl"])


def test_of_two_masks_a_step_needs_both(loss, slices, run_seeded, assert_same_output):
    first, second = (torch.arange(3) < torch.tensor(lengths).unsqueeze(-1) for lengths in ([3, 1, 2, 3], [2, 3, 3, 0]))
    slices["collector", "mask"], slices["shifted_valid"] = first, second
    of_both = run_seeded(loss.eval(), slices)
    slices["collector", "mask"] = slices["shifted_valid"] = first & second
    assert_same_output(of_both, run_seeded(loss, slices), rtol=0, atol=0)


def test_a_term_of_one_s_own_finds_a_scale_that_it_can_divide_by_in_padded_steps(make_loss, world_model, slices):
    read = make_loss("whole", world_model).slices(_pad(slices, 0.0))
    assert (read.plan_scale[~read.counts] == 1).all()
    assert (read.action[~read.counts] == 0).all()


@pytest.mark.parametrize("stack_dim", [0, 1])
def test_masks_lie_over_the_steps_of_dictionaries_that_are_stacked_lazily(stack_dim):
    class First(nn.Module):
        def __init__(self):
            super().__init__()
            self.layer = nn.Linear(3, 16)

        def forward(self, observation):
            return simnorm(self.layer(observation["inner", "state"]), 8)

    torch.manual_seed(0)
    loss = EfficientTDMPCLoss(WorldModel(None, 2, encoder=First(), latent_dim=16, mlp_dim=16), discount=0.99).eval()
    SoftUpdate(loss, tau=0.01)
    dense = random_slices(3, 2, num_slices=3, slice_len=3)  # three of everything: no shape tells them apart
    for key in ("observation", ("next", "observation")):
        dense[key] = TensorDict({"inner": {"state": dense[key]}}, dense.batch_size)
    dense["collector", "mask"] = torch.tensor([[True, False, False], [True, True, False], [True, True, True]])
    found = []
    for batch in (dense, LazyStackedTensorDict(*dense.unbind(stack_dim), stack_dim=stack_dim)):
        torch.manual_seed(0)
        found.append(loss(batch))
    for name, value in found[0].items():
        assert torch.equal(found[1][name], value), name


@pytest.mark.parametrize("whole", [False, True], ids=["a part of a slice", "a whole slice"])
def test_masked_steps_leave_gradients_finite_of_an_encoder_that_no_zero_may_enter(whole):
    class Direction(nn.Module):
        def __init__(self):
            super().__init__()
            self.layer = nn.Linear(3, 16)

        def forward(self, observation):
            return simnorm(self.layer(observation / observation.norm(dim=-1, keepdim=True)), 8)

    torch.manual_seed(0)
    loss = EfficientTDMPCLoss(WorldModel(3, 2, encoder=Direction(), latent_dim=16, mlp_dim=16), discount=0.99).eval()
    SoftUpdate(loss, tau=0.01)
    batch = random_slices(3, 2, num_slices=2, slice_len=3)
    batch["collector", "mask"] = mask = torch.tensor([[not whole, False, False], [True, True, True]])
    for key in ("observation", ("next", "observation")):
        batch[key] = torch.where(mask.unsqueeze(-1), batch[key], 0)
    sum(value for name, value in loss(batch).items() if name.startswith("loss_")).backward()
    assert all(parameter.grad.isfinite().all() for parameter in loss.parameters())
    if whole:
        alone = loss(batch[1:])["loss_consistency"]
        torch.testing.assert_close(loss(batch)["loss_consistency"], alone)
