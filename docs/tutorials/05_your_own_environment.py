"""
Your own environment, and one that terminates
=============================================

Any TorchRL environment can be trained on. This page writes one from nothing, lets ``check_env`` say what it lacks,
and gives it an edge that ends the episode.
"""

# %%
# An environment from nothing
# ---------------------------
# A cart on a track: the action pushes it, and the reward is highest at the right edge. Whoever goes over an edge has
# *terminated*: nothing follows. After 50 steps time is up and the episode is *truncated*: something would have
# followed.

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import torch
from tensordict import TensorDict
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from torchrl_etdmpc.envs import Task, check_env, make_env, register_task
from torchrl_etdmpc.training import TrainConfig, launch, load_agent


class Track(EnvBase):
    """A cart between two edges at -1 and 1."""

    def __init__(self, device="cpu"):
        super().__init__(device=device)
        self.observation_spec = Composite(observation=Unbounded((2,)))
        self.action_spec = Bounded(-1, 1, (1,))
        self.reward_spec = Unbounded((1,))
        flags = ("done", "terminated", "truncated")
        self.full_done_spec = Composite({name: Binary(1, dtype=torch.bool) for name in flags})
        self.generator = torch.Generator().manual_seed(0)

    def _set_seed(self, seed):
        self.generator.manual_seed(seed or 0)

    def _state(self, terminated):
        truncated = self.steps == 50 and not terminated
        flags = {"done": terminated or truncated, "terminated": terminated, "truncated": truncated}
        values = {name: torch.tensor([flag]) for name, flag in flags.items()}
        return values | {"observation": torch.cat([self.position, self.speed])}

    def _reset(self, tensordict=None):
        self.position, self.steps = torch.rand(1, generator=self.generator) - 0.5, 0
        self.speed = torch.zeros(1)
        return TensorDict(self._state(False))

    def _step(self, tensordict):
        self.steps += 1
        self.speed = 0.8 * self.speed + 0.1 * tensordict["action"]
        self.position = self.position + self.speed
        reward = (1 + self.position) / 2
        return TensorDict({"reward": reward, **self._state(bool(self.position.abs() > 1))})


# %%
# What is missing
# ---------------
# ``check_env`` looks at the specs and names everything in one error, with the transform that adds it.

try:
    check_env(Track())
except ValueError as error:
    print(error)

# %%
# ``make_env`` adds these two by itself. A task is a name, a time limit and whether episodes can terminate;
# ``register_task`` makes it known, with its maker.

task = Task("track", "mine", episode_length=50, terminates=True)
register_task(task, lambda task, device: Track(device))
check_env(make_env(task, seed=0))

# %%
# From the command line the same is ``task=my_file:Track task.episode_length=50``.
#
# Training
# --------
# The world model gets a termination head because the task terminates, and slices may begin in an episode's last
# steps, so that ends are learned from as often as other steps. What is not written here has the defaults, which are
# those of ``efficient-tdmpc``; ``dataclasses.replace(preset("cpu"), ...)`` begins with those of ``cpu``.

run_dir = Path(tempfile.mkdtemp()) / "track"
planner = {"horizon": 3, "num_samples": 24, "num_elites": 4, "num_proposals": 2, "iterations": 2}
config = TrainConfig.from_dict(
    {
        **{"task": "track", "total_env_steps": 700, "run_dir": str(run_dir)},
        **{"eval_every": 350, "eval_episodes": 3, "log_every": 100, "compile": "off", "threads": 1},
        "model": {"latent_dim": 32, "mlp_dim": 64, "encoder_dim": 64, "num_dynamics": 2},
        "planner": planner,
        "reanalyze": {**planner, "num_slices": 4},
        "optim": {"batch_size": 64, "lr": 1e-3},
        "loss": {"tau": 0.03},
        "replay": {"seed_decisions": 400, "pretrain_updates": 200},
    }
)
print(launch(config).rpartition(";")[0])

# %%
# Does it know the edges?
# -----------------------
# The head predicts, from the latent that an action leads to, whether the episode has ended. Here it is asked for
# positions on both sides of the edges, at three speeds. What the agent never visits it cannot know.

agent, _, _ = load_agent(run_dir / "checkpoints" / "last.pt")
positions = torch.linspace(-1.2, 1.2, 121)

figure, axis = plt.subplots(figsize=(7, 3.2), layout="constrained")
with torch.no_grad():
    for speed in (-0.1, 0.0, 0.1):
        observations = torch.stack([positions, torch.full_like(positions, speed)], -1)
        ended = agent.world_model.termination(agent.world_model.encode(observations))
        axis.plot(positions, ended, label=f"speed {speed:+.1f}")
for edge in (-1, 1):
    axis.axvline(edge, color="gray", linestyle=":")
axis.set(xlabel="position", ylabel="predicted probability", title="has the episode ended?")
axis.legend()
plt.show()

# %%
# And what it does: the reward is highest at the right edge, and over it is the end.

figure, axis = plt.subplots(figsize=(7, 3.2), layout="constrained")
played = make_env(task, seed=1).append_transform(agent.eval_planner.make_tensordict_primer())
with torch.no_grad():
    for _ in range(4):
        rollout = played.rollout(50, agent.eval_planner)
        axis.plot(rollout["next", "observation"][:, 0], marker=".", markersize=3)
axis.axhline(1, color="gray", linestyle=":")
axis.set(xlabel="decision", ylabel="position", title="four episodes of the trained agent")
plt.show()
