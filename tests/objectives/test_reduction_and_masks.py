from __future__ import annotations

import pytest
import torch


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
        slices[key][2] += 0.1
    slices["next", "terminated"][2] ^= True
    after = run_seeded(loss, slices)
    for term in terms_of[kind]:
        changed = before[f"loss_{term}"] != after[f"loss_{term}"]
        assert changed[2].all()
        assert not changed[[0, 1, 3]].any()


@pytest.mark.parametrize("mask_key", [("collector", "mask"), "shifted_valid"])
@pytest.mark.parametrize("trailing", [(), (1,)])
def test_masked_steps_do_not_count(make_loss, world_model, kind, slices, run_seeded, mask_key, trailing, terms_of):
    mask = torch.rand(4, 3) < 0.5
    mask[0] = True
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


def _pad(slices, fill):
    """Masks the last two steps of slice 1 and the last of slice 2, and fills them."""
    mask = torch.ones(4, 3, 1, dtype=torch.bool)
    mask[1, 1:] = mask[2, 2:] = False
    padded = slices.clone()
    padded["collector", "mask"] = mask
    # The first masked step's own observation is the last valid one's successor: it is real.
    for key in ("action", ("next", "observation"), ("next", "reward"), ("plan", "loc"), ("plan", "scale")):
        padded[key] = torch.where(mask, padded[key], fill)
    padded["next", "terminated"] &= mask
    return padded


@pytest.mark.parametrize("fill", [1.0, 30.0])
def test_the_content_of_a_padded_tail_reaches_neither_terms_nor_gradients(
    make_loss, world_model, kind, slices, run_seeded, gradients, assert_same_gradients, fill, total, terms_of
):
    loss = make_loss(kind, world_model).eval()
    expected, actual = run_seeded(loss, _pad(slices, 0.5)), run_seeded(loss, _pad(slices, fill))
    for term in terms_of[kind]:
        torch.testing.assert_close(actual[f"loss_{term}"], expected[f"loss_{term}"])
    expected, actual = gradients(total(expected), world_model), gradients(total(actual), world_model)
    assert_same_gradients(actual, expected)


def test_a_nan_in_a_padded_tail_does_not_reach_the_terms(make_loss, world_model, kind, slices, run_seeded, terms_of):
    # The terms only: 0 * nan is nan in the backward pass, so padding must be finite (and a scale positive) to train on.
    loss = make_loss(kind, world_model).eval()
    expected, actual = run_seeded(loss, _pad(slices, 0.5)), run_seeded(loss, _pad(slices, float("nan")))
    for term in terms_of[kind]:
        torch.testing.assert_close(actual[f"loss_{term}"], expected[f"loss_{term}"])
