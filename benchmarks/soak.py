"""An hour of training with a kill every few minutes, beside the same run without: the curves must be the same.

    python benchmarks/soak.py                    # two runs side by side, one thread each, an hour
    python benchmarks/soak.py --minutes 10 --kill-every 60 120

One run is killed (SIGKILL) at random moments and started again with `resume=auto`; the other is left alone. Both are
asked to stop (SIGTERM) when the time is over, and what both have written by then is compared, every digit of every
evaluation and of every row of training metrics. Writes `benchmarks/results/cpu/soak/`: `killed.csv` and `straight.csv`
(evaluations), and `soak.json`. POSIX only.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pandas as pd
from cpu_learning import RESULTS, ROOT

from torchrl_etdmpc.runs import RunDirectory, library_versions
from torchrl_etdmpc.training import EXIT_CODE

FOLDER = RESULTS / "soak"


def start(run_dir: Path, task: str, seed: int) -> subprocess.Popen[bytes]:
    command = [sys.executable, str(ROOT / "examples" / "train_dmc.py"), "preset=cpu", f"task={task}", f"seed={seed}"]
    command += [f"run_dir={run_dir}", "resume=auto", "total_env_steps=10000000", "checkpoint_minutes=1", "device=cpu"]
    with run_dir.with_suffix(".log").open("ab") as log:
        return subprocess.Popen(command, env={**os.environ, "OMP_NUM_THREADS": "1"}, stdout=log, stderr=log)


def train(run_dir: Path, task: str, seed: int, minutes: float, pauses: tuple[float, float] | None) -> int:
    """Trains until the time is over, killed after each pause in seconds if there are any; returns how often."""
    end, kills, moments = time.monotonic() + 60 * minutes, 0, random.Random(seed)
    process = start(run_dir, task, seed)
    while True:
        left = end - time.monotonic()
        pause = left if pauses is None else min(moments.uniform(*pauses), left)
        try:
            code = process.wait(max(pause, 0))
        except subprocess.TimeoutExpired:
            if end - time.monotonic() <= 0:
                break
            process.kill()
            process.wait()
            kills += 1
            process = start(run_dir, task, seed)
        else:
            raise RuntimeError(f"the run ended by itself with code {code}; see {run_dir.with_suffix('.log')}")
    process.send_signal(signal.SIGTERM)
    if process.wait(60) != EXIT_CODE:
        raise RuntimeError(f"the run did not save when it was asked to stop; see {run_dir.with_suffix('.log')}")
    return kills


def compare(killed: Path, straight: Path) -> dict[str, object]:
    """How many rows both have, and whether they are the same in everything but the clock."""
    answer: dict[str, object] = {}
    for table_of in (lambda run: RunDirectory(run).eval, lambda run: RunDirectory(run).train):
        name = table_of(killed).name
        tables = [pd.read_csv(table_of(run), dtype=str).drop(columns="wall_time_s") for run in (killed, straight)]
        common = min(map(len, tables))
        answer[f"{name}_rows"] = common
        answer[f"{name}_equal"] = tables[0][:common].equals(tables[1][:common])
        for run, table in zip(("killed", "straight"), tables, strict=True):
            answer[f"{run}_env_steps_in_{name}"] = int(table.env_steps.iloc[-1])
    return answer


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--task", default="walker-run")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--minutes", type=float, default=60)
    parser.add_argument("--kill-every", type=float, nargs=2, default=(120.0, 300.0), metavar=("FROM", "TO"))
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(2) as pool:
        runs = {name: Path(folder) / name for name in ("killed", "straight")}
        options = arguments.task, arguments.seed, arguments.minutes
        killed = pool.submit(train, runs["killed"], *options, tuple(arguments.kill_every))
        straight = pool.submit(train, runs["straight"], *options, None)
        kills = killed.result() + straight.result()
        FOLDER.mkdir(parents=True, exist_ok=True)
        for name, run in runs.items():
            pd.read_csv(RunDirectory(run).eval, dtype=str).to_csv(FOLDER / f"{name}.csv", index=False)
        answer: dict[str, object] = {"task": arguments.task, "seed": arguments.seed, "minutes": arguments.minutes}
        answer |= {"kills": kills} | compare(runs["killed"], runs["straight"])
    answer["versions"] = library_versions()
    (FOLDER / "soak.json").write_text(json.dumps(answer, indent=1) + "\n")
    print(json.dumps(answer, indent=1))
    if not (answer["eval.csv_equal"] and answer["train.csv_equal"]):
        sys.exit("error: the killed run went another way.")


if __name__ == "__main__":
    main()
