from __future__ import annotations

import copy
import math
import pickle
import warnings

import pytest
import torch
from tensordict import TensorDict
from torch._dynamo.testing import CompileCounter
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_etdmpc import EnsembleMPPIPlanner, FinalScore, LatentEnv, Plan, PlanTrace, WorldModel
from torchrl_etdmpc.functional import shift_plan
from torchrl_etdmpc.planners import PlanNoise
from torchrl_etdmpc.testing import LineWorld, LQRWorld

_MODES = ("elite", "mean", "best")
_WIDE = {"proposal_log_std_min": -2.0, "proposal_log_std_max": 1.0}
_WARNING = (
    "^'plan_mean' is not in the planner's input, so every plan starts cold; append planner.make_tensordict_primer"
)


@pytest.fixture(autouse=True)
def _seed():
    torch.manual_seed(0)


def make_planner(world=None, **options) -> EnsembleMPPIPlanner:
    """A small planner that starts cold, unless told otherwise."""
    small = {"horizon": 3, "num_samples": 24, "num_elites": 6, "num_proposals": 5, "iterations": 3, "warm_start": False}
    return EnsembleMPPIPlanner(LatentEnv(make_model() if world is None else world), **{**small, **options})


def make_model(**options) -> WorldModel:
    """A small float64 world model in which rewards, values and heads differ."""
    sizes = {"latent_dim": 16, "mlp_dim": 16, "encoder_dim": 16, "num_dynamics": 2, "num_values": 2}
    model = WorldModel(3, 2, **{**sizes, **options})
    for head in (model.reward_head, model.value_head, model.policy):
        torch.nn.init.normal_(head.output.weight, std=0.5)
    return model.double()


def states(*batch_size: int) -> torch.Tensor:
    return torch.randn(*batch_size, 3, dtype=torch.float64)


def rows(noise: PlanNoise, index) -> PlanNoise:
    return PlanNoise(*(draw[index] for draw in noise))


def assert_same_plan(plan: Plan, expected: Plan) -> None:
    for name in Plan._fields[:-1]:
        torch.testing.assert_close(
            getattr(plan, name), getattr(expected, name), equal_nan=True, msg=lambda text, name=name: f"{name}: {text}"
        )


def count_calls(monkeypatch, world, name: str) -> list[tuple]:
    """The shapes of the first argument of every call of a method of the world, from now on."""
    method, shapes = getattr(world, name), []

    def counted(latent, *arguments):
        shapes.append(tuple(latent.shape))
        return method(latent, *arguments)

    monkeypatch.setattr(world, name, counted)
    return shapes


# The optimum of analytic worlds


_HEADS = {"num_dynamics": 3, "num_values": 2, "value_offset": torch.tensor([1.0, -1.0])}
_LINE_STATES, _LQR_STATES = [[0.0], [-2.0], [0.5]], [[0.4, 0.2], [-0.3, 0.5], [0.0, 0.1]]
_OPTIMA = {
    "line": (lambda: LineWorld(goal=0.3), _LINE_STATES),
    "drifting line": (
        lambda: LineWorld(goal=0.3, drift=torch.tensor([[0.1], [0.0], [-0.1]]), **_HEADS),
        _LINE_STATES,
    ),
    "lqr": (lambda: LQRWorld(), _LQR_STATES),
    "drifting lqr": (
        lambda: LQRWorld(drift=torch.tensor([[0.1, 0.0], [0.0, 0.1], [-0.1, -0.1]]), **_HEADS),
        _LQR_STATES,
    ),
}


@pytest.mark.parametrize("mode", _MODES)
@pytest.mark.parametrize("score", ["final", "mean"])
@pytest.mark.parametrize("name", _OPTIMA)
def test_the_planner_finds_the_known_optimum(name, score, mode):
    make_world, start = _OPTIMA[name]
    world, start = make_world(), torch.tensor(start)
    planner = make_planner(
        world, horizon=4, num_samples=256, num_elites=32, iterations=6, score=score, eval_first_action=mode
    )
    plan = planner.plan(start, explore=False, trace=True)
    torch.testing.assert_close(plan.loc, world.optimal_action(start), atol=0.1, rtol=0)
    torch.testing.assert_close(plan.mean, world.optimal_actions(start, 4), atol=0.15, rtol=0)
    assert not plan.fallback.any()


@pytest.mark.parametrize("name", ["line", "lqr"])
def test_drifts_that_cancel_do_not_move_the_plan(name):
    start = torch.tensor(_OPTIMA[name][1])
    calm, drifting = (make_planner(_OPTIMA[key][0](), score="mean") for key in (name, f"drifting {name}"))
    noise = calm.draw_noise(3)
    torch.testing.assert_close(
        drifting.plan(start, noise=noise).mean, calm.plan(start, noise=noise).mean, atol=1e-3, rtol=0
    )


@pytest.mark.parametrize("score", ["final", "mean", "adaptive"])
def test_a_penalty_avoids_what_a_single_head_hallucinates(score):
    world = LineWorld(goal=0.3, num_dynamics=4, trap=(-1.0, -0.5))
    start = torch.tensor([[0.0], [0.1]])
    options = {"num_samples": 256, "num_elites": 32, "iterations": 6, "score": score}
    fooled = make_planner(world, **options).plan(start, explore=False)
    assert (fooled.loc <= -0.5).all()
    careful = make_planner(world, **options, beta=10.0).plan(start, explore=False)
    torch.testing.assert_close(careful.loc, world.optimal_action(start), atol=0.1, rtol=0)


def test_an_objective_of_ones_own_is_one_function():
    world = LineWorld(goal=0.3, num_dynamics=4, trap=(-1.0, -0.5))
    shapes = []

    def worst_head(returns):
        shapes.append(returns.shape)
        return returns[..., -1, :, :].amin((-2, -1))

    planner = make_planner(world, num_samples=256, num_elites=32, iterations=6, score=worst_head)
    plan = planner.plan(torch.zeros(1, 1), explore=False)
    torch.testing.assert_close(plan.loc, torch.tensor([[0.6]]), atol=0.1, rtol=0)
    assert set(shapes) == {(1, 256, 3, 4, 1), (1, 251, 3, 4, 1)}  # the proposals are scored once


