from __future__ import annotations

import importlib.util
import io

import numpy as np
import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import (
    ActionScaling,
    CatFrames,
    EnvBase,
    GymEnv,
    RewardScaling,
    StepCounter,
    TimeMaxPool,
    Transform,
    TransformedEnv,
)
from torchrl.envs.transforms import VecNormV2
from torchrl.testing.mocking_classes import ContinuousActionVecMockEnv

pytest.importorskip("dm_control")

from torchrl_etdmpc import SeedPolicy, SimulatorError, StepCollector  # noqa: E402
from torchrl_etdmpc.envs import get_task, load_simulator_state, simulator_state  # noqa: E402
from torchrl_etdmpc.envs import make_env as make_any_env  # noqa: E402
from torchrl_etdmpc.envs.episode import equal_states, transform_states  # noqa: E402

LIMIT = 9
THIRD = 2 * LIMIT + 3  # a step of the third episode
needs_gym = pytest.mark.skipif(importlib.util.find_spec("gymnasium") is None, reason="needs gymnasium")
needs_mujoco = pytest.mark.skipif(importlib.util.find_spec("imageio") is None, reason="needs gymnasium[mujoco]")


def make_env(task: str, num_envs: int, *, parallel: bool, seed: int = 3) -> EnvBase:
    """Episodes of nine steps; the last transform is outside the workers."""
    return make_any_env(task, seed=seed, num_envs=num_envs, parallel=parallel).append_transform(StepCounter(LIMIT))


def step(env: EnvBase, carrier: TensorDictBase) -> tuple[TensorDictBase, TensorDictBase]:
    carrier.set("action", torch.rand(env.action_spec.shape) * 2 - 1)
    stepped, carrier = env.step_and_maybe_reset(carrier)
    return stepped.clone(), carrier


def through_a_file(state):
    """As a checkpoint would: only tensors and plain containers survive ``weights_only``."""
    file = io.BytesIO()
    torch.save(state, file)
    file.seek(0)
    return torch.load(file, weights_only=True)


@pytest.mark.parametrize(
    ("task", "num_envs", "steps"),
    [
        ("walker-walk", 1, 4),  # of the first episode
        ("walker-walk", 2, THIRD),
        ("quadruped-walk", 1, THIRD),  # random initial orientation, rescaled actions
        ("reacher-easy", 1, THIRD),  # a target drawn at every reset
        ("humanoid-run", 1, THIRD),
        ("finger-spin", 1, THIRD),
        pytest.param("gym/Pendulum-v1", 1, 4, marks=needs_gym),
        pytest.param("gym/Pendulum-v1", 1, THIRD, marks=needs_gym),
        pytest.param("gym/Hopper-v5", 2, THIRD, marks=needs_mujoco),
    ],
)
def test_another_environment_goes_on_where_the_first_one_was(task, num_envs, steps):
    resume(task, num_envs, parallel=False, steps=steps)


@pytest.mark.slow  # worker processes start four times
def test_worker_processes_go_on_where_the_first_ones_were():
    resume("walker-walk", 2, parallel=True, steps=THIRD)


@pytest.mark.slow  # worker processes start four times
@needs_gym
def test_worker_processes_of_gymnasium_go_on_where_the_first_ones_were():
    resume("gym/Pendulum-v1", 2, parallel=True, steps=THIRD)


def resume(task: str, num_envs: int, parallel: bool, steps: int) -> None:
    torch.manual_seed(0)
    first, second = (make_env(task, num_envs, parallel=parallel, seed=seed) for seed in (3, 4))
    carrier = first.reset()
    for _ in range(steps):
        _, carrier = step(first, carrier)
    state, resumed = through_a_file(simulator_state(first)), carrier.clone()
    torch.manual_seed(1)
    expected = []
    for _ in range(2 * LIMIT):  # over two resets
        stepped, carrier = step(first, carrier)
        expected.append(stepped)
    assert load_simulator_state(second, state)
    torch.manual_seed(1)
    for wanted in expected:
        stepped, resumed = step(second, resumed)
        assert (stepped == wanted).all()
    first.close()
    second.close()


