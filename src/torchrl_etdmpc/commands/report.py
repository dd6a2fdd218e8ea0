"""Compares runs with each other and with published baselines: tables, figures and a page.

  report runs/                               all runs below a folder
  report ours=runs/a other=runs/b --out report
  report runs/ --budget 50000 --grid-step 10000 --watch
  report runs/exp --paired base              variants of an experiment against one of them

Runs with the same name are seeds of one method; the name is the preset unless
given (`NAME=PATH`), and the variant below a folder with an experiment.yaml.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from torchrl_etdmpc.commands.command_line import one_line_errors
from torchrl_etdmpc.runs import RunDirectory
from torchrl_etdmpc.runs.files import make_folder

if TYPE_CHECKING:
    from torchrl_etdmpc.analysis import Benchmark, Experiment, Run

Table = Any  # of pandas, which is imported where it is used
REFERENCE = Path(__file__).resolve().parents[1] / "analysis" / "reference"
DEFAULT_REFERENCES = tuple(REFERENCE / f"{name}.csv" for name in ("bmpc", "tdmpc2", "lowbudget"))
DEFAULT_POINTS = (REFERENCE / "points.csv",)
DEFAULT_GRID_STEP = 100_000
MOST_SECONDS = 1e9  # that a process can sleep
MOST_POINTS = 1000  # of a grid: more take minutes, and evaluations are not that dense


class _OneLineParser(argparse.ArgumentParser):
    """Answers a mistake as the other commands do."""

    def error(self, message: str) -> NoReturn:
        raise ValueError(f"{message}; --help lists the options.")


def parse() -> argparse.Namespace:
    """The command line.

    Raises:
        ValueError: if an option makes no sense.
    """
    from torchrl_etdmpc.analysis import BENCHMARKS, get_benchmark

    parser = _OneLineParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", metavar="[NAME=]PATH", help="run directories, or folders of them")
    parser.add_argument("--benchmark", help=f"one of {', '.join(BENCHMARKS)}; default: that of the runs' tasks")
    parser.add_argument(
        "--reference",
        nargs="*",
        metavar="CSV",
        default=DEFAULT_REFERENCES,
        help="files of baselines, per seed or as means, in the place of BMPC, TD-MPC2, DR.Q, ...; none: no baselines",
    )
    parser.add_argument(
        "--points",
        nargs="*",
        metavar="CSV",
        help="files of single means that are quoted with a source (default: DC-MPC, MR.Q, ..., unless --reference)",
    )
    parser.add_argument(
        "--paired",
        metavar="BASE",
        help="compares the others with BASE, paired by task and seed (default: the experiment's, or the first name)",
    )
    parser.add_argument("--out", default="report", help="folder of the report (default: report)")
    parser.add_argument("--all-tasks", action="store_true", help="all tasks of the benchmark, not only those with runs")
    parser.add_argument(
        "--budget", type=int, help="env steps; default: the benchmark's, or the largest that all runs reach"
    )
    parser.add_argument("--grid-step", type=int, help="env steps between points of the AUC's grid (default: 100,000)")
    parser.add_argument("--grid-start", type=int, help="first point of the AUC's grid (default: the runs' first)")
    parser.add_argument("--vector", choices=("pdf", "svg"), help="write every figure in this format as well")
    parser.add_argument(
        "--watch", nargs="?", type=float, const=30.0, metavar="SECONDS", help="refresh when new rows arrive, until ^C"
    )
    arguments = parser.parse_args()
    if arguments.points is None:
        theirs = arguments.reference is not parser.get_default("reference")
        arguments.points = [] if theirs else DEFAULT_POINTS
    if arguments.benchmark is not None:
        get_benchmark(arguments.benchmark)  # a wrong name ends here, also when watching
    if not arguments.out:  # of an unset variable of the shell, as below
        raise ValueError("--out must not be empty; leave it out for report.")
    if Path(arguments.out).expanduser().is_file():
        raise ValueError(f"--out={arguments.out} is a file; name a folder.")
    for argument in arguments.runs:
        name, path = named(argument)
        if not path or name == "":
            raise ValueError(f"runs are PATH or NAME=PATH, and neither may be empty, got {argument!r}.")
        if name is not None and hasattr(arguments, name.replace("-", "_")):
            raise ValueError(f"{argument} would call runs {name!r}; an option is written --{name} {path}.")
    for name in ("budget", "grid_step", "grid_start", "watch"):
        value = getattr(arguments, name)
        if value is not None and value <= 0:
            raise ValueError(f"--{name.replace('_', '-')} must be positive, got {value:g}.")
    if arguments.watch is not None and not arguments.watch < MOST_SECONDS:
        raise ValueError(f"--watch must be a number of seconds below {MOST_SECONDS:g}, got {arguments.watch:g}.")
    return arguments


def named(argument: str) -> tuple[str | None, str]:
    """The name and the path of one argument; a path that exists is a path, whatever it is called."""
    name, separator, path = argument.partition("=")
    if separator and not Path(argument).expanduser().exists():
        return name, os.path.expanduser(path)
    return None, os.path.expanduser(argument)


def read(arguments: argparse.Namespace) -> tuple[list[Run], Table, list[Experiment], list[str]]:
    """The runs, their seed curves, the experiments that are read whole, and a line for whatever cannot be read.

    Raises:
        ValueError, OSError: if there is no other run.
    """
    from torchrl_etdmpc.analysis import Run, experiment_root, find_runs, join_runs, read_experiment

    runs: list[Run] = []
    broken: dict[Path, Exception] = {}
    roots: dict[Path, None] = {}
    known: set[tuple[str | None, Path]] = set()
    for argument in arguments.runs:
        name, path = named(argument)
        for folder in find_runs([path]):
            if (name, folder.resolve()) in known:  # below two of the arguments
                continue
            known.add((name, folder.resolve()))
            root, method = None if name else experiment_root(folder), name
            if root is not None:
                method = folder.absolute().relative_to(root.absolute()).parts[0]
                if Path(path).absolute() in (root.absolute(), *root.absolute().parents):
                    roots[root] = None
            try:
                runs.append(Run.read(folder, method=method))
            except (ValueError, OSError) as error:
                broken[folder] = error
    if not runs:
        raise next(iter(broken.values()))
    lines = [f"skipped {run}: {error}" for run, error in broken.items()]
    experiments = []
    for root in roots:
        try:
            experiments.append(read_experiment(root))
        except ValueError as error:
            lines.append(str(error))
    return runs, join_runs(runs), experiments, lines


def choose_budget(
    arguments: argparse.Namespace, benchmark: Benchmark, runs: Table, experiments: list[Experiment]
) -> tuple[int, int]:
    """The budget and the step of the AUC's grid: what was asked for or planned, the benchmark's, or what all reach."""
    from torchrl_etdmpc.analysis import BENCHMARKS, begins

    least, most = reached(runs), ends(runs).max()
    present = set(runs["task"])
    planned = {
        plan.env_steps(task, variant)
        for plan in experiments
        for task in plan.tasks
        for variant in plan.variants
        if task in present
    }
    planned = {budget for budget in planned if budget and budget <= most}
    step = None
    if arguments.budget or (least >= benchmark.budget and benchmark.name in BENCHMARKS):
        budget = arguments.budget or benchmark.budget
        step = DEFAULT_GRID_STEP if budget >= 2 * DEFAULT_GRID_STEP and budget % DEFAULT_GRID_STEP == 0 else None
    elif len(planned) == 1:  # a run that ended early is named, and does not shorten the others
        (budget,) = planned
    else:
        budget = min(least, benchmark.budget)
    step = arguments.grid_step or step
    if step and budget // step > MOST_POINTS:
        raise ValueError(
            f"--grid-step={step} makes more than {MOST_POINTS:,} points of {budget:,} env steps; take "
            f"{-(-budget // MOST_POINTS):,} or more."
        )
    if step is None:
        first = begins(runs).max()
        steps = [budget // points for points in (10, 5, 4, 3, 2) if budget % points == 0]
        step = next((step for step in steps if step >= first), steps[-1] if steps else None)
        if step is None and arguments.budget:
            near = f"{budget - 1} or {budget + 1}" if budget > 1 else "2"
            raise ValueError(f"--budget={budget} has no grid of equal steps; take {near}.")
        if budget < 2:
            raise ValueError("the runs end at 1 env step, which makes no curve; wait for an evaluation after it.")
        if step is None:
            budget, step = budget - 1, (budget - 1) // 2
    return budget, step


def choose_benchmark(arguments: argparse.Namespace, runs: Table) -> Benchmark:
    """The one asked for, or that of the runs' tasks; tasks of no benchmark, e.g. Gymnasium's, are one of their own."""
    from torchrl_etdmpc.analysis import BENCHMARKS, benchmark_of, get_benchmark, own_benchmark

    present = list(dict.fromkeys(runs["task"]))
    own = [task for task in present if not any(task in benchmark.tasks for benchmark in BENCHMARKS.values())]
    if arguments.benchmark:
        return get_benchmark(arguments.benchmark)
    if not own:
        return benchmark_of(present)
    if len(own) < len(present):
        raise ValueError(f"{own[0]} is of no benchmark, other runs are; report them apart, or pass --benchmark.")
    return own_benchmark(own, max(reached(runs), 1))


def report(arguments: argparse.Namespace, references: list[Table], points: list[Table]) -> str:
    """Writes the report; returns a line for the terminal."""
    import pandas as pd

    from torchrl_etdmpc.analysis import (
        BENCHMARKS,
        compare,
        evaluated_methods,
        incomplete_runs,
        join_curves,
        mixed_settings,
        no_points,
        write_report,
    )

    found, runs, experiments, lines = read(arguments)
    found, experiments, left_out = only_of_benchmark(arguments, found, experiments)
    mixed = mixed_settings(found)
    for line in [*lines, *left_out, *mixed]:
        print(line, file=sys.stderr, flush=True)
    # A run that has just begun would make nothing of the comparison; it is named as unfinished.
    evaluated = runs["env_steps"].where(runs["return_mean"].notna())
    runs = runs[evaluated.groupby([runs["method"], runs["task"], runs["seed"]]).transform("max") > 0]
    if runs.empty:
        raise ValueError("no evaluation after 0 env steps in any of the runs yet; wait for the first one.")
    present = list(dict.fromkeys(runs["task"]))
    benchmark = choose_benchmark(arguments, runs)
    tasks = tuple(task for task in benchmark.tasks if arguments.all_tasks or task in present)
    chosen = runs[runs["task"].isin(tasks)]
    if chosen.empty:
        raise ValueError(f"no run on a task of {benchmark.name}; the runs are on {', '.join(present)}.")
    planned = dict.fromkeys(variant for plan in experiments for variant in plan.variants)  # in their own order
    methods = [name for name in dict.fromkeys([*planned, *chosen["method"]]) if name in set(chosen["method"])]
    budget, grid_step = choose_budget(arguments, benchmark, chosen, experiments)
    # Published returns are of whole episodes.
    changed = changed_tasks([run for run in found if run.task in tasks])
    shorter = {run.task for run in found if any(setting.startswith("episode_length") for setting in run.changed)}
    shorter &= set(tasks)
    seeds, means, unused = [chosen], [], list(left_out)
    for file, table in zip(arguments.reference, references, strict=True):
        known = table[table["task"].isin(benchmark.tasks)]
        if file not in DEFAULT_REFERENCES:
            unused += tasks_of_no_use(file, table, benchmark, "curve")
        (seeds if "return_mean" in table else means).append(known[~known["task"].isin(shorter)])
    for file, table in zip(arguments.points, points, strict=True):
        if file not in DEFAULT_POINTS:
            unused += tasks_of_no_use(file, table, benchmark, "point")
    for line in unused[len(left_out) :]:
        print(line, file=sys.stderr, flush=True)
    quoted: Table = pd.concat(points or [no_points()], ignore_index=True)
    quoted = quoted[~quoted["task"].isin(shorter)]
    refuse_clash(methods, [*means, *seeds[1:], quoted])
    curves = join_curves(seeds)
    published = join_curves(means) if means else pd.DataFrame(columns=["method", "task", "env_steps", "mean"])
    baselines = evaluated_methods(curves, published, tasks=tasks, budget=budget)
    first = chosen.groupby("method")["env_steps"].min().max()
    comparison = compare(
        curves,
        published,
        benchmark=benchmark,
        tasks=tasks,
        methods=tuple(dict.fromkeys([*methods, *baselines])),
        budget=budget,
        grid_step=grid_step,
        start=arguments.grid_start or int(-(-first // grid_step) * grid_step),
        points=quoted,
        **choose_base(arguments, chosen, methods, experiments),
    )
    notes = [f"{line}." for line in (*unused, *mixed)]
    notes += [f"{task} was run with {settings}, not as the benchmark has it." for task, settings in changed.items()]
    if shorter:
        where = ", ".join(sorted(shorter))
        notes.append(f"Nothing published stands beside {where}: returns of other episodes do not compare.")
    notes += [
        f"The experiment's base {plan.base} has no runs here."
        for plan in experiments
        if plan.base and plan.base not in methods
    ]
    comparison = dataclasses.replace(comparison, notes=(*comparison.notes, *notes))
    incomplete = [*lines, *incomplete_runs(found, experiments, budget=budget)]
    make_folder(Path(arguments.out).expanduser())
    page = write_report(comparison, os.path.expanduser(arguments.out), vector=arguments.vector, incomplete=incomplete)
    count = chosen[["method", "task", "seed"]].drop_duplicates().shape[0]
    last = chosen["env_steps"].max()
    whose = benchmark.title if benchmark.name in BENCHMARKS else "no benchmark"
    counts = f"{count} run{'s' * (count > 1)} on {len(tasks)} task{'s' * (len(tasks) > 1)} of {whose}"
    at = ""
    if not arguments.budget and (budget != benchmark.budget or budget < last):
        which = "which all of them reach" if budget <= reached(chosen) else "the budget of the experiment"
        known = f" (the benchmark's budget is {benchmark.budget:,})" if benchmark.name in BENCHMARKS else ""
        at = f", compared at {budget:,}, {which}{known}"
    at += missing(incomplete)
    return f"{counts}, up to {last:,.0f} env steps{at}; the report is {page}"


def only_of_benchmark(
    arguments: argparse.Namespace, runs: list[Run], experiments: list[Experiment]
) -> tuple[list[Run], list[Experiment], list[str]]:
    """The runs and what the experiments plan on the tasks of the benchmark that was asked for; a line on the others."""
    from torchrl_etdmpc.analysis import get_benchmark

    if not arguments.benchmark:
        return runs, experiments, []
    tasks = get_benchmark(arguments.benchmark).tasks
    here = [run for run in runs if run.task in tasks]
    others = ", ".join(dict.fromkeys(run.task for run in runs if run.task not in tasks))
    if not here or not others:
        return runs, experiments, []
    own = {plan.root: tuple(task for task in plan.tasks if task in tasks) for plan in experiments}
    plans = [dataclasses.replace(plan, tasks=own[plan.root]) for plan in experiments]
    count = len(runs) - len(here)
    return here, plans, [f"{count} run{'s' * (count > 1)} on {others}, not of {arguments.benchmark}: left out"]


def tasks_of_no_use(file: Path | str, table: Table, benchmark: Benchmark, kind: str) -> list[str]:
    """A line on a file's tasks that are in no benchmark and not among those compared, or on a file without any."""
    from torchrl_etdmpc.analysis import BENCHMARKS

    tasks = list(dict.fromkeys(table["task"]))
    if not set(tasks) & set(benchmark.tasks):
        return [f"{file} has no {kind} on a task of {benchmark.name}, its tasks are {', '.join(tasks)}: left out"]
    unknown = [task for task in tasks if not any(task in known.tasks for known in (*BENCHMARKS.values(), benchmark))]
    return [f"{file}: no benchmark has the task {', '.join(unknown)}: left out"] if unknown else []