def test_an_objective_that_needs_the_last_depth_only_can_say_so():
    def last(returns):
        assert returns.shape[-3] == 1
        return returns.mean((-3, -2, -1))

    last.depths = "last"
    planner, named = make_planner(LineWorld(), score=last), make_planner(LineWorld(), score="final")
    noise = planner.draw_noise(1)
    assert_same_plan(planner.plan(torch.zeros(1, 1), noise=noise), named.plan(torch.zeros(1, 1), noise=noise))


def test_an_objective_of_the_wrong_shape_is_answered_with_the_right_one():
    planner = make_planner(LineWorld(), score=lambda returns: returns.mean(-1))
    with pytest.raises(
        ValueError,
        match=r"^score must reduce the return table \[1, 24, 3, 1, 1\] to \[1, 24\], got \[1, 24, 3, 1\]\.$",
    ):
        planner.plan(torch.zeros(1, 1))


# Return estimates


def naive_table(model, observation, actions, discount) -> torch.Tensor:
    """Return table ``[H, F, V]`` of one sequence ``[H, A]`` by plain loops; every head rolls on alone."""
    table = torch.zeros(len(actions), model.num_dynamics, model.num_values, dtype=torch.float64)
    for head in range(model.num_dynamics):
        latent, total, alive = model.encode(observation), 0.0, 1.0
        for step, action in enumerate(actions):
            total += discount**step * alive * model.reward(latent, action).item()
            latent = model.next(latent.unsqueeze(0), action)[head]
            ended = model.termination(latent)
            alive *= 1.0 if ended is None else 1 - ended.item()
            for member, value in enumerate(model.values(latent).tolist()):
                table[step, head, member] = total + discount ** (step + 1) * alive * value
    return table


@pytest.mark.parametrize("termination", [False, True])
def test_every_return_estimate_is_that_of_a_head_on_its_own_rollout(termination):
    model = make_model(termination=termination)
    planner = make_planner(model, num_samples=6, num_elites=3, num_proposals=2, iterations=2, discount=0.9)
    observation = states(2)
    trace = planner.plan(observation, trace=True).trace
    assert trace.returns.shape == (2, 2, 6, 3, 2, 2)
    with torch.no_grad():
        for state in range(2):
            for iteration in range(2):
                for sequence in range(6):
                    actions = trace.actions[state, iteration, sequence]
                    expected = naive_table(model, observation[state], actions, 0.9)
                    torch.testing.assert_close(trace.returns[state, iteration, sequence], expected)
    # The table has something to get wrong: heads, depths and candidates all differ.
    assert all(trace.returns.std(dim).min() > 1e-6 for dim in (2, 3, 4, 5))


def bmpc_return(model, observation, actions, discount) -> float:
    """Return estimate of one sequence ``[H, A]`` with one model and one value: BMPC's."""
    latent, total = model.encode(observation), 0.0
    for step, action in enumerate(actions):
        total += discount**step * model.reward(latent, action).item()
        latent = model.next(latent.unsqueeze(0), action).squeeze(0)
    return total + discount ** len(actions) * model.values(latent).item()


def test_one_head_one_depth_is_bmpc():
    model = make_model(num_dynamics=1, num_values=1)
    planner = make_planner(model, num_samples=8, num_proposals=2, num_elites=4, iterations=2, score="final", beta=7.0)
    observation = states(2)
    trace = planner.plan(observation, trace=True).trace
    with torch.no_grad():
        expected = [
            [[bmpc_return(model, start, actions, 0.99) for actions in candidates] for candidates in iterations]
            for start, iterations in zip(observation, trace.actions, strict=True)
        ]
    torch.testing.assert_close(trace.scores, torch.tensor(expected, dtype=torch.float64))


def test_mean_objective_with_horizon_one_equals_final():
    model, observation = make_model(), states(4)
    mean, final = (make_planner(model, horizon=1, score=score, beta=2.0) for score in ("mean", "final"))
    noise = mean.draw_noise(4)
    assert_same_plan(mean.plan(observation, noise=noise), final.plan(observation, noise=noise))


def test_adaptive_objective_without_penalty_takes_the_best_depth():
    trace = make_planner(score="adaptive").plan(states(2), trace=True).trace
    torch.testing.assert_close(trace.scores, trace.returns.mean((-2, -1)).amax(-1))
    assert trace.returns.mean((-2, -1)).argmax(-1).unique().numel() > 1


def test_scores_of_named_objectives_are_those_of_the_table():
    for score, beta in (("final", 3.0), ("mean", 3.0)):
        trace = make_planner(score=score, beta=beta).plan(states(2), trace=True).trace
        averaged = trace.returns.mean(-3).flatten(-2)  # one depth only, with "final"
        sigma = averaged.std(-1) / 2  # of the mean of four estimates
        torch.testing.assert_close(trace.scores, averaged.mean(-1) - beta * sigma)


def test_final_computes_values_at_the_last_depth_only(monkeypatch):
    model, observation = make_model(), states(2)
    final = make_planner(model, score="final", beta=1.0)
    full = make_planner(model, score=lambda returns: FinalScore(1.0)(returns))
    noise = final.draw_noise(2)
    calls = count_calls(monkeypatch, model, "values")
    cheap = final.plan(observation, noise=noise, trace=True)
    assert [shape[0] for shape in calls] == [1] * 3  # one depth in every iteration
    calls.clear()
    dear = full.plan(observation, noise=noise, trace=True)
    assert [shape[0] for shape in calls] == [3] * 3
    assert cheap.trace.returns.shape[-3:] == (1, 2, 2)
    torch.testing.assert_close(cheap.trace.returns, dear.trace.returns[..., -1:, :, :])
    torch.testing.assert_close(cheap.trace.scores, dear.trace.scores)
    assert_same_plan(cheap, dear)


class CliffWorld(LineWorld):
    """A line world in which episodes tend to terminate on the way to the goal."""

    def termination(self, latent):
        return 0.5 * latent[..., 0].clamp(0, 1)


@pytest.mark.parametrize(("score", "expected"), [("final", [-3.22875]), ("mean", [-3.76875, -3.22875])])
def test_returns_are_weighted_by_the_probability_of_being_alive(score, expected):
    # From 0, two actions of 1 lead to 0.5 and 1, where the episode has ended with probability 0.25 and 0.5.
    # Rewards -1.5^2 and -1, values -1.5^2 and -1:
    # Q_1 = -2.25 - 0.9 * 0.75 * 2.25 and Q_2 = -2.25 - 0.9 * 0.75 * 1 - 0.81 * 0.75 * 0.5 * 1.
    planner = make_planner(CliffWorld(goal=2.0), horizon=2, num_proposals=0, iterations=1, discount=0.9, score=score)
    noise = planner.draw_noise(1)
    noise = noise._replace(candidates=torch.full_like(noise.candidates, 10.0))
    trace = planner.plan(torch.zeros(1, 1), noise=noise, trace=True).trace
    assert trace.actions.eq(1).all()
    assert trace.returns[0, 0, 0].flatten().tolist() == pytest.approx(expected)
    assert trace.scores[0, 0, 0].item() == pytest.approx(sum(expected) / len(expected))


