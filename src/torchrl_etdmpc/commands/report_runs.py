"""The report on the runs that were named, beside the baselines of files."""

from __future__ import annotations

import argparse
import dataclasses
import os
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from torchrl_etdmpc.analysis import (
    BENCHMARKS,
    Benchmark,
    Experiment,
    Run,
    compare,
    evaluated_methods,
    experiment_root,
    find_runs,
    get_benchmark,
    incomplete_runs,
    join_curves,
    join_runs,
    mixed_settings,
    no_points,
    read_experiment,
    write_report,
)
from torchrl_etdmpc.analysis.experiment import EXPERIMENT
from torchrl_etdmpc.analysis.tables import RANKS
from torchrl_etdmpc.commands.report_choices import choose_base, choose_benchmark, choose_budget, reached
from torchrl_etdmpc.runs import RunDirectory
from torchrl_etdmpc.runs.files import make_folder

Table = Any  # of pandas, whose types know no column
Baselines = Sequence[tuple[Path | str, Table]]  # files and what they hold

_REFERENCE = Path(__file__).resolve().parents[1] / "analysis" / "reference"
DEFAULT_REFERENCES = tuple(_REFERENCE / f"{name}.csv" for name in ("bmpc", "tdmpc2", "lowbudget"))
DEFAULT_POINTS = (_REFERENCE / "points.csv",)


