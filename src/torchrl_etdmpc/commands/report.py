"""Compares runs with each other and with published baselines: tables, figures and a page.

  report runs/                               all runs below a folder
  report ours=runs/a other=runs/b --out report
  report runs/ --budget 50000 --grid-step 10000 --watch

Runs with the same name are seeds of one method; the name is the preset unless
given (`NAME=PATH`).
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchrl_etdmpc.runs import RunDirectory

if TYPE_CHECKING:
    from torchrl_etdmpc.analysis import Benchmark

Table = Any  # of pandas, which is imported where it is used
REFERENCE = Path(__file__).resolve().parents[1] / "analysis" / "reference"
DEFAULT_GRID_STEP = 100_000


def parse() -> argparse.Namespace:
    """The command line.

    Raises:
        ValueError: if an option makes no sense.
    """
    from torchrl_etdmpc.analysis import BENCHMARKS, get_benchmark

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", metavar="[NAME=]PATH", help="run directories, or folders of them")
    parser.add_argument("--benchmark", help=f"one of {', '.join(BENCHMARKS)}; default: that of the runs' tasks")
    parser.add_argument(
        "--reference",
        nargs="*",
        metavar="CSV",
        default=[REFERENCE / "bmpc.csv", REFERENCE / "tdmpc2.csv"],
        help="files of baselines, per seed or as means; none for no baselines (default: BMPC, TD-MPC2, ...)",
    )
    parser.add_argument("--out", default="report", help="folder of the report (default: report)")
    parser.add_argument("--all-tasks", action="store_true", help="all tasks of the benchmark, not only those with runs")
    parser.add_argument(
        "--budget", type=int, help="env steps; default: the benchmark's, or the largest that all runs reach"
    )
    parser.add_argument("--grid-step", type=int, help="env steps between points of the AUC's grid (default: 100,000)")
    parser.add_argument("--vector", choices=("pdf", "svg"), help="write every figure in this format as well")
    parser.add_argument(
        "--watch", nargs="?", type=float, const=30.0, metavar="SECONDS", help="refresh when new rows arrive, until ^C"
    )
    arguments = parser.parse_args()
    if arguments.benchmark is not None:
        get_benchmark(arguments.benchmark)  # a wrong name ends here, also when watching
    for name in ("budget", "grid_step", "watch"):
        value = getattr(arguments, name)
        if value is not None and value <= 0:
            raise ValueError(f"--{name.replace('_', '-')} must be positive, got {value:g}.")
    return arguments


def named(argument: str) -> tuple[str | None, str]:
    """The name and the path of one argument; a path that exists is a path, whatever it is called."""
    name, separator, path = argument.partition("=")
    if separator and not Path(argument).expanduser().exists():
        return name, os.path.expanduser(path)
    return None, os.path.expanduser(argument)


def read(arguments: argparse.Namespace) -> tuple[Table, list[str]]:
    """The runs' seed curves, and a line for each run that cannot be read.

    Raises:
        ValueError, OSError: if there is no other run.
    """
    from torchrl_etdmpc.analysis import find_runs, join_curves, read_run, read_runs

    groups: dict[str | None, list[Path]] = {}
    broken: dict[Path, Exception] = {}
    for argument in arguments.runs:
        name, path = named(argument)
        for run in find_runs([path]):
            try:
                read_run(run)
                groups.setdefault(name, []).append(run)
            except (ValueError, OSError) as error:
                broken[run] = error
    if not groups:
        raise next(iter(broken.values()))
    runs = join_curves(read_runs(paths, method=name) for name, paths in groups.items())
    return runs, [f"skipped {run}: {error}" for run, error in broken.items()]


def choose_budget(arguments: argparse.Namespace, benchmark: Benchmark, runs: Table) -> tuple[int, int]:
    """The budget and the step of the AUC's grid: those asked for, or the benchmark's, or what all runs reach.

    Raises:
        ValueError: if a run has not got beyond its first evaluation.
    """
    from torchrl_etdmpc.analysis import BENCHMARKS

    last = runs.groupby(["method", "task", "seed"])["env_steps"].max()
    reached = int(last.min())
    if arguments.budget or (reached >= benchmark.budget and benchmark.name in BENCHMARKS):
        budget, step = arguments.budget or benchmark.budget, DEFAULT_GRID_STEP
    elif reached:
        budget = min(reached, benchmark.budget)
        step = next((budget // points for points in (10, 5, 4, 3, 2) if budget % points == 0), None)
        if step is None:
            budget, step = budget - 1, (budget - 1) // 2
    else:
        method, task, seed = last.idxmin()
        raise ValueError(
            f"{method} on {task} with seed {seed} has only its first evaluation yet, at 0 env steps; wait, or leave "
            "that run out."
        )
    return budget, arguments.grid_step or step


def choose_benchmark(arguments: argparse.Namespace, runs: Table) -> Benchmark:
    """The one asked for, or that of the runs' tasks; Gymnasium's and users' tasks are one of their own."""
    from torchrl_etdmpc.analysis import benchmark_of, get_benchmark, own_benchmark

    present = list(dict.fromkeys(runs["task"]))
    own = [task for task in present if "/" in task or ":" in task]
    for task in present:
        if task not in own:
            benchmark_of([task])  # an unknown task is an error, one of another benchmark is left out
    if arguments.benchmark:
        return get_benchmark(arguments.benchmark)
    if not own:
        return benchmark_of(present)
    if len(own) < len(present):
        raise ValueError(f"{own[0]} is of no benchmark, other runs are; report them apart, or pass --benchmark.")
    reached = runs.groupby(["method", "task", "seed"])["env_steps"].max().min()
    return own_benchmark(own, max(int(reached), 1))


