from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

_WARNING = (
    "^'plan_mean' is not in the planner's input, so every plan starts cold; append planner.make_tensordict_primer"
)


def test_the_first_candidates_are_drawn_around_the_shifted_previous_plan(make_planner, states):
    planner = make_planner(warm_start=True)
    previous = torch.rand(2, 3, 2, dtype=torch.float64) * 2 - 1
    noise = planner.draw_noise(2)
    trace = planner.plan(states(2), previous, noise=noise, trace=True).trace
    shifted = torch.cat([previous[:, 1:], torch.zeros(2, 1, 2)], dim=1)
    drawn = (shifted[:, None] + 2.0 * noise.candidates[:, 0]).clamp(-1, 1)
    torch.testing.assert_close(trace.actions[:, 0, 5:], drawn)


@pytest.mark.parametrize("shape", [(3, 2, 2), (3, 3), (2, 3, 3), (2, 1, 3, 2)])
def test_a_carried_plan_of_another_shape_is_refused_and_not_dealt_out_anew(make_planner, states, shape):
    with pytest.raises(ValueError, match=r"^plan_mean must be \[\.\.\., H, A\], here \[2, 3, 2\], got \["):
        make_planner(warm_start=True).plan(states(2), torch.zeros(shape, dtype=torch.float64))


def test_the_carried_plan_is_the_mean_of_the_last_iteration(make_planner, states):
    plan = make_planner().plan(states(2), trace=True)
    assert torch.equal(plan.mean, plan.trace.mean[:, -1])


def test_the_start_of_an_episode_zeroes_that_environments_plan_only(make_planner, states, run, expected_plan):
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


def test_a_carried_plan_needs_no_episode_flag(make_planner, states, run, expected_plan):
    planner, observation = make_planner(warm_start=True), states(2)
    carried = torch.rand(2, 3, 2, dtype=torch.float64)
    out = run(planner, TensorDict({"observation": observation, "plan_mean": carried}, batch_size=[2]))
    torch.testing.assert_close(out["next", "plan_mean"], expected_plan(planner, observation, carried).mean)


def test_an_episode_flag_alone_starts_cold_and_carries_on(make_planner, states, run, expected_plan):
    planner, observation = make_planner(warm_start=True), states(2)
    td = TensorDict({"observation": observation, "is_init": torch.ones(2, 1, dtype=torch.bool)}, batch_size=[2])
    out = run(planner, td)
    torch.testing.assert_close(out["next", "plan_mean"], expected_plan(planner, observation, None).mean)


def test_a_plan_that_was_lost_within_an_episode_is_warned_of_once(make_planner, states, run, expected_plan):
    planner, observation = make_planner(warm_start=True), states(2)
    td = TensorDict({"observation": observation, "is_init": torch.tensor([[True], [False]])}, batch_size=[2])
    with pytest.warns(UserWarning, match=_WARNING):
        run(planner, td)
    out = run(planner, td)  # warnings are errors here
    torch.testing.assert_close(out["next", "plan_mean"], expected_plan(planner, observation, None).mean)


def test_with_neither_key_every_plan_is_cold_and_the_planner_warns_once(make_planner, states, run, expected_plan):
    planner, observation = make_planner(warm_start=True), states(2)
    td = TensorDict({"observation": observation}, batch_size=[2])
    with pytest.warns(UserWarning, match=_WARNING):
        out = run(planner, td)
    for _ in range(2):
        torch.testing.assert_close(out["plan", "loc"], expected_plan(planner, observation, None).loc)
        assert ("next", "plan_mean") not in out.keys(True)
        out = run(planner, td)  # warnings are errors here


def test_the_warning_of_a_cold_start_is_of_the_line_that_calls_the_planner(make_planner, states):
    for _ in range(2):  # Python shows a warning once for each line
        with pytest.warns(UserWarning, match=_WARNING) as warned:
            make_planner(warm_start=True)(TensorDict({"observation": states(2)}, batch_size=[2]))
        assert warned[0].filename == __file__


def test_without_warm_start_nothing_is_read_written_or_warned_of(make_planner, states, run, expected_plan):
    planner, observation = make_planner(), states(2)
    carried = torch.rand(2, 3, 2, dtype=torch.float64)
    td = TensorDict({"observation": observation, "plan_mean": carried}, batch_size=[2])
    out = run(planner, td)
    torch.testing.assert_close(out["plan", "loc"], expected_plan(planner, observation, None).loc)
    assert "next" not in out.keys()
    assert planner.in_keys == ["observation"]


def test_the_planner_keeps_nothing_from_call_to_call(make_planner, states, run):
    planner = make_planner(warm_start=True)
    td, other = (
        TensorDict({"observation": states(2), "plan_mean": torch.rand(2, 3, 2).double()}, batch_size=[2])
        for _ in range(2)
    )
    first = run(planner, td)
    run(planner, other, seed=1)
    assert (run(planner, td) == first).all()


def test_the_primer_describes_the_warm_start(make_planner):
    primer = make_planner(horizon=4, plan_mean_key=("agent", "carried")).make_tensordict_primer()
    assert primer.primers["agent", "carried"].shape == (4, 2)


def test_an_episode_flag_may_lack_its_last_dimension(make_planner, states, run):
    # As many environments as steps: each flag must zero its environment, not a step of every one.
    planner = make_planner(warm_start=True)
    td = TensorDict({"observation": states(3), "plan_mean": torch.rand(3, 3, 2, dtype=torch.float64)}, batch_size=[3])
    flag = torch.tensor([True, False, False])
    plans = [run(planner, td.clone().set("is_init", init))["next", "plan_mean"] for init in (flag, flag.unsqueeze(-1))]
    assert torch.equal(*plans)
    assert not torch.equal(
        plans[0], run(planner, td.clone().set("is_init", torch.zeros(3, 1).bool()))["next", "plan_mean"]
    )


def test_a_plan_of_another_planner_is_refused_by_its_shape(make_planner, states):
    planner = make_planner(warm_start=True)
    carried = TensorDict({"observation": states(2), "plan_mean": torch.zeros(2, 6, 2, dtype=torch.float64)}, [2])
    with pytest.raises(ValueError, match=r"'plan_mean' holds a plan of shape \[6, 2\], this planner's are .*=\[3, 2\]"):
        planner(carried)
