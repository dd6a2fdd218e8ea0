from __future__ import annotations

import copy
import pickle
import warnings

import pytest
import torch
from tensordict import TensorDict
from torch._dynamo.testing import CompileCounter
from torchrl.collectors import Collector
from torchrl.envs import ExplorationType
from torchrl.envs.utils import set_exploration_type

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


@pytest.mark.parametrize("kind", [ExplorationType.DETERMINISTIC, ExplorationType.RANDOM])
def test_noise_that_is_added_to_an_action_in_place_does_not_move_the_target(make_planner, states, kind):
    with set_exploration_type(kind):
        out = make_planner()(TensorDict({"observation": states(3)}, [3]))
    target = out["plan", "loc"].clone()
    out["action"].add_(1.0)
    assert torch.equal(out["plan", "loc"], target)


@pytest.mark.parametrize("explore", [True, False])
@pytest.mark.parametrize("kind", [ExplorationType.DETERMINISTIC, ExplorationType.RANDOM])
def test_a_planner_that_was_told_whether_to_explore_asks_nobody(make_planner, states, kind, explore):
    """The exploration type is one for all threads of a process, and a loss beside sets it."""
    planner = make_planner()
    planner.explore = explore
    with set_exploration_type(kind):
        out = copy.deepcopy(planner)(TensorDict({"observation": states(3)}, [3]))
    assert torch.equal(out["action"], out["plan", "loc"]) != explore


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


def test_a_planner_that_a_collector_held_is_pickled(make_planner, make_model):
    planner = make_planner(make_model().float())
    collector = Collector(
        planner.env, planner, frames_per_batch=2, total_frames=2, auto_register_policy_transforms=True
    )
    next(iter(collector))
    collector.shutdown()
    other = pickle.loads(pickle.dumps(planner))
    assert other.env.collector is None
    assert other.env.rollout(2).shape == (2,)


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
    first = planner.plan(observation, noise=noise, trace=True)
    assert all(torch.equal(value, before[name]) for name, value in model.state_dict().items())
    assert first.action.dtype == torch.float32
    with torch.no_grad():
        model.reward_head.output.bias[-1] += 5  # the highest bin: the same candidates are worth more
    assert (planner.plan(observation, noise=noise, trace=True).trace.returns > first.trace.returns)[:, 0].all()


def test_a_scoring_dtype_can_be_named(make_planner, make_model, states, assert_same_plan):
    model, observation = make_model().float(), states(2).float()
    by_name, by_dtype = (make_planner(model, scoring_dtype=dtype) for dtype in ("bfloat16", torch.bfloat16))
    assert by_name.scoring_dtype == torch.bfloat16
    noise = by_name.draw_noise(2)
    assert_same_plan(by_name.plan(observation, noise=noise), by_dtype.plan(observation, noise=noise))


def test_scoring_in_the_weights_own_dtype_is_no_other_computation(make_planner, make_model, states):
    model, observation = make_model(), states(3)
    plain, named = make_planner(model), make_planner(model, scoring_dtype="float64")
    noise = plain.draw_noise(3)
    expected, plan = (planner.plan(observation, noise=noise) for planner in (plain, named))
    for name in Plan._fields[:-1]:
        assert torch.equal(getattr(plan, name), getattr(expected, name)), name


def test_a_compiled_plan_is_called_in_the_place_of_plan_and_leaves_it_alone(make_planner, states):
    planner, td = make_planner(), TensorDict({"observation": states(3)}, batch_size=[3])
    calls, method = [], planner.plan

    def compiled(observation, plan_mean, **options):
        calls.append(set(options))
        return method(observation, plan_mean, **options)._replace(action=torch.full((3, 2), 0.5))

    assert planner.compiled_plan is None
    planner.compiled_plan = compiled
    assert (planner(td.clone())["action"] == 0.5).all()
    assert calls == [{"latent", "explore"}]
    assert (planner.plan(td["observation"]).action != 0.5).all()
    assert planner.plan == method
    assert planner.state_dict().keys() == make_planner().state_dict().keys()
    planner.compiled_plan = None
    assert (planner(td.clone())["action"] != 0.5).any()
    assert len(calls) == 1


def test_a_copy_starts_without_what_was_compiled_for_the_original(make_planner, states):
    planner, td = make_planner(), TensorDict({"observation": states(3)}, batch_size=[3])

    def compiled(*inputs, **options):
        raise AssertionError("the original's compiled plan was called")

    planner.compiled_plan = compiled
    for other in (copy.deepcopy(planner), pickle.loads(pickle.dumps(planner))):
        assert other.compiled_plan is None
        assert other(td.clone())["action"].isfinite().all()
    assert planner.compiled_plan is compiled


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
