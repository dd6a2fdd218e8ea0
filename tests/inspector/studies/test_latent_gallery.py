from __future__ import annotations

import pytest
import torch

from torchrl_etdmpc.inspector.studies import choose_states, latent_gallery
from torchrl_etdmpc.testing import LineWorld

DRIFT = 0.05


def test_heads_drift_apart_step_by_step_and_their_mean_stays_true(make_episodes, make_planner, WorldSimulator):
    world = LineWorld(num_dynamics=2, num_values=2, drift=[[DRIFT], [-DRIFT]], policy_gain=1.0)
    states = choose_states(make_episodes(world, world.optimal_action), 5, ahead=4)
    planner = make_planner(world)
    result = latent_gallery.latent_gallery(planner, states, WorldSimulator(world), horizon=4)
    assert result.imagined.shape == (5, 2, 2, 5, 2)
    assert result.true.shape == (5, 2, 5, 2)
    assert result.returns.shape == (5, 2, 4, 2, 2)
    expected = DRIFT * torch.arange(1.0, 5)
    assert torch.allclose(result.spread, expected.expand(5, 2, -1), atol=1e-5)
    assert torch.allclose(result.error, torch.zeros(5, 2, 4), atol=1e-5)
    assert torch.allclose(result.deviation, result.returns.flatten(-2).std(-1) / 2)
    # Each head sees minus the squared distance from where it thinks it is: the mean misses the drift's square.
    value = -(result.true[:, :, 1:, 0] - world.goal).square()
    assert torch.allclose(result.returns.mean((-2, -1))[..., 0] + 2 * DRIFT**2, 1.99 * value[..., 0], atol=0.01)


def test_pessimism_keeps_the_heads_together(make_episodes, make_planner, WorldSimulator):
    class Uncertain(LineWorld):
        """Heads that disagree about large actions."""

        def next(self, latent, action):
            following = super().next(latent, action).clone()
            apart = torch.tensor([0.5, -0.5]).view(2, *(1,) * (following.ndim - 2))
            following[..., 0] = following[..., 0] + apart * action[..., 0].square()
            return following

    world = Uncertain(goal=2.0, num_dynamics=2, policy_gain=1.0)
    states = choose_states(make_episodes(world, torch.zeros_like), 6, ahead=3)
    result = latent_gallery.latent_gallery(make_planner(world), states, WorldSimulator(world), betas=(0.0, 10.0))
    assert (result.spread[:, 1, -1] < 0.7 * result.spread[:, 0, -1]).all()
    assert (result.true_returns[:, 1, -1] < result.true_returns[:, 0, -1]).all()  # and costs return
    assert len(latent_gallery.table(result)) == 2 * 3
    axes = latent_gallery.figure(result).axes
    assert len(axes) == 2 * latent_gallery.SHOWN
    assert [len(axis.lines) for axis in axes[: latent_gallery.SHOWN]] == [2 * (2 + 1 + 1) + 1] * latent_gallery.SHOWN
    assert "beta 10 over beta 0, geometric mean: 0." in latent_gallery.lines(result)[0]


def test_every_beta_is_planned_with_the_same_random_numbers(make_episodes, make_planner, WorldSimulator):
    world = LineWorld(num_dynamics=2, drift=[[DRIFT], [-DRIFT]], policy_gain=0.5)
    states = choose_states(make_episodes(world, torch.zeros_like), 4, ahead=3)
    planner = make_planner(world, num_samples=16, num_elites=4, iterations=1)
    result = latent_gallery.latent_gallery(planner, states, WorldSimulator(world), betas=(1.0, 1.0))
    assert torch.equal(*result.imagined.unbind(1))


def test_one_head_has_no_spread_to_speak_of(make_episodes, make_planner, WorldSimulator):
    world = LineWorld(num_dynamics=1, policy_gain=1.0)
    states = choose_states(make_episodes(world, world.optimal_action), 5, ahead=4)
    result = latent_gallery.latent_gallery(make_planner(world), states, WorldSimulator(world), horizon=4)
    (text,) = latent_gallery.lines(result)
    assert text.startswith("true return of the whole plan, beta 10 minus beta 0: ")
    assert len(latent_gallery.figure(result).axes) == 2 * latent_gallery.SHOWN


def test_what_lies_behind_the_end_of_the_task_is_no_error(make_episodes, make_planner, WorldSimulator, EndingSimulator):
    world = LineWorld(num_dynamics=2, drift=[[0.1], [-0.1]], policy_gain=1.0)
    states = choose_states(make_episodes(world, world.optimal_action), 5, ahead=4)
    result = latent_gallery.latent_gallery(make_planner(world), states, EndingSimulator(world), horizon=4)
    assert torch.allclose(result.error[..., :2], torch.zeros(5, 2, 2), atol=1e-5)
    assert result.error[..., 2:].isnan().all()
    assert result.true_returns.isfinite().all()
    latent_gallery.figure(result)
    whole = latent_gallery.latent_gallery(make_planner(world), states, WorldSimulator(world), horizon=4)
    true = whole.true + 1
    true[1:, :, 3:] = torch.nan  # all but one ended
    rows = latent_gallery.table(whole._replace(true=true))
    assert [row["error"] for row in rows] == pytest.approx([2**0.5] * 8, rel=1e-4)


def test_states_in_which_the_heads_agree_exactly_are_left_out_of_the_ratio(make_episodes, make_planner, WorldSimulator):
    world = LineWorld(num_dynamics=2, drift=[[0.1], [-0.1]], policy_gain=1.0)
    states = choose_states(make_episodes(world, world.optimal_action), 5, ahead=4)
    result = latent_gallery.latent_gallery(make_planner(world), states, WorldSimulator(world), horizon=4)
    apart = torch.tensor([1.0, 2.0]).view(2, 1, 1, 1) * torch.tensor([1.0, -1.0]).view(2, 1, 1)  # [b, F, 1, 1]
    imagined = apart.expand_as(result.imagined).clone()
    imagined[0] = 0
    said = latent_gallery.lines(result._replace(imagined=imagined))
    assert said[0].endswith("geometric mean: 2.00 [2.00, 2.00]")
    without = latent_gallery.lines(result._replace(imagined=torch.zeros_like(imagined)))
    assert not any(line.startswith("spread of the heads") for line in without)


def test_the_lines_say_what_the_last_beta_costs_and_the_table_has_every_value_within_its_interval():
    latents, returns = torch.rand(6, 2, 2, 4, 2), torch.rand(6, 2, 3, 2, 2)
    true = torch.tensor([[1.0, 2.0, 5.0], [1.0, 2.0, 3.0]]).expand(6, 2, 3)
    episode = torch.arange(6) % 3
    result = latent_gallery.LatentGallery(latents, latents[:, :, 0], returns, true, (0.0, 10.0), episode)
    assert latent_gallery.lines(result)[-1] == (
        "true return of the whole plan, beta 10 minus beta 0: -2.000 [-2.000, -2.000]"
    )
    rows = latent_gallery.table(result)
    estimates = [row["estimated_return"] for row in rows]
    assert estimates == pytest.approx(returns.mean((0, 3, 4)).flatten().tolist())
    for name in ("spread", "error", "deviation", "estimated_return"):
        assert all(row[f"{name}_low"] < row[name] < row[f"{name}_high"] for row in rows)
