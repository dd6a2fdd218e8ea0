"""Variants of the cpu preset beside it: the runs of an experiment, what is kept of them, tables and a figure.

    python benchmarks/ablation.py                          # 12 variants, 5 tasks, 5 seeds, 50,000 env steps: days
    python benchmarks/ablation.py --variants "all four off (BMPC)" --tasks walker-run hopper-stand --seeds 1
    python benchmarks/ablation.py --experiment adaptive    # 5 variants, 4 tasks, 5 seeds: a day
    python benchmarks/ablation.py --report-only            # from the committed files

Runs stand in `runs/<experiment>`, where `examples/suite.py` goes on with interrupted ones. Of finished ones
`benchmarks/results/cpu/<ablation or adaptive>/<variant>/<task>/seed<k>` gets `eval.csv` and `summary.json`. They are
compared with the preset as it is: with the experiment's own runs of it, with those of `cpu_learning.py`, whose
evaluations have ten episodes, or with *mean* of the experiment "adaptive", whose have twenty; where there is none it is
trained, too. Same settings but for the variant's own, same seed and so the same random phase. Writes `README.md` and
`differences.png` there.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import textwrap
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from cpu_learning import RESULTS, ROOT, TASKS, half_interval
from matplotlib.figure import Figure
from scipy.optimize import brentq
from scipy.stats import nct
from scipy.stats import t as student

from torchrl_etdmpc.analysis import read_runs
from torchrl_etdmpc.envs import DMC_TASKS
from torchrl_etdmpc.runs import RunDirectory
from torchrl_etdmpc.suites import Experiment, read_experiment

KEPT = {"cpu-ablation": "ablation", "adaptive": "adaptive"}
"""Folder below ``RESULTS`` by the name of the experiment."""
AS_IT_IS = (".", "adaptive/mean")
"""Folders below ``RESULTS`` with runs of the preset as it is, whatever the experiment."""
ALIKE = {"ablation/final depth": "adaptive/final"}
"""Variants with the settings of another experiment's, below ``RESULTS``: its runs stand for those that are missing."""
ENV_STEPS = 50_000
STEPS = range(10_000, ENV_STEPS + 1, 10_000)
COLUMNS = (*map(str, STEPS), "area")
"""What is compared: returns, and the area under the curve from 0 on as in thesis D.1, by its length."""
HEADER = " | ".join([*(f"{step:,}" for step in STEPS), "area"])
LEAST = 3
"""Tasks or seeds for an interval: that of two is thirteen times as wide as the two are apart."""
SEEDS = (3, 5, 10, 20, 50)
"""Numbers of seeds for which it is said what they would show."""
POWER = 0.8
"""How many of such experiments would show it."""


def file_of(name: str) -> Path:
    """The experiment's file."""
    return ROOT / "benchmarks" / "experiments" / f"{name}.yaml"


def collect(runs: Path, folder: Path) -> None:
    """Copies what is kept of finished runs, but for those of the preset that ``cpu_learning.py`` keeps."""
    for summary in sorted(runs.glob("*/*/seed*/summary.json")):
        source = RunDirectory(summary.parent)
        variant, task, seed = summary.parts[-4:-1]
        if variant != "cpu" or not (RESULTS / task / seed).exists():
            target = folder / variant / task / seed
            target.mkdir(parents=True, exist_ok=True)
            for file in (source.eval, source.summary):
                shutil.copy(file, target)


def partner(folder: Path, base: str, task: str, seed: str) -> Path | None:
    """The run of the preset as it is with the same task and seed, if there is one."""
    folders = (path / task / seed for path in (folder / base, *(RESULTS / name for name in AS_IT_IS)))
    return next((path for path in folders if RunDirectory(path).finished), None)


def read_pairs(folder: Path, base: str) -> tuple[pd.DataFrame, list[str]]:
    """Runs of variants that the base has with the same task and seed; the names of those that it has not.

    Args:
        folder: of the kept runs.
        base: the variant that is the preset as it is; its runs are in ``folder`` or else where :data:`AS_IT_IS` says.

    Returns:
        tuple: index ``variant, task, seed``; ``COLUMNS`` of both (``variant 50000`` and ``base 50000``). And
        ``variant/task/seed`` of each run without a partner.
    """
    rows, alone = [], []
    runs = {path.parts[-3:]: path for path in folder.glob("*/*/seed*")}
    for name, other in ALIKE.items():
        kept, variant = name.split("/")
        found = (RESULTS / other).glob("*/seed*") if kept == folder.name else ()
        runs = {(variant, *path.parts[-2:]): path for path in found} | runs
    for (variant, task, seed), path in sorted(runs.items()):
        if variant == base:
            continue
        beside = partner(folder, base, task, seed)
        if beside is None:
            alone.append(f"{variant}/{task}/{seed}")
            continue
        row: dict[str, object] = {"variant": variant, "task": task, "seed": int(seed.removeprefix("seed"))}
        for name, run in (("variant", path), ("base", beside)):
            returns = read_runs([run]).set_index("env_steps")["return_mean"].loc[[0, *STEPS]]
            row |= {f"{name} {step}": returns[step] for step in STEPS}
            row[f"{name} area"] = np.trapezoid(returns, returns.index) / ENV_STEPS
        rows.append(row)
    if not rows:
        sys.exit(f"error: no runs under {folder} that the preset has too; run this script without --report-only first.")
    return pd.DataFrame(rows).set_index(["variant", "task", "seed"]), alone


