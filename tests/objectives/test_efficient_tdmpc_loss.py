from __future__ import annotations

import copy
import pickle
import warnings

import pytest
import torch
from tensordict import LazyStackedTensorDict, TensorDict
from torchrl.objectives import SoftUpdate

_TRAINED_BY_TERM = {
    "consistency": {"encoder", "dynamics"},
    "reward": {"encoder", "dynamics", "reward"},
    "value": {"encoder", "dynamics", "value"},
    "termination": {"encoder", "dynamics", "termination"},
    "policy": {"policy"},
}
_TERMS = {
    "whole": ["consistency", "reward", "termination", "value", "policy"],
    "model": ["consistency", "reward", "termination"],
    "value": ["value"],
    "policy": ["policy"],
}
_METRICS = {
    "consistency": ["consistency_error"],
    "reward": ["reward_error"],
    "termination": ["termination_error"],
    "value": ["value_error", "value_target"],
    "policy": ["policy_kl", "policy_entropy", "kl_scale"],
}
_READ = {
    "whole": ["observation", "next_observation", "action", "next_reward", "next_terminated", "plan_loc", "plan_scale"],
    "model": ["observation", "next_observation", "action", "next_reward", "next_terminated"],
    "value": ["observation", "next_observation", "action"],
    "policy": ["observation", "next_observation", "action", "plan_loc", "plan_scale"],
}
_KIND_AND_TERM = [(kind, term) for kind, terms in _TERMS.items() for term in terms]
_KEYS = {
    "next_observation": ("next", "observation"),
    "next_reward": ("next", "reward"),
    "next_terminated": ("next", "terminated"),
    "plan_loc": ("plan", "loc"),
    "plan_scale": ("plan", "scale"),
}
_RENAMED = {
    "observation": ("data", "state"),
    "action": "act",
    "reward": ("signals", "gain"),
    "terminated": "over",
    "plan_loc": "target_mean",
    "plan_scale": ("target", "deep", "std"),
}


def _keywords(kind, slices, *, termination=True):
    names = [name for name in _READ[kind] if termination or name != "next_terminated"]
    return {name: slices[_KEYS.get(name, name)] for name in names}


def _owned(kind):
    return set.union(*(_TRAINED_BY_TERM[term] for term in _TERMS[kind]))


def _identities(module):
    return {id(parameter) for parameter in module.parameters()}


def _total(out):
    return sum(value for key, value in out.items() if key.startswith("loss_"))


@pytest.fixture
def world_model(make_world_model):
    return make_world_model(termination=True)


@pytest.fixture
def loss(kind, make_loss, world_model):
    return make_loss(kind, world_model)


# Terms and gradients


def test_the_whole_is_the_sum_of_its_parts(make_loss, world_model, slices, run_seeded):
    whole = make_loss("whole", world_model, entropy_coef=0.1).eval()
    value = make_loss("value", world_model).eval()
    value.target_value_params.data.update_(whole.target_value_params.data)
    parts = [make_loss("model", world_model).eval(), value]
    parts.append(make_loss("policy", world_model, entropy_coef=0.1).eval())
    out = run_seeded(whole, slices)
    seen = []
    for part in parts:
        for key, number in run_seeded(part, slices).items():
            torch.testing.assert_close(out[key], number)
            seen.append(key)
    assert sorted(seen) == sorted(out.keys())


@pytest.mark.parametrize(("kind", "term"), _KIND_AND_TERM)
def test_each_term_alone_trains_its_networks_and_no_other(make_loss, world_model, slices, gradients, kind, term):
    found = gradients(make_loss(kind, world_model)(slices)[f"loss_{term}"], world_model)
    for network, parameters in found.items():
        for name, gradient in parameters.items():
            if network in _TRAINED_BY_TERM[term]:
                assert gradient is not None, (network, name)
                assert gradient.isfinite().all() and gradient.any(), (network, name)
            else:
                assert gradient is None, (network, name)


def test_every_ensemble_member_is_trained(make_loss, world_model, slices, gradients):
    found = gradients(_total(make_loss("whole", world_model)(slices)), world_model)
    for network in ("dynamics", "value"):
        for name, gradient in found[network].items():
            assert all(member.any() for member in gradient), (network, name)


