from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip("matplotlib")
pytest.importorskip("scipy")

import numpy as np  # noqa: E402
import pandas as pd  # noqa: E402

from torchrl_etdmpc.analysis import interquartile_mean, probability_of_improvement, scores_at  # noqa: E402

# The resamples of the bootstrap do not touch the value, which most of these tests are about.
small = settings(deadline=None, max_examples=20)
FEW = 20
numbers = st.lists(st.integers(-3, 3).map(float), min_size=2, max_size=5)
tasks = st.dictionaries(st.sampled_from("xyz"), numbers, min_size=1)


def draw(seed: int, *, shift: float = 0.0, runs: int = 5) -> dict[str, np.ndarray]:
    generator = np.random.default_rng(seed)
    return {task: generator.normal(shift, 1.0, runs) for task in "xyz"}


def seed_curves(rows: list[tuple]) -> pd.DataFrame:
    return pd.DataFrame(rows, columns=["method", "task", "seed", "env_steps", "return_mean"])


@small
@given(score=st.floats(-10, 10), counts=st.lists(st.integers(2, 5), min_size=1, max_size=3))
def test_the_interquartile_mean_of_equal_scores_is_that_score_without_spread(score, counts):
    scores = {str(task): [score] * count for task, count in enumerate(counts)}
    assert tuple(interquartile_mean(scores, resamples=FEW)) == pytest.approx((score,) * 3)


def test_the_interquartile_mean_pools_tasks_and_ignores_the_outer_quarters():
    scores = np.arange(20.0) ** 2  # of which any other share has another mean
    assert interquartile_mean({"x": scores[:12], "y": scores[12:]}, resamples=FEW).value == scores[5:15].mean()


@small
@given(scores=tasks, scale=st.floats(0.1, 5), shift=st.floats(-5, 5))
def test_the_interquartile_mean_moves_and_scales_with_the_scores(scores, scale, shift):
    value = interquartile_mean(scores, resamples=FEW).value
    moved = {task: scale * np.array(values) + shift for task, values in scores.items()}
    assert interquartile_mean(moved, resamples=FEW).value == pytest.approx(scale * value + shift, abs=1e-9)


@small
@given(scores=tasks, other=tasks)
def test_the_probability_of_improvement_counts_pairs_with_ties_half(scores, other):
    other = {task: other.get(task, [0.0, 1.0]) for task in scores}
    pairs = [
        np.mean([(a > b) + 0.5 * (a == b) for a in values for b in other[task]]) for task, values in scores.items()
    ]
    assert probability_of_improvement(scores, other, resamples=FEW).value == pytest.approx(np.mean(pairs))


@small
@given(scores=tasks)
def test_over_itself_a_method_improves_with_probability_one_half(scores):
    assert probability_of_improvement(scores, scores, resamples=FEW).value == pytest.approx(0.5)


@small
@given(scores=tasks, seed=st.integers(0, 9))
def test_the_probabilities_of_both_directions_add_up_to_one(scores, seed):
    other = {task: np.random.default_rng(seed).integers(-3, 4, 3) for task in scores}
    forth = probability_of_improvement(scores, other, resamples=FEW).value
    back = probability_of_improvement(other, scores, resamples=FEW).value
    assert forth + back == pytest.approx(1)


def test_the_order_of_tasks_and_runs_does_not_matter():
    ours, theirs = draw(0), draw(1)
    turned = {task: ours[task][::-1] for task in "zxy"}
    expected = probability_of_improvement(ours, theirs, resamples=FEW).value
    assert probability_of_improvement(turned, theirs, resamples=FEW).value == pytest.approx(expected)
    expected = interquartile_mean(ours, resamples=FEW).value
    assert interquartile_mean(turned, resamples=FEW).value == pytest.approx(expected)


def test_a_method_that_always_wins_improves_for_sure():
    assert probability_of_improvement(draw(0, shift=100), draw(1)) == (1.0, 1.0, 1.0)
    assert probability_of_improvement(draw(1), draw(0, shift=100)) == (0.0, 0.0, 0.0)


@pytest.mark.parametrize("seed", range(5))
def test_the_intervals_contain_their_value_and_are_not_empty(seed):
    for interval in (interquartile_mean(draw(seed)), probability_of_improvement(draw(seed), draw(seed + 10))):
        assert interval.lower < interval.value < interval.upper
    assert 0 <= interval.lower < interval.upper <= 1


