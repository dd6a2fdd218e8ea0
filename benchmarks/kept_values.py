"""What keeps the values of a trained agent up where nothing is paid?

    python benchmarks/kept_values.py runs/mine
    python benchmarks/kept_values.py runs/mine --seed 7 --every 20 --out values.csv

Plays an episode from a run's last checkpoint, with the planner as the run evaluates it and with the policy alone, and
sets beside the value of each state what the next step is said to make of it: the one that the model imagines of the
policy's mean action, which is the thesis' value target without its noise, and the one that was made. Values that the
imagined step keeps up and the real one does not are sustained by the model. Prints a row every so many decisions, and
the means.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import pandas as pd
import torch

from torchrl_etdmpc.checkpoints import CheckpointError
from torchrl_etdmpc.functional import bootstrapped_returns
from torchrl_etdmpc.inspector import Episode, play_episode
from torchrl_etdmpc.modules import WorldModel
from torchrl_etdmpc.objectives import imagined_value_target
from torchrl_etdmpc.planners import BarePolicy
from torchrl_etdmpc.runs import RunDirectory
from torchrl_etdmpc.training import load_agent

COLUMNS = ["who", "decision", "reward", "predicted reward", "value", "followed", "imagined step", "real step"]


@torch.no_grad()
def kept_values(model: WorldModel, episode: Episode, discount: float) -> pd.DataFrame:
    """A row per decision of an episode.

    ``followed`` is the discounted reward of the rest of the episode, with the value at its end; ``imagined step`` and
    ``real step`` are what one step of the policy in the model, and the one that was made, are worth.
    """
    latents = model.encode(episode.observation)
    here, values = latents[:-1], model.values(latents).mean(-1)
    following = values[1:].clone()
    if episode.terminated:
        following[-1] = 0
    columns = {
        "decision": range(len(here)),
        "reward": episode.reward,
        "predicted reward": model.reward(here, episode.action),
        "value": values[:-1],
        "followed": bootstrapped_returns(episode.reward, following, discount),
        "imagined step": imagined_value_target(model, model.values, here, torch.zeros_like(episode.action), discount),
        "real step": episode.reward + discount * following,
    }
    return pd.DataFrame(columns)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run_dir", type=Path)
    parser.add_argument("--seed", type=int, default=100, help="of the start; a run's evaluations have other ones")
    parser.add_argument("--every", type=int, default=50, help="decisions between two printed rows")
    parser.add_argument("--out", type=Path, help="a CSV file, of every decision")
    arguments = parser.parse_args()
    if arguments.every < 1:
        sys.exit("error: --every must be at least 1.")
    torch.set_num_threads(1)
    try:
        agent, config, _ = load_agent(RunDirectory(arguments.run_dir).last_agent, compile_setting="off")
        players: dict[str, Any] = {"planner": agent.eval_planner, "policy alone": BarePolicy(agent.acting_model)}
        tables = []
        for who, player in players.items():
            episode = play_episode(player, config.task_spec, seed=arguments.seed)
            table = kept_values(agent.acting_model, episode, float(agent.eval_planner.discount))
            table.insert(0, "who", who)
            tables.append(table)
            print(f"{who}: return {episode.reward.sum():.0f}")
            ends = zip(*(bound.tolist() for bound in episode.observation.aminmax(dim=0)), strict=True)
            print("observations: " + ", ".join(f"{low:.2g} to {high:.2g}" for low, high in ends))
            print(table.iloc[:: arguments.every, 1:].to_string(index=False, float_format="{:.1f}".format))
            mean = table[COLUMNS[2:]].mean()
            print("in the mean: " + ", ".join(f"{name} {number:.2f}" for name, number in mean.items()), flush=True)
        if arguments.out:
            pd.concat(tables).round(3).to_csv(arguments.out, index=False, columns=COLUMNS)
    except (CheckpointError, OSError, ValueError) as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    main()
