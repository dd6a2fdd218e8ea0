from __future__ import annotations

import copy
import importlib.util

import pytest
import torch

pytest.importorskip("dm_control")

from torchrl_etdmpc import EnsembleMPPIPlanner, LatentEnv, WorldModel  # noqa: E402
from torchrl_etdmpc.envs import EASY_DMC, HARD_DMC, load_simulator_state, make_env, simulator_state  # noqa: E402
from torchrl_etdmpc.inspector import Episode, Simulator, episodes, play_episode  # noqa: E402
from torchrl_etdmpc.planners import BarePolicy  # noqa: E402

needs_gym = pytest.mark.skipif(importlib.util.find_spec("gymnasium") is None, reason="needs gymnasium")
needs_mujoco = pytest.mark.skipif(importlib.util.find_spec("imageio") is None, reason="needs gymnasium[mujoco]")


def sizes(task: str) -> tuple[int, int]:
    env = make_env(task, seed=0)
    return env.observation_spec["observation"].shape[-1], env.action_spec.shape[-1]


def small_model(task: str) -> WorldModel:
    torch.manual_seed(0)
    return WorldModel(*sizes(task), latent_dim=16, mlp_dim=16, encoder_dim=16, num_dynamics=2)


def small_planner(task: str, **settings: object) -> EnsembleMPPIPlanner:
    budget = {"horizon": 3, "num_samples": 8, "num_elites": 4, "num_proposals": 2, "iterations": 1}
    return EnsembleMPPIPlanner(LatentEnv(small_model(task)), **budget | settings)


def equal(one: object, other: object) -> bool:
    if isinstance(one, dict):
        return isinstance(other, dict) and all(equal(one[name], other[name]) for name in one)
    return torch.equal(one, other) if isinstance(one, torch.Tensor) else one == other


@pytest.fixture(scope="module")
def walk() -> Episode:
    return play_episode(small_planner("walker-walk"), "walker-walk", seed=3, steps=12)


def test_an_episode_has_a_state_before_and_after_every_decision(walk):
    assert walk.observation.shape == (13, 24)
    assert walk.action.shape == (12, 6)
    assert walk.reward.shape == (12,)
    assert len(walk.states) == 13
    assert (walk.task, walk.seed, walk.terminated) == ("walker-walk", 3, False)


def test_the_states_of_an_episode_share_its_actions(walk):
    actions = [state["_extra_state"]["actions"] for state in walk.states]
    assert [len(part) for part in actions] == list(range(13))
    assert len({part.untyped_storage().data_ptr() for part in actions}) == 1


def test_an_episode_follows_from_its_seed_and_leaves_the_callers_random_numbers(walk):
    planner = small_planner("walker-walk")
    before = torch.random.get_rng_state()
    again = play_episode(planner, "walker-walk", seed=3, steps=12)
    assert torch.equal(torch.random.get_rng_state(), before)
    assert torch.equal(again.action, walk.action)
    assert torch.equal(again.observation, walk.observation)
    assert equal(again.states[-1], walk.states[-1])
    other = play_episode(planner, "walker-walk", seed=4, steps=12)
    assert not torch.equal(other.action, walk.action)
    assert not torch.equal(other.observation[0], walk.observation[0])


def test_the_warm_start_is_the_plan_before_and_nothing_in_the_first_decision(walk):
    planner = small_planner("walker-walk")
    assert walk.plan_mean.shape == (12, 3, 6)
    assert not walk.plan_mean[0].any()
    torch.manual_seed(3)
    first = planner.plan(walk.observation[:1], walk.plan_mean[:1], explore=False)
    assert torch.allclose(first.mean[0], walk.plan_mean[1], atol=1e-6)
    assert torch.allclose(first.action[0], walk.action[0], atol=1e-6)


def test_what_carries_no_plan_has_none():
    for policy in (BarePolicy(small_model("walker-walk")), small_planner("walker-walk", warm_start=False)):
        assert play_episode(policy, "walker-walk", seed=0, steps=2).plan_mean is None


def test_a_whole_episode_ends_at_its_time_limit():
    episode = play_episode(BarePolicy(small_model("cartpole-balance")), "cartpole-balance", seed=0)
    assert episode.reward.shape == (500,)
    assert not episode.terminated


@needs_gym
@needs_mujoco
def test_an_episode_that_terminates_says_so():
    task = "gym/InvertedPendulum-v5"
    episode = play_episode(BarePolicy(small_model(task)), task, seed=0)
    assert episode.terminated
    assert len(episode.reward) < 500
    simulator = Simulator(task)
    simulator.restore(episode.states[-2])
    rolled = simulator.roll(episode.action[-1:].expand(5, -1))
    assert rolled.terminated
    assert rolled.reward.shape == (1,)
    simulator.restore(episode.states[-1])
    assert simulator.roll(episode.action[-1:]).reward.shape == (0,)  # it is over


def test_an_episode_that_is_given_up_leaves_no_environment_open(monkeypatch):
    made = []

    def make(*arguments, **options):
        made.append(make_env(*arguments, **options))
        return made[-1]

    monkeypatch.setattr(episodes, "make_env", make)
    planner = small_planner("walker-walk")

    def stop(*_):
        raise KeyboardInterrupt

    planner.register_forward_pre_hook(stop)
    with pytest.raises(KeyboardInterrupt):
        play_episode(planner, "walker-walk", seed=0)
    assert [env.is_closed for env in made] == [True]


