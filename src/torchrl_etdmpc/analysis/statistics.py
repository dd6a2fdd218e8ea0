"""Estimates over seeds, normalisation, aggregates and areas under learning curves (thesis appendix A.1.2).

Pure functions on tidy tables. *Estimates* have one row per method, task and step: ``method, task, env_steps, mean,
standard_error, seeds``, further columns are kept. ``standard_error`` is NaN where it is not known: for one seed, or for
a published mean without one. Steps are environment steps; nothing is ever extrapolated, neither beyond the
last evaluation nor before the first: an evaluation at 0 env steps is of the untrained agent, and no line leaves it.
"""

from __future__ import annotations

import numpy as np
import pandas as pd

Z_95 = 1.96  # half-width of a 95% interval in standard errors, as the thesis has it
NORMALISER = "BMPC"


def estimate(seed_curves: pd.DataFrame) -> pd.DataFrame:
    r"""Mean over seeds and its standard error at every evaluation step.

    .. math:: \hat\mu_t = \frac1N \sum_j R_{j,t}, \quad
        \hat\sigma_t^2 = \frac1{N-1} \sum_j (R_{j,t} - \hat\mu_t)^2, \quad \hat s_t = \hat\sigma_t / \sqrt N

    (thesis A.1.2, "Per-task learning curves"). A step counts the seeds that were evaluated there; a NaN return is a
    missing evaluation.

    Args:
        seed_curves (DataFrame): ``method, task, seed, env_steps, return_mean``.

    Returns:
        DataFrame: estimates.

    >>> rows = [("a", "walker-run", seed, 0, 10.0 * seed) for seed in (1, 2, 3)]
    >>> estimate(pd.DataFrame(rows, columns=["method", "task", "seed", "env_steps", "return_mean"])).round(3)
      method        task  env_steps  mean  standard_error  seeds
    0      a  walker-run          0  20.0           5.774      3
    """
    groups = seed_curves.dropna(subset="return_mean").groupby(["method", "task", "env_steps"], sort=True)
    return groups["return_mean"].agg(mean="mean", standard_error="sem", seeds="count").reset_index()


def add_interval(estimates: pd.DataFrame) -> pd.DataFrame:
    r"""Adds ``std`` :math:`\hat\sigma = \hat s \sqrt N`, and ``lower``, ``upper`` :math:`= \hat\mu \mp 1.96 \hat s`.

    All three are NaN where the standard error is unknown (thesis A.1.2, "Per-task learning curves").

    Args:
        estimates (DataFrame): any number of rows.

    >>> estimates = pd.DataFrame({"mean": [10.0], "standard_error": [1.0], "seeds": [4]})
    >>> add_interval(estimates)[["std", "lower", "upper"]].values.tolist()
    [[2.0, 8.04, 11.96]]
    """
    half = Z_95 * estimates["standard_error"]
    return estimates.assign(
        std=estimates["standard_error"] * np.sqrt(estimates["seeds"]),
        lower=estimates["mean"] - half,
        upper=estimates["mean"] + half,
    )


def interpolate(estimates: pd.DataFrame, grid: np.ndarray, *, from_zero: bool = False) -> pd.DataFrame:
    """Every curve on a grid of steps: linear between two evaluations of the trained agent, NaN where there are not two.

    An evaluation at 0 env steps counts at 0 and nowhere else: between it and the next one nobody measured what was
    learned, so that a method is *not evaluated* before its first evaluation after 0.

    The standard error is interpolated like the mean, which is exact if the errors of neighbouring evaluations are
    perfectly correlated and too large otherwise. ``seeds`` is the smaller count of the two neighbours.

    Args:
        estimates (DataFrame): one curve per method and task, and per seed if there is such a column.
        grid (array): env steps, increasing.
        from_zero (bool): also draws the line from the evaluation at 0 to the next one, as the thesis does where a curve
            lacks an evaluation on its grid.

    Returns:
        DataFrame: estimates at the steps of the grid.

    >>> columns = {"method": "a", "task": "x", "standard_error": 1.0, "seeds": 3}
    >>> curve = pd.DataFrame({**columns, "env_steps": [0, 100, 200], "mean": [5.0, 20.0, 40.0]})
    >>> interpolate(curve, np.array([0, 50, 100, 150, 250]))["mean"].tolist()
    [5.0, nan, 20.0, 30.0, nan]
    """
    grid = np.asarray(grid, dtype=float)
    if not len(estimates):
        return estimates.iloc[:0]
    key = _curve_key(estimates)
    curve = estimates.groupby(key, sort=False).ngroup().to_numpy()
    order = np.lexsort((estimates["env_steps"], curve))
    columns = [estimates[name].to_numpy(float)[order] for name in ("env_steps", "mean", "standard_error", "seeds")]
    starts = np.flatnonzero(np.diff(curve[order], prepend=-1))
    values = []
    for rows in zip(*(np.split(column, starts[1:]) for column in columns), strict=True):
        values.append(_on_grid(*rows, grid, from_zero))
    table = estimates[key].iloc[np.repeat(order[starts], len(grid))].reset_index(drop=True)
    mean, error, seeds = np.concatenate(values, axis=1)
    return table.assign(env_steps=np.tile(grid, len(starts)), mean=mean, standard_error=error, seeds=seeds)


