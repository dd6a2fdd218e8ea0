from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from torchrl_etdmpc import Plan, WorldModel
from torchrl_etdmpc.modules import ActionValueWorldModel
from torchrl_etdmpc.testing import LineWorld

_WIDE = {"proposal_log_std_min": -2.0, "proposal_log_std_max": 1.0}


# Model predictive path integral control, step by step


_BUDGETS = {
    "usual": {},
    "no proposals": {"num_proposals": 0},
    "everyone is an elite": {"num_elites": 24},
    "one elite": {"num_elites": 1},
    "one free candidate": {"num_proposals": 23},
    "hot": {"inverse_temperature": 0.01},
    "cold": {"inverse_temperature": 20.0},
}


@pytest.mark.parametrize("name", _BUDGETS)
def test_every_iteration_refits_the_elites(name, make_planner, states, elites_by_hand):
    planner = make_planner(**_BUDGETS[name])
    trace = planner.plan(states(2), trace=True).trace
    for i in range(2):
        for iteration in range(3):
            actions, scores = trace.actions[i, iteration], trace.scores[i, iteration]
            best, weights = elites_by_hand(planner, actions, scores)
            mean = sum(w * actions[n] for n, w in zip(best, weights, strict=True))
            variance = sum(w * (actions[n] - mean) ** 2 for n, w in zip(best, weights, strict=True))
            torch.testing.assert_close(trace.mean[i, iteration], mean)
            torch.testing.assert_close(trace.std[i, iteration], variance.sqrt().clamp(0.05, 2.0))


@pytest.mark.parametrize("name", _BUDGETS)
def test_every_iteration_draws_around_the_previous_fit(name, make_planner, states):
    planner = make_planner(**_BUDGETS[name])
    noise = planner.draw_noise(2)
    trace = planner.plan(states(2), noise=noise, trace=True).trace
    mean, std = torch.zeros(2, 1, 3, 2), torch.full((2, 1, 3, 2), 2.0)
    for iteration in range(3):
        drawn = (mean + std * noise.candidates[:, iteration]).clamp(-1, 1)
        torch.testing.assert_close(trace.actions[:, iteration, planner.num_proposals :], drawn)
        mean, std = trace.mean[:, iteration, None], trace.std[:, iteration, None]
    assert trace.actions.abs().max() == 1


def test_the_spread_stays_within_its_bounds(make_planner, states):
    planner = make_planner(std_min=0.25, std_max=0.3)
    noise = planner.draw_noise(20)
    trace = planner.plan(states(20), noise=noise, trace=True).trace
    assert (trace.std.min().item(), trace.std.max().item()) == pytest.approx((0.25, 0.3))
    # The first iteration draws with the largest.
    torch.testing.assert_close(trace.actions[:, 0, 5:], (0.3 * noise.candidates[:, 0]).clamp(-1, 1))


def test_proposals_come_first_in_every_iteration_and_are_scored_once(
    monkeypatch, make_planner, make_model, states, count_calls
):
    model = make_model()
    calls = count_calls(monkeypatch, model, "reward")
    trace = make_planner(model).plan(states(2), trace=True).trace
    for field in (trace.actions, trace.scores, trace.returns):
        assert torch.equal(field[:, 1:, :5], field[:, :1, :5].expand_as(field[:, 1:, :5]))
        assert not torch.equal(field[:, 1, 5:], field[:, 0, 5:])
    # All 24 candidates of two states in the first iteration, then the 19 free ones; one call for three steps, the first
    # of which is the same for both heads.
    assert calls == [(2 * 24 * (1 + 2 * 2), 16), *[(2 * 19 * (1 + 2 * 2), 16)] * 2]


@pytest.mark.parametrize("num_proposals", [1, 2, 7])
def test_proposals_take_turns_in_the_dynamics_heads(num_proposals, make_planner, make_model, states):
    model, observation = make_model(num_dynamics=3), states(2)
    planner = make_planner(model, num_proposals=num_proposals)
    noise = planner.draw_noise(2)
    trace = planner.plan(observation, noise=noise, trace=True).trace

    def propose(i, p, head):
        latent, actions = model.encode(observation[i]), []
        for step in range(3):
            mean, log_std = model.policy(latent)
            actions.append((mean + log_std.exp() * noise.proposals[i, p, step]).clamp(-1, 1))
            latent = model.next(latent.unsqueeze(0), actions[-1])[head]
        return torch.stack(actions)

    with torch.no_grad():
        for i in range(2):
            for p in range(num_proposals):
                torch.testing.assert_close(trace.actions[i, 0, p], propose(i, p, p % 3))
                assert not torch.allclose(trace.actions[i, 0, p], propose(i, p, (p + 1) % 3))


