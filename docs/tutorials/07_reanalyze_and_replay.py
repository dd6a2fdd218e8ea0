"""
Reanalyze and per-step replay, by experiment
============================================

The policy learns from plans that are stored with the transitions. Plans grow old: they were made with weights that
have changed since. Reanalyze makes some of them anew. This page measures what grows old, and how fast.
"""

# %%
# The experiment
# --------------
# A small agent acts on Pendulum for 360 decisions, with one update each after the first sixty. Three times: without
# reanalyze, with a quarter of every 20th batch made anew, and of every 5th.

import matplotlib.pyplot as plt
import torch
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer, TensorDictRoundRobinWriter

from torchrl_etdmpc import (
    EfficientTDMPCLoss,
    EnsembleMPPIPlanner,
    LatentEnv,
    ReanalyzeTransform,
    SeedPolicy,
    StepCollector,
    StepSliceSampler,
    WorldModel,
)
from torchrl_etdmpc.envs import make_env
from torchrl_etdmpc.functional import gaussian_kl
from torchrl_etdmpc.training import Updater

budget = dict(horizon=3, num_samples=24, num_elites=6, num_proposals=2, iterations=3, discount=0.97)


def experiment(interval):
    torch.manual_seed(0)
    env = make_env("gym/Pendulum-v1", seed=0)
    world_model = WorldModel(3, 1, latent_dim=32, mlp_dim=64, num_dynamics=2)
    planner = EnsembleMPPIPlanner(LatentEnv(world_model), **budget)
    fresh = EnsembleMPPIPlanner(LatentEnv(world_model), score="final", warm_start=False, **budget)
    updater = Updater(EfficientTDMPCLoss(world_model, discount=0.97), lr=1e-3)
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(1_000),
        sampler=StepSliceSampler(slice_len=3, as_slices=True),
        writer=TensorDictRoundRobinWriter(track_generations=True),
        batch_size=3 * 32,
    )
    if interval:
        ReanalyzeTransform(fresh, slice_len=3, interval=interval, num_slices=8).attach(buffer)
    collector = StepCollector(
        env,
        planner,
        replay_buffer=buffer,
        total_frames=360,
        init_random_frames=60,
        seed_policy=SeedPolicy(env.action_spec),
    )
    steps, ages = [], []
    for frame, _ in enumerate(collector, 1):
        if frame <= 60:
            continue
        updater.step(buffer.sample())
        if frame % 20 == 0:
            rows = buffer.storage[:]
            steps.append(frame - 60)
            ages.append((world_model.version - rows["plan", "version"]).float().mean().item())
    return buffer.storage[:], world_model, fresh, (steps, ages)


results = {interval: experiment(interval) for interval in (0, 20, 5)}

# %%
# How old plans are
# -----------------
# The age of a plan is the number of updates since it was made. Without reanalyze the mean age grows for ever. With
# it, growth is slower; it stops only where as many plans are made anew as become old.

figure, axis = plt.subplots(figsize=(7, 3.2), layout="constrained")
for interval, (_, _, _, (steps, ages)) in results.items():
    axis.plot(steps, ages, marker=".", label=f"every {interval} updates" if interval else "never")
axis.set(xlabel="updates", ylabel="mean age of the stored plans, updates")
axis.legend(title="reanalyze")
plt.show()

# %%
# What goes stale
# ---------------
# Every stored state is planned for once more with the final weights. The divergence of the stored plan from that one
# says how wrong it has become. Two fresh plans of one state differ as well, because planning draws random numbers:
# the dashed line.


def staleness(rows, world_model, fresh):
    torch.manual_seed(1)
    again, once_more = (fresh.plan(rows["observation"]) for _ in range(2))
    stored = rows["plan", "loc"], rows["plan", "scale"]
    kl = gaussian_kl(again.loc, again.scale, *stored).mean(-1)
    floor = gaussian_kl(again.loc, again.scale, once_more.loc, once_more.scale).mean(-1)
    return (world_model.version - rows["plan", "version"]).squeeze(-1), kl, floor


stale = {interval: staleness(*made) for interval, (*made, _) in results.items()}
age, kl, floor = stale[20]
planned = age < 300  # without the random phase, whose plans are N(0, 1)
edges = torch.arange(0, 301, 30)
middles, medians = [], []
for low, high in zip(edges[:-1], edges[1:], strict=True):
    chosen = planned & (age >= low) & (age < high)
    if chosen.sum() >= 5:
        middles.append(int(low + high) / 2)
        medians.append(kl[chosen].median().item())
figure, axis = plt.subplots(figsize=(7, 3.2), layout="constrained")
axis.plot(middles, medians, marker="o", label="stored plan")
axis.axhline(floor.median(), color="gray", linestyle="--", label="another fresh plan")
axis.set(xlabel="age of the stored plan, updates", ylabel="KL(fresh || stored), median", yscale="log")
axis.legend()
plt.show()

# %%
print(f"{'reanalyze':12} {'mean age':>9} {'median KL of stored plans':>27} {'of fresh ones':>14}")
for interval, (age, kl, floor) in stale.items():
    chosen = age < 300
    name = f"every {interval}" if interval else "never"
    print(f"{name:12} {age.float().mean():9.0f} {kl[chosen].median():27.2f} {floor.median():14.2f}")

# %%
# Each row of the table is another agent with other data, so compare the columns within a row first.
#
# Per step or per episode
# -----------------------
# With ``insertion="step"`` a transition can be sampled before the next action is chosen. With ``"episode"`` it waits
# until its episode has ended, as in BMPC. Random actions will do to see it.


def waiting(insertion):
    env = make_env("gym/Pendulum-v1", seed=0)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(1_000))
    policy = SeedPolicy(env.action_spec)
    collector = StepCollector(env, policy, replay_buffer=buffer, total_frames=360, insertion=insertion)
    return [frame - len(buffer) for frame, _ in enumerate(collector, 1)]


figure, axis = plt.subplots(figsize=(7, 2.8), layout="constrained")
for insertion in ("step", "episode"):
    axis.plot(waiting(insertion), label=f'insertion="{insertion}"')
axis.set(xlabel="decision", ylabel="transitions that\ncannot be sampled yet")
axis.legend()
plt.show()

# %%
# An episode of 200 decisions means that its newest 200 transitions are unknown to the losses. On tasks where learning
# is fast, the newest ones matter most.