def changed_tasks(runs: list[Run]) -> dict[str, str]:
    """By task, settings that are not its own, with the names of the runs where others have its own."""
    changed: dict[str, str] = {}
    for task in dict.fromkeys(run.task for run in runs if run.changed):
        methods = {run.method: ", ".join(run.changed) for run in runs if run.task == task}
        told = dict.fromkeys(settings for settings in methods.values() if settings)
        names = {settings: [name for name, other in methods.items() if other == settings] for settings in told}
        whose = len(set(methods.values())) > 1
        changed[task] = "; ".join(settings + f" by {', '.join(names[settings])}" * whose for settings in told)
    return changed


def ends(runs: Table) -> Table:
    """Env steps of each run's last return that is a number."""
    return runs.dropna(subset="return_mean").groupby(["method", "task", "seed"])["env_steps"].max()


def reached(runs: Table) -> int:
    """Env steps that all runs reach."""
    return int(ends(runs).min())


def missing(lines: list[str]) -> str:
    """What the line for the terminal says of runs that are missing or not finished."""
    if not lines:
        return ""
    more = f"; and {len(lines) - 5} more" if len(lines) > 5 else ""
    return f"; {len(lines)} missing or unfinished ({'; '.join(lines[:5])}{more})"


def refuse_clash(methods: list[str], tables: list[Table]) -> None:
    """Raises ValueError if runs have the name of a baseline, or of a column that every table has."""
    from torchrl_etdmpc.analysis.tables import RANKS

    for name in RANKS:
        if name in methods:
            raise ValueError(f"{name} is a column of the tables; give the runs another name (NAME=PATH).")
    clash = sorted({name for table in tables for name in table["method"]} & set(methods))
    if clash:
        raise ValueError(f"{clash[0]} names both runs and a baseline; give the runs another name (NAME=PATH).")