def report(arguments: argparse.Namespace, references: Baselines, points: Baselines) -> str:
    """Writes the report; returns a line for the terminal.

    Args:
        arguments (Namespace): of the command line.
        references (sequence): files of baselines with their curves.
        points (sequence): files of quoted means with these.

    Raises:
        ValueError, OSError: if there is nothing to report on, or no sense in what was asked for.
    """
    found, experiments, lines = read(arguments.runs)
    found, experiments, left_out = only_of_benchmark(arguments.benchmark, found, experiments)
    mixed = mixed_settings(found)
    tell([*lines, *left_out, *mixed])
    runs = with_evaluations(join_runs(found))
    present = list(dict.fromkeys(runs["task"]))
    benchmark = choose_benchmark(arguments.benchmark, runs)
    tasks = tuple(task for task in benchmark.tasks if arguments.all_tasks or task in present)
    runs = runs[runs["task"].isin(tasks)]
    if runs.empty:
        raise ValueError(f"no run on a task of {benchmark.name}; the runs are on {', '.join(present)}.")
    planned = dict.fromkeys(variant for plan in experiments for variant in plan.variants)  # in their own order
    methods = [name for name in dict.fromkeys([*planned, *runs["method"]]) if name in set(runs["method"])]
    budget, grid_step = choose_budget(arguments.budget, arguments.grid_step, benchmark, runs, experiments)

    unused = files_of_no_use(references, points, benchmark)
    tell(unused)
    shorter = {run.task for run in found if any(setting.startswith("episode_length") for setting in run.changed)}
    shorter &= set(tasks)
    seeds, published, quoted = baselines(references, points, benchmark, shorter)
    refuse_clash(methods, [*seeds, published, quoted])
    curves = join_curves([runs, *seeds])
    others = evaluated_methods(curves, published, tasks=tasks, budget=budget)
    first = runs.groupby("method")["env_steps"].min().max()
    base, variants = choose_base(arguments.paired, runs, methods, experiments)
    comparison = compare(
        curves,
        published,
        benchmark=benchmark,
        tasks=tasks,
        methods=tuple(dict.fromkeys([*methods, *others])),
        budget=budget,
        grid_step=grid_step,
        start=arguments.grid_start or int(-(-first // grid_step) * grid_step),
        points=quoted,
        base=base,
        variants=variants,
    )
    notes = [f"{line}." for line in (*left_out, *unused, *mixed)]
    notes += notes_on_tasks([run for run in found if run.task in tasks], shorter)
    absent = [plan.base for plan in experiments if plan.base and plan.base not in methods]
    notes += [f"The experiment's base {name} has no runs here." for name in absent]
    comparison = dataclasses.replace(comparison, notes=(*comparison.notes, *notes))
    incomplete = [*lines, *incomplete_runs(found, experiments, budget=budget)]
    out = Path(arguments.out).expanduser()
    make_folder(out)
    page = write_report(comparison, out, vector=arguments.vector, incomplete=incomplete)
    compared = "" if arguments.budget else where_compared(benchmark, budget, runs)
    return f"{counts(benchmark, tasks, runs)}{compared}{missing(incomplete)}; the report is {page}"


def tell(lines: Iterable[str]) -> None:
    """Prints lines beside the report."""
    for line in lines:
        print(line, file=sys.stderr, flush=True)


def read(arguments: Iterable[str]) -> tuple[list[Run], list[Experiment], list[str]]:
    """The runs, the experiments that are read whole, and a line for whatever cannot be read.

    Args:
        arguments (iterable of str): ``PATH`` or ``NAME=PATH``.

    Raises:
        ValueError, OSError: if there is no other run.
    """
    runs: list[Run] = []
    broken: dict[Path, Exception] = {}
    roots: dict[Path, None] = {}
    known: set[tuple[str | None, Path]] = set()
    for argument in arguments:
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
    return runs, experiments, lines


def only_of_benchmark(
    name: str | None, runs: list[Run], experiments: list[Experiment]
) -> tuple[list[Run], list[Experiment], list[str]]:
    """The runs and what the experiments plan on the tasks of the benchmark that was asked for; a line on the others."""
    if not name:
        return runs, experiments, []
    tasks = get_benchmark(name).tasks
    here = [run for run in runs if run.task in tasks]
    others = ", ".join(dict.fromkeys(run.task for run in runs if run.task not in tasks))
    if not here or not others:
        return runs, experiments, []
    own = {plan.root: tuple(task for task in plan.tasks if task in tasks) for plan in experiments}
    plans = [dataclasses.replace(plan, tasks=own[plan.root]) for plan in experiments]
    count = len(runs) - len(here)
    return here, plans, [f"{count} run{'s' * (count > 1)} on {others}, not of {name}: left out"]


def named(argument: str) -> tuple[str | None, str]:
    """The name and the path of one argument; a path that exists is a path, whatever it is called."""
    name, separator, path = argument.partition("=")
    if separator and not Path(argument).expanduser().exists():
        return name, os.path.expanduser(path)
    return None, os.path.expanduser(argument)


def stamp(arguments: Iterable[str]) -> list[tuple[str, int, int]]:
    """Changes when an evaluation is added, a run appears or is finished, or what a run or an experiment is changes."""
    folders = find_runs(path for _, path in map(named, arguments))
    runs, roots = [*map(RunDirectory, folders)], dict.fromkeys(filter(None, map(experiment_root, folders)))
    files = [file for run in runs for file in (run.eval, run.summary, run.config)]
    files = [file for file in (*files, *(root / EXPERIMENT for root in roots)) if file.exists()]
    return [(str(file), file.stat().st_size, file.stat().st_mtime_ns) for file in files]


def with_evaluations(runs: Table) -> Table:
    """The runs with a return after 0 env steps: one that has just begun would make nothing of the comparison.

    Raises:
        ValueError: if there is none.
    """
    steps = runs["env_steps"].where(runs["return_mean"].notna())
    runs = runs[steps.groupby([runs["method"], runs["task"], runs["seed"]]).transform("max") > 0]
    if runs.empty:
        raise ValueError("no evaluation after 0 env steps in any of the runs yet; wait for the first one.")
    return runs


def refuse_clash(methods: list[str], tables: list[Table]) -> None:
    """Raises ValueError if runs have the name of a baseline, or of a column that every table has."""
    for name in RANKS:
        if name in methods:
            raise ValueError(f"{name} is a column of the tables; give the runs another name (NAME=PATH).")
    clash = sorted({name for table in tables for name in table["method"]} & set(methods))
    if clash:
        raise ValueError(f"{clash[0]} names both runs and a baseline; give the runs another name (NAME=PATH).")


def files_of_no_use(references: Baselines, points: Baselines, benchmark: Benchmark) -> list[str]:
    """A line on a given file without a task of the comparison, or on its tasks that no benchmark has."""
    lines = []
    given = [(file, table, "curve") for file, table in references if file not in DEFAULT_REFERENCES]
    given += [(file, table, "point") for file, table in points if file not in DEFAULT_POINTS]
    for file, table, kind in given:
        tasks = list(dict.fromkeys(table["task"]))
        unknown = [task for task in tasks if not any(task in each.tasks for each in (*BENCHMARKS.values(), benchmark))]
        if not set(tasks) & set(benchmark.tasks):
            of = f"{benchmark.name}, its tasks are {', '.join(tasks)}"
            lines.append(f"{file} has no {kind} on a task of {of}: left out")
        elif unknown:
            lines.append(f"{file}: no benchmark has the task {', '.join(unknown)}: left out")
    return lines


def baselines(
    references: Baselines, points: Baselines, benchmark: Benchmark, shorter: set[str]
) -> tuple[list[Table], Table, Table]:
    """Curves per seed, curves of means and quoted means, but for tasks whose episodes are ``shorter`` than theirs."""
    import pandas as pd

    curves: list[Table] = [table[table["task"].isin(set(benchmark.tasks) - shorter)] for _, table in references]
    quoted: Table = pd.concat([table for _, table in points] or [no_points()], ignore_index=True)
    seeds = [table for table in curves if "return_mean" in table]
    means = [table for table in curves if "return_mean" not in table]
    published = join_curves(means) if means else pd.DataFrame(columns=["method", "task", "env_steps", "mean"])
    return seeds, published, quoted[~quoted["task"].isin(shorter)]


def notes_on_tasks(runs: list[Run], shorter: set[str]) -> list[str]:
    """What the page says of tasks that were run with settings not their own, and of those with shorter episodes."""
    notes = [f"{task} was run with {told}, not as the benchmark has it." for task, told in changed_tasks(runs).items()]
    if shorter:
        where = ", ".join(sorted(shorter))
        notes.append(f"Nothing published stands beside {where}: returns of other episodes do not compare.")
    return notes


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


def counts(benchmark: Benchmark, tasks: Sequence[str], runs: Table) -> str:
    """What the line for the terminal says of the runs."""
    count = runs[["method", "task", "seed"]].drop_duplicates().shape[0]
    whose = benchmark.title if benchmark.name in BENCHMARKS else "no benchmark"
    of = f"{count} run{'s' * (count > 1)} on {len(tasks)} task{'s' * (len(tasks) > 1)} of {whose}"
    return f"{of}, up to {runs['env_steps'].max():,.0f} env steps"


def where_compared(benchmark: Benchmark, budget: int, runs: Table) -> str:
    """What it says of a budget that nobody asked for and that is neither the benchmark's nor where the runs end."""
    if budget == benchmark.budget and budget >= runs["env_steps"].max():
        return ""
    which = "which all of them reach" if budget <= reached(runs) else "the budget of the experiment"
    known = f" (the benchmark's budget is {benchmark.budget:,})" if benchmark.name in BENCHMARKS else ""
    return f", compared at {budget:,}, {which}{known}"


def missing(lines: list[str]) -> str:
    """What the line for the terminal says of runs that are missing or not finished."""
    if not lines:
        return ""
    more = f"; and {len(lines) - 5} more" if len(lines) > 5 else ""
    return f"; {len(lines)} missing or unfinished ({'; '.join(lines[:5])}{more})"