def test_termination_is_weighed_on_each_heads_own_rollout():
    world = CliffWorld(goal=2.0, num_dynamics=2, drift=torch.tensor([[0.3], [-0.3]]))
    trace = make_planner(world, num_samples=6, num_elites=3, num_proposals=2).plan(torch.zeros(1, 1), trace=True).trace
    for actions, returns in zip(trace.actions[0, -1], trace.returns[0, -1], strict=True):
        expected = naive_table(world, torch.zeros(1), actions, 0.99).float()
        torch.testing.assert_close(returns, expected)


# Batches


def test_planning_a_batch_is_planning_each_state_alone():
    planner = make_planner(score="final", beta=1.0)
    observation, carried = states(5), 0.5 * torch.randn(5, 3, 2, dtype=torch.float64)
    noise = planner.draw_noise(5)
    together = planner.plan(observation, carried, noise=noise, trace=True)
    for i in range(5):
        alone = planner.plan(observation[i], carried[i], noise=rows(noise, i), trace=True)
        assert_same_plan(alone, Plan(*(field[i] for field in together[:-1]), None))
        for name in PlanTrace._fields:
            torch.testing.assert_close(getattr(alone.trace, name), getattr(together.trace, name)[i])


@pytest.mark.parametrize("explore", [True, False])
@pytest.mark.parametrize("batch_size", [(), (1,), (5,), (2, 3), (2, 1, 2)])
def test_any_leading_batch_is_planned(batch_size, explore):
    planner = make_planner()
    size = math.prod(batch_size)
    observation, carried = states(size), torch.rand(size, 3, 2, dtype=torch.float64)
    noise = planner.draw_noise(size)
    flat = planner.plan(observation, carried, noise=noise, explore=explore, trace=True)

    def fold(tensor):
        return tensor.reshape(batch_size + tensor.shape[1:])

    folded = PlanNoise(*(fold(draw) for draw in noise))
    assert all(a.shape == b.shape for a, b in zip(planner.draw_noise(*batch_size), folded, strict=True))
    plan = planner.plan(fold(observation), fold(carried), noise=folded, explore=explore, trace=True)
    assert_same_plan(plan, Plan(*(fold(field) for field in flat[:-1]), None))
    for field, expected in zip(plan.trace, flat.trace, strict=True):
        torch.testing.assert_close(field, fold(expected))
    shapes = {"action": (2,), "loc": (2,), "scale": (2,), "value": (), "mean": (3, 2), "fallback": ()}
    assert {name: getattr(plan, name).shape for name in shapes} == {
        name: batch_size + shape for name, shape in shapes.items()
    }
    shapes = {"actions": (3, 24, 3, 2), "scores": (3, 24), "returns": (3, 24, 3, 2, 2), "mean": (3, 3, 2)}
    assert {name: getattr(plan.trace, name).shape for name in shapes} == {
        name: batch_size + shape for name, shape in shapes.items()
    }


@pytest.mark.parametrize("strange", [3.0, torch.nan])
def test_a_state_does_not_leak_into_the_others(strange):
    planner = make_planner()
    observation, carried = states(3), torch.rand(3, 3, 2, dtype=torch.float64)
    noise = planner.draw_noise(3)
    before = planner.plan(observation, carried, noise=noise)
    observation[1], carried[1] = strange, strange
    after = planner.plan(observation, carried, noise=noise)
    for old, new in zip(before[:-1], after[:-1], strict=True):
        torch.testing.assert_close(old[[0, 2]], new[[0, 2]])
    assert not torch.equal(before.loc[1], after.loc[1])


def test_a_latent_can_take_the_place_of_the_observation():
    model, observation = make_model(), states(4)
    planner = make_planner(model)
    noise = planner.draw_noise(4)
    latent = model.encode(observation)
    assert_same_plan(planner.plan(latent=latent, noise=noise), planner.plan(observation, noise=noise))


def test_an_observation_beside_a_latent_is_refused_unless_latents_are_not_read():
    # A rollout in the latent env keeps the observation that it began with; a pipeline may carry a stale latent.
    model, observation = make_model(), states(3)
    td = TensorDict({"observation": observation, "latent": model.encode(states(3))}, batch_size=[3])
    with pytest.raises(ValueError, match="found both 'observation' and 'latent'"):
        run(make_planner(model), td)
    out = run(make_planner(model, latent_key=None), td)
    torch.testing.assert_close(out["plan", "loc"], expected_plan(make_planner(model), observation, None).loc)


def test_the_key_of_the_latent_can_be_renamed():
    model, observation = make_model(), states(3)
    td = TensorDict({"agent": {"z": model.encode(observation)}, "latent": states(3)}, batch_size=[3])
    out = run(make_planner(model, latent_key=("agent", "z")), td)
    torch.testing.assert_close(out["plan", "loc"], expected_plan(make_planner(model), observation, None).loc)


# Warm start


def run(planner, tensordict, *, seed: int = 0):
    """The planner's output on a copy of the input, with seeded noise."""
    torch.manual_seed(seed)
    return planner(tensordict.clone())


def expected_plan(planner, observation, carried, *, seed: int = 0) -> Plan:
    """The same from ``plan``."""
    torch.manual_seed(seed)
    return planner.plan(observation, carried, explore=False, noise=planner.draw_noise(len(observation)))


def test_the_first_candidates_are_drawn_around_the_shifted_previous_plan():
    planner = make_planner(warm_start=True)
    previous = torch.rand(2, 3, 2, dtype=torch.float64) * 2 - 1
    noise = planner.draw_noise(2)
    trace = planner.plan(states(2), previous, noise=noise, trace=True).trace
    shifted = torch.cat([previous[:, 1:], torch.zeros(2, 1, 2)], dim=1)
    drawn = (shifted[:, None] + 2.0 * noise.candidates[:, 0]).clamp(-1, 1)
    torch.testing.assert_close(trace.actions[:, 0, 5:], drawn)