def interval(differences: pd.Series, level: float = 0.95) -> tuple[float, float]:
    """Mean and half of its interval (Student's t; NaN for fewer than ``LEAST`` differences)."""
    count = len(differences)
    if count < LEAST:
        return differences.mean(), float("nan")
    return differences.mean(), student.ppf((1 + level) / 2, count - 1) * differences.std() / count**0.5


def interval_over_seeds(differences: pd.Series) -> tuple[float, float]:
    """Mean over tasks and half of its 95% interval over seeds of these tasks, several of each."""
    tasks = differences.groupby("task").agg(["mean", "var", "count"])
    return tasks["mean"].mean(), half_interval(tasks["var"] / tasks["count"], tasks["count"])


def least_seen(deviation: float, count: int) -> float:
    """The least true difference that ``POWER`` of experiments with so many pairs tell from 0 at 95% (paired t test).

    Args:
        deviation: standard deviation of one pair's difference.
        count: pairs.
    """
    critical = student.ppf(0.975, count - 1)

    def too_seldom(effect: float) -> float:
        return POWER - float(nct.sf(critical, count - 1, effect * count**0.5))

    return deviation * brentq(too_seldom, 0, 10)


def written(mean: float, half: float) -> str:
    """``+84 [-96, +265]``, or the mean alone."""
    return f"{mean:+.0f}" + ("" if np.isnan(half) else f" [{mean - half:+.0f}, {mean + half:+.0f}]")


def groups(tasks: pd.Index, chosen: Sequence[str]) -> dict[str, pd.Index]:
    """All tasks; those of the experiment, those that the preset was tuned on and the others, where that is a part."""
    parts = {
        "all": tasks,
        "those of the experiment": tasks[tasks.isin(chosen)],
        "tuned on": tasks[tasks.isin(TASKS)],
        "not tuned on": tasks[~tasks.isin(TASKS)],
    }
    return {name: part for name, part in parts.items() if name == "all" or 0 < len(part) < len(tasks)}


def report(pairs: pd.DataFrame, experiment: Experiment, alone: Sequence[str] = ()) -> str:
    """Tables of every variant, and what is in none of them."""
    lines = [f"# {experiment.title}", "", *__doc__.strip().split("\n\n")[-1].splitlines(), ""]
    lines += [
        f"A difference is the variant's return minus that of *{experiment.base}*, of runs with the same task and seed;",
        "above 0 the variant is ahead. In brackets 95% intervals (Student's t). Those over tasks are of one difference",
        "per task: they say what other tasks of this kind would show. Those of a task are of one difference per seed,",
        "and that of a table's last row is of the seeds of each of its tasks: they say what other seeds would show.",
        f"There is none for fewer than {LEAST} tasks or seeds.",
        f"*Area* is that under the curve to {ENV_STEPS:,}, divided by {ENV_STEPS:,}: the mean return on the way.",
        f"{', '.join(TASKS[:-1])} and {TASKS[-1]} are those that the preset was tuned on.",
        "",
        *([f"Left out, because *{experiment.base}* has no run beside them: {', '.join(alone)}.", ""] if alone else []),
    ]
    for variant in in_order(pairs, experiment):
        rows = pairs.xs(variant, level="variant")
        by_task = rows.groupby("task").mean()
        lines += [
            f"## {variant}",
            "",
            f"| mean over tasks | tasks | {HEADER} |",
        ]
        lines += ["|---|---" + "|---" * len(COLUMNS) + "|"]
        for name, tasks in groups(by_task.index, experiment.tasks).items():
            cells = [written(*interval(differences(by_task.loc[tasks], column))) for column in COLUMNS]
            lines.append(f"| {name} | {len(tasks)} | {' | '.join(cells)} |")
        lines += ["", *tasks_table(rows, experiment), "", *without_zero(rows)]
    lines += [*returns_table(pairs, experiment), "", *seen_table(pairs), "", "![differences](differences.png)", ""]
    return "\n".join(lines)


