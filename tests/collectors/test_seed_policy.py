from __future__ import annotations

import pytest
import torch
from scipy.stats import kstest
from tensordict import TensorDict
from torchrl.data import Bounded, Categorical, Composite, OneHot, Unbounded

from torchrl_etdmpc import EnsembleMPPIPlanner, LatentEnv, SeedPolicy, WorldModel

BOUNDS = Bounded(-1, 1, shape=(2,))


def test_actions_are_uniform_in_the_planner_s_bounds():
    torch.manual_seed(0)
    spec = BOUNDS.expand(4000, 2)
    actions = SeedPolicy(spec)(TensorDict(batch_size=[4000]))["action"].double()
    for dimension in range(2):
        assert kstest(actions[:, dimension], "uniform", args=(-1, 2)).pvalue > 1e-3


def test_successive_actions_differ_and_follow_torch_manual_seed():
    policy = SeedPolicy(BOUNDS)
    torch.manual_seed(0)
    first, second = (policy(TensorDict())["action"] for _ in range(2))
    torch.manual_seed(0)
    assert torch.equal(policy(TensorDict())["action"], first)
    assert not torch.equal(first, second)


@pytest.mark.parametrize("batch", [(), (3,)], ids=["one-env", "three-envs"])
def test_the_target_is_the_standard_normal_made_at_update_zero(batch):
    out = SeedPolicy(BOUNDS.expand(*batch, 2))(TensorDict(batch_size=batch))
    assert torch.equal(out["plan", "loc"], torch.zeros(*batch, 2))
    assert torch.equal(out["plan", "scale"], torch.ones(*batch, 2))
    assert torch.equal(out["plan", "value"], torch.zeros(*batch, 1))
    assert torch.equal(out["plan", "version"], torch.zeros(*batch, 1, dtype=torch.int64))
    assert torch.equal(out["plan", "fallback"], torch.zeros(*batch, 1, dtype=torch.bool))


@pytest.mark.parametrize("keys", [{}, {"action_key": ("control", "u"), "plan_key": ("expert", "target")}])
def test_it_writes_exactly_what_the_planner_writes(keys):
    model = WorldModel(3, 2, latent_dim=16, mlp_dim=16)
    options = {"horizon": 2, "num_samples": 8, "num_elites": 2, "num_proposals": 2, "iterations": 1}
    planner = EnsembleMPPIPlanner(LatentEnv(model), warm_start=False, **options, **keys)
    policy = SeedPolicy(Bounded(-1, 1, shape=(5, 2)), **keys)
    planned = planner(TensorDict({"observation": torch.zeros(5, 3)}, [5])).exclude("observation")
    seeded = policy(TensorDict(batch_size=[5]))
    assert policy.out_keys == planner.out_keys
    assert set(seeded.keys(True, True)) == set(planned.keys(True, True)) == set(policy.out_keys)
    for key in policy.out_keys:
        assert (seeded[key].dtype, seeded[key].shape) == (planned[key].dtype, planned[key].shape), key


def test_a_composite_spec_is_read_at_the_action_s_key():
    spec = Composite(control=Composite(u=BOUNDS, brake=Unbounded((3,))))
    torch.manual_seed(0)
    out = SeedPolicy(spec, action_key=("control", "u"))(TensorDict())
    torch.manual_seed(0)
    assert torch.equal(out["control", "u"], SeedPolicy(BOUNDS)(TensorDict())["action"])
    assert ("control", "brake") not in out.keys(True)


def test_what_was_there_stays():
    observation = torch.randn(3)
    out = SeedPolicy(BOUNDS)(TensorDict({"observation": observation}))
    assert torch.equal(out["observation"], observation)
    assert "next" not in out.keys()


def test_its_targets_do_not_share_memory():
    out = SeedPolicy(BOUNDS)(TensorDict())
    out["plan", "loc"].fill_(7)
    out["plan", "value"].fill_(7)
    assert (out["plan", "scale"] == 1).all()
    assert not out["plan", "fallback"].any()
    assert (SeedPolicy(BOUNDS)(TensorDict())["plan", "loc"] == 0).all()


@pytest.mark.parametrize(
    ("spec", "fault"),
    [
        (Unbounded((2,)), "action has no finite bounds"),
        (Bounded(low=torch.zeros(2), high=torch.tensor([1.0, torch.inf])), "action has no finite bounds"),
        (Bounded(0, 10, shape=(2,)), r"action has bounds of 0 and 10 instead of -1 and 1 \(append ActionScaling"),
        (Bounded(-2, 2, shape=(2,)), "action has bounds of -2 and 2"),
        (Bounded(torch.tensor([-1.0, -1.0]), torch.tensor([1.0, 0.5])), "action has bounds of -1 and 0.5"),
        (Categorical(4), r"action is discrete \(Categorical\)"),
        (OneHot(4), r"action is discrete \(OneHot\)"),
    ],
)
def test_an_action_that_the_planner_would_not_take_is_refused(spec, fault):
    with pytest.raises(ValueError, match=rf"SeedPolicy acts in \[-1, 1\], as the planner does, but {fault}"):
        SeedPolicy(spec)
