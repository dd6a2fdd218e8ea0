from __future__ import annotations

import re

import pytest
import torch
from torchrl.objectives.value.functional import td1_return_estimate

from torchrl_etdmpc.functional import bootstrapped_returns, discount_from_episode_length, return_table


def rollout(horizon: int, heads: int, values: int, *batch: int, seed: int = 0) -> tuple[torch.Tensor, ...]:
    generator = torch.Generator().manual_seed(seed)
    draw = lambda *shape: torch.randn(*batch, *shape, generator=generator, dtype=torch.float64)  # noqa: E731
    alive = torch.rand(*batch, horizon, heads, generator=generator, dtype=torch.float64).cumprod(-2)
    return draw(horizon, heads), draw(horizon, heads, values), alive


def table_by_loops(rewards, values, discount, alive=None):
    """Eq. 3.1 term by term, each term weighted by the probability that the episode goes on until then."""
    horizon, heads, value_heads = values.shape
    table = torch.zeros_like(values)
    for h in range(1, horizon + 1):
        for i in range(heads):
            for j in range(value_heads):
                for u in range(h):
                    weight = 1.0 if alive is None or u == 0 else alive[u - 1, i]
                    table[h - 1, i, j] += weight * discount**u * rewards[u, i]
                weight = 1.0 if alive is None else alive[h - 1, i]
                table[h - 1, i, j] += weight * discount**h * values[h - 1, i, j]
    return table


def test_the_table_matches_a_hand_computed_one():
    rewards = torch.tensor([[1.0, 2.0], [4.0, 0.0], [8.0, -4.0]])  # [H=3, F=2]
    values = torch.tensor([[[10.0, 20.0], [30.0, 40.0]], [[0.0, 4.0], [8.0, 12.0]], [[16.0, 0.0], [-8.0, 8.0]]])
    expected = torch.tensor(
        [
            [[6.0, 11.0], [17.0, 22.0]],  # 1 + V/2           | 2 + V/2
            [[3.0, 4.0], [4.0, 5.0]],  # 1 + 4/2 + V/4        | 2 + 0 + V/4
            [[7.0, 5.0], [0.0, 2.0]],  # 1 + 4/2 + 8/4 + V/8  | 2 + 0 - 4/4 + V/8
        ]
    )
    assert torch.equal(return_table(rewards, values, 0.5), expected)


@pytest.mark.parametrize(("horizon", "heads", "values"), [(1, 1, 1), (3, 2, 2), (6, 4, 2), (4, 1, 3)])
@pytest.mark.parametrize("weighted", [False, True])
def test_the_table_equals_eq_3_1_term_by_term(horizon, heads, values, weighted):
    rewards, value, alive = rollout(horizon, heads, values)
    alive = alive if weighted else None
    expected = table_by_loops(rewards, value, 0.9, alive)
    torch.testing.assert_close(return_table(rewards, value, 0.9, alive), expected)


def test_with_discount_zero_every_depth_is_the_first_reward():
    rewards, values, _ = rollout(3, 2, 2)
    assert torch.equal(return_table(rewards, values, 0.0), rewards[:1, :, None].expand(3, 2, 2))


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("depths", [1, 2, 4])
def test_the_deepest_depths_alone_are_the_last_rows_of_the_full_table(depths, weighted):
    rewards, values, alive = rollout(4, 3, 2, 5)
    alive = alive if weighted else None
    full = return_table(rewards, values, 0.9, alive)
    part = return_table(rewards, values[:, -depths:], 0.9, alive)
    assert part.shape == (5, depths, 3, 2)
    torch.testing.assert_close(part, full[:, -depths:])


def test_consistent_values_give_the_same_return_at_every_depth():
    # If V satisfies the Bellman equation along the rollout, looking further changes nothing.
    rewards, _, _ = rollout(5, 1, 1)
    values = torch.zeros(6, dtype=torch.float64)
    values[5] = 3.0
    for u in range(4, -1, -1):
        values[u] = rewards[u, 0] + 0.9 * values[u + 1]
    table = return_table(rewards, values[1:, None, None], 0.9)
    torch.testing.assert_close(table, values[0].expand(5, 1, 1))


def test_alive_weights_match_a_hand_computed_table():
    rewards = torch.tensor([[1.0], [4.0], [8.0]])
    values = torch.tensor([10.0, 20.0, 40.0]).view(3, 1, 1)
    alive = torch.tensor([[0.5], [0.25], [0.0]])
    # depth 1: 1 + .5 * 10/2; depth 2: 1 + .5 * 4/2 + .25 * 20/4; depth 3: 1 + .5 * 4/2 + .25 * 8/4 + 0
    assert return_table(rewards, values, 0.5, alive).flatten().tolist() == [3.5, 3.25, 2.5]


