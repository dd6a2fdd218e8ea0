"""How much do two plans of one state differ, by the settings of reanalyze and by others?

    python benchmarks/repeated_plans.py runs/mine
    python benchmarks/repeated_plans.py runs/mine --states 100 --repeats 16 --out repeated_plans.csv

Plays an episode from a run's last checkpoint and plans a number of its states several times anew. ``spread`` is the
standard deviation of the target's mean between the repeats, ``scale`` the one that a plan says it has, ``kl`` the
divergence ``KL(plan || next repeat)``, a mean over action dimensions as in the policy's loss: what a policy that is one
plan is told to be away from another. Prints a row for every setting.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from pathlib import Path
from typing import Any

import pandas as pd
import torch
from torch import Tensor

from torchrl_etdmpc.checkpoints import CheckpointError
from torchrl_etdmpc.functional import gaussian_kl
from torchrl_etdmpc.inspector import play_episode
from torchrl_etdmpc.modules import WorldModel
from torchrl_etdmpc.runs import RunDirectory
from torchrl_etdmpc.training import build_planner, load_agent
from torchrl_etdmpc.training.config import ReanalyzeConfig

COLUMNS = ["setting", "spread", "scale", "kl"]
BMPC = {"num_samples": 512, "num_elites": 64, "num_proposals": 24, "iterations": 6}
CHANGES: dict[str, dict[str, Any]] = {
    "as trained": {},
    "from the policy": {"initial": "policy"},
    "wide": {"initial": "wide"},
    "wide, std_max 1": {"initial": "wide", "std_max": 1.0},
    "wide, target is the mean": {"initial": "wide", "first_action": "mean"},
    "from the policy, target is the mean": {"initial": "policy", "first_action": "mean"},
    "wide, BMPC's budget": {"initial": "wide", **BMPC},
}


@torch.no_grad()
def repeated_plans(
    model: WorldModel, config: ReanalyzeConfig, latent: Tensor, repeats: int, discount: float
) -> dict[str, float]:
    """The columns of one setting, for states ``[B, L]``."""
    planner = build_planner(model, config, discount=discount, warm_start=False, group="reanalyze")
    plans = [planner.plan(latent=latent) for _ in range(repeats)]
    loc, scale = (torch.stack([getattr(plan, name) for plan in plans]) for name in ("loc", "scale"))
    kl = gaussian_kl(loc, scale, loc.roll(1, 0), scale.roll(1, 0))
    return {"spread": loc.std(0).mean().item(), "scale": scale.mean().item(), "kl": kl.mean().item()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run_dir", type=Path)
    parser.add_argument("--states", type=int, default=50, help="of one episode")
    parser.add_argument("--repeats", type=int, default=8)
    parser.add_argument("--seed", type=int, default=100, help="of the start; a run's evaluations have other ones")
    parser.add_argument("--out", type=Path, help="a CSV file")
    arguments = parser.parse_args()
    if arguments.states < 1 or arguments.repeats < 2:
        sys.exit("error: --states must be at least 1 and --repeats at least 2.")
    torch.set_num_threads(1)
    try:
        agent, config, _ = load_agent(RunDirectory(arguments.run_dir).last_agent, compile_setting="off")
        episode = play_episode(agent.eval_planner, config.task_spec, seed=arguments.seed)
        every = max(1, len(episode.action) // arguments.states)
        model, discount = agent.acting_model, float(agent.eval_planner.discount)
        latent = model.encode(episode.observation[:-1][::every][: arguments.states]).detach()
        print(f"{config.task}: {len(latent)} states, {arguments.repeats} plans each", flush=True)
        rows = []
        for setting, change in CHANGES.items():
            changed = dataclasses.replace(config.reanalyze, **change)
            row = repeated_plans(model, changed, latent, arguments.repeats, discount)
            rows.append({"setting": setting, **row})
            print(setting + ": " + ", ".join(f"{name} {number:.2f}" for name, number in row.items()), flush=True)
        if arguments.out:
            pd.DataFrame(rows, columns=COLUMNS).round(4).to_csv(arguments.out, index=False)
    except (CheckpointError, OSError, ValueError) as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    main()
