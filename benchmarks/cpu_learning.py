"""Learning runs of the cpu preset: the experiment `cpu-all`, what is kept of its runs, and reports.

    python benchmarks/cpu_learning.py                 # 28 tasks, 3 seeds, 100,000 env steps: 32 hours on two cores
    python benchmarks/cpu_learning.py --tasks walker-stand --seeds 1
    python benchmarks/cpu_learning.py --report-only   # from the committed files

Runs stand in `runs/cpu-all`, where `examples/suite.py` goes on with interrupted ones. Of finished ones
`benchmarks/results/cpu/<task>/seed<k>` gets `eval.csv` and `summary.json`, and `train.csv` where `early_markers.py`
reads it. `report/` sets the six tasks that the preset was tuned on beside published curves, `report-easy/` and
`report-hard/` those of the benchmark that have runs. `README.md` then has returns and times of all that are there, and
`docs/results.md` means over the easy tasks that it was tuned on and over the others, and every task, beside baselines.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import pandas as pd
from scipy.stats import t as student

from torchrl_etdmpc.analysis import get_benchmark, read_runs
from torchrl_etdmpc.envs import DMC_TASKS
from torchrl_etdmpc.runs import RunDirectory

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "benchmarks" / "results" / "cpu"
PAGE = ROOT / "docs" / "results.md"
EXPERIMENT = ROOT / "benchmarks" / "experiments" / "cpu-all.yaml"
RUNS = ROOT / "runs" / "cpu-all"
TASKS = ("walker-stand", "reacher-easy", "cartpole-swingup", "cup-catch", "finger-spin", "walker-walk")
"""What the preset was tuned on."""
MARKED = ("walker-walk", "reacher-easy")
"""Tasks whose ``train.csv`` is kept."""
SEEDS = (1, 2, 3)
STEPS = (50_000, 100_000)
BESIDE = ("SimbaV2-UTD8", "FoG", "DR.Q", "BMPC", "TD-MPC2")
"""What has a mean over all easy tasks at the last step, the method's own lineage among it."""


def run(
    task: str,
    seed: int,
    env_steps: int,
    *overrides: str,
    target: Path,
    preset: str = "cpu",
    keep: Sequence[str] = ("eval", "summary"),
) -> str:
    """One run in a process of its own; files of it (``keep``) go to ``target``. Returns a line for the terminal."""
    if RunDirectory(target).finished:
        return f"{task} seed {seed}: already there"
    with tempfile.TemporaryDirectory() as folder:
        run_dir = Path(folder) / "run"
        command = [sys.executable, str(ROOT / "examples" / "train_dmc.py"), f"preset={preset}", f"task={task}"]
        command += [f"seed={seed}", f"total_env_steps={env_steps}", f"run_dir={run_dir}", *overrides]
        result = subprocess.run(command, env={**os.environ, "OMP_NUM_THREADS": "1"}, capture_output=True, text=True)
        if result.returncode:
            return f"{task} seed {seed}: failed: {result.stderr.strip().splitlines()[-1]}"
        target.mkdir(parents=True, exist_ok=True)
        for name in keep:
            shutil.copy(getattr(RunDirectory(run_dir), name), target)
    return result.stdout.strip().splitlines()[-1].split(";")[0] + f" (seed {seed})"


def collect(runs: Path) -> None:
    """Copies what is kept of finished runs."""
    for summary in sorted(runs.glob("cpu/*/seed*/summary.json")):
        source = RunDirectory(summary.parent)
        task, seed = summary.parts[-3:-1]
        target = RESULTS / task / seed
        target.mkdir(parents=True, exist_ok=True)
        for file in (source.eval, source.summary, *([source.train] if task in MARKED else [])):
            shutil.copy(file, target)


def folders(tasks: Sequence[str]) -> list[Path]:
    """Those of the tasks that have committed runs."""
    return [RESULTS / task for task in sorted(tasks) if any((RESULTS / task).glob("seed*/eval.csv"))]


def write_report(tasks: Sequence[str], out: Path) -> None:
    """Runs beside the published curves."""
    found = folders(tasks)
    if not found:
        return
    command = [sys.executable, str(ROOT / "examples" / "report.py"), *map(str, found), "--out", str(out)]
    # From 20,000 on, where several baselines were evaluated first: the area before is known of these runs alone.
    command += ["--budget", str(STEPS[-1]), "--grid-step", "10000", "--grid-start", "20000"]
    subprocess.run(command, check=True)