def test_the_carried_plan_is_the_mean_of_the_last_iteration():
    plan = make_planner().plan(states(2), trace=True)
    assert torch.equal(plan.mean, plan.trace.mean[:, -1])


def test_the_start_of_an_episode_zeroes_that_environments_plan_only():
    planner, observation = make_planner(warm_start=True), states(3)
    carried = torch.rand(3, 3, 2, dtype=torch.float64)
    is_init = torch.tensor([[False], [True], [False]])
    td = TensorDict({"observation": observation, "plan_mean": carried, "is_init": is_init}, batch_size=[3])
    expected = expected_plan(planner, observation, carried * torch.tensor([1.0, 0.0, 1.0])[:, None, None])
    out = run(planner, td)
    torch.testing.assert_close(out["plan", "loc"], expected.loc)
    torch.testing.assert_close(out["next", "plan_mean"], expected.mean)
    # Every part of it matters: the plan is another one with other starts.
    for other in (carried, torch.zeros_like(carried)):
        assert not torch.allclose(expected_plan(planner, observation, other).mean, expected.mean)


def test_a_carried_plan_needs_no_episode_flag():
    planner, observation = make_planner(warm_start=True), states(2)
    carried = torch.rand(2, 3, 2, dtype=torch.float64)
    out = run(planner, TensorDict({"observation": observation, "plan_mean": carried}, batch_size=[2]))
    torch.testing.assert_close(out["next", "plan_mean"], expected_plan(planner, observation, carried).mean)


def test_an_episode_flag_alone_starts_cold_and_carries_on():
    planner, observation = make_planner(warm_start=True), states(2)
    td = TensorDict({"observation": observation, "is_init": torch.ones(2, 1, dtype=torch.bool)}, batch_size=[2])
    out = run(planner, td)
    torch.testing.assert_close(out["next", "plan_mean"], expected_plan(planner, observation, None).mean)


def test_a_plan_that_was_lost_within_an_episode_is_warned_of_once():
    planner, observation = make_planner(warm_start=True), states(2)
    td = TensorDict({"observation": observation, "is_init": torch.tensor([[True], [False]])}, batch_size=[2])
    with pytest.warns(UserWarning, match=_WARNING):
        run(planner, td)
    out = run(planner, td)  # warnings are errors here
    torch.testing.assert_close(out["next", "plan_mean"], expected_plan(planner, observation, None).mean)


def test_with_neither_key_every_plan_is_cold_and_the_planner_warns_once():
    planner, observation = make_planner(warm_start=True), states(2)
    td = TensorDict({"observation": observation}, batch_size=[2])
    with pytest.warns(UserWarning, match=_WARNING):
        out = run(planner, td)
    for _ in range(2):
        torch.testing.assert_close(out["plan", "loc"], expected_plan(planner, observation, None).loc)
        assert ("next", "plan_mean") not in out.keys(True)
        out = run(planner, td)  # warnings are errors here


def test_without_warm_start_nothing_is_read_written_or_warned_of():
    planner, observation = make_planner(), states(2)
    carried = torch.rand(2, 3, 2, dtype=torch.float64)
    td = TensorDict({"observation": observation, "plan_mean": carried}, batch_size=[2])
    out = run(planner, td)
    torch.testing.assert_close(out["plan", "loc"], expected_plan(planner, observation, None).loc)
    assert "next" not in out.keys()
    assert planner.in_keys == ["observation"]


def test_the_planner_keeps_nothing_from_call_to_call():
    planner = make_planner(warm_start=True)
    td, other = (
        TensorDict({"observation": states(2), "plan_mean": torch.rand(2, 3, 2).double()}, batch_size=[2])
        for _ in range(2)
    )
    first = run(planner, td)
    run(planner, other, seed=1)
    assert (run(planner, td) == first).all()


def test_the_primer_describes_the_warm_start():
    primer = make_planner(horizon=4, plan_mean_key=("agent", "carried")).make_tensordict_primer()
    assert primer.primers["agent", "carried"].shape == (4, 2)


# Non-finite scores


class PatchyWorld(LineWorld):
    """A line world whose reward is ``bad`` for actions below ``edge`` and for positions beyond 10."""

    def __init__(self, *, bad: float = torch.nan, edge: float = -1.0, **options) -> None:
        super().__init__(**options)
        self.bad, self.edge = bad, edge

    def reward(self, latent, action):
        spoilt = (action[..., 0] < self.edge) | (latent[..., 0] > 10)
        return torch.where(spoilt, self.bad, super().reward(latent, action))


@pytest.mark.parametrize("mode", _MODES)
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_non_finite_candidate_is_never_an_elite(bad, mode):
    # All returns are negative, so a candidate that counted as 0 would win.
    world = PatchyWorld(bad=bad, edge=-0.2, goal=2.0)
    planner = make_planner(world, num_samples=64, iterations=6, eval_first_action=mode)
    plan = planner.plan(torch.zeros(4, 1), explore=False, trace=True)
    assert not plan.trace.scores.isfinite().all()
    assert plan.trace.scores[plan.trace.scores.isfinite()].max() < 0
    assert all(field.isfinite().all() for field in (plan.loc, plan.scale, plan.value, *plan.trace[3:]))
    torch.testing.assert_close(plan.loc, torch.ones(4, 1), atol=0.1, rtol=0)
    assert not plan.fallback.any()


@pytest.mark.parametrize("mode", _MODES)
def test_a_plan_stays_out_of_a_non_finite_region_even_if_the_optimum_lies_within(mode):
    world = PatchyWorld(edge=-0.2, goal=-2.0)
    plan = make_planner(world, num_samples=64, iterations=6, eval_first_action=mode).plan(
        torch.zeros(4, 1), explore=False
    )
    assert (plan.loc >= -0.2).all()
    assert (plan.loc < 0.1).all()
    assert (plan.mean >= -0.2).all()


def test_fewer_finite_candidates_than_elites_share_all_the_weight():
    planner = make_planner(
        PatchyWorld(edge=-0.5), horizon=1, num_samples=4, num_elites=3, num_proposals=0, iterations=1, std_min=1e-3
    )
    noise = planner.draw_noise(1)
    actions = torch.tensor([0.2, -0.8, 0.6, -0.9])
    noise = noise._replace(candidates=actions.view(1, 1, 4, 1, 1) / 2.0)
    plan = planner.plan(torch.zeros(1, 1), noise=noise, trace=True)
    scores = plan.trace.scores[0, 0]
    assert scores.isfinite().tolist() == [True, False, True, False]
    better = 1 / (1 + math.exp(0.5 * (scores[0] - scores[2])))
    mean = 0.2 + 0.4 * better
    assert plan.mean.item() == pytest.approx(mean)
    assert plan.scale.item() == pytest.approx(math.sqrt((1 - better) * (0.2 - mean) ** 2 + better * (0.6 - mean) ** 2))


