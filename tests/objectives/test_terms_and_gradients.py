from __future__ import annotations

import pytest
import torch

_KIND_AND_TERM = [
    *(("whole", term) for term in ("consistency", "reward", "termination", "value", "policy")),
    *(("model", term) for term in ("consistency", "reward", "termination")),
    ("value", "value"),
    ("policy", "policy"),
]


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
def test_each_term_alone_trains_its_networks_and_no_other(
    make_loss, world_model, slices, gradients, kind, term, trained_by_term
):
    found = gradients(make_loss(kind, world_model)(slices)[f"loss_{term}"], world_model)
    for network, parameters in found.items():
        for name, gradient in parameters.items():
            if network in trained_by_term[term]:
                assert gradient is not None, (network, name)
                assert gradient.isfinite().all() and gradient.any(), (network, name)
            else:
                assert gradient is None, (network, name)


def test_several_calls_can_share_one_backward_pass(
    loss, slices, make_slices, gradients, world_model, run_seeded, total
):
    batches = [slices, make_slices(), make_slices()]
    together = gradients(sum(total(run_seeded(loss.eval(), batch)) for batch in batches), world_model)
    apart = [gradients(total(run_seeded(loss, batch)), world_model) for batch in batches]
    for network, parameters in together.items():
        for name, gradient in parameters.items():
            if gradient is not None:
                torch.testing.assert_close(gradient, sum(found[network][name] for found in apart))
    loss.train()  # where every call moves the scale
    sum(total(loss(batch)) for batch in batches).backward()


def test_only_the_loss_entries_carry_a_gradient(loss, kind, slices):
    out = loss(slices)
    assert out.batch_size == torch.Size([])
    for key, value in out.items():
        assert value.shape == torch.Size([])
        assert value.isfinite()
        assert value.requires_grad == key.startswith("loss_"), key


@pytest.mark.parametrize("termination", [False, True])
@pytest.mark.parametrize("distill", [False, True])
def test_the_output_has_exactly_the_out_keys(
    make_loss, make_world_model, kind, slices, termination, distill, terms_of, metrics_of
):
    options = {"distill": distill} if kind == "whole" else {}
    loss = make_loss(kind, make_world_model(termination=termination), **options)
    terms = [term for term in terms_of[kind] if termination or term != "termination"]
    if not distill and kind == "whole":
        terms.remove("policy")
    expected = [f"loss_{term}" for term in terms] + [metric for term in terms for metric in metrics_of[term]]
    assert loss.out_keys == expected
    assert set(loss(slices).keys()) == set(expected)


@pytest.mark.parametrize("termination", [False, True])
def test_a_call_reads_exactly_the_in_keys(
    make_loss, make_world_model, kind, slices, termination, run_seeded, keywords_of, key_of
):
    loss = make_loss(kind, make_world_model(termination=termination)).eval()
    expected = [key_of(name) for name in keywords_of(kind, slices, termination=termination)]
    assert loss.in_keys == expected
    out = run_seeded(loss, slices)
    assert (run_seeded(loss, slices.select(*expected)) == out).all()
    for key in expected:
        with pytest.raises(KeyError, match=f"{type(loss).__name__} needs the key .*set_keys"):
            loss(slices.exclude(key))


def test_turning_distillation_off_and_on_changes_what_is_read_and_returned(make_loss, slices, gradients, total):
    loss = make_loss("whole")
    plan = [("plan", "loc"), ("plan", "scale")]
    assert loss.distill and loss.in_keys[-2:] == plan
    loss.distill = False
    assert not set(plan) & set(loss.in_keys)
    out = loss(slices.exclude("plan"))
    assert not {"loss_policy", "policy_kl", "policy_entropy", "kl_scale"} & set(out.keys())
    assert not any(gradient is not None for gradient in gradients(total(out), loss.world_model)["policy"].values())
    loss.distill = True
    assert loss.in_keys[-2:] == plan
    assert "loss_policy" in loss(slices).keys()


def test_a_call_changes_nothing_in_its_input(loss, slices, total):
    before = {key: (value, value.clone()) for key, value in slices.items(True, True)}
    total(loss(slices)).backward()
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
    slices["td_error"] = torch.rand(4, 3)
    slices["index"] = torch.arange(12).view(4, 3)
    assert (run_seeded(loss, slices) == out).all()
    assert "td_error" not in out.keys()


@pytest.mark.parametrize(("kind", "term"), _KIND_AND_TERM)
def test_a_term_is_its_error_times_a_coefficient_that_can_be_assigned_in_place(
    make_loss, world_model, kind, slices, term
):
    name, options = f"{term}_coef", {"entropy_coef": 0.1} if term == "policy" else {}
    loss = make_loss(kind, world_model, rho=1.0, **{name: 7.0}, **options).eval()
    buffer = getattr(loss, name)
    for number in (7.0, 0.0, torch.tensor(0.3)):
        setattr(loss, name, number)
        out = loss(slices)
        if term == "policy":
            error = out["policy_kl"] - 0.1 * 3 * out["policy_entropy"]
        else:
            error = out[f"{term}_error"]
        torch.testing.assert_close(out[f"loss_{term}"].detach(), number * error)
        assert getattr(loss, name) is buffer
    torch.testing.assert_close(loss.state_dict()[name].item(), 0.3, rtol=1e-6, atol=0)


def test_step_k_counts_rho_to_the_k_with_k_from_zero_unless_it_is_of_the_termination_term(
    make_loss, world_model, kind, make_slices, run_seeded, terms_of
):
    slices = make_slices(slice_len=4)
    loss = make_loss(kind, world_model, rho=0.3, reduction="none").eval()
    decayed = run_seeded(loss, slices)
    loss.rho = 1.0
    plain = run_seeded(loss, slices)
    for term in terms_of[kind]:
        share = torch.ones(4) if term == "termination" else torch.tensor([1.0, 0.3, 0.09, 0.027])
        torch.testing.assert_close(decayed[f"loss_{term}"] / plain[f"loss_{term}"], share.expand(4, 4))
