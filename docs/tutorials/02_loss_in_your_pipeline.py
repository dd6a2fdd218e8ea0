"""
The loss in a TorchRL pipeline of your own
==========================================

``EfficientTDMPCLoss`` is a TorchRL loss module. Here it learns Pendulum with TorchRL's ``GymEnv``, ``Collector`` and
replay buffer and a plain Adam; nothing of this package's training code is used.
"""

# %%
# Environment and networks
# ------------------------
# Two transforms make Pendulum fit: actions in [-1, 1], and a mark on the first step of an episode. MuJoCo's tasks also
# need ``DoubleToFloat(in_keys=["observation"])``; ``check_env`` says what an environment lacks.

import matplotlib.pyplot as plt
import torch
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer, TensorDictRoundRobinWriter
from torchrl.envs import ActionScaling, Compose, GymEnv, InitTracker, TransformedEnv
from torchrl.objectives import SoftUpdate

from torchrl_etdmpc import (
    EfficientTDMPCLoss,
    EnsembleMPPIPlanner,
    LatentEnv,
    ReanalyzeTransform,
    StepSliceSampler,
    WorldModel,
)

torch.manual_seed(0)
env = TransformedEnv(GymEnv("Pendulum-v1"), Compose(ActionScaling(), InitTracker()))
env.set_seed(0)
world_model = WorldModel(observation_dim=3, action_dim=1, latent_dim=32, mlp_dim=64, num_dynamics=2, num_bins=21)

# %%
# Planner, loss, buffer
# ---------------------
# The planner acts. A second one, without a warm start, makes old plans anew. The loss takes slices of three steps of
# one episode, ``[B, T]``, which the sampler cuts from the buffer as soon as they are there. Half of a value target is
# what was paid, all plans count alike, and bins are few, as in the preset ``cpu``: small networks learn faster so.

budget = dict(horizon=3, num_samples=24, num_elites=4, num_proposals=2, iterations=2, discount=0.97)
planner = EnsembleMPPIPlanner(LatentEnv(world_model), score="mean", **budget)
reanalyzer = EnsembleMPPIPlanner(LatentEnv(world_model), score="final", warm_start=False, **budget)
loss = EfficientTDMPCLoss(world_model, discount=0.97, value_replayed=0.5, kl_direction="forward")
optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
target_update = SoftUpdate(loss, tau=0.1)
buffer = TensorDictReplayBuffer(
    storage=LazyTensorStorage(10_000),
    sampler=StepSliceSampler(slice_len=3, as_slices=True),
    batch_size=3 * 64,
    writer=TensorDictRoundRobinWriter(track_generations=True),
)
ReanalyzeTransform(reanalyzer, slice_len=3, interval=10, num_slices=4).attach(buffer)

# %%
# The loop
# --------
# An episode is collected, then there is one update for each of its steps. ``loss(batch)`` returns the weighted terms,
# whose names begin with ``loss_``, and metrics.

collector = Collector(env, planner, frames_per_batch=200, total_frames=1_000, auto_register_policy_transforms=True)
ERRORS = ("consistency_error", "reward_error", "value_error", "policy_kl")
returns, errors = [], []
for frames in collector:
    buffer.extend(frames.exclude("plan_mean", ("next", "plan_mean")))  # the warm start need not be stored
    for _ in range(frames.numel()):
        terms = loss(buffer.sample())
        sum(value for key, value in terms.items() if key.startswith("loss_")).backward()
        torch.nn.utils.clip_grad_norm_(loss.parameters(), 20)
        optimizer.step()
        optimizer.zero_grad()
        target_update.step()
    returns.append(frames["next", "reward"].sum().item())
    errors.append({key: terms[key].item() for key in ERRORS})

# %%
# Shapes, for those who look them up: what goes in, and what comes out.

batch = buffer.sample()
entries = ("observation", "action", ("next", "reward"), ("plan", "loc"))
print("in: ", {str(key): tuple(batch[key].shape) for key in entries})
print("out:", {key: tuple(value.shape) for key, value in terms.items()})

# %%
# The result
# ----------

figure, axes = plt.subplots(1, 2, figsize=(9, 3.4), layout="constrained")
steps = [200 * (index + 1) for index in range(len(returns))]
axes[0].plot(steps, returns, marker="o")
axes[0].set(xlabel="env steps", title="return of each training episode")
for key in errors[0]:
    axes[1].plot(steps, [error[key] for error in errors], label=key)
axes[1].set(xlabel="env steps", yscale="log", title="errors, of the last batch")
axes[1].legend()
plt.show()

# %%
# These are training episodes, with exploration, of one seed. The first ones are played with random weights: there is
# no random phase here. What else works in the place of ``Collector`` and the buffer is in `the table of pipelines
# <../pipelines.html>`_.
