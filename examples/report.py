"""Compares runs with each other and with published baselines: tables, figures and a page.

    python examples/report.py runs/                               # all runs below a folder
    python examples/report.py ours=runs/a other=runs/b --out report
    python examples/report.py runs/ --budget 50000 --grid-step 10000 --watch

A run directory holds an `eval.csv`. Runs with the same name are seeds of one method; the name is the preset unless
given (`NAME=PATH`). Needs `pip install torchrl_etdmpc[analysis]`.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from pathlib import Path

os.environ.setdefault("MUJOCO_GL", "disable")

import pandas as pd  # noqa: E402

from torchrl_etdmpc.analysis import (  # noqa: E402
    BENCHMARKS,
    Benchmark,
    benchmark_of,
    compare,
    find_runs,
    get_benchmark,
    join_curves,
    own_benchmark,
    read_curves,
    read_runs,
    write_report,
)

REFERENCE = Path(__file__).resolve().parent.parent / "benchmarks" / "reference"


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", metavar="[NAME=]PATH", help="run directories, or folders of them")
    parser.add_argument("--benchmark", help=f"one of {', '.join(BENCHMARKS)}; default: that of the runs' tasks")
    parser.add_argument(
        "--reference",
        nargs="*",
        default=[REFERENCE / "bmpc.csv", REFERENCE / "tdmpc2.csv"],
        help="CSV files of baselines (format: benchmarks/reference/README.md); none for no baselines",
    )
    parser.add_argument("--out", default="report", help="folder of the report (default: report)")
    parser.add_argument("--all-tasks", action="store_true", help="all tasks of the benchmark, not only those with runs")
    parser.add_argument("--budget", type=int, help="env steps; default: the benchmark's")
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
    return (name, path) if separator and not Path(argument).exists() else (None, argument)


def read(arguments: argparse.Namespace) -> pd.DataFrame:
    """The runs' seed curves."""
    groups: dict[str | None, list[str]] = {}
    for argument in arguments.runs:
        name, path = named(argument)
        groups.setdefault(name, []).append(path)
    return join_curves(read_runs(paths, method=name) for name, paths in groups.items())


def choose_benchmark(arguments: argparse.Namespace, runs: pd.DataFrame) -> Benchmark:
    """The one asked for, or that of the runs' tasks; Gymnasium's and users' tasks are one of their own."""
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


def report(arguments: argparse.Namespace, references: list[pd.DataFrame]) -> str:
    """Writes the report; returns a line for the terminal."""
    runs = read(arguments)
    if runs.empty:
        raise ValueError("no evaluation in any of the runs yet; wait for the first row of eval.csv.")
    present = list(dict.fromkeys(runs["task"]))
    benchmark = choose_benchmark(arguments, runs)
    tasks = tuple(task for task in benchmark.tasks if arguments.all_tasks or task in present)
    chosen = runs[runs["task"].isin(tasks)]
    if chosen.empty:
        raise ValueError(f"no run on a task of {benchmark.name}; the runs are on {', '.join(present)}.")
    methods = list(dict.fromkeys(chosen["method"]))
    seeds, means = [chosen], []
    for table in references:
        known = table[table["task"].isin(benchmark.tasks)]
        clash = sorted(set(known["method"]) & set(methods))
        if clash:
            raise ValueError(f"{clash[0]} names both runs and a baseline; give the runs another name (NAME=PATH).")
        (seeds if "return_mean" in table else means).append(known)
    baselines = [name for name in dict.fromkeys(name for table in means + seeds[1:] for name in table["method"])]
    comparison = compare(
        join_curves(seeds),
        join_curves(means) if means else pd.DataFrame(columns=["method", "task", "env_steps", "mean"]),
        benchmark=benchmark,
        tasks=tasks,
        methods=(*methods, *baselines),
        budget=arguments.budget,
        grid_step=arguments.grid_step or (100_000 if benchmark.name in BENCHMARKS else max(benchmark.budget // 10, 1)),
    )
    page = write_report(comparison, arguments.out, vector=arguments.vector)
    count = chosen[["method", "task", "seed"]].drop_duplicates().shape[0]
    last = chosen["env_steps"].max()
    counts = f"{count} run{'s' * (count > 1)} on {len(tasks)} task{'s' * (len(tasks) > 1)} of {benchmark.title}"
    return f"{counts}, up to {last:,.0f} env steps; the report is {page}"


def stamp(arguments: argparse.Namespace) -> list[tuple[str, int, int]]:
    """Changes when an evaluation is added or a run appears."""
    files = [run / "eval.csv" for run in find_runs(path for _, path in map(named, arguments.runs))]
    return [(str(file), file.stat().st_size, file.stat().st_mtime_ns) for file in files]


def main() -> None:
    try:
        arguments = parse()
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


if __name__ == "__main__":
    main()
