"""Value targets that are what was paid in the rest of a replayed slice."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from torchrl_etdmpc.functional import two_hot_encode
from torchrl_etdmpc.modules import WorldModel
from torchrl_etdmpc.objectives import LatentRollout, Term, imagined_value_target, replayed_value_target, value_error

DISCOUNT = 0.99


def test_a_slice_of_one_step_is_the_temporal_difference_of_what_happened():
    target = replayed_value_target(
        lambda z: torch.cat([10 * z, 14 * z], -1), torch.ones(1, 4, 1), torch.ones(1, 4), 0.5
    )
    assert target.tolist() == [[7.0] * 4]


def test_a_beta_of_one_bootstraps_from_the_lesser_of_two_heads():
    target = replayed_value_target(
        lambda z: torch.cat([10 * z, 14 * z], -1), torch.ones(1, 4, 1), torch.ones(1, 4), 0.5, beta=1.0
    )
    torch.testing.assert_close(target, torch.full((1, 4), 6.0))


class Optimistic:
    """A model in which an agent that stands still comes closer with every step, by a hundredth of the value."""

    def act(self, latent: Tensor, noise: Tensor) -> Tensor:
        return torch.zeros_like(noise)

    def next(self, latent: Tensor, action: Tensor) -> Tensor:
        return latent + 1

    def reward(self, latent: Tensor, action: Tensor) -> Tensor:
        return torch.zeros(latent.shape[:-1])

    def termination(self, latent: Tensor) -> Tensor | None:
        return None


@pytest.mark.parametrize(("replayed", "left"), [(0.0, 137.0), (0.5, 0.0), (1.0, 0.0)])
def test_a_value_that_nothing_pays_for_stays_where_it_is_imagined_alone_and_fades_otherwise(replayed, left):
    value, here = torch.tensor(137.0), torch.zeros(3, 1, 1)
    for _ in range(2000):
        # What lies one imagined step ahead is worth a hundredth more than the state itself.
        values = lambda latent, value=value: value * (1 + latent / 99)  # noqa: E731
        imagined = imagined_value_target(Optimistic(), values, here[:1], torch.zeros(1, 1, 1), DISCOUNT)[0]
        paid = replayed_value_target(values, here, torch.zeros(3, 1), DISCOUNT)[0]
        value = ((1 - replayed) * imagined + replayed * paid)[0]
    assert value.item() == pytest.approx(left, abs=0.05)


def test_a_target_that_is_replayed_alone_is_the_same_whatever_the_model_and_the_policy_say(
    make_world_model, make_loss, slices
):
    loss = make_loss("whole", make_world_model(), value_replayed=1.0).eval()
    before = loss(slices)["value_target"]
    with torch.no_grad():
        for network in (loss.world_model.dynamics, loss.world_model.reward_head, loss.world_model.policy):
            for parameter in network.parameters():
                parameter.fill_(torch.nan)  # which no weight of zero would take away
    assert loss(slices)["value_target"] == before


def test_the_targets_have_no_gradient(make_world_model):
    world_model = make_world_model()
    latents = torch.rand(3, 7, 16, requires_grad=True)
    assert not replayed_value_target(world_model.values, latents, torch.zeros(3, 7), DISCOUNT).requires_grad


@pytest.mark.parametrize("termination", [False, True])
def test_the_value_loss_reads_what_was_paid_only_if_it_counts(make_world_model, make_loss, slices, termination):
    ends = [("next", "terminated")] if termination else []
    for replayed, read in ((0.0, []), (0.5, [("next", "reward"), *ends])):
        loss = make_loss("value", make_world_model(termination=termination), value_replayed=replayed)
        assert loss.in_keys == ["observation", ("next", "observation"), "action", *read]
        loss(slices.select(*loss.in_keys))


def test_without_a_termination_head_the_targets_bootstrap_through_ends(make_world_model, make_loss, make_slices):
    slices = make_slices()
    loss = make_loss("whole", make_world_model(), value_replayed=1.0, ignore_termination=True)
    targets = []
    for flag in (False, True):
        slices["next", "terminated"][:] = flag
        targets.append(loss(slices)["value_target"])
    assert torch.equal(*targets)


def test_a_slice_that_ends_early_is_worth_what_its_last_counted_step_leads_to(make_world_model, make_loss, make_slices):
    slices = make_slices(slice_len=4)
    loss = make_loss("value", make_world_model(), value_replayed=1.0, reduction="none").eval()
    short = loss(slices[:, :2])["value_target"]
    slices["collector", "mask"] = torch.arange(4).expand(slices.shape) < 2
    slices["next", "reward"][:, 2:] = 1e6
    slices["next", "observation"][:, 2:] = 1e6
    torch.testing.assert_close(loss(slices)["value_target"], short)


@pytest.mark.parametrize("expectile", [0.2, 0.5, 0.7])
def test_values_of_equally_frequent_targets_settle_at_their_expectile(expectile):
    world_model = WorldModel(5, 3, latent_dim=16, mlp_dim=12, num_dynamics=2)  # values are their bias alone
    targets = torch.tensor([[0.0, 100.0]])
    better, worse = (two_hot_encode(targets[0, i], world_model.bins) for i in (1, 0))
    settled = expectile * better + (1 - expectile) * worse
    with torch.no_grad():
        world_model.value_head.output.bias.copy_(settled.clamp_min(1e-12).log())
    rollout = LatentRollout(torch.rand(2, 2, 16), torch.rand(2, 2, 2, 16))
    bias = world_model.value_head.output.bias
    for asked in (0.2, 0.5, 0.7):
        error = value_error(world_model, rollout, targets, dropout=False, expectile=asked).mean()
        (gradient,) = torch.autograd.grad(error, bias)
        assert (gradient.abs().max() < 1e-6) == (asked == expectile)
    value = world_model.values(torch.rand(16))
    torch.testing.assert_close(value, torch.full((2,), math.expm1(expectile * math.log(101))), rtol=1e-4, atol=0)


def test_an_expectile_of_a_float64_model_is_weighed_in_float64():
    world_model = WorldModel(3, 2, latent_dim=16, mlp_dim=32, num_dynamics=1).double()
    rollout = LatentRollout(torch.zeros(2, 4, 16), torch.rand(2, 1, 4, 16, dtype=torch.float64))
    above = torch.full((1, 4), 5.0, dtype=torch.float64)  # new values are 0
    for target, weight in ((above, 2 * 0.7), (-above, 2 * (1 - 0.7))):
        error = value_error(world_model, rollout, target, dropout=False)
        weighed = value_error(world_model, rollout, target, dropout=False, expectile=0.7)
        torch.testing.assert_close(weighed, weight * error, rtol=1e-14, atol=0)


def test_a_term_that_reads_ends_does_not_end_what_is_replayed(make_loss, make_slices, run_seeded):
    term = Term("ends", lambda world_model, slices, rollout: slices.terminated.float(), keys=("terminated",))
    slices, found = make_slices(), []
    slices["next", "terminated"][:] = True
    for terms in ([], [term]):
        torch.manual_seed(0)
        loss = make_loss(value_replayed=1.0, ignore_termination=True, extra_terms=terms)
        found.append(run_seeded(loss.eval(), slices)["value_target"])
    assert torch.equal(*found)
    assert not torch.isclose(found[0], slices["next", "reward"].mean(), atol=1e-2)  # as it were with ends
