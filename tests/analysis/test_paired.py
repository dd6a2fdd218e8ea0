from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip("pandas")
pytest.importorskip("scipy")

import numpy as np  # noqa: E402
import pandas as pd  # noqa: E402

from torchrl_etdmpc.analysis import AGGREGATE, compare_paired  # noqa: E402
from torchrl_etdmpc.analysis.paired import paired_markdown  # noqa: E402

small = settings(deadline=None, max_examples=15)
scores = st.lists(st.tuples(st.floats(-100, 100), st.floats(-100, 100)), min_size=2, max_size=5)


def curves(runs: dict[tuple[str, str, int], float], step: int = 100) -> pd.DataFrame:
    rows = [(*key, step, value) for key, value in runs.items()]
    return pd.DataFrame(rows, columns=["method", "task", "seed", "env_steps", "return_mean"])


def compare(table: pd.DataFrame, tasks="xy", **options) -> pd.DataFrame:
    options = {"base": "base", "variants": ["new"], "env_steps": 100} | options
    return compare_paired(table, tasks=list(tasks), **options).set_index("task")


def pairs(found: list[tuple[float, float]], task: str = "x") -> dict:
    runs = {}
    for seed, (new, base) in enumerate(found):
        runs |= {("new", task, seed): new, ("base", task, seed): base}
    return runs


@small
@given(found=scores)
def test_one_task_is_the_mean_difference_of_pairs_and_the_share_of_wins_with_ties_half(found):
    table = compare(curves(pairs(found)), "x")
    x, y = np.array(found).T
    wins = np.mean([[(a > b) + 0.5 * (a == b) for b in y] for a in x])
    for task in ("x", "All tasks"):
        assert table.loc[task, "difference"] == pytest.approx(np.mean(x - y), abs=1e-9)
        assert table.loc[task, "improvement"] == pytest.approx(wins)
        assert table.loc[task, "pairs"] == len(found)


@small
@given(found=scores)
def test_changing_places_changes_the_sign_and_the_probability_to_its_rest(found):
    one = compare(curves(pairs(found)), "x")
    other = compare(curves(pairs(found)), "x", base="new", variants=["base"])
    np.testing.assert_allclose(
        one[["difference", "lower", "upper"]], -other[["difference", "upper", "lower"]], atol=1e-9
    )
    columns = ["improvement", "improvement_lower", "improvement_upper"]
    swapped = ["improvement", "improvement_upper", "improvement_lower"]
    np.testing.assert_allclose(one[columns], 1 - other[swapped], atol=1e-9)


def test_pairing_takes_what_the_seeds_share_out_of_the_interval():
    generator = np.random.default_rng(0)
    hard = generator.normal(0, 100, 6)  # seeds differ, and by the same amount for both
    paired = compare(curves(pairs([(seed + 5.0, seed) for seed in hard])), "x").loc["x"]
    assert (paired["difference"], paired["lower"], paired["upper"]) == pytest.approx((5, 5, 5))
    mixed = list(zip(hard + 5.0, np.roll(hard, 1), strict=True))
    loose = compare(curves(pairs(mixed)), "x").loc["x"]
    assert loose["difference"] == pytest.approx(5)
    assert loose["lower"] < -10 and loose["upper"] > 20


def test_runs_meet_by_task_and_seed_and_one_without_a_partner_is_left_out_and_counted():
    runs = {("new", "x", 1): 10.0, ("new", "x", 2): 20.0, ("new", "x", 3): 999.0}
    runs |= {("base", "x", 2): 5.0, ("base", "x", 1): 1.0, ("base", "y", 1): 7.0, ("other", "x", 1): -50.0}
    table = compare(curves(runs))
    assert list(table.index) == ["x", "All tasks (1 of 2 tasks)"]  # y has no pair
    assert table.loc["x", ["pairs", "left_out", "difference"]].tolist() == [2, 1, pytest.approx(12)]
    assert table.loc["All tasks (1 of 2 tasks)", ["pairs", "left_out"]].tolist() == [2, 2]


def test_every_task_counts_alike_and_the_bootstrap_is_stratified():
    runs = pairs([(1.0, 0.0)] * 4) | pairs([(3.0, 0.0)] * 2, "y")
    table = compare(curves(runs))
    # without strata, resamples would mix tasks and spread
    for column in ("difference", "lower", "upper"):
        assert table.loc["All tasks", column] == pytest.approx(2)
    assert table.loc["All tasks", "pairs"] == 6