def test_a_discount_in_a_tensor_equals_a_float():
    rewards, values, alive = rollout(3, 2, 2)
    expected = return_table(rewards, values, 0.75, alive)
    assert torch.equal(return_table(rewards, values, torch.tensor(0.75, dtype=torch.float64), alive), expected)
    rewards, values = rewards.float(), values.float()
    single = return_table(rewards, values, torch.tensor(0.75, dtype=torch.float64))
    assert single.dtype == torch.float32
    torch.testing.assert_close(single, return_table(rewards, values, 0.75))


def test_any_leading_batch_gives_the_result_of_its_parts_and_inputs_are_left_alone():
    rewards, values, alive = rollout(3, 2, 2, 4, 5)
    before = [rewards.clone(), values.clone(), alive.clone()]
    table = return_table(rewards, values, 0.9, alive)
    assert table.shape == (4, 5, 3, 2, 2)
    torch.testing.assert_close(table[3, 1], return_table(rewards[3, 1], values[3, 1], 0.9, alive[3, 1]))
    assert all(torch.equal(a, b) for a, b in zip((rewards, values, alive), before, strict=True))


@pytest.mark.parametrize(("rewards", "values"), [((3, 2), (4, 2, 2)), ((3, 2), (3, 4, 2)), ((5, 3, 2), (5, 1, 1, 2))])
def test_tables_that_do_not_fit_are_refused_with_their_shapes(rewards, values):
    message = (
        f"return_table needs rewards [..., H, F] and values [..., D, F, V] with D <= H, got {rewards} and {values}."
    )
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        return_table(torch.zeros(rewards), torch.zeros(values), 0.9)


@pytest.mark.parametrize(("steps", "discount"), [(500, 0.99), (1000, 0.995), (200, 0.975), (100, 0.95)])
def test_the_discount_heuristic_gives_the_published_discounts(steps, discount):
    assert discount_from_episode_length(steps) == pytest.approx(discount, abs=1e-12)


@pytest.mark.parametrize(("steps", "discount"), [(1, 0.95), (50, 0.95), (1001, 0.995), (10**6, 0.995)])
def test_the_discount_heuristic_is_clipped_at_both_ends(steps, discount):
    assert discount_from_episode_length(steps) == discount


def test_the_discount_heuristic_follows_its_bounds_and_denominator():
    assert discount_from_episode_length(10, discount_min=0.1) == pytest.approx(0.5)
    assert discount_from_episode_length(10**4, discount_max=1.0) == pytest.approx(0.9995)
    assert discount_from_episode_length(500, denominator=10.0) == pytest.approx(0.98)


@pytest.mark.parametrize("steps", [0, -500])
def test_an_episode_without_steps_has_no_discount(steps):
    message = f"decision_steps must be positive, got {steps}; pass the episode length in decisions."
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        discount_from_episode_length(steps)


@pytest.mark.parametrize("ends", [False, True])
def test_bootstrapped_returns_are_those_of_torchrl(ends):
    generator = torch.Generator().manual_seed(3)
    rewards, values = (torch.randn(6, 50, generator=generator, dtype=torch.float64) for _ in range(2))
    terminated = (torch.rand(6, 50, generator=generator) < 0.2) & ends
    done = terminated.clone()
    done[-1] = True  # the slice ends there, and the values tell what is left
    entries = (entry.T.unsqueeze(-1) for entry in (values, rewards, done, terminated))
    expected = td1_return_estimate(0.9, *entries).squeeze(-1).T
    torch.testing.assert_close(bootstrapped_returns(rewards, values, 0.9, terminated=terminated), expected)


def test_bootstrapped_returns_of_one_step_are_reward_and_discounted_value():
    torch.testing.assert_close(bootstrapped_returns(torch.ones(1), torch.ones(1), 0.25), torch.tensor([1.25]))


@pytest.mark.parametrize("length", [1, 2, 3, 4])
def test_bootstrapped_returns_end_where_the_steps_cease_to_count(length):
    rewards, values = torch.randn(2, 4, 5)
    counts = (torch.arange(4) < length).unsqueeze(-1).expand(4, 5)
    short = bootstrapped_returns(rewards[:length], values[:length], 0.9)
    torch.testing.assert_close(bootstrapped_returns(rewards, values, 0.9, counts=counts)[:length], short)


def test_nothing_is_bootstrapped_where_the_last_step_that_counts_terminates():
    rewards, values = torch.ones(3), torch.full((3,), 100.0)
    ends = {"terminated": torch.tensor([False, True, False]), "counts": torch.tensor([True, True, False])}
    assert bootstrapped_returns(rewards, values, 0.5, **ends)[:2].tolist() == [1.5, 1.0]


def test_a_task_without_a_time_limit_has_the_largest_discount():
    assert discount_from_episode_length(float("inf")) == discount_from_episode_length(1e300) == 0.995
    assert discount_from_episode_length(float("inf"), discount_max=1.0) == 1.0
    with pytest.raises(ValueError, match="^decision_steps must be positive, got nan"):
        discount_from_episode_length(float("nan"))