def test_the_limits_are_percentiles_of_the_resamples_so_that_a_probability_stays_one():
    ours, theirs = [1.0, 2.0, 3.0, 4.0, 5.0], [0.0, 0.0, 0.0, 0.0, 4.5]
    found = probability_of_improvement({"x": ours}, {"x": theirs})
    assert 0.8 < found.value < 1
    assert found.upper <= 1


def test_more_runs_give_narrower_intervals():
    few, many = (interquartile_mean(draw(0, runs=runs), resamples=500) for runs in (4, 64))
    assert many.upper - many.lower < (few.upper - few.lower) / 2


def test_the_interval_is_that_of_95_percent():
    """Of many runs, the interval is the normal one of a trimmed mean, whose error is that of the winsorised scores."""
    scores = draw(0, runs=400)["x"]
    middle = np.sort(scores)[100:300]
    error = np.clip(scores, middle[0], middle[-1]).std(ddof=1) / (0.5 * 400**0.5)
    found = interquartile_mean({"x": scores}, resamples=4000)
    assert (found.upper - found.lower) / (2 * error) == pytest.approx(1.96, rel=0.06)


def test_both_methods_are_resampled_each_for_itself():
    scores = {"x": [1.0, 2.0, 3.0, 4.0, 5.0]}
    found = probability_of_improvement(scores, scores)  # if they were drawn as pairs, every resample would be a tie
    assert found.lower < 0.25 and found.upper > 0.75


def test_the_same_scores_give_the_same_interval_and_another_seed_nearly_the_same():
    assert interquartile_mean(draw(0)) == interquartile_mean(draw(0))
    one, other = (interquartile_mean(draw(0), seed=seed) for seed in (0, 1))
    assert one.value == other.value
    assert one.lower != other.lower
    assert one.lower == pytest.approx(other.lower, abs=0.1)


def test_resampling_stays_within_tasks():
    # Pooled over the tasks, a resample could miss one of them; within each task nothing can change.
    assert interquartile_mean({"x": [0.0] * 4, "y": [1.0] * 4}, resamples=200) == (0.5, 0.5, 0.5)


def test_one_run_on_a_task_leaves_the_limits_unknown():
    for interval in (
        interquartile_mean({"x": [1.0, 2.0], "y": [3.0]}),
        probability_of_improvement({"x": [2.0]}, {"x": [1.0, 3.0]}),
        probability_of_improvement({"x": [1.0, 3.0]}, {"x": [2.0]}),
    ):
        assert np.isnan([interval.lower, interval.upper]).all()
        assert np.isfinite(interval.value)


def test_no_scores_are_an_error():
    with pytest.raises(ValueError, match="at least one task, got none"):
        interquartile_mean({})
    with pytest.raises(ValueError, match="scores of the same tasks"):
        probability_of_improvement({}, {})


def test_different_tasks_cannot_be_compared():
    with pytest.raises(ValueError, match=r"scores of the same tasks, got \['x'\] and \['x', 'y'\]"):
        probability_of_improvement({"x": [1.0, 2.0]}, {"x": [1.0, 2.0], "y": [1.0, 2.0]})


def test_scores_are_read_at_the_step_and_runs_that_do_not_reach_it_are_left_out():
    rows = [("a", "x", 1, 25, 0.0), ("a", "x", 1, 75, 10.0)]  # between two evaluations
    rows += [("a", "x", 2, 50, 7.0)]  # exactly there
    rows += [("a", "x", 3, 0, 1.0), ("a", "x", 3, 49, 1.0), ("a", "x", 4, 51, 1.0)]  # ended, not yet begun
    rows += [("a", "y", 1, 50, np.nan)]  # no return
    rows += [("b", "x", 1, 50, 99.0)]  # another method
    scores = scores_at(seed_curves(rows), "a", 50)
    assert {task: sorted(values) for task, values in scores.items()} == {"x": [5.0, 7.0]}


def test_a_method_without_runs_has_no_scores():
    assert scores_at(seed_curves([("a", "x", 1, 0, 0.0)]), "b", 0) == {}