def test_backward_leaves_the_targets_alone(make_loss, world_model, slices):
    loss = make_loss("whole", world_model)
    _total(loss(slices)).backward()
    assert all(parameter.grad is not None for parameter in loss.parameters())
    assert all(target.grad is None for target in loss.target_value_params.values(True, True))


def test_several_calls_can_share_one_backward_pass(loss, slices, make_slices, gradients, world_model, run_seeded):
    batches = [slices, make_slices(), make_slices()]
    together = gradients(sum(_total(run_seeded(loss.eval(), batch)) for batch in batches), world_model)
    apart = [gradients(_total(run_seeded(loss, batch)), world_model) for batch in batches]
    for network, parameters in together.items():
        for name, gradient in parameters.items():
            if gradient is not None:
                torch.testing.assert_close(gradient, sum(found[network][name] for found in apart))
    loss.train()  # where every call moves the scale
    sum(_total(loss(batch)) for batch in batches).backward()


def test_only_the_loss_entries_carry_a_gradient(loss, kind, slices):
    out = loss(slices)
    assert out.batch_size == torch.Size([])
    for key, value in out.items():
        assert value.shape == torch.Size([])
        assert value.isfinite()
        assert value.requires_grad == key.startswith("loss_"), key


@pytest.mark.parametrize("termination", [False, True])
@pytest.mark.parametrize("distill", [False, True])
def test_the_output_has_exactly_the_out_keys(make_loss, make_world_model, kind, slices, termination, distill):
    options = {"distill": distill} if kind == "whole" else {}
    loss = make_loss(kind, make_world_model(termination=termination), **options)
    terms = [term for term in _TERMS[kind] if termination or term != "termination"]
    if not distill and kind == "whole":
        terms.remove("policy")
    expected = [f"loss_{term}" for term in terms] + [metric for term in terms for metric in _METRICS[term]]
    assert loss.out_keys == expected
    assert set(loss(slices).keys()) == set(expected)


@pytest.mark.parametrize("termination", [False, True])
def test_a_call_reads_exactly_the_in_keys(make_loss, make_world_model, kind, slices, termination, run_seeded):
    loss = make_loss(kind, make_world_model(termination=termination)).eval()
    expected = [_KEYS.get(name, name) for name in _keywords(kind, slices, termination=termination)]
    assert loss.in_keys == expected
    out = run_seeded(loss, slices)
    assert (run_seeded(loss, slices.select(*expected)) == out).all()
    for key in expected:
        with pytest.raises(KeyError, match=f"{type(loss).__name__} needs the key .*set_keys"):
            loss(slices.exclude(key))


def test_turning_distillation_off_and_on_changes_what_is_read_and_returned(make_loss, slices, gradients):
    loss = make_loss("whole")
    plan = [("plan", "loc"), ("plan", "scale")]
    assert loss.distill and loss.in_keys[-2:] == plan
    loss.distill = False
    assert not set(plan) & set(loss.in_keys)
    out = loss(slices.exclude("plan"))
    assert not {"loss_policy", "policy_kl", "policy_entropy", "kl_scale"} & set(out.keys())
    assert not any(gradient is not None for gradient in gradients(_total(out), loss.world_model)["policy"].values())
    loss.distill = True
    assert loss.in_keys[-2:] == plan
    assert "loss_policy" in loss(slices).keys()


def test_a_call_changes_nothing_in_its_input(loss, slices):
    before = {key: (value, value.clone()) for key, value in slices.items(True, True)}
    _total(loss(slices)).backward()
    assert slices.batch_size == (4, 3)
    assert set(slices.keys(True, True)) == set(before)
    for key, (value, content) in before.items():
        assert slices[key] is value
        assert torch.equal(value, content)
        assert not value.requires_grad
    loss(slices.lock_())


def test_entries_that_the_loss_does_not_know_have_no_influence(loss, slices, run_seeded):
    out = run_seeded(loss.eval(), slices)
    slices["_weight"] = torch.rand(4, 3)
    slices["priority_weight"] = torch.rand(4, 3)
    slices["td_error"] = torch.rand(4, 3)
    slices["index"] = torch.arange(12).view(4, 3)
    assert (run_seeded(loss, slices) == out).all()
    assert "td_error" not in out.keys()


# Parameters


