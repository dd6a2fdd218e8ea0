"""Reproduces the thesis' tables C.1 to C.6 from public learning curves, cell by cell.

    python benchmarks/reproduce_tables.py             # one line per cell, ours beside the thesis'
    python benchmarks/reproduce_tables.py --summary   # one line per table and method

Exits with 1 if a cell that should come out does not. Tolerances: 0.001 for the areas of DMC and for all aggregates,
0.003 for the areas of HumanoidBench, half a unit of the last printed digit (and rounding of the curves) for returns.

Where a curve lacks the first evaluation of the grid, the thesis draws a line to the next one from that of the untrained
agent, at 0 env steps (`from_zero`); reports do not.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
import pandas as pd

from torchrl_etdmpc.analysis import AGGREGATE, compare, get_benchmark, read_curves

REFERENCE = Path(__file__).resolve().parents[1] / "src" / "torchrl_etdmpc" / "analysis" / "reference"
HUMANOIDBENCH_START = 100_000  # other methods of tables C.5 and C.6 were first evaluated there
AGGREGATE_TOLERANCE = 0.001
# Table -> tolerance, whole methods that must come out.
EXPECTED = {
    "C.1": (0.001, ("BMPC", "SAC", "TD-MPC2")),
    "C.2": (0.06, ("BMPC", "SAC", "TD-MPC2")),
    "C.3": (0.001, ("BMPC", "SAC", "TD-MPC2")),
    "C.4": (0.06, ("BMPC", "SAC", "TD-MPC2")),
    "C.5": (0.003, ("BMPC",)),
    "C.6": (0.06, ("BMPC",)),
}
NO_CURVES = "its curves are not in the reference data"


def reason(method: str, benchmark: str) -> str:
    """Why a cell that is not expected to come out may not."""
    if benchmark == "humanoidbench-hard":
        return "the thesis used other files than the BMPC repository's"
    return "the public seeds have gaps there; the thesis used other files" if method == "DreamerV3" else NO_CURVES


def reproduce(name: str, tables: pd.DataFrame) -> pd.DataFrame:
    """Ours beside the thesis' for the two tables of one benchmark: table, method, task, thesis, ours."""
    benchmark = get_benchmark(name)
    means, seeds = read_curves(REFERENCE / "bmpc.csv"), read_curves(REFERENCE / "tdmpc2.csv")
    start = HUMANOIDBENCH_START if name == "humanoidbench-hard" else 0
    result = compare(seeds, means, benchmark=benchmark, start=start, from_zero=True)
    columns = {"auc": (result.areas, "auc"), "final_return": (result.finals, "mean")}
    ours = {metric: table.set_index(["method", "task"])[column] for metric, (table, column) in columns.items()}
    rows = []
    for row in tables[tables["benchmark"] == name].itertuples():
        cell = (row.method, AGGREGATE if row.task == "aggregate" else row.task)
        rows.append((row.table, row.method, row.task, row.value, ours[row.metric].get(cell, np.nan)))
    return pd.DataFrame(rows, columns=["table", "method", "task", "thesis", "ours"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--summary", action="store_true", help="one line per table and method instead of per cell")
    arguments = parser.parse_args()
    tables = pd.read_csv(REFERENCE / "thesis_tables.csv")
    cells = pd.concat([reproduce(name, tables) for name in tables["benchmark"].unique()], ignore_index=True)
    tolerance = cells["table"].map({table: limit for table, (limit, _) in EXPECTED.items()})
    cells["tolerance"] = tolerance.where(cells["task"] != "aggregate", AGGREGATE_TOLERANCE)
    cells["good"] = (cells["ours"] - cells["thesis"]).abs() <= cells["tolerance"]
    cells["expected"] = [row.method in EXPECTED[row.table][1] for row in cells.itertuples()]
    benchmarks = tables.drop_duplicates("table").set_index("table")["benchmark"]

    for (table, method), rows in cells.groupby(["table", "method"], sort=False):
        known = rows["ours"].notna().any()
        why = "" if rows["good"].all() else f": {reason(method, benchmarks[table]) if known else NO_CURVES}"
        if rows["expected"].any() and not rows["good"].all():
            why = ": SHOULD COME OUT"
        print(f"table {table} {method}: {rows['good'].sum()} of {len(rows)} cells{why}")
        if known and not arguments.summary:
            for row in rows.itertuples():
                ours = "unavailable" if np.isnan(row.ours) else f"{row.ours:.4g}"
                line = f"  {row.task:26s} thesis {row.thesis:<8g} ours {ours:<12s} {'' if row.good else 'differs'}"
                print(line.rstrip())
    failed = cells[cells["expected"] & ~cells["good"]]
    for row in failed.itertuples():
        print(
            f"error: table {row.table} {row.method} {row.task}: {row.ours:.4g} instead of {row.thesis:g}",
            file=sys.stderr,
        )
    print(f"reproduced {cells['good'].sum()} of {len(cells)} cells")
    sys.exit(1 if len(failed) else 0)


if __name__ == "__main__":
    main()
