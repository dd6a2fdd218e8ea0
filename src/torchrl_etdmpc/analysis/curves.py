"""Learning curves as tidy tables, and those of published baselines from CSV files.

Two kinds of table, one row per evaluation, ``env_steps`` always in environment steps:

- *seed curves*: ``method, task, seed, env_steps, return_mean``;
- *estimates*: ``method, task, env_steps, mean, standard_error, seeds`` (see :mod:`torchrl_etdmpc.analysis.statistics`).
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

import pandas as pd

from torchrl_etdmpc.analysis.csv_table import check_units, make_numbers, parse_table, refuse_doubles

SEED_COLUMNS = ("method", "task", "seed", "env_steps", "return_mean")
POINT_COLUMNS = ("method", "task", "env_steps", "mean", "source")
ESTIMATE_COLUMNS = ("method", "task", "env_steps", "mean", "standard_error", "seeds")


def read_curves(file: str | os.PathLike[str]) -> pd.DataFrame:
    """Learning curves of a baseline from a CSV file, per seed or as means.

    Per seed the columns are ``method, task, seed, env_steps, return_mean``; as means they are ``method, task,
    env_steps, mean`` and, where known, ``standard_error`` and ``seeds`` (number of runs). Other columns are ignored.

    Args:
        file (str or Path): the CSV file. Steps are environment steps.

    Returns:
        pandas.DataFrame: seed curves or estimates, whichever the file holds.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: not a CSV file, missing columns or cells, steps in other units, or two rows for one evaluation.

    >>> import tempfile
    >>> file = Path(tempfile.mkdtemp()) / "curves.csv"
    >>> rows = ["method,task,seed,env_steps,return_mean", "ours,walker-walk,1,0,20"]
    >>> _ = file.write_text(os.linesep.join(rows))
    >>> read_curves(file)["return_mean"].tolist()
    [20.0]
    """
    file = Path(file)
    if not file.is_file():
        raise FileNotFoundError(f"no such file of learning curves: {file}.")
    text = file.read_text(encoding="utf-8", errors="replace")
    table = parse_table(text, file, ("method", "task", "env_steps"))
    if {"seed", "return_mean"} <= set(table):
        key, numbers, columns = ["method", "task", "seed", "env_steps"], ["env_steps", "return_mean"], SEED_COLUMNS
        if table["seed"].isna().any():
            raise ValueError(f"{file}: every row needs a seed.")
    elif "mean" in table:
        table = table.reindex(columns=[*table, *({"standard_error", "seeds"} - set(table))])
        key, numbers = ["method", "task", "env_steps"], ["env_steps", "mean", "standard_error", "seeds"]
        columns = ESTIMATE_COLUMNS
    else:
        raise ValueError(f"{file} has neither the columns seed, return_mean (one row per seed) nor mean; add them.")
    make_numbers(table, numbers, file)
    if "seeds" in numbers and ((table["standard_error"] < 0) | (table["seeds"] < 1)).any():
        raise ValueError(f"{file}: standard_error is at least 0, seeds at least 1; leave empty what is not known.")
    check_units(table, file)
    refuse_doubles(table, key, file)
    return table[list(columns)].sort_values(key, ignore_index=True)


def read_points(file: str | os.PathLike[str]) -> pd.DataFrame:
    """Single means that are quoted from publications: never joined to a line, never interpolated.

    Args:
        file (str or Path): a CSV file with the columns ``method, task, env_steps, mean, source``; the source is a text
            without which a number is no quote.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: not a CSV file, missing columns or cells, a step of 0, or two rows for one point.

    >>> import tempfile
    >>> file = Path(tempfile.mkdtemp()) / "points.csv"
    >>> rows = ["method,task,env_steps,mean,source", "some,walker-walk,50000,800,a paper"]
    >>> _ = file.write_text(os.linesep.join(rows))
    >>> read_points(file)["mean"].tolist()
    [800.0]
    """
    file = Path(file)
    if not file.is_file():
        raise FileNotFoundError(f"no such file of quoted points: {file}.")
    table = parse_table(file.read_text(encoding="utf-8", errors="replace"), file, POINT_COLUMNS)
    make_numbers(table, ["env_steps", "mean"], file)
    wrong = table["source"].isna() | table["mean"].isna() | (table["env_steps"] == 0)
    if wrong.any():
        raise ValueError(f"{file}: every point needs a source, a mean and env_steps above 0.")
    refuse_doubles(table, ["method", "task", "env_steps"], file)
    return table[list(POINT_COLUMNS)]


def join_curves(tables: Iterable[pd.DataFrame]) -> pd.DataFrame:
    """Joins seed curves, or estimates, of different files.

    Args:
        tables (iterable of DataFrame): all of one kind, at least one.

    Raises:
        ValueError: if two of them hold the same curve: it would count twice.

    >>> curve = {"method": "a", "task": "t", "seed": 1, "env_steps": [0, 10], "return_mean": 1.0}
    >>> len(join_curves([pd.DataFrame(curve), pd.DataFrame({**curve, "seed": 2})]))
    4
    """
    seen: set[tuple] = set()
    joined = []
    for table in tables:
        key = [name for name in ("method", "task", "seed") if name in table]
        curves = set(table[key].itertuples(index=False, name=None))
        if curves & seen:
            double = min(curves & seen, key=str)
            where = " ".join([f"{double[0]} on {double[1]}", *(f"with seed {seed}" for seed in double[2:])])
            raise ValueError(f"two curves of {where}; leave one out, or give one of them a name of its own.")
        seen |= curves
        joined.append(table)
    return pd.concat(joined, ignore_index=True)