def test_reset_parameters_recursive_draws_new_weights_for_the_networks_that_are_trained(
    loss, kind, world_model, networks
):
    before = {}
    for name, network in networks(world_model).items():
        with torch.no_grad():
            for parameter in network.parameters():
                parameter.add_(1000.0)
        before[name] = [(parameter, parameter.clone()) for parameter in network.parameters()]
    loss.reset_parameters_recursive()
    for name, network in networks(world_model).items():
        for (parameter, value), now in zip(before[name], network.parameters(), strict=True):
            assert parameter is now
            if name in _owned(kind):
                assert (now.abs() < 10).all()
            else:
                assert torch.equal(now, value)
    if "value" in _owned(kind):
        for key, parameter in loss.value_params.items(True, True):
            assert torch.equal(loss.target_value_params[key], parameter)
            assert loss.target_value_params[key].data_ptr() != parameter.data_ptr()
    if "dynamics" in _owned(kind):
        first, second = world_model.dynamics.hidden[0].weight
        assert first.any() and not torch.equal(first, second)


def test_a_reset_of_the_whole_starts_the_count_of_updates_anew(make_loss):
    for kind, version in (("whole", 0), ("policy", 5)):
        loss = make_loss(kind)
        loss.world_model.version.fill_(5)
        loss.reset_parameters_recursive()
        assert loss.world_model.version == version


def test_the_parameters_are_the_trained_networks_own_and_targets_add_none(loss, kind, world_model, networks):
    own = [network for name, network in networks(world_model).items() if name in _owned(kind)]
    assert _identities(loss) == set.union(*(_identities(network) for network in own))
    assert len(list(loss.parameters())) == sum(len(list(network.parameters())) for network in own)
    if kind == "whole":
        assert _identities(loss) == _identities(world_model)


@pytest.mark.parametrize("called_before", [False, True])
def test_a_cast_keeps_the_networks_shared_and_takes_everything_along(
    loss, kind, world_model, networks, slices, called_before
):
    if called_before:
        loss(slices)
    shared = _identities(loss)
    for cast in (loss.double, lambda: loss.to("cpu"), loss.float, lambda: loss.to(torch.float64)):
        assert cast() is loss
        assert _identities(loss) == shared
        assert shared <= _identities(world_model)
    assert {parameter.dtype for parameter in world_model.parameters()} == {torch.float64}
    assert world_model.bins.dtype == torch.float64
    assert world_model.version.dtype == torch.int64
    assert {buffer.dtype for buffer in loss.buffers()} == {torch.float64}
    out = loss(slices.to(torch.float64))
    assert {value.dtype for value in out.values()} == {torch.float64}
    _total(out).backward()
    assert all(parameter.grad.dtype == torch.float64 for parameter in loss.parameters())


def test_the_updater_still_works_after_calls_and_a_cast(make_loss, slices):
    loss = make_loss("whole", updater=False)
    updater = SoftUpdate(loss, tau=0.1)
    loss(slices)
    loss.double()
    loss(slices.to(torch.float64))
    with torch.no_grad():
        loss.world_model.value_head.output.bias.add_(1.0)
    before = loss.target_value_params["output", "bias"].clone()
    updater.step()
    torch.testing.assert_close(loss.target_value_params["output", "bias"], before + 0.1)


def test_an_optimizer_step_on_the_loss_is_seen_by_the_world_model(loss, kind, world_model, networks, slices):
    before = {name: [p.clone() for p in network.parameters()] for name, network in networks(world_model).items()}
    optimizer = torch.optim.SGD(loss.parameters(), lr=0.1)
    _total(loss(slices)).backward()
    optimizer.step()
    for name, network in networks(world_model).items():
        for value, now in zip(before[name], network.parameters(), strict=True):
            assert torch.equal(value, now) == (name not in _owned(kind))


