"""Learning runs of the cpu preset: every task and seed, two at a time with one thread each, and a report.

    python benchmarks/cpu_learning.py                        # the committed runs (about three hours on two cores)
    python benchmarks/cpu_learning.py --tasks walker-stand --seeds 1
    python benchmarks/cpu_learning.py --report-only          # from the committed files

Writes `benchmarks/results/cpu/<task>/seed<k>/{eval.csv,summary.json}`, `README.md` with budgets and wall times, and
`report/` with the comparison to published curves, of the six tasks that have three seeds; `untuned_returns.csv` has
that of the others. Any DMC task may be named. A run that is there already is kept; remove its folder to repeat it.
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
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pandas as pd

from torchrl_etdmpc.analysis import read_runs
from torchrl_etdmpc.envs import DMC_TASKS
from torchrl_etdmpc.runs import RunDirectory

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "benchmarks" / "results" / "cpu"
UNTUNED = RESULTS / "untuned_returns.csv"
TASKS = ("walker-stand", "reacher-easy", "cartpole-swingup", "cup-catch", "finger-spin", "walker-walk")
ENV_STEPS = 50_000
SEEDS = (1, 2, 3)


def run(
    task: str,
    seed: int,
    env_steps: int,
    *overrides: str,
    preset: str = "cpu",
    target: Path | None = None,
    keep: Sequence[str] = ("eval", "summary"),
) -> str:
    """One run in a process of its own; files of it (``keep``) go to ``target``. Returns a line for the terminal."""
    target = target or RESULTS / task / f"seed{seed}"
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


def folders(tasks: Sequence[str]) -> list[Path]:
    """Those of the tasks that have committed runs."""
    found = [
        RESULTS / task for task in sorted(tasks) if any((RESULTS / task).glob(f"seed*/{RunDirectory('').eval.name}"))
    ]
    if not found:
        sys.exit(f"error: no runs under {RESULTS}; run this script without --report-only first.")
    return found


def report(tasks: Sequence[str], out: Path) -> None:
    """Runs beside the published curves, up to the budget of these runs."""
    command = [sys.executable, str(ROOT / "examples" / "report.py"), *map(str, folders(tasks))]
    # From 20,000 on, where several baselines were evaluated first: the area before is known of these runs alone.
    command += ["--budget", str(ENV_STEPS), "--grid-step", "10000", "--grid-start", "20000", "--out", str(out)]
    subprocess.run(command, check=True)


def write_reports() -> None:
    """The whole report of the six tasks, the returns of the others."""
    report(TASKS, RESULTS / "report")
    with tempfile.TemporaryDirectory() as folder:
        report([task for task in DMC_TASKS if task not in TASKS], Path(folder))
        shutil.copy(Path(folder) / "returns.csv", UNTUNED)


def write_readme(table: pd.DataFrame) -> None:
    """A table of returns, budgets and wall times."""
    lines = [
        "# Learning runs of the cpu preset",
        "",
        "What `python benchmarks/cpu_learning.py` makes; these were made as the same runs by `examples/suite.py`: the",
        "tasks with three seeds as the variant *21 bins and more reanalyze* of `cpu-settles` (commit 0e23b41), when",
        "the preset had other settings, and all others by `cpu-all` (commit cfbf9f5). Two at a time, one thread each,",
        "with other work beside. Return of the evaluation (mean of 10 episodes, planner without noise) at the end of",
        "the budget; wall time includes random phase, compilation, evaluations and pauses.",
        "",
        "The preset's settings were chosen on the tasks with three seeds, with these seeds; on no other.",
        "",
        "| task | env steps | seeds | final return: mean (each) | best mean of seeds | wall time, min | decisions/s |",
        "|---|---|---|---|---|---|---|",
    ]
    versions = set()
    for task, rows in table.groupby("task"):
        seeds = sorted((RESULTS / task).glob("seed*"))
        summaries = [json.loads(RunDirectory(seed).summary.read_text()) for seed in seeds]
        finals = [summary["final_return"] for summary in summaries]
        curve = rows.groupby("env_steps").return_mean.mean()
        walls = sorted(summary["wall_time_s"] / 60 for summary in summaries)
        speeds = sorted(summary["decisions_per_second"] for summary in summaries)
        versions |= {json.dumps(summary["versions"], sort_keys=True) for summary in summaries}
        lines.append(
            f"| {task} | {int(rows.env_steps.max())} | {len(finals)} | {sum(finals) / len(finals):.0f} "
            f"({', '.join(f'{value:.0f}' for value in finals)}) | {curve.max():.0f} at {curve.idxmax():.0f} "
            f"| {walls[0]:.1f} to {walls[-1]:.1f} | {speeds[0]:.0f} to {speeds[-1]:.0f} |"
        )
    lines += ["", "Versions: " + "; ".join(sorted(versions)).replace('"', "") + "."]
    lines += [
        "",
        "The tasks with three seeds beside published curves: [report](report/index.md); the others: "
        "[returns](untuned_returns.csv).",
        "",
        "![learning curves](report/curves.png)",
        "",
    ]
    (RESULTS / "README.md").write_text("\n".join(lines))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tasks", nargs="+", default=TASKS, choices=DMC_TASKS, metavar="TASK")
    parser.add_argument("--seeds", nargs="+", type=int, default=list(SEEDS))
    parser.add_argument("--env-steps", type=int, default=ENV_STEPS)
    parser.add_argument("--jobs", type=int, default=2, help="runs at a time, one thread each")
    parser.add_argument("--report-only", action="store_true")
    arguments = parser.parse_args()
    if not arguments.report_only:
        with ThreadPoolExecutor(arguments.jobs) as pool:
            runs = [(task, seed) for seed in arguments.seeds for task in arguments.tasks]
            for line in pool.map(lambda pair: run(*pair, arguments.env_steps), runs):
                print(line, flush=True)
    write_readme(read_runs(folders(DMC_TASKS)))
    write_reports()


if __name__ == "__main__":
    main()
