from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip("matplotlib")
pytest.importorskip("pandas")

import numpy as np  # noqa: E402
import pandas as pd  # noqa: E402

from torchrl_etdmpc.analysis import (  # noqa: E402
    add_interval,
    aggregate,
    auc,
    auc_of_seeds,
    estimate,
    interpolate,
    normalise,
    normalisers,
    seed_estimates,
    shared_grid,
)

small = settings(deadline=None, max_examples=25)
returns = st.floats(-1000, 1000)
errors = st.floats(0, 100)


def curve(steps, means, *, errors=np.nan, seeds=3, method="a", task="x") -> pd.DataFrame:
    """One curve of estimates."""
    columns = {"method": method, "task": task, "env_steps": np.asarray(steps, dtype=float)}
    values = {"mean": np.broadcast_to(np.asarray(means, float), np.shape(steps))}
    values["standard_error"] = np.broadcast_to(np.asarray(errors, float), np.shape(steps))
    return pd.DataFrame(columns | values | {"seeds": np.broadcast_to(seeds, np.shape(steps))})


def seed_curves(table: dict[int, dict[float, float]], *, method="a", task="x") -> pd.DataFrame:
    """Returns by seed and step."""
    rows = [(method, task, seed, step, value) for seed, row in table.items() for step, value in row.items()]
    return pd.DataFrame(rows, columns=["method", "task", "seed", "env_steps", "return_mean"])


def shuffled(table: pd.DataFrame, seed: int = 0) -> pd.DataFrame:
    return table.sample(frac=1, random_state=seed, ignore_index=True)


def area(table: pd.DataFrame) -> float:
    (row,) = auc(table).itertuples()
    return row.auc


@st.composite
def steps_and_means(draw, min_size: int = 2):
    """Increasing steps up to a million, and a return at each."""
    steps = sorted(draw(st.sets(st.integers(0, 1_000_000), min_size=min_size, max_size=6)))
    return steps, draw(st.lists(returns, min_size=len(steps), max_size=len(steps)))


# Means over seeds


@small
@given(rows=st.lists(st.lists(returns | st.just(np.nan), min_size=3, max_size=3), min_size=1, max_size=5))
def test_the_estimate_is_numpys_mean_and_standard_error_of_the_seeds_that_have_a_return(rows):
    steps = (0, 1000, 2000)
    table = estimate(seed_curves({seed: dict(zip(steps, row, strict=True)) for seed, row in enumerate(rows)}))
    table = table.set_index("env_steps")
    for step, column in zip(steps, np.array(rows).T, strict=True):
        there = column[~np.isnan(column)]
        if not len(there):
            assert step not in table.index
            continue
        row = table.loc[step]
        assert row["seeds"] == len(there)
        assert row["mean"] == pytest.approx(np.mean(there), abs=1e-9)
        if len(there) == 1:
            assert np.isnan(row["standard_error"])
        else:
            expected = np.std(there, ddof=1) / np.sqrt(len(there))
            assert row["standard_error"] == pytest.approx(expected, rel=1e-6, abs=1e-9)


def test_an_estimate_by_hand():
    table = estimate(seed_curves({1: {0: 1.0}, 2: {0: 3.0}, 3: {0: 8.0}}))
    # mean 4; squares 9 + 1 + 16 = 26; variance 13; standard error sqrt(13 / 3)
    assert table[["mean", "standard_error", "seeds"]].to_numpy().tolist() == [[4.0, pytest.approx((13 / 3) ** 0.5), 3]]


def test_one_seed_is_a_mean_without_an_interval():
    table = add_interval(estimate(seed_curves({5: {0: 1.0, 1000: 2.0}})))
    assert table["mean"].tolist() == [1.0, 2.0]
    assert table["seeds"].tolist() == [1, 1]
    assert table[["standard_error", "std", "lower", "upper"]].isna().all(axis=None)