def tasks_table(rows: pd.DataFrame, experiment: Experiment) -> list[str]:
    """A variant's tasks at the last step, means over the seeds that are there, and the mean of those with enough."""
    names = f"| task | seeds | {experiment.base} at {ENV_STEPS:,} | variant | difference | difference of areas |"
    lines = [names, "|---|---|---|---|---|---|"]
    returns = rows[[f"base {ENV_STEPS}", f"variant {ENV_STEPS}"]]
    found = [differences(rows, column) for column in (str(ENV_STEPS), "area")]
    for task, seeds in returns.groupby("task"):
        numbers = ", ".join(map(str, sorted(seeds.index.get_level_values("seed"))))
        cells = [f"{mean:.0f}" for mean in seeds.mean()]
        cells += [written(*interval(each.loc[[task]])) for each in found]
        lines.append(f"| {task} | {numbers} | {' | '.join(cells)} |")
    counts = rows.groupby("task").size()
    enough = [task for task, count in counts.items() if count >= LEAST]
    if len(enough) > 1:
        name = "these tasks" if len(enough) == len(counts) else f"those with {LEAST} seeds or more"
        means = returns.groupby("task").mean().loc[enough].mean()
        cells = [f"{mean:.0f}" for mean in means]
        cells += [written(*interval_over_seeds(each.loc[enough])) for each in found]
        lines.append(f"| {name} |  | {' | '.join(cells)} |")
    return lines


def without_zero(rows: pd.DataFrame) -> list[str]:
    """How many intervals of ``LEAST`` tasks or more leave out 0, and which at a level that allows for their number."""
    found = {
        f"{task} ({'area' if column == 'area' else 'return'})": seeds
        for column in (str(ENV_STEPS), "area")
        for task, seeds in differences(rows, column).groupby("task")
        if len(seeds) >= LEAST
    }
    if len(found) < 2 * LEAST:
        return []
    level = 1 - 0.05 / len(found)
    likely, sure = (
        [name for name, seeds in found.items() if abs(seeds.mean()) > interval(seeds, at)[1]] for at in (0.95, level)
    )
    return [
        f"Of these {len(found)} intervals of single tasks {len(likely)} leave out 0, where chance alone makes "
        f"{0.05 * len(found):.1f} do so.",
        f"At {level:.2%}, which allows for their number (Bonferroni): {', '.join(sure) or 'none'}.",
        "",
    ]


def differences(rows: pd.DataFrame, column: str) -> pd.Series:
    """The variant's minus the base's, of one of ``COLUMNS``."""
    return rows[f"variant {column}"] - rows[f"base {column}"]


def returns_table(pairs: pd.DataFrame, experiment: Experiment) -> list[str]:
    """Returns by task and variant, means over the seeds that are there."""
    lines = ["## Returns", "", f"| task | variant | seeds | {HEADER} |", "|---|---|---" + "|---" * len(COLUMNS) + "|"]
    for task, rows in pairs.groupby("task"):
        bases = rows[[f"base {column}" for column in COLUMNS]].groupby("seed").first()
        found = {experiment.base: bases} | {
            variant: rows.xs(variant, level="variant")[[f"variant {column}" for column in COLUMNS]].droplevel("task")
            for variant in in_order(rows, experiment)
        }
        for variant, returns in found.items():
            numbers = ", ".join(map(str, sorted(returns.index)))
            cells = " | ".join(f"{mean:.0f}" for mean in returns.mean())
            lines.append(f"| {task if variant == experiment.base else ''} | {variant} | {numbers} | {cells} |")
    return lines


def seen_table(pairs: pd.DataFrame) -> list[str]:
    """By task how much seeds differ, and what true difference so many of them would show."""
    names = f"| task | of | variants | pairs | deviation | {' | '.join(f'{count} seeds' for count in SEEDS)} |"
    lines = [
        "## What would be seen",
        "",
        f"The least true difference from the preset that {POWER:.0%} of experiments with so many seeds would tell from",
        "0 (paired t test at 95%). *Deviation* is the standard deviation of the differences of seeds from their",
        f"variant's mean, of all variants with {LEAST} seeds or more together. These share the preset's runs, so it is",
        "a rough one.",
        "",
        names,
        "|---" * (5 + len(SEEDS)) + "|",
    ]
    for task, rows in pairs.groupby("task"):
        for column, name in ((str(ENV_STEPS), f"return at {ENV_STEPS:,}"), ("area", "area")):
            spread = differences(rows, column).groupby("variant").agg(["var", "count"])
            spread = spread[spread["count"] >= LEAST]
            if spread.empty:
                continue
            free = spread["count"] - 1
            deviation = float((spread["var"] * free).sum() / free.sum()) ** 0.5
            cells = " | ".join(f"{least_seen(deviation, count):.0f}" for count in SEEDS)
            lines.append(f"| {task} | {name} | {len(spread)} | {spread['count'].sum()} | {deviation:.0f} | {cells} |")
    return lines


