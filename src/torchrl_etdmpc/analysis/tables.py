"""Result tables in the layout of the thesis (appendix C): one row per task, one column per method."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd

RANKS = ("best", "second_best")
"""Columns beside those of methods, so no names for methods."""
AGGREGATE = "Normalized aggregate"
"""The name of the row over all tasks in tables of normalised numbers."""
DASH = "–"
"""An unavailable value."""


def escape(name: object) -> str:
    """A name within a row of a Markdown table."""
    return str(name).replace("|", "\\|")


def result_table(values: pd.DataFrame, *, tasks: Sequence[str], methods: Sequence[str], column: str) -> pd.DataFrame:
    """Spreads one value per method and task over a table of tasks and methods.

    Args:
        values (DataFrame): ``method, task`` and ``column``; the task :data:`AGGREGATE` is the last row.
        tasks (sequence of str): rows, in this order.
        methods (sequence of str): columns, in this order.
        column (str): which value.

    Returns:
        DataFrame: index ``task``, columns ``methods``, NaN where a value is unavailable.

    >>> values = pd.DataFrame({"method": ["a", "b"], "task": "t", "mean": [1.0, 2.0]})
    >>> result_table(values, tasks=["t"], methods=["b", "a"], column="mean").values.tolist()
    [[2.0, 1.0], [nan, nan]]
    """
    wide = values.pivot(index="task", columns="method", values=column)
    return wide.reindex(index=[*tasks, AGGREGATE], columns=list(methods))


def rank_methods(table: pd.DataFrame) -> pd.DataFrame:
    """The best and the second best method of every row; missing where there is none. Ties go to the first column.

    Args:
        table (DataFrame): index ``task``, a column of numbers for each method, the larger the better.

    Returns:
        DataFrame: index ``task``, columns ``best, second_best``.

    >>> rank_methods(pd.DataFrame({"a": [1.0], "b": [3.0], "c": [2.0]}, index=["walker-run"]))
               best second_best
    walker-run    b           c
    """
    rows = []
    for _, row in table.iterrows():
        order = list(row.dropna().sort_values(ascending=False, kind="stable").index)
        rows.append((order + [None, None])[:2])
    return pd.DataFrame(rows, index=table.index, columns=list(RANKS))


def to_csv(table: pd.DataFrame, seeds: pd.DataFrame, errors: pd.DataFrame) -> str:
    """The table as CSV: task, a column per method, best and second best, then standard errors and numbers of seeds.

    Args:
        table (DataFrame): see :func:`result_table`.
        seeds (DataFrame): of the same shape.
        errors (DataFrame): of the same shape.

    >>> table = pd.DataFrame({"a": [1.0], "b": [2.0]}, index=pd.Index(["t"], name="task"))
    >>> to_csv(table, table, table).splitlines()[1].split(",")[:5]
    ['t', '1', '2', 'b', 'a']
    """
    parts = [table, rank_methods(table)]
    parts += [errors.add_suffix(" standard_error"), seeds.add_suffix(" seeds")]
    return pd.concat(parts, axis=1).rename_axis("task").to_csv(float_format="%.6g", lineterminator="\n")


def to_markdown(table: pd.DataFrame, seeds: pd.DataFrame, *, digits: dict[str, int] | int) -> str:
    """The table as Markdown: best bold, second best in italics, the number of seeds in brackets.

    Equal values share a mark, two best ones leave no second best, and a value that stands alone in its row has none.

    Args:
        table (DataFrame): see :func:`result_table`; a dash marks an unavailable value.
        seeds (DataFrame): of the same shape; a question mark stands for an unknown number.
        digits (int or dict): decimals, of every row or by task.

    >>> table = pd.DataFrame({"a": [1.0], "b": [2.0]}, index=pd.Index(["t"], name="task"))
    >>> print(to_markdown(table, table, digits=1).splitlines()[-1])
    | t | *1.0* (1) | **2.0** (2) |
    """
    ranks = table.rank(axis=1, method="min", ascending=False).where(table.count(axis=1) > 1)
    names = [escape(name) for name in table.columns]
    lines = ["| task | " + " | ".join(names) + " |", "|---" * (1 + len(table.columns)) + "|"]
    for task, row in table.iterrows():
        decimals = digits if isinstance(digits, int) else digits.get(task, digits[AGGREGATE])
        cells = []
        for method, value in row.items():
            if np.isnan(value):
                cells.append(DASH)
                continue
            mark = {1: "**", 2: "*"}.get(ranks.loc[task, method], "")
            count = seeds.loc[task, method]
            cells.append(f"{mark}{value:.{decimals}f}{mark} ({'?' if np.isnan(count) else int(count)})")
        lines.append(f"| {task} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"