def test_the_order_of_rows_and_the_names_of_seeds_do_not_matter():
    table = seed_curves({1: {0: 1.0, 10: 2.0}, 2: {0: 4.0, 10: -3.0}, 3: {0: 0.5, 10: 7.0}})
    expected = estimate(table)
    for seed in range(5):
        pd.testing.assert_frame_equal(estimate(shuffled(table, seed)), expected)
    pd.testing.assert_frame_equal(estimate(table.assign(seed=table["seed"].map({1: 30, 2: 7, 3: 1}))), expected)


def test_equal_seeds_have_no_spread():
    table = estimate(seed_curves({seed: {0: 3.5} for seed in range(4)}))
    assert table[["mean", "standard_error"]].to_numpy().tolist() == [[3.5, 0.0]]


def test_methods_and_tasks_are_not_mixed():
    parts = [seed_curves({1: {0: n}, 2: {0: n}}, method=m, task=t) for n, (m, t) in enumerate(["ax", "ay", "bx"])]
    table = estimate(pd.concat(parts))
    assert table[["method", "task", "mean"]].to_numpy().tolist() == [["a", "x", 0], ["a", "y", 1], ["b", "x", 2]]


def test_seeds_with_different_evaluations_are_counted_where_they_are():
    table = estimate(seed_curves({1: {0: 1.0, 500: 5.0}, 2: {0: 3.0, 1000: 9.0}}))
    assert table[["env_steps", "mean", "seeds"]].to_numpy().tolist() == [[0, 2, 2], [500, 5, 1], [1000, 9, 1]]


@given(mean=returns, error=errors, seeds=st.integers(2, 20))
@small
def test_the_interval_is_1_96_standard_errors_to_both_sides_and_std_undoes_the_root(mean, error, seeds):
    (row,) = add_interval(curve([0], mean, errors=error, seeds=seeds)).itertuples()
    assert row.upper - row.mean == pytest.approx(1.96 * error, abs=1e-9)
    assert row.mean - row.lower == pytest.approx(1.96 * error, abs=1e-9)
    assert row.std == pytest.approx(error * seeds**0.5)


# Interpolation


@small
@given(data=steps_and_means(min_size=1), grid=st.sets(st.integers(-100, 1_100_000), min_size=1, max_size=8))
def test_interpolation_never_extrapolates_and_stays_between_its_neighbours(data, grid):
    steps, means = data
    table = interpolate(curve(steps, means), np.array(sorted(grid), dtype=float))
    for row in table.itertuples():
        # an evaluation at 0 is of the untrained agent: it counts there, and no line leaves it
        before = [
            mean for step, mean in zip(steps, means, strict=True) if min(1, row.env_steps) <= step <= row.env_steps
        ]
        after = [mean for step, mean in zip(steps, means, strict=True) if step >= row.env_steps]
        if before and after:
            low, high = sorted((before[-1], after[0]))
            assert low - 1e-6 <= row.mean <= high + 1e-6
            assert row.seeds == 3
        else:
            assert np.isnan(row.mean) and np.isnan(row.standard_error) and np.isnan(row.seeds)


@small
@given(data=steps_and_means(), seed=st.integers(0, 9))
def test_interpolation_at_a_curves_own_steps_changes_nothing_whatever_the_order_of_its_rows(data, seed):
    table = curve(*data, errors=np.abs(data[1]))
    result = interpolate(shuffled(table, seed), np.array(data[0], dtype=float))
    pd.testing.assert_frame_equal(result, table, check_dtype=False)


def test_interpolation_by_hand():
    table = curve([100, 200, 400], [1.0, 3.0, -1.0], errors=[0.5, 1.5, 0.5], seeds=[5, 3, 4])
    result = interpolate(table, np.array([50.0, 100.0, 150.0, 200.0, 250.0, 400.0, 401.0]))
    nan = np.nan
    np.testing.assert_allclose(result["mean"], [nan, 1.0, 2.0, 3.0, 2.0, -1.0, nan])
    np.testing.assert_allclose(result["standard_error"], [nan, 0.5, 1.0, 1.5, 1.25, 0.5, nan])
    np.testing.assert_array_equal(result["seeds"], [nan, 5, 3, 3, 3, 4, nan])