def test_a_state_dict_carries_weights_targets_and_the_scale_to_a_fresh_loss(
    make_loss, make_world_model, kind, slices, run_seeded, assert_same_output
):
    trained = make_loss(kind, make_world_model(termination=True))
    if kind in ("whole", "policy"):
        trained.scale_tau = 1.0
    trained(slices)
    fresh = make_loss(kind, make_world_model(termination=True))
    others = [network for network in ("reward_head", "termination_head", "policy", "encoder", "dynamics")]
    for name in others:  # what a part does not own is not in its state
        if name.removesuffix("_head") not in _owned(kind):
            getattr(fresh.world_model, name).load_state_dict(getattr(trained.world_model, name).state_dict())
    assert not (run_seeded(fresh.eval(), slices) == run_seeded(trained.eval(), slices)).any()
    state = copy.deepcopy(trained.state_dict())
    keys = fresh.load_state_dict(state)
    assert not keys.missing_keys and not keys.unexpected_keys
    assert_same_output(run_seeded(fresh.eval(), slices), run_seeded(trained.eval(), slices), rtol=0, atol=0)
    if kind in ("whole", "value"):
        target, online = fresh.target_value_params["output", "weight"], fresh.value_params["output", "weight"]
        assert torch.equal(target, trained.target_value_params["output", "weight"])
        assert not torch.equal(target, online)
    if kind in ("whole", "policy"):
        assert fresh.kl_scale == trained.kl_scale > 1
    assert _identities(fresh) <= _identities(fresh.world_model)


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda loss: pickle.loads(pickle.dumps(loss))])
@pytest.mark.parametrize("called_before", [False, True])
def test_a_copy_gives_the_same_numbers_and_trains_its_own_world_model(
    loss, slices, run_seeded, assert_same_output, duplicate, called_before
):
    if called_before:
        loss(slices)
    twin = duplicate(loss)
    assert not _identities(twin) & _identities(loss)
    assert _identities(twin) <= _identities(twin.world_model)
    assert_same_output(run_seeded(twin.eval(), slices), run_seeded(loss.eval(), slices), rtol=0, atol=0)
    _total(twin(slices)).backward()
    assert all(parameter.grad is not None for parameter in twin.parameters())
    assert all(parameter.grad is None for parameter in loss.parameters())


def test_copying_a_loss_together_with_its_world_model_keeps_them_shared(loss, world_model):
    world_model_twin, twin = copy.deepcopy((world_model, loss))
    assert twin.world_model is world_model_twin
    assert _identities(twin) <= _identities(world_model_twin)


# Keys and dispatch


def test_an_unknown_key_is_refused(loss):
    for name in ("value", "priority_weight", "next_observation"):
        with pytest.raises(ValueError, match=f"{name} is not an accepted tensordict key"):
            loss.set_keys(**{name: "x"})


def test_keys_have_defaults_and_can_be_set_and_restored(loss, kind):
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
    assert loss.in_keys == [renamed[name] for name in _READ[kind]]
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
    make_loss, make_world_model, kind, slices, run_seeded, termination
):
    loss = make_loss(kind, make_world_model(termination=termination)).eval()
    expected = run_seeded(loss, slices)
    out = run_seeded(loss, **_keywords(kind, slices, termination=termination))
    assert len(out) == len(loss.out_keys)
    for key, value in zip(loss.out_keys, out, strict=True):
        assert torch.equal(value, expected[key]), key


def test_a_call_by_keyword_uses_the_renamed_keys(loss, kind, slices, run_seeded):
    expected = run_seeded(loss.eval(), slices)
    loss.set_keys(observation=("data", "state"), action="act")
    keywords = _keywords(kind, slices)
    keywords["data_state"] = keywords.pop("observation")
    keywords["next_data_state"] = keywords.pop("next_observation")
    keywords["act"] = keywords.pop("action")
    out = run_seeded(loss, **keywords)
    assert torch.equal(out[0], expected[loss.out_keys[0]])


def test_a_call_by_keyword_works_where_all_entries_agree_in_size(
    make_loss, make_world_model, make_slices, kind, run_seeded
):
    # The inferred batch size then is [B, T, 1].
    sizes = {"observation_dim": 1, "action_dim": 1}
    loss = make_loss(kind, make_world_model(termination=True, **sizes)).eval()
    slices = make_slices(**sizes)
    expected = run_seeded(loss, slices)
    out = run_seeded(loss, **_keywords(kind, slices))
    assert [value.item() for value in out] == [expected[key].item() for key in loss.out_keys]


def test_out_keys_can_be_selected(loss, kind, slices, run_seeded):
    everything = run_seeded(loss.eval(), slices)
    wanted = f"loss_{_TERMS[kind][0]}"
    all_keys = loss.out_keys
    assert loss.select_out_keys(wanted) is loss
    assert loss.out_keys == [wanted]
    out = run_seeded(loss, slices)
    assert list(out.keys()) == [wanted]
    assert torch.equal(out[wanted], everything[wanted])
    assert torch.equal(run_seeded(loss, **_keywords(kind, slices)), everything[wanted])
    loss.reset_out_keys()
    assert loss.out_keys == all_keys
    assert set(loss(slices).keys()) == set(all_keys)


