"""
Interrupt a run and go on
=========================

A run that is stopped at any moment goes on from its newest checkpoint as if nothing had happened. Here one run is
left alone, and a second one is stopped by a signal and goes on. Then the two are compared, digit by digit.
"""

# %%
# A small run
# -----------
# The networks are tiny, because exactness does not depend on their size.

import os
import signal
import tempfile
import threading
import time
from pathlib import Path

import matplotlib.pyplot as plt
import pandas as pd
import torch

from torchrl_etdmpc.training import RunInterrupted, TrainConfig, launch

folder = Path(tempfile.mkdtemp())
planner = {"horizon": 3, "num_samples": 16, "num_elites": 4, "num_proposals": 2, "iterations": 2}


def config(name, **changes):
    return TrainConfig.from_dict(
        {
            "task": "gym/Pendulum-v1",
            "total_env_steps": 400,
            "eval_every": 200,
            "eval_episodes": 1,
            "log_every": 25,
            "checkpoint_every": 100,
            "compile": "off",
            "threads": 1,
            "run_dir": str(folder / name),
            "model": {"latent_dim": 16, "mlp_dim": 32, "encoder_dim": 32, "num_dynamics": 2},
            "planner": planner,
            "reanalyze": {**planner, "every": 10, "num_slices": 2},
            "optim": {"batch_size": 32, "lr": 1e-3},
            "replay": {"seed_decisions": 200, "pretrain_updates": 20},
        }
        | changes
    )


print(launch(config("left alone")).rpartition(";")[0])

# %%
# Stopped in the middle
# ---------------------
# A thread waits until the second run has written some rows and then sends SIGTERM, as a cluster would. The run
# finishes its step, saves, and raises ``RunInterrupted``; a command exits with 75 then.


def stop_when(table, rows):
    while not table.is_file() or len(table.read_text().splitlines()) <= rows:
        time.sleep(0.02)
    os.kill(os.getpid(), signal.SIGTERM)


table = folder / "stopped" / "train.csv"
threading.Thread(target=stop_when, args=(table, 3), daemon=True).start()
try:
    launch(config("stopped"))
except RunInterrupted as interruption:
    stopped_at = int(pd.read_csv(table)["env_steps"].iloc[-1])
    print(str(interruption).replace(str(folder), "..."))

# %%
# And on
# ------
# ``resume="auto"`` goes on if there is something to go on from, and begins otherwise: a job script can always run the
# same command.

print(launch(config("stopped", resume="auto")).rpartition(";")[0])

# %%
# The comparison
# --------------

runs = {name: pd.read_csv(folder / name / "eval.csv") for name in ("left alone", "stopped")}
same = runs["left alone"]["return_mean"].equals(runs["stopped"]["return_mean"])
agents = [torch.load(folder / name / "checkpoints" / "last.pt", weights_only=True) for name in runs]
weights = [agent["world_model"] for agent in agents]
equal = all(torch.equal(weights[0][key], weights[1][key]) for key in weights[0])
print(f"evaluations equal to the last digit: {same}")
print(f"final weights equal to the last bit: {equal}")

figure, axis = plt.subplots(figsize=(7, 3.2), layout="constrained")
axis.plot(
    runs["left alone"]["env_steps"], runs["left alone"]["return_mean"], linewidth=6, alpha=0.3, label="left alone"
)
axis.plot(runs["stopped"]["env_steps"], runs["stopped"]["return_mean"], marker="o", label="stopped, gone on")
axis.axvline(stopped_at, color="gray", linestyle=":", label=f"stopped after {stopped_at} env steps")
axis.set(xlabel="env steps", ylabel="return")
axis.legend()
plt.show()
assert same and equal

# %%
# What is exact, what is not, and what a checkpoint holds is said in `runs that survive <../surviving.html>`_.
