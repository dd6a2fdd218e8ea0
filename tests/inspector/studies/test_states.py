from __future__ import annotations

import pytest
import torch

from torchrl_etdmpc.inspector.studies.calibration import rank_correlation
from torchrl_etdmpc.inspector.studies.replan import true_returns
from torchrl_etdmpc.inspector.studies.states import choose_states, episode_interval, roll_all
from torchrl_etdmpc.testing import LineWorld


def test_states_are_drawn_without_repeats_in_the_order_of_their_episodes(make_episodes):
    episodes = make_episodes(LineWorld(), torch.zeros_like, count=4, steps=9)
    states = choose_states(episodes, 20, ahead=3, seed=1)
    places = list(zip(states.episode.tolist(), states.step.tolist(), strict=True))
    assert places == sorted(set(places))
    assert len(places) == 20
    assert set(states.episode.tolist()) == {0, 1, 2, 3}
    assert int(states.step.max()) <= 9 - 3
    for index, (episode, step) in enumerate(places):
        assert torch.equal(states.observation[index], episodes[episode].observation[step])
        assert torch.equal(states.simulator[index], episodes[episode].states[step])
    assert states.plan_mean.shape == (20, 3, 1)
    assert places != list(zip(*(f.tolist() for f in choose_states(episodes, 20, ahead=3)[-2:]), strict=True))


def test_all_states_are_taken_where_there_are_not_enough(make_episodes):
    episodes = make_episodes(LineWorld(), torch.zeros_like, count=2, steps=5)
    assert len(choose_states(episodes, 100, ahead=2).step) == 2 * 4
    assert len(choose_states(episodes, 100).step) == 2 * 5  # of every decision


def test_every_decision_counts_of_an_episode_that_ended_its_task(make_episodes):
    cut, ended = make_episodes(LineWorld(), torch.zeros_like, count=2, steps=5)
    states = choose_states([cut, ended._replace(terminated=True)], 100, ahead=3)
    assert states.step[states.episode == 0].tolist() == [0, 1, 2]
    assert states.step[states.episode == 1].tolist() == [0, 1, 2, 3, 4]


def test_of_an_episode_that_ended_no_state_has_the_time_limit_ahead(make_episodes):
    ended = make_episodes(LineWorld(), torch.zeros_like, count=1, steps=5)[0]._replace(terminated=True)
    for limit, last in ((5, 2), (6, 3), (7, 4), (100, 4)):  # its fifth decision ended it
        assert choose_states([ended], 100, ahead=3, limit=limit).step.tolist() == list(range(last + 1))


def test_no_states_are_an_error(make_episodes):
    episodes = make_episodes(LineWorld(), torch.zeros_like, count=2, steps=5)
    for count, ahead in ((5, 6), (0, 1)):
        with pytest.raises(ValueError, match=f"have {ahead} decisions after them, got states={count} and episodes of"):
            choose_states(episodes, count, ahead=ahead)


def test_an_interval_knows_that_states_of_one_episode_are_no_independent_evidence():
    values = torch.tensor([0.0, 1.0, 2.0, 3.0]).repeat_interleave(100)
    episode = torch.arange(4).repeat_interleave(100)
    together = episode_interval(values, episode)
    apart = episode_interval(values, torch.arange(400))
    assert together.value.item() == apart.value.item() == 1.5
    assert together.high - together.low > 5 * (apart.high - apart.low)
    assert 0 <= together.low < 1.5 < together.high <= 3


def test_the_interval_is_that_of_95_percent_of_the_resamples():
    values = torch.randn(60, generator=torch.Generator().manual_seed(0))
    interval = episode_interval(values, torch.arange(60), resamples=4000)
    error = values.std(correction=0) / 60**0.5
    assert ((interval.high - interval.low) / (2 * error)).item() == pytest.approx(1.96, rel=0.06)


def test_an_interval_holds_its_value_and_none_is_beside_no_value():
    """Every resample has ties that the states have not."""
    levels, episode = torch.randn(10, generator=torch.Generator().manual_seed(0)), torch.arange(40) // 4
    noise = torch.randn(40, 2, generator=torch.Generator().manual_seed(100))
    pairs = levels[episode].unsqueeze(-1) + 0.05 * noise
    interval = episode_interval(pairs, episode, rank_correlation, resamples=200)
    assert interval.low < interval.value <= interval.high
    assert interval.high == interval.value
    nothing = episode_interval(torch.tensor([1.0, torch.nan, 3.0]), torch.arange(3), lambda rows: rows.mean(0))
    assert nothing.value.isnan() and nothing.low.isnan() and nothing.high.isnan()


def test_an_episode_of_which_no_state_was_drawn_changes_no_interval():
    values = torch.tensor([0.0, 1.0, 5.0, 7.0])
    with_gaps, without = (episode_interval(values, torch.tensor(of)) for of in ([2, 2, 5, 7], [0, 0, 1, 2]))
    assert all(map(torch.equal, with_gaps, without))


def test_one_episode_has_no_interval():
    interval = episode_interval(torch.arange(3.0), torch.zeros(3))
    assert interval.value.item() == 1
    assert interval.low.isnan()
    assert interval.high.isnan()


def test_intervals_take_any_shape_and_statistic():
    values, episode = torch.rand(40, 2, 3), torch.arange(40) % 5
    assert episode_interval(values, episode).low.shape == (2, 3)
    largest = episode_interval(values, episode, lambda rows: rows.amax((0, 2)), resamples=50)
    assert torch.equal(largest.value, values.amax((0, 2)))
    assert (largest.low <= largest.high).all()


def test_nothing_is_earned_or_observed_after_the_end(make_episodes, WorldSimulator, EndingSimulator):
    world = LineWorld()
    states = choose_states(make_episodes(world, torch.zeros_like), 3, ahead=4)
    observation, reward, alive = roll_all(EndingSimulator(world), states, torch.ones(3, 4, 1))
    assert torch.equal(alive, torch.tensor([[True, True, False, False, False]]).expand(3, -1))
    assert reward[:, :2].abs().min() > 0
    assert not reward[:, 2:].any()
    assert observation[:, :3].isfinite().all()
    assert observation[:, 3:].isnan().all()
    whole, _, lives = roll_all(WorldSimulator(world), states, torch.ones(3, 4, 1))
    assert lives.all()
    assert torch.allclose(whole[:, -1] - whole[:, 0], torch.tensor(2.0))


def test_the_state_in_which_the_task_ends_is_worth_nothing(make_planner, make_episodes, EndingSimulator):
    world = LineWorld(value_offset=torch.tensor([100.0]))
    states = choose_states(make_episodes(world, torch.zeros_like), 3, ahead=4)
    returns = true_returns(make_planner(world), *roll_all(EndingSimulator(world), states, torch.ones(3, 4, 1)))
    assert (returns[:, 0] > 50).all()
    assert (returns[:, 1:] < 50).all()


def test_what_follows_a_time_limit_is_unknown(make_planner, make_episodes, WorldSimulator):
    class CutSimulator(WorldSimulator):
        def roll(self, actions):
            return super().roll(actions[:2])

    world = LineWorld(value_offset=torch.tensor([100.0]))
    states = choose_states(make_episodes(world, torch.zeros_like), 3, ahead=4)
    observation, reward, alive = roll_all(CutSimulator(world), states, torch.ones(3, 4, 1))
    assert alive.all()
    assert reward[:, 2:].isnan().all()
    returns = true_returns(make_planner(world), observation, reward, alive)
    assert (returns[:, :2] > 50).all()
    assert returns[:, 2:].isnan().all()
