"""Value targets that replayed transitions correct: what of a model's errors they cancel."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from torchrl_etdmpc.objectives import Transition, imagined_value_target, model_error

DISCOUNT = 0.99


class Track:
    """A position that actions move, paid by how far it is; the model imagines steps that are ``bias`` longer.

    The latent is the position, the value whatever a function says of it, the policy's action always the same.
    """

    num_dynamics = 2

    def __init__(self, bias: float = 0.0, reward_bias: float = 0.0, action: float = 0.5) -> None:
        self.bias, self.reward_bias, self.action = bias, reward_bias, action

    def act(self, latent: Tensor, noise: Tensor) -> Tensor:
        return torch.full_like(noise, self.action)

    def truly(self, latent: Tensor, action: Tensor) -> Transition:
        following = latent + action
        return Transition(latent, action, following.squeeze(-1), following)

    def next(self, latent: Tensor, action: Tensor) -> Tensor:
        return (latent + action + self.bias).expand(self.num_dynamics, *action.shape)

    def reward(self, latent: Tensor, action: Tensor) -> Tensor:
        return (latent + action).squeeze(-1) + self.reward_bias

    def termination(self, latent: Tensor) -> Tensor | None:
        return None


def linear_value(latent: Tensor) -> Tensor:
    return torch.cat([10 * latent, 14 * latent], -1)  # two heads, 12 per unit in the mean


@pytest.fixture
def positions() -> Tensor:
    return torch.linspace(-2, 2, 9, dtype=torch.float64).unsqueeze(-1)


def corrected_target(world: Track, latent: Tensor, action: Tensor, values=linear_value) -> Tensor:
    imagined = imagined_value_target(world, values, latent, torch.zeros_like(latent), DISCOUNT)
    return imagined + model_error(world, values, world.truly(latent, action), DISCOUNT)


def test_an_exact_model_has_no_error(positions):
    error = model_error(Track(), linear_value, Track().truly(positions, torch.rand_like(positions)), DISCOUNT)
    torch.testing.assert_close(error, torch.zeros_like(error))


def test_the_error_is_what_happened_less_what_was_imagined(positions):
    world = Track(bias=0.1, reward_bias=0.3)
    error = model_error(world, linear_value, world.truly(positions, torch.rand_like(positions)), DISCOUNT)
    torch.testing.assert_close(error, torch.full_like(error, -0.3 - DISCOUNT * 12 * 0.1))


def test_after_the_policys_own_action_the_target_is_what_happened_whatever_the_model_says(positions):
    world = Track(bias=3.0, reward_bias=-5.0)
    happened = world.truly(positions, torch.full_like(positions, world.action))
    expected = happened.reward + DISCOUNT * linear_value(happened.following).mean(-1)
    torch.testing.assert_close(corrected_target(world, positions, happened.action), expected)


@pytest.mark.parametrize("action", [-1.0, 0.2, 1.0])
def test_an_error_that_is_the_same_for_every_action_cancels(positions, action):
    world, exact = Track(bias=0.4, reward_bias=0.3), Track()
    expected = imagined_value_target(exact, linear_value, positions, torch.zeros_like(positions), DISCOUNT)
    torch.testing.assert_close(corrected_target(world, positions, torch.full_like(positions, action)), expected)


def test_a_terminal_state_is_worth_nothing_more():
    world = Track()
    ends = torch.tensor([False, True])
    step = world.truly(torch.ones(2, 1), torch.ones(2, 1))._replace(terminated=ends)
    error = model_error(world, linear_value, step, DISCOUNT)
    torch.testing.assert_close(error, torch.tensor([0.0, -DISCOUNT * 24]))


def test_a_value_that_nothing_pays_for_fades_although_the_model_sees_progress_in_every_step():
    """An agent stands still, unpaid; its model says that each step comes a hundredth of the value closer."""

    class Optimistic(Track):
        def next(self, latent: Tensor, action: Tensor) -> Tensor:
            return (latent + 1).expand(self.num_dynamics, *latent.shape)

        def reward(self, latent: Tensor, action: Tensor) -> Tensor:
            return torch.zeros(latent.shape[:-1])

        def truly(self, latent: Tensor, action: Tensor) -> Transition:
            return Transition(latent, action, torch.zeros(latent.shape[:-1]), latent)

    world, here = Optimistic(), torch.zeros(1, 1)
    left = {}
    for corrected in (False, True):
        value = torch.tensor(137.0)
        for _ in range(1000):
            # What lies one imagined step ahead is worth a hundredth more than the state itself.
            values = lambda latent, value=value: (value * (1 + latent / 99)).expand(*latent.shape[:-1], 2)  # noqa: E731
            target = imagined_value_target(world, values, here, torch.zeros(1, 1), DISCOUNT)
            if corrected:
                target = target + model_error(world, values, world.truly(here, torch.zeros(1, 1)), DISCOUNT)
            value = target[0]
        left[corrected] = value.item()
    assert left[False] == pytest.approx(137, rel=1e-3)
    assert left[True] < 0.01


def test_the_correction_has_no_gradient(make_world_model):
    world_model = make_world_model()
    latent, following = (torch.rand(7, 16, requires_grad=True) for _ in range(2))
    step = Transition(latent, torch.zeros(7, 3), torch.zeros(7), following)
    assert not model_error(world_model, world_model.values, step, DISCOUNT).requires_grad


@pytest.mark.parametrize("termination", [False, True])
def test_the_value_loss_reads_rewards_and_ends_only_if_it_is_corrected(
    make_world_model, make_loss, slices, termination
):
    ends = [("next", "terminated")] if termination else []
    for correction, read in ((0.0, []), (0.5, [("next", "reward"), *ends])):
        loss = make_loss("value", make_world_model(termination=termination), value_correction=correction)
        assert loss.in_keys == ["observation", ("next", "observation"), "action", *read]
        loss(slices.select(*loss.in_keys))


def test_without_a_termination_head_a_correction_bootstraps_through_ends_too(make_world_model, make_loss, make_slices):
    slices = make_slices()
    loss = make_loss("whole", make_world_model(), value_correction=1.0, ignore_termination=True)
    values = []
    for flag in (False, True):
        slices["next", "terminated"][:] = flag
        torch.manual_seed(1)
        values.append(loss(slices)["value_target"])
    assert torch.equal(*values)