def in_order(pairs: pd.DataFrame, experiment: Experiment) -> list[str]:
    """Those variants that are there, as the experiment has them."""
    return [variant for variant in experiment.variants if variant in pairs.index.unique("variant")]


def draw(pairs: pd.DataFrame, experiment: Experiment) -> Figure:
    """A column for each variant: the difference on every task and with every seed, and the mean over tasks.

    Above of the returns at ``ENV_STEPS``, below of the areas. Where some variants were run on ``LEAST`` tasks or more,
    the others stand in the tables alone.
    """
    variants = in_order(pairs, experiment)
    variants = [name for name in variants if pairs.loc[name].index.unique("task").size >= LEAST] or variants
    tasks = sorted(pairs.loc[variants].index.unique("task"), reverse=True)
    rows = {str(ENV_STEPS): f"return at {ENV_STEPS:,} env steps", "area": "area under the curve"}
    figure = Figure(figsize=(1.6 + 2.6 * len(variants), 2 * (0.26 * len(tasks) + 1.5)), layout="constrained")
    grid = figure.subplots(2, len(variants), squeeze=False, sharex="row", sharey=True)
    names = [f"{task} (tuned on)" if task in TASKS else task for task in tasks]
    for (column, title), axes in zip(rows.items(), grid, strict=True):
        for axis, variant in zip(axes, variants, strict=True):
            found = differences(pairs.loc[variant], column)
            for task, seeds in found.groupby("task"):
                place = 1 + tasks.index(str(task))
                axis.plot(seeds, [place] * len(seeds), "|", color="#0072B2", alpha=0.6)
                axis.plot(seeds.mean(), place, "o", color="#0072B2", fillstyle="none" if task in TASKS else "full")
            mean, half = interval(found.groupby("task").mean())
            if not np.isnan(half):
                axis.errorbar(mean, 0, xerr=half, fmt="D", color="black", capsize=3)
            axis.axvline(0, color="grey", linewidth=0.8)
            axis.set_title(textwrap.fill(variant, 26), fontsize=10)
            axis.grid(axis="x", alpha=0.3)
            axis.set_xlabel(title, fontsize=9)
        axes[0].set_yticks(range(len(tasks) + 1), ["mean, 95% interval", *names])
    figure.supxlabel(f"difference from {experiment.base}", fontsize=10)
    return figure


def train(file: Path, variants: Sequence[str], tasks: Sequence[str], seeds: Sequence[int], runs: Path) -> None:
    """The runs of the experiment that are missing."""
    command = [sys.executable, str(ROOT / "examples" / "suite.py"), f"experiment={file}", f"runs_dir={runs}"]
    command += [f"variants={','.join(variants)}", f"tasks={','.join(tasks)}", f"seeds={list(seeds)}"]
    subprocess.run(command, check=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--experiment", default="cpu-ablation", choices=KEPT)
    parser.add_argument("--variants", nargs="+", metavar="VARIANT", help="default: all but the preset as it is")
    parser.add_argument("--tasks", nargs="+", choices=DMC_TASKS, metavar="TASK", help="default: the experiment's")
    parser.add_argument("--seeds", nargs="+", type=int, default=[1, 2, 3, 4, 5])
    parser.add_argument("--runs", type=Path, help="folder of the runs; default: runs/<experiment>")
    parser.add_argument("--report-only", action="store_true")
    arguments = parser.parse_args()
    experiment, folder = read_experiment(file_of(arguments.experiment)), RESULTS / KEPT[arguments.experiment]
    others = [name for name in experiment.variants if name != experiment.base]
    unknown = [name for name in arguments.variants or [] if name not in others]
    if unknown:
        parser.error(f"--variants of {arguments.experiment} are {', '.join(map(repr, others))}; got {unknown[0]!r}.")
    if not arguments.report_only:
        file, runs = file_of(arguments.experiment), arguments.runs or ROOT / "runs" / arguments.experiment
        tasks = arguments.tasks or experiment.tasks
        for seed in arguments.seeds:
            without = [task for task in tasks if partner(folder, experiment.base, task, f"seed{seed}") is None]
            if without:
                train(file, [experiment.base], without, [seed], runs)
        train(file, arguments.variants or others, tasks, arguments.seeds, runs)
        collect(runs, folder)
    pairs, alone = read_pairs(folder, experiment.base)
    (folder / "README.md").write_text(report(pairs, experiment, alone))
    draw(pairs, experiment).savefig(folder / "differences.png", dpi=120)


if __name__ == "__main__":
    main()
