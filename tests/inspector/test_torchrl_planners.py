from __future__ import annotations

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.data import Composite, Unbounded
from torchrl.envs.model_based import ModelBasedEnvBase
from torchrl.modules import CEMPlanner, MPPIPlanner, ValueOperator, WorldModelWrapper
from torchrl.objectives.value import TDLambdaEstimator

from torchrl_etdmpc.inspector import figures, load_trace, trace_torchrl_planner

BUDGET = {"planning_horizon": 4, "optim_steps": 3, "num_candidates": 20, "top_k": 5}


class Line(ModelBasedEnvBase):
    """A point in a plane that each action moves; the reward is minus its distance to the origin."""

    def __init__(self) -> None:
        move = TensorDictModule(lambda x, action: x + 0.5 * action, in_keys=["x", "action"], out_keys=["x"])
        reward = TensorDictModule(lambda x: -x.square().sum(-1, keepdim=True), in_keys=["x"], out_keys=["reward"])
        super().__init__(WorldModelWrapper(move, reward), batch_size=[])
        self.state_spec = Composite(x=Unbounded((2,)))
        self.observation_spec = Composite(x=Unbounded((2,)))
        self.action_spec = Unbounded((2,))
        self.reward_spec = Unbounded((1,))

    def _reset(self, tensordict: TensorDict | None) -> TensorDict:
        return self.full_observation_spec.zero()


def cem() -> CEMPlanner:
    return CEMPlanner(Line(), **BUDGET)


def mppi() -> MPPIPlanner:
    value = ValueOperator(torch.nn.Linear(2, 1), in_keys=["x"])
    return MPPIPlanner(Line(), TDLambdaEstimator(gamma=0.9, lmbda=0.9, value_network=value), temperature=1.0, **BUDGET)


STATE = TensorDict({"x": torch.tensor([0.5, -0.5])}, [])


@pytest.mark.parametrize("make", [cem, mppi])
def test_a_trace_holds_the_planner_s_own_numbers(make):
    torch.manual_seed(0)
    planner = make()
    random = torch.get_rng_state()
    trace = trace_torchrl_planner(planner, STATE, seed=3, task="line")
    assert torch.equal(torch.get_rng_state(), random)
    torch.manual_seed(3)
    action = planner.planning(STATE[None])[0]
    np.testing.assert_allclose(trace["action"], action.detach(), atol=1e-6)
    np.testing.assert_allclose(trace["mean"][-1, 0], action.detach(), atol=1e-6)  # refitted from the elites
    assert trace["actions"].shape == (3, 20, 4, 2)
    assert trace.manifest["settings"]["top_k"] == 5
    assert trace.manifest["task"] == "line"


@pytest.mark.parametrize("make", [cem, mppi])
def test_what_acts_is_the_last_mean_and_its_value_and_deviation_are_of_the_weighted_elites(make):
    torch.manual_seed(0)
    trace = trace_torchrl_planner(make(), STATE)
    assert np.array_equal(trace["chosen_actions"], trace["mean"][-1])
    ranked = np.take_along_axis(trace["scores"], trace["elites"], 1)
    weights = np.exp(ranked - ranked.max(1, keepdims=True)) if make is mppi else np.ones_like(ranked)
    weights /= weights.sum(1, keepdims=True)
    np.testing.assert_allclose(trace["elite_weights"], weights, atol=1e-5)
    assert trace["value"] == pytest.approx((weights[-1] * ranked[-1]).sum(), rel=1e-4)
    best = np.take_along_axis(trace["actions"], trace["elites"][..., None, None], 1)
    variance = (weights[..., None, None] * np.square(best - trace["mean"][:, None])).sum(1)
    bessel = 5 / 4 if make is cem else 1.0
    np.testing.assert_allclose(trace["std"], np.sqrt(variance * bessel), atol=1e-5)


def test_where_mppi_s_weights_overflow_the_trace_has_its_nan():
    planner = mppi()
    planner.temperature = torch.tensor(1e4)
    trace = trace_torchrl_planner(planner, STATE, seed=3)
    torch.manual_seed(3)
    assert planner.planning(STATE[None]).isnan().all()
    assert np.isfinite(trace["scores"][0]).all()
    assert np.isnan(trace["mean"][0]).all() and np.isnan(trace["elite_weights"][0]).any()


def test_cem_s_scores_are_the_imagined_rewards():
    trace = trace_torchrl_planner(cem(), STATE)
    places = STATE["x"].numpy() + 0.5 * trace["actions"].cumsum(2)
    np.testing.assert_allclose(trace["scores"], -np.square(places).sum((2, 3)), atol=1e-4)
    assert np.array_equal(trace["returns"][..., 0, 0, 0], trace["scores"])
    across = np.take_along_axis(trace["actions"][0], trace["elites"][0][:, None, None], 0)
    np.testing.assert_allclose(across.std(0, ddof=1), trace["std"][0], atol=1e-5)
    reached = (places - trace["centre"]) @ trace["basis"].T
    np.testing.assert_allclose(trace["points"][:, :, :, 0], reached, atol=1e-4)


@pytest.mark.parametrize("make", [cem, mppi])
def test_what_a_planner_lacks_is_absent(make, tmp_path):
    trace = trace_torchrl_planner(make(), STATE)
    lacking = {"mixture", "policy_action", "policy_scores", "chosen_returns", "chosen_rewards", "warm_start", "scale"}
    assert not lacking & trace.arrays.keys()
    assert ("returns" in trace.arrays) == (make is cem)
    assert not trace["proposals"].any()
    again = load_trace(trace.save(tmp_path / "trace.npz"))
    pytest.importorskip("plotly")
    for name in figures.FIGURES:
        assert getattr(figures, name)(again).to_json()


def test_other_planners_and_batches_are_refused():
    with pytest.raises(TypeError, match="planner must be TorchRL's CEMPlanner or MPPIPlanner, got Linear"):
        trace_torchrl_planner(torch.nn.Linear(1, 1), STATE)
    with pytest.raises(ValueError, match=r"state must be one state, got the batch size \[1\]"):
        trace_torchrl_planner(cem(), STATE[None])