def test_no_steps_are_refused():
    with pytest.raises(ValueError, match="steps must be at least 1, got 0"):
        play_episode(BarePolicy(small_model("walker-walk")), "walker-walk", seed=0, steps=0)


def go_back_and_forth(task: str, steps: int = 8) -> None:
    """From every state, by every way of going there, the same as in the episode and in a simulator made anew."""
    torch.manual_seed(1)
    _, action_dim = sizes(task)
    env = make_env(task, seed=5)
    carrier, states, actions = env.reset(), [simulator_state(env)], torch.rand(steps, action_dim) * 2 - 1
    observations = [carrier["observation"]]
    for action in actions:
        carrier = env.step(carrier.set("action", action))["next"]
        observations.append(carrier["observation"])
        states.append(simulator_state(env))
    fast = Simulator(task, seed=9)
    other = torch.rand(steps, action_dim) * 2 - 1
    for start in (3, 3, 0, 5, 5, 6, 2, steps - 1, 3):  # again, to before, on, to before
        fast.restore(states[start])
        assert torch.equal(fast.observation, observations[start])
        assert equal(simulator_state(fast.env), states[start])
        assert torch.equal(fast.roll(actions[start:]).observation, torch.stack(observations[start:]))
        assert equal(simulator_state(fast.env), states[-1])
        fast.restore(states[start])
        rolled = fast.roll(other)
        slow = make_env(task, seed=11)
        slow.reset()
        assert load_simulator_state(slow, states[start])
        for step, action in enumerate(other):
            following = slow.step(carrier.set("action", action))["next"]
            assert torch.equal(following["observation"], rolled.observation[step + 1])
            assert torch.equal(following["reward"].squeeze(-1), rolled.reward[step])


# Contacts, sensors of touch and force, a target drawn at the reset, and a suite without a short way back.
@pytest.mark.parametrize(
    "task", ["walker-walk", "finger-spin", "reacher-easy", pytest.param("gym/Pendulum-v1", marks=needs_gym)]
)
def test_going_back_is_exact_by_every_way(task):
    go_back_and_forth(task)


@pytest.mark.slow
@pytest.mark.parametrize("task", [*EASY_DMC, *HARD_DMC])
def test_going_back_is_exact_on_every_task(task):
    go_back_and_forth(task, steps=40)


def test_going_back_to_the_same_place_or_on_from_it_does_not_repeat_the_episode(walk, monkeypatch):
    simulator, decided = Simulator("walker-walk"), 0
    decide = type(simulator.env)._decide

    def count(self, action):
        nonlocal decided
        decided += 1
        return decide(self, action)

    monkeypatch.setattr(type(simulator.env), "_decide", count)
    for state, cost in ((10, 10), (10, 0), (12, 2), (12, 0), (4, 4)):
        decided = 0
        simulator.restore(walk.states[state])
        assert decided == cost


def test_rolling_the_episodes_own_actions_gives_the_episode(walk):
    simulator = Simulator("walker-walk")
    simulator.restore(walk.states[4])
    rolled = simulator.roll(walk.action[4:])
    assert torch.equal(rolled.observation, walk.observation[4:])
    assert torch.equal(rolled.reward, walk.reward[4:])
    assert not rolled.terminated


def test_the_starts_of_two_episodes_are_two_places(walk):
    other = play_episode(BarePolicy(small_model("walker-walk")), "walker-walk", seed=4, steps=1)
    simulator = Simulator("walker-walk")
    for episode in (walk, other, walk):
        simulator.restore(episode.states[0])
        assert torch.equal(simulator.observation, episode.observation[0])
        assert torch.equal(simulator.roll(episode.action[:1]).observation, episode.observation[:2])


def test_a_state_of_another_task_is_refused(walk):
    simulator = Simulator("reacher-easy")
    with pytest.raises(ValueError, match="state cannot be restored: it is not one of task 'reacher-easy'; make"):
        simulator.restore(walk.states[4])
    simulator = Simulator("cheetah-run")  # as many actions, another place
    with pytest.raises(ValueError, match="state cannot be restored"):
        simulator.restore(walk.states[4])
    simulator.restore(play_episode(BarePolicy(small_model("cheetah-run")), "cheetah-run", seed=0, steps=2).states[1])


def test_a_state_that_leads_elsewhere_is_refused(walk):
    simulator = Simulator("walker-walk")
    for state in (4, 6):  # through the episode; and on from a place, which is then forgotten
        changed = copy.deepcopy(walk.states[state])
        changed["_extra_state"]["fingerprint"][0] += 1e-12
        with pytest.raises(ValueError, match="state cannot be restored exactly on task 'walker-walk'"):
            simulator.restore(changed)
        simulator.restore(walk.states[4])
        assert torch.equal(simulator.observation, walk.observation[4])


def test_no_state_is_refused():
    with pytest.raises(ValueError, match="does not record its episodes; take a task of dm_control or Gymnasium"):
        Simulator("walker-walk").restore(None)


def test_frames_without_a_renderer_name_the_remedy(walk, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "disable")
    simulator = Simulator("walker-walk")
    simulator.restore(walk.states[1])
    with pytest.raises(RuntimeError, match="set MUJOCO_GL=egl before Python starts"):
        simulator.frame()
    with pytest.raises(RuntimeError, match="task 'walker-walk' cannot be rendered: frames of walker must be"):
        simulator.frame(10_000, 10_000)
