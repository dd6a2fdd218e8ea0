"""Differences of variants from the cpu preset, from the files of runs whose returns are known."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("matplotlib")
pd = pytest.importorskip("pandas")
ttest_1samp = pytest.importorskip("scipy.stats").ttest_1samp

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"


def write(folder: Path, returns: dict[int, float]) -> None:
    folder.mkdir(parents=True)
    task, seed = folder.parent.name, folder.name.removeprefix("seed")
    (folder / "summary.json").write_text(f'{{"task": "{task}", "preset": "cpu", "seed": {seed}}}')
    returns = {0: next(iter(returns.values()))} | returns
    rows = [f"{step},{step // 2},{step},1.0,{value},1.0,10" for step, value in returns.items()]
    header = "env_steps,decision_steps,updates,wall_time_s,return_mean,return_std,episodes"
    (folder / "eval.csv").write_text("\n".join([header, *rows, ""]))


@pytest.fixture
def script(monkeypatch, tmp_path):
    monkeypatch.syspath_prepend(BENCHMARKS)
    module = importlib.import_module("ablation")
    monkeypatch.setattr(module, "RESULTS", tmp_path)
    return module


def test_runs_are_paired_by_task_and_seed_and_tasks_count_alike(script, tmp_path, monkeypatch):
    steps = list(script.STEPS)
    gains = {"walker-run": [10.0, 30.0], "walker-walk": [100.0], "hopper-stand": [0.0]}
    for task, seeds in gains.items():
        for seed, gain in enumerate(seeds, start=1):
            write(tmp_path / task / f"seed{seed}", dict.fromkeys(steps, 200.0))
            later = {step: 200 + gain * step / steps[-1] for step in [0, *steps]}
            write(tmp_path / "ablation" / "one head" / task / f"seed{seed}", later)
    write(tmp_path / "ablation" / "one head" / "cheetah-run" / "seed1", dict.fromkeys(steps, 900.0))  # has no partner
    monkeypatch.setattr(sys, "argv", ["ablation.py", "--report-only"])
    script.main()
    page = (tmp_path / "ablation" / "README.md").read_text()
    # 20, 100 and 0 by task: mean 40, deviation 52.9, Student's t of two degrees of freedom 4.303.
    assert (
        "| all | 3 | +8 [-18, +34] | +16 [-37, +69] | +24 [-55, +103] | +32 [-73, +137] | +40 [-91, +171] | +20" in page
    )
    assert "| tuned on | 1 | +20 | +40 | +60 | +80 | +100 | +50 |" in page
    assert "| walker-run | 1, 2 | 200 | 220 | +20 | +10 |" in page
    assert page.count("cheetah-run") == 1
    assert "Left out, because *cpu* has no run beside them: one head/cheetah-run/seed1." in page
    assert (tmp_path / "ablation" / "differences.png").read_bytes().startswith(b"\x89PNG")


def test_intervals_over_seeds_are_of_a_task_and_of_all_tasks(script, tmp_path, monkeypatch):
    steps = list(script.STEPS)
    gains = {"walker-run": [10.0, 30.0, 50.0], "hopper-stand": [0.0, 0.0, 120.0], "walker-walk": [7.0, 7.0, 7.0]}
    for task, seeds in gains.items():
        for seed, gain in enumerate(seeds, start=1):
            write(tmp_path / task / f"seed{seed}", dict.fromkeys(steps, 200.0))
            late = dict.fromkeys(steps, 200.0) | {steps[-1]: 200 + gain}  # a tenth of the gain in the area
            write(tmp_path / "ablation" / "one head" / task / f"seed{seed}", late)
            if task == "walker-run" and seed < 3:
                write(tmp_path / "ablation" / "final depth" / task / f"seed{seed}", dict.fromkeys(steps, 200 + gain))
    monkeypatch.setattr(sys, "argv", ["ablation.py", "--report-only"])
    script.main()
    page = (tmp_path / "ablation" / "README.md").read_text()
    # Standard errors 11.5, 40 and 0, Student's t of two degrees of freedom 4.303. Of the three tasks: a standard error
    # of 13.9 and 2.33 degrees of freedom, t 3.768.
    assert "| walker-run | 1, 2, 3 | 200 | 230 | +30 [-20, +80] | +3 [-2, +8] |" in page
    assert "| hopper-stand | 1, 2, 3 | 200 | 240 | +40 [-132, +212] | +4 [-13, +21] |" in page
    assert "| walker-walk | 1, 2, 3 | 200 | 207 | +7 [+7, +7] | +1 [+1, +1] |" in page
    assert "| these tasks |  | 200 | 226 | +26 [-27, +78] | +3 [-3, +8] |" in page
    assert "| walker-run | 1, 2 | 200 | 220 | +20 | +20 |" in page
    assert page.count("these tasks") == 1


def test_tasks_with_few_seeds_are_not_in_the_interval_over_seeds(script, tmp_path, monkeypatch):
    gains = {"walker-run": [10.0, 30.0, 50.0], "hopper-stand": [10.0, 30.0, 50.0], "walker-walk": [100.0, 500.0]}
    for task, seeds in gains.items():
        for seed, gain in enumerate(seeds, start=1):
            write(tmp_path / task / f"seed{seed}", dict.fromkeys(script.STEPS, 0.0))
            write(tmp_path / "ablation" / "one head" / task / f"seed{seed}", dict.fromkeys(script.STEPS, gain))
    monkeypatch.setattr(sys, "argv", ["ablation.py", "--report-only"])
    script.main()
    page = (tmp_path / "ablation" / "README.md").read_text()
    # A standard error of 11.5 / sqrt(2) and four degrees of freedom, t 2.776.
    assert "| those with 3 seeds or more |  | 0 | 30 | +30 [+7, +53] | +30 [+7, +53] |" in page


def test_seeds_that_all_differ_alike_leave_no_doubt(script):
    index = script.pd.MultiIndex.from_product([["walker-run", "walker-walk"], [1, 2, 3]], names=["task", "seed"])
    assert script.interval_over_seeds(script.pd.Series(5.0, index)) == (5.0, 0.0)


def test_what_so_many_seeds_would_show(script):
    """Textbooks have 34 pairs for half a standard deviation, at 80% and 95%; 33 fall short of it."""
    assert script.least_seen(2.0, 34) < 1 < script.least_seen(2.0, 33)
    draws = np.random.default_rng(0).normal(script.least_seen(7.0, 5), 7.0, (20_000, 5))
    seen = ttest_1samp(draws, 0, axis=1).pvalue < 0.05
    assert seen.mean() == pytest.approx(0.8, abs=0.01)


def test_how_much_seeds_differ_is_of_all_variants_with_enough_of_them(script):
    index = ["variant", "task", "seed"]
    gains = {"one head": [0.0, 30.0, 60.0], "final depth": [5.0, 5.0, 5.0, 5.0, 5.0], "UTD 2": [0.0, 900.0]}
    rows = [
        {"variant": variant, "task": "walker-run", "seed": seed}
        | {f"{name} {column}": gain * (name == "variant") for name in ("base", "variant") for column in script.COLUMNS}
        for variant, found in gains.items()
        for seed, gain in enumerate(found, start=1)
    ]
    table = script.seen_table(pd.DataFrame(rows).set_index(index))
    # Variances of 900 and 0, of two and four degrees of freedom.
    assert [line for line in table if "walker-run | area | 2 | 8 | 17 | " in line]
    assert len([line for line in table if line.startswith("| walker-run")]) == 2


def test_of_many_intervals_some_leave_out_zero_by_chance(script):
    """The t values are infinite, 5.20 and 1.73; that of 95% is 4.30, that of 99.17% is 10.89."""
    gains = {"walker-run": [9.0, 9.0, 9.0], "hopper-stand": [20.0, 30.0, 40.0], "fish-swim": [0.0, 10.0, 20.0]}
    rows = [
        {"task": task, "seed": seed, "base 50000": 0.0, "base area": 0.0, "variant 50000": gain, "variant area": gain}
        for task, found in gains.items()
        for seed, gain in enumerate(found, start=1)
    ]
    pairs = pd.DataFrame(rows).set_index(["task", "seed"]).sort_index()
    said = script.without_zero(pairs)
    assert said[0] == "Of these 6 intervals of single tasks 4 leave out 0, where chance alone makes 0.3 do so."
    assert said[1].startswith("At 99.17%, ") and said[1].endswith(": walker-run (return), walker-run (area).")
    assert script.without_zero(pairs.drop("fish-swim")) == []


def test_the_figure_is_of_the_variants_that_were_run_on_several_tasks(script):
    def panels(**tasks: list[str]) -> list[str]:
        runs = [(name.replace("_", " "), task, 1) for name, each in tasks.items() for task in each]
        columns = [f"{part} {column}" for part in ("variant", "base") for column in script.COLUMNS]
        pairs = script.pd.DataFrame(0.0, script.pd.MultiIndex.from_tuples(runs), columns)
        pairs.index.names = ["variant", "task", "seed"]
        figure = script.draw(pairs, script.read_experiment(script.file_of("cpu-ablation")))
        return [axis.get_title() for axis in figure.axes[: len(figure.axes) // 2]]

    three = ["walker-run", "hopper-stand", "cheetah-run"]
    assert panels(one_head=["fish-swim"], final_depth=three, UTD_2=three[:2]) == ["final depth"]
    assert panels(one_head=["fish-swim"], UTD_2=three[:2]) == ["one head", "UTD 2"]


def test_what_is_kept_of_the_experiment_s_runs_leaves_out_what_is_kept_elsewhere(script, tmp_path):
    write(tmp_path / "walker-run" / "seed1", dict.fromkeys(script.STEPS, 1.0))
    for variant in ("cpu", "no reanalyze"):
        write(tmp_path / "runs" / variant / "walker-run" / "seed1", dict.fromkeys(script.STEPS, 1.0))
    kept = tmp_path / "ablation"
    script.collect(tmp_path / "runs", kept)
    found = sorted(str(file.relative_to(kept)) for file in kept.rglob("*") if file.is_file())
    assert found == [f"no reanalyze/walker-run/seed1/{name}" for name in ("eval.csv", "summary.json")]


def test_the_base_is_trained_and_kept_where_it_has_no_run(script, tmp_path, monkeypatch):
    write(tmp_path / "walker-run" / "seed1", dict.fromkeys(script.STEPS, 1.0))
    trained = []

    def train(file, variants, tasks, seeds, runs):
        trained.append((variants, tasks, seeds))
        for variant in variants:
            for seed in seeds:
                write(runs / variant / tasks[0] / f"seed{seed}", dict.fromkeys(script.STEPS, 2.0))

    monkeypatch.setattr(script, "train", train)
    command = ["ablation.py", "--variants", "one head", "--tasks", "walker-run", "--seeds", "1", "4", "--runs"]
    monkeypatch.setattr(sys, "argv", [*command, str(tmp_path / "runs")])
    script.main()
    assert trained == [(["cpu"], ["walker-run"], [4]), (["one head"], ["walker-run"], [1, 4])]
    assert (tmp_path / "ablation" / "cpu" / "walker-run" / "seed4" / "eval.csv").exists()
    page = (tmp_path / "ablation" / "README.md").read_text()
    assert "| walker-run | 1, 4 | 2 | 2 | +0 | +0 |" in page  # 1.5 and 2


def test_without_a_pair_there_is_one_line(script, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["ablation.py", "--report-only"])
    with pytest.raises(SystemExit, match=r"^error: no runs under .* run this script without --report-only first\.$"):
        script.main()


def test_a_base_of_the_experiment_s_own_goes_before_the_preset_s_run(script, tmp_path, monkeypatch):
    steps = list(script.STEPS)
    for seed, value in ((1, 100.0), (2, 200.0)):
        write(tmp_path / "walker-run" / f"seed{seed}", dict.fromkeys(steps, value))
        write(tmp_path / "adaptive" / "final" / "walker-run" / f"seed{seed}", dict.fromkeys(steps, 500.0))
    write(tmp_path / "adaptive" / "mean" / "walker-run" / "seed1", dict.fromkeys(steps, 400.0))
    write(tmp_path / "adaptive" / "adaptive beta 0" / "walker-run" / "seed2", dict.fromkeys(steps, 260.0))
    monkeypatch.setattr(sys, "argv", ["ablation.py", "--report-only", "--experiment", "adaptive"])
    script.main()
    page = (tmp_path / "adaptive" / "README.md").read_text()
    assert page.startswith("# Does it pay to choose the planning depth?")
    assert "| walker-run | 1, 2 | 300 | 500 | +200 | +200 |" in page  # 400 of its own, 200 of the preset's run
    table = page[page.index("## Returns") :]
    assert "| walker-run | mean | 1, 2 | 300 | 300 | 300 | 300 | 300 | 300 |" in table
    assert table.index("|  | final | 1, 2 | 500 |") < table.index("|  | adaptive beta 0 | 2 | 260 |")


def test_the_preset_s_runs_of_the_other_experiment_are_partners_where_there_are_no_others(script, tmp_path):
    steps, runs = list(script.STEPS), {"seed1": 100.0, "seed4": 300.0}
    for seed, value in runs.items():
        write(tmp_path / "adaptive" / "mean" / "walker-run" / seed, dict.fromkeys(steps, value))
        write(tmp_path / "ablation" / "one head" / "walker-run" / seed, dict.fromkeys(steps, 500.0))
    write(tmp_path / "walker-run" / "seed1", dict.fromkeys(steps, 200.0))
    pairs, alone = script.read_pairs(tmp_path / "ablation", "cpu")
    assert script.differences(pairs, "50000").tolist() == [300.0, 200.0] and not alone


def test_runs_of_a_variant_with_the_same_settings_stand_for_missing_ones(script, tmp_path):
    steps = list(script.STEPS)
    for seed in ("seed1", "seed2"):
        write(tmp_path / "walker-run" / seed, dict.fromkeys(steps, 200.0))
        write(tmp_path / "adaptive" / "final" / "walker-run" / seed, dict.fromkeys(steps, 300.0))
    write(tmp_path / "ablation" / "final depth" / "walker-run" / "seed2", dict.fromkeys(steps, 250.0))
    pairs, alone = script.read_pairs(tmp_path / "ablation", "cpu")
    assert script.differences(pairs, "50000").to_dict() == {
        ("final depth", "walker-run", 1): 100.0,
        ("final depth", "walker-run", 2): 50.0,
    }
    assert not alone


@pytest.mark.parametrize("variant", ["one hed", "mean"])
def test_a_variant_that_there_is_not_is_refused_before_anything_is_trained(script, monkeypatch, capsys, variant):
    monkeypatch.setattr(script, "train", lambda *arguments: pytest.fail("trains"))
    monkeypatch.setattr(sys, "argv", ["ablation.py", "--experiment", "adaptive", "--variants", variant])
    with pytest.raises(SystemExit):
        script.main()
    assert "--variants of adaptive are 'final', 'adaptive beta 0'" in (said := capsys.readouterr().err)
    assert f"got {variant!r}." in said


@pytest.fixture
def committed(monkeypatch):
    monkeypatch.syspath_prepend(BENCHMARKS)
    script = importlib.import_module("ablation")

    def read(name: str) -> tuple:
        folder, experiment = script.RESULTS / script.KEPT[name], script.read_experiment(script.file_of(name))
        return folder, experiment, *script.read_pairs(folder, experiment.base)

    return script, read


@pytest.mark.parametrize("name", ["cpu-ablation", "adaptive"])
def test_the_committed_tables_are_those_of_the_committed_files(committed, name):
    script, read = committed
    folder, experiment, pairs, alone = read(name)
    assert (folder / "README.md").read_text() == script.report(pairs, experiment, alone)


def test_the_study_of_the_adaptive_score_has_the_differences_of_the_committed_files(committed):
    script, read = committed
    _, experiment, pairs, _ = read("adaptive")
    page = (BENCHMARKS.parent / "docs" / "studies" / "planner.md").read_text()
    for variant in script.in_order(pairs, experiment):
        rows, cells = pairs.xs(variant, level="variant"), [variant]
        for column in (str(script.ENV_STEPS), "area"):
            found = script.differences(rows, column)
            intervals = [script.interval(found.groupby("task").mean()), script.interval_over_seeds(found)]
            cells.append(f"{intervals[0][0]:+.0f}")
            for mean, half in intervals if column != "area" else intervals[1:]:
                cells.append(f"{mean - half:+.0f} to {mean + half:+.0f}")
        assert f"| {' | '.join(cells)} |" in page


def test_the_study_of_the_ablation_has_the_areas_of_the_committed_files(committed):
    script, read = committed
    _, experiment, pairs, _ = read("cpu-ablation")
    page = (BENCHMARKS.parent / "docs" / "studies" / "ablation.md").read_text()
    found = 0
    for variant in script.in_order(pairs, experiment):
        rows = pairs.xs(variant, level="variant")
        if "walker-run" in rows.index.get_level_values("task"):
            rows = rows.loc["walker-run"]
            each = script.differences(rows, "area")
            cells = [variant, ", ".join(map(str, rows.index))]
            cells += [", ".join(f"{area:.0f}" for area in rows["variant area"])]
            cells += [", ".join(f"{area:+.0f}" for area in each)]
            cells += [script.written(*script.interval(each))]
            assert f"| {' | '.join(cells)} |" in page
            found += 1
    assert found == 10


def test_the_study_of_the_ablation_has_what_all_four_parts_do(committed):
    script, read = committed
    _, experiment, pairs, _ = read("cpu-ablation")
    page = " ".join((BENCHMARKS.parent / "docs" / "studies" / "ablation.md").read_text().split())
    rows = pairs.xs("all four off (BMPC)", level="variant")
    by_task = [row for row in script.tasks_table(rows, experiment)[2:] if not row.startswith("| these tasks")]
    assert len(by_task) == 15
    assert [row for row in by_task if row not in page] == []

    named = {"the five of the experiment": experiment.tasks, "all 15 that the preset was not tuned on": None}
    for name, tasks in named.items():
        cells = [name]
        for column in (str(script.ENV_STEPS), "area"):
            found = script.differences(rows, column).loc[slice(None) if tasks is None else list(tasks)]
            intervals = [script.interval(found.groupby("task").mean()), script.interval_over_seeds(found)]
            cells.append(f"{intervals[0][0]:+.0f}")
            cells += [f"{mean - half:+.0f} to {mean + half:+.0f}" for mean, half in intervals]
        assert f"| {' | '.join(cells)} |" in page

    seen = {tuple(row.split(" | ")[:2]): row.split(" | ") for row in script.seen_table(pairs) if " | area | " in row}
    walker, hopper = (seen[f"| {task}", "area"] for task in ("walker-run", "hopper-stand"))
    five, twenty = (5 + script.SEEDS.index(count) for count in (5, 20))
    assert f"areas of {walker[five]} with five seeds of walker-run and of {walker[twenty]} with 20; " in page
    assert f"of hopper-stand it takes {hopper[five]} with five and {hopper[twenty]} with 20. " in page


def test_the_study_of_the_ablation_has_the_returns_on_cartpole_balance_sparse(committed):
    script, read = committed
    _, experiment, pairs, _ = read("cpu-ablation")
    page = (BENCHMARKS.parent / "docs" / "studies" / "ablation.md").read_text()
    rows = pairs.xs("cartpole-balance-sparse", level="task")
    for variant in script.in_order(rows, experiment):
        for seed, row in rows.loc[variant].iterrows():
            for who, kind in ((experiment.base, "base"), (variant, "variant")):
                cells = " | ".join(f"{row[f'{kind} {column}']:.0f}" for column in script.COLUMNS)
                assert f"| {seed if kind == 'base' else ''} | {who} | {cells} |" in page


def test_the_study_of_the_ablation_has_the_returns_by_either_score(committed):
    script, _ = committed
    page = (BENCHMARKS.parent / "docs" / "studies" / "ablation.md").read_text()
    table = script.pd.read_csv(script.RESULTS / "ablation" / "first_evaluation.csv")
    returns = table.set_index(["learned_with", "acts_by", "seed"])["return_mean"].sort_index()
    for name, label in (("cpu", "the mean over depths (cpu)"), ("final depth", "the last depth (final depth)")):
        cells = [", ".join(f"{value:.0f}" for value in returns[name, score]) for score in ("mean", "final")]
        assert f"| {label} | {' | '.join(cells)} |" in page
    ahead = returns["final depth"] - returns["cpu"]
    other = returns.xs("final", level="acts_by") - returns.xs("mean", level="acts_by")
    said = " ".join(page.split())
    assert f"by {ahead.min():.0f} to {ahead.max():.0f} and by {ahead.mean():.0f} in the mean of the eight pairs" in said
    between = f"between {-other.min():.0f} less and {other.max():.0f} more"
    assert f"gives {other.mean():.0f} more in the mean, {between}" in said
    assert f"standard deviations over episodes are up to {table['return_std'].max():.0f}:" in said
