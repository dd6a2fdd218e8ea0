from __future__ import annotations

from collections.abc import Callable

import pytest

pytest.importorskip("matplotlib")
pytest.importorskip("pandas")

import numpy as np  # noqa: E402
import pandas as pd  # noqa: E402

from torchrl_etdmpc.analysis import (  # noqa: E402
    AGGREGATE,
    Comparison,
    compare,
    evaluated_methods,
    get_benchmark,
    merge_estimates,
    seed_estimates,
)

EASY = get_benchmark("dmc-easy")  # budget 200,000
TASKS = ("walker-walk", "walker-run")
STEPS = (0, 50_000, 100_000, 150_000, 200_000)
FINAL = {"walker-walk": 800.0, "walker-run": 400.0}  # of BMPC


def seed_curves(
    method: str, value: Callable[[int, str, int], float], *, seeds=(1, 2, 3), steps=STEPS, tasks=TASKS
) -> pd.DataFrame:
    rows = [(method, task, seed, step, value(seed, task, step)) for task in tasks for seed in seeds for step in steps]
    return pd.DataFrame(rows, columns=["method", "task", "seed", "env_steps", "return_mean"])


def means(method: str, value: Callable[[str, int], float], *, steps=STEPS, tasks=TASKS, error=np.nan, seeds=np.nan):
    rows = [(method, task, step, value(task, step), error, seeds) for task in tasks for step in steps]
    return pd.DataFrame(rows, columns=["method", "task", "env_steps", "mean", "standard_error", "seeds"])


def ours(seed: int, task: str, step: int) -> float:
    return seed * step / 1000 + len(task)


BMPC = means("BMPC", lambda task, step: FINAL[task] * step / 200_000, error=2.0, seeds=5)
OURS = seed_curves("ours", ours)
NO_SEEDS, NO_MEANS = OURS.iloc[:0], BMPC.iloc[:0]


def run(seeds: pd.DataFrame = OURS, published: pd.DataFrame = BMPC, **options) -> Comparison:
    return compare(seeds, published, **{"benchmark": EASY, "tasks": TASKS, "grid_step": 50_000} | options)


def cell(table: pd.DataFrame, method: str, task: str) -> pd.Series:
    (row,) = table[(table["method"] == method) & (table["task"] == task)].to_dict("records")
    return pd.Series(row)


def ending(method: str, last: int, step: int) -> pd.DataFrame:
    """Two seeds of return 900 up to ``last``; a third one of return 0, which ends with its third evaluation."""
    going_on = seed_curves(method, lambda *_: 900.0, seeds=(1, 2), steps=range(step, last + 1, step))
    return pd.concat([going_on, seed_curves(method, lambda *_: 0.0, seeds=(3,), steps=range(step, 3 * step + 1, step))])


def numbers(comparison: Comparison) -> list[pd.DataFrame]:
    return [
        t.set_index(["task", "method"]).sort_index().sort_index(axis=1) for t in (comparison.areas, comparison.finals)
    ]


def test_the_normaliser_ends_at_one_and_a_straight_line_to_it_has_half_the_length_as_its_area():
    comparison = run()
    assert comparison.constants.to_dict() == FINAL
    assert cell(comparison.finals, "BMPC", AGGREGATE)["mean"] == pytest.approx(1)
    for task in (*TASKS, AGGREGATE):
        assert cell(comparison.areas, "BMPC", task)["auc"] == pytest.approx(0.2 / 2)


def test_every_number_of_a_small_comparison_by_hand():
    comparison = run()
    scores, areas = {}, {}
    for task, final in FINAL.items():
        ends = np.array([ours(seed, task, 200_000) for seed in (1, 2, 3)])
        starts = np.array([ours(seed, task, 0) for seed in (1, 2, 3)])
        areas[task], scores[task] = 0.2 * (starts + ends) / 2 / final, ends  # straight lines
        row = cell(comparison.finals, "ours", task)
        assert row["mean"] == pytest.approx(ends.mean())
        assert row["standard_error"] == pytest.approx(ends.std(ddof=1) / 3**0.5)
        row = cell(comparison.areas, "ours", task)
        assert row["auc"] == pytest.approx(areas[task].mean())
        assert row["standard_error"] == pytest.approx(areas[task].std(ddof=1) / 3**0.5)
        assert row["seeds"] == 3
    row = cell(comparison.areas, "ours", AGGREGATE)
    assert row["auc"] == pytest.approx(np.mean([area.mean() for area in areas.values()]))
    spread = [area.std(ddof=1) / 3**0.5 for area in areas.values()]
    assert row["standard_error"] == pytest.approx(np.hypot(*spread) / 2)
    row = cell(comparison.finals, "ours", AGGREGATE)
    assert row["mean"] == pytest.approx(np.mean([scores[task].mean() / FINAL[task] for task in TASKS]))


