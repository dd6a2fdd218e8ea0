"""
A small experiment, from YAML to report
=======================================

A comparison is tasks, seeds and variants. This page writes one into a file, trains its runs with one command, and
makes a report with another.
"""

# %%
# The file
# --------
# Two variants that differ by one setting: whether old plans are made anew. The networks are tiny and the budget is
# small, so that four runs fit into a minute.

import subprocess
import sys
import tempfile
from pathlib import Path

import matplotlib.image
import matplotlib.pyplot as plt
import pandas as pd

folder = Path(tempfile.mkdtemp())
experiment = """\
title: Does reanalyze matter?
tasks: [gym/Pendulum-v1]
seeds: 2
budget: 300
settings:
  preset: cpu
  eval_every: 150
  eval_episodes: 1
  compile: "off"
  model.mlp_dim: 32
  planner.num_samples: 16
  planner.iterations: 2
  optim.batch_size: 16
  replay.seed_decisions: 150
  replay.pretrain_updates: 20
variants:
  reanalyze: {}
  no reanalyze: {reanalyze.every: 0}
base: no reanalyze
"""
(folder / "reanalyze.yaml").write_text(experiment)


def command(*arguments):
    """What you would type after ``torchrl-etdmpc``."""
    words = [sys.executable, "-m", "torchrl_etdmpc.commands", *arguments]
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True, check=True)
    return done.stdout.strip().replace(str(folder), "...")


# %%
# Before anything runs
# --------------------
# ``dry_run=true`` checks every setting of every run and says what would be trained.

for line in command("suite", "experiment=reanalyze.yaml", "dry_run=true").splitlines():
    print(line.split(" -m ")[-1][:100])

# %%
# All runs
# --------
# Typed again, the same command would find everything finished. ``suite status`` can be asked from elsewhere
# meanwhile.

command("suite", "experiment=reanalyze.yaml", "runs_dir=runs", "workers=2")
print(command("suite", "status", "runs_dir=runs"))

# %%
# The report
# ----------
# Names of variants become names of methods; differences are paired by task and seed.

print(command("report", "runs", "--out", "report", "--paired", "no reanalyze"))
paired = pd.read_csv(folder / "report" / "paired.csv")
print(paired.to_string(index=False))

# %%
picture = matplotlib.image.imread(folder / "report" / "curves.png")
figure, axis = plt.subplots(figsize=(8, 8 * picture.shape[0] / picture.shape[1]), layout="constrained")
axis.imshow(picture)
axis.axis("off")
plt.show()

# %%
# Two seeds and 300 env steps answer nothing: the bands overlap, and an interval of two pairs only spans their two
# differences. For an answer raise ``seeds`` and ``budget`` in the file and run it again; what is finished is not
# repeated when seeds are added.
