"""Ranges of what ``train.csv`` says early in runs that learned, for the page on runs that do not.

    python benchmarks/early_markers.py                          # of the committed runs
    python benchmarks/early_markers.py mine=runs/mine           # the same of your own, to compare with

An argument is a name and a folder with run directories below it. The rows between 5,000 and 12,000 env steps count: the
lowest, median and highest of each marker over all runs. Without arguments it writes
``benchmarks/results/cpu/early_markers.csv``; with arguments it prints the same table.
"""

from __future__ import annotations

import argparse
import csv
import io
import sys
from pathlib import Path

import pandas as pd

from torchrl_etdmpc.runs import RunDirectory

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
RESULTS = Path(__file__).resolve().parent / "results" / "cpu"
OUT = RESULTS / "early_markers.csv"
COMMITTED = {
    "Pendulum-v1": RESULTS / "distributed" / "one-process",
    "InvertedPendulum-v5": RESULTS / "termination-head" / "head and partial slices",
    "walker-walk": RESULTS / "walker-walk",
    "reacher-easy": RESULTS / "reacher-easy",
}


def ranges(folders: dict[str, Path]) -> str:
    """The table, as CSV.

    Raises:
        ValueError: if a folder holds no runs, or none that came far enough.
    """
    rows = []
    for name, folder in folders.items():
        runs = [RunDirectory(path.parent) for path in sorted(folder.rglob(RunDirectory("").train.name))]
        runs = [run for run in runs if run.eval.is_file()]
        if not runs:
            raise ValueError(f"{str(folder)!r} must hold run directories with a train.csv.")
        frames = [pd.read_csv(run.train) for run in runs]
        early = pd.concat([frame[frame["env_steps"].between(FIRST, LAST)] for frame in frames])
        if early.empty:
            raise ValueError(f"the runs in {str(folder)!r} have no row between {FIRST:,} and {LAST:,} env steps.")
        finals = [pd.read_csv(run.eval)["return_mean"].iloc[-1] for run in runs]
        for marker in MARKERS:
            values = early[marker].dropna()
            low, median, high = (f"{values.quantile(share):.4g}" for share in (0, 0.5, 1))
            rows.append([name, marker, low, median, high, len(runs), f"{sum(finals) / len(finals):.1f}"])
    memory = io.StringIO()
    writer = csv.writer(memory, lineterminator="\n")
    writer.writerow(["runs", "marker", "low", "median", "high", "seeds", "final_return"])
    writer.writerows(rows)
    return memory.getvalue()


def main(arguments: list[str] | None = None) -> None:
    """Writes the committed runs' table, or prints that of the folders that are named."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("runs", nargs="*", metavar="NAME=FOLDER", help="a name and a folder with run directories below")
    named = parser.parse_args(arguments).runs
    own = {name: Path(folder) for name, _, folder in (argument.partition("=") for argument in named) if folder}
    if len(own) < len(named):
        parser.error(f"every argument must be NAME=FOLDER with a name of its own, got {' '.join(named)}")
    try:
        text = ranges(own or COMMITTED)
    except ValueError as error:
        sys.exit(f"error: {error}")
    if own:
        print(text, end="")
        return
    OUT.write_text(text, encoding="utf-8")
    print(f"wrote {OUT}")


if __name__ == "__main__":
    main()
