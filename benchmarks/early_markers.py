"""Ranges of what ``train.csv`` says early in runs that learned, for the page on runs that do not.

    python benchmarks/early_markers.py "walker-walk=runs/a/walker-walk" "Pendulum=runs/b"

Each argument is a name and a folder with run directories below it. The rows between 5,000 and 12,000 env steps count.
Writes ``benchmarks/results/cpu/early_markers.csv``: of each marker the lowest, median and highest row of all runs.
"""

from __future__ import annotations

import csv
import sys
from pathlib import Path

import pandas as pd

MARKERS = (
    "consistency_error",
    "reward_error",
    "value_error",
    "value_target",
    "policy_kl",
    "policy_entropy",
    "kl_scale",
    "grad_norm_model",
    "grad_norm_policy",
    "target_age",
    "plan_fallbacks",
    "updates_skipped",
)
FIRST, LAST = 5_000, 12_000
OUT = Path(__file__).parent / "results" / "cpu" / "early_markers.csv"


def main(arguments: list[str]) -> None:
    rows = []
    for argument in arguments:
        name, _, folder = argument.partition("=")
        tables = [path for path in sorted(Path(folder).rglob("train.csv")) if (path.parent / "eval.csv").is_file()]
        if not tables:
            sys.exit(f"error: {folder!r} must hold run directories with a train.csv.")
        frames = [pd.read_csv(path) for path in tables]
        early = pd.concat([frame[frame["env_steps"].between(FIRST, LAST)] for frame in frames])
        finals = [pd.read_csv(path.parent / "eval.csv")["return_mean"].iloc[-1] for path in tables]
        for marker in MARKERS:
            values = early[marker].dropna()
            low, median, high = (f"{values.quantile(share):.4g}" for share in (0, 0.5, 1))
            rows.append([name, marker, low, median, high, len(tables), f"{sum(finals) / len(finals):.1f}"])
    with open(OUT, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["runs", "marker", "low", "median", "high", "seeds", "final_return"])
        writer.writerows(rows)
    print(f"wrote {OUT}")


if __name__ == "__main__":
    main(sys.argv[1:])
