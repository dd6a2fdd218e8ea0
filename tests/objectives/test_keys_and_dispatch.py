from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

_RENAMED = {
    "observation": ("data", "state"),
    "action": "act",
    "reward": ("signals", "gain"),
    "terminated": "over",
    "plan_loc": "target_mean",
    "plan_scale": ("target", "deep", "std"),
}


def test_an_unknown_key_is_refused(loss):
    for name in ("value", "priority_weights", "next_observation"):
        with pytest.raises(ValueError, match=f"{name} is not an accepted tensordict key"):
            loss.set_keys(**{name: "x"})


def test_keys_have_defaults_and_can_be_set_and_restored(loss, kind, keywords_of, slices):
    defaults = {
        "observation": "observation",
        "action": "action",
        "reward": "reward",
        "terminated": "terminated",
        "plan_loc": ("plan", "loc"),
        "plan_scale": ("plan", "scale"),
    }
    in_keys = loss.in_keys
    for name, default in defaults.items():
        assert getattr(loss.tensor_keys, name) == default
        loss.set_keys(**{name: _RENAMED[name]})
        assert getattr(loss.tensor_keys, name) == _RENAMED[name]
    renamed = {
        "observation": ("data", "state"),
        "next_observation": ("next", "data", "state"),
        "action": "act",
        "next_reward": ("next", "signals", "gain"),
        "next_terminated": ("next", "over"),
        "plan_loc": "target_mean",
        "plan_scale": ("target", "deep", "std"),
    }
    assert loss.in_keys == [renamed[name] for name in keywords_of(kind, slices)]
    loss.set_keys(**dict.fromkeys(defaults))
    assert {name: getattr(loss.tensor_keys, name) for name in defaults} == defaults
    assert loss.in_keys == in_keys


def test_the_keys_of_one_loss_are_not_those_of_another(make_loss, kind):
    make_loss(kind).set_keys(observation="pixels")
    assert make_loss(kind).in_keys[0] == "observation"


def test_renamed_and_nested_keys_give_the_same_numbers(loss, slices, run_seeded, assert_same_output):
    expected = run_seeded(loss.eval(), slices)
    moved = TensorDict(batch_size=slices.batch_size)
    for name in ("observation", "action"):
        moved[_RENAMED[name]] = slices[name]
    for name in ("observation", "reward", "terminated"):
        path = _RENAMED[name]
        moved[("next", *((path,) if isinstance(path, str) else path))] = slices["next", name]
    for name in ("loc", "scale"):
        moved[_RENAMED[f"plan_{name}"]] = slices["plan", name]
    loss.set_keys(**_RENAMED)
    assert_same_output(run_seeded(loss, moved), expected, rtol=0, atol=0)


@pytest.mark.parametrize("termination", [False, True])
def test_a_call_by_keyword_gives_the_same_numbers_in_the_order_of_the_out_keys(
    make_loss, make_world_model, kind, slices, run_seeded, termination, keywords_of
):
    loss = make_loss(kind, make_world_model(termination=termination)).eval()
    expected = run_seeded(loss, slices)
    out = run_seeded(loss, **keywords_of(kind, slices, termination=termination))
    assert len(out) == len(loss.out_keys)
    for key, value in zip(loss.out_keys, out, strict=True):
        assert torch.equal(value, expected[key]), key


def test_a_call_by_keyword_uses_the_renamed_keys(loss, kind, slices, run_seeded, keywords_of):
    expected = run_seeded(loss.eval(), slices)
    loss.set_keys(observation=("data", "state"), action="act")
    keywords = keywords_of(kind, slices)
    keywords["data_state"] = keywords.pop("observation")
    keywords["next_data_state"] = keywords.pop("next_observation")
    keywords["act"] = keywords.pop("action")
    out = run_seeded(loss, **keywords)
    assert torch.equal(out[0], expected[loss.out_keys[0]])


def test_a_call_by_keyword_works_where_all_entries_agree_in_size(
    make_loss, make_world_model, make_slices, kind, run_seeded, keywords_of
):
    # The inferred batch size then is [B, T, 1].
    sizes = {"observation_dim": 1, "action_dim": 1}
    loss = make_loss(kind, make_world_model(termination=True, **sizes)).eval()
    slices = make_slices(**sizes)
    expected = run_seeded(loss, slices)
    out = run_seeded(loss, **keywords_of(kind, slices))
    assert [value.item() for value in out] == [expected[key].item() for key in loss.out_keys]


def test_out_keys_can_be_selected(loss, kind, slices, run_seeded, keywords_of, terms_of):
    everything = run_seeded(loss.eval(), slices)
    wanted = f"loss_{terms_of[kind][0]}"
    all_keys = loss.out_keys
    assert loss.select_out_keys(wanted) is loss
    assert loss.out_keys == [wanted]
    out = run_seeded(loss, slices)
    assert list(out.keys()) == [wanted]
    assert torch.equal(out[wanted], everything[wanted])
    assert torch.equal(run_seeded(loss, **keywords_of(kind, slices)), everything[wanted])
    loss.reset_out_keys()
    assert loss.out_keys == all_keys
    assert set(loss(slices).keys()) == set(all_keys)


def test_selected_keys_follow_distill_and_are_taken_back_whole(make_loss, make_world_model, make_slices):
    loss, slices = make_loss("whole", make_world_model()), make_slices()
    everything = loss.out_keys
    loss.select_out_keys("loss_value", "loss_policy")
    loss.distill = False
    assert loss.out_keys == ["loss_value"]
    assert list(loss(slices).keys()) == ["loss_value"]
    loss.reset_out_keys()
    assert "loss_policy" not in loss.out_keys
    loss.distill = True
    assert loss.out_keys == everything
    assert set(loss(slices).keys()) == set(everything)
