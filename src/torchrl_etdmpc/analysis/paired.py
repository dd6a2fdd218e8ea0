"""Differences between variants, paired by task and seed, with bootstrap intervals stratified by task."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd

from torchrl_etdmpc.analysis.statistics import interpolate, seed_estimates
from torchrl_etdmpc.analysis.tables import AGGREGATE, escape

ALL_TASKS = "All tasks"
RESAMPLES = 2000
PAIRED_COLUMNS = (
    "variant",
    "base",
    "task",
    "pairs",
    "left_out",
    "difference",
    "lower",
    "upper",
    "improvement",
    "improvement_lower",
    "improvement_upper",
)


def compare_paired(
    seed_curves: pd.DataFrame,
    *,
    base: str,
    variants: Sequence[str],
    env_steps: float,
    tasks: Sequence[str],
    constants: pd.Series | None = None,
    seed: int = 0,
) -> pd.DataFrame:
    r"""What each variant gains over the base at a step, from the runs that both have with the same task and seed.

    On a task with pairs :math:`(x_j, y_j)` of variant and base, ``difference`` is the mean of :math:`x_j - y_j` and
    ``improvement`` the probability that a run of the variant scores more than one of the base, the mean of
    :math:`[x_i > y_j] + \frac12 [x_i = y_j]` over all :math:`i, j`. Over tasks both are means. The 95% percentile
    intervals resample pairs within each task, a pair as a whole; with few seeds they are narrower than they should be.

    Args:
        seed_curves (DataFrame): ``method, task, seed, env_steps, return_mean``.
        base (str): the variant that the others are compared with.
        variants (sequence of str): the others.
        env_steps (float): where returns are read, linear between two evaluations of a run.
        tasks (sequence of str): rows, in this order.
        constants (Series, optional): index task. With one for every task, the row over tasks is of normalised returns
            (:func:`normalise`), else of returns.
        seed (int): of the bootstrap.

    Returns:
        DataFrame: a row per variant and task with pairs, then over these tasks: ``variant, base, task, pairs,
        left_out`` (runs of either that are in no pair), ``difference, lower, upper, improvement, improvement_lower,
        improvement_upper``. Limits are NaN where a task has one pair.

    >>> rows = [(m, "x", seed, 9, seed + 2.0 * (m == "b")) for m in "ab" for seed in (1, 2)]
    >>> curves = pd.DataFrame(rows, columns=["method", "task", "seed", "env_steps", "return_mean"])
    >>> table = compare_paired(curves, base="a", variants=["b"], env_steps=9, tasks=["x"])
    >>> table[["variant", "task", "pairs", "difference", "lower", "upper", "improvement"]]
      variant       task  pairs  difference  lower  upper  improvement
    0       b          x      2         2.0    2.0    2.0          1.0
    1       b  All tasks      2         2.0    2.0    2.0          1.0
    """
    normalised = constants is not None and len(tasks) > 0 and all(task in constants.index for task in tasks)
    chosen = seed_curves[seed_curves["method"].isin([base, *variants]) & seed_curves["task"].isin(tasks)]
    scores = interpolate(seed_estimates(chosen), np.array([float(env_steps)])).dropna(subset="mean")
    scores = scores.set_index(["method", "task", "seed"])["mean"]
    by_run = {key: dict(rows.droplevel([0, 1])) for key, rows in scores.groupby(level=["method", "task"])}
    there = chosen.groupby(["method", "task"])["seed"].nunique()
    random = np.random.default_rng(seed)
    rows = []
    for variant in variants:
        found, left_out = [], 0
        for task in tasks:
            ours, theirs = by_run.get((variant, task), {}), by_run.get((base, task), {})
            shared = sorted(set(ours) & set(theirs))
            alone = sum(there.get((method, task), 0) for method in (variant, base)) - 2 * len(shared)
            left_out += alone
            if not shared:
                continue
            x, y = (np.array([table[run] for run in shared]) for table in (ours, theirs))
            index = random.integers(len(shared), size=(RESAMPLES, len(shared)))
            values = np.concatenate([_statistics(x[None], y[None]), _statistics(x[index], y[index])], 1)
            if len(shared) < 2:
                values[:, 1:] = np.nan
            rows.append((variant, base, task, len(shared), alone, *_interval(values[0]), *_interval(values[1])))
            scale = constants[task] if normalised else 1.0
            found.append((len(shared), values / np.array([[scale], [1.0]])))
        if found:
            over = np.mean([values for _, values in found], 0)
            pairs, name = sum(count for count, _ in found), AGGREGATE if normalised else ALL_TASKS
            if len(found) < len(tasks):
                name = f"{name} ({len(found)} of {len(tasks)} tasks)"
            rows.append((variant, base, name, pairs, left_out, *_interval(over[0]), *_interval(over[1])))
    return pd.DataFrame(rows, columns=list(PAIRED_COLUMNS))


def _statistics(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Mean difference and probability of improvement of every resample ``[R, n]``: ``[2, R]``."""
    wins = (np.sign(x[:, :, None] - y[:, None, :]) + 1).mean((1, 2)) / 2
    return np.stack([(x - y).mean(1), wins])


def _interval(values: np.ndarray) -> tuple[float, float, float]:
    """The value, which comes first, and the 2.5% and 97.5% percentiles of its resamples."""
    lower, upper = np.percentile(values[1:], (2.5, 97.5))
    return float(values[0]), float(lower), float(upper)


def paired_markdown(table: pd.DataFrame) -> str:
    """The table as Markdown, normalised differences with three decimals.

    Args:
        table (DataFrame): see :func:`compare_paired`.
    """
    lines = [
        "| variant | base | task | difference | probability of improvement | pairs | left out |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in table.itertuples():
        digits = 3 if row.task.startswith(AGGREGATE) else 1
        difference = _quote(f"+.{digits}f", row.difference, row.lower, row.upper)
        improvement = _quote(".2f", row.improvement, row.improvement_lower, row.improvement_upper)
        names = " | ".join(escape(name) for name in (row.variant, row.base, row.task))
        lines.append(f"| {names} | {difference} | {improvement} | {row.pairs} | {row.left_out} |")
    return "\n".join(lines) + "\n"


def _quote(form: str, value: float, lower: float, upper: float) -> str:
    return f"{value:{form}}" + ("" if np.isnan(lower) else f" [{lower:{form}}, {upper:{form}}]")
