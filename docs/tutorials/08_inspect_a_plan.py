"""
Inspect a plan
==============

With ``trace=True`` a plan brings every iteration with it: candidates, scores, return tables, the mean and the
standard deviation. This page looks at one decision in slow motion.
"""

# %%
# One decision, two scores
# ------------------------
# The world is the one of the tutorial on scores: one of four heads believes in a bonus for actions between 0.2
# and 0.6, and the goal lies the other way.

import matplotlib.pyplot as plt
import torch

from torchrl_etdmpc import EnsembleMPPIPlanner, LatentEnv
from torchrl_etdmpc.testing import LineWorld

world = LineWorld(goal=-1.0, num_dynamics=4, trap=(0.2, 0.6), trap_bonus=20.0)
budget = dict(horizon=3, num_samples=128, num_elites=16, num_proposals=0, iterations=6, warm_start=False)
state = torch.tensor([0.0])
plans = {}
for beta in (0.0, 3.0):
    planner = EnsembleMPPIPlanner(LatentEnv(world), score="mean", beta=beta, **budget)
    noise = planner.draw_noise(generator=torch.Generator().manual_seed(0))
    plans[beta] = planner.plan(state, explore=False, noise=noise, trace=True)

trace = plans[0.0].trace
print({name: tuple(value.shape) for name, value in trace._asdict().items()})

# %%
# Candidates and scores, iteration by iteration
# ---------------------------------------------
# Each dot is a candidate: its first action, and its score. Those in colour are the elites, to which the next Gaussian
# is fitted.

figure, axes = plt.subplots(2, 4, figsize=(11, 5), sharex=True, sharey="row", layout="constrained")
for row, (beta, plan) in zip(axes, plans.items(), strict=True):
    for axis, index in zip(row, (0, 1, 3, 5), strict=True):
        first = plan.trace.actions[index, :, 0, 0]
        score = plan.trace.scores[index]
        elite = score.topk(16).indices
        axis.axvspan(0.2, 0.6, color="tab:red", alpha=0.12)
        axis.scatter(first, score, s=8, color="lightgray")
        axis.scatter(first[elite], score[elite], s=10, color="tab:blue")
        axis.set(title=f"beta={beta:g}, iteration {index + 1}")
    row[0].set_ylabel("score")
for axis in axes[-1]:
    axis.set_xlabel("first action")
plt.show()

# %%
# Without a penalty the bonus of one head lifts the mean, and the search closes in on the trap (red). With it, the
# same candidates fall behind.
#
# The table behind a score
# ------------------------
# For the best candidate of the first iteration: a row for each depth, a column for each head. The head that is wrong
# stands alone.

best = trace.scores[0].argmax()
table = trace.returns[0, best].squeeze(-1)
print("depth " + "".join(f"   head {head}" for head in range(4)))
for depth, row in enumerate(table, 1):
    print(f"{depth:5d} " + "".join(f"{value:9.2f}" for value in row.tolist()))

# %%
figure, axis = plt.subplots(figsize=(6, 3), layout="constrained")
image = axis.imshow(table, cmap="viridis", aspect="auto")
axis.set(xticks=range(4), yticks=range(3), yticklabels=[1, 2, 3], xlabel="dynamics head", ylabel="depth")
figure.colorbar(image, label="estimated return")
plt.show()

# %%
# Of a trained agent
# ------------------
# `The inspector <../inspector.html>`_ shows all of this for a checkpoint, on a page in the browser. In Python the same
# call works with a learned model: ``load_agent`` of ``torchrl_etdmpc.training`` reads a checkpoint's agent,
# and ``agent.eval_planner.plan(observations, explore=False, trace=True)`` traces it. There is no truth to hold the
# plan against then, but three things are worth a look: whether the spread shrinks, whether elites come from the
# policy's proposals (the first ones of ``trace.actions``), and at which depth the heads begin to disagree.