# Reduction and masks


def test_the_reductions_agree_with_each_other(make_loss, world_model, kind, slices, run_seeded):
    out = {}
    for reduction in ("none", "mean", "sum", None):
        loss = make_loss(kind, world_model, reduction=reduction).eval()
        if kind in ("whole", "value"):
            loss.target_value_params.data.update_(loss.value_params.data)
        out[reduction] = run_seeded(loss, slices)
    for term in _TERMS[kind]:
        key = f"loss_{term}"
        assert out["none"][key].shape == (4, 3)
        assert out["none"][key].unique().numel() == 12
        assert out["mean"][key].shape == out["sum"][key].shape == ()
        torch.testing.assert_close(out["none"][key].mean(), out["mean"][key])
        torch.testing.assert_close(out["none"][key].sum(), out["sum"][key])
        assert torch.equal(out[None][key], out["mean"][key])
        for metric in _METRICS[term]:
            assert out["none"][metric].shape == ()
            assert torch.equal(out["none"][metric], out["sum"][metric])


def test_entry_b_k_of_an_unreduced_term_belongs_to_slice_b(make_loss, world_model, kind, slices, run_seeded):
    loss = make_loss(kind, world_model, reduction="none").eval()
    before = run_seeded(loss, slices)
    for key in ("observation", ("next", "observation"), "action", ("next", "reward"), ("plan", "loc")):
        slices[key] = slices[key].clone()
        slices[key][2] += 0.1
    slices["next", "terminated"][2] ^= True
    after = run_seeded(loss, slices)
    for term in _TERMS[kind]:
        changed = before[f"loss_{term}"] != after[f"loss_{term}"]
        assert changed[2].all()
        assert not changed[[0, 1, 3]].any()


@pytest.mark.parametrize("mask_key", [("collector", "mask"), "shifted_valid"])
@pytest.mark.parametrize("trailing", [(), (1,)])
def test_masked_steps_do_not_count(make_loss, world_model, kind, slices, run_seeded, mask_key, trailing):
    mask = torch.rand(4, 3) < 0.5
    mask[0] = True
    loss = make_loss(kind, world_model, reduction="none").eval()
    unmasked = run_seeded(loss, slices)
    slices[mask_key] = mask.view(4, 3, *trailing)
    masked = {}
    for reduction in ("none", "mean", "sum"):
        loss.reduction = reduction
        masked[reduction] = run_seeded(loss, slices)
    for key in (f"loss_{term}" for term in _TERMS[kind]):
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
    make_loss, world_model, kind, slices, run_seeded, gradients, assert_same_gradients, fill
):
    loss = make_loss(kind, world_model).eval()
    expected, actual = run_seeded(loss, _pad(slices, 0.5)), run_seeded(loss, _pad(slices, fill))
    for term in _TERMS[kind]:
        torch.testing.assert_close(actual[f"loss_{term}"], expected[f"loss_{term}"])
    expected, actual = gradients(_total(expected), world_model), gradients(_total(actual), world_model)
    assert_same_gradients(actual, expected)


def test_a_nan_in_a_padded_tail_does_not_reach_the_terms(make_loss, world_model, kind, slices, run_seeded):
    # The terms only: 0 * nan is nan in the backward pass, so padding must be finite (and a scale positive) to train on.
    loss = make_loss(kind, world_model).eval()
    expected, actual = run_seeded(loss, _pad(slices, 0.5)), run_seeded(loss, _pad(slices, float("nan")))
    for term in _TERMS[kind]:
        torch.testing.assert_close(actual[f"loss_{term}"], expected[f"loss_{term}"])


# Coefficients, warnings, errors