@pytest.mark.parametrize("explore", [True, False])
@pytest.mark.parametrize("mode", _MODES)
def test_without_any_finite_score_the_policy_acts_in_that_state_only(mode, explore):
    world = PatchyWorld(goal=0.3, policy_gain=0.5)
    planner = make_planner(world, first_action=mode, eval_first_action=mode, **_WIDE)
    observation, carried = torch.tensor([[0.0], [20.0], [0.5]]), torch.rand(3, 3, 1)
    noise = planner.draw_noise(3)
    plan = planner.plan(observation, carried, noise=noise, explore=explore, trace=True)
    assert plan.fallback.tolist() == [False, True, False]
    # The policy's own mean and std: half the best action, and the middle of the bounds (-3, 1).
    assert plan.loc[1].item() == -0.5
    assert plan.scale[1].item() == pytest.approx(math.exp(-1))
    action = -0.5 + math.exp(-1) * noise.action[1].item() if explore else -0.5
    assert plan.action[1].item() == pytest.approx(max(min(action, 1), -1))
    assert plan.value.isnan().tolist() == [False, True, False]
    torch.testing.assert_close(plan.mean[1], shift_plan(carried[1]))  # where it started
    others = planner.plan(observation[[0, 2]], carried[[0, 2]], noise=rows(noise, [0, 2]), explore=explore)
    assert_same_plan(Plan(*(field[[0, 2]] for field in plan[:-1]), None), others)


@pytest.mark.parametrize(("bounds", "expected"), [({"std_min": 0.5}, 0.5), ({"std_max": 0.25}, 0.25)])
def test_the_scale_of_the_fallback_stays_within_the_planners_bounds(bounds, expected):
    plan = make_planner(PatchyWorld(), **bounds).plan(torch.tensor([20.0]))
    assert plan.fallback.item()
    assert plan.scale.item() == expected


# Exploration


@pytest.mark.parametrize("mode", [ExplorationType.DETERMINISTIC, ExplorationType.MODE, ExplorationType.MEAN])
def test_without_exploration_the_action_is_the_mean_of_the_target(mode):
    planner = make_planner(eval_first_action="elite")
    with set_exploration_type(mode):
        out = planner(TensorDict({"observation": states(50)}, batch_size=[50]))
    assert torch.equal(out["action"], out["plan", "loc"])


def test_an_exploring_action_is_a_sample_of_the_target():
    planner = make_planner()
    noise = planner.draw_noise(20)
    plan = planner.plan(states(20), noise=noise, explore=True)
    torch.testing.assert_close(plan.action, (plan.loc + plan.scale * noise.action).clamp(-1, 1))
    assert (plan.action != plan.loc).any(-1).all()


def test_exploring_actions_spread_as_the_target_says():
    planner = make_planner(LineWorld(goal=0.0), std_min=0.1, std_max=0.1)
    with set_exploration_type(ExplorationType.RANDOM):
        out = planner(TensorDict({"observation": torch.zeros(4000, 1)}, batch_size=[4000]))
    assert out["plan", "scale"].unique().tolist() == pytest.approx([0.1])
    deviation = (out["action"] - out["plan", "loc"]) / 0.1
    assert deviation.mean().item() == pytest.approx(0, abs=0.08)
    assert deviation.std().item() == pytest.approx(1, abs=0.05)


@pytest.mark.parametrize("evaluation", _MODES)
@pytest.mark.parametrize("training", _MODES)
def test_training_and_evaluation_choose_their_own_first_action(training, evaluation):
    model, observation = make_model(), states(3)
    planner = make_planner(model, first_action=training, eval_first_action=evaluation)
    noise = planner.draw_noise(3)
    for explore, mode in ((True, training), (False, evaluation)):
        expected = make_planner(model, first_action=mode, eval_first_action=mode).plan(observation, noise=noise)
        torch.testing.assert_close(planner.plan(observation, noise=noise, explore=explore).loc, expected.loc)


def elites_by_hand(planner, actions, scores) -> tuple[list[int], list[float]]:
    """Indices and weights of the best of N candidates by plain loops; the scores are finite."""
    scores = scores.tolist()
    best = sorted(range(len(scores)), key=lambda n: -scores[n])[: planner.num_elites]
    weights = [math.exp(planner.inverse_temperature * (scores[n] - scores[best[0]])) for n in best]
    return best, [weight / sum(weights) for weight in weights]


def test_the_best_first_action_is_that_of_the_highest_scoring_candidate():
    plan = make_planner(first_action="best").plan(states(6), trace=True)
    for i in range(6):
        scores = plan.trace.scores[i, -1]
        assert torch.equal(plan.loc[i], plan.trace.actions[i, -1, scores.argmax(), 0])
        assert plan.value[i] == scores.max()


def test_the_mean_first_action_is_the_fitted_mean():
    planner = make_planner(first_action="mean")
    plan = planner.plan(states(6), trace=True)
    assert torch.equal(plan.loc, plan.trace.mean[:, -1, 0])
    for i in range(6):
        best, weights = elites_by_hand(planner, plan.trace.actions[i, -1], plan.trace.scores[i, -1])
        expected = sum(w * plan.trace.scores[i, -1, n].item() for n, w in zip(best, weights, strict=True))
        assert plan.value[i].item() == pytest.approx(expected)


def test_elites_are_drawn_as_often_as_they_weigh():
    planner = make_planner(
        LineWorld(), horizon=2, num_samples=8, num_elites=4, num_proposals=2, iterations=1, inverse_temperature=0.2
    )
    draws = 4000
    noise = rows(planner.draw_noise(1), [0] * draws)
    noise = noise._replace(elite=torch.rand(draws, 4))
    plan = planner.plan(torch.zeros(draws, 1), noise=noise, trace=True)
    best, weights = elites_by_hand(planner, plan.trace.actions[0, 0], plan.trace.scores[0, 0])
    assert 0.02 < min(weights) < max(weights) < 0.9
    total = 0.0
    for index, weight in zip(best, weights, strict=True):
        chosen = (plan.loc == plan.trace.actions[0, 0, index, 0]).all(-1)
        total += chosen.double().mean().item()
        assert chosen.double().mean().item() == pytest.approx(weight, abs=4 * math.sqrt(weight * (1 - weight) / draws))
        assert plan.value[chosen].unique().item() == plan.trace.scores[0, 0, index].item()
    assert total == pytest.approx(1)


