from __future__ import annotations

import math

import pytest
import torch
from torchrl.envs.utils import check_env_specs

from torchrl_etdmpc import EnsembleMPPIPlanner, LatentEnv, WorldModel
from torchrl_etdmpc.functional import ensemble_mean, ensemble_variance, return_table
from torchrl_etdmpc.testing import AnalyticWorld, LineWorld, LQRWorld

_DRIFT = {"num_dynamics": 3, "num_values": 2, "value_offset": torch.tensor([1.0, -1.0])}
_WORLDS = {
    "line": lambda: LineWorld(goal=0.8),
    "two lines": lambda: LineWorld(goal=0.8, action_dim=2),
    "drifting line": lambda: LineWorld(goal=0.8, drift=torch.tensor([[0.1], [0.0], [-0.1]]), **_DRIFT),
    "lqr": lambda: LQRWorld(),
    "drifting lqr": lambda: LQRWorld(drift=torch.tensor([[0.1, 0.0], [0.0, 0.1], [-0.1, -0.1]]), **_DRIFT),
    "undiscounted lqr with two controls": lambda: LQRWorld(
        torch.tensor([[1.1, 0.2], [0.0, 0.9]]), torch.eye(2), action_cost=2 * torch.eye(2), discount=1.0
    ),
}


@pytest.fixture(autouse=True)
def _seed():
    torch.manual_seed(0)


def estimates(world: AnalyticWorld, state: torch.Tensor, actions: torch.Tensor, discount: float) -> torch.Tensor:
    """Return table ``[..., H, F, V]`` of sequences ``[..., H, A]`` from one state ``[O]``."""
    latent = world.encode(state).expand(1, *actions.shape[:-2], world.latent_dim)
    rewards, values = [], []
    for action in actions.unbind(-2):
        rewards.append(world.reward(latent, action).expand(world.num_dynamics, *actions.shape[:-2]))
        latent = world.next(latent, action)
        values.append(world.values(latent))
    return return_table(
        torch.stack(rewards).movedim((0, 1), (-2, -1)), torch.stack(values).movedim((0, 1), (-3, -2)), discount
    )


@pytest.mark.parametrize("name", _WORLDS)
def test_no_other_plan_beats_the_optimum_at_any_depth(name):
    world = _WORLDS[name]()
    state = 0.3 * torch.randn(world.observation_dim)
    best = world.optimal_actions(state, 4)
    assert best.shape == (4, world.action_dim)
    assert best.abs().max() <= 1
    others = torch.cat([best + 0.05 * torch.randn(200, *best.shape), 2 * torch.rand(200, *best.shape) - 1]).clamp(-1, 1)
    discount = getattr(world, "discount", 0.9)
    optimum = ensemble_mean(estimates(world, state, best, discount))
    assert (ensemble_mean(estimates(world, state, others, discount)) <= optimum + 1e-5).all()


@pytest.mark.parametrize("name", ["drifting line", "drifting lqr"])
def test_drifts_that_cancel_cost_every_plan_the_same(name):
    world, calm = _WORLDS[name](), _WORLDS[name.split()[1]]()
    plans = 2 * torch.rand(50, 4, 1) - 1
    state = torch.full((world.observation_dim,), 0.2)
    cost = ensemble_mean(estimates(calm, state, plans, 0.99)) - ensemble_mean(estimates(world, state, plans, 0.99))
    torch.testing.assert_close(cost, cost[:1].expand(50, 4), atol=1e-4, rtol=0)
    assert (cost > 0).all()


@pytest.mark.parametrize("name", _WORLDS)
def test_an_analytic_world_answers_like_a_world_model(name):
    world = _WORLDS[name]()
    model = WorldModel(
        world.observation_dim,
        world.action_dim,
        latent_dim=world.latent_dim,
        simnorm_dim=world.latent_dim,
        mlp_dim=8,
        encoder_dim=8,
        num_dynamics=world.num_dynamics,
        num_values=world.num_values,
    )
    observation, action = torch.randn(5, world.observation_dim), torch.randn(5, world.action_dim)
    latent = world.encode(observation)
    assert latent.shape == model.encode(observation).shape
    for start in (latent.unsqueeze(0), latent.expand(world.num_dynamics, 5, -1)):
        assert world.next(start, action).shape == model.next(start, action).shape
    heads = world.next(latent.unsqueeze(0), action)
    for given in (latent, heads):
        assert world.reward(given, action).shape == model.reward(given, action).shape
        assert world.values(given).shape == model.values(given).shape
        assert world.act(given, torch.zeros_like(action)).shape == model.act(given, torch.zeros_like(action)).shape
    assert world.termination(latent) is model.termination(latent) is None
    assert [part.shape for part in world.policy(latent)] == [part.shape for part in model.policy(latent)]
    assert world.version.dtype == model.version.dtype