@pytest.mark.parametrize(
    ("name", "steps", "resets"),
    [
        pytest.param("gym/Pendulum-v1", 170, 1, marks=needs_gym),
        pytest.param("gym/InvertedPendulum-v5", 33, 5, marks=needs_mujoco),  # falls often
        pytest.param("gym/Hopper-v5", 30, 1, marks=needs_mujoco),
        ("pendulum-swingup", 470, 1),
    ],
)
def test_an_episode_goes_on_to_its_own_end_and_into_the_next_ones(name, steps, resets):
    first, second = (make_any_env(get_task(name), seed=seed) for seed in (3, 4))
    torch.manual_seed(0)
    carrier = first.reset()
    for _ in range(steps):
        _, carrier = step(first, carrier)
    state, resumed = through_a_file(simulator_state(first)), carrier.clone()
    assert 0 < len(state["_extra_state"]["actions"])  # in the middle of an episode
    second.rollout(5)  # in another one
    assert load_simulator_state(second, state)
    seen = 0
    for _ in range(60):
        action = torch.rand(first.action_spec.shape) * 2 - 1
        wanted, carrier = first.step_and_maybe_reset(carrier.set("action", action))
        stepped, resumed = second.step_and_maybe_reset(resumed.set("action", action))
        assert (stepped == wanted).all()
        assert (resumed == carrier).all()
        seen += wanted["next", "done"].item()
    assert seen >= resets


def test_a_bookmark_leads_back_from_behind_the_end_of_an_episode():
    env = make_any_env(get_task("walker-walk", episode_length=8), seed=3)
    action = env.action_spec.rand()
    env.step(env.reset().set("action", action))
    env._env.task.memory = [1]  # what a task of one's own may remember
    lead_back, rests, place = env.bookmark(), [], through_a_file(simulator_state(env))
    for _ in range(2):
        rest = [env.step(TensorDict({"action": action}))["next"] for _ in range(3)]
        rests.append([(row["observation"].tolist(), row["reward"].item(), row["truncated"].item()) for row in rest])
        env._env.task.memory.append(2)
        assert not equal_states(simulator_state(env), place)
        lead_back()
        assert equal_states(simulator_state(env), place)  # the record of the episode, and what it has paid
        assert env._env.task.memory == [1]
    assert rests[0] == rests[1]
    assert [truncated for _, _, truncated in rests[0]] == [False, False, True]


@needs_gym
def test_the_state_that_a_seeded_reset_began_with_is_kept():
    first, second = (make_any_env("gym/Pendulum-v1") for _ in range(2))
    start = first.reset(seed=7)["observation"]
    assert torch.equal(start, GymEnv("Pendulum-v1").reset(seed=7)["observation"])
    assert load_simulator_state(second, simulator_state(first))
    assert torch.equal(first.reset()["observation"], second.reset()["observation"])


@needs_gym
def test_an_episode_whose_reset_fails_again_begins_afresh_and_is_no_error(monkeypatch):
    env, other = (make_any_env("gym/Pendulum-v1", seed=0) for _ in range(2))
    env.rollout(3)
    reset = type(env._env.unwrapped).reset

    def failing(self, **options):
        reset(self, **options)  # after the random numbers are drawn
        raise RuntimeError("no answer")

    monkeypatch.setattr(type(env._env.unwrapped), "reset", failing)
    with pytest.raises(RuntimeError, match="no answer"):
        env.reset()
    state = simulator_state(env)
    load_simulator_state(other, state)  # whether it is there is the collector's to see
    monkeypatch.undo()
    assert other.reset()["observation"].isfinite().all()


@needs_gym
def test_a_simulator_of_gymnasium_that_behaves_otherwise_is_noticed():
    first, second = (make_any_env("gym/Pendulum-v1", seed=0) for _ in range(2))
    first.rollout(3)
    second._env.unwrapped.g = 5.0
    assert not load_simulator_state(second, simulator_state(first))


