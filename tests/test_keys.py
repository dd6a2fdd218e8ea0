from __future__ import annotations

import torch
from tensordict import TensorDict
from torchrl.data import Bounded

from torchrl_etdmpc import EfficientTDMPCLoss, EnsembleMPPIPlanner, LatentEnv, SeedPolicy, WorldModel, keys
from torchrl_etdmpc.testing import random_slices


def test_parts_with_default_keys_meet():
    model = WorldModel(3, 2, latent_dim=16, mlp_dim=16, encoder_dim=16)
    planner = EnsembleMPPIPlanner(LatentEnv(model), horizon=3, num_samples=8, num_elites=4, num_proposals=2)
    seed_policy = SeedPolicy(Bounded(-1, 1, shape=(2,)))
    plan = [(keys.PLAN, name) for name in keys.PLAN_FIELDS]
    assert seed_policy.out_keys == [keys.ACTION, *plan]
    assert planner.out_keys == [*seed_policy.out_keys, (keys.NEXT, keys.PLAN_MEAN)]
    assert planner.in_keys == [keys.OBSERVATION, keys.IS_INIT, keys.PLAN_MEAN]
    loss = EfficientTDMPCLoss(model, discount=0.9)
    written = {keys.OBSERVATION, *planner.out_keys, *random_slices(3, 2).keys(True, True)}
    assert set(loss.in_keys) <= written


def test_the_fallback_is_written_but_is_no_target():
    assert keys.PLAN_FIELDS == (*keys.TARGETS, keys.FALLBACK)
    assert keys.FALLBACK not in keys.TARGETS
    model = WorldModel(3, 2, latent_dim=16, mlp_dim=16, encoder_dim=16)
    planner = EnsembleMPPIPlanner(LatentEnv(model), num_samples=8, num_elites=4, num_proposals=2, warm_start=False)
    out = planner(TensorDict({keys.OBSERVATION: torch.zeros(4, 3)}, batch_size=[4]))
    assert set(out[keys.PLAN].keys()) == set(keys.PLAN_FIELDS)
    assert set(random_slices(3, 2)[keys.PLAN].keys()) == set(keys.TARGETS)