def report(arguments: argparse.Namespace, references: list[Table]) -> str:
    """Writes the report; returns a line for the terminal."""
    import pandas as pd

    from torchrl_etdmpc.analysis import compare, join_curves, write_report

    runs, skipped = read(arguments)
    for line in skipped:
        print(line, file=sys.stderr, flush=True)
    if runs.empty:
        raise ValueError("no evaluation in any of the runs yet; wait for the first one.")
    present = list(dict.fromkeys(runs["task"]))
    benchmark = choose_benchmark(arguments, runs)
    tasks = tuple(task for task in benchmark.tasks if arguments.all_tasks or task in present)
    chosen = runs[runs["task"].isin(tasks)]
    if chosen.empty:
        raise ValueError(f"no run on a task of {benchmark.name}; the runs are on {', '.join(present)}.")
    methods = list(dict.fromkeys(chosen["method"]))
    budget, grid_step = choose_budget(arguments, benchmark, chosen)
    seeds, means = [chosen], []
    for table in references:
        known = table[table["task"].isin(benchmark.tasks)]
        clash = sorted(set(known["method"]) & set(methods))
        if clash:
            raise ValueError(f"{clash[0]} names both runs and a baseline; give the runs another name (NAME=PATH).")
        if not arguments.budget:  # a baseline that was first evaluated later has nothing to say here
            begins = known.groupby("method")["env_steps"].transform("min")
            known = known[begins <= budget - grid_step]
        (seeds if "return_mean" in table else means).append(known)
    baselines = [name for name in dict.fromkeys(name for table in means + seeds[1:] for name in table["method"])]
    comparison = compare(
        join_curves(seeds),
        join_curves(means) if means else pd.DataFrame(columns=["method", "task", "env_steps", "mean"]),
        benchmark=benchmark,
        tasks=tasks,
        methods=(*methods, *baselines),
        budget=budget,
        grid_step=grid_step,
    )
    page = write_report(comparison, os.path.expanduser(arguments.out), vector=arguments.vector)
    count = chosen[["method", "task", "seed"]].drop_duplicates().shape[0]
    last = chosen["env_steps"].max()
    counts = f"{count} run{'s' * (count > 1)} on {len(tasks)} task{'s' * (len(tasks) > 1)} of {benchmark.title}"
    at = ""
    if not arguments.budget and budget != benchmark.budget:
        at = f", compared at {budget:,}, which all of them reach (the benchmark's budget is {benchmark.budget:,})"
    return f"{counts}, up to {last:,.0f} env steps{at}; the report is {page}"


def stamp(arguments: argparse.Namespace) -> list[tuple[str, int, int]]:
    """Changes when an evaluation is added or a run appears."""
    from torchrl_etdmpc.analysis import find_runs

    files = [RunDirectory(run).eval for run in find_runs(path for _, path in map(named, arguments.runs))]
    return [(str(file), file.stat().st_size, file.stat().st_mtime_ns) for file in files]


def main() -> None:
    """Writes the report, once or again and again."""
    try:
        arguments = parse()
        from torchrl_etdmpc.analysis import read_curves

        references = [read_curves(file) for file in arguments.reference]
        if arguments.watch is None:
            print(report(arguments, references))
            return
        seen = None
        while True:
            try:
                now = stamp(arguments)
                if now != seen:
                    print(report(arguments, references), flush=True)
                    seen = now
            except (ValueError, OSError) as error:  # a run that is just being made is complete the next time
                print(f"waiting: {error}", file=sys.stderr, flush=True)
            time.sleep(arguments.watch)
    except KeyboardInterrupt:
        sys.exit(130)
    except (ValueError, OSError, ImportError) as error:
        sys.exit(f"error: {error}")