@pytest.mark.parametrize("seed", range(3))
def test_the_order_of_rows_and_tasks_and_the_names_of_seeds_change_no_number(seed):
    expected = numbers(run())
    renamed = OURS.assign(seed=OURS["seed"].map({1: 9, 2: 4, 3: 6}))
    tables = [table.sample(frac=1, random_state=seed, ignore_index=True) for table in (renamed, BMPC)]
    for one, other in zip(numbers(run(*tables, tasks=TASKS[::-1])), expected, strict=True):
        pd.testing.assert_frame_equal(one, other, check_dtype=False)


def test_methods_and_tasks_come_in_the_order_that_was_asked_for_or_that_of_the_tables():
    assert run().methods == ("ours", "BMPC")
    assert run(methods=("BMPC", "ours")).methods == ("BMPC", "ours")
    assert run().tasks == TASKS
    assert run(tasks=None).tasks == EASY.tasks
    assert set(run(methods=("ours",)).areas["method"]) == {"ours"}


def test_leaving_the_normaliser_out_of_the_columns_does_not_change_the_others():
    for task in (*TASKS, AGGREGATE):
        pd.testing.assert_series_equal(
            cell(run(methods=("ours",)).areas, "ours", task), cell(run().areas, "ours", task)
        )


def test_seed_curves_win_over_means_of_the_same_method_on_the_same_task_only():
    published = means("ours", lambda task, step: -1.0, error=7.0, seeds=9)
    merged = merge_estimates(seed_curves("ours", ours, tasks=("walker-run",)), pd.concat([published, BMPC]))
    by_task = merged[merged["method"] == "ours"].groupby("task")
    assert by_task["seeds"].unique().map(list).to_dict() == {"walker-run": [3], "walker-walk": [9]}
    assert by_task.size().to_dict() == dict.fromkeys(TASKS, len(STEPS))
    assert (by_task.get_group("walker-walk")["mean"] == -1).all()
    expected = [np.mean([ours(seed, "walker-run", step) for seed in (1, 2, 3)]) for step in STEPS]
    assert by_task.get_group("walker-run")["mean"].tolist() == expected
    assert len(merged[merged["method"] == "BMPC"]) == len(BMPC)


def test_a_method_of_which_two_sets_of_runs_are_published_on_a_compared_task_is_named():
    published = pd.concat([BMPC, means("ours", lambda task, step: -1.0)])
    note = "Published per seed and, of other runs, as means: ours; the curves per seed are used."
    assert note in run(published=published).notes
    elsewhere = seed_curves("ours", ours, tasks=TASKS[1:])
    assert note not in run(elsewhere, published, tasks=TASKS[:1]).notes
    # On the other task, which is not compared, there are both.
    assert note in run(elsewhere, published, tasks=TASKS[1:]).notes


def test_means_alone_can_be_compared():
    comparison = run(NO_SEEDS, pd.concat([BMPC, BMPC.assign(method="half", mean=BMPC["mean"] / 2)]))
    assert cell(comparison.areas, "half", AGGREGATE)["auc"] == pytest.approx(0.05)
    assert np.isnan(cell(comparison.areas, "half", AGGREGATE)["standard_error"])
    assert cell(comparison.finals, "half", AGGREGATE)["standard_error"] == pytest.approx(np.hypot(2 / 800, 2 / 400) / 2)


def test_seed_curves_alone_can_be_compared():
    comparison = run(pd.concat([OURS, seed_curves("BMPC", lambda seed, task, step: FINAL[task])]), NO_MEANS)
    assert cell(comparison.areas, "BMPC", AGGREGATE)["auc"] == pytest.approx(0.2)
    assert cell(comparison.areas, "BMPC", AGGREGATE)["standard_error"] == pytest.approx(0)


def test_methods_with_other_checkpoints_meet_on_the_shared_grid():
    line = lambda seed, task, step: FINAL[task] * step / 200_000  # noqa: E731
    odd = seed_curves("odd", line, steps=(0, 30_000, 170_000, 300_000))
    comparison = run(pd.concat([OURS, odd]))
    np.testing.assert_array_equal(comparison.grid, STEPS)
    assert cell(comparison.areas, "odd", AGGREGATE)["auc"] == pytest.approx(0.1)
    assert cell(comparison.finals, "odd", AGGREGATE)["mean"] == pytest.approx(1)
    assert any(note.startswith("odd: not evaluated at 200,000 env steps") for note in comparison.notes)