def test_the_target_has_the_spread_of_the_last_fit():
    plan = make_planner().plan(states(3), trace=True)
    assert torch.equal(plan.scale, plan.trace.std[:, -1, 0])


# Model predictive path integral control, step by step


_BUDGETS = {
    "usual": {},
    "no proposals": {"num_proposals": 0},
    "everyone is an elite": {"num_elites": 24},
    "one elite": {"num_elites": 1},
    "one free candidate": {"num_proposals": 23},
    "hot": {"inverse_temperature": 0.01},
    "cold": {"inverse_temperature": 20.0},
}


@pytest.mark.parametrize("name", _BUDGETS)
def test_every_iteration_refits_the_elites(name):
    planner = make_planner(**_BUDGETS[name])
    trace = planner.plan(states(2), trace=True).trace
    for i in range(2):
        for iteration in range(3):
            actions, scores = trace.actions[i, iteration], trace.scores[i, iteration]
            best, weights = elites_by_hand(planner, actions, scores)
            mean = sum(w * actions[n] for n, w in zip(best, weights, strict=True))
            variance = sum(w * (actions[n] - mean) ** 2 for n, w in zip(best, weights, strict=True))
            torch.testing.assert_close(trace.mean[i, iteration], mean)
            torch.testing.assert_close(trace.std[i, iteration], variance.sqrt().clamp(0.05, 2.0))


@pytest.mark.parametrize("name", _BUDGETS)
def test_every_iteration_draws_around_the_previous_fit(name):
    planner = make_planner(**_BUDGETS[name])
    noise = planner.draw_noise(2)
    trace = planner.plan(states(2), noise=noise, trace=True).trace
    mean, std = torch.zeros(2, 1, 3, 2), torch.full((2, 1, 3, 2), 2.0)
    for iteration in range(3):
        drawn = (mean + std * noise.candidates[:, iteration]).clamp(-1, 1)
        torch.testing.assert_close(trace.actions[:, iteration, planner.num_proposals :], drawn)
        mean, std = trace.mean[:, iteration, None], trace.std[:, iteration, None]
    assert trace.actions.abs().max() == 1


def test_the_spread_stays_within_its_bounds():
    planner = make_planner(std_min=0.3, std_max=0.6)
    noise = planner.draw_noise(3)
    trace = planner.plan(states(3), noise=noise, trace=True).trace
    assert (trace.std.min().item(), trace.std.max().item()) == pytest.approx((0.3, 0.6))
    # The first iteration draws with the largest.
    torch.testing.assert_close(trace.actions[:, 0, 5:], (0.6 * noise.candidates[:, 0]).clamp(-1, 1))


def test_proposals_come_first_in_every_iteration_and_are_scored_once(monkeypatch):
    model = make_model()
    calls = count_calls(monkeypatch, model, "reward")
    trace = make_planner(model).plan(states(2), trace=True).trace
    for field in (trace.actions, trace.scores, trace.returns):
        assert torch.equal(field[:, 1:, :5], field[:, :1, :5].expand_as(field[:, 1:, :5]))
        assert not torch.equal(field[:, 1, 5:], field[:, 0, 5:])
    # All 24 candidates of two states in the first iteration, then the 19 free ones; one call for three steps, the first
    # of which is the same for both heads.
    assert calls == [(2 * 24 * (1 + 2 * 2), 16), *[(2 * 19 * (1 + 2 * 2), 16)] * 2]


@pytest.mark.parametrize("num_proposals", [1, 2, 7])
def test_proposals_take_turns_in_the_dynamics_heads(num_proposals):
    model, observation = make_model(num_dynamics=3), states(2)
    planner = make_planner(model, num_proposals=num_proposals)
    noise = planner.draw_noise(2)
    trace = planner.plan(observation, noise=noise, trace=True).trace

    def propose(i, p, head):
        latent, actions = model.encode(observation[i]), []
        for step in range(3):
            mean, log_std = model.policy(latent)
            actions.append((mean + log_std.exp() * noise.proposals[i, p, step]).clamp(-1, 1))
            latent = model.next(latent.unsqueeze(0), actions[-1])[head]
        return torch.stack(actions)

    with torch.no_grad():
        for i in range(2):
            for p in range(num_proposals):
                torch.testing.assert_close(trace.actions[i, 0, p], propose(i, p, p % 3))
                assert not torch.allclose(trace.actions[i, 0, p], propose(i, p, (p + 1) % 3))


def test_a_knowing_policy_is_followed():
    world = LineWorld(goal=0.3, policy_gain=1.0, log_std_bounds=(-9.0, -8.0))
    plan = make_planner(world, num_samples=6, num_elites=1, iterations=1).plan(torch.zeros(1), explore=False)
    torch.testing.assert_close(plan.loc, torch.tensor([0.6]), atol=1e-2, rtol=0)


def test_wider_bounds_change_the_proposals_only():
    model, observation = make_model(), states(2)
    narrow, wide = make_planner(model), make_planner(model, **_WIDE)
    noise = narrow.draw_noise(2)
    usual, widened = (planner.plan(observation, noise=noise, trace=True).trace for planner in (narrow, wide))
    assert torch.equal(widened.actions[:, 0, 5:], usual.actions[:, 0, 5:])
    assert torch.equal(widened.scores[:, 0, 5:], usual.scores[:, 0, 5:])
    with torch.no_grad():
        latent = model.encode(observation)
        for bounds, trace in ((None, usual), ((-2.0, 1.0), widened)):
            for p in range(5):
                first = model.act(latent, noise.proposals[:, p, 0], bounds)
                torch.testing.assert_close(trace.actions[:, 0, p, 0], first)
    assert not torch.allclose(widened.actions[:, 0, :5], usual.actions[:, 0, :5])


