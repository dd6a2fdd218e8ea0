from __future__ import annotations

import pytest
import torch

from torchrl_etdmpc import AdaptiveScore, FinalScore, MeanScore
from torchrl_etdmpc.testing import LineWorld


def naive_table(model, observation, actions, discount) -> torch.Tensor:
    """Return table ``[H, F, V]`` of one sequence ``[H, A]`` by plain loops; every head rolls on alone."""
    table = torch.zeros(len(actions), model.num_dynamics, model.num_values, dtype=torch.float64)
    for head in range(model.num_dynamics):
        latent, total, alive = model.encode(observation), 0.0, 1.0
        for step, action in enumerate(actions):
            total += discount**step * alive * model.reward(latent, action).item()
            latent = model.next(latent.unsqueeze(0), action)[head]
            ended = model.termination(latent)
            alive *= 1.0 if ended is None else 1 - ended.item()
            for member, value in enumerate(model.values(latent).tolist()):
                table[step, head, member] = total + discount ** (step + 1) * alive * value
    return table


@pytest.mark.parametrize("termination", [False, True])
def test_every_return_estimate_is_that_of_a_head_on_its_own_rollout(termination, make_planner, make_model, states):
    model = make_model(termination=termination)
    planner = make_planner(model, num_samples=6, num_elites=3, num_proposals=2, iterations=2, discount=0.9)
    observation = states(2)
    trace = planner.plan(observation, trace=True).trace
    assert trace.returns.shape == (2, 2, 6, 3, 2, 2)
    with torch.no_grad():
        for state in range(2):
            for iteration in range(2):
                for sequence in range(6):
                    actions = trace.actions[state, iteration, sequence]
                    expected = naive_table(model, observation[state], actions, 0.9)
                    torch.testing.assert_close(trace.returns[state, iteration, sequence], expected)
    # The table has something to get wrong: heads, depths and candidates all differ.
    assert all(trace.returns.std(dim).min() > 1e-6 for dim in (2, 3, 4, 5))


@pytest.mark.parametrize("score", [FinalScore(1.0), MeanScore(-1.0), AdaptiveScore(1.0)])
def test_where_heads_agree_a_score_has_a_gradient(score):
    returns = torch.full((2, 3, 2, 2), 5.0, requires_grad=True)
    score(returns).sum().backward()
    torch.testing.assert_close(returns.grad.sum((1, 2, 3)), torch.ones(2))


def bmpc_return(model, observation, actions, discount) -> float:
    """Return estimate of one sequence ``[H, A]`` with one model and one value: BMPC's."""
    latent, total = model.encode(observation), 0.0
    for step, action in enumerate(actions):
        total += discount**step * model.reward(latent, action).item()
        latent = model.next(latent.unsqueeze(0), action).squeeze(0)
    return total + discount ** len(actions) * model.values(latent).item()


def test_one_head_one_depth_is_bmpc(make_planner, make_model, states):
    model = make_model(num_dynamics=1, num_values=1)
    planner = make_planner(model, num_samples=8, num_proposals=2, num_elites=4, iterations=2, score="final", beta=7.0)
    observation = states(2)
    trace = planner.plan(observation, trace=True).trace
    with torch.no_grad():
        expected = [
            [[bmpc_return(model, start, actions, 0.99) for actions in candidates] for candidates in iterations]
            for start, iterations in zip(observation, trace.actions, strict=True)
        ]
    torch.testing.assert_close(trace.scores, torch.tensor(expected, dtype=torch.float64))


def test_mean_objective_with_horizon_one_equals_final(make_planner, make_model, states, assert_same_plan):
    model, observation = make_model(), states(4)
    mean, final = (make_planner(model, horizon=1, score=score, beta=2.0) for score in ("mean", "final"))
    noise = mean.draw_noise(4)
    assert_same_plan(mean.plan(observation, noise=noise), final.plan(observation, noise=noise))


def test_adaptive_objective_without_penalty_takes_the_best_depth(make_planner, states):
    trace = make_planner(score="adaptive").plan(states(2), trace=True).trace
    torch.testing.assert_close(trace.scores, trace.returns.mean((-2, -1)).amax(-1))
    assert trace.returns.mean((-2, -1)).argmax(-1).unique().numel() > 1


def test_scores_of_named_objectives_are_those_of_the_table(make_planner, states):
    for score, beta in (("final", 3.0), ("mean", 3.0)):
        trace = make_planner(score=score, beta=beta).plan(states(2), trace=True).trace
        averaged = trace.returns.mean(-3).flatten(-2)  # one depth only, with "final"
        sigma = averaged.std(-1) / 2  # of the mean of four estimates
        torch.testing.assert_close(trace.scores, averaged.mean(-1) - beta * sigma)


def test_final_computes_values_at_the_last_depth_only(
    monkeypatch, make_planner, make_model, states, assert_same_plan, count_calls
):
    model, observation = make_model(), states(2)
    final = make_planner(model, score="final", beta=1.0)
    full = make_planner(model, score=lambda returns: FinalScore(1.0)(returns))
    noise = final.draw_noise(2)
    calls = count_calls(monkeypatch, model, "values")
    cheap = final.plan(observation, noise=noise, trace=True)
    assert [shape[0] for shape in calls] == [1] * 3  # one depth in every iteration
    calls.clear()
    dear = full.plan(observation, noise=noise, trace=True)
    assert [shape[0] for shape in calls] == [3] * 3
    assert cheap.trace.returns.shape[-3:] == (1, 2, 2)
    torch.testing.assert_close(cheap.trace.returns, dear.trace.returns[..., -1:, :, :])
    torch.testing.assert_close(cheap.trace.scores, dear.trace.scores)
    assert_same_plan(cheap, dear)


class CliffWorld(LineWorld):
    """A line world in which episodes tend to terminate on the way to the goal."""

    def termination(self, latent):
        return 0.5 * latent[..., 0].clamp(0, 1)


@pytest.mark.parametrize(("score", "expected"), [("final", [-3.22875]), ("mean", [-3.76875, -3.22875])])
def test_returns_are_weighted_by_the_probability_of_being_alive(score, expected, make_planner):
    # From 0, two actions of 1 lead to 0.5 and 1, where the episode has ended with probability 0.25 and 0.5.
    # Rewards -1.5^2 and -1, values -1.5^2 and -1:
    # Q_1 = -2.25 - 0.9 * 0.75 * 2.25 and Q_2 = -2.25 - 0.9 * 0.75 * 1 - 0.81 * 0.75 * 0.5 * 1.
    planner = make_planner(CliffWorld(goal=2.0), horizon=2, num_proposals=0, iterations=1, discount=0.9, score=score)
    noise = planner.draw_noise(1)
    noise = noise._replace(candidates=torch.full_like(noise.candidates, 10.0))
    trace = planner.plan(torch.zeros(1, 1), noise=noise, trace=True).trace
    assert trace.actions.eq(1).all()
    assert trace.returns[0, 0, 0].flatten().tolist() == pytest.approx(expected)
    assert trace.scores[0, 0, 0].item() == pytest.approx(sum(expected) / len(expected))


def test_termination_is_weighed_on_each_heads_own_rollout(make_planner):
    world = CliffWorld(goal=2.0, num_dynamics=2, drift=torch.tensor([[0.3], [-0.3]]))
    trace = make_planner(world, num_samples=6, num_elites=3, num_proposals=2).plan(torch.zeros(1, 1), trace=True).trace
    for actions, returns in zip(trace.actions[0, -1], trace.returns[0, -1], strict=True):
        expected = naive_table(world, torch.zeros(1), actions, 0.99).float()
        torch.testing.assert_close(returns, expected)