@needs_gym
@pytest.mark.parametrize("num_envs", [1, 2])
def test_a_simulator_of_gymnasium_without_a_known_random_state_says_that_it_cannot_be_restored(num_envs):
    def make(unrepeatable: bool) -> EnvBase:
        env = make_any_env("gym/Pendulum-v1", num_envs=num_envs, parallel=False)
        if unrepeatable:
            env.reset()  # starts several environments
            for single in getattr(env, "_envs", [env])[-1:]:  # one is enough
                single._env.unwrapped.np_random = np.random.Generator(np.random.MT19937(0))
        env.reset()
        return env

    state = simulator_state(make(False))
    assert state is not None
    assert simulator_state(make(True)) is None
    assert not load_simulator_state(make(False), None)


@needs_gym
def test_what_is_registered_as_nondeterministic_cannot_be_restored():
    import gymnasium

    gymnasium.register(
        "Random-v0", gymnasium.registry["Pendulum-v1"].entry_point, max_episode_steps=9, nondeterministic=True
    )
    try:
        env = make_any_env("gym/Random-v0")
        env.reset()
        assert simulator_state(env) is None
    finally:
        del gymnasium.registry["Random-v0"]


@needs_gym
@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_a_simulator_whose_rewards_are_drawn_by_chance_is_not_brought_back(noise):
    """The place is reached exactly; what was paid on the way there is not."""
    import gymnasium

    class Paid(gymnasium.Wrapper):
        def step(self, action):
            observation, reward, *flags = self.env.step(action)
            return observation, reward + noise * np.random.normal(), *flags

    pendulum = gymnasium.registry["Pendulum-v1"]
    gymnasium.register("Paid-v0", lambda **kwargs: Paid(pendulum.make(**kwargs).unwrapped), max_episode_steps=9)
    try:
        env = make_any_env("gym/Paid-v0", seed=1)
        env.rollout(3)
        state = through_a_file(simulator_state(env))
        assert load_simulator_state(make_any_env("gym/Paid-v0", seed=1), state) == (noise == 0)
        del state["_extra_state"]["episode_reward"]  # as versions before kept it
        assert load_simulator_state(make_any_env("gym/Paid-v0", seed=1), state)
    finally:
        del gymnasium.registry["Paid-v0"]


@needs_mujoco
def test_a_simulator_of_mujoco_whose_observations_are_drawn_by_chance_is_not_brought_back():
    import gymnasium

    class Noisy(gymnasium.ObservationWrapper):
        def observation(self, observation):
            return observation + noise * np.random.normal(size=observation.shape)

    cheetah = gymnasium.registry["HalfCheetah-v5"]
    gymnasium.register("Noisy-v0", lambda **kwargs: Noisy(cheetah.make(**kwargs).unwrapped), max_episode_steps=9)
    try:
        for noise in (0.0, 1.0):
            env = make_any_env("gym/Noisy-v0", seed=1)
            env.rollout(3)
            state = through_a_file(simulator_state(env))
            assert load_simulator_state(make_any_env("gym/Noisy-v0", seed=1), state) == (noise == 0)
        place = state["_extra_state"]["fingerprint"]
        state["_extra_state"]["fingerprint"] = place[: len(place) - 17]  # as versions before kept it
        del state["_extra_state"]["episode_reward"]
        assert load_simulator_state(make_any_env("gym/Noisy-v0", seed=1), state)
    finally:
        del gymnasium.registry["Noisy-v0"]


@needs_gym
def test_a_reset_with_options_cannot_be_repeated_and_the_next_one_can():
    env = make_any_env("gym/Pendulum-v1")
    env.reset(options={"x_init": 0.1, "y_init": 0.1})
    assert simulator_state(env) is None
    env.reset()
    assert simulator_state(env) is not None


def test_an_environment_before_its_first_reset_has_nothing_to_come_back_to():
    assert simulator_state(make_any_env("pendulum-swingup")) is None


@needs_gym
def test_torchrls_own_gymnasium_environments_say_that_they_cannot_be_restored():
    env = TransformedEnv(GymEnv("Pendulum-v1"), ActionScaling())
    env.reset()
    assert simulator_state(env) is None


def test_a_simulator_that_behaves_otherwise_is_noticed():
    first, second = (make_env("walker-walk", 1, parallel=False) for _ in range(2))
    carrier = first.reset()
    for _ in range(3):
        _, carrier = step(first, carrier)
    second.physics.model.opt.gravity[2] = -5.0
    assert not load_simulator_state(second, simulator_state(first))