@pytest.mark.parametrize(
    ("action_dim", "options", "expected"),
    [
        (20, {}, 3),
        (21, {}, 5),
        (21, {"extra_iterations": 0}, 3),
        (21, {"extra_iterations": 4}, 7),
        (2, {"large_action_dim": 2}, 3),
        (2, {"large_action_dim": 1}, 5),
    ],
)
def test_large_action_spaces_get_more_iterations(action_dim, options, expected):
    planner = make_planner(LineWorld(action_dim=action_dim), **options)
    assert planner.iterations == expected
    assert planner.plan(torch.zeros(action_dim), trace=True).trace.scores.shape == (expected, 24)


# Noise


def test_the_noise_decides_everything():
    planner, observation = make_planner(), states(3)
    noise = planner.draw_noise(3)
    first, second = (planner.plan(observation, noise=noise) for _ in range(2))
    for name in Plan._fields[:-1]:
        assert torch.equal(getattr(first, name), getattr(second, name))
    assert not torch.equal(planner.plan(observation).loc, planner.plan(observation).loc)


def test_plans_repeat_with_the_global_seed():
    planner = make_planner(warm_start=True)
    td = TensorDict({"observation": states(3), "is_init": torch.ones(3, 1, dtype=torch.bool)}, batch_size=[3])
    assert (run(planner, td, seed=5) == run(planner, td, seed=5)).all()
    assert not torch.equal(run(planner, td, seed=5)["plan", "loc"], run(planner, td, seed=6)["plan", "loc"])


def test_a_generator_draws_the_noise_and_leaves_the_global_one_alone():
    planner = make_planner()
    state = torch.get_rng_state()
    first, second = (planner.draw_noise(3, generator=torch.Generator().manual_seed(1)) for _ in range(2))
    planner.plan(torch.zeros(3, 3, dtype=torch.float64), noise=first)
    assert torch.equal(torch.get_rng_state(), state)
    for a, b in zip(first, second, strict=True):
        assert torch.equal(a, b)


def test_the_noise_is_standard():
    noise = make_planner(num_samples=128).draw_noise(50)
    for draw in (noise.proposals, noise.candidates):
        assert draw.mean().item() == pytest.approx(0, abs=0.06)
        assert draw.std().item() == pytest.approx(1, abs=0.05)
    assert noise.elite.min() >= 0
    assert noise.elite.max() < 1
    assert noise.elite.mean().item() == pytest.approx(0.5, abs=0.06)
    assert {draw.dtype for draw in noise} == {torch.float64}


# Targets in the tensordict


def test_keys_shapes_and_dtypes_of_the_targets():
    model = make_model().float()
    model.version.fill_(17)
    planner = make_planner(model, warm_start=True)
    for batch_size in ((), (5,), (2, 3)):
        flags = torch.ones(*batch_size, 1, dtype=torch.bool)
        out = planner(TensorDict({"observation": torch.randn(*batch_size, 3), "is_init": flags}, batch_size=batch_size))
        assert set(out.keys(True, True)) == {*planner.out_keys, "observation", "is_init"}
        expected = {
            "action": ((2,), torch.float32),
            ("plan", "loc"): ((2,), torch.float32),
            ("plan", "scale"): ((2,), torch.float32),
            ("plan", "value"): ((1,), torch.float32),
            ("plan", "version"): ((1,), torch.int64),
            ("plan", "fallback"): ((1,), torch.bool),
            ("next", "plan_mean"): ((3, 2), torch.float32),
        }
        assert {key: (out[key].shape, out[key].dtype) for key in planner.out_keys} == {
            key: (batch_size + shape, dtype) for key, (shape, dtype) in expected.items()
        }
        assert out["plan", "version"].eq(17).all()
    model.version.add_(1)
    assert out["plan", "version"].eq(17).all()  # a record, not a view


def test_renamed_and_nested_keys():
    planner = make_planner(
        warm_start=True,
        observation_key=("agent", "pixels"),
        action_key=("agent", "torque"),
        is_init_key="first",
        plan_mean_key=("agent", "carried"),
        plan_key=("agent", "target"),
    )
    observation, carried = states(4), torch.rand(4, 3, 2, dtype=torch.float64)
    td = TensorDict(
        {
            "agent": {"pixels": observation, "carried": carried},
            "first": torch.zeros(4, 1, dtype=torch.bool),
            "observation": states(4),
            "plan_mean": torch.rand(4, 3, 2),
        },
        batch_size=[4],
    )
    out, expected = run(planner, td), expected_plan(planner, observation, carried)
    assert planner.in_keys == [("agent", "pixels"), "first", ("agent", "carried")]
    assert set(planner.out_keys) <= set(out.keys(True, True))
    torch.testing.assert_close(out["agent", "torque"], expected.loc)
    torch.testing.assert_close(out["agent", "target", "value"].squeeze(-1), expected.value)
    torch.testing.assert_close(out["next", "agent", "carried"], expected.mean)
    assert set(out["agent", "target"].keys()) == {"loc", "scale", "value", "version", "fallback"}
    assert "action" not in out.keys()
    assert "plan" not in out.keys()


def test_nothing_that_was_passed_is_changed_in_place():
    planner = make_planner(warm_start=True)
    td = TensorDict(
        {
            "observation": states(3),
            "is_init": torch.tensor([[True], [False], [True]]),
            "plan_mean": torch.rand(3, 3, 2, dtype=torch.float64),
        },
        batch_size=[3],
    )
    planner(td)  # a second call meets the outputs of the first
    noise = planner.draw_noise(3)
    tensors = {key: td[key] for key in td.keys(True, True)} | noise._asdict()
    before = {key: tensor.clone() for key, tensor in tensors.items()}
    versions = {key: tensor._version for key, tensor in tensors.items()}
    planner(td)
    planner.plan(td["observation"], td["plan_mean"], noise=noise)
    for key, tensor in tensors.items():
        assert torch.equal(tensor, before[key])
        assert tensor._version == versions[key]


def test_planning_returns_the_action_and_writes_nothing():
    planner = make_planner(warm_start=True)
    td = TensorDict(
        {"observation": states(3), "is_init": torch.ones(3, 1, dtype=torch.bool), "next": {"x": torch.zeros(3)}},
        batch_size=[3],
    )
    before = td.clone()
    torch.manual_seed(0)
    action = planner.planning(td)
    assert set(td.keys(True, True)) == set(before.keys(True, True))
    assert torch.equal(action, run(planner, td)["action"])


def test_the_output_can_go_elsewhere():
    planner = make_planner()
    td, out = TensorDict({"observation": states(3)}, batch_size=[3]), TensorDict(batch_size=[3])
    assert planner(td, tensordict_out=out) is out
    assert set(td.keys()) == {"observation"}
    assert set(out.keys(True, True)) == set(planner.out_keys)


