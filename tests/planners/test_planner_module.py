from __future__ import annotations

import copy
import pickle
import warnings

import pytest
import torch
from tensordict import TensorDict
from torch._dynamo.testing import CompileCounter

from torchrl_etdmpc import Plan
from torchrl_etdmpc.planners import PlanNoise


def test_the_state_dict_lists_the_weights_once(make_planner, make_model):
    model = make_model()
    planner = make_planner(model)
    weights = {tensor.data_ptr() for tensor in model.state_dict().values()}
    saved = planner.state_dict()
    assert len(saved) == len(model.state_dict()) == len(weights)
    assert {tensor.data_ptr() for tensor in saved.values()} == weights
    assert len(list(TensorDict.from_module(planner).keys(True, True))) == len(model.state_dict())


def test_the_weights_are_shared_with_the_world_model(make_planner, make_model, states):
    model, observation = make_model(), states(3)
    planner = make_planner(model)
    assert planner.world_model is model
    assert [id(weight) for weight in planner.parameters()] == [id(weight) for weight in model.parameters()]
    noise = planner.draw_noise(3)
    before = planner.plan(observation, noise=noise).value
    with torch.no_grad():
        for weight in model.value_head.parameters():
            weight.add_(torch.randn_like(weight))
    assert not torch.allclose(planner.plan(observation, noise=noise).value, before)


def test_a_copy_plans_with_weights_of_its_own(make_planner, states, assert_same_plan):
    planner, observation = make_planner(), states(3)
    noise = planner.draw_noise(3)
    before = planner.plan(observation, noise=noise)
    for other in (copy.deepcopy(planner), pickle.loads(pickle.dumps(planner))):
        assert other.world_model is other.module.world_model is not planner.world_model
        assert_same_plan(other.plan(observation, noise=noise), before)
        with torch.no_grad():
            for weight in other.parameters():
                weight.mul_(2)
    assert_same_plan(planner.plan(observation, noise=noise), before)


@pytest.mark.parametrize("convert", [lambda planner: planner.double(), lambda planner: planner.to(torch.float64)])
def test_the_dtype_is_that_of_the_world_model(convert, make_planner, make_model, states):
    planner = convert(make_planner(make_model().float(), warm_start=True))
    td = TensorDict({"observation": states(2), "is_init": torch.ones(2, 1, dtype=torch.bool)}, batch_size=[2])
    out = planner(planner(td).exclude("next").set("plan_mean", td["next", "plan_mean"]))
    floats = ["action", ("plan", "loc"), ("plan", "scale"), ("plan", "value"), ("next", "plan_mean")]
    assert {out[key].dtype for key in floats} == {torch.float64}


def test_precision_makes_no_difference_to_the_first_returns(make_planner, make_model, states):
    model, observation = make_model(), states(2)
    planner = make_planner(model)
    noise = planner.draw_noise(2)
    exact = planner.plan(observation, noise=noise, trace=True).trace
    planner.float()
    rough = planner.plan(observation.float(), noise=PlanNoise(*(d.float() for d in noise)), trace=True).trace
    torch.testing.assert_close(rough.returns[:, 0].double(), exact.returns[:, 0], atol=1e-3, rtol=1e-3)


def test_candidates_scored_in_half_precision_are_ranked_nearly_alike(make_planner, make_model, states):
    model, observation = make_model(), states(3).float()
    model.float()
    plain, half = make_planner(model), make_planner(model, scoring_dtype=torch.bfloat16)
    noise = PlanNoise(*(draw.float() for draw in plain.draw_noise(3)))
    exact, rough = (planner.plan(observation, noise=noise, trace=True).trace for planner in (plain, half))
    assert rough.returns.dtype == rough.scores.dtype == rough.actions.dtype == torch.float32
    assert not torch.equal(rough.returns[:, 0], exact.returns[:, 0])
    spread = exact.returns[:, 0].std()
    assert (rough.returns[:, 0] - exact.returns[:, 0]).square().mean().sqrt() < 0.05 * spread
    for one, other in zip(rough.scores[:, 0], exact.scores[:, 0], strict=True):
        assert torch.corrcoef(torch.stack([one, other]))[0, 1] > 0.99


def test_half_precision_leaves_the_weights_as_they_are_and_follows_them(make_planner, make_model, states):
    model, observation = make_model(), states(2).float()
    model.float()
    planner = make_planner(model, scoring_dtype=torch.bfloat16)
    before = {name: value.clone() for name, value in model.state_dict().items()}
    noise = PlanNoise(*(draw.float() for draw in planner.draw_noise(2)))
    first = planner.plan(observation, noise=noise)
    assert all(torch.equal(value, before[name]) for name, value in model.state_dict().items())
    assert first.action.dtype == torch.float32
    with torch.no_grad():
        model.reward_head.output.bias[-1] += 5
    assert (planner.plan(observation, noise=noise).value > first.value).all()


def test_one_compiled_graph_plans_as_eager_code_does(make_planner, states):
    # The backend runs the traced graph as it is, in double precision; only mish is written otherwise there.
    counter = CompileCounter()
    planner, observation = make_planner(score="adaptive", beta=1.0, iterations=2), states(3)
    carried, noise = torch.rand(3, 3, 2, dtype=torch.float64), planner.draw_noise(3)
    compiled = torch.compile(planner.plan, fullgraph=True, backend=counter)
    for _ in range(2):
        plan = compiled(observation, carried, noise=noise)
        expected = planner.plan(observation, carried, noise=noise)
        for name in Plan._fields[:-1]:
            torch.testing.assert_close(getattr(plan, name), getattr(expected, name), rtol=1e-10, atol=1e-12, msg=name)
    assert counter.frame_count == 1


@pytest.mark.slow
def test_a_plan_compiled_to_kernels_is_that_of_eager_code(make_planner, states, assert_same_plan):
    planner, observation = make_planner(horizon=2, iterations=1), states(3)
    noise = planner.draw_noise(3)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the compiler, about the machine
        compiled = torch.compile(planner.plan, fullgraph=True)(observation, noise=noise)
    assert_same_plan(compiled, planner.plan(observation, noise=noise))
