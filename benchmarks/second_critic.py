"""TD-MPC2 at the cpu preset's size beside the cpu preset, on walker-stand, both as they were with 101 bins.

    python benchmarks/second_critic.py                 # one seed, some minutes
    python benchmarks/second_critic.py --seeds 1 2 3   # the committed runs
    python benchmarks/second_critic.py --report-only   # from the committed curves

Writes `benchmarks/results/cpu/tdmpc2-walker-stand/`: `seed<k>/{eval.csv,summary.json}`, `curves.png` and `README.md`.
The cpu preset's runs are those of `docs/studies/cpu-width.md`, at the same sizes and up to the same budget.
"""

from __future__ import annotations

import argparse
import json

from cpu_learning import RESULTS, run
from sized import FORMER_CPU

from torchrl_etdmpc.analysis import estimate, plot_curves, read_runs
from torchrl_etdmpc.runs import RunDirectory

TASK, ENV_STEPS, PRESET = "walker-stand", 25_000, "tdmpc2-cpu"
FOLDER = RESULTS / f"tdmpc2-{TASK}"
BESIDE = RESULTS / "bins-101" / "make_train"


def report() -> str:
    """Every evaluation of both, and the figure beside it."""
    curves = read_runs([BESIDE, FOLDER])
    curves = curves[curves["env_steps"] <= ENV_STEPS]
    methods = ["cpu", PRESET]
    figure = plot_curves(estimate(curves), tasks=[TASK], methods=methods, budget=ENV_STEPS)
    figure.savefig(FOLDER / "curves.png", dpi=150)
    table = curves.pivot(index=["method", "seed"], columns="env_steps", values="return_mean").loc[methods]
    lines = [
        "# TD-MPC2 at the cpu preset's size",
        "",
        f"Made by `python benchmarks/second_critic.py --seeds 1 2 3`: `preset={PRESET}` on {TASK}, one thread, beside",
        f"the runs of `preset=cpu` in `{BESIDE.relative_to(RESULTS)}`, both as the presets were with 101 bins.",
        "Return of every evaluation (mean of 10 episodes, planner without noise) by env steps.",
        "",
        "| preset | seed | " + " | ".join(f"{steps:.0f}" for steps in table.columns) + " |",
        "|---" * (2 + len(table.columns)) + "|",
    ]
    for (method, seed), row in table.iterrows():
        cells = ["" if value != value else f"{value:.0f}" for value in row]
        lines.append(f"| {method} | {seed} | " + " | ".join(cells) + " |")
    summaries = [json.loads(RunDirectory(seed).summary.read_text()) for seed in sorted(FOLDER.glob("seed*"))]
    lines += ["", "| seed | wall time, min | of it compiling | decisions/s | parameters |", "|---|---|---|---|---|"]
    for row in summaries:
        minutes = f"{row['wall_time_s'] / 60:.1f} | {row['compile_s'] / 60:.1f}"
        lines.append(f"| {row['seed']} | {minutes} | {row['decisions_per_second']:.0f} | {row['parameters']} |")
    versions = {json.dumps(row["versions"], sort_keys=True) for row in summaries}
    lines += ["", "Versions: " + "; ".join(sorted(versions)).replace('"', "") + "."]
    lines += ["Its machine was shared with other work, so that the times are those of a fraction of a core."]
    return "\n".join([*lines, "", "![learning curves](curves.png)", ""])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", nargs="+", type=int, default=[1])
    parser.add_argument("--report-only", action="store_true")
    arguments = parser.parse_args()
    if not arguments.report_only:
        for seed in arguments.seeds:
            print(run(TASK, seed, ENV_STEPS, *FORMER_CPU, preset=PRESET, target=FOLDER / f"seed{seed}"), flush=True)
    (FOLDER / "README.md").write_text(report())
    print(f"written: {FOLDER / 'README.md'}")


if __name__ == "__main__":
    main()