def test_curves_on_different_grids_meet_on_one():
    coarse, fine = curve([5, 105], [0.0, 10.0]), curve([5, 30, 55, 80, 105], [0, 2.5, 5.0, 7.5, 10.0], method="b")
    result = interpolate(pd.concat([coarse, fine]), np.array([15.0, 65.0]))
    assert result["method"].tolist() == ["a", "a", "b", "b"]
    np.testing.assert_allclose(result["mean"], [1.0, 6.0, 1.0, 6.0])


def test_no_line_leaves_the_evaluation_of_the_untrained_agent_unless_asked_for():
    table = pd.concat([curve([0, 100, 200], [0.0, 10.0, 30.0], errors=1.0), curve([0], [7.0], errors=1.0, method="b")])
    grid = np.array([0.0, 1.0, 99.0, 100.0, 150.0])
    result = interpolate(table, grid)
    nan = np.nan
    np.testing.assert_array_equal(result["mean"], [0, nan, nan, 10, 20, 7, nan, nan, nan, nan])
    np.testing.assert_array_equal(result["standard_error"].isna(), result["mean"].isna())
    np.testing.assert_array_equal(result["seeds"].isna(), result["mean"].isna())
    thesis = interpolate(table, grid, from_zero=True)
    np.testing.assert_allclose(thesis["mean"], [0, 0.1, 9.9, 10, 20, 7, nan, nan, nan, nan])


def test_a_curve_without_an_evaluation_on_the_grid_before_its_first_has_no_area_unless_asked_for():
    table = seed_curves({1: {0: 0.0, 100: 10.0, 200: 10.0}, 2: {0: 0.0, 200: 20.0}})
    grid = np.array([0.0, 100.0, 200.0])
    assert auc_of_seeds(table, grid)["seeds"].item() == 1
    assert auc_of_seeds(table, grid)["standard_error"].isna().all()
    assert auc_of_seeds(table, grid, from_zero=True)["standard_error"].notna().all()
    late = interpolate(curve([0, 200], [0.0, 20.0]), grid)
    assert np.isnan(area(late))


def test_seeds_on_different_grids_are_interpolated_one_by_one():
    table = seed_estimates(seed_curves({1: {10: 0.0, 110: 10.0}, 2: {60: 20.0, 80: 30.0}}))
    result = interpolate(table, np.array([10.0, 70.0]))
    assert result["seed"].tolist() == [1, 1, 2, 2]
    np.testing.assert_allclose(result["mean"], [0.0, 6.0, np.nan, 25.0])


def test_an_unknown_standard_error_stays_unknown():
    result = interpolate(curve([0, 100], [0.0, 10.0]), np.array([0.0, 50.0]))
    assert result["standard_error"].isna().all()


def test_a_return_that_is_not_a_number_is_bridged_by_the_seeds_other_evaluations():
    table = seed_estimates(seed_curves({1: {10: 0.0, 60: np.nan, 110: 10.0}}))
    np.testing.assert_allclose(interpolate(table, np.array([60.0]))["mean"], [5.0])


# The shared grid


@small
@given(
    firsts=st.lists(st.integers(0, 500_000), min_size=1, max_size=4),
    step=st.sampled_from([10_000, 50_000, 100_000, 250_000]),
)
def test_the_grid_starts_at_the_first_multiple_that_all_methods_have_and_ends_at_the_budget(firsts, step):
    table = pd.concat([curve([first, 1e6], 0.0, method=str(n)) for n, first in enumerate(firsts)])
    grid = shared_grid(shuffled(table), 1_000_000, step)
    assert grid[-1] == 1_000_000
    np.testing.assert_array_equal(np.diff(grid), step)
    assert grid[0] % step == 0
    assert max(firsts) <= grid[0] < max(firsts) + step


def test_one_late_task_does_not_shorten_the_grid():
    parts = [curve([0, 4e5], 0.0), curve([3e5, 4e5], 0.0, task="y"), curve([0.5e5, 4e5], 0.0, method="b")]
    np.testing.assert_array_equal(shared_grid(pd.concat(parts), 400_000, 100_000), [1e5, 2e5, 3e5, 4e5])


