"""CSV files of learning curves as tables whose cells are what they should be, or one line that says what is wrong."""

from __future__ import annotations

import io
import warnings
from pathlib import Path

import numpy as np
import pandas as pd

from torchrl_etdmpc.analysis.benchmarks import BENCHMARKS

ACTION_REPEAT = {task: benchmark.action_repeat for benchmark in BENCHMARKS.values() for task in benchmark.tasks}


def parse_table(text: str, file: Path, columns: tuple[str, ...], *, empty: bool = False) -> pd.DataFrame:
    """The table of a file's text, with these columns and any others; ``empty=True`` lets a text without any be one."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", pd.errors.ParserWarning)  # rows longer than the header
            table = pd.read_csv(io.StringIO(text), index_col=False, dtype={"method": str, "task": str})
    except (ValueError, pd.errors.ParserWarning) as error:
        if empty and not text.strip():
            return pd.DataFrame(columns=list(columns), dtype=float)
        raise ValueError(f"{file} is not a CSV file with a header line ({' '.join(str(error).split())}).") from error
    table.columns = table.columns.str.strip()
    if "env_steps" not in table and "decision_steps" in table:
        raise ValueError(
            f"{file} counts decision_steps only; add a column env_steps (decision steps times the action repeat)."
        )
    missing = [name for name in columns if name not in table]
    if missing:
        raise ValueError(f"{file} lacks the column{'s' * (len(missing) > 1)} {', '.join(missing)}.")
    for name in ("method", "task"):
        if name in columns and table[name].isna().any():
            raise ValueError(f"{file}: every row needs a {name}.")
    make_numbers(table, [name for name in ("env_steps", "return_mean") if name in columns], file)
    return table


def make_numbers(table: pd.DataFrame, columns: list[str], file: Path) -> None:
    """Makes the columns floats; an empty cell is NaN."""
    for name in columns:
        try:
            table[name] = pd.to_numeric(table[name]).astype(float)
        except (ValueError, TypeError) as error:
            raise ValueError(f"{file}: column {name} must hold numbers ({' '.join(str(error).split())}).") from error
        if np.isinf(table[name]).any():
            raise ValueError(f"{file}: column {name} must hold finite numbers.")
    steps = table["env_steps"]
    if steps.isna().any() or (steps < 0).any():
        raise ValueError(f"{file}: every row needs env_steps of at least 0.")


def refuse_doubles(table: pd.DataFrame, key: list[str], file: Path) -> None:
    """Raises ValueError if two rows are of the same curve and step, or point."""
    double = table[table.duplicated(key)]
    if len(double):
        row = double.astype({"env_steps": int}).iloc[0]
        raise ValueError(f"{file} has two rows for {', '.join(f'{name}={row[name]}' for name in key)}; keep one.")


def check_units(table: pd.DataFrame, file: Path, action_repeat: int | None = None) -> None:
    """Refuses steps that are not environment steps; ``action_repeat`` takes the place of the tasks' own."""
    if "decision_steps" not in table:
        return
    make_numbers(table, ["decision_steps"], file)
    repeats = ACTION_REPEAT if action_repeat is None else dict.fromkeys(table["task"], action_repeat)
    repeat = np.array([repeats.get(task, np.nan) for task in table["task"]])
    wrong = ~np.isnan(repeat) & (table["env_steps"].to_numpy() != table["decision_steps"].to_numpy() * repeat)
    if wrong.any():
        row = table[wrong].iloc[0]
        raise ValueError(
            f"{file} mixes units: {row['env_steps']:.0f} env_steps beside {row['decision_steps']:.0f} decision_steps, "
            f"but {row['task']} has {repeats[row['task']]} env steps per decision; write environment steps."
        )