def _on_grid(
    steps: np.ndarray, mean: np.ndarray, error: np.ndarray, seeds: np.ndarray, grid: np.ndarray, from_zero: bool
) -> np.ndarray:
    """Mean, standard error and seeds of one curve, in the order of its steps, on the grid ``[3, len(grid)]``."""
    untrained = (grid > 0) & (grid < steps[steps > 0].min(initial=np.inf)) & (not from_zero)
    mean, error = (
        np.where(untrained, np.nan, np.interp(grid, steps, values, left=np.nan, right=np.nan))
        for values in (mean, error)
    )
    after = np.clip(np.searchsorted(steps, grid), 0, len(steps) - 1)
    before = np.clip(np.searchsorted(steps, grid, side="right") - 1, 0, len(steps) - 1)
    return np.stack([mean, error, np.where(np.isnan(mean), np.nan, np.fmin(seeds[before], seeds[after]))])


def shared_grid(estimates: pd.DataFrame, budget: float, step: float, *, start: float | None = None) -> np.ndarray:
    """Multiples of ``step`` from the first checkpoint that all methods have to the budget (thesis A.1.2, "AUC").

    A method's first checkpoint is the earliest over its tasks, so that one late curve leaves that cell out and not the
    start of everybody's.

    Args:
        estimates (DataFrame): the compared methods.
        budget (float): env steps.
        step (float): env steps.
        start (float, optional): first point, instead of that checkpoint.

    Raises:
        ValueError: if no more than one grid point is left.

    >>> curves = pd.DataFrame({"method": ["a", "a", "b"], "task": "x", "env_steps": [0, 50_000, 90_000]})
    >>> shared_grid(curves, 300_000, 100_000)
    array([100000., 200000., 300000.])
    """
    if start is not None:
        first = start
        if start % step:
            raise ValueError(f"the grid must start at a multiple of its step, got {start:g} and {step:g} env steps.")
    else:
        first = estimates.groupby("method")["env_steps"].min().max() if len(estimates) else np.nan
    grid = np.arange(np.ceil(first / step), np.floor(budget / step) + 1) * step if first <= budget else np.empty(0)
    if len(grid) < 2:
        raise ValueError(
            f"the grid needs at least two steps of {step:g} env steps between the first checkpoint of all methods "
            f"({first:g}) and the budget ({budget:g}); use a smaller grid step or a larger budget."
        )
    if grid[-1] != budget:
        raise ValueError(f"the budget must be a multiple of the grid step, got {budget:g} and {step:g} env steps.")
    return grid


def normalisers(estimates: pd.DataFrame, budget: float, method: str = NORMALISER) -> pd.Series:
    """The constants :math:`c_i`: the method's mean return on each task at the budget (thesis A.1.2).

    Args:
        estimates (DataFrame): holds curves of ``method``.
        budget (float): env steps.
        method (str): by default BMPC.

    Returns:
        Series: index task; without the tasks on which the method has no value at the budget, or 0.

    >>> curve = {"method": "BMPC", "task": "t", "seed": 1, "env_steps": [0, 10], "return_mean": [0.0, 500.0]}
    >>> estimates = seed_estimates(pd.DataFrame(curve))
    >>> normalisers(estimates, 10)["t"]
    np.float64(500.0)
    """
    table = interpolate(estimates[estimates["method"] == method], np.array([budget]))
    return table[table["mean"].notna() & (table["mean"] != 0)].set_index("task")["mean"].astype(float)


def normalise(table: pd.DataFrame, constants: pd.Series) -> pd.DataFrame:
    r"""Divides values and standard errors by the task's constant, :math:`\tilde\mu = \hat\mu / c_i` (thesis A.1.2).

    The constant is treated as fixed: its own uncertainty does not enter. Tasks without one become NaN.

    Args:
        table (DataFrame): estimates, seed curves or areas.
        constants (Series): index task, see :func:`normalisers`.

    >>> table = pd.DataFrame({"method": ["ours"], "task": "t", "env_steps": 10, "mean": 250.0, "standard_error": 50.0})
    >>> normalise(table, pd.Series({"t": 500.0}))[["mean", "standard_error"]].values.tolist()
    [[0.5, 0.1]]
    """
    scale = table["task"].map(constants)
    columns = [name for name in ("mean", "standard_error", "return_mean", "auc", "std") if name in table]
    return table.assign(**{name: table[name] / scale for name in columns})


