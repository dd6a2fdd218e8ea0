from __future__ import annotations

import pytest
import torch
from scipy.stats import kstest
from tensordict import TensorDict
from torchrl.data import Bounded, Categorical, Composite, OneHot, Unbounded

from torchrl_etdmpc import EnsembleMPPIPlanner, LatentEnv, SeedPolicy, WorldModel

BOUNDS = Bounded(-1, 1, shape=(2,))


def run_lengths(actions: torch.Tensor) -> torch.Tensor:
    """For how many decisions each value of a column ``[T, N]`` stays, the last one left out."""
    changes = torch.nn.functional.pad((actions[1:] != actions[:-1]).T, (1, 0), value=True)  # [N, T]
    starts = [row.nonzero().flatten() for row in changes]
    return torch.cat([start.diff() for start in starts]).double()


def test_a_held_action_stays_for_a_geometric_time_in_every_dimension_of_every_environment_by_itself():
    torch.manual_seed(0)
    policy = SeedPolicy(BOUNDS.expand(50, 2), hold=4)
    actions = torch.stack([policy(TensorDict(batch_size=[50]))["action"] for _ in range(2000)])
    lengths = run_lengths(actions.flatten(1))
    assert lengths.mean() == pytest.approx(4, rel=0.02)
    assert (lengths == 1).double().mean() == pytest.approx(1 / 4, rel=0.05)
    changed = (actions[1:] != actions[:-1]).double()
    assert torch.corrcoef(changed.flatten(1).T).fill_diagonal_(0).abs().max() < 0.15
    assert kstest(actions[::100, :, 0].flatten().double(), "uniform", args=(-1, 2)).pvalue > 1e-3


def test_a_new_action_every_time_is_drawn_as_without_the_argument():
    torch.manual_seed(0)
    expected = [BOUNDS.rand() for _ in range(3)]
    torch.manual_seed(0)
    policy = SeedPolicy(BOUNDS)
    assert all(torch.equal(policy(TensorDict())["action"], action) for action in expected)


def test_a_held_action_goes_on_in_a_copy_that_loads_its_state_and_is_not_what_a_buffer_stores():
    torch.manual_seed(0)
    policy, copy = (SeedPolicy(BOUNDS, hold=1e9) for _ in range(2))
    action = policy(TensorDict())["action"]
    expected = action.clone()
    action.zero_()
    copy.load_state_dict(policy.state_dict())
    assert torch.equal(copy(TensorDict())["action"], expected)
    assert not torch.equal(SeedPolicy(BOUNDS, hold=1e9)(TensorDict())["action"], expected)
    assert not dict(policy.named_buffers())  # which would be sent to workers with the weights


@pytest.mark.parametrize("hold", [0, 0.99, -1, float("nan")])
def test_an_action_cannot_be_held_for_less_than_its_decision(hold):
    with pytest.raises(ValueError, match=rf"^hold must be at least 1, got {hold}\.$"):
        SeedPolicy(BOUNDS, hold=hold)


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
