from __future__ import annotations

import pytest
import torch
from scipy.stats import spearmanr

from torchrl_etdmpc.inspector.studies import calibration, choose_states
from torchrl_etdmpc.testing import LineWorld


class Unsure(LineWorld):
    """Two heads that are wrong, and apart, by shares of how far from 0 they are."""

    wrong, apart = 0.0, 0.0

    def next(self, latent, action):
        following = super().next(latent, action).clone()
        shares = torch.tensor([self.wrong + self.apart, self.wrong - self.apart])
        distance = latent[..., 0].abs().expand(following.shape[:-1])
        following[..., 0] += shares.view(2, *(1,) * (following.ndim - 2)) * distance
        return following


@pytest.fixture
def measure(make_episodes, make_planner, WorldSimulator):
    def run(wrong: float, apart: float) -> calibration.Calibration:
        world = Unsure(num_dynamics=2, policy_gain=1.0)
        world.wrong, world.apart = wrong, apart
        states = choose_states(make_episodes(world, torch.zeros_like, count=30, steps=2), 60, ahead=2)
        planner = make_planner(world, num_samples=16, num_elites=4, iterations=1)
        return calibration.calibration(planner, states, WorldSimulator(world), horizon=2)

    return run


def test_heads_that_are_apart_where_they_are_wrong_are_calibrated(measure):
    result = measure(wrong=0.3, apart=0.1)
    assert torch.allclose(result.error[..., 0], 3 * result.disagreement[..., 0], atol=1e-5)
    first = [row for row in calibration.table(result) if row["depth"] == 1]
    for row in first:
        assert row["rank_correlation"] == pytest.approx(1, abs=0.01)
        assert row["error_over_disagreement"] == pytest.approx(3, rel=1e-3)
    said = [line.partition(":")[0] for line in calibration.lines(result)]
    assert said == [f"{kind} actions, depth {depth}" for kind in ("planned", "random") for depth in (1, 2)]
    points = calibration.figure(result).axes[0].collections[0].get_offsets()
    assert points.tolist() == torch.stack([result.disagreement[:, 0, 0], result.error[:, 0, 0]], dim=-1).tolist()


def test_heads_that_err_alike_do_not_know_it(measure):
    result = measure(wrong=0.3, apart=0.0)
    assert result.error[..., 0].mean() > 0.05
    assert result.disagreement[..., 0].abs().max() < 1e-6


def test_fewer_than_two_pairs_have_no_rank_correlation():
    pairs = torch.tensor([[1.0, 2.0], [2.0, 5.0], [3.0, 1.0]])
    for left in (0, 1):
        missing = torch.arange(3) >= left
        assert calibration.rank_correlation(pairs.where(~missing[:, None], torch.nan)).isnan()
    assert calibration.rank_correlation(pairs[:2]) == 1
    assert calibration.rank_correlation(torch.ones(2, 2)) == 0
    # Only one of the episodes that resamples are drawn from has states that are left.
    alone = calibration.Calibration(*torch.rand(2, 6, 2, 1), torch.arange(6) % 3)
    disagreement, error = (x.where((torch.arange(6) % 3 == 0)[:, None, None], torch.nan) for x in alone[:2])
    for row in calibration.table(alone._replace(disagreement=disagreement, error=error)):
        assert abs(row["rank_correlation"]) == 1
        assert {row["low"], row["high"]} == {row["rank_correlation"]}


def test_random_actions_go_both_ways(make_episodes, make_planner, WorldSimulator):
    rolled = []

    class Watched(WorldSimulator):
        def roll(self, actions):
            rolled.append(actions)
            return super().roll(actions)

    world = Unsure(num_dynamics=2, policy_gain=1.0)
    states = choose_states(make_episodes(world, torch.zeros_like), 20, ahead=2)
    planner = make_planner(world, num_samples=16, num_elites=4, iterations=1)
    calibration.calibration(planner, states, Watched(world), horizon=2)
    random = torch.stack(rolled[20:])
    assert -1 <= random.min() < -0.5
    assert 0.5 < random.max() <= 1


def test_rank_correlation_is_spearman_s():
    torch.manual_seed(0)
    pairs = torch.randn(50, 3, 2)
    pairs[:, 1] = pairs[:, 1].round()  # ties
    pairs[:, 2, 1] = pairs[:, 2, 0].exp()
    expected = [spearmanr(pairs[:, column, 0], pairs[:, column, 1]).statistic for column in range(3)]
    assert calibration.rank_correlation(pairs).tolist() == pytest.approx(expected)
    assert calibration.rank_correlation(torch.ones(5, 2)).item() == 0


def test_one_head_is_refused(make_episodes, make_planner, WorldSimulator):
    world = LineWorld()
    states = choose_states(make_episodes(world, torch.zeros_like), 4, ahead=2)
    with pytest.raises(ValueError, match="num_dynamics must be at least 2 for heads to disagree, got 1"):
        calibration.calibration(make_planner(world), states, WorldSimulator(world))


def test_what_lies_behind_the_end_of_the_task_is_no_error(make_episodes, make_planner, EndingSimulator):
    world = Unsure(num_dynamics=2, policy_gain=1.0)
    world.wrong, world.apart = 0.3, 0.1
    states = choose_states(make_episodes(world, torch.zeros_like, count=20, steps=4), 20, ahead=4)
    planner = make_planner(world, num_samples=16, num_elites=4, iterations=1)
    result = calibration.calibration(planner, states, EndingSimulator(world), horizon=4)
    for field in (result.error, result.disagreement):
        assert field[..., :2].isfinite().all()
        assert field[..., 2:].isnan().all()
    rows = calibration.table(result)
    assert [row["states"] for row in rows] == 2 * [20, 20, 0, 0]
    calibration.figure(result)
    for field in (result.error, result.disagreement):
        field[5:, :, 0] = torch.nan
        field[:5, :, 0] = torch.arange(5.0).unsqueeze(1)
    first = calibration.table(result)[0]
    found = [first[name] for name in ("error", "disagreement", "error_over_disagreement", "rank_correlation")]
    assert found == pytest.approx([2, 2, 1, 1])


def test_pairs_that_are_not_there_change_no_rank():
    torch.manual_seed(0)
    pairs = torch.randn(30, 2)
    pairs[::3, 1] = torch.nan
    expected = spearmanr(*pairs[~pairs[:, 1].isnan()].T).statistic
    assert calibration.rank_correlation(pairs).item() == pytest.approx(expected)


def test_a_ratio_is_that_of_the_means_and_intervals_are_over_episodes():
    disagreement = torch.tensor([1.0, 3.0]).repeat(20).view(40, 1, 1).expand(-1, 2, 1)
    error = torch.tensor([[1.0, 9.0], [18.0, 2.0]]).repeat_interleave(10, 0).view(40, 1, 1).expand(-1, 2, 1)
    for row in calibration.table(calibration.Calibration(disagreement, error, torch.arange(40) // 20)):
        ratio = [row[name] for name in ("ratio_low", "error_over_disagreement", "ratio_high")]
        assert ratio == pytest.approx([2.5, 3.75, 5])
        assert [row["low"], row["high"]] == pytest.approx([-1, 1])