def half_interval(shares: pd.Series, counts: pd.Series) -> float:
    """Half of the 95% interval over seeds of a mean over tasks.

    Tasks have their own variances, so the degrees of freedom of Student's t are those of Welch and Satterthwaite.

    Args:
        shares (Series): by task, the squared standard error of its mean; the interval is NaN if one is not known.
        counts (Series): by task, the seeds of that mean.
    """
    total = shares.sum(skipna=False)
    if total == 0:
        return 0.0
    freedom = total**2 / (shares**2 / (counts - 1)).sum(skipna=False)
    return student.ppf(0.975, freedom) * total**0.5 / len(shares)


def beside_baselines(returns: pd.DataFrame) -> list[str]:
    """Means over the tasks that the preset was tuned on, over the others and over all, as lines of Markdown.

    Args:
        returns (DataFrame): ``returns.csv`` of a report. At each number of env steps the tasks are those on which the
            preset has a return; a method that lacks one of them has no mean.
    """
    rows = returns[returns["tasks"] == 1]
    groups = {}
    for step in STEPS:
        tasks = rows.loc[(rows["method"] == "cpu") & (rows["env_steps"] == step), "task"]
        tuned = tasks.isin(TASKS)
        for name, chosen in (("tuned", tasks[tuned]), ("others", tasks[~tuned]), ("all", tasks)):
            if len(chosen):
                groups[f"{step:,}: {len(chosen)} {name}"] = rows[rows["env_steps"].eq(step) & rows["task"].isin(chosen)]
    lines = {}
    for method, kinds in rows.groupby("method", sort=False)["kind"]:
        cells = []
        for group in groups.values():
            own = group[group["method"] == method]
            if len(own) < group["task"].nunique():
                cells.append("–")
                continue
            mean, half = own["mean"].mean(), half_interval(own["standard_error"].pow(2), own["seeds"])
            cell = f"{'≈ ' if own['kind'].eq('interpolated').any() else ''}{mean:.0f}"
            cells.append(cell if pd.isna(half) else f"{cell} [{mean - half:.0f}, {mean + half:.0f}]")
            place = -mean  # ends as that over all tasks at the last step
        if set(cells) != {"–"}:
            name = "**cpu**" if method == "cpu" else method
            row = f"| {name}{' (quoted)' if kinds.eq('quoted').all() else ''} | {' | '.join(cells)} |"
            lines[row] = (0.0 if cells[-1] == "–" else place, method)
    return [
        f"| mean return at | {' | '.join(groups)} |",
        "|---" * (1 + len(groups)) + "|",
        *sorted(lines, key=lambda row: lines[row]),
    ]