def test_no_graph_is_built():
    planner = make_planner(warm_start=True)
    observation = states(3).requires_grad_()
    out = planner(TensorDict({"observation": observation, "is_init": torch.ones(3, 1).bool()}, batch_size=[3]))
    plan = planner.plan(observation, trace=True)
    tensors = [*out.select(*planner.out_keys).values(True, True), *plan[:-1], *plan.trace]
    assert not any(tensor.requires_grad for tensor in tensors)


def test_a_missing_observation_is_named():
    planner = make_planner(observation_key="pixels")
    with pytest.raises(
        KeyError, match=r"the planner needs 'pixels' \(or 'latent'\) in its input; pass observation_key="
    ):
        planner(TensorDict({"observation": states(2)}, batch_size=[2]))


# As a module


def test_the_state_dict_lists_the_weights_once():
    model = make_model()
    planner = make_planner(model)
    weights = {tensor.data_ptr() for tensor in model.state_dict().values()}
    saved = planner.state_dict()
    assert len(saved) == len(model.state_dict()) == len(weights)
    assert {tensor.data_ptr() for tensor in saved.values()} == weights
    assert len(list(TensorDict.from_module(planner).keys(True, True))) == len(model.state_dict())


def test_the_weights_are_shared_with_the_world_model():
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


def test_a_copy_plans_with_weights_of_its_own():
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
def test_the_dtype_is_that_of_the_world_model(convert):
    planner = convert(make_planner(make_model().float(), warm_start=True))
    td = TensorDict({"observation": states(2), "is_init": torch.ones(2, 1, dtype=torch.bool)}, batch_size=[2])
    out = planner(planner(td).exclude("next").set("plan_mean", td["next", "plan_mean"]))
    floats = ["action", ("plan", "loc"), ("plan", "scale"), ("plan", "value"), ("next", "plan_mean")]
    assert {out[key].dtype for key in floats} == {torch.float64}


def test_precision_makes_no_difference_to_the_first_returns():
    model, observation = make_model(), states(2)
    planner = make_planner(model)
    noise = planner.draw_noise(2)
    exact = planner.plan(observation, noise=noise, trace=True).trace
    planner.float()
    rough = planner.plan(observation.float(), noise=PlanNoise(*(d.float() for d in noise)), trace=True).trace
    torch.testing.assert_close(rough.returns[:, 0].double(), exact.returns[:, 0], atol=1e-3, rtol=1e-3)


def test_candidates_scored_in_half_precision_are_ranked_nearly_alike():
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


def test_half_precision_leaves_the_weights_as_they_are_and_follows_them():
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


def test_one_compiled_graph_plans_as_eager_code_does():
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
def test_a_plan_compiled_to_kernels_is_that_of_eager_code():
    planner, observation = make_planner(horizon=2, iterations=1), states(3)
    noise = planner.draw_noise(3)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the compiler, about the machine
        compiled = torch.compile(planner.plan, fullgraph=True)(observation, noise=noise)
    assert_same_plan(compiled, planner.plan(observation, noise=noise))


# Arguments


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"horizon": 0}, r"horizon must be at least 1, got 0\."),
        ({"iterations": 0}, r"iterations must be at least 1, got 0\."),
        ({"num_elites": 0}, r"num_elites must be at least 1, got 0\."),
        ({"num_elites": 25}, r"num_elites must be at most num_samples=24, got 25\."),
        ({"num_proposals": 24}, r"num_proposals must be in \[0, num_samples=24\), got 24\."),
        ({"num_proposals": -1}, r"num_proposals must be in \[0, num_samples=24\), got -1\."),
        ({"extra_iterations": -1}, r"extra_iterations must not be negative, got -1\."),
        ({"inverse_temperature": -0.5}, r"inverse_temperature must not be negative, got -0\.5\."),
        ({"std_min": 0.0}, r"std_min must be in \(0, std_max=2\.0\], got 0\.0\."),
        ({"std_min": 3.0}, r"std_min must be in \(0, std_max=2\.0\], got 3\.0\."),
        ({"discount": 0.0}, r"discount must be in \(0, 1\], got 0\.0\."),
        ({"discount": 1.1}, r"discount must be in \(0, 1\], got 1\.1\."),
        ({"first_action": "last"}, r"first_action must be one of elite, mean, best, got 'last'\."),
        ({"eval_first_action": "last"}, r"eval_first_action must be one of elite, mean, best, got 'last'\."),
        ({"score": "best"}, r"score must be one of final, mean, adaptive or a callable, got 'best'\."),
        (
            {"score": FinalScore(), "beta": 1.0},
            r"beta=1\.0 has no effect on a score of your own; put the penalty into the callable\.",
        ),
        (
            {"score": "adaptive", "beta": -1.0},
            r"beta must not be negative with the adaptive score, got -1\.0; score='final' and score='mean' take a "
            r"negative one, for optimism\.",
        ),
        (
            {"scoring_dtype": "int8"},
            r"scoring_dtype must be one of float16, bfloat16, float32, float64, got 'int8'\.",
        ),
        ({"scoring_dtype": torch.int8}, r"scoring_dtype must be a floating point dtype, got torch\.int8\."),
        (
            {"proposal_log_std_min": -2.0},
            r"proposal_log_std_min and proposal_log_std_max must be given together, got -2\.0 and None; leave both out "
            r"for the policy's own bounds\.",
        ),
        (
            {"proposal_log_std_max": 1.0},
            r"proposal_log_std_min and proposal_log_std_max must be given together, got None and 1\.0; leave both out "
            r"for the policy's own bounds\.",
        ),
        (
            {"proposal_log_std_min": 1.0, "proposal_log_std_max": 1.0},
            r"proposal_log_std_min must be below proposal_log_std_max=1\.0, got 1\.0\.",
        ),
    ],
)
def test_an_impossible_argument_is_refused(options, message):
    with pytest.raises(ValueError, match=f"^{message}$"):
        make_planner(LineWorld(), **options)


@pytest.mark.parametrize("env", [None, LineWorld()])
def test_an_environment_that_is_not_a_latent_env_is_refused(env):
    with pytest.raises(
        TypeError,
        match=rf"^EnsembleMPPIPlanner needs a LatentEnv, got {type(env).__name__}; wrap the networks: "
        r"LatentEnv\(world_model\)\.$",
    ):
        EnsembleMPPIPlanner(env)
