"""With the weights of trained agents as they are, which settings of the planner play best?

    python benchmarks/frozen_agents.py runs/cpu-all/cpu/*/seed* --out frozen_agents.csv

Plays episodes from the last checkpoint of every run: with the planner as the run evaluates it, with one change to it at
a time, and with the policy alone. All play the same starts, which no evaluation of a run has. Writes a row per run,
whose directory is named as seen from the table's, and setting; an ``--out`` that is there already is gone on with, if
all of its rows are of these runs. Then prints what each change does to the return: its mean over tasks and a 95%
interval (t over tasks, whose agents are no independent samples).
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import sys
from pathlib import Path

import pandas as pd
import torch
from scipy import stats

from torchrl_etdmpc.checkpoints import CheckpointError
from torchrl_etdmpc.collectors import Episodes, evaluate
from torchrl_etdmpc.envs import make_env
from torchrl_etdmpc.planners import BarePolicy
from torchrl_etdmpc.runs import RunDirectory
from torchrl_etdmpc.training import build_planner, load_agent, read_run_config

SEED = 100  # of the starts; a run's evaluations have its own seed
AS_TRAINED, POLICY = "as trained", "policy alone"
CHANGES = {
    AS_TRAINED: {},
    "elite": {"eval_first_action": "elite"},
    "mean": {"eval_first_action": "mean"},
    "last depth": {"score": "final"},
    "12 proposals": {"num_proposals": 12},
    "24 proposals": {"num_proposals": 24},
    "1 iteration": {"iterations": 1},
    "6 iterations": {"iterations": 6},
    "beta 3": {"beta": 3.0},
    POLICY: {},
}
COLUMNS = ["run", "task", "seed", "setting", "return_mean", "return_std", "episodes"]


def play(run: RunDirectory, setting: str, episodes: int) -> Episodes:
    """The episodes of one agent with one setting."""
    agent, config, _ = load_agent(run.last_agent, compile_setting="off")
    env = make_env(config.task_spec, seed=SEED, num_envs=episodes, parallel=False)
    torch.manual_seed(SEED)
    if setting == POLICY:
        policy = BarePolicy(agent.acting_model)
    else:
        planner = dataclasses.replace(config.planner, **CHANGES[setting])
        discount = agent.eval_planner.discount
        policy = build_planner(agent.acting_model, planner, discount=discount, warm_start=True)
        env = env.append_transform(policy.make_tensordict_primer())
    played = evaluate(env, policy, episodes=episodes)
    env.close(raise_if_closed=False)
    return played


def measure(runs: list[RunDirectory], settings: list[str], episodes: int, out: Path) -> pd.DataFrame:
    """The table, written after every row that it did not have."""
    table = pd.read_csv(out) if out.is_file() else pd.DataFrame(columns=COLUMNS)
    if (table["episodes"] != episodes).any():
        raise ValueError(f"{out} has other numbers of episodes than {episodes}; choose another --out.")
    names = [Path(os.path.relpath(run.path.resolve(), out.parent.resolve())).as_posix() for run in runs]
    agents = [read_run_config(run) for run in runs]
    keys = [(name, config.task, config.seed) for name, config in zip(names, agents, strict=True)]
    if len({key[1:] for key in keys}) < len(keys):
        raise ValueError("several runs have the same task and seed; name the runs of one variant at a time.")
    if "run" not in table:
        raise ValueError(f"{out} does not say which runs its rows are of; choose another --out.")
    others = [name for name in table["run"] if name not in names]
    if others:
        raise ValueError(f"{out} has rows of another run, {others[0]}; name that run too, or choose another --out.")
    done = set(table[COLUMNS[:4]].itertuples(index=False, name=None))
    todo = [(run, (*key, setting)) for setting in settings for run, key in zip(runs, keys, strict=True)]
    for run, key in todo:
        if key in done:
            continue
        returns = play(run, key[-1], episodes).returns
        row = (*key, round(returns.mean().item(), 1), round(returns.std(correction=0).item(), 1), episodes)
        print(*row, sep="\t", flush=True)
        table = pd.DataFrame([*table.itertuples(index=False, name=None), row], columns=COLUMNS)
        table.to_csv(out, index=False)
    return table


def effects(table: pd.DataFrame) -> pd.DataFrame:
    """Mean over tasks of the return's difference from that of the planner as trained, with a 95% interval (t).

    A task counts by the mean of its agents, of those alone that have both returns.
    """
    returns = table.pivot(index=["task", "seed"], columns="setting", values="return_mean")
    rows = []
    for setting in (name for name in CHANGES if name in returns):
        pairs = (returns[setting] - returns[AS_TRAINED]).dropna()
        tasks = pairs.groupby("task").mean()
        half = stats.t.ppf(0.975, len(tasks) - 1) * tasks.sem() if len(tasks) > 1 else float("nan")
        mean, by_task = tasks.mean(), returns.loc[pairs.index, setting].groupby("task").mean()
        rows.append([setting, len(pairs), by_task.mean(), mean, mean - half, mean + half, (pairs > 0).sum()])
    return pd.DataFrame(rows, columns=["setting", "agents", "return", "difference", "low", "high", "higher"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("runs", type=Path, nargs="+", help="directories of runs")
    parser.add_argument("--changes", nargs="*", choices=[*CHANGES][1:], default=[*CHANGES][1:])
    parser.add_argument("--episodes", type=int, default=10)
    parser.add_argument("--out", type=Path, required=True, help="a CSV file")
    arguments = parser.parse_args()
    if arguments.episodes < 1:
        sys.exit("error: --episodes must be at least 1.")
    runs = [RunDirectory(path) for path in arguments.runs]
    for run in runs:
        if not run.last_agent.is_file():
            sys.exit(f"error: {run.path} has no {run.last_agent.relative_to(run.path)}; name directories of runs.")
    torch.set_num_threads(1)
    try:
        table = measure(runs, [AS_TRAINED, *arguments.changes], arguments.episodes, arguments.out)
    except (CheckpointError, OSError, ValueError) as error:
        sys.exit(f"error: {error}")
    print(effects(table).to_string(index=False, float_format="{:.0f}".format))


if __name__ == "__main__":
    main()
