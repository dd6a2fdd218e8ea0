from __future__ import annotations

import numpy as np
import pytest
import torch

from torchrl_etdmpc.inspector import Trace, add_simulation, figures, trace_plan
from torchrl_etdmpc.modules import WorldModel
from torchrl_etdmpc.planners import EnsembleMPPIPlanner, LatentEnv
from torchrl_etdmpc.testing import LineWorld

pytest.importorskip("plotly")


def make(action_dim: int = 2, **settings) -> Trace:
    torch.manual_seed(0)
    model = WorldModel(3, action_dim, latent_dim=16, mlp_dim=16, num_dynamics=2)
    budget = {"horizon": 4, "num_samples": 24, "num_elites": 5, "num_proposals": 4, "iterations": 3}
    planner = EnsembleMPPIPlanner(LatentEnv(model), **budget | settings)
    trace = trace_plan(planner, torch.tensor([0.1, -0.2, 0.3]))
    return add_simulation(trace, torch.tensor([1.0, 2.0, 3.0, 4.0]), torch.randn(5, 3), None, model)


@pytest.fixture(scope="module")
def trace() -> Trace:
    return make(score="adaptive", beta=1.0)


def drawn(figure, name: str):
    return [each for each in figure.data if each.name == name]


def test_the_plane_shows_every_candidate_once_a_head_where_it_leads(trace):
    figure = figures.latent_plane(trace, 1, depth=2, components=(0, 2))
    for head in range(2):
        marks = [drawn(figure, kind)[head] for kind in ("candidate", "elite", "proposal")]
        shown = np.concatenate([mark.customdata for mark in marks])
        assert sorted(shown) == list(range(24))
        for mark in marks:
            places = trace["points"][1, mark.customdata, 1, head]
            assert np.array_equal(mark.x, places[:, 0])
            assert np.array_equal(mark.y, places[:, 2])
            assert np.array_equal(mark.marker.color, trace["scores"][1, mark.customdata])
    assert list(drawn(figure, "proposal")[0].customdata) == [0, 1, 2, 3]
    assert set(drawn(figure, "elite")[0].customdata) == set(trace["elites"][1]) - {0, 1, 2, 3}
    symbols = {kind: drawn(figure, kind)[0].marker.symbol for kind in ("candidate", "elite", "proposal", "chosen")}
    assert len(set(symbols.values())) == 4  # told apart without colour


def test_the_plane_marks_the_chosen_the_real_and_the_clicked(trace):
    figure = figures.latent_plane(trace, -1, candidate=7)
    for head in range(2):
        assert drawn(figure, "chosen")[head].x[-1] == trace["chosen_points"][-1, head, 0]
        assert drawn(figure, "chosen")[head].x[0] == trace["start_point"][0]
        assert np.array_equal(drawn(figure, "simulator")[head].y, trace["real_points"][:, 1])
        ring = figure.layout.shapes[head]
        assert (ring.name, ring.xref, ring.yref) == (("clicked", "x", "y"), ("clicked", "x2", "y2"))[head]
        assert np.array_equal([ring.xanchor, ring.yanchor], trace["points"][-1, 7, -1, head, :2])
    assert not figures.latent_plane(trace).layout.shapes


def test_the_plane_s_axes_hold_all_that_it_shows(trace):
    figure = figures.latent_plane(trace, 0, components=(1, 2))
    for axis, name in ((figure.layout.xaxis, "x"), (figure.layout.yaxis, "y")):
        shown = np.concatenate([each[name] for each in figure.data])
        low, high = axis.range
        assert low < shown.min() and shown.max() < high
        assert high - low < 1.2 * np.ptp(shown)


def test_a_figure_is_drawn_as_plain_dictionaries_without_plotly_s_checks(trace):
    for name in figures.FIGURES:
        figure = getattr(figures, name)
        plain = figures.plain(figure)(trace)
        assert isinstance(plain, dict)
        assert [each.name for each in figure(trace).data] == [each.get("name") for each in plain["data"]]


def test_the_return_table_is_that_of_the_candidate(trace):
    shown = figures.return_table(trace, 1, 9).data[0]
    assert np.array_equal(shown.z, trace["returns"][1, 9].reshape(4, -1))
    assert list(shown.x) == ["1.1", "1.2", "2.1", "2.2"]
    assert np.array_equal(figures.return_table(trace).data[0].z, trace["chosen_returns"].reshape(4, -1))


def test_a_score_of_the_last_depth_has_one_row_named_by_its_depth():
    shown = figures.return_table(make(score="final"), 0, 3).data[0]
    assert (shown.z.shape, list(shown.y)) == ((1, 4), ["4"])