@pytest.mark.parametrize("name", _WORLDS)
def test_an_analytic_world_is_a_valid_latent_env(name):
    check_env_specs(LatentEnv(_WORLDS[name]()))


@pytest.mark.parametrize("cast", [True, False])
@pytest.mark.parametrize("name", _WORLDS)
def test_a_world_answers_in_the_dtype_of_its_input(name, cast):
    world = _WORLDS[name]().double() if cast else _WORLDS[name]()
    state = torch.zeros(3, world.observation_dim, dtype=torch.float64)
    action = world.optimal_action(state)
    following = world.next(world.encode(state).unsqueeze(0), action)
    outputs = (action, following, world.reward(following, action), world.values(following))
    assert {output.dtype for output in outputs} == {torch.float64}


def test_the_line_goes_straight_to_the_goal_and_stays():
    world = LineWorld(goal=1.2, step_size=0.5)
    assert world.optimal_actions(torch.tensor([0.0]), 5).flatten().tolist() == pytest.approx(
        [1, 1, 0.4, 0, 0], abs=1e-6
    )
    assert world.optimal_actions(torch.tensor([1.5]), 2).flatten().tolist() == pytest.approx([-0.6, 0], abs=1e-6)


def test_the_reward_of_the_line_is_the_distance_after_the_step():
    world = LineWorld(goal=1.0, step_size=0.5)
    latent = world.encode(torch.tensor([0.0]))
    assert world.reward(latent, torch.tensor([1.0])).item() == -0.25
    assert world.value(latent).item() == -1.0


def test_the_value_of_the_regulator_solves_the_riccati_equation():
    # The scalar system x' = x + a with unit costs and no discount: P is the golden ratio.
    one = torch.ones(1, 1)
    world = LQRWorld(one, one, discount=1.0)
    golden = (1 + math.sqrt(5)) / 2
    assert world.value_matrix.item() == pytest.approx(golden)
    assert world.gain.item() == pytest.approx(golden / (1 + golden))


def test_the_value_of_the_regulator_is_that_of_an_independent_solver():
    linalg = pytest.importorskip("scipy.linalg")
    torch.set_default_dtype(torch.float64)
    try:
        world = LQRWorld(discount=0.9)
    finally:
        torch.set_default_dtype(torch.float32)
    a, b = 0.9**0.5 * world.transition_matrix, 0.9**0.5 * world.control_matrix
    solution = linalg.solve_discrete_are(a.numpy(), b.numpy(), world.state_cost.numpy(), world.action_cost.numpy())
    torch.testing.assert_close(world.value_matrix, torch.from_numpy(solution))


def test_the_control_of_the_regulator_stays_within_its_bounds():
    world = LQRWorld()
    states = torch.tensor([[9.0, 9.0], [-9.0, -9.0]])
    assert world.optimal_action(states).tolist() == [[-1.0], [1.0]]
    assert world.optimal_actions(states[0], 3).abs().max() <= 1


def test_the_value_of_the_regulator_is_the_return_of_its_own_control():
    world = LQRWorld()
    state = torch.tensor([0.2, -0.1])
    latent, total = state, 0.0
    for step in range(200):
        action = world.optimal_action(latent)
        total += 0.99**step * world.reward(latent, action).item()
        latent = world.transition(latent, action)
    assert total == pytest.approx(world.value(state).item(), rel=1e-4)


def test_only_the_symmetric_part_of_a_cost_counts_for_the_optimum_as_it_does_for_the_rewards():
    skewed = torch.tensor([[1.0, 0.6], [0.0, 1.0]])
    for name, more in (("state_cost", {}), ("action_cost", {"control_matrix": torch.eye(2)})):
        one, other = (LQRWorld(**{name: cost}, **more) for cost in (skewed, (skewed + skewed.mT) / 2))
        torch.testing.assert_close(one.value_matrix, other.value_matrix)
        torch.testing.assert_close(one.gain, other.gain)
        state = torch.tensor([0.2, -0.1])
        assert one.reward(state, state[: one.action_dim]) == other.reward(state, state[: one.action_dim])


def test_a_regulator_that_cannot_hold_its_state_is_refused():
    with pytest.raises(ValueError, match=r"^the Riccati equation has no solution after 10,000 iterations"):
        LQRWorld(torch.full((1, 1), 1.2), torch.zeros(1, 1), discount=1.0)


