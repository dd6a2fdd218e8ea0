"""
Your own loss term and encoder
==============================

The loss is a list of terms, and you can add to it. The encoder is a module, and you can replace it. Here an encoder
normalises its input by itself, and a term asks latents to remember the observation.
"""

# %%
# Data
# ----
# Pendulum's observation is the cosine and the sine of an angle, and a speed up to 8. Two thousand random steps are
# enough to see what changes.

import matplotlib.pyplot as plt
import torch
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs.utils import RandomPolicy

from torchrl_etdmpc import EfficientTDMPCLoss, StepSliceSampler, WorldModel
from torchrl_etdmpc.envs import make_env
from torchrl_etdmpc.functional import simnorm
from torchrl_etdmpc.objectives import Term
from torchrl_etdmpc.training import Updater

env = make_env("gym/Pendulum-v1", seed=0)
buffer = TensorDictReplayBuffer(
    storage=LazyTensorStorage(2_000), sampler=StepSliceSampler(slice_len=3, as_slices=True), batch_size=3 * 64
)
for frames in Collector(env, RandomPolicy(env.action_spec), frames_per_batch=500, total_frames=2_000):
    buffer.extend(frames)

# %%
# An encoder
# ----------
# It takes an observation with any leading batch and returns latents ``[..., L]``. Predicted latents lie in the range
# of SimNorm, so it ends with ``simnorm``.


class ScaledEncoder(nn.Module):
    """Divides the speed by its bound before anything else."""

    def __init__(self, latent_dim):
        super().__init__()
        self.network = nn.Sequential(nn.Linear(3, 64), nn.LayerNorm(64), nn.SiLU(), nn.Linear(64, latent_dim))

    def forward(self, observation):
        return simnorm(self.network(observation / observation.new_tensor([1.0, 1.0, 8.0])), 8)


# %%
# A term
# ------
# A term is a function of world model, slices and their latent rollout that returns an error of every step, ``[T,
# B]``. One that is a module brings networks of its own, which the loss owns, saves and trains. This one reads the
# real next observation from each head's predicted latent.


class Reconstruction(nn.Module):
    """Squared error of a decoder on the predicted latents."""

    def __init__(self, latent_dim):
        super().__init__()
        self.decoder = nn.Sequential(nn.Linear(latent_dim, 64), nn.SiLU(), nn.Linear(64, 3))

    def forward(self, world_model, slices, rollout):
        target = slices.next_observation / slices.reward.new_tensor([1.0, 1.0, 8.0])  # [T, B, O]
        decoded = self.decoder(rollout.predicted[1:])  # [T, F, B, O]
        return (decoded - target.unsqueeze(1)).square().mean((1, -1))


# %%
# Three ways to train
# -------------------
# The same number of updates with the same data. The policy term is left out (``distill=False``), as random data has
# no plans. ``Updater`` clips, steps and moves the targets, and it trains the decoder too.


KEYS = ("reconstruction_error", "reward_error")


def trained(encoder, coef):
    torch.manual_seed(0)
    world_model = WorldModel(
        3 if encoder is None else None, 1, encoder=encoder, latent_dim=32, mlp_dim=64, num_dynamics=2
    )
    term = Term("reconstruction", Reconstruction(32), coef=coef)
    loss = EfficientTDMPCLoss(world_model, discount=0.97, extra_terms=[term])
    updater = Updater(loss, lr=1e-3)
    history = []
    for _ in range(300):
        history.append(updater.step(buffer.sample(), distill=False))
    return {key: [float(terms[key]) for terms in history] for key in KEYS}


torch.manual_seed(0)
own = ScaledEncoder(32)
curves = {
    "no reconstruction": trained(None, 0.0),
    "reconstruction": trained(None, 2.0),
    "reconstruction, own encoder": trained(own, 2.0),
}

# %%
# Without weight the term is computed and trains nothing, so its error is that of a decoder that was never trained:
# the first line is the scale to compare with.

figure, axes = plt.subplots(1, 2, figsize=(9, 3.4), layout="constrained")
for axis, key in zip(axes, KEYS, strict=True):
    for name, values in curves.items():
        smooth = torch.tensor(values[key]).unfold(0, 20, 1).mean(-1)
        axis.plot(smooth, label=name)
    axis.set(xlabel="update", yscale="log", title=key)
axes[0].legend()
plt.show()

print(f"{'last 20 updates':30} {'reconstruction_error':>22} {'reward_error':>14}")
for name, values in curves.items():
    last = [sum(values[key][-20:]) / 20 for key in KEYS]
    print(f"{name:30} {last[0]:22.4f} {last[1]:14.4f}")

# %%
# Latents hold the observation if they are asked to. Whether that helps an agent is another question, which this
# page does not answer: the method does without, on purpose, so that latents hold what rewards and values need.