def test_seeds_with_other_checkpoints_than_each_other_have_their_own_areas():
    one = seed_curves("odd", lambda *_: 400.0, seeds=(1,), steps=STEPS)
    other = seed_curves("odd", lambda *_: 200.0, seeds=(2,), steps=(0, 5e4, 2e5))
    late = seed_curves("odd", lambda *_: 600.0, seeds=(3,), steps=(0, 4e4, 199_000, 201_000))
    comparison = run(pd.concat([OURS, one, other]))
    assert cell(comparison.areas, "odd", "walker-run")["auc"] == pytest.approx(0.15)
    assert cell(comparison.areas, "odd", "walker-run")["seeds"] == 2
    assert cell(comparison.finals, "odd", "walker-run")["mean"] == pytest.approx(300)
    comparison = run(pd.concat([OURS, one, other, late]))
    assert cell(comparison.areas, "odd", "walker-run")["auc"] == pytest.approx(0.2)
    assert cell(comparison.finals, "odd", "walker-run")["mean"] == pytest.approx(400)
    assert cell(comparison.finals, "odd", "walker-run")["seeds"] == 3


def test_after_a_seed_has_ended_values_are_those_of_the_others_alone():
    runs, options = ending("ours", 105_000, 15_000), {"benchmark": EASY, "tasks": TASKS[:1]}
    # At 50,000 nobody was evaluated; a line from 45,000 to 60,000 would mix the means of three seeds and of two.
    found = compare(runs, seed_estimates(runs.head(0)), budget=50_000, grid_step=5_000, **options)
    final = found.finals[found.finals["task"] == "walker-walk"].iloc[0]
    assert (final["mean"], final["standard_error"], final["seeds"]) == (900, 0, 2)
    returns = found.returns[found.returns["task"] == "walker-walk"].set_index("env_steps")
    assert returns.loc[[20_000, 50_000], "mean"].tolist() == [600, 900]
    assert returns.loc[[20_000, 50_000], "seeds"].tolist() == [3, 2]
    assert set(returns["kind"]) == {"interpolated"}


def test_wherever_a_curve_is_read_a_seed_that_has_ended_does_not_count():
    """All were evaluated at 45,000 and the others again at 60,000; between them a line would lead from 600 to 900."""
    runs, walk = ending("ours", 105_000, 15_000), TASKS[0]
    ends = means("BMPC", lambda task, step: FINAL[task] * step / 200_000, steps=(0, 200_000))
    options = {"published": ends, "budget": 60_000, "grid_step": 20_000, "tasks": TASKS[:1]}
    returns = run(runs, steps=(50_000,), **options).returns.set_index(["method", "task"])
    assert returns.loc[("ours", walk), "mean"] == pytest.approx(900)
    final = cell(run(runs, steps=(), **(options | {"budget": 50_000, "grid_step": 25_000})).finals, "ours", walk)
    assert (final["mean"], final["standard_error"]) == (900, 0)
    areas = run(runs, steps=(), **(options | {"grid_step": 10_000})).areas
    assert cell(areas, "ours", walk)[["auc", "standard_error", "seeds"]].tolist() == pytest.approx(
        [0.04 * 900 / 800, 0, 2]
    )
    # Figures read the estimates where other methods were evaluated.
    others = pd.concat([runs, seed_curves("other", ours, steps=(0, 53_000, 100_000))])
    published = means("BMPC", lambda *_: 1.0, steps=(0, 52_000, 200_000))
    estimates = run(others, steps=(), **(options | {"published": published})).estimates
    estimates = estimates.set_index(["method", "env_steps"])["mean"]
    assert estimates[[("ours", 52_000), ("ours", 53_000)]].tolist() == [900, 900]


