from __future__ import annotations

import pytest
import torch
from torchrl.collectors import Collector
from torchrl.data import Bounded, LazyTensorStorage, ReplayBuffer
from torchrl.envs import ActionScaling, Compose, InitTracker, SerialEnv, TransformedEnv
from torchrl.testing.mocking_classes import ContinuousActionVecMockEnv

from torchrl_etdmpc import EnsembleMPPIPlanner, LatentEnv, StepCollector, WorldModel

BUDGET = {"horizon": 2, "num_samples": 8, "num_elites": 2, "num_proposals": 2, "iterations": 1}
SCALED = r"action has bounds of -2 and 2 instead of -1 and 1 \(append ActionScaling\(\)\)"


def make_env(bound=1.0) -> TransformedEnv:
    action = Bounded(-bound, bound, shape=(2,), dtype=torch.float32)
    return TransformedEnv(ContinuousActionVecMockEnv(action_spec=action), InitTracker())


def make_planner(env, *, observation_dim=None, action_dim=2, **options) -> EnsembleMPPIPlanner:
    size = env.observation_spec["observation"].shape[-1] if observation_dim is None else observation_dim
    model = WorldModel(size, action_dim, latent_dim=16, mlp_dim=16, encoder_dim=16)
    return EnsembleMPPIPlanner(LatentEnv(model), **BUDGET, **options)


def test_the_first_reset_compares_environment_and_model():
    env = make_env(2.0)
    env.append_transform(make_planner(env).make_tensordict_primer())
    with pytest.raises(ValueError, match=SCALED):
        env.reset()


def test_transforms_that_come_after_the_primer_may_mend_the_environment():
    env = make_env(2.0)
    planner = make_planner(env)
    env = TransformedEnv(env.base_env, Compose(InitTracker(), planner.make_tensordict_primer(), ActionScaling()))
    assert env.reset()["plan_mean"].shape == (2, 2)


@pytest.mark.parametrize("warm_start", [True, False])
@pytest.mark.parametrize(
    ("sizes", "message"),
    [
        ({"action_dim": 3}, "action has 2 entries instead of the model's 3"),
        ({"observation_dim": 4}, "observation has 7 entries instead of the model's 4"),
    ],
)
def test_our_collector_compares_before_it_acts(sizes, message, warm_start):
    env = SerialEnv(2, make_env)
    buffer = ReplayBuffer(storage=LazyTensorStorage(10))
    with pytest.raises(ValueError, match=message):
        StepCollector(env, make_planner(env, **sizes, warm_start=warm_start), replay_buffer=buffer)


def test_a_collector_of_torchrl_compares_at_its_first_reset():
    env = make_env(2.0)
    with pytest.raises(ValueError, match=SCALED):
        Collector(env, make_planner(env), frames_per_batch=2, total_frames=2, auto_register_policy_transforms=True)
