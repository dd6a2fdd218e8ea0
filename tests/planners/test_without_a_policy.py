"""A model without a policy: what plans over it, what the fallback is, and what says that it needs one."""

from __future__ import annotations

import inspect

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor, nn

from torchrl_etdmpc import EnsembleMPPIPlanner, LatentEnv, export_planner, export_policy
from torchrl_etdmpc.modules import has_policy, require_prediction_model
from torchrl_etdmpc.planners import BarePolicy

START = {"horizon": 2, "num_samples": 64, "num_elites": 8, "num_proposals": 0, "iterations": 4, "warm_start": False}


class Line(nn.Module):
    """A point that actions push; best is to stand at 1."""

    observation_dim = action_dim = latent_dim = num_dynamics = 1
    version = torch.zeros((), dtype=torch.int64)

    def __init__(self, reward: float = 0.0) -> None:
        super().__init__()
        self.bonus = reward

    def encode(self, observation: Tensor) -> Tensor:
        return observation

    def next(self, latent: Tensor, action: Tensor) -> Tensor:
        return latent + 0.5 * action

    def reward(self, latent: Tensor, action: Tensor) -> Tensor:
        return self.bonus - (latent + 0.5 * action - 1).square().sum(-1)

    def values(self, latent: Tensor) -> Tensor:
        return torch.zeros_like(latent)

    def termination(self, latent: Tensor) -> Tensor | None:
        return None


def make_planner(world: Line, **options) -> EnsembleMPPIPlanner:
    torch.manual_seed(0)
    return EnsembleMPPIPlanner(LatentEnv(world), **(START | options))


def test_a_model_of_one_s_own_is_short():
    lines = [line for line in inspect.getsource(Line).splitlines() if line.strip()]
    assert len(lines) + 1 <= 25  # and the line that plans over it
    assert "._" not in "".join(lines).replace(".__init__", "")


def test_a_policy_is_no_part_of_what_planning_needs():
    require_prediction_model(Line())
    assert not has_policy(Line())


def test_the_planner_finds_the_optimum_without_proposals():
    planner = make_planner(Line())
    state = TensorDict({"observation": torch.tensor([[0.0], [0.8], [1.25]])}, [3])
    torch.testing.assert_close(planner(state)["plan", "loc"], torch.tensor([[1.0], [0.4], [-0.5]]), atol=0.15, rtol=0)


def test_a_planner_over_a_model_without_a_policy_is_exported():
    planner = make_planner(Line(), iterations=1)
    action, _ = export_planner(planner, batch_size=None).module()(torch.zeros(3, 1), torch.zeros(3, 2, 1))
    assert action.shape == (3, 1)


def test_the_fallback_is_the_plan_that_was_carried():
    planner, carried = make_planner(Line(torch.nan)), torch.tensor([[[0.9], [0.25]]])
    plan = planner.plan(torch.zeros(1, 1), carried, explore=False)
    assert plan.fallback.all() and plan.value.isnan().all()
    assert plan.action.item() == plan.loc.item() == 0.25  # of the step after
    assert plan.scale.item() == planner.std_max
    assert planner.plan(torch.zeros(1, 1), explore=False).action.item() == 0


def test_what_needs_a_policy_says_so():
    with pytest.raises(ValueError, match=r"^num_proposals must be 0 for a model without a policy \(Line\), got 24\.$"):
        EnsembleMPPIPlanner(LatentEnv(Line()))
    message = r" needs a model with a policy, got Line without policy and act\.$"
    for name, needy in {"BarePolicy": BarePolicy, "export_policy": export_policy}.items():
        with pytest.raises(TypeError, match=f"^{name}{message}"):
            needy(Line())


def test_proposals_that_are_asked_for_later_need_a_policy_too():
    planner = make_planner(Line())
    planner.num_proposals = 4
    with pytest.raises(TypeError, match=r"^num_proposals=4 needs a model with a policy, got Line without"):
        planner.plan(torch.zeros(1, 1))


def test_an_activation_called_act_is_no_policy():
    model = Line()
    model.act = nn.Mish()
    assert not has_policy(model)
    assert make_planner(model).plan(torch.zeros(1, 1), explore=False).action.shape == (1, 1)


def test_a_search_cannot_begin_at_a_policy_that_is_not_there():
    with pytest.raises(ValueError, match=r"^initial must be 'wide' for a model without a policy \(Line\), got 'po"):
        EnsembleMPPIPlanner(LatentEnv(Line()), initial="policy", **START)