def test_other_environments_say_that_they_cannot_be_restored():
    assert simulator_state(TransformedEnv(ContinuousActionVecMockEnv(), StepCounter(3))) is None


@pytest.mark.parametrize("num_envs", [1, 2])
@pytest.mark.parametrize("insertion", ["step", "episode"])
def test_a_loaded_collector_goes_on_inside_the_episode(insertion, num_envs):
    def make_collector(seed: int) -> tuple[StepCollector, TensorDictReplayBuffer]:
        env = make_env("cartpole-swingup", num_envs, parallel=False, seed=seed)
        buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(200))
        policy = SeedPolicy(env.action_spec)
        return StepCollector(env, policy, replay_buffer=buffer, insertion=insertion), buffer

    first, buffer = make_collector(seed=0)
    for _ in range(LIMIT + 4):
        first.step()
    state, rows = through_a_file(first.state_dict()), len(buffer)
    torch.manual_seed(5)
    for _ in range(2 * LIMIT):
        first.step()
    second, resumed = make_collector(seed=1)
    second.load_state_dict(state)
    torch.manual_seed(5)
    for _ in range(2 * LIMIT):
        second.step()
    wanted = buffer.storage[:][rows:].exclude("index")
    assert (resumed.storage[:].exclude("index") == wanted).all()
    assert len(resumed) == len(wanted) > 0


REMEMBERING = {
    "frames": lambda: CatFrames(N=3, dim=-1, in_keys=["observation"]),
    "maximum": lambda: TimeMaxPool(in_keys=["observation"], T=3),
    "statistics": lambda: VecNormV2(in_keys=["observation"]),
    "constants": lambda: RewardScaling(0.0, 2.0),
}


def remembering(name: str, num_envs: int, seed: int = 3) -> EnvBase:
    return make_env("cartpole-swingup", num_envs, parallel=False, seed=seed).append_transform(REMEMBERING[name]())


@pytest.mark.filterwarnings("ignore:Support of VecNormV2 for containers with non-empty batch-size")
@pytest.mark.parametrize(("name", "num_envs"), [*((name, 1) for name in REMEMBERING), ("frames", 2), ("statistics", 2)])
def test_what_transforms_remember_goes_on_too(name, num_envs):
    first, second = (remembering(name, num_envs, seed) for seed in (3, 4))
    torch.manual_seed(0)
    carrier = first.reset()
    for _ in range(4):
        _, carrier = step(first, carrier)
    state, resumed = simulator_state(first), carrier.clone()
    torch.manual_seed(1)
    expected = []
    for _ in range(LIMIT):  # over a reset
        stepped, carrier = step(first, carrier)
        expected.append(stepped)
    state = through_a_file(state)  # which has not moved on
    for _ in range(2):  # one that has not stepped yet, then one that remembers something else
        assert load_simulator_state(second, state)
        again = resumed.clone()
        torch.manual_seed(1)
        for wanted in expected:
            stepped, again = step(second, again)
            assert (stepped == wanted).all()


@pytest.mark.parametrize("name", REMEMBERING)
def test_transforms_around_what_was_not_reset_yet_are_no_error(name):
    simulator_state(remembering(name, 1))


def test_what_a_file_cannot_hold_of_a_transform_cannot_be_restored():
    class Odd(Transform):
        def get_extra_state(self):
            return object()

    env = make_any_env("pendulum-swingup").append_transform(Odd(in_keys=[], out_keys=[]))
    env.reset()
    assert simulator_state(env) is None


def test_the_weights_of_a_transform_s_network_are_no_part_of_a_state():
    transform = Transform()
    transform.network = torch.nn.Linear(2, 2)
    transform.register_buffer("seen", torch.zeros(()))
    states = transform_states(TransformedEnv(ContinuousActionVecMockEnv(), transform))
    assert [list(state) for state in states.values()] == [["seen"]]