def test_each_head_is_off_by_its_own_drift_and_offset():
    drift, offset = torch.tensor([[0.1], [0.0], [-0.3]]), torch.tensor([2.0, -1.0])
    world = LineWorld(num_dynamics=3, num_values=2, drift=drift, value_offset=offset)
    latent, action = world.encode(torch.randn(4, 1)), torch.randn(4, 1)
    following, truth = world.next(latent.unsqueeze(0), action), world.transition(latent, action)
    torch.testing.assert_close((following - truth)[..., :1], drift[:, None].expand(3, 4, 1))
    assert (following - truth)[..., 1:].eq(0).all()
    torch.testing.assert_close(world.values(latent) - world.value(latent)[:, None], offset.expand(4, 2))


def test_heads_roll_on_their_own_latents():
    world = LineWorld(num_dynamics=2, drift=torch.tensor([[0.1], [-0.1]]))
    latent = world.encode(torch.zeros(1))
    for _ in range(3):
        latent = world.next(latent.expand(2, -1), torch.zeros(1))
    torch.testing.assert_close(latent[:, 0], torch.tensor([0.3, -0.3]))


def test_only_one_head_believes_in_the_trap_and_only_within_it():
    world = LineWorld(num_dynamics=3, trap=(-1.0, -0.5), trap_bonus=7.0, trap_head=1)
    actions = torch.tensor([[-1.0], [-0.5], [-0.4], [1.0]])
    following = world.next(world.encode(torch.zeros(4, 1)).unsqueeze(0), actions)
    assert following[..., -1].tolist() == [[0.0] * 4, [7.0, 7.0, 0.0, 0.0], [0.0] * 4]
    # The next reward and the value include it.
    bare = torch.cat([following[..., :-1], torch.zeros_like(following[..., -1:])], dim=-1)
    torch.testing.assert_close(world.reward(following, actions) - world.reward(bare, actions), following[..., -1])
    torch.testing.assert_close(world.value(following) - world.value(bare), following[..., -1])
    # It is earned once: one step later it is gone.
    assert world.next(following, torch.zeros(1))[..., -1].eq(0).all()


def test_a_penalty_of_one_standard_deviation_takes_the_hallucinated_bonus_away_exactly():
    world, calm = (LineWorld(num_dynamics=4, trap=trap, trap_bonus=7.0) for trap in ((-1.0, -0.5), None))
    actions = torch.tensor([[-0.8], [0.3], [-0.6]])
    returns = estimates(world, torch.zeros(1), actions, 0.9)
    truth = ensemble_mean(estimates(calm, torch.zeros(1), actions, 0.9))
    earned = torch.tensor([0.9, 0.9, 0.9 + 0.9**3]) * 7  # by depth
    torch.testing.assert_close(ensemble_mean(returns) - truth, earned / 4)
    torch.testing.assert_close(ensemble_variance(returns).sqrt(), earned / 4)


def test_the_gain_of_the_policy_is_how_much_it_knows():
    state, noise = torch.tensor([[0.0], [0.9]]), torch.zeros(2, 1)
    best = LineWorld().optimal_action(state)
    for gain in (0.0, 0.5, 1.0):
        torch.testing.assert_close(LineWorld(policy_gain=gain).act(LineWorld().encode(state), noise), gain * best)


def test_the_policy_obeys_other_bounds_of_its_log_std():
    world = LineWorld(log_std_bounds=(-4.0, 0.0))
    latent = world.encode(torch.zeros(1))
    assert world.policy(latent)[1].item() == -2.0
    assert world.policy(latent, (-2.0, 1.0))[1].item() == -0.5
    torch.testing.assert_close(world.act(latent, torch.ones(1), (-2.0, 1.0)), torch.tensor([math.exp(-0.5)]))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"num_dynamics": 2, "drift": torch.zeros(3, 1)},
            r"drift must have one row per head, shape \(2, 1\), got \(3, 1\)\.",
        ),
        ({"value_offset": [1.0, 2.0]}, r"value_offset must have one row per head, shape \(1,\), got \(2,\)\."),
        ({"step_size": 0.0}, r"step_size must be positive, got 0\.0\."),
        ({"num_dynamics": 2, "trap_head": 2}, r"trap_head must be in 0\.\.1, got 2\."),
        ({"num_dynamics": 2, "trap_head": -1}, r"trap_head must be in 0\.\.1, got -1\."),
    ],
)
def test_an_impossible_world_is_refused(options, message):
    with pytest.raises(ValueError, match=f"^{message}$"):
        LineWorld(**options)


@pytest.mark.parametrize("dtype", ["bfloat16", "float64"])
def test_a_world_of_matrices_is_scored_in_any_dtype(dtype):
    planner = EnsembleMPPIPlanner(
        LatentEnv(LQRWorld()), horizon=2, num_samples=16, num_elites=4, num_proposals=2, scoring_dtype=dtype
    )
    assert planner.plan(torch.tensor([[0.2, -0.1]])).value.isfinite().all()
