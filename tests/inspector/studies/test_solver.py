from __future__ import annotations

import torch

from torchrl_etdmpc.functional import adaptive_mixture, ensemble_mean
from torchrl_etdmpc.inspector.settings import with_settings
from torchrl_etdmpc.inspector.studies import choose_states, gradient_mixture, solver
from torchrl_etdmpc.inspector.studies.replan import generator_of, replan
from torchrl_etdmpc.testing import LineWorld


def test_gradients_come_closer_to_the_closed_form_and_never_beyond_it():
    torch.manual_seed(0)
    mean, std = torch.randn(30, 5, 4).double(), torch.rand(30, 5, 4).double() + 0.1
    for beta in (0.5, 3.0):
        best, weights = adaptive_mixture(mean, std, beta)
        assert torch.allclose(gradient_mixture.objective(weights, mean, std, beta), best)
        # A fixed step keeps the projected one swinging around the optimum.
        for ascend, last in ((gradient_mixture.softmax_ascent, 1.0), (gradient_mixture.projected_ascent, 0.03)):
            short = [
                best - gradient_mixture.objective(ascend(mean, std, beta, count, rate), mean, std, beta)
                for count, rate in ((0, 1.0), (10, 0.3), (2000, last))
            ]
            assert all((gap > -1e-12).all() for gap in short)
            assert short[0].mean() > 2 * short[1].mean() > 4 * short[2].mean()
            assert short[2].mean() < 1e-3


def test_a_projection_is_the_nearest_point_of_the_simplex():
    torch.manual_seed(0)
    points = torch.randn(20, 5).double() * 2
    projected = gradient_mixture.project(points)
    assert torch.allclose(projected.sum(-1), torch.ones(20).double())
    assert (projected >= 0).all()
    others = torch.rand(500, 1, 5).double().softmax(-1)
    nearest = (points - projected).norm(dim=-1)
    assert (nearest <= (points - others).norm(dim=-1) + 1e-12).all()
    assert (nearest <= (points - torch.eye(5).double().unsqueeze(1)).norm(dim=-1) + 1e-12).all()


def test_the_study_reports_gap_agreement_and_time_of_a_planner_s_candidates(make_episodes, make_planner):
    world = LineWorld(num_dynamics=2, drift=[[0.1], [-0.1]], policy_gain=1.0)
    states = choose_states(make_episodes(world, world.optimal_action), 4)
    planner = make_planner(world, num_samples=32, num_elites=8)
    result = solver.solver(planner, states, betas=(1.0, 10.0), iterations=(1, 200), horizon=3)
    assert result.gap.shape == (2, 2, 2)
    assert (result.gap >= -1e-9).all()
    assert (result.gap[..., 1] <= result.gap[..., 0]).all()
    assert (result.same_best[..., 1] >= 0.5).all()
    assert result.candidates == 4 * 32
    rows = solver.table(result)
    assert len(rows) == 8
    assert all(row["milliseconds"] > 0 for row in rows)
    slower = [row["times_the_closed_form"] for row in rows if row["iterations"] == 200]
    assert min(slower) > 2
    assert len(solver.lines(result)) == 4
    axes = solver.figure(result).axes
    assert [len(axis.lines) for axis in axes] == [3, 3]
    assert axes[0].lines[0].get_ydata().tolist() == result.gap[0, 0].tolist()


def test_the_gap_is_in_deviations_of_the_candidates_and_every_number_of_iterations_has_its_own(monkeypatch):
    monkeypatch.setattr(solver, "_seconds", lambda call: 1.0)
    torch.manual_seed(0)
    mean, std = torch.randn(4, 16, 3).double(), torch.rand(4, 16, 3).double() + 0.1
    iterations = (1, 10, 300)
    gap, same, *_ = solver.compare(mean, std, 1.0, iterations)
    assert gap.shape == same.shape == (2, 3)
    assert (gap[:, 0] > gap[:, 1]).all() and (gap[:, 1] > gap[:, 2]).all()
    larger, *_ = solver.compare(100 * mean, 100 * std, 1.0, iterations)
    assert torch.allclose(larger, gap, rtol=1e-3, atol=1e-6)


def test_the_candidates_are_those_of_the_last_iteration(make_episodes, make_planner, monkeypatch):
    given = []
    monkeypatch.setattr(solver, "compare", lambda mean, *rest: given.append(mean) or (mean,) * 5)
    world = LineWorld(num_dynamics=2, drift=[[0.1], [-0.1]], policy_gain=1.0)
    states, planner = choose_states(make_episodes(world, world.optimal_action), 4), make_planner(world)
    solver.solver(planner, states, betas=(1.0,), horizon=3, seed=2)
    searcher = with_settings(planner, score="adaptive", beta=1.0)
    returns = replan(searcher, states.observation, generator=generator_of(planner, 2), trace=True).trace.returns
    assert torch.equal(given[0], ensemble_mean(returns[:, -1].double()))
