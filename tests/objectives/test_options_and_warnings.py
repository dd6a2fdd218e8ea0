from __future__ import annotations

import copy
import warnings

import pytest
import torch


@pytest.mark.parametrize("value", [3, 3.0, torch.tensor(3.0)])
def test_a_running_scale_is_assigned_in_place_as_the_coefficients_are(make_loss, value):
    loss = make_loss("whole")
    buffer = loss.kl_scale
    loss.kl_scale = value
    assert loss.kl_scale is buffer
    assert buffer.item() == 3


def test_the_defaults_are_the_papers(loss, kind, terms_of):
    coefs = {"consistency": 20.0, "reward": 0.1, "value": 0.1, "termination": 1.0, "policy": 1.0}
    expected = {"rho": 0.5} | {f"{term}_coef": coefs[term] for term in terms_of[kind]}
    if "policy" in terms_of[kind]:
        expected |= {"entropy_coef": 1e-4, "scale_tau": 0.01}
        assert loss.kl_direction == "backward"
    assert {name: float(getattr(loss, name)) for name in expected} == pytest.approx(expected)


@pytest.mark.parametrize("kind", ["whole", "value"])
def test_a_loss_with_targets_warns_while_no_updater_is_associated(make_loss, slices, kind):
    with pytest.warns(UserWarning, match="No target network updater has been associated"):
        make_loss(kind, updater=False)(slices)


def test_no_warning_is_raised_by_building_calling_saving_or_copying(
    make_loss, make_world_model, kind, slices, total, keywords_of
):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        loss = make_loss(kind, make_world_model(termination=True))
        for _ in range(2):
            total(loss(slices)).backward()
        loss.load_state_dict(loss.state_dict())
        loss.set_keys(observation=None)
        copy.deepcopy(loss).double()
        loss.reset_parameters_recursive()
        loss.train().eval()
        loss(**keywords_of(kind, slices))


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
        ("whole value", "value_beta", -1.0, "value_beta must be finite and not negative, got -1.0; 0 is the mean"),
        ("whole value", "value_beta", float("nan"), "value_beta must be finite and not negative, got nan"),
        ("whole value", "value_replayed", -0.1, r"value_replayed must be in \[0, 1\], got -0.1"),
        ("whole value", "value_replayed", 1.1, r"value_replayed must be in \[0, 1\], got 1.1"),
        ("whole value", "value_expectile", 0.0, r"value_expectile must be in \(0, 1\), got 0.0; 0.5 is the mean"),
        ("whole value", "value_expectile", 1.0, r"value_expectile must be in \(0, 1\), got 1.0"),
        ("whole policy", "scale_tau", -0.1, r"scale_tau must be in \[0, 1\], got -0.1"),
        ("whole policy", "scale_tau", 1.1, r"scale_tau must be in \[0, 1\], got 1.1"),
        ("whole policy", "kl_direction", "up", "kl_direction must be one of backward, forward, got 'up'"),
    ],
)
def test_an_option_out_of_range_is_refused_by_name(make_loss, kinds, option, value, message):
    for kind in kinds.split():
        with pytest.raises(ValueError, match=message):
            make_loss(kind, **{option: value})


def test_the_ends_of_the_ranges_are_accepted(make_loss, slices, total):
    for options in ({"rho": 1.0, "discount": 1.0, "scale_tau": 0.0}, {"scale_tau": 1.0}):
        assert total(make_loss("whole", **options)(slices)).isfinite()


@pytest.mark.parametrize(
    ("name", "value", "changed"),
    [
        ("value_beta", 3.0, "value_target"),
        ("value_replayed", 1.0, "value_target"),
        ("value_expectile", 0.9, "loss_value"),
        ("discount", 0.5, "value_target"),
        ("rho", 0.9, "loss_reward"),
        ("entropy_coef", 1.0, "loss_policy"),
    ],
)
def test_an_option_that_is_assigned_later_is_that_of_a_loss_that_was_built_with_it(
    make_loss, world_model, slices, run_seeded, assert_same_output, name, value, changed
):
    loss = make_loss("whole", world_model, value_replayed=0.5).eval()
    before, buffers = run_seeded(loss, slices), {id(buffer) for buffer in loss.buffers()}
    setattr(loss, name, value)
    after = run_seeded(loss, slices)
    assert before[changed] != after[changed]
    assert {id(buffer) for buffer in loss.buffers()} == buffers  # in place
    built = make_loss("whole", world_model, **{"value_replayed": 0.5, name: value}).eval()
    built.target_value_params.update_(loss.target_value_params)
    assert_same_output(run_seeded(built, slices), after)


def test_replayed_rewards_cannot_be_asked_for_where_the_loss_does_not_read_them(make_loss, slices):
    pytest.raises(AttributeError, lambda: make_loss("policy").value_replayed)
    loss = make_loss("value")
    loss.value_replayed = 0.5
    with pytest.raises(ValueError, match="^value_replayed can leave 0 only where the loss was built with it above 0"):
        loss(slices)


@pytest.mark.parametrize(("name", "known"), [("kl_direction", "backward, forward"), ("reduction", "none, mean, sum")])
def test_a_misspelt_option_that_is_assigned_later_is_refused(make_loss, slices, name, known):
    loss = make_loss("whole")
    setattr(loss, name, "Backward")
    with pytest.raises(ValueError, match=f"^{name} must be one of {known}, got 'Backward'"):
        loss(slices)


def test_hooks_of_torchrl_s_losses_say_what_there_is(make_loss, slices):
    loss = make_loss("whole")
    with pytest.raises(NotImplementedError, match="^EfficientTDMPCLoss makes its value targets itself"):
        loss.make_value_estimator()
    loss.set_vmap_randomness("different")
    loss(slices)