@pytest.mark.parametrize("first, step", [(250_000, 100_000), (0, 600_000), (900_000, 100_000), (300_001, 100_000)])
def test_a_grid_of_fewer_than_two_points_is_an_error(first, step):
    table = curve([first, 1e6], 0.0)
    with pytest.raises(
        ValueError, match="the grid needs at least two steps .* use a smaller grid step or a larger budg"
    ):
        shared_grid(table, 300_000, step)


def test_a_grid_without_curves_is_an_error():
    with pytest.raises(ValueError, match="the grid needs at least two steps"):
        shared_grid(curve([], []), 300_000, 100_000)


def test_a_budget_that_is_no_multiple_of_the_step_is_an_error():
    with pytest.raises(ValueError, match="budget must be a multiple of the grid step, got 250000 and 100000 env steps"):
        shared_grid(curve([0, 1e6], 0.0), 250_000, 100_000)


# Normalisation


@small
@given(final=st.floats(1, 1000), error=st.floats(0.1, 100))
def test_normalised_by_itself_the_normaliser_is_one_at_the_budget_with_the_same_relative_error(final, error):
    table = curve([0, 2e5, 4e5], [1.0, final, 7.0], errors=error, method="BMPC")
    result = normalise(table, normalisers(table, 200_000)).set_index("env_steps").loc[200_000]
    assert result["mean"] == pytest.approx(1)
    assert result["standard_error"] == pytest.approx(error / final)


def test_the_normaliser_is_read_between_evaluations_and_missing_where_the_curve_has_ended():
    parts = [curve([1e5, 3e5], [0.0, 8.0], method="BMPC"), curve([0, 1e5], [0.0, 9.0], method="BMPC", task="y")]
    constants = normalisers(pd.concat([*parts, curve([0, 4e5], 100.0)]), 200_000)
    assert constants.to_dict() == {"x": 4.0}


def test_nothing_is_divided_by_a_return_of_zero():
    table = pd.concat(
        [curve([0, 1e5], [5.0, last], method="BMPC", task=task) for task, last in (("x", 0.0), ("y", 2.0))]
    )
    assert normalisers(table, 100_000).to_dict() == {"y": 2.0}


def test_another_method_can_normalise():
    assert normalisers(pd.concat([curve([0], 2.0), curve([0], 3.0, method="BMPC")]), 0, "a").to_dict() == {"x": 2.0}


def test_each_task_is_divided_by_its_own_constant_and_without_one_is_unavailable():
    table = pd.concat([curve([0], 6.0, errors=1.0, task=task).assign(std=3.0) for task in "xyz"], ignore_index=True)
    result = normalise(table, pd.Series({"x": 2.0, "y": 4.0}))
    np.testing.assert_allclose(result["mean"], [3.0, 1.5, np.nan])
    np.testing.assert_allclose(result["standard_error"], [0.5, 0.25, np.nan])
    np.testing.assert_allclose(result["std"], [1.5, 0.75, np.nan])
    assert table["mean"].tolist() == [6.0, 6.0, 6.0]  # what was passed is unchanged


def test_seed_curves_are_normalised_like_their_mean():
    table, constants = seed_curves({1: {0: 2.0}, 2: {0: 6.0}}), pd.Series({"x": 4.0})
    one, other = estimate(normalise(table, constants)), normalise(estimate(table), constants)
    pd.testing.assert_frame_equal(one, other)


# Means over tasks


@small
@given(error=errors, tasks=st.integers(1, 8))
def test_the_aggregate_of_equal_errors_is_that_error_over_the_root_of_the_tasks(error, tasks):
    names = [str(n) for n in range(tasks)]
    table = pd.concat([curve([0, 10], n, errors=error, task=str(n)) for n in range(tasks)])
    result = aggregate(table, names)
    assert len(result) == 2
    np.testing.assert_allclose(result["standard_error"], error / tasks**0.5, atol=1e-12)
    np.testing.assert_allclose(result["mean"], (tasks - 1) / 2)


