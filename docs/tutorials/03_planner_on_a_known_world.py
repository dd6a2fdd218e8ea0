"""
The planner on a world whose best plan is known
===============================================

The planner needs a model that encodes, predicts and values. Here it gets one that is exact, so that its plans can be
held against the optimum. Then it gets a model of your own.
"""

# %%
# A point on a line
# -----------------
# ``LineWorld`` is a point whose action is its speed; the reward is highest at the origin. It offers the same methods
# as a learned world model, so ``LatentEnv`` wraps it in the same way.

import matplotlib.pyplot as plt
import torch

from torchrl_etdmpc import EnsembleMPPIPlanner, LatentEnv
from torchrl_etdmpc.testing import LineWorld

world = LineWorld()
planner = EnsembleMPPIPlanner(
    LatentEnv(world), horizon=3, num_samples=128, num_elites=16, num_proposals=0, iterations=6, warm_start=False
)
states = torch.linspace(-2, 2, 9).unsqueeze(-1)
plan = planner.plan(states, explore=False, trace=True)
print("planned:", [round(action, 2) for action in plan.action.flatten().tolist()])
print("optimal:", [round(action, 2) for action in world.optimal_action(states).flatten().tolist()])

# %%
# One call planned for nine states at once. ``plan.trace`` holds every iteration: the candidates, their scores, the
# mean and the standard deviation. The search begins wide and closes in on the optimum.

optimum = world.optimal_actions(states, 3)
error = (plan.trace.mean - optimum.unsqueeze(-3)).abs().mean((-2, -1))  # [states, iterations]
spread = plan.trace.std.mean((-2, -1))

figure, axes = plt.subplots(1, 2, figsize=(9, 3.2), layout="constrained")
rounds = range(1, error.shape[-1] + 1)
axes[0].plot(rounds, error.T, color="tab:blue", alpha=0.4)
axes[0].plot(rounds, error.mean(0), color="tab:blue", linewidth=2)
axes[0].set(xlabel="iteration", ylabel="distance of the mean from the optimum", title="nine states and their mean")
axes[1].plot(rounds, spread.mean(0), color="tab:orange")
axes[1].set(xlabel="iteration", ylabel="standard deviation", title="how wide the search is")
plt.show()

# %%
# A model of your own
# -------------------
# Any module with these members can be planned over; `the page on models <../models.html>`_ lists what each means.
# This one is a pendulum in closed form: the latent is the angle and its speed, and the reward asks it to stand up.


class Pendulum(torch.nn.Module):
    observation_dim, action_dim, latent_dim, num_dynamics = 2, 1, 2, 1
    version = torch.zeros((), dtype=torch.int64)

    def encode(self, observation):
        return observation

    def next(self, latent, action):
        angle, speed = latent.unbind(-1)
        speed = speed + 0.05 * (15 * torch.sin(angle) + 6 * action.squeeze(-1))
        return torch.stack([angle + 0.05 * speed, speed.expand_as(angle + speed)], -1)

    def reward(self, latent, action):
        angle, speed = latent.unbind(-1)
        angle = torch.remainder(angle + torch.pi, 2 * torch.pi) - torch.pi
        return -(angle.square() + 0.1 * speed.square() + 0.004 * action.squeeze(-1).square())

    def values(self, latent):
        return torch.zeros_like(latent[..., :1])

    def termination(self, latent):
        return None


# %%
# There is no policy and no value, so the horizon has to see the whole swing: 30 steps of 50 ms. The plan is carried
# from step to step, as TD-MPC2 does.

model = Pendulum()
planner = EnsembleMPPIPlanner(
    LatentEnv(model), horizon=30, num_samples=256, num_elites=32, num_proposals=0, iterations=4, score="final"
)
state, plan_mean = torch.tensor([[torch.pi, 0.0]]), None
angles, actions = [], []
for _ in range(100):
    plan = planner.plan(state, plan_mean, explore=False)
    plan_mean = plan.mean
    state = model.next(state.unsqueeze(0), plan.action)[0]
    angles.append(state[0, 0].item())
    actions.append(plan.action.item())

figure, axes = plt.subplots(2, 1, figsize=(7, 4), sharex=True, layout="constrained")
axes[0].plot([a / torch.pi for a in angles])
axes[0].axhline(0, color="gray", linewidth=0.8)
axes[0].axhline(2, color="gray", linewidth=0.8)
axes[0].set(ylabel="angle / pi", title="hanging at 1, standing at 0 or 2")
axes[1].step(range(100), actions, where="post")
axes[1].set(ylabel="action", xlabel="decision")
plt.show()

# %%
# With an exact model the planner alone is enough. What the learned parts add is a value, so that a horizon of three
# will do, and proposals, so that few candidates will do.