def aggregate(estimates: pd.DataFrame, tasks: list[str] | tuple[str, ...]) -> pd.DataFrame:
    r"""Mean over tasks with the standard error of independent tasks.

    .. math:: \tilde\mu_t = \frac1T \sum_i \tilde\mu_{i,t}, \quad
        \tilde s_t = \frac1T \sqrt{\textstyle\sum_i \tilde s_{i,t}^2}

    (thesis A.1.2, "Aggregate normalized learning curves"). NaN at a step where one of the tasks has no value.

    Args:
        estimates (DataFrame): normalised, all methods at the same steps (:func:`interpolate`).
        tasks (sequence of str): the T tasks.

    Returns:
        DataFrame: ``method, env_steps, mean, standard_error, seeds``; ``seeds`` is the smallest count of a task.

    >>> rows = [("a", "x", 0, 1.0, 0.3, 3), ("a", "y", 0, 2.0, 0.4, 5)]
    >>> columns = ["method", "task", "env_steps", "mean", "standard_error", "seeds"]
    >>> aggregate(pd.DataFrame(rows, columns=columns), ["x", "y"])
      method  env_steps  mean  standard_error  seeds
    0      a          0   1.5            0.25      3
    """
    chosen = estimates[estimates["task"].isin(tasks)]
    groups = chosen.groupby(["method", "env_steps"], sort=False)
    table = pd.DataFrame(
        {
            "mean": groups["mean"].agg(lambda values: values.sum(skipna=False) / len(tasks)),
            "standard_error": groups["standard_error"].agg(
                lambda errors: np.sqrt(np.square(errors).sum(skipna=False)) / len(tasks)
            ),
            "seeds": groups["seeds"].min(),
        }
    )
    complete = groups["mean"].count() == len(tasks)
    return table.where(complete).reset_index().astype({"seeds": table["seeds"].dtype if complete.all() else float})


def auc(table: pd.DataFrame) -> pd.DataFrame:
    """Area under each curve by the trapezoid rule, env steps in millions (thesis A.1.2, "Area under the curve").

    Args:
        table (DataFrame): estimates on a shared grid (:func:`interpolate`); a curve with a NaN has the area NaN.

    Returns:
        DataFrame: ``method, task, auc, seeds``, with ``seed`` if the curves have it.

    >>> curve = pd.DataFrame({"method": "a", "task": "x", "env_steps": [0, 1e5, 2e5], "mean": 0.5, "seeds": 3})
    >>> auc(curve)
      method task  auc  seeds
    0      a    x  0.1      3
    """
    key = _curve_key(table)
    rows = []
    for names, curve in table.groupby(key, sort=False):
        curve = curve.sort_values("env_steps")
        area = np.trapezoid(curve["mean"], curve["env_steps"] / 1e6)
        rows.append((*names, area, curve["seeds"].min()))
    return pd.DataFrame(rows, columns=[*key, "auc", "seeds"])


def auc_of_seeds(seed_curves: pd.DataFrame, grid: np.ndarray, *, from_zero: bool = False) -> pd.DataFrame:
    """Mean over seeds of their areas, and its standard error (thesis D.1: areas per seed, then their mean).

    Of the seeds whose own curve covers the grid; NaN where none does. The standard error is NaN for one seed.

    Args:
        seed_curves (DataFrame): normalised or not.
        grid (array): env steps.
        from_zero (bool): see :func:`interpolate`.

    Returns:
        DataFrame: ``method, task, auc, standard_error, seeds``, the last one the number of seeds that cover the grid.

    >>> curve = {"method": "a", "task": "t", "env_steps": [0, 1_000_000]}
    >>> curves = pd.concat([pd.DataFrame({**curve, "seed": seed, "return_mean": seed}) for seed in (1, 3)])
    >>> auc_of_seeds(curves, np.array([0, 1_000_000]), from_zero=True)
      method task  auc  standard_error  seeds
    0      a    t  2.0             1.0      2
    """
    areas = auc(interpolate(seed_estimates(seed_curves), grid, from_zero=from_zero))
    groups = areas.groupby(["method", "task"], sort=False)["auc"]
    table = groups.agg(auc="mean", standard_error="sem", seeds="count").reset_index()
    return table.assign(seeds=table["seeds"].where(table["seeds"] > 0))


def seed_estimates(seed_curves: pd.DataFrame) -> pd.DataFrame:
    """The curve of each seed as an estimate from one seed, for :func:`interpolate` and :func:`auc`.

    Args:
        seed_curves (DataFrame): ``method, task, seed, env_steps, return_mean``; NaN returns are left out.

    >>> curve = {"method": "a", "task": "t", "seed": 1, "env_steps": [0, 10], "return_mean": 1.0}
    >>> len(seed_estimates(pd.DataFrame(curve)))
    2
    """
    curves = seed_curves.dropna(subset="return_mean").rename(columns={"return_mean": "mean"})
    return curves.assign(standard_error=np.nan, seeds=1)


def _curve_key(table: pd.DataFrame) -> list[str]:
    return [name for name in ("method", "task", "seed") if name in table]
