"""How far committed runs fall below an earlier evaluation, beside what ten episodes can tell.

    python benchmarks/falls.py

Of every run of the cpu preset, and on the six tasks that it was tuned on of what it was before (values that were
imagined alone; with 101 bins; at half the width), the largest fall from the best evaluation so far, with its standard
error: that of two means of independent episodes, which overstates it where both evaluations play the same starts.
Writes `benchmarks/results/cpu/falls.csv`.
"""

from __future__ import annotations

import argparse
import math

import pandas as pd
from cpu_learning import RESULTS, TASKS

from torchrl_etdmpc.envs import DMC_TASKS

OUT = RESULTS / "falls.csv"


def largest_fall(curve: pd.DataFrame) -> dict[str, float]:
    """The largest, and after how many env steps it began and ended; no fall is one of 0, at the end."""
    error: list[float] = (curve["return_std"] / (curve["episodes"] - 1) ** 0.5).tolist()
    returns: list[float] = curve["return_mean"].tolist()
    steps: list[int] = curve["env_steps"].tolist()
    last = len(returns) - 1
    begin, end = max(
        ((returns.index(max(returns[:place])), place) for place in range(1, len(returns))),
        key=lambda pair: returns[pair[0]] - returns[pair[1]],
    )
    if returns[begin] <= returns[end]:
        begin = end = last
    fall = returns[begin] - returns[end]
    known = math.hypot(error[begin], error[end]) if fall else 0.0
    return {
        "from_env_steps": steps[begin],
        "to_env_steps": steps[end],
        "from_return": round(returns[begin], 1),
        "fall": round(fall, 1),
        "standard_error": round(known, 1),
        "last_return": round(returns[last], 1),
    }


def main() -> None:
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter).parse_args()
    rows = []
    presets = (
        (64, 101, "imagined", RESULTS / "width-64", TASKS),
        (128, 101, "imagined", RESULTS / "bins-101", TASKS),
        (128, 21, "imagined", RESULTS / "imagined", TASKS),
        (128, 21, "replayed", RESULTS, DMC_TASKS),
    )
    for width, bins, values, folder, tasks in presets:
        for task in sorted(tasks):
            for path in sorted((folder / task).glob("seed*/eval.csv")):
                seed = int(path.parent.name.removeprefix("seed"))
                name = {"width": width, "bins": bins, "values": values, "task": task, "seed": seed}
                rows.append(name | largest_fall(pd.read_csv(path)))
    table = pd.DataFrame(rows)
    table.to_csv(OUT, index=False)
    clear = table[(table["fall"] > 2 * table["standard_error"]) & (table["fall"] > 0.1 * table["from_return"])]
    print(f"{len(table)} runs; falls of more than a tenth and two standard errors:")
    print(clear.to_string(index=False))
    print(OUT)


if __name__ == "__main__":
    main()
