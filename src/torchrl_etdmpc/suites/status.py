"""Where an experiment is, as a text for the terminal."""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import fmean, median
from typing import get_args

from torchrl_etdmpc.suites.experiment import Run
from torchrl_etdmpc.suites.index import Progress, State

_COLUMNS = ("variant", "task", "seeds done", "env steps", "return", "decisions/s", "time left")


def status_text(runs: Sequence[Run], progress: Sequence[Progress], workers: int = 1) -> str:
    """A table, variant x task, with a line for the whole and one for each failure.

    Args:
        runs (sequence of Run): those of an experiment.
        progress (sequence of Progress): of each.
        workers (int): runs at a time while none is running, for the time that is left. Default: ``1``.

    >>> from pathlib import Path
    >>> from torchrl_etdmpc.suites import Experiment, read_progress
    >>> experiment = Experiment("heads", ("walker-walk",), (1,), {"cpu": {"preset": "cpu"}}, budget=50_000)
    >>> runs = experiment.runs(Path("runs/nowhere"))
    >>> print(status_text(runs, [read_progress(run) for run in runs]).splitlines()[0].split()[:2])
    ['variant', 'task']
    """
    groups: dict[tuple[str, str], list[tuple[Run, Progress]]] = {}
    for run, how_far in zip(runs, progress, strict=True):
        groups.setdefault((run.variant, run.task), []).append((run, how_far))
    speeds = [entry.decisions_per_second for entry in progress if not math.isnan(entry.decisions_per_second)]
    usual = median(speeds) if speeds else math.nan
    rows: list[tuple[str, ...]] = [_COLUMNS]
    left_s = 0.0
    for (variant, task), members in groups.items():
        seconds = sum(_seconds_left(run, entry, usual) for run, entry in members)
        left_s += seconds
        entries = [entry for _, entry in members]
        done = sum(entry.state == "finished" for entry in entries)
        active = sum(entry.state == "running" for entry in entries)
        returns = [entry.latest_return for entry in entries if not math.isnan(entry.latest_return)]
        known = [entry.decisions_per_second for entry in entries if not math.isnan(entry.decisions_per_second)]
        steps = sorted({entry.env_steps for entry in entries})
        rows.append(
            (
                variant,
                task,
                f"{done}/{len(entries)}" + f" +{active}" * bool(active),
                f"{steps[0]:,}" if len(steps) == 1 else f"{steps[0]:,} to {steps[-1]:,}",
                f"{fmean(returns):.1f}" if returns else "-",
                f"{fmean(known):.1f}" if known else "-",
                duration(seconds) if seconds else "-",
            )
        )
    states = [entry.state for entry in progress]
    said = ", ".join(f"{states.count(state)} {state}" for state in get_args(State) if state in states)
    at_a_time = states.count("running") or workers
    total = f"{len(runs)} runs: {said}"
    if math.isnan(left_s):
        total += "; the time left is known when a run has written a row"
    elif left_s:
        total += f"; about {duration(left_s / at_a_time)} left with {at_a_time} at a time"
    failures = [
        f"failed: {run.name}: {entry.error}"
        for run, entry in zip(runs, progress, strict=True)
        if entry.state == "failed"
    ]
    return "\n".join([*_aligned(rows), "", total, *failures])


def _seconds_left(run: Run, entry: Progress, usual: float) -> float:
    if entry.state in ("finished", "pruned", "failed"):
        return 0.0
    speed = usual if math.isnan(entry.decisions_per_second) else entry.decisions_per_second
    left = max(run.config.total_env_steps - entry.env_steps, 0)  # one that was gone on with by hand may be beyond it
    return left / run.config.task_spec.action_repeat / speed


def duration(seconds: float) -> str:
    """A time in two units.

    >>> duration(59), duration(3_700), duration(100_000), duration(float("nan"))
    ('1 min', '1 h 2 min', '1 d 3 h', '?')
    """
    if math.isnan(seconds):
        return "?"
    minutes = max(math.ceil(seconds / 60), 1)
    if minutes < 60:
        return f"{minutes} min"
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min" if hours < 24 else f"{hours // 24} d {hours % 24} h"


def _aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    lines = []
    for row in rows:
        cells = [
            cell.ljust(width) if index < 2 else cell.rjust(width)
            for index, (cell, width) in enumerate(zip(row, widths, strict=True))
        ]
        lines.append("  ".join(cells).rstrip())
    return lines