@pytest.mark.parametrize(("kind", "term"), _KIND_AND_TERM)
def test_a_coefficient_can_be_assigned_in_place_and_weighs_its_term(make_loss, world_model, kind, slices, term):
    loss = make_loss(kind, world_model).eval()
    buffer = getattr(loss, f"{term}_coef")
    setattr(loss, f"{term}_coef", 1.0)
    torch.manual_seed(7)
    one = loss(slices)[f"loss_{term}"]
    setattr(loss, f"{term}_coef", 0.3)
    torch.manual_seed(7)
    torch.testing.assert_close(loss(slices)[f"loss_{term}"], 0.3 * one)
    assert getattr(loss, f"{term}_coef") is buffer
    assert f"{term}_coef" in dict(loss.named_buffers())
    torch.testing.assert_close(loss.state_dict()[f"{term}_coef"].item(), 0.3, rtol=1e-6, atol=0)


@pytest.mark.parametrize("kind", ["whole", "value"])
def test_the_discount_can_be_assigned_in_place_and_takes_effect(make_loss, slices, run_seeded, kind):
    loss = make_loss(kind).eval()
    buffer = loss.discount
    targets = []
    for discount in (0.0, 0.5, 1.0):
        loss.discount = discount
        targets.append(run_seeded(loss, slices)["value_target"])
    assert loss.discount is buffer
    torch.testing.assert_close(targets[1], (targets[0] + targets[2]) / 2)
    assert targets[0] != targets[2]


@pytest.mark.parametrize("kind", ["whole", "policy"])
def test_the_entropy_coefficient_can_be_assigned_in_place_and_takes_effect(make_loss, slices, kind):
    loss = make_loss(kind, rho=1.0).eval()
    buffer = loss.entropy_coef
    loss.entropy_coef = 0.0
    none = loss(slices)
    loss.entropy_coef = 0.5
    torch.testing.assert_close(loss(slices)["loss_policy"], none["loss_policy"] - 0.5 * 3 * none["policy_entropy"])
    assert loss.entropy_coef is buffer


def test_the_default_coefficients_are_the_papers(make_loss, world_model):
    loss = make_loss("whole", world_model)
    defaults = {"consistency": 20.0, "reward": 0.1, "value": 0.1, "termination": 1.0, "policy": 1.0, "entropy": 1e-4}
    for name, value in defaults.items():
        assert getattr(loss, f"{name}_coef").item() == pytest.approx(value)
    assert loss.rho == 0.5


@pytest.mark.parametrize("kind", ["whole", "value"])
def test_a_loss_with_targets_warns_while_no_updater_is_associated(make_loss, slices, kind):
    with pytest.warns(UserWarning, match="No target network updater has been associated"):
        make_loss(kind, updater=False)(slices)


def test_no_warning_is_raised_by_building_calling_saving_or_copying(make_loss, make_world_model, kind, slices):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        loss = make_loss(kind, make_world_model(termination=True))
        for _ in range(2):
            _total(loss(slices)).backward()
        loss.load_state_dict(loss.state_dict())
        loss.set_keys(observation=None)
        copy.deepcopy(loss).double()
        loss.reset_parameters_recursive()
        loss.train().eval()
        loss(**_keywords(kind, slices))


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


@pytest.mark.parametrize(
    ("kinds", "option", "value", "message"),
    [
        (
            "whole model value policy",
            "reduction",
            "average",
            "reduction must be one of none, mean, sum, got 'average'",
        ),
        ("whole model value policy", "rho", 0.0, r"rho must be in \(0, 1\], got 0.0"),
        ("whole model value policy", "rho", 1.1, r"rho must be in \(0, 1\], got 1.1"),
        ("whole model value policy", "rho", float("nan"), r"rho must be in \(0, 1\], got nan"),
        ("whole value", "discount", 0.0, r"discount must be in \(0, 1\], got 0.0; see discount_from_episode_length"),
        ("whole value", "discount", 1.1, r"discount must be in \(0, 1\], got 1.1"),
        ("whole policy", "scale_tau", -0.1, r"scale_tau must be in \[0, 1\], got -0.1"),
        ("whole policy", "scale_tau", 1.1, r"scale_tau must be in \[0, 1\], got 1.1"),
        ("whole policy", "kl_direction", "up", "kl_direction must be one of backward, forward, got 'up'"),
    ],
)
def test_an_option_out_of_range_is_refused_by_name(make_loss, kinds, option, value, message):
    for kind in kinds.split():
        with pytest.raises(ValueError, match=message):
            make_loss(kind, **{option: value})


