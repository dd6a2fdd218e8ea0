"""What do random actions see of a task, by how long each of them is held?

    python benchmarks/random_phase.py
    python benchmarks/random_phase.py --tasks reacher-hard fish-swim --holds 1 8 --out mine.csv

Plays whole episodes of the random phase (`SeedPolicy`), the same starts with every hold. ``return`` is the mean of the
episodes, ``found`` in how many of them something was paid after their first 25 decisions, what a lucky start pays left
out. Writes `benchmarks/results/cpu/random_phase.csv`, or for other tasks, holds or episodes what ``--out`` names.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import pandas as pd
import torch

from torchrl_etdmpc import SeedPolicy
from torchrl_etdmpc.envs import DMC_TASKS, make_env

OUT = Path(__file__).resolve().parent / "results" / "cpu" / "random_phase.csv"
TASKS = (
    *("cartpole-swingup-sparse", "cheetah-run", "cup-catch", "finger-turn-hard", "hopper-stand"),
    *("pendulum-swingup", "quadruped-walk", "reacher-hard", "walker-walk"),
)
HOLDS = (1.0, 4.0, 8.0, 16.0)
EPISODES = 24
START = 25
COLUMNS = ["task", "hold", "return", "found", "episodes"]


def random_episodes(task: str, hold: float, episodes: int) -> torch.Tensor:
    """Rewards ``[episodes, T]`` of random episodes from the starts of seed 0."""
    env = make_env(task, seed=0, num_envs=episodes, parallel=False)
    torch.manual_seed(0)
    rollout = env.rollout(10**6, SeedPolicy(env.action_spec, hold=hold))
    env.close()
    return rollout["next", "reward"].reshape(episodes, -1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tasks", nargs="+", default=TASKS, choices=DMC_TASKS, metavar="TASK")
    parser.add_argument("--holds", nargs="+", type=float, default=HOLDS)
    parser.add_argument("--episodes", type=int, default=EPISODES)
    parser.add_argument("--out", type=Path, help=f"a CSV file; default: {OUT.name} of the results")
    arguments = parser.parse_args()
    if arguments.episodes < 1 or not all(hold >= 1 for hold in arguments.holds):
        sys.exit("error: --episodes and --holds must be at least 1.")
    asked = tuple(arguments.tasks), tuple(arguments.holds), arguments.episodes
    if arguments.out is None and asked != (TASKS, HOLDS, EPISODES):
        sys.exit("error: other tasks, holds or episodes make another table than the committed one; name it by --out.")
    rows = []
    for task in arguments.tasks:
        for hold in arguments.holds:
            rewards = random_episodes(task, hold, arguments.episodes)
            found = int((rewards[:, START:] > 0).any(-1).sum())
            rows.append([task, hold, round(rewards.sum(-1).mean().item(), 2), found, arguments.episodes])
            print(*rows[-1], flush=True)
    pd.DataFrame(rows, columns=COLUMNS).to_csv(arguments.out or OUT, index=False)


if __name__ == "__main__":
    main()