def test_resamples_of_one_task_are_not_those_of_another():
    differences = [0.0, 1.0, 2.0, 3.0]
    runs = pairs([(one, 0.0) for one in differences]) | pairs([(-one, 0.0) for one in differences], "y")
    row = compare(curves(runs)).loc["All tasks"]  # drawn alike, they would cancel out
    assert row["difference"] == pytest.approx(0)
    assert row["lower"] < -0.3 and row["upper"] > 0.3


def test_with_a_constant_for_every_task_the_differences_over_tasks_are_normalised_and_no_probability():
    runs = pairs([(1.0, 0.0), (1.0, 2.0), (6.0, 0.0)]) | pairs([(4.0, 0.0), (1.0, 2.0)], "y")
    table = compare(curves(runs), constants=pd.Series({"x": 10.0, "y": 5.0}))
    assert table.loc[AGGREGATE, "difference"] == pytest.approx((0.2 + 0.3) / 2)
    assert table.loc["x", "difference"] == pytest.approx(2)
    plain = compare(curves(runs), constants=pd.Series({"x": 10.0})).loc["All tasks"]
    probabilities = ["improvement", "improvement_lower", "improvement_upper"]
    assert table.loc[AGGREGATE, probabilities].tolist() == pytest.approx(plain[probabilities].tolist())
    assert 0 < plain["improvement_lower"] < plain["improvement"] < plain["improvement_upper"]


def test_a_page_has_normalised_differences_with_more_decimals_than_returns():
    found = compare(curves(pairs([(16.0, 0.0), (8.0, 0.0)])), "x", constants=pd.Series({"x": 100.0}))
    assert paired_markdown(found.reset_index()).splitlines()[2:] == [
        "| new | base | x | +12.0 [+8.0, +16.0] | 1.00 [1.00, 1.00] | 2 | 0 |",
        f"| new | base | {AGGREGATE} | +0.120 [+0.080, +0.160] | 1.00 [1.00, 1.00] | 2 | 0 |",
    ]


def test_one_pair_has_a_difference_and_no_interval():
    table = compare(curves(pairs([(3.0, 1.0)]) | pairs([(1.0, 0.0), (2.0, 0.0)], "y")))
    assert table["difference"].tolist() == pytest.approx([2, 1.5, 1.75])
    assert table["lower"].isna().tolist() == [True, False, True]
    assert table["improvement_upper"].isna().tolist() == [True, False, True]


def test_a_run_that_ends_before_the_step_or_has_not_begun_is_no_partner():
    early = curves(pairs([(1.0, 0.0), (1.0, 0.0), (1.0, 0.0)]))
    early.loc[(early["method"] == "new") & (early["seed"] == 0), "env_steps"] = 99
    late = early[early["seed"] == 1].assign(env_steps=0)
    table = compare(pd.concat([early[early["seed"] != 1], late]), "x")
    assert table.loc["x", "pairs"] == 1
    assert table.loc["x", "left_out"] == 4  # both runs of two seeds, whichever of them has no value there


def test_without_a_shared_run_there_is_no_row():
    assert compare(curves({("new", "x", 1): 1.0, ("base", "x", 2): 1.0})).empty
    assert compare(curves({}), variants=[]).empty


def test_the_interval_is_that_of_95_percent_of_the_resamples():
    differences = np.random.default_rng(0).normal(size=50)
    row = compare(curves(pairs([(difference, 0.0) for difference in differences])), "x").loc["x"]
    error = differences.std() / 50**0.5
    assert (row["upper"] - row["lower"]) / (2 * error) == pytest.approx(1.96, rel=0.06)


def test_the_interval_of_many_pairs_holds_the_truth_about_as_often_as_it_says():
    generator, inside = np.random.default_rng(1), 0
    for _ in range(60):
        found = [tuple(pair) for pair in generator.normal((1.0, 0.0), 1.0, (20, 2))]
        row = compare(curves(pairs(found)), "x").loc["x"]
        inside += row["lower"] <= 1.0 <= row["upper"]
    assert 50 <= inside <= 60
