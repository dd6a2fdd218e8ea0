"""TorchRL's own Trainer with the parts of this package: Pendulum, on one CPU thread in minutes.

    python examples/torchrl_trainer.py [SEED] [STEPS]

The Trainer owns the loop; collector, planner, buffer and loss are ours, and any of them can be exchanged for TorchRL's
(docs/pipelines.md). It prints the mean return of ten episodes: about -1200 at random;
seeds 0 to 2 came to -163, -98 and -147 after 3000 steps.
"""

from __future__ import annotations

import sys

import torch
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer, TensorDictRoundRobinWriter
from torchrl.envs import ExplorationType
from torchrl.envs.utils import set_exploration_type
from torchrl.trainers import Trainer

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
from torchrl_etdmpc.training import Updater, UpdateStepper


def train(seed: int = 0, total_frames: int = 3000, random_frames: int = 600, slices: int = 64) -> EnsembleMPPIPlanner:
    """Trains a planner with its world model."""
    torch.manual_seed(seed)
    env = make_env("gym/Pendulum-v1", seed=seed)
    model = WorldModel(3, 1, latent_dim=64, mlp_dim=64, encoder_dim=128, num_dynamics=2, activation="silu")
    budget = {"horizon": 3, "num_samples": 48, "num_elites": 10, "num_proposals": 4, "iterations": 3, "discount": 0.975}
    planner = EnsembleMPPIPlanner(LatentEnv(model), **budget)
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(total_frames),
        sampler=StepSliceSampler(slice_len=3, as_slices=True),
        writer=TensorDictRoundRobinWriter(track_generations=True),
        batch_size=3 * slices,
    )
    fresh = EnsembleMPPIPlanner(LatentEnv(model), score="final", warm_start=False, **budget)
    ReanalyzeTransform(fresh, slice_len=3, interval=10, num_slices=6).attach(buffer)
    loss = EfficientTDMPCLoss(model, discount=0.975)
    trainer = Trainer(
        collector=StepCollector(
            env,
            planner,
            replay_buffer=buffer,
            total_frames=total_frames,
            init_random_frames=random_frames,
            seed_policy=SeedPolicy(env.action_spec),
        ),
        loss_module=loss,
        optimizer=None,
        optimization_stepper=UpdateStepper(Updater(loss, lr=1e-3, tau=0.03)),
        total_frames=total_frames,
        frame_skip=1,
        optim_steps_per_batch=1,
        progress_bar=False,
    )
    trainer.register_op("process_optim_batch", lambda batch: buffer.sample())
    trainer.train()
    return planner


def evaluate(planner: EnsembleMPPIPlanner, seed: int, episodes: int = 10) -> float:
    """Mean return of episodes that are played to win."""
    env = make_env("gym/Pendulum-v1", seed=seed, num_envs=episodes, parallel=False)
    env = env.append_transform(planner.make_tensordict_primer())
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        played = env.rollout(200, planner)
    return played["next", "reward"].sum().item() / episodes


if __name__ == "__main__":
    torch.set_num_threads(1)
    seed = int(sys.argv[1]) if len(sys.argv) > 1 else 0
    steps = int(sys.argv[2]) if len(sys.argv) > 2 else 3000
    print(f"seed {seed}, {steps} steps: mean return {evaluate(train(seed, steps), seed + 1000):.0f}")
