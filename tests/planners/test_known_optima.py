from __future__ import annotations

import pytest
import torch

from torchrl_etdmpc.testing import LineWorld, LQRWorld

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


@pytest.mark.parametrize(("score", "mode"), [("final", "best"), ("mean", "elite"), ("mean", "mean")])
@pytest.mark.parametrize("name", _OPTIMA)
def test_the_planner_finds_the_known_optimum(name, score, mode, make_planner):
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
def test_drifts_that_cancel_do_not_move_the_plan(name, make_planner):
    start = torch.tensor(_OPTIMA[name][1])
    calm, drifting = (make_planner(_OPTIMA[key][0](), score="mean") for key in (name, f"drifting {name}"))
    noise = calm.draw_noise(3)
    torch.testing.assert_close(
        drifting.plan(start, noise=noise).mean, calm.plan(start, noise=noise).mean, atol=1e-3, rtol=0
    )


@pytest.mark.parametrize("score", ["final", "mean", "adaptive"])
def test_a_penalty_avoids_what_a_single_head_hallucinates(score, make_planner):
    world = LineWorld(goal=0.3, num_dynamics=4, trap=(-1.0, -0.5))
    start = torch.tensor([[0.0], [0.1]])
    options = {"num_samples": 256, "num_elites": 32, "iterations": 6, "score": score}
    fooled = make_planner(world, **options).plan(start, explore=False)
    assert (fooled.loc <= -0.5).all()
    careful = make_planner(world, **options, beta=10.0).plan(start, explore=False)
    torch.testing.assert_close(careful.loc, world.optimal_action(start), atol=0.1, rtol=0)


def test_an_objective_that_needs_the_last_depth_only_can_say_so(make_planner, assert_same_plan):
    def last(returns):
        assert returns.shape[-3] == 1
        return returns.mean((-3, -2, -1))

    last.depths = "last"
    planner, named = make_planner(LineWorld(), score=last), make_planner(LineWorld(), score="final")
    noise = planner.draw_noise(1)
    assert_same_plan(planner.plan(torch.zeros(1, 1), noise=noise), named.plan(torch.zeros(1, 1), noise=noise))


def test_an_objective_of_the_wrong_shape_is_answered_with_the_right_one(make_planner):
    planner = make_planner(LineWorld(), score=lambda returns: returns.mean(-1))
    with pytest.raises(
        ValueError,
        match=r"^score must reduce the return table \[1, 24, 3, 1, 1\] to \[1, 24\], got \[1, 24, 3, 1\]\.$",
    ):
        planner.plan(torch.zeros(1, 1))
