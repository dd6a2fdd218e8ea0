"""
A score of your own
===================

The planner scores a candidate by a function of its table of return estimates: the thesis calls it the planner's
objective. You can pass a function of yours. To compare scores, plan with each from the same states, with the same
random numbers, and judge the plans by a world that is known.
"""

# %%
# A world with a trap
# -------------------
# In ``LineWorld`` a point has to go to its goal. One of four dynamics heads believes that actions between 0.2 and 0.6
# earn a large bonus. That is what a learned model's mistake looks like to a planner: an opportunity.

import matplotlib.pyplot as plt
import torch

from torchrl_etdmpc import AdaptiveScore, EnsembleMPPIPlanner, FinalScore, LatentEnv, MeanScore
from torchrl_etdmpc.testing import LineWorld

believed = LineWorld(goal=-1.0, num_dynamics=4, trap=(0.2, 0.6), trap_bonus=20.0)
truth = LineWorld(goal=-1.0)

# %%
# Scores are functions
# --------------------
# The table is ``[..., D, F, V]``: depth, dynamics head, value head. A score reduces it to ``[...]``. Here are two of
# your own.


def cautious(returns):
    """The mean over depths of the most pessimistic pair of heads."""
    return returns.amin((-2, -1)).mean(-1)


def median(returns):
    """The mean over depths of the middle of all heads."""
    return returns.flatten(-2).median(-1).values.mean(-1)


scores = {
    "final": FinalScore(),
    "final, beta=3": FinalScore(beta=3.0),
    "mean": MeanScore(),
    "mean, beta=3": MeanScore(beta=3.0),
    "adaptive, beta=3": AdaptiveScore(beta=3.0),
    "cautious": cautious,
    "median": median,
}

# %%
# The same states, the same draws
# -------------------------------
# ``draw_noise`` draws every random number of a planning call. With the same ones, two plans differ by the score
# alone.

budget = dict(horizon=3, num_samples=128, num_elites=16, num_proposals=0, iterations=6, warm_start=False)
states = torch.linspace(-2, 1, 64).unsqueeze(-1)
noise = EnsembleMPPIPlanner(LatentEnv(believed), **budget).draw_noise(len(states))
optimum = truth.optimal_action(states)

trapped, costs = {}, {}
for name, score in scores.items():
    plan = EnsembleMPPIPlanner(LatentEnv(believed), score=score, **budget).plan(states, explore=False, noise=noise)
    action = plan.action
    trapped[name] = ((action > 0.2) & (action < 0.6)).float().mean().item()
    latent = truth.encode(states)
    costs[name] = (truth.reward(latent, optimum) - truth.reward(latent, action)).mean().item()

print(f"{'score':18} {'in the trap':>12} {'reward lost per step':>22}")
for name in scores:
    print(f"{name:18} {trapped[name]:12.0%} {costs[name]:22.3f}")

# %%
figure, axis = plt.subplots(figsize=(7, 3.2), layout="constrained")
axis.barh(list(costs), list(costs.values()), color=["tab:gray"] * 5 + ["tab:blue"] * 2)
axis.invert_yaxis()
axis.set(xlabel="reward lost per step against the optimum", title="64 states, same random numbers")
plt.show()

# %%
# What this shows is the mechanism: where one head is wrong and the others are not, disagreement gives it away. It
# does not show that caution pays while learning. There, heads disagree about everything that is new, and a cautious
# agent may never go and see.
