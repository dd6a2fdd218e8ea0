"""Memory of a long run, and of a full buffer: does the first grow, and is the second as large as its rows?

    python benchmarks/memory.py                          # 100,000 decisions, about half an hour on one core
    python benchmarks/memory.py --decisions 20000

Writes `benchmarks/results/<cpu|gpu>/memory.csv` (resident memory by decision) and `memory.json` (both answers).
Linux only: memory is read from /proc.
"""

from __future__ import annotations

import argparse
import gc
import json
import sys
import tempfile
from pathlib import Path

import pandas as pd
import torch

from torchrl_etdmpc.envs import make_env
from torchrl_etdmpc.runs import RunDirectory, RunLog, library_versions
from torchrl_etdmpc.training import (
    TrainConfig,
    TrainingRun,
    build_agent,
    build_collector,
    build_replay,
    preset,
    row_bytes,
)

RESULTS = Path(__file__).resolve().parent / "results"
HUMANOID = 67, 21  # observation and action
MILLION = 1_000_000


def resident() -> float:
    """MB of this process that are in memory."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmRSS")) / 1024


def run_for(decisions: int) -> pd.DataFrame:
    """Trains the cpu preset past several turns of a small buffer; memory after every thousand decisions."""
    values = preset("cpu").to_dict()
    values |= {"task": "walker-walk", "total_env_steps": 2 * decisions, "eval_every": 20_000, "eval_episodes": 1}
    values["replay"] |= {"capacity": 10_000}
    config = TrainConfig.from_dict(values)
    torch.set_num_threads(config.threads)
    env = make_env(config.task, seed=0)
    eval_env = make_env(config.task, seed=1, num_envs=1)
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        directory = RunDirectory(Path(folder) / "run")
        directory.begin(config.to_dict())
        log = RunLog(directory, total_env_steps=config.total_env_steps)
        run = TrainingRun(config, env=env, eval_env=eval_env, log=log)
        write_row, collector = run.write_row, run.learner.collector

        def sample() -> None:
            write_row()
            if collector.frames % 1000 == 0:
                gc.collect()
                rows.append({"decisions": collector.frames, "resident_mb": round(resident(), 2)})

        run.write_row = sample
        run.run()
        directory.close()
    return pd.DataFrame(rows)


def full_buffer() -> dict[str, float]:
    """A buffer of a million rows of humanoid, written ten thousand at a time."""
    values = preset("efficient-tdmpc").to_dict() | {"task": "humanoid-walk", "total_env_steps": 2 * MILLION}
    config = TrainConfig.from_dict(values)
    gc.collect()
    before = resident()
    buffer = build_replay(config, sizes=HUMANOID)
    row = humanoid_row()
    for chunk in range(MILLION // 10_000):
        rows = row.expand(10_000).clone()
        rows["collector", "traj_ids"] = torch.arange(10_000) // 500 + 20 * chunk
        buffer.extend(rows)
    buffer.sample()
    arithmetic = MILLION * row_bytes(*HUMANOID) / 2**20
    return {"replay_rows": len(buffer), "replay_mb": resident() - before, "arithmetic_mb": arithmetic}


def humanoid_row():
    """One transition as the collector stores it."""
    values = preset("cpu").to_dict() | {"task": "humanoid-walk", "compile": "off"}
    config = TrainConfig.from_dict(values)
    env = make_env(config.task, seed=0)
    buffer = build_replay(config)
    build_collector(config, build_agent(config, *HUMANOID), env, buffer).step()
    env.close()
    return buffer[:1].clone()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--decisions", type=int, default=100_000)
    arguments = parser.parse_args()
    if not sys.platform.startswith("linux"):
        sys.exit("error: memory.py reads /proc and needs Linux.")
    buffer = full_buffer()
    print(f"a million rows of humanoid: {buffer['replay_mb']:.0f} MB, by arithmetic {buffer['arithmetic_mb']:.0f} MB")
    table = run_for(arguments.decisions)
    cuda = torch.cuda.is_available()
    folder = RESULTS / ("gpu" if cuda else "cpu")
    folder.mkdir(parents=True, exist_ok=True)
    table.to_csv(folder / "memory.csv", index=False)
    half = table[table.decisions >= arguments.decisions / 2].resident_mb  # the buffer is full, everything has run
    answer = buffer | {
        "decisions": arguments.decisions,
        "resident_mb_at_half": float(half.iloc[0]),
        "resident_mb_at_end": float(half.iloc[-1]),
        "largest_in_second_half": float(half.max()),
        "versions": library_versions(),
    }
    (folder / "memory.json").write_text(json.dumps(answer, indent=1) + "\n")
    print(f"resident memory at half of the run {half.iloc[0]:.0f} MB, at its end {half.iloc[-1]:.0f} MB")


if __name__ == "__main__":
    main()
