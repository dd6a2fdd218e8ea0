"""The benchmarks by name: their tasks, budgets and action repeats."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from dataclasses import dataclass

from torchrl_etdmpc.envs import EASY_DMC, HARD_DMC, HUMANOIDBENCH_HARD


@dataclass(frozen=True)
class Benchmark:
    """A set of tasks that are compared at one budget.

    Args:
        name (str): how commands know it.
        title (str): how figures and tables call it.
        tasks (tuple of str): in the order of the thesis' tables.
        budget (int): env steps per run, at which final returns are read and up to which the AUC is taken.
        action_repeat (int): env steps per decision step.

    >>> get_benchmark("dmc-easy").budget
    200000
    """

    name: str
    title: str
    tasks: tuple[str, ...]
    budget: int
    action_repeat: int


BENCHMARKS: dict[str, Benchmark] = {
    benchmark.name: benchmark
    for benchmark in (
        Benchmark("dmc-easy", "Easy DMC", EASY_DMC, 200_000, 2),
        Benchmark("dmc-hard", "Hard DMC", HARD_DMC, 600_000, 2),
        Benchmark("humanoidbench-hard", "HumanoidBench-Hard", HUMANOIDBENCH_HARD, 1_000_000, 1),
    )
}
"""The three benchmarks of the thesis (appendix A.1.2 and tables C.1 to C.6)."""


def get_benchmark(name: str) -> Benchmark:
    """Looks a benchmark up by its name.

    Raises:
        ValueError: if there is none of this name.

    >>> get_benchmark("dmc-hard").budget
    600000
    """
    if name not in BENCHMARKS:
        raise ValueError(f"unknown benchmark {name!r}; choose one of {', '.join(BENCHMARKS)}.")
    return BENCHMARKS[name]


def own_benchmark(tasks: Iterable[str], budget: int) -> Benchmark:
    """The tasks of no published benchmark as one: nothing normalises them, and no baseline joins.

    Args:
        tasks (iterable of str): names such as ``gym/Hopper-v5`` or ``module:function``.
        budget (int): env steps.

    >>> own_benchmark(["gym/Hopper-v5"], 100_000).title
    'Tasks without a benchmark'
    """
    return Benchmark("own", "Tasks without a benchmark", tuple(tasks), budget, 1)


def benchmark_of(tasks: Iterable[str]) -> Benchmark:
    """The benchmark that holds all of the tasks.

    Args:
        tasks (iterable of str): at least one name.

    Raises:
        ValueError: a task of no benchmark (the message holds the nearest names), or tasks of several.

    >>> benchmark_of(["walker-walk", "cup-catch"]).title
    'Easy DMC'
    """
    found: dict[str, str] = {}
    for task in tasks:
        for benchmark in BENCHMARKS.values():
            if task in benchmark.tasks:
                found.setdefault(benchmark.name, task)
                break
        else:
            known = [name for benchmark in BENCHMARKS.values() for name in benchmark.tasks]
            nearest = difflib.get_close_matches(str(task), known, n=3)
            hint = f"did you mean {', '.join(nearest)}?" if nearest else f"choose tasks of {', '.join(BENCHMARKS)}."
            raise ValueError(f"unknown task {task!r}; {hint}")
    if not found:
        raise ValueError("tasks must hold at least one name, got none.")
    if len(found) > 1:
        examples = ", ".join(f"{task} is of {name}" for name, task in found.items())
        raise ValueError(f"tasks of several benchmarks: {examples}; name the benchmark that you want.")
    return BENCHMARKS[next(iter(found))]
