from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_etdmpc.functional import sample_elite
from torchrl_etdmpc.testing import LineWorld


def test_training_draws_an_elite_and_evaluation_takes_the_best_unless_told_otherwise(make_planner):
    planner = make_planner()
    assert (planner.first_action, planner.eval_first_action) == ("elite", "best")


@pytest.mark.parametrize("mode", [ExplorationType.DETERMINISTIC, ExplorationType.MODE, ExplorationType.MEAN])
def test_without_exploration_the_action_is_the_mean_of_the_target(mode, make_planner, states):
    planner = make_planner(eval_first_action="elite")
    with set_exploration_type(mode):
        out = planner(TensorDict({"observation": states(10)}, batch_size=[10]))
    assert torch.equal(out["action"], out["plan", "loc"])


def test_an_exploring_action_is_a_sample_of_the_target(make_planner, states):
    planner = make_planner()
    noise = planner.draw_noise(20)
    plan = planner.plan(states(20), noise=noise, explore=True)
    torch.testing.assert_close(plan.action, (plan.loc + plan.scale * noise.action).clamp(-1, 1))
    assert (plan.action != plan.loc).any(-1).all()


def test_exploring_actions_spread_as_the_target_says(make_planner):
    planner = make_planner(LineWorld(goal=0.0), std_min=0.1, std_max=0.1)
    with set_exploration_type(ExplorationType.RANDOM):
        out = planner(TensorDict({"observation": torch.zeros(4000, 1)}, batch_size=[4000]))
    assert out["plan", "scale"].unique().tolist() == pytest.approx([0.1])
    deviation = (out["action"] - out["plan", "loc"]) / 0.1
    assert deviation.mean().item() == pytest.approx(0, abs=0.08)
    assert deviation.std().item() == pytest.approx(1, abs=0.05)


@pytest.mark.parametrize(("training", "evaluation"), [("elite", "mean"), ("mean", "best"), ("best", "elite")])
def test_training_and_evaluation_choose_their_own_first_action(training, evaluation, make_planner, make_model, states):
    model, observation = make_model(), states(3)
    planner = make_planner(model, first_action=training, eval_first_action=evaluation)
    noise = planner.draw_noise(3)
    for explore, mode in ((True, training), (False, evaluation)):
        expected = make_planner(model, first_action=mode, eval_first_action=mode).plan(observation, noise=noise)
        torch.testing.assert_close(planner.plan(observation, noise=noise, explore=explore).loc, expected.loc)


def test_the_best_first_action_is_that_of_the_highest_scoring_candidate(make_planner, states):
    plan = make_planner(first_action="best").plan(states(6), trace=True)
    for i in range(6):
        scores = plan.trace.scores[i, -1]
        assert torch.equal(plan.loc[i], plan.trace.actions[i, -1, scores.argmax(), 0])
        assert plan.value[i] == scores.max()


def test_the_mean_first_action_is_the_fitted_mean(make_planner, states, elites_by_hand):
    planner = make_planner(first_action="mean")
    plan = planner.plan(states(6), trace=True)
    assert torch.equal(plan.loc, plan.trace.mean[:, -1, 0])
    for i in range(6):
        best, weights = elites_by_hand(planner, plan.trace.actions[i, -1], plan.trace.scores[i, -1])
        expected = sum(w * plan.trace.scores[i, -1, n].item() for n, w in zip(best, weights, strict=True))
        assert plan.value[i].item() == pytest.approx(expected)


def test_elites_are_drawn_as_often_as_they_weigh(make_planner, rows, elites_by_hand):
    planner = make_planner(
        LineWorld(), horizon=2, num_samples=8, num_elites=4, num_proposals=2, iterations=1, inverse_temperature=0.2
    )
    draws = 4000
    noise = rows(planner.draw_noise(1), [0] * draws)
    noise = noise._replace(elite=torch.rand(draws, 4))
    plan = planner.plan(torch.zeros(draws, 1), noise=noise, trace=True)
    best, weights = elites_by_hand(planner, plan.trace.actions[0, 0], plan.trace.scores[0, 0])
    assert 0.02 < min(weights) < max(weights) < 0.9
    total = 0.0
    for index, weight in zip(best, weights, strict=True):
        chosen = (plan.loc == plan.trace.actions[0, 0, index, 0]).all(-1)
        total += chosen.double().mean().item()
        assert chosen.double().mean().item() == pytest.approx(weight, abs=4 * math.sqrt(weight * (1 - weight) / draws))
        assert plan.value[chosen].unique().item() == plan.trace.scores[0, 0, index].item()
    assert total == pytest.approx(1)


def test_the_target_has_the_spread_of_the_last_fit(make_planner, states):
    plan = make_planner().plan(states(3), trace=True)
    assert torch.equal(plan.scale, plan.trace.std[:, -1, 0])


def test_in_half_precision_too_elites_are_drawn_by_weight(make_planner):
    planner = make_planner(horizon=1, iterations=1, num_samples=64, num_proposals=0, num_elites=64)
    noise = planner.draw_noise(100_000, dtype=torch.bfloat16, generator=torch.Generator().manual_seed(0))
    drawn = sample_elite(torch.full((100_000, 64), 1 / 64, dtype=torch.bfloat16), noise.elite)
    assert (drawn < 32).float().mean().item() == pytest.approx(0.5, abs=0.0064)  # four standard errors
    shares = torch.bincount(drawn, minlength=64) / len(drawn)
    torch.testing.assert_close(shares, torch.full((64,), 1 / 64), atol=0.0016, rtol=0)