def test_the_ends_of_the_ranges_are_accepted(make_loss, slices):
    for options in ({"rho": 1.0, "discount": 1.0, "scale_tau": 0.0}, {"scale_tau": 1.0}):
        assert _total(make_loss("whole", **options)(slices)).isfinite()


# Inputs of other kinds, compilation


def test_a_memory_mapped_batch_gives_the_same_numbers(loss, slices, run_seeded, assert_same_output, tmp_path):
    expected = run_seeded(loss.eval(), slices)
    mapped = slices.memmap(tmp_path)
    assert mapped.is_memmap()
    assert_same_output(run_seeded(loss, mapped), expected)


@pytest.mark.parametrize("stack_dim", [0, 1])
def test_a_lazily_stacked_batch_gives_the_same_numbers(loss, slices, run_seeded, assert_same_output, stack_dim):
    expected = run_seeded(loss.eval(), slices)
    lazy = LazyStackedTensorDict(*slices.unbind(stack_dim), stack_dim=stack_dim)
    assert lazy.batch_size == (4, 3)
    assert_same_output(run_seeded(loss, lazy), expected)


@pytest.mark.parametrize(("num_slices", "slice_len"), [(4, 1), (1, 3), (1, 1)])
@pytest.mark.parametrize("heads", [1, 2])
def test_single_heads_slices_and_steps_are_ordinary_sizes(
    make_loss, make_world_model, make_slices, run_seeded, num_slices, slice_len, heads
):
    world_model = make_world_model(num_dynamics=heads, num_values=heads, termination=True)
    loss = make_loss("whole", world_model, reduction="none")
    out = run_seeded(loss, make_slices(num_slices, slice_len))
    for term in _TERMS["whole"]:
        assert out[f"loss_{term}"].shape == (num_slices, slice_len)
        assert out[f"loss_{term}"].isfinite().all()
    _total(out).sum().backward()
    assert all(parameter.grad.isfinite().all() for parameter in loss.parameters())


@pytest.mark.usefixtures("double_precision")
@pytest.mark.parametrize(("num_dynamics", "num_values"), [(1, 1), (1, 2), (3, 1)])
@pytest.mark.parametrize("slice_len", [1, 3])
def test_the_plain_reference_holds_for_other_numbers_of_heads_and_steps(
    make_loss, make_world_model, make_slices, run_seeded, plain_errors, depth_mean, num_dynamics, num_values, slice_len
):
    world_model = make_world_model(num_dynamics=num_dynamics, num_values=num_values)
    loss = make_loss("whole", world_model, entropy_coef=0.1).eval()
    slices = make_slices(slice_len=slice_len)
    torch.manual_seed(7)
    errors = plain_errors(loss, slices, torch.randn_like(slices["action"].transpose(0, 1)))
    out = run_seeded(loss, slices)
    torch.testing.assert_close(out["loss_consistency"], 20 * depth_mean(errors["consistency"]))
    torch.testing.assert_close(out["loss_reward"], 0.1 * depth_mean(errors["reward"]))
    torch.testing.assert_close(out["loss_value"], 0.1 * depth_mean(errors["value"]))
    torch.testing.assert_close(out["loss_policy"], depth_mean(errors["kl"] - 0.1 * 3 * errors["entropy"]))


# tensordict reads a switch that torch deprecates
@pytest.mark.filterwarnings("ignore:torch._dynamo.config.inline_inbuilt_nn_modules:FutureWarning")
def test_the_compiled_loss_equals_the_eager_one_in_numbers_gradients_and_scale(
    make_loss, make_world_model, slices, run_seeded, assert_same_output, gradients, assert_same_gradients
):
    world_model = make_world_model(termination=True, dropout=0.0)
    loss = make_loss("whole", world_model, scale_tau=0.5)
    torch.compiler.reset()
    compiled = torch.compile(loss, fullgraph=True, backend="aot_eager")
    for seed in (1, 2):  # the scale moves in between
        loss.kl_scale.fill_(1.0 + seed)
        expected = run_seeded(loss, slices, seed=seed)
        loss.kl_scale.fill_(1.0 + seed)
        actual = run_seeded(compiled, slices, seed=seed)
        assert_same_output(actual, expected)
        assert actual["kl_scale"] == loss.kl_scale != 1.0 + seed
        expected, actual = gradients(_total(expected), world_model), gradients(_total(actual), world_model)
        assert_same_gradients(actual, expected)