def test_a_state_of_other_transforms_is_noticed():
    first, fewer, larger = (
        remembering("frames", 1),
        make_env("cartpole-swingup", 1, parallel=False),
        remembering("frames", 3),
    )
    for env in (first, fewer, larger):
        env.rollout(3)
    assert not load_simulator_state(fewer, simulator_state(first))
    assert not load_simulator_state(first, simulator_state(fewer))
    frames = simulator_state(first)["transforms"]
    assert not load_simulator_state(larger, simulator_state(larger) | {"transforms": frames})


@needs_gym
@pytest.mark.parametrize(("saved", "loading"), [(2, 1), (1, 2), (2, 3), (3, 2)])
def test_a_state_of_another_number_of_environments_leads_nowhere(saved, loading):
    env = make_env("gym/Pendulum-v1", saved, parallel=False)
    env.rollout(3)
    other = make_env("gym/Pendulum-v1", loading, parallel=False)
    assert not load_simulator_state(other, simulator_state(env))
    assert other.rollout(3).shape[-1] == 3


@needs_gym
@pytest.mark.parametrize("num_envs", [1, 2])
@pytest.mark.parametrize("tasks", [("cheetah-run", "gym/Pendulum-v1"), ("gym/Pendulum-v1", "cheetah-run")])
def test_a_state_of_another_suite_leads_nowhere(tasks, num_envs):
    env, other = (make_env(task, num_envs, parallel=False) for task in tasks)
    env.rollout(3)
    assert not load_simulator_state(other, simulator_state(env))
    assert other.rollout(3).shape[-1] == 3


def test_a_collector_whose_simulator_does_not_come_back_begins_fresh_episodes_and_says_so():
    envs = [make_env("walker-walk", 1, parallel=False) for _ in range(2)]
    collectors = [
        StepCollector(
            env, SeedPolicy(env.action_spec), replay_buffer=TensorDictReplayBuffer(storage=LazyTensorStorage(50))
        )
        for env in envs
    ]
    for _ in range(3):
        collectors[0].step()
    envs[1].physics.model.opt.gravity[2] = -5.0
    with pytest.warns(UserWarning, match="^the simulator did not come back to where it was"):
        collectors[1].load_state_dict(collectors[0].state_dict())
    assert collectors[1].frames == 3
    row = collectors[1].step()
    assert row["collector", "traj_ids"].item() == 1
    assert row["next", "step_count"].item() == 1


@needs_gym
def test_a_collector_that_is_saved_after_a_fault_goes_on_though_the_fault_repeats(monkeypatch):
    import gymnasium
    from gymnasium.envs.classic_control.pendulum import PendulumEnv

    class Unstable(PendulumEnv):
        def reset(self, **options):
            self.steps = 0
            return super().reset(**options)

        def step(self, action):
            self.steps += 1
            if self.steps == 5:
                raise RuntimeError("unstable")
            return super().step(action)

    monkeypatch.setattr(gymnasium.envs.registration, "registry", dict(gymnasium.registry))
    monkeypatch.setattr(gymnasium, "registry", gymnasium.envs.registration.registry)
    gymnasium.register("Unstable-v0", Unstable, max_episode_steps=9)
    collectors = []
    for seed in (3, 4):
        env = make_any_env("gym/Unstable-v0", seed=seed)
        buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(50))
        collectors.append(StepCollector(env, SeedPolicy(env.action_spec), replay_buffer=buffer))
    for _ in range(4):
        collectors[0].step()
    with pytest.raises(SimulatorError, match="failed at decision step 4: unstable"):
        collectors[0].step()
    collectors[1].load_state_dict(through_a_file(dict(collectors[0].state_dict())))
    assert not collectors[1].begins_fresh
    rows = []
    for collector in collectors:
        torch.manual_seed(0)
        rows.append(collector.step())
    assert (rows[0] == rows[1]).all()  # the next episode, with its own number


def test_a_state_is_small_and_of_plain_types():
    env = make_env("humanoid-run", 1, parallel=False)
    carrier = env.reset()
    for _ in range(5):
        _, carrier = step(env, carrier)
    state = simulator_state(env)
    tensors = TensorDict(state).flatten_keys()
    assert tensors.bytes() < 10_000