def by_task(returns: pd.DataFrame, curves: pd.DataFrame) -> list[str]:
    """Returns of single tasks at the last step, furthest ahead of the highest other mean first, as lines of Markdown.

    Args:
        returns (DataFrame): ``returns.csv`` of a report.
        curves (DataFrame): the preset's evaluations, as of :func:`read_runs`.
    """
    at_end = returns[(returns["tasks"] == 1) & (returns["env_steps"] == STEPS[-1])]
    lines = {}
    for task, rows in at_end.groupby("task"):
        means = rows.set_index("method")["mean"]
        if "cpu" not in means:
            continue
        seeds = curves.loc[(curves["task"] == task) & (curves["env_steps"] == STEPS[-1]), "return_mean"]
        others = means.drop("cpu")
        cells = [
            task,
            f"{means['cpu']:.0f}",
            ", ".join(f"{value:.0f}" for value in seeds),
            f"{others.idxmax()} {others.max():.0f}",
            *(f"{means[name]:.0f}" if name in means else "–" for name in BESIDE),
        ]
        lines[f"| {' | '.join(cells)} |"] = others.max() - means["cpu"]
    heads = ["task", "**cpu**", "its seeds", "highest other", *BESIDE]
    return [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|", *sorted(lines, key=lambda row: lines[row])]


def write_readme(table: pd.DataFrame) -> None:
    """A table of returns, budgets and wall times."""
    lines = [
        "# Learning runs of the cpu preset",
        "",
        "What `python benchmarks/cpu_learning.py` makes: runs of `benchmarks/experiments/cpu-all.yaml`, two at a time,",
        "one thread each, with other work beside. Returns are means of evaluations (10 episodes, planner without",
        "noise) and in brackets those of each seed; minutes include random phase, compilation, evaluations and pauses,",
        "ms per decision pauses too: runs far above the others waited while something else was timed. A plan of the",
        "humanoids and dogs, whose actions have more than 20 dimensions, has five iterations, of the others three.",
        "Tasks that are missing, and missing seeds of three, are not run yet.",
        "",
        f"The preset's settings were chosen on {', '.join(TASKS[:-1])} and {TASKS[-1]}, with these",
        "seeds. Reacher-hard, finger-turn-hard, finger-turn-easy, pendulum-swingup, cheetah-run and hopper-stand were",
        "looked at meanwhile, with seed 1, the first two with seed 2 as well.",
        "",
        f"| task | seeds | {' | '.join(f'at {step:,}' for step in STEPS)} | best mean | minutes | ms per decision |",
        "|---|---|---|---|---|---|---|",
    ]
    versions = set()
    for task, rows in table.groupby("task"):
        seeds = sorted((RESULTS / task).glob("seed*"))
        summaries = [json.loads(RunDirectory(seed).summary.read_text()) for seed in seeds]
        curve = rows.groupby("env_steps").return_mean.mean()
        cells = []
        for step in STEPS:
            values = rows.loc[rows["env_steps"] == step, "return_mean"]  # by seed, as read
            each = f" ({', '.join(f'{value:.0f}' for value in values)})" if len(values) > 1 else ""
            cells.append(f"{values.mean():.0f}{each}" if len(values) else "–")
        walls = sorted(summary["wall_time_s"] / 60 for summary in summaries)
        times = sorted(1000 / summary["decisions_per_second"] for summary in summaries)
        versions |= {json.dumps(summary["versions"], sort_keys=True) for summary in summaries}
        lines.append(
            f"| {task} | {len(seeds)} | {' | '.join(cells)} | {curve.max():.0f} at {curve.idxmax():,.0f} "
            f"| {_range(walls)} | {_range(times)} |"
        )
    lines += ["", "Versions: " + "; ".join(sorted(versions)).replace('"', "") + ".", ""]
    lines += [
        "Beside published curves: [means](../../../docs/results.md#what-the-cpu-preset-is-worth),",
        "[the six tasks that it was tuned on](report/index.md), [easy tasks](report-easy/index.md),",
        "[hard tasks](report-hard/index.md).",
        "With the preset's former settings:",
        "[values that were imagined alone](imagined/README.md), [with 101 bins too](bins-101/README.md),",
        "[at half the width](width-64/README.md).",
        "",
        "![learning curves](report-easy/curves.png)",
        "",
    ]
    (RESULTS / "README.md").write_text("\n".join(lines))


def write_table(name: str, lines: Sequence[str]) -> None:
    """A table into its place on the page on results."""
    begin, end = f"<!-- {name}: written by benchmarks/cpu_learning.py -->\n", "<!-- end -->"
    head, rest = PAGE.read_text(encoding="utf-8").split(begin)
    PAGE.write_text("\n".join((head + begin + lines[0], *lines[1:], rest[rest.index(end) :])), encoding="utf-8")


def _range(values: Sequence[float]) -> str:
    """Lowest to highest, of sorted values."""
    low, high = f"{values[0]:.0f}", f"{values[-1]:.0f}"
    return low if low == high else f"{low} to {high}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tasks", nargs="+", default=DMC_TASKS, choices=DMC_TASKS, metavar="TASK")
    parser.add_argument("--seeds", nargs="+", type=int, default=list(SEEDS))
    parser.add_argument("--runs", type=Path, default=RUNS, help="folder of the experiment's runs")
    parser.add_argument("--report-only", action="store_true")
    arguments = parser.parse_args()
    if not arguments.report_only:
        command = [sys.executable, str(ROOT / "examples" / "suite.py"), f"experiment={EXPERIMENT}"]
        command += [f"tasks={','.join(arguments.tasks)}", f"seeds={arguments.seeds}", f"runs_dir={arguments.runs}"]
        subprocess.run(command, check=True)
        collect(arguments.runs)
    found = folders(DMC_TASKS)
    if not found:
        sys.exit(f"error: no runs under {RESULTS}; run this script without --report-only first.")
    write_report(TASKS, RESULTS / "report")
    for level in ("easy", "hard"):
        write_report(get_benchmark(f"dmc-{level}").tasks, RESULTS / f"report-{level}")
    curves, returns = read_runs(found), pd.read_csv(RESULTS / "report-easy" / "returns.csv")
    write_readme(curves)
    write_table("means", beside_baselines(returns))
    write_table("tasks", by_task(returns, curves))


if __name__ == "__main__":
    main()