def test_an_area_is_of_the_seeds_whose_curves_cover_the_grid():
    """The mean curve of seeds that begin or end apart is no run's; its area would be the largest here."""
    early = seed_curves("part", lambda *_: 900.0, seeds=(2,), steps=STEPS[:3], tasks=TASKS[:1])
    runs = [seed_curves("part", lambda *_: 100.0, seeds=(1,)), early]
    areas = run(pd.concat([OURS, *runs]), start=50_000).areas
    assert cell(areas, "part", TASKS[0])[["auc", "seeds"]].tolist() == pytest.approx([0.15 * 100 / 800, 1])
    assert np.isnan(cell(areas, "part", TASKS[0])["standard_error"])
    late = seed_curves("part", lambda *_: 900.0, seeds=(3,), steps=STEPS[2:], tasks=TASKS[:1])
    areas = run(pd.concat([OURS, early, late]), start=50_000).areas
    assert np.isnan(cell(areas, "part", TASKS[0])["auc"])  # each covers a part of it


def test_a_seed_of_the_normaliser_that_has_ended_at_the_benchmark_s_budget_does_not_count():
    runs = ending("BMPC", 240_000, 60_000)  # the third seed ends at 180,000
    comparison = run(runs, NO_MEANS, budget=150_000, steps=())
    assert comparison.constants.to_dict() == dict.fromkeys(TASKS, 900.0)


def test_the_grid_starts_where_all_methods_have_begun():
    late = seed_curves("late", lambda *_: 1.0, steps=(60_000, 200_000))
    np.testing.assert_array_equal(run(pd.concat([OURS, late])).grid, [100_000, 150_000, 200_000])


def test_a_method_that_begins_late_on_one_task_is_named_with_the_latest_beginning():
    late = [seed_curves("late", ours, tasks=TASKS[:1]), seed_curves("late", ours, tasks=TASKS[1:], steps=STEPS[3:])]
    note = "Not evaluated before their first evaluation after 0 env steps, on one task at least: late from 150,000."
    assert note in run(pd.concat([OURS, *late])).notes


def test_a_method_that_begins_after_the_budget_is_left_out_and_named_with_its_earliest_beginning():
    late = [seed_curves("late", ours, tasks=TASKS[n : n + 1], steps=(250_000 + 50_000 * n,)) for n in range(2)]
    notes = run(pd.concat([OURS, *late]), methods=("ours", "BMPC")).notes
    assert "Not evaluated by 200,000 env steps on these tasks, so left out: late (from 250,000)." in notes


def test_a_method_that_begins_at_the_budget_was_evaluated_by_it():
    late = seed_curves("late", ours, steps=(200_000, 250_000))
    comparison = run(pd.concat([OURS, late]), methods=("ours", "BMPC"))
    assert not any("left out: late" in note for note in comparison.notes)


def test_a_run_that_ends_early_is_unavailable_there_and_in_the_aggregate_and_a_note_says_so():
    short = [seed_curves("short", ours, tasks=TASKS[:1]), seed_curves("short", ours, tasks=TASKS[1:], steps=STEPS[:4])]
    comparison = run(pd.concat([OURS, *short]))
    for table, column in ((comparison.areas, "auc"), (comparison.finals, "mean")):
        values = {task: cell(table, "short", task)[column] for task in (*TASKS, AGGREGATE)}
        assert {task: bool(np.isnan(value)) for task, value in values.items()} == {
            "walker-walk": False,
            "walker-run": True,
            AGGREGATE: True,
        }
    note = "short ends before 200,000 env steps on walker-run (last evaluation 150,000): unavailable there"
    assert any(text.startswith(note) for text in comparison.notes)


def test_of_several_tasks_that_end_before_the_budget_the_first_end_is_named():
    short = [seed_curves("short", ours, tasks=TASKS[n : n + 1], steps=STEPS[: 3 + n]) for n in range(2)]
    note = "short ends before 200,000 env steps on walker-run, walker-walk (last evaluation 100,000)"
    assert any(text.startswith(note) for text in run(pd.concat([OURS, *short])).notes)


def test_a_task_without_a_curve_is_unavailable_in_the_aggregate_and_a_note_says_so():
    comparison = run(pd.concat([OURS, seed_curves("part", ours, tasks=TASKS[:1])]))
    rows = comparison.areas[comparison.areas["method"] == "part"].set_index("task")["auc"]
    assert np.isfinite(rows["walker-walk"]) and np.isnan(rows[AGGREGATE])
    assert "part has no curve on walker-run." in comparison.notes


def test_a_smaller_budget_still_normalises_by_the_benchmarks():
    comparison = run(budget=100_000)
    assert comparison.budget == comparison.grid[-1] == 100_000
    assert cell(comparison.finals, "BMPC", AGGREGATE)["mean"] == pytest.approx(0.5)
    assert cell(comparison.areas, "BMPC", AGGREGATE)["auc"] == pytest.approx(0.1 * 0.25)


