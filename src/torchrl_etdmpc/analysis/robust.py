"""Interquartile mean and probability of improvement with stratified bootstrap intervals, by SciPy.

The quantities of Agarwal et al., "Deep Reinforcement Learning at the Edge of the Statistical Precipice" (NeurIPS 2021).
Scores are one number per run, grouped by task: ``{task: array of the seeds' scores}``. Resampling draws seeds within
each task.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd
from scipy import stats

from torchrl_etdmpc.analysis.statistics import interpolate, seed_estimates


class Interval(NamedTuple):
    """A value and its 95% interval; the limits are NaN where a task has one seed.

    >>> Interval(1.0, 0.5, 1.5).value
    1.0
    """

    value: float
    lower: float
    upper: float


def scores_at(seed_curves: pd.DataFrame, method: str, env_steps: float) -> dict[str, np.ndarray]:
    """The scores of a method's runs at a step, by task; runs that have no value there are left out.

    Args:
        seed_curves (DataFrame): normalised, so that tasks can be pooled.
        method (str): whose runs.
        env_steps (float): where the scores are read, linear between two evaluations of a run.

    >>> curve = {"method": "ours", "task": "walker-walk", "seed": 1, "env_steps": [0, 100], "return_mean": [0.0, 50.0]}
    >>> scores_at(pd.DataFrame(curve), "ours", 100)
    {'walker-walk': array([50.])}
    """
    curves = seed_estimates(seed_curves[seed_curves["method"] == method])
    values = interpolate(curves, np.array([float(env_steps)])).dropna(subset="mean")
    return {str(task): rows["mean"].to_numpy(float) for task, rows in values.groupby("task", sort=False)}


def interquartile_mean(scores: Mapping[str, Sequence[float]], *, resamples: int = 2000, seed: int = 0) -> Interval:
    """Mean of the middle half of all runs' scores, with a 95% percentile interval.

    Args:
        scores (dict): by task.
        resamples (int): bootstrap resamples.
        seed (int): of the bootstrap.

    Raises:
        ValueError: if there are no scores.

    >>> interquartile_mean({"a": [0.0, 1.0, 2.0, 9.0]}).value
    1.5
    """
    if not scores:
        raise ValueError("scores must hold at least one task, got none.")

    def statistic(*samples: np.ndarray, axis: int = -1) -> np.ndarray:
        return stats.trim_mean(np.concatenate(samples, axis=axis), 0.25, axis=axis)

    return _bootstrap(statistic, list(scores.values()), resamples, seed)


def probability_of_improvement(
    scores: Mapping[str, Sequence[float]],
    baseline: Mapping[str, Sequence[float]],
    *,
    resamples: int = 2000,
    seed: int = 0,
) -> Interval:
    """Mean over tasks of P(a run scores more than a run of the baseline), ties counted half, with its 95% interval.

    Args:
        scores (dict): by task.
        baseline (dict): the same tasks.
        resamples (int): bootstrap resamples.
        seed (int): of the bootstrap.

    Raises:
        ValueError: if the tasks differ, or there are none.

    >>> probability_of_improvement({"a": [2.0, 3.0]}, {"a": [1.0, 2.0]}).value
    0.875
    """
    if set(scores) != set(baseline) or not scores:
        raise ValueError(f"both need scores of the same tasks, got {sorted(scores)} and {sorted(baseline)}.")
    count = len(scores)

    def statistic(*samples: np.ndarray, axis: int = -1) -> np.ndarray:
        wins = []
        for ours, theirs in zip(samples[:count], samples[count:], strict=True):
            difference = np.moveaxis(ours, axis, -1)[..., :, None] - np.moveaxis(theirs, axis, -1)[..., None, :]
            wins.append((np.sign(difference) + 1).mean(axis=(-1, -2)) / 2)
        return np.mean(wins, axis=0)

    return _bootstrap(statistic, [*scores.values(), *(baseline[task] for task in scores)], resamples, seed)


def _bootstrap(statistic: Callable[..., np.ndarray], samples: list, resamples: int, seed: int) -> Interval:
    samples = [np.asarray(sample, dtype=float) for sample in samples]
    if not all(map(len, samples)):
        raise ValueError("every task needs at least one score.")
    value = float(statistic(*samples))
    if min(map(len, samples)) < 2:
        return Interval(value, np.nan, np.nan)
    options = {"n_resamples": resamples, "method": "percentile", "vectorized": True, "rng": np.random.default_rng(seed)}
    result = stats.bootstrap(samples, statistic, **options)
    return Interval(value, float(result.confidence_interval.low), float(result.confidence_interval.high))
