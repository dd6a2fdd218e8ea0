"""Seconds that a report over many run directories takes: an experiment of invented curves, read and drawn.

    python benchmarks/many_runs.py               # 16 variants x 21 tasks x 3 seeds: 1,008 runs
    python benchmarks/many_runs.py --seeds 1

Prints the seconds; asserts first that every run is in the report.
"""

from __future__ import annotations

import argparse
import contextlib
import cProfile
import io
import json
import pstats
import random
import sys
import tempfile
import time
from pathlib import Path

import yaml

from torchrl_etdmpc.analysis import get_benchmark
from torchrl_etdmpc.commands import report
from torchrl_etdmpc.runs import EVAL_COLUMNS, RunDirectory
from torchrl_etdmpc.training import PRESETS


def make_experiment(root: Path, *, variants: int, tasks: int, seeds: int, env_steps: int = 200_000) -> int:
    """Writes run directories ``<variant>/<task>/seed<N>`` with whole configurations; returns their number."""
    chosen = get_benchmark("dmc-easy").tasks[:tasks]
    plan = {
        "variants": [f"variant{number}" for number in range(variants)],
        "tasks": list(chosen),
        "seeds": list(range(seeds)),
        "budget": env_steps,
    }
    root.mkdir(parents=True, exist_ok=True)
    (root / "experiment.yaml").write_text(yaml.safe_dump(plan))
    config, draw = PRESETS["cpu"].to_dict(), random.Random(0)
    for number, variant in enumerate(plan["variants"]):
        for task in chosen:
            for seed in plan["seeds"]:
                run = RunDirectory(root / variant / task / f"seed{seed}")
                run.path.mkdir(parents=True)
                names = {"task": task, "preset": "cpu", "seed": seed}
                run.config.write_text(yaml.safe_dump({**config, **names}, sort_keys=False))
                run.summary.write_text(json.dumps(names))
                rows = [",".join(EVAL_COLUMNS)]
                for step in range(0, env_steps + 1, env_steps // 20):
                    value = step / 250 + 5 * number + draw.gauss(0, 30)
                    rows.append(f"{step},{step // 2},{step // 2},1.0,{value},10.0,10")
                run.eval.write_text("\n".join(rows) + "\n")
    return variants * len(chosen) * seeds


def measure(root: Path, out: Path, *, profiled: bool = False) -> tuple[float, str, str]:
    """Seconds of the command in this process, its line, and its dearest functions."""
    profile, printed = cProfile.Profile(), io.StringIO()
    sys.argv = ["report", str(root), "--out", str(out)]
    start = time.perf_counter()
    with contextlib.redirect_stdout(printed):
        profile.runcall(report.main) if profiled else report.main()
    seconds, text = time.perf_counter() - start, io.StringIO()
    if profiled:
        pstats.Stats(profile, stream=text).sort_stats("cumulative").print_stats("torchrl_etdmpc", 25)
    return seconds, printed.getvalue().strip(), text.getvalue()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--variants", type=int, default=16)
    parser.add_argument("--tasks", type=int, default=21)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--profile", action="store_true", help="where the seconds went; takes twice as long")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "experiment"
        count = make_experiment(root, variants=arguments.variants, tasks=arguments.tasks, seeds=arguments.seeds)
        before = time.process_time()
        seconds, line, profile = measure(root, Path(folder) / "report", profiled=arguments.profile)
        cpu = time.process_time() - before
    assert line.startswith(f"{count} runs on {arguments.tasks} tasks"), line
    print(profile)
    print(f"{count} runs: {seconds:.1f} s, {cpu:.1f} s of the processor; {line}")


if __name__ == "__main__":
    main()
