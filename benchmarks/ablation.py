"""Does the method help at the cpu preset's size? The experiment `cpu-ablation`, what is kept of its runs, its figure.

    python benchmarks/ablation.py                          # 10 variants, 5 tasks, 5 seeds, 50,000 env steps: days
    python benchmarks/ablation.py --variants "all four off (BMPC)" --tasks walker-run hopper-stand --seeds 1
    python benchmarks/ablation.py --report-only            # from the committed files

Runs stand in `runs/cpu-ablation`, where `examples/suite.py` goes on with interrupted ones. Of finished ones
`benchmarks/results/cpu/ablation/<variant>/<task>/seed<k>` gets `eval.csv` and `summary.json`. They are compared with
the runs of `cpu_learning.py`, which have the same settings but for the variant's own, the same seeds and so the same
random phase. Writes `README.md` and `differences.png` there.
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
from cpu_learning import RESULTS, ROOT, TASKS
from matplotlib.figure import Figure
from scipy.stats import t as student

from torchrl_etdmpc.analysis import read_runs
from torchrl_etdmpc.envs import DMC_TASKS
from torchrl_etdmpc.runs import RunDirectory
from torchrl_etdmpc.suites import read_experiment

FOLDER = RESULTS / "ablation"
EXPERIMENT = ROOT / "benchmarks" / "experiments" / "cpu-ablation.yaml"
RUNS = ROOT / "runs" / "cpu-ablation"
BASE, ENV_STEPS = "cpu", 50_000
STEPS = range(10_000, ENV_STEPS + 1, 10_000)


def collect(runs: Path) -> None:
    """Copies what is kept of finished runs."""
    for summary in sorted(runs.glob("*/*/seed*/summary.json")):
        source = RunDirectory(summary.parent)
        variant, task, seed = summary.parts[-4:-1]
        if variant != BASE:
            target = FOLDER / variant / task / seed
            target.mkdir(parents=True, exist_ok=True)
            for file in (source.eval, source.summary):
                shutil.copy(file, target)


def read_pairs() -> pd.DataFrame:
    """Runs of variants that the base has with the same task and seed.

    Returns:
        DataFrame: index ``variant, task, seed``; the returns of both at ``STEPS`` (columns ``variant 50000`` and
        ``base 50000`` for the last one).
    """
    rows = []
    for folder in sorted(FOLDER.glob("*/*/seed*")):
        variant, task, seed = folder.parts[-3:]
        base = RESULTS / task / seed
        if not RunDirectory(base).finished:
            continue
        row: dict[str, object] = {"variant": variant, "task": task, "seed": int(seed.removeprefix("seed"))}
        for name, path in (("variant", folder), ("base", base)):
            returns = read_runs([path]).set_index("env_steps")["return_mean"]
            row |= {f"{name} {step}": returns[step] for step in STEPS}
        rows.append(row)
    if not rows:
        sys.exit(f"error: no runs under {FOLDER} that {RESULTS} has too; run this script without --report-only first.")
    return pd.DataFrame(rows).set_index(["variant", "task", "seed"])


def mean_over_tasks(differences: pd.Series) -> tuple[float, float]:
    """Mean of one difference per task, and half of its 95% interval (Student's t over the tasks; NaN for one)."""
    count = len(differences)
    if count < 2:
        return differences.mean(), float("nan")
    return differences.mean(), student.ppf(0.975, count - 1) * differences.std() / count**0.5


def groups(tasks: pd.Index) -> dict[str, pd.Index]:
    """All tasks; those of the experiment, those that the preset was tuned on and the others, where that is a part."""
    chosen = read_experiment(EXPERIMENT).tasks
    parts = {
        "all": tasks,
        "those of the experiment": tasks[tasks.isin(chosen)],
        "tuned on": tasks[tasks.isin(TASKS)],
        "not tuned on": tasks[~tasks.isin(TASKS)],
    }
    return {name: part for name, part in parts.items() if name == "all" or 0 < len(part) < len(tasks)}


def report(pairs: pd.DataFrame) -> str:
    """Tables of every variant."""
    lines = ["# Does the method help at this size?", "", *__doc__.strip().split("\n\n")[-1].splitlines(), ""]
    lines += [
        "A difference is the variant's return minus the preset's, of runs with the same task and seed, ten episodes",
        "each; above 0 the variant is ahead. In brackets the 95% interval of the mean over tasks (Student's t over one",
        "difference per task): it says what other tasks of this kind would show, not what other seeds would.",
        f"{', '.join(TASKS[:-1])} and {TASKS[-1]} are those that the preset was tuned on.",
        "",
    ]
    for variant, rows in pairs.groupby("variant", sort=False):
        by_task = rows.groupby("task").mean()
        lines += [
            f"## {variant}",
            "",
            "| mean over tasks | tasks | " + " | ".join(f"{step:,}" for step in STEPS) + " |",
        ]
        lines += ["|---|---" + "|---" * len(STEPS) + "|"]
        for name, tasks in groups(by_task.index).items():
            cells = []
            for step in STEPS:
                mean, half = mean_over_tasks(by_task.loc[tasks, f"variant {step}"] - by_task.loc[tasks, f"base {step}"])
                cells.append(f"{mean:+.0f}" + ("" if np.isnan(half) else f" [{mean - half:+.0f}, {mean + half:+.0f}]"))
            lines.append(f"| {name} | {len(tasks)} | {' | '.join(cells)} |")
        lines += [
            "",
            f"| task | seeds | {BASE} at {ENV_STEPS:,} | variant | difference |",
            "|---|---|---|---|---|",
        ]
        for task, seeds in rows.groupby("task"):
            mean = seeds.mean()
            ours, theirs = mean[f"base {ENV_STEPS}"], mean[f"variant {ENV_STEPS}"]
            numbers = ", ".join(map(str, sorted(seeds.index.get_level_values("seed"))))
            lines.append(f"| {task} | {numbers} | {ours:.0f} | {theirs:.0f} | {theirs - ours:+.0f} |")
        lines.append("")
    return "\n".join([*lines, "![differences](differences.png)", ""])


def draw(pairs: pd.DataFrame) -> Figure:
    """A panel for each variant: the difference on every task, and where there are several their mean."""
    variants, tasks = list(pairs.index.unique("variant")), sorted(pairs.index.unique("task"), reverse=True)
    figure = Figure(figsize=(1.6 + 2.6 * len(variants), 0.26 * len(tasks) + 1.5), layout="constrained")
    axes = figure.subplots(1, len(variants), squeeze=False, sharex=True, sharey=True)[0]
    for axis, variant in zip(axes, variants, strict=True):
        by_task = pairs.loc[variant].groupby("task").mean()
        found = by_task[f"variant {ENV_STEPS}"] - by_task[f"base {ENV_STEPS}"]
        for task, difference in found.items():
            place = 1 + tasks.index(str(task))
            axis.plot(difference, place, "o", color="#0072B2", fillstyle="none" if task in TASKS else "full")
        mean, half = mean_over_tasks(found)
        if not np.isnan(half):
            axis.errorbar(mean, 0, xerr=half, fmt="D", color="black", capsize=3)
        axis.axvline(0, color="grey", linewidth=0.8)
        axis.set_title(textwrap.fill(variant, 26), fontsize=10)
        axis.grid(axis="x", alpha=0.3)
    names = [f"{task} (tuned on)" if task in TASKS else task for task in tasks]
    axes[0].set_yticks(range(len(tasks) + 1), ["mean, 95% interval", *names])
    figure.supxlabel(f"return minus the preset's at {ENV_STEPS:,} env steps", fontsize=10)
    return figure


def train(variants: Sequence[str], tasks: Sequence[str], seeds: Sequence[int], runs: Path) -> None:
    """The runs of the experiment that are missing."""
    command = [sys.executable, str(ROOT / "examples" / "suite.py"), f"experiment={EXPERIMENT}", f"runs_dir={runs}"]
    command += [f"variants={','.join(variants)}", f"tasks={','.join(tasks)}", f"seeds={list(seeds)}"]
    subprocess.run(command, check=True)


def main() -> None:
    experiment = read_experiment(EXPERIMENT)
    others = [variant for variant in experiment.variants if variant != BASE]
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--variants", nargs="+", default=others, choices=others, metavar="VARIANT")
    parser.add_argument("--tasks", nargs="+", default=list(experiment.tasks), choices=DMC_TASKS, metavar="TASK")
    parser.add_argument("--seeds", nargs="+", type=int, default=[1, 2, 3, 4, 5])
    parser.add_argument("--runs", type=Path, default=RUNS, help="folder of the experiment's runs")
    parser.add_argument("--report-only", action="store_true")
    arguments = parser.parse_args()
    if not arguments.report_only:
        train(arguments.variants, arguments.tasks, arguments.seeds, arguments.runs)
        collect(arguments.runs)
    pairs = read_pairs()
    (FOLDER / "README.md").write_text(report(pairs))
    draw(pairs).savefig(FOLDER / "differences.png", dpi=120)


if __name__ == "__main__":
    main()
