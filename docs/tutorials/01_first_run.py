"""
First run and its curves
========================

A run is a configuration and a folder. This page trains Gymnasium's Pendulum for 1,000 steps, which is less than a
minute of simulated time, and reads what the run wrote.
"""

# %%
# The configuration
# -----------------
# A preset holds every setting; what you change is replaced in it. ``preset("cpu")`` has the parts of the method at a
# size that one core learns with, and some settings of its own; here networks and planners are smaller still, so that
# the page is built quickly. On the command line the same is
# ``torchrl-etdmpc train task=gym/Pendulum-v1 preset=cpu total_env_steps=1000 model.mlp_dim=64 ...``.

import tempfile
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import pandas as pd

from torchrl_etdmpc.training import launch, preset

run_dir = Path(tempfile.mkdtemp()) / "pendulum"
small = preset("cpu")
config = replace(
    small,
    task="gym/Pendulum-v1",
    total_env_steps=1_000,
    eval_every=500,
    eval_episodes=3,
    log_every=50,
    run_dir=str(run_dir),
    compile="off",
    model=replace(small.model, latent_dim=64, mlp_dim=64, encoder_dim=64),
    planner=replace(small.planner, num_samples=24, num_elites=3, num_proposals=2, iterations=2),
    reanalyze=replace(small.reanalyze, num_slices=5, iterations=2),
    replay=replace(small.replay, seed_decisions=400, pretrain_updates=200),
)

# %%
# The run
# -------
# ``launch`` trains to the end and returns one line on what came out. Before its first step it says how long it will
# take. A random agent has a return near -1,200 here; a good one has about -150.

print(launch(config))

# %%
# What it wrote
# -------------
# ``eval.csv`` has a row per evaluation, played with the planner and without noise. Every evaluation plays the same
# episodes.

print(sorted(path.name for path in run_dir.iterdir()))
evaluations = pd.read_csv(run_dir / "eval.csv")
print(evaluations[["env_steps", "updates", "wall_time_s", "return_mean", "return_std"]].round(1).to_string(index=False))

# %%
# ``train.csv`` has a row per interval of training: losses and what they are made of, gradients, the age of the plans
# that the policy learns from.

training = pd.read_csv(run_dir / "train.csv")
figure, axes = plt.subplots(2, 2, figsize=(9, 5.5), layout="constrained")
axes[0, 0].errorbar(
    evaluations["env_steps"], evaluations["return_mean"], evaluations["return_std"], marker="o", capsize=3
)
axes[0, 0].set(title="return, with the standard deviation of 3 episodes")
for axis, column in zip(axes.flat[1:], ("reward_error", "consistency_error", "target_age"), strict=True):
    axis.plot(training["env_steps"], training[column], marker=".")
    axis.set(title=column)
for axis in axes.flat:
    axis.set_xlabel("env steps")
plt.show()

# %%
# How to read it
# --------------
# ``reward_error`` falls while the world model learns what actions earn. The return rises once plans are good enough
# to bring the pendulum up. ``target_age`` grows with the buffer: plans are made anew now and then, but not all of
# them.
#
# One seed of a small run shows that it learns, and not how well: for that see `the expected curves
# <../start.html#expected-curves>`_.