@small
@given(values=st.lists(st.tuples(returns, errors, st.integers(2, 9)), min_size=1, max_size=6))
def test_the_aggregate_of_unequal_errors_is_the_closed_form_in_any_order(values):
    table = pd.concat([curve([5], m, errors=e, seeds=n, task=str(i)) for i, (m, e, n) in enumerate(values)])
    means, spread, counts = (np.array(column) for column in zip(*values, strict=True))
    names = [str(n) for n in range(len(values))]
    for arranged, order in ((table, names), (shuffled(table), names[::-1])):
        (row,) = aggregate(arranged, order).itertuples()
        assert row.mean == pytest.approx(np.mean(means), abs=1e-9)
        assert row.standard_error == pytest.approx(np.linalg.norm(spread) / len(values), abs=1e-9)
        assert row.seeds == counts.min()


def test_the_aggregate_over_one_task_is_that_task():
    table = curve([0, 10], [1.0, 2.0], errors=[0.1, 0.2])
    pd.testing.assert_frame_equal(aggregate(table, ["x"]), table.drop(columns="task"))


def test_the_aggregate_is_unavailable_where_a_task_is():
    parts = [curve([0, 10, 20], 1.0, errors=0.1), curve([0, 10], [3.0, np.nan], errors=0.1, task="y")]
    result = aggregate(pd.concat(parts), ["x", "y"])
    np.testing.assert_array_equal(result["mean"], [2.0, np.nan, np.nan])
    np.testing.assert_array_equal(np.isnan(result["standard_error"]), [False, True, True])


def test_one_unknown_error_makes_the_aggregates_error_unknown_and_leaves_its_mean():
    result = aggregate(pd.concat([curve([0], 1.0, errors=0.1), curve([0], 3.0, task="y")]), ["x", "y"])
    assert result["mean"].tolist() == [2.0]
    assert result["standard_error"].isna().all()


def test_tasks_that_were_not_asked_for_do_not_enter_the_aggregate():
    table = pd.concat(
        [curve([0], value, errors=value, task=task) for task, value in zip("xyz", (1, 2, 90), strict=True)]
    )
    assert aggregate(table, ["y", "x"])["mean"].tolist() == [1.5]


# Areas


@small
@given(height=returns, steps=st.sets(st.integers(0, 10_000_000), min_size=2, max_size=6))
def test_the_area_of_a_constant_curve_is_its_height_times_its_length_in_millions(height, steps):
    length = (max(steps) - min(steps)) / 1e6
    assert area(curve(sorted(steps), height)) == pytest.approx(height * length, abs=1e-9)


@small
@given(slope=returns, offset=returns, steps=st.sets(st.integers(0, 3_000_000), min_size=2, max_size=6))
def test_the_area_of_a_straight_line_is_its_length_times_its_height_in_the_middle(slope, offset, steps):
    millions = np.array(sorted(steps)) / 1e6
    expected = (millions[-1] - millions[0]) * (offset + slope * (millions[0] + millions[-1]) / 2)
    assert area(curve(sorted(steps), offset + slope * millions)) == pytest.approx(expected, abs=1e-6)


@small
@given(data=steps_and_means(min_size=3), cut=st.integers(1, 4))
def test_areas_of_adjacent_grids_add_up(data, cut):
    table = curve(*data)
    cut = min(cut, len(table) - 2)
    assert area(table) == pytest.approx(area(table.iloc[: cut + 1]) + area(table.iloc[cut:]), abs=1e-9)


@small
@given(data=steps_and_means(), scale=st.floats(-3, 3), shift=returns, seed=st.integers(0, 9))
def test_the_area_is_linear_in_the_curve_and_blind_to_the_order_of_rows(data, scale, shift, seed):
    table = curve(*data)
    other = shuffled(table.assign(mean=scale * table["mean"] + shift), seed)
    length = (data[0][-1] - data[0][0]) / 1e6
    assert area(other) == pytest.approx(scale * area(table) + shift * length, abs=1e-6)