def test_the_gaussian_is_that_of_the_iteration(trace):
    figure = figures.plan_gaussian(trace, 0)
    for number in range(2):
        (line,) = drawn(figure, f"a{number + 1}")
        assert np.array_equal(line.y, trace["mean"][0, :, number])
        assert np.array_equal(line.customdata, trace["std"][0, :, number])


def test_the_deviation_of_a_plan_of_one_step_is_a_bar():
    one = make(horizon=1)
    (line,) = drawn(figures.plan_gaussian(one), "a1")
    assert np.array_equal(line.error_y.array, one["std"][-1, :, 0])
    assert drawn(figures.plan_gaussian(make()), "a1")[0].error_y.array is None


def test_many_action_dimensions_are_an_image():
    many = make(action_dim=9)
    mean, std = figures.plan_gaussian(many, 1).data
    assert np.array_equal(mean.z, many["mean"][1].T)
    assert np.array_equal(std.z, many["std"][1].T)


def test_mixture_weights_are_the_elites_mean_or_the_candidate_s(trace):
    rows = figures.mixture_weights(trace).data[0].z
    assert np.allclose(rows[2], trace["mixture"][2, trace["elites"][2]].mean(0))
    assert np.allclose(rows.sum(1), 1, atol=1e-5)
    assert np.array_equal(figures.mixture_weights(trace, 5).data[0].z, trace["mixture"][:, 5])
    assert not figures.mixture_weights(make()).data


def test_elites_without_a_finite_score_count_in_no_mean():
    """The planner gives them no weight; the mixture of returns that are NaN would be all of depth 1."""

    class Diverging(LineWorld):
        def next(self, latent, action):
            return torch.where(action[..., :1] > 0.9, torch.nan, super().next(latent, action))

    budget = {"horizon": 3, "num_samples": 16, "num_elites": 12, "num_proposals": 2, "iterations": 2}
    planner = EnsembleMPPIPlanner(LatentEnv(Diverging(num_dynamics=2)), score="adaptive", beta=1.0, **budget)
    trace = trace_plan(planner, torch.tensor([0.5]))
    scores = trace["scores"][0]
    finite = [index for index in trace["elites"][0] if np.isfinite(scores[index])]
    assert 0 < len(finite) < len(trace["elites"][0])
    assert np.isnan(trace["mixture"][0][~np.isfinite(scores)]).all()
    row = figures.mixture_weights(trace).data[0].z[0]
    np.testing.assert_allclose(row, trace["mixture"][0][finite].mean(0), rtol=1e-6)
    (elites,) = [line.y for line in figures.disagreement(trace, 0).data if line.name == "elites" and line.xaxis == "x"]
    np.testing.assert_allclose(elites, trace["returns"][0][finite].std((-2, -1)).mean(0), rtol=1e-5)


def test_disagreement_is_the_spread_over_heads_by_depth(trace):
    figure = figures.disagreement(trace, 1, 6)
    table, latents = drawn(figure, "clicked")
    assert np.allclose(table.y, trace["returns"][1, 6].std((1, 2)))
    assert np.array_equal(latents.y, trace["latent_spread"][1, 6])
    assert np.allclose(drawn(figure, "chosen")[0].y, trace["chosen_returns"].std((1, 2)))
    assert list(table.x) == [1, 2, 3, 4]


def test_plan_policy_scores_and_rewards_are_the_trace_s(trace):
    bars = figures.plan_and_policy(trace)
    assert np.array_equal(drawn(bars, "plan")[0].y, trace["action"])
    assert np.array_equal(drawn(bars, "policy")[0].y, trace["policy_action"])
    scores = figures.score_spread(trace)
    assert np.array_equal(drawn(scores, "best elite")[0].y, trace["scores"].max(1))
    rewards = figures.reward_check(trace)
    assert np.array_equal(drawn(rewards, "simulator")[0].y, trace["real_rewards"])
    assert np.array_equal(drawn(rewards, "head 2")[0].y, trace["chosen_rewards"][:, 1])


def test_a_comparison_is_second_less_first(trace):
    other = make(horizon=3)
    gap = figures.compare_plans(trace, other).data[0].z
    assert np.array_equal(gap, other["mean"][-1] - trace["mean"][-1, :3])


def test_scores_that_are_not_finite_do_not_break_a_figure():
    broken = make(score=lambda returns: returns.sum((-3, -2, -1)) * torch.nan)
    for name in figures.FIGURES:
        assert getattr(figures, name)(broken).to_json()