def test_a_knowing_policy_is_followed(make_planner):
    world = LineWorld(goal=0.3, policy_gain=1.0, log_std_bounds=(-9.0, -8.0))
    plan = make_planner(world, num_samples=6, num_elites=1, iterations=1).plan(torch.zeros(1), explore=False)
    torch.testing.assert_close(plan.loc, torch.tensor([0.6]), atol=1e-2, rtol=0)


def test_wider_bounds_change_the_proposals_only(make_planner, make_model, states):
    model, observation = make_model(), states(2)
    narrow, wide = make_planner(model), make_planner(model, **_WIDE)
    noise = narrow.draw_noise(2)
    usual, widened = (planner.plan(observation, noise=noise, trace=True).trace for planner in (narrow, wide))
    assert torch.equal(widened.actions[:, 0, 5:], usual.actions[:, 0, 5:])
    assert torch.equal(widened.scores[:, 0, 5:], usual.scores[:, 0, 5:])
    with torch.no_grad():
        latent = model.encode(observation)
        for bounds, trace in ((None, usual), ((-2.0, 1.0), widened)):
            for p in range(5):
                first = model.act(latent, noise.proposals[:, p, 0], bounds)
                torch.testing.assert_close(trace.actions[:, 0, p, 0], first)
    assert not torch.allclose(widened.actions[:, 0, :5], usual.actions[:, 0, :5])


@pytest.mark.parametrize(
    ("action_dim", "options", "expected"),
    [
        (20, {}, 3),
        (21, {}, 5),
        (21, {"extra_iterations": 0}, 3),
        (21, {"extra_iterations": 4}, 7),
        (2, {"large_action_dim": 2}, 3),
        (2, {"large_action_dim": 1}, 5),
    ],
)
def test_large_action_spaces_get_more_iterations(action_dim, options, expected, make_planner):
    planner = make_planner(LineWorld(action_dim=action_dim), **options)
    assert planner.iterations == expected
    assert planner.plan(torch.zeros(action_dim), trace=True).trace.scores.shape == (expected, 24)


# Noise


def test_the_noise_decides_everything(make_planner, states):
    planner, observation = make_planner(), states(3)
    noise = planner.draw_noise(3)
    first, second = (planner.plan(observation, noise=noise) for _ in range(2))
    for name in Plan._fields[:-1]:
        assert torch.equal(getattr(first, name), getattr(second, name))
    assert not torch.equal(planner.plan(observation).loc, planner.plan(observation).loc)


def test_plans_repeat_with_the_global_seed(make_planner, states, run):
    planner = make_planner(warm_start=True)
    td = TensorDict({"observation": states(3), "is_init": torch.ones(3, 1, dtype=torch.bool)}, batch_size=[3])
    assert (run(planner, td, seed=5) == run(planner, td, seed=5)).all()
    assert not torch.equal(run(planner, td, seed=5)["plan", "loc"], run(planner, td, seed=6)["plan", "loc"])


@pytest.mark.parametrize("kind", [WorldModel, ActionValueWorldModel])
def test_a_generator_draws_the_noise_and_leaves_the_global_one_alone(make_planner, kind):
    planner = make_planner(kind(3, 2, latent_dim=16, mlp_dim=16).double())
    state = torch.get_rng_state()
    first, second = (planner.draw_noise(3, generator=torch.Generator().manual_seed(1)) for _ in range(2))
    planner.plan(torch.zeros(3, 3, dtype=torch.float64), noise=first)
    assert torch.equal(torch.get_rng_state(), state)
    for a, b in zip(first, second, strict=True):
        assert torch.equal(a, b)


def test_the_noise_is_standard(make_planner):
    noise = make_planner(num_samples=128).draw_noise(50)
    for draw in (noise.proposals, noise.candidates):
        assert draw.mean().item() == pytest.approx(0, abs=0.06)
        assert draw.std().item() == pytest.approx(1, abs=0.05)
    assert noise.elite.min() >= 0
    assert noise.elite.max() < 1
    assert noise.elite.mean().item() == pytest.approx(0.5, abs=0.06)
    assert {draw.dtype for draw in noise} == {torch.float64}


@pytest.mark.parametrize("kind", [WorldModel, ActionValueWorldModel])
def test_states_candidates_and_steps_share_no_draw(make_planner, kind):
    noise = make_planner(kind(3, 2, latent_dim=16, mlp_dim=16).double()).draw_noise(5)
    for draw in noise:
        assert len(draw.unique()) == draw.numel()
