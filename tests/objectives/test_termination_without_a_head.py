from __future__ import annotations

import pytest
import torch

from torchrl_etdmpc.testing import random_slices

bootstrapping = pytest.mark.parametrize("kind", ["whole", "model", "value"])


@pytest.fixture
def make(make_loss):
    """Builds a loss that accepts no end which its model cannot predict, unless told otherwise."""
    return lambda *args, **options: make_loss(*args, **{"ignore_termination": False, **options})


@bootstrapping
def test_a_row_that_terminates_is_refused_with_both_remedies(make, make_world_model, kind):
    loss = make(kind, make_world_model())
    terminated = random_slices(5, 3, terminated=True)
    with pytest.raises(
        ValueError,
        match=r"^\('next', 'terminated'\) holds True, but the world model has no termination head, so values would be "
        r"bootstrapped through the end of an episode; build WorldModel\(\.\.\., termination=True\), or pass "
        rf"{type(loss).__name__}\(\.\.\., ignore_termination=True\) if that is what you want\.$",
    ):
        loss(terminated)
    one = random_slices(5, 3)
    one["next", "terminated"][2, 1] = True
    with pytest.raises(ValueError, match="holds True"):
        loss.slices(one)
    assert loss(random_slices(5, 3)).keys()  # nothing terminates
    assert loss(terminated.exclude(("next", "terminated"))).keys()  # and nobody says so


@bootstrapping
@pytest.mark.parametrize("remedy", ["termination head", "ignored"])
def test_either_remedy_accepts_it(make, make_world_model, kind, remedy):
    options = {"ignore_termination": True} if remedy == "ignored" else {}
    loss = make(kind, make_world_model(termination=remedy == "termination head"), **options)
    out = loss(random_slices(5, 3, terminated=True))
    assert ("loss_termination" in out.keys()) == (remedy == "termination head" and kind != "value")


def test_the_flag_is_read_under_its_own_name(make, make_world_model):
    loss = make("whole", make_world_model())
    loss.set_keys(terminated="over")
    terminated = random_slices(5, 3, terminated=True)
    assert loss(terminated).keys()
    with pytest.raises(ValueError, match=r"^\('next', 'over'\) holds True"):
        loss(terminated.rename_key_(("next", "terminated"), ("next", "over")))


def test_the_policy_does_not_bootstrap_and_does_not_ask(make_loss):
    assert make_loss("policy")(random_slices(5, 3, terminated=True))["loss_policy"].isfinite()


def test_flags_without_a_dimension_of_their_own_are_read_step_by_step(make, make_world_model):
    loss, batch = make("whole", make_world_model()), random_slices(5, 3, num_slices=4, slice_len=1)
    flags = torch.tensor([[True], [False], [False], [False]])
    batch["next", "terminated"] = flags
    batch["collector", "mask"] = ~flags
    assert loss(batch)["loss_reward"].isfinite()
    batch["collector", "mask"] = ~flags.flip(0)
    with pytest.raises(ValueError, match=r"^\('next', 'terminated'\) holds True"):
        loss(batch)


@pytest.mark.parametrize("reason", ["traced", "on a device"])
def test_nothing_waits_for_the_flag_where_it_would_cost(make, make_world_model, monkeypatch, reason):
    loss, terminated = make("whole", make_world_model()), random_slices(5, 3, terminated=True)
    if reason == "traced":
        monkeypatch.setattr(torch.compiler, "is_compiling", lambda: True)
    else:
        terminated = terminated.to("meta")  # where looking is impossible
    assert loss.slices(terminated).action.shape == (3, 4, 3)