@small
@given(data=steps_and_means(), more=st.sets(st.floats(0, 1), max_size=4))
def test_a_finer_grid_leaves_the_area_of_a_curve_of_straight_pieces_unchanged(data, more):
    steps, means = data
    steps = [step + 1 for step in steps]  # none at 0, from which no line leaves
    data = steps, means
    finer = np.union1d(steps, steps[0] + np.array(sorted(more)) * (steps[-1] - steps[0]))
    assert area(interpolate(curve(*data), finer)) == pytest.approx(area(curve(*data)), abs=1e-6)


def test_an_area_by_hand():
    (row,) = auc(curve([0, 1e5, 3e5], [0.0, 4.0, 1.0], seeds=[5, 2, 4])).itertuples()
    assert row.auc == pytest.approx(0.1 * 2 + 0.2 * 2.5)
    assert row.seeds == 2


def test_a_curve_that_does_not_cover_the_grid_has_no_area_and_the_others_keep_theirs():
    table = pd.concat([curve([1, 1e6], 1.0), curve([1, 9e5], 1.0, method="b"), curve([1e5, 1e6], 1.0, method="c")])
    result = auc(interpolate(table, np.array([1, 5e5, 1e6])))
    np.testing.assert_allclose(result["auc"], [0.999999, np.nan, np.nan])


@small
@given(rows=st.lists(st.lists(returns, min_size=3, max_size=3), min_size=2, max_size=5), seed=st.integers(0, 9))
def test_the_error_of_an_area_is_that_of_the_seeds_areas_whose_mean_is_the_area_of_the_mean(rows, seed):
    steps = (0, 100_000, 400_000)
    table = seed_curves({n: dict(zip(steps, row, strict=True)) for n, row in enumerate(rows)})
    (row,) = auc_of_seeds(shuffled(table, seed), np.array(steps)).itertuples()
    areas = [0.1 * (a + b) / 2 + 0.3 * (b + c) / 2 for a, b, c in rows]
    assert row.standard_error == pytest.approx(np.std(areas, ddof=1) / len(areas) ** 0.5, rel=1e-6, abs=1e-9)
    assert (row.auc, row.seeds) == (pytest.approx(np.mean(areas), abs=1e-9), len(areas))
    assert area(estimate(table)) == pytest.approx(np.mean(areas), abs=1e-9)


def test_seeds_on_unequal_grids_each_have_their_own_area():
    table = seed_curves({1: {1e6: 1.0, 2e6: 1.0}, 2: {1e6: 0.0, 1.25e6: 0.5, 2e6: 2.0}})
    (row,) = auc_of_seeds(table, np.array([1e6, 1.5e6, 2e6])).itertuples()
    assert (row.auc, row.standard_error) == pytest.approx((1.0, 0.0))  # both are 1: a constant and the line 2 x - 2


@pytest.mark.parametrize("ends", [(10,), (10, 9), (9, 10, 9)])
def test_one_seed_that_covers_the_grid_has_an_area_and_no_error(ends):
    seeds = {seed: {1: 1.0, end: 1.0} for seed, end in enumerate(ends)}
    (row,) = auc_of_seeds(seed_curves(seeds), np.array([1.0, 10.0])).itertuples()
    assert (row.auc, row.seeds) == (pytest.approx(9e-6), 1)
    assert np.isnan(row.standard_error)


def test_a_seed_that_does_not_cover_the_grid_does_not_count():
    table = seed_curves({1: {1e6: 1.0, 2e6: 1.0}, 2: {1e6: 900.0, 1.9e6: 900.0}, 3: {1e6: 3.0, 2e6: 3.0}})
    (row,) = auc_of_seeds(table, np.array([1e6, 2e6])).itertuples()
    assert (row.auc, row.standard_error, row.seeds) == pytest.approx((2.0, 1.0, 2))


def test_where_no_seed_covers_the_grid_neither_an_area_nor_a_count_is_known():
    table = pd.concat([seed_curves({1: {1: 1.0, 9: 1.0}}), seed_curves({1: {1: 1.0, 10: 1.0}}, method="b")])
    areas = auc_of_seeds(table, np.array([1.0, 10.0])).set_index("method")
    assert areas.loc["a", ["auc", "seeds"]].isna().all()
    assert areas.loc["b", "seeds"] == 1
