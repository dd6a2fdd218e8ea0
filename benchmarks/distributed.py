"""Workers against one process: Pendulum with the cpu preset, return, speed and ages.

    python benchmarks/distributed.py                       # all variants, three seeds
    python benchmarks/distributed.py --seeds 1 --variants multi
    python benchmarks/distributed.py --report-only         # from the committed files

Runs one after the other: one process (`examples/train.py`), two workers of TorchRL's MultiAsyncCollector and two of its
RayCollector (`examples/distributed.py`), all with one thread per process. Writes
`benchmarks/results/cpu/distributed/<variant>/seed<k>/{train.csv,eval.csv,summary.json}` and `README.md` there. A run
that is there already is kept; remove its folder to repeat it.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import pandas as pd
from sized import FORMER_CPU

from torchrl_etdmpc.runs import RunDirectory

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "benchmarks" / "results" / "cpu" / "distributed"
VARIANTS = {
    "one-process": ("train.py",),
    "multi": ("distributed.py", "workers=2", "engine=multi"),
    "ray": ("distributed.py", "workers=2", "engine=ray"),
}
# Half the width of the preset, for the time of nine runs, and its settings of then; what is compared is who collects.
SIZES = (*(f"model.{name}=64" for name in ("latent_dim", "mlp_dim", "encoder_dim")), *FORMER_CPU)
SETTINGS = ("task=gym/Pendulum-v1", "preset=cpu", *SIZES, "total_env_steps=10000", "eval_every=2500")
SEEDS = (1, 2, 3)


def run(variant: str, seed: int) -> str:
    """One run in a process of its own; returns a line for the terminal."""
    target = RunDirectory(RESULTS / variant / f"seed{seed}")
    if target.finished:
        return f"{variant} seed {seed}: already there"
    script, *more = VARIANTS[variant]
    with tempfile.TemporaryDirectory() as folder:
        made = RunDirectory(Path(folder) / "run")
        command = [sys.executable, str(ROOT / "examples" / script), *SETTINGS, *more, f"seed={seed}", f"run_dir={made}"]
        result = subprocess.run(command, env={**os.environ, "OMP_NUM_THREADS": "1"}, capture_output=True, text=True)
        if result.returncode:
            return f"{variant} seed {seed}: failed: {(result.stderr or result.stdout).strip().splitlines()[-1]}"
        summary = json.loads(made.summary.read_text())
        summary["load"] = round(os.getloadavg()[2], 1)  # processes that wanted a core, mean of 15 minutes
        target.path.mkdir(parents=True, exist_ok=True)
        for name in ("train", "eval"):
            shutil.copy(getattr(made, name), target.path)
        target.summary.write_text(json.dumps(summary, indent=2) + "\n")
    return f"{variant} seed {seed}: return {summary['final_return']:.1f}"


def rows() -> list[dict[str, object]]:
    """One row per variant that has runs."""
    found = []
    for variant in VARIANTS:
        runs = [RunDirectory(path) for path in sorted((RESULTS / variant).glob("seed*"))]
        runs = [made for made in runs if made.finished]
        if not runs:
            continue
        summaries = [json.loads(made.summary.read_text()) for made in runs]
        trained = pd.concat([pd.read_csv(made.train) for made in runs])
        curves = pd.concat([pd.read_csv(made.eval) for made in runs])
        speeds = [summary["decisions_per_second"] for summary in summaries]
        row: dict[str, object] = {
            "collected by": variant,
            "seeds": ", ".join(str(summary["seed"]) for summary in summaries),
        }
        for steps, returns in curves.groupby("env_steps").return_mean:
            row[f"return at {steps:,}"] = f"{returns.mean():.0f} ({', '.join(f'{value:.0f}' for value in returns)})"
        row["decisions/s"] = f"{min(speeds):.1f} to {max(speeds):.1f}"
        row["wall time, min"] = ", ".join(f"{summary['wall_time_s'] / 60:.1f}" for summary in summaries)
        row["load"] = ", ".join(str(summary["load"]) for summary in summaries)
        age = trained.get("weight_age")
        row["age of weights, updates"] = "0" if age is None else f"{age.mean():.0f}"
        row["age of plans, updates"] = f"{trained.target_age.mean():.0f}"
        found.append(row)
    return found


def write_readme() -> None:
    table = rows()
    if not table:
        sys.exit(f"error: no runs under {RESULTS}; run this script without --report-only first.")
    columns = list(dict.fromkeys(name for row in table for name in row))
    versions = json.loads(next(RESULTS.glob(f"*/seed*/{RunDirectory('').summary.name}")).read_text())["versions"]
    lines = [
        "# Workers against one process",
        "",
        f"Made by `python benchmarks/distributed.py`: `{' '.join(SETTINGS)}`,",
        "two workers, one thread per process, one run at a time. Return: mean of an evaluation of 10 episodes, over",
        "the seeds and each of them. Ages: mean over the rows of `train.csv`; one process plans with newest weights.",
        "Decisions per second are those of acting and updating, without the random phase. **Load** is the number of",
        f"processes that wanted one of the {os.cpu_count()} cores (mean of 15 minutes, other work included). If",
        "it is well above what the run itself starts, the machine was shared: then speeds and wall times, compilation",
        "included, say nothing about which variant is faster.",
        "",
        "| " + " | ".join(columns) + " |",
        "|" + "---|" * len(columns),
        *("| " + " | ".join(str(row.get(name, "")) for name in columns) + " |" for row in table),
        "",
        f"Machine: {platform.machine()}, {os.cpu_count()} cores. Versions: "
        + ", ".join(f"{name} {version}" for name, version in versions.items())
        + ".",
        "",
    ]
    (RESULTS / "README.md").write_text("\n".join(lines))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--variants", nargs="+", default=list(VARIANTS), choices=VARIANTS, metavar="VARIANT")
    parser.add_argument("--seeds", nargs="+", type=int, default=list(SEEDS))
    parser.add_argument("--report-only", action="store_true")
    arguments = parser.parse_args()
    if not arguments.report_only:
        for seed in arguments.seeds:
            for variant in arguments.variants:
                print(run(variant, seed), flush=True)
    write_readme()


if __name__ == "__main__":
    main()