def test_quoted_points_count_up_to_a_smaller_budget_and_variants_are_paired_there():
    quotes = {"method": "quoted", "task": "walker-walk", "env_steps": [100_000, 150_000], "mean": 1.0, "source": "p"}
    ahead = seed_curves("ahead", lambda seed, task, step: ours(seed, task, step) + step)
    options = {"points": pd.DataFrame(quotes), "base": "ours", "variants": ["ahead"]}
    comparison = run(pd.concat([OURS, ahead]), budget=100_000, **options)
    assert comparison.points["env_steps"].tolist() == [100_000]
    differences = comparison.paired.set_index("task")["difference"]
    assert differences[[*TASKS]].tolist() == pytest.approx([100_000] * 2)


def test_differences_over_tasks_are_of_normalised_returns():
    ahead = seed_curves("ahead", lambda seed, task, step: ours(seed, task, step) + FINAL[task])
    paired = run(pd.concat([OURS, ahead]), base="ours", variants=["ahead"]).paired.set_index("task")
    assert paired.loc[AGGREGATE, "difference"] == pytest.approx(1)


def test_a_variant_without_a_pair_is_named():
    alone = seed_curves("alone", ours, seeds=(7, 8))
    comparison = run(pd.concat([OURS, alone]), base="ours", variants=["alone"])
    assert comparison.paired.empty
    assert "alone shares no task and seed with ours: not paired." in comparison.notes
    short = seed_curves("short", ours, steps=STEPS[:4])
    notes = run(pd.concat([OURS, short]), base="ours", variants=["short"]).notes
    assert "short and ours share no task and seed on which both reach 200,000 env steps: not paired." in notes


def test_returns_at_the_budget_may_lie_on_the_line_from_the_untrained_agent_if_asked_for():
    late = seed_curves("late", lambda seed, task, step: float(step), steps=(0, 150_000))
    expected = {False: np.nan, True: 100_000}
    for from_zero, mean in expected.items():
        comparison = run(pd.concat([OURS, late]), budget=100_000, start=0, from_zero=from_zero)
        assert cell(comparison.finals, "late", "walker-walk")["mean"] == pytest.approx(mean, nan_ok=True)


def test_the_error_of_an_area_may_use_the_line_from_the_untrained_agent_if_asked_for():
    late = seed_curves("late", lambda seed, task, step: seed * step, steps=(0, 100_000, 200_000))
    for from_zero in (False, True):
        comparison = run(pd.concat([OURS, late]), start=50_000, from_zero=from_zero)
        row = cell(comparison.areas, "late", "walker-walk")
        assert np.isfinite([row["auc"], row["standard_error"]]).tolist() == [from_zero, from_zero]


def test_the_thesis_mean_is_over_the_seeds_that_were_evaluated_there():
    other = seed_curves("ours", lambda *_: 0.0, seeds=(4,), steps=(0, 100_000, 200_000))
    runs = pd.concat([seed_curves("ours", lambda *_: 400.0), other])
    for from_zero, mean in ((False, 300), (True, 400)):  # of four at 150,000, of which one lies on a line; of three
        returns = run(runs, steps=(150_000,), from_zero=from_zero).returns.set_index(["method", "task"])
        assert returns.loc[("ours", "walker-walk"), "mean"] == mean


def test_a_mean_of_which_a_seed_lies_between_two_evaluations_is_not_called_evaluated():
    other = seed_curves("ours", ours, seeds=(4,), steps=(0, 40_000, 120_000, 160_000, 240_000))
    comparison = run(pd.concat([OURS, other]), steps=(50_000, 200_000))
    kinds = comparison.returns.groupby(["method", "env_steps"])["kind"].agg(set)
    for step in (50_000, 200_000):
        assert (kinds["ours", step], kinds["BMPC", step]) == ({"interpolated"}, {"evaluated"})
    assert any(note.startswith("ours: not evaluated at 200,000 env steps; values there") for note in comparison.notes)
    alone = run(steps=(50_000, 200_000)).returns
    assert set(alone["kind"]) == {"evaluated"}


def test_the_evaluation_of_the_untrained_agent_makes_no_evaluated_method():
    late = seed_curves("late", ours, steps=(0, 300_000))
    for budget, found in ((200_000, []), (300_000, ["late"])):
        assert evaluated_methods(late, NO_MEANS, tasks=TASKS, budget=budget) == found


