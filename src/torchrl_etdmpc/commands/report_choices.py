"""What a report compares where nobody says: which benchmark, up to how many env steps, and with whom."""

from __future__ import annotations

from typing import Any

from torchrl_etdmpc.analysis import (
    BENCHMARKS,
    Benchmark,
    Experiment,
    begins,
    benchmark_of,
    get_benchmark,
    own_benchmark,
)

Table = Any  # of pandas, whose types know no column
DEFAULT_GRID_STEP = 100_000
MOST_POINTS = 1000  # of a grid: more take minutes, and evaluations are not that dense


def choose_benchmark(name: str | None, runs: Table) -> Benchmark:
    """The one asked for, or that of the runs' tasks; tasks of no benchmark, e.g. Gymnasium's, are one of their own."""
    present = list(dict.fromkeys(runs["task"]))
    own = [task for task in present if not any(task in benchmark.tasks for benchmark in BENCHMARKS.values())]
    if name:
        return get_benchmark(name)
    if not own:
        return benchmark_of(present)
    if len(own) < len(present):
        raise ValueError(f"{own[0]} is of no benchmark, other runs are; report them apart, or pass --benchmark.")
    return own_benchmark(own, reached(runs))


def choose_budget(
    asked: int | None, asked_step: int | None, benchmark: Benchmark, runs: Table, experiments: list[Experiment]
) -> tuple[int, int]:
    """The budget and the step of the AUC's grid: what was asked for or planned, the benchmark's, or what all reach."""
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
    if asked or (least >= benchmark.budget and benchmark.name in BENCHMARKS):
        budget = asked or benchmark.budget
        step = DEFAULT_GRID_STEP if budget >= 2 * DEFAULT_GRID_STEP and budget % DEFAULT_GRID_STEP == 0 else None
    elif len(planned) == 1:  # a run that ended early is named, and does not shorten the others
        (budget,) = planned
    else:
        budget = least
    step = asked_step or step
    if step and budget // step > MOST_POINTS:
        raise ValueError(
            f"--grid-step={step} makes more than {MOST_POINTS:,} points of {budget:,} env steps; take "
            f"{-(-budget // MOST_POINTS):,} or more."
        )
    if step is None:
        first = begins(runs).max()
        steps = [budget // points for points in (10, 5, 4, 3, 2) if budget % points == 0]
        step = next((step for step in steps if step >= first), steps[-1] if steps else None)
        if step is None and asked:
            near = f"{budget - 1} or {budget + 1}" if budget > 1 else "2"
            raise ValueError(f"--budget={budget} has no grid of equal steps; take {near}.")
        if budget < 2:
            raise ValueError("the runs end at 1 env step, which makes no curve; wait for an evaluation after it.")
        if step is None:
            budget, step = budget - 1, (budget - 1) // 2
    return budget, step


def choose_base(
    name: str | None, runs: Table, methods: list[str], experiments: list[Experiment]
) -> tuple[str, list[str]]:
    """The base and the variants that are compared with it, if there are any.

    Raises:
        ValueError: if no run has the name that was asked for.
    """
    if name is None:
        base = next((plan.base for plan in experiments if plan.base in methods), methods[0])
        keys = {method: set(zip(rows["task"], rows["seed"], strict=True)) for method, rows in runs.groupby("method")}
        variants = [method for method in methods if method != base and keys[method] & keys[base]]
    elif name in methods:
        base = name
        variants = [method for method in methods if method != base]
    else:
        raise ValueError(f"--paired={name} is no name of runs; choose one of {', '.join(methods)}.")
    return base, variants


def ends(runs: Table) -> Table:
    """Env steps of each run's last return that is a number."""
    return runs.dropna(subset="return_mean").groupby(["method", "task", "seed"])["env_steps"].max()


def reached(runs: Table) -> int:
    """Env steps that all runs reach."""
    return int(ends(runs).min())