def choose_base(
    arguments: argparse.Namespace, runs: Table, methods: list[str], experiments: list[Experiment]
) -> dict[str, Any]:
    """The base and the variants that are compared with it, if there are any.

    Raises:
        ValueError: if no run has the name that was asked for.
    """
    if arguments.paired is None:
        base = next((plan.base for plan in experiments if plan.base in methods), methods[0])
        keys = {name: set(zip(rows["task"], rows["seed"], strict=True)) for name, rows in runs.groupby("method")}
        variants = [name for name in methods if name != base and keys[name] & keys[base]]
    elif arguments.paired in methods:
        base = arguments.paired
        variants = [name for name in methods if name != base]
    else:
        raise ValueError(f"--paired={arguments.paired} is no name of runs; choose one of {', '.join(methods)}.")
    return {"base": base, "variants": variants}


def stamp(arguments: argparse.Namespace) -> list[tuple[str, int, int]]:
    """Changes when an evaluation is added, a run appears or is finished, or what a run or an experiment is changes."""
    from torchrl_etdmpc.analysis import experiment_root, find_runs
    from torchrl_etdmpc.analysis.experiment import EXPERIMENT

    folders = find_runs(path for _, path in map(named, arguments.runs))
    runs, roots = [*map(RunDirectory, folders)], dict.fromkeys(filter(None, map(experiment_root, folders)))
    files = [file for run in runs for file in (run.eval, run.summary, run.config)]
    files = [file for file in (*files, *(root / EXPERIMENT for root in roots)) if file.exists()]
    return [(str(file), file.stat().st_size, file.stat().st_mtime_ns) for file in files]


@one_line_errors
def main() -> None:
    """Writes the report, once or again and again."""
    arguments = parse()
    from torchrl_etdmpc.analysis import read_curves, read_points

    references = [read_curves(file) for file in arguments.reference]
    points = [read_points(file) for file in arguments.points]
    if arguments.watch is None:
        print(report(arguments, references, points))
        return
    seen = None
    while True:
        try:
            now = stamp(arguments)
            if now != seen:
                print(report(arguments, references, points), flush=True)
                seen = now
        except BrokenPipeError:
            raise
        except (ValueError, OSError) as error:  # a run that is just being made is complete the next time
            print(f"waiting: {error}", file=sys.stderr, flush=True)
        time.sleep(arguments.watch)