def test_without_the_normaliser_there_are_returns_but_no_areas_and_a_note_says_so():
    comparison = run(published=NO_MEANS)
    assert cell(comparison.finals, "ours", "walker-run")["mean"] == pytest.approx(410)
    assert np.isnan(cell(comparison.finals, "ours", AGGREGATE)["mean"])
    assert comparison.areas["auc"].isna().all()
    note = "No return of BMPC to normalise by on walker-walk, walker-run: areas there are unavailable."
    assert note in comparison.notes


def test_tasks_and_methods_of_no_concern_are_left_out():
    strange = seed_curves("ours", lambda *_: 1e9, tasks=("dog-run", "walker-stand"))
    for one, other in zip(numbers(run(pd.concat([OURS, strange]))), numbers(run()), strict=True):
        pd.testing.assert_frame_equal(one, other)


def test_what_was_passed_is_not_changed():
    seeds, published = OURS.copy(), BMPC.copy()
    run(seeds, published)
    pd.testing.assert_frame_equal(seeds, OURS)
    pd.testing.assert_frame_equal(published, BMPC)


@pytest.mark.parametrize(
    "options, message",
    [
        ({"grid_step": 200_000, "tasks": ("walker-run",), "budget": 100_000}, "the grid needs at least two steps"),
        ({"budget": 130_000}, "the budget must be a multiple of the grid step"),
        ({"start": 200_000}, "grid"),
        ({"start": 300_000}, "grid"),
        ({"start": 30_000}, "grid"),
    ],
)
def test_a_grid_of_one_point_or_one_that_misses_the_budget_is_an_error(options, message):
    with pytest.raises(ValueError, match=message):
        run(**options)


def test_the_start_of_the_grid_can_be_chosen():
    comparison = run(start=100_000)
    np.testing.assert_array_equal(comparison.grid, [100_000, 150_000, 200_000])
    assert cell(comparison.areas, "BMPC", AGGREGATE)["auc"] == pytest.approx(0.1 * 0.75)


def test_a_complete_comparison_needs_no_note_but_that_on_methods_without_seeds():
    assert run().notes == (
        "No interval of the AUC for BMPC: it needs the curves of at least two seeds on the whole grid.",
    )


def test_one_seed_has_a_mean_and_no_interval_and_a_note_says_so():
    comparison = run(seed_curves("ours", ours, seeds=(1,)))
    for task in (*TASKS, AGGREGATE):
        assert np.isfinite(cell(comparison.areas, "ours", task)["auc"])
        assert np.isnan(cell(comparison.areas, "ours", task)["standard_error"])
        assert np.isnan(cell(comparison.finals, "ours", task)["standard_error"])
    expected = f"ours: one seed on {', '.join(sorted(TASKS))}; a mean of one run, no interval."
    assert expected in comparison.notes


def test_one_task_with_an_interval_of_its_area_is_enough():
    alone = seed_curves("part", ours, seeds=(1,), tasks=TASKS[:1])
    comparison = run(pd.concat([OURS, alone, seed_curves("part", ours, tasks=TASKS[1:])]))
    assert [note for note in comparison.notes if note.startswith("No interval")] == [
        "No interval of the AUC for BMPC: it needs the curves of at least two seeds on the whole grid."
    ]


def test_a_return_that_is_not_a_number_is_left_out_and_counted():
    broken = OURS.assign(return_mean=OURS["return_mean"].mask((OURS["seed"] == 2) & (OURS["env_steps"] == 200_000)))
    comparison = run(broken)
    assert cell(comparison.finals, "ours", "walker-run")["mean"] == pytest.approx(10 + np.mean([200, 600]))
    assert cell(comparison.finals, "ours", "walker-run")["seeds"] == 2
    assert "2 evaluations with a return that is not a number: left out." in comparison.notes


def test_missing_evaluations_of_a_seed_are_noted():
    gap = OURS[~((OURS["seed"] == 3) & (OURS["env_steps"] == 50_000) & (OURS["task"] == "walker-run"))]
    note = "ours: not all seeds begin and end alike on walker-run; each mean is of those that reach there."
    assert note in run(gap).notes


def test_a_seed_that_is_behind_does_not_make_it_one_seed():
    behind = OURS[(OURS["seed"] == 1) | ((OURS["seed"] == 2) & (OURS["env_steps"] < 200_000))]
    assert not any("one seed" in note for note in run(behind).notes)


def test_an_unknown_number_of_seeds_is_not_taken_for_a_varying_one():
    unknown = means("theirs", lambda task, step: 1.0)
    assert not any("not all seeds" in note for note in run(published=pd.concat([BMPC, unknown])).notes)
