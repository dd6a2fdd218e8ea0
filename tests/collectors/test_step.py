from __future__ import annotations

from collections import defaultdict
from functools import partial

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torchrl.collectors import BaseCollector
from torchrl.data import (
    Binary,
    Bounded,
    Composite,
    LazyMemmapStorage,
    LazyStackStorage,
    LazyTensorStorage,
    ListStorage,
    ReplayBuffer,
    TensorDictReplayBuffer,
    TensorDictRoundRobinWriter,
    Unbounded,
)
from torchrl.envs import (
    ActionScaling,
    Compose,
    EnvBase,
    ExplorationType,
    GymEnv,
    InitTracker,
    ParallelEnv,
    RenameTransform,
    SerialEnv,
    StepCounter,
    TensorDictPrimer,
    TransformedEnv,
)
from torchrl.envs.transforms import VecNormV2
from torchrl.envs.utils import RandomPolicy, exploration_type
from torchrl.testing.mocking_classes import CountingEnv, CountingEnvCountPolicy

from torchrl_etdmpc import (
    EnsembleMPPIPlanner,
    LatentEnv,
    NonFiniteError,
    SeedPolicy,
    SimulatorError,
    StepCollector,
    StepSliceSampler,
    WorldModel,
)
from torchrl_etdmpc.envs import get_task
from torchrl_etdmpc.envs import make_env as make_task_env
from torchrl_etdmpc.planners import FunctionScore

TRAJ_KEY = ("collector", "traj_ids")


class LineEnv(EnvBase):
    """A point on a line. The observation is (position, steps of the episode), the reward the position reached.

    An episode is truncated after ``length`` steps and terminated beyond ``border``. ``broken`` turns NaN at the
    environment's ``broken_at``-th step, ``"reset"`` at its ``broken_at``-th reset.
    """

    def __init__(self, length=4, *, border=float("inf"), broken="", broken_at=0):
        super().__init__()
        self.length, self.border, self.broken, self.broken_at = length, border, broken, broken_at
        self.observation_spec = Composite(observation=Unbounded((2,)))
        self.action_spec = Bounded(-1.0, 1.0, shape=(1,))
        self.reward_spec = Unbounded((1,))
        self.full_done_spec = Composite(
            {key: Binary(1, dtype=torch.bool) for key in ("done", "terminated", "truncated")}
        )
        self.generator = torch.Generator().manual_seed(0)
        self.steps = self.resets = 0

    def _set_seed(self, seed):
        self.generator = torch.Generator().manual_seed(seed)

    def _reset(self, tensordict=None):
        self.resets += 1
        self.position = torch.rand(1, generator=self.generator)
        self.count = 0
        observation = self._observation()
        if self.broken == "reset" and self.resets == self.broken_at:
            observation[0] = torch.nan
        flag = torch.zeros(1, dtype=torch.bool)
        return TensorDict(
            {"observation": observation, "done": flag, "terminated": flag.clone(), "truncated": flag.clone()}
        )

    def _observation(self):
        return torch.cat([self.position, torch.tensor([float(self.count)])])

    def _step(self, tensordict):
        self.steps += 1
        self.count += 1
        self.position = self.position + tensordict["action"]
        reward, observation = self.position.clone(), self._observation()
        if self.steps == self.broken_at and self.broken in ("reward", "observation"):
            {"reward": reward, "observation": observation}[self.broken][0] = torch.nan
        terminated = self.position > self.border
        truncated = torch.tensor([self.count >= self.length])
        return TensorDict(
            {
                "observation": observation,
                "reward": reward,
                "terminated": terminated,
                "truncated": truncated,
                "done": terminated | truncated,
            }
        )


class RandomActions(TensorDictModuleBase):
    """Uniform actions; calls ``look`` with its input first."""

    in_keys, out_keys = ["observation"], ["action"]

    def __init__(self, look=lambda tensordict: None, answer=None):
        super().__init__()
        self.look, self.answer, self.calls = look, answer, 0

    def forward(self, tensordict):
        self.calls += 1
        self.look(tensordict)
        action = torch.rand(*tensordict.batch_size, 1) * 2 - 1
        return tensordict.set("action", action if self.answer is None else self.answer(self.calls, action))


def make_replay(capacity=500, **options) -> TensorDictReplayBuffer:
    return TensorDictReplayBuffer(
        storage=LazyTensorStorage(capacity), writer=TensorDictRoundRobinWriter(track_generations=True), **options
    )


def make_env(lengths=(4,), **options) -> EnvBase:
    """One environment of batch size [], or several of batch size [num_envs]."""
    makers = [partial(LineEnv, length, **options) for length in lengths]
    return makers[0]() if len(makers) == 1 else SerialEnv(len(makers), makers)


def make_collector(env=None, policy=None, **options) -> StepCollector:
    """A collector of random actions into a buffer of its own, unless told otherwise."""
    options = {"replay_buffer": make_replay(), **options}
    return StepCollector(make_env() if env is None else env, RandomActions() if policy is None else policy, **options)


def make_planner(observation_dim=2, **options) -> EnsembleMPPIPlanner:
    torch.manual_seed(0)
    model = WorldModel(observation_dim, 1, latent_dim=16, mlp_dim=16, num_dynamics=2)
    options = {"horizon": 3, "num_samples": 8, "num_elites": 3, "num_proposals": 2, "iterations": 1} | options
    return EnsembleMPPIPlanner(LatentEnv(model), **options)


def episodes(rows: TensorDict) -> dict[int, list[TensorDict]]:
    """The rows of each trajectory, in the order in which they were stored."""
    out = defaultdict(list)
    for row in rows.unbind(0):
        out[int(row[TRAJ_KEY])].append(row)
    return out


def test_it_is_a_torchrl_collector():
    collector = make_collector()
    assert isinstance(collector, BaseCollector)
    assert collector.stats()["frames"] == 0
    collector.update_policy_weights_()


@pytest.mark.parametrize("lengths", [(4,), (3, 5)], ids=["one-env", "two-envs"])
def test_the_last_transition_can_be_sampled_before_the_next_action_is_chosen(lengths):
    replay = make_replay(sampler=StepSliceSampler(1))
    newest = []

    def look(tensordict):
        if len(replay):
            newest.append(int(replay.sample(200)["index"].max()))

    for _ in StepCollector(make_env(lengths), RandomActions(look), replay_buffer=replay, total_frames=20):
        pass
    assert newest == list(range(len(lengths) - 1, 20 - len(lengths), len(lengths)))


@pytest.mark.parametrize("lengths", [(4,), (3, 5)], ids=["one-env", "two-envs"])
def test_iterating_yields_what_was_stored_one_step_of_every_environment_at_a_time(lengths):
    replay = make_replay()
    collector = StepCollector(make_env(lengths), RandomActions(), replay_buffer=replay, total_frames=22)
    steps = list(collector)
    assert len(steps) == len(collector) == 22 // len(lengths)
    assert all(step.batch_size == (len(lengths),) for step in steps)
    assert collector.frames == len(replay) == 22
    yielded, stored = torch.cat(steps), replay.storage[:]
    assert set(yielded.keys(True, True)) == set(stored.keys(True, True)) - {"index"}
    for key in yielded.keys(True, True):
        assert torch.equal(yielded[key], stored[key]), key


def test_total_frames_is_reached_by_whole_steps_of_all_environments():
    collector = make_collector(make_env((3, 5)), total_frames=5)
    assert len(list(collector)) == len(collector) == 3
    assert collector.frames == 6


def test_without_total_frames_it_goes_on_for_as_long_as_it_is_asked():
    collector = make_collector()
    for _, step in zip(range(30), collector, strict=False):
        assert step.batch_size == (1,)
    assert collector.next().batch_size == (1,)


def test_the_environment_may_be_given_as_a_function():
    replay = make_replay()
    for _ in StepCollector(lambda: LineEnv(2), RandomActions(), replay_buffer=replay, total_frames=4):
        pass
    assert len(replay) == 4


@pytest.mark.parametrize("insertion", ["step", "episode"])
def test_trajectory_ids_are_unique_per_episode_and_environment(insertion):
    replay = make_replay()
    collector = StepCollector(
        make_env((3, 5, 4)), RandomActions(), replay_buffer=replay, total_frames=60, insertion=insertion
    )
    for _ in collector:
        pass
    lengths = []
    for rows in episodes(replay.storage[:]).values():
        assert [int(row["observation"][1]) for row in rows] == list(range(len(rows)))
        for before, after in zip(rows, rows[1:], strict=False):
            assert torch.equal(before["next", "observation"], after["observation"])
            assert not before["next", "done"]
        lengths.append(len(rows))
    # 20 steps: six episodes of 3, four of 5, five of 4; with "step" also the begun one of 2
    assert sorted(lengths) == sorted([3] * 6 + [5] * 4 + [4] * 5 + ([2] if insertion == "step" else []))


def test_with_episode_insertion_an_episode_is_stored_when_it_ends_and_as_a_whole():
    replay = make_replay()
    collector = StepCollector(make_env((3, 5)), RandomActions(), replay_buffer=replay, insertion="episode")
    sizes = []
    for _ in range(10):
        collector.step()
        sizes.append(len(replay))
    assert sizes == [0, 0, 3, 3, 8, 11, 11, 11, 14, 19]
    stored = replay.storage[:]
    assert stored["observation"][:, 1].tolist() == [*range(3), *range(5), *range(3), *range(3), *range(5)]
    assert stored["next", "done"].flatten().nonzero().flatten().tolist() == [2, 7, 10, 13, 18]
    assert stored[TRAJ_KEY].tolist() == [0] * 3 + [1] * 5 + [2] * 3 + [4] * 3 + [3] * 5


def test_both_insertions_store_the_same_transitions():
    stored = {}
    for insertion in ("step", "episode"):
        replay = make_replay()
        env = make_env((3, 5))
        torch.manual_seed(0)
        collector = StepCollector(env, RandomActions(), replay_buffer=replay, insertion=insertion, total_frames=30)
        collector.set_seed(0)
        for _ in collector:
            pass
        stored[insertion] = episodes(replay.storage[:])
    assert stored["step"].keys() == stored["episode"].keys()  # 15 steps: both environments end an episode there
    for trajectory, rows in stored["step"].items():
        for one, other in zip(rows, stored["episode"][trajectory], strict=True):
            assert (one.exclude("index") == other.exclude("index")).all()


@pytest.mark.parametrize("lengths", [(4,), (3, 5)], ids=["one-env", "two-envs"])
@pytest.mark.parametrize("insertion", ["step", "episode"])
@pytest.mark.parametrize("storage", [LazyTensorStorage, ListStorage, LazyStackStorage])
def test_a_consumer_that_writes_into_a_yielded_step_does_not_change_what_is_stored(storage, insertion, lengths):
    replay = ReplayBuffer(storage=storage(500))
    for step in StepCollector(
        make_env(lengths), RandomActions(), replay_buffer=replay, total_frames=30, insertion=insertion
    ):
        step["next", "reward"].fill_(777)
    assert len(replay) > 0
    assert not any(replay.storage[row]["next", "reward"] == 777 for row in range(len(replay)))


@pytest.mark.parametrize("lengths", [(4,), (3, 5)], ids=["one-env", "two-envs"])
def test_what_is_stored_equals_an_independent_replay_of_the_actions(lengths):
    replay = make_replay()
    collector = StepCollector(make_env(lengths), RandomActions(), replay_buffer=replay, total_frames=40)
    collector.set_seed(3)
    for _ in collector:
        pass
    reference = make_env(lengths)
    reference.set_seed(3)
    single = reference.batch_size == ()
    observation = reference.reset()["observation"].reshape(-1, 2)
    for rows in replay.storage[:].split(len(lengths)):
        assert torch.equal(rows["observation"], observation)
        action = rows["action"].squeeze(0) if single else rows["action"]
        out = reference.step(TensorDict({"action": action}, reference.batch_size))["next"].reshape(-1)
        for key in ("observation", "reward", "done", "terminated", "truncated"):
            assert torch.equal(rows["next", key], out[key]), key
        observation = out["observation"].clone()
        if out["done"].any():
            fresh = reference.reset(
                TensorDict({"_reset": out["done"].reshape(reference.done_spec.shape)}, reference.batch_size)
            )
            observation = torch.where(out["done"], fresh["observation"].reshape(-1, 2), observation)


def test_a_gymnasium_task_is_stored_as_gymnasium_itself_plays_it():
    gymnasium = pytest.importorskip("gymnasium")
    env, replay = GymEnv("Pendulum-v1"), make_replay()
    collector = StepCollector(env, RandomPolicy(env.action_spec), replay_buffer=replay, total_frames=230)
    collector.set_seed(5)
    for _ in collector:
        pass
    collector.shutdown()
    stored = replay.storage[:]

    reference = gymnasium.make("Pendulum-v1")
    reference.reset(seed=5)
    observation, _ = reference.reset()
    for row in stored.unbind(0):
        torch.testing.assert_close(row["observation"], torch.as_tensor(observation))
        observation, reward, terminated, truncated, _ = reference.step(row["action"].numpy())
        torch.testing.assert_close(row["next", "observation"], torch.as_tensor(observation))
        assert float(row["next", "reward"]) == pytest.approx(float(reward), rel=1e-5, abs=1e-6)
        assert (bool(row["next", "terminated"]), bool(row["next", "truncated"])) == (terminated, truncated)
        if terminated or truncated:
            observation, _ = reference.reset()
    reference.close()
    assert stored[TRAJ_KEY].tolist() == [0] * 200 + [1] * 30


def test_termination_and_truncation_are_stored_apart():
    replay = make_replay()
    policy = RandomActions(answer=lambda call, action: torch.ones_like(action))
    for _ in StepCollector(make_env((4, 50), border=2.5), policy, replay_buffer=replay, total_frames=60):
        pass
    for _ in StepCollector(make_env((1, 1), border=2.5), policy, replay_buffer=replay, total_frames=20):
        pass
    rows = replay.storage[:]
    expected = rows["next", "observation"][:, :1] > 2.5
    assert torch.equal(rows["next", "terminated"], expected)
    assert expected[:60].any() and not expected[60:].any()
    assert rows["next", "truncated"][60:].any()
    assert torch.equal(rows["next", "done"], rows["next", "terminated"] | rows["next", "truncated"])


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_processes_of_a_parallel_environment_are_stored_like_environments_in_turn():
    replay, seen = make_replay(sampler=StepSliceSampler(2)), []
    makers = [partial(CountingEnv, max_steps=steps) for steps in (3, 5)]
    env = ParallelEnv(2, makers, mp_start_method="fork")  # copies of this process need no imports
    policy = CountingEnvCountPolicy(env.action_spec)

    class Watching(TensorDictModuleBase):
        in_keys, out_keys = ["observation"], ["action"]

        def forward(self, tensordict):
            seen.append(len(replay))
            return policy(tensordict)

    collector = StepCollector(env, Watching(), replay_buffer=replay, total_frames=40)
    steps = list(collector)
    assert seen == list(range(0, 40, 2))
    stored = replay.storage[:]
    assert (torch.cat(steps)["next", "observation"] == stored["next", "observation"]).all()
    for rows in episodes(stored).values():
        counts = [int(row["observation"]) for row in rows]
        assert counts == list(range(len(rows)))
        assert [int(row["next", "observation"]) for row in rows] == [count + 1 for count in counts]
        assert [bool(row["next", "done"]) for row in rows[:-1]] == [False] * (len(rows) - 1)
    pairs = replay.sample(400).reshape(-1, 2)
    assert (pairs["observation"].diff(dim=1) == 1).all()
    collector.shutdown()
    collector.shutdown()
    assert env.is_closed


@pytest.mark.parametrize("lengths", [(4,), (3, 5)], ids=["one-env", "two-envs"])
def test_the_seed_phase_ends_exactly_after_its_frames_and_writes_the_planner_s_schema(lengths):
    replay, planner, env = make_replay(), make_planner(), make_env(lengths)
    planner.world_model.version.fill_(9)
    collector = StepCollector(
        env,
        planner,
        replay_buffer=replay,
        total_frames=26,
        init_random_frames=18,
        seed_policy=SeedPolicy(env.action_spec),
    )
    steps, phases, stepping = [], [], iter(collector)
    while collector.frames < 26:
        phases.append(collector.in_seed_phase)
        steps.append(next(stepping))
    assert phases == [True] * (18 // len(lengths)) + [False] * (8 // len(lengths))
    seed, planned = torch.cat(steps)[:18], torch.cat(steps)[18:]
    assert (seed["plan", "loc"] == 0).all() and (seed["plan", "scale"] == 1).all()
    assert (seed["plan", "value"] == 0).all() and (seed["plan", "version"] == 0).all()
    assert len(seed["action"].unique()) == 18 and seed["action"].abs().max() <= 1
    assert (planned["plan", "version"] == 9).all() and (planned["plan", "scale"] != 1).all()
    assert set(seed.keys(True, True)) == set(planned.keys(True, True))
    stored = replay.storage[:]
    for key in planned.keys(True, True):
        assert seed[key].dtype == planned[key].dtype == stored[key].dtype, key
        assert seed[key].shape[1:] == planned[key].shape[1:] == stored[key].shape[1:], key
        assert torch.equal(stored[key], torch.cat([seed[key], planned[key]])), key
    assert set(stored.keys(True, True)) == set(planned.keys(True, True)) | {"index"}  # nothing was left unwritten


def test_the_seed_phase_ends_with_the_first_step_that_begins_after_it():
    env = make_env((3, 5))
    collector = StepCollector(
        env,
        RandomActions(),
        replay_buffer=make_replay(),
        init_random_frames=5,
        seed_policy=RandomActions(),
        total_frames=12,
    )
    for _ in collector:
        pass
    assert (collector.seed_policy.calls, collector.policy.calls) == (3, 3)


def test_a_seed_policy_with_another_schema_is_refused_before_its_row_is_stored():
    env, replay = make_env(), make_replay()
    collector = StepCollector(
        env, make_planner(), replay_buffer=replay, init_random_frames=2, seed_policy=RandomActions()
    )
    collector.step(), collector.step()
    with pytest.raises(ValueError, match=r"must write the same keys; they differ in .*'plan', 'loc'"):
        collector.step()
    assert len(replay) == 2


def test_a_seed_phase_without_a_seed_policy_is_refused():
    with pytest.raises(ValueError, match=r"init_random_frames=10 needs a seed_policy .*SeedPolicy\(env.action_spec\)"):
        make_collector(init_random_frames=10)


def test_a_collector_without_a_buffer_is_refused():
    env, policy = LineEnv(), SeedPolicy(LineEnv().action_spec)
    with pytest.raises(ValueError, match=r"^StepCollector stores what it collects, got replay_buffer=None; pass a Rep"):
        StepCollector(env, policy, replay_buffer=None)


def test_an_unknown_insertion_is_refused():
    with pytest.raises(ValueError, match="insertion must be 'step' or 'episode', got 'batch'"):
        make_collector(insertion="batch")


@pytest.mark.parametrize("key", ["plan_mean", ("next", "plan_mean")])
def test_one_key_is_not_taken_for_a_list_of_keys_to_leave_out(key):
    """The letters of a name would leave out nothing, the parts of a nested one everything below "next"."""
    with pytest.raises(ValueError, match="exclude_keys must be a list of keys"):
        make_collector(LineEnv(), exclude_keys=key)


def test_an_environment_whose_done_has_another_name_is_refused():
    env = TransformedEnv(LineEnv(), RenameTransform(["done"], ["over"], create_copy=False))
    with pytest.raises(ValueError, match=r"^StepCollector needs the key 'done' of an environment, got \[.*'over'"):
        make_collector(env)


def test_more_than_one_batch_dimension_is_refused():
    env = SerialEnv(2, lambda: SerialEnv(2, LineEnv))
    with pytest.raises(ValueError, match=r"at most one batch dimension, got torch.Size\(\[2, 2\]\)"):
        make_collector(env)


class FailingReset(LineEnv):
    """Every second reset fails."""

    def _reset(self, tensordict=None):
        if self.resets % 2:
            self.resets += 1
            raise RuntimeError("no answer")
        return super()._reset(tensordict)


@pytest.mark.parametrize("insertion", ["step", "episode"])
@pytest.mark.parametrize("num_envs", [1, 2])
def test_a_reset_that_fails_costs_no_end_of_an_episode(insertion, num_envs):
    replay, faults = make_replay(), 0
    env = FailingReset(3) if num_envs == 1 else SerialEnv(2, [partial(FailingReset, 3), partial(LineEnv, 5)])
    collector = StepCollector(env, RandomActions(), replay_buffer=replay, insertion=insertion)
    for _ in range(12):
        try:
            collector.step()
        except SimulatorError:
            faults += 1
    rows = episodes(replay.storage[:])
    assert faults == 4 or (faults == 3 and num_envs == 2)
    for steps in rows.values():
        assert len(steps) == 3
        assert [row["next", "done"].item() for row in steps] == [False, False, True]
    assert collector.frames == num_envs * (12 - faults)


def test_an_end_is_stored_where_the_reset_behind_it_fails_in_the_first_step_of_a_resumed_collector(monkeypatch):
    gymnasium = pytest.importorskip("gymnasium")
    task = get_task("gym/Pendulum-v1", episode_length=3)
    first, resumed = (make_collector(make_task_env(task, seed=seed)) for seed in (0, 1))
    for _ in range(2):
        first.step()
    resumed.replay_buffer.extend(first.replay_buffer.storage[:])
    resumed.load_state_dict(first.state_dict())
    pendulum = gymnasium.make("Pendulum-v1").unwrapped

    def fail(*args, **options):
        raise RuntimeError("no answer")

    monkeypatch.setattr(type(pendulum), "reset", fail)
    for collector in (first, resumed):
        with pytest.raises(SimulatorError, match="no answer"):
            collector.step()
        (steps,) = episodes(collector.replay_buffer.storage[:]).values()
        assert [row["next", "done"].item() for row in steps] == [False, False, True]


@pytest.mark.parametrize("chosen", [None, ExplorationType.DETERMINISTIC])
def test_both_policies_see_the_exploration_type(chosen):
    types = []
    policies = [RandomActions(look=lambda tensordict: types.append(exploration_type())) for _ in range(2)]
    collector = StepCollector(
        make_env(),
        policies[0],
        seed_policy=policies[1],
        init_random_frames=1,
        replay_buffer=make_replay(),
        total_frames=2,
        **({} if chosen is None else {"exploration_type": chosen}),
    )
    before = exploration_type()
    for _ in collector:
        assert exploration_type() is before
    assert types == [chosen or ExplorationType.RANDOM] * 2


def _primers(env: EnvBase) -> int:
    transform = getattr(env, "transform", None)
    return sum(
        isinstance(one, TensorDictPrimer) for one in (transform if isinstance(transform, Compose) else [transform])
    )


@pytest.mark.parametrize("lengths", [(4,), (3, 5)], ids=["one-env", "two-envs"])
def test_the_planner_is_warm_started_within_episodes_and_the_plan_is_not_stored(lengths):
    replay, planner = make_replay(), make_planner()
    received, made, plan = [], [], planner.plan

    def spy(observation, plan_mean=None, **options):
        received.append(plan_mean.clone())
        made.append(plan(observation, plan_mean, **options))
        return made[-1]

    planner.compiled_plan = spy
    steps = list(StepCollector(make_env(lengths), planner, replay_buffer=replay, total_frames=24))
    assert not [key for key in replay.storage[:].keys(True, True) if "plan_mean" in key]
    assert not [key for key in steps[0].keys(True, True) if "plan_mean" in key]
    cold = 0
    for now, before, step in zip(received[1:], made, steps, strict=False):
        begins = step["next", "done"].reshape(-1, 1, 1)
        before = before.mean.reshape(-1, 3, 1)
        assert torch.equal(now.reshape(-1, 3, 1), torch.where(begins, torch.zeros_like(before), before))
        assert (before != 0).any()
        cold += int(begins.sum())
    assert cold == sum((24 // len(lengths) - 1) // length for length in lengths)
    assert (received[0] == 0).all()


def test_the_primer_is_added_once_and_only_if_it_is_needed():
    planner = make_planner()
    first = StepCollector(make_env(), planner, replay_buffer=make_replay())
    assert _primers(first.env) == 1
    assert _primers(StepCollector(first.env, planner, replay_buffer=make_replay()).env) == 1
    own = TransformedEnv(make_env(), InitTracker()).append_transform(planner.make_tensordict_primer())
    assert _primers(StepCollector(own, planner, replay_buffer=make_replay()).env) == 1
    cold = StepCollector(make_env(), make_planner(warm_start=False), replay_buffer=make_replay())
    assert _primers(cold.env) == 0
    assert _primers(make_collector().env) == 0


def test_further_keys_can_be_kept_out_of_the_buffer():
    replay = make_replay()
    env = TransformedEnv(make_env(), InitTracker())
    list(
        StepCollector(
            env,
            RandomActions(),
            replay_buffer=replay,
            total_frames=8,
            exclude_keys=["is_init", ("next", "is_init"), ("next", "truncated")],
        )
    )
    keys = set(replay.storage[:].keys(True, True))
    assert not keys & {"is_init", ("next", "is_init"), ("next", "truncated")}
    assert {"observation", ("next", "observation"), ("next", "terminated"), "truncated"} <= keys


def test_what_is_kept_out_of_the_buffer_need_not_be_finite():
    env = TransformedEnv(LineEnv(broken="observation", broken_at=2), StepCounter())
    policy = RandomActions()
    policy.in_keys = ["step_count"]
    keys = ["observation", ("next", "observation")]
    collector = StepCollector(env, policy, replay_buffer=make_replay(), total_frames=5, exclude_keys=keys)
    assert len(list(collector)) == 5


@pytest.mark.parametrize("lengths", [(4,), (3, 5)], ids=["one-env", "two-envs"])
def test_a_policy_device_changes_nothing_but_where_the_policy_runs(lengths):
    stored = []
    for device in (None, "cpu"):
        replay, planner = make_replay(), make_planner()
        collector = StepCollector(
            make_env(lengths), planner, replay_buffer=replay, total_frames=20, policy_device=device
        )
        collector.set_seed(0)
        list(collector)
        stored.append(replay.storage[:])
    assert set(stored[0].keys(True, True)) == set(stored[1].keys(True, True))
    assert (stored[0] == stored[1]).all()


@pytest.mark.parametrize("lengths", [(4,), (3, 5)], ids=["one-env", "two-envs"])
def test_a_policy_may_answer_in_a_tensordict_of_its_own(lengths):
    stored = []
    for own in (False, True):
        replay, planner = make_replay(), make_planner(warm_start=False)
        out_keys, env = planner.out_keys, make_env(lengths)
        policy = (lambda state, act=planner, keys=out_keys: act(state.copy()).select(*keys)) if own else planner
        collector = StepCollector(env, policy, replay_buffer=replay, total_frames=20)
        list(collector)
        stored.append(replay.storage[:])
    assert set(stored[0].keys(True, True)) == set(stored[1].keys(True, True))
    assert (stored[0] == stored[1]).all()


def test_collection_is_reproducible_by_set_seed_and_torch_manual_seed():
    stored = []
    for seed in (1, 1, 2):
        replay = make_replay()
        collector = StepCollector(make_env((3, 5)), RandomActions(), replay_buffer=replay, total_frames=20)
        collector.step()  # on an episode that the seed abandons
        replay.empty()
        torch.manual_seed(0)
        assert isinstance(collector.set_seed(seed), int)
        list(collector)
        stored.append(replay.storage[:])
    assert torch.equal(stored[0]["next", "observation"], stored[1]["next", "observation"])
    assert not torch.equal(stored[0]["observation"][0], stored[2]["observation"][0])


def test_a_static_seed_reaches_the_environment():
    collector = make_collector()
    assert collector.set_seed(7, static_seed=True) == 7 != collector.set_seed(7)


@pytest.mark.parametrize("insertion", ["step", "episode"])
def test_an_episode_that_a_seed_abandons_never_continues(insertion):
    replay = make_replay()
    collector = StepCollector(make_env((5,)), RandomActions(), replay_buffer=replay, insertion=insertion)
    for _ in range(3):
        collector.step()
    collector.set_seed(0)
    for _ in range(10):
        collector.step()
    lengths = [len(rows) for rows in episodes(replay.storage[:]).values()]
    assert lengths == ([3, 5, 5] if insertion == "step" else [5, 5])


@pytest.mark.parametrize("insertion", ["step", "episode"])
def test_a_loaded_collector_goes_on_counting_with_fresh_trajectories(insertion):
    replay = make_replay()
    options = {"replay_buffer": replay, "insertion": insertion, "init_random_frames": 16, "total_frames": 48}
    first = StepCollector(make_env((3, 5)), RandomActions(), seed_policy=RandomActions(), **options)
    for _ in range(7):
        first.step()
    used = set(replay.storage[:][TRAJ_KEY].tolist()) | {first.state_dict()["next_trajectory"] - 1}
    rows = len(replay)
    resumed = StepCollector(make_env((3, 5)), RandomActions(), seed_policy=RandomActions(), **options)
    resumed.step()  # forgotten by loading
    state = first.state_dict()
    with pytest.warns(UserWarning, match=r"^the environment cannot be restored, so fresh episodes begin\.$"):
        resumed.load_state_dict(state)
    replay_rows = len(replay)
    assert resumed.begins_fresh
    assert (resumed.frames, resumed.in_seed_phase) == (14, True)
    assert resumed.state_dict()["next_trajectory"] == state["next_trajectory"]
    resumed.seed_policy.calls = 0
    list(resumed)
    assert resumed.frames == 48
    assert (resumed.seed_policy.calls, resumed.policy.calls) == (1, 16)
    fresh = replay.storage[:][replay_rows:]
    assert rows <= replay_rows
    assert min(fresh[TRAJ_KEY].tolist()) > max(used)
    for row in (steps[0] for steps in episodes(fresh).values()):
        assert row["observation"][1] == 0


@pytest.mark.parametrize("way", ["restored", "others", "not plain"])
def test_what_transforms_remember_outlives_a_simulator_that_cannot_be_restored(way, monkeypatch):
    def make(transform):
        return make_collector(make_env((9,)).append_transform(transform))

    first = make(VecNormV2(in_keys=["observation"]))
    for _ in range(7):
        first.step()
    if way == "not plain":
        monkeypatch.setattr(VecNormV2, "get_extra_state", lambda self: object(), raising=False)
        monkeypatch.setattr(VecNormV2, "set_extra_state", lambda self, state: None, raising=False)
    state = first.state_dict()
    assert state["simulator"] is None
    second = make(StepCounter() if way == "others" else VecNormV2(in_keys=["observation"]))
    lost = {"others": "they are others than were saved", "not plain": "what they remember could not be saved"}
    lost = f", and its transforms begin anew: {lost[way]}" if way in lost else ""
    with pytest.warns(UserWarning, match=f"^the environment cannot be restored, so fresh episodes begin{lost}.$"):
        second.load_state_dict(state)
    if way == "restored":
        ours, theirs = (collector.env.transform.state_dict()["_extra_state"] for collector in (first, second))
        assert ours and all(torch.equal(theirs[name], ours[name]) for name in ours)


@pytest.mark.parametrize("lengths", [(9,), (9, 9)], ids=["one-env", "two-envs"])
@pytest.mark.parametrize("insertion", ["step", "episode"])
@pytest.mark.parametrize("message", ["the environment cannot be restored", "the simulator did not come back"])
def test_episodes_that_cannot_go_on_are_stored_to_their_last_step_as_truncated_ones(
    message, insertion, lengths, monkeypatch
):
    if "simulator" in message:
        monkeypatch.setattr("torchrl_etdmpc.collectors.step.load_simulator_state", lambda *_: False)
        monkeypatch.setattr("torchrl_etdmpc.collectors.step.simulator_state", lambda _: {})
    replay = make_replay(sampler=StepSliceSampler(3, partial=True), batch_size=3)
    options = {"replay_buffer": replay, "insertion": insertion}
    first, second = (StepCollector(make_env(lengths), RandomActions(), **options) for _ in range(2))
    for _ in range(5):
        first.step()
    state = first.state_dict()
    with pytest.warns(UserWarning, match=message):
        second.load_state_dict(state)
    assert second.begins_fresh
    rows = episodes(replay.storage[:])
    assert [[row["next", "truncated"].item() for row in steps] for steps in rows.values()] == [
        [False] * 4 + [True] for _ in lengths
    ]
    second.step()
    assert min(second.state_dict()["carrier"]["collector"]["traj_ids"].reshape(-1).tolist()) > max(rows)


@pytest.mark.parametrize("lengths", [(9,), (9, 9)], ids=["one-env", "two-envs"])
@pytest.mark.parametrize("faults", [1, 2], ids=["before-saving", "before-and-after"])
def test_ends_that_faults_made_are_made_again_in_a_buffer_that_was_saved_before(lengths, faults, monkeypatch):
    # What was written is never written again by a checkpoint, so the rows come back as they first were.
    monkeypatch.setattr("torchrl_etdmpc.collectors.step.load_simulator_state", lambda *_: True)
    monkeypatch.setattr("torchrl_etdmpc.collectors.step.simulator_state", lambda _: {})

    def make() -> StepCollector:
        sampler = StepSliceSampler(3, partial=True)
        return StepCollector(make_env(lengths), RandomActions(), replay_buffer=make_replay(sampler=sampler))

    first, second = make(), make()
    buffer = first.replay_buffer
    for _ in range(5):
        first.step()
    before = buffer.storage[:].clone()
    first._truncate_episodes()  # as a fault does
    for _ in range(3):
        first.step()
    buffer.sampler.sample(buffer.storage, 3)
    other = second.replay_buffer
    other.extend(torch.cat([before, buffer.storage[:][len(before) :]]))
    other.sampler.load_state_dict(buffer.sampler.state_dict())
    second.load_state_dict(first.state_dict())
    assert not second.begins_fresh
    if faults == 2:
        for collector in (first, second):
            collector._truncate_episodes()
    done = other.storage[:]["next", "done"].reshape(-1, len(lengths)).all(-1).tolist()
    assert done == [False] * 4 + [True] + [False] * 2 + [faults == 2]
    assert (other.storage[:] == buffer.storage[:]).all()
    torch.manual_seed(0)
    rows, _ = buffer.sampler.sample(buffer.storage, 300)
    torch.manual_seed(0)
    assert torch.equal(other.sampler.sample(other.storage, 300)[0], rows)


def test_the_ends_of_every_fault_are_kept():
    collector = make_collector(make_env((9,)))
    for _ in range(2):
        collector.step()
        collector._truncate_episodes()  # as a fault does
    assert collector.state_dict()["ended_rows"] == {0: 0, 1: 1}


def test_going_back_forgets_the_ends_that_faults_made_since(monkeypatch):
    monkeypatch.setattr("torchrl_etdmpc.collectors.step.load_simulator_state", lambda *_: True)
    monkeypatch.setattr("torchrl_etdmpc.collectors.step.simulator_state", lambda _: {})
    collector = make_collector(make_env((9,)))
    collector.step()
    state = collector.state_dict()
    collector.step()
    collector._truncate_episodes()  # as a fault does
    assert collector.state_dict()["ended_rows"]
    collector.load_state_dict(state)
    assert collector.state_dict()["ended_rows"] == {}


def test_a_row_that_was_written_over_is_not_ended_by_the_fault_of_an_older_episode(monkeypatch):
    monkeypatch.setattr("torchrl_etdmpc.collectors.step.load_simulator_state", lambda *_: True)
    monkeypatch.setattr("torchrl_etdmpc.collectors.step.simulator_state", lambda _: {})
    buffer = make_replay(4)
    first, second = (StepCollector(make_env((9,)), RandomActions(), replay_buffer=buffer) for _ in range(2))
    for _ in range(3):
        first.step()
    first._truncate_episodes()
    for _ in range(4):
        first.step()
    assert not buffer.storage[:]["next", "done"].any()
    second.load_state_dict(first.state_dict())
    assert not buffer.storage[:]["next", "done"].any()


def test_what_a_seed_policy_holds_is_saved_with_the_seed_phase_and_not_after_it():
    def make() -> StepCollector:
        env = make_env((5,))
        seeding = SeedPolicy(env.action_spec, hold=1e9, plan_key="target")
        options = {"replay_buffer": make_replay(), "init_random_frames": 3}
        return StepCollector(env, SeedPolicy(env.action_spec, plan_key="target"), seed_policy=seeding, **options)

    first, second = make(), make()
    first.step()
    held = first.step()["action"]
    with pytest.warns(UserWarning, match="fresh episodes begin"):
        second.load_state_dict(first.state_dict())
    assert torch.equal(second.step()["action"], held)
    first.step()
    assert not first.in_seed_phase
    assert first.state_dict()["seed_policy"] is None


def test_a_state_of_before_seed_policies_and_ends_were_saved_is_loaded():
    options = {"init_random_frames": 9, "seed_policy": RandomActions()}
    first, second = (make_collector(make_env((5,)), **options) for _ in range(2))
    first.step()
    state = first.state_dict()
    for name in ("seed_policy", "ended_rows", "last_rows"):
        del state[name]
    with pytest.warns(UserWarning, match="fresh episodes begin"):
        second.load_state_dict(state)
    second.step()
    assert second.frames == 2


def test_a_seed_policy_that_is_no_module_has_nothing_to_save():
    def make() -> StepCollector:
        env = make_env((5,))
        random = RandomPolicy(env.action_spec)  # TorchRL's, a plain class
        return StepCollector(env, random, seed_policy=random, replay_buffer=make_replay(), init_random_frames=9)

    first, second = make(), make()
    first.step()
    with pytest.warns(UserWarning, match="fresh episodes begin"):
        second.load_state_dict(first.state_dict())
    second.step()
    assert second.frames == 2


@pytest.mark.parametrize("kind", [SerialEnv, pytest.param(ParallelEnv, marks=pytest.mark.slow)])
def test_a_collector_that_has_not_acted_can_be_saved_even_if_its_workers_rescale_actions(kind):
    def make() -> StepCollector:
        env = kind(2, _make_rescaled)
        return StepCollector(env, RandomPolicy(env.action_spec), replay_buffer=make_replay())

    first, second = make(), make()
    second.load_state_dict(first.state_dict())
    assert not second.begins_fresh  # there was nothing to come back to
    second.act()
    assert second.state_dict()["simulator"] is None
    second.step()
    with pytest.warns(UserWarning, match="the environment cannot be restored"):
        first.load_state_dict(second.state_dict())
    assert first.state_dict()["frames"] == 2
    first.step()
    assert first.frames == 4
    first.shutdown()
    second.shutdown()


def test_a_simulator_that_cannot_tell_its_state_does_not_keep_the_rest_from_being_saved(monkeypatch):
    def fail(env: EnvBase) -> None:
        raise RuntimeError("At least one process failed\nTraceback")

    first, second = (make_collector() for _ in range(2))
    first.step()
    monkeypatch.setattr("torchrl_etdmpc.collectors.step.simulator_state", fail)
    with pytest.warns(UserWarning, match=r"cannot tell its state \(At least one process failed\): a run that goes on"):
        state = first.state_dict()
    with pytest.warns(UserWarning, match="the environment cannot be restored, so fresh episodes begin"):
        second.load_state_dict(state)
    second.step()
    assert second.frames == 2


def _make_rescaled() -> TransformedEnv:
    return TransformedEnv(GymEnv("Pendulum-v1"), ActionScaling())


def test_shutdown_closes_the_environment_and_may_be_repeated():
    env = make_env((3, 5))
    collector = make_collector(env)
    collector.step()
    collector.shutdown()
    assert env.is_closed
    collector.shutdown()
    collector.shutdown(raise_on_error=True)


def test_shutdown_of_an_environment_that_was_closed_elsewhere_is_harmless():
    env = make_env((3, 5))
    collector = make_collector(env)
    collector.step()
    env.close()
    collector.shutdown()


def test_shutdown_can_leave_the_environment_open():
    env = make_env((3, 5))
    collector = make_collector(env)
    collector.step()
    collector.shutdown(close_env=False)
    assert not env.is_closed
    env.close()


def _nan_at(call_number):
    return lambda call, action: torch.full_like(action, torch.nan) if call == call_number else action


@pytest.mark.parametrize(
    ("broken", "source", "key"),
    [
        ("observation", "the environment", r"\('next', 'observation'\)"),
        ("reward", "the environment", r"\('next', 'reward'\)"),
        ("action", "the policy", "'action'"),
    ],
)
def test_a_non_finite_value_is_named_with_its_step_and_not_stored(broken, source, key):
    replay = make_replay()
    policy = RandomActions(answer=_nan_at(6) if broken == "action" else None)
    collector = StepCollector(LineEnv(4, broken=broken, broken_at=6), policy, replay_buffer=replay)
    for _ in range(5):
        collector.step()
    with pytest.raises(NonFiniteError, match=f"{source} returned a non-finite {key} at decision step 5 .*not stored"):
        collector.step()
    assert len(replay) == collector.frames == 5
    assert all(value.isfinite().all() for value in replay.storage[:].values(True, True) if value.is_floating_point())


def test_a_policy_that_writes_no_action_is_answered_with_what_it_wrote():
    policy = TensorDictModule(lambda observation: observation, in_keys=["observation"], out_keys=["torque"])
    collector = StepCollector(LineEnv(4), policy, replay_buffer=make_replay())
    with pytest.raises(KeyError, match=r"the policy wrote no .*action.*; it wrote .*torque"):
        collector.step()


@pytest.mark.parametrize("resets", [1, 2], ids=["first-reset", "later-reset"])
def test_a_non_finite_observation_of_a_reset_is_named_and_not_stored(resets):
    replay = make_replay()
    collector = StepCollector(LineEnv(4, broken="reset", broken_at=resets), RandomActions(), replay_buffer=replay)
    for _ in range(4 * (resets - 1)):
        collector.step()
    with pytest.raises(NonFiniteError, match="the environment returned a non-finite 'observation' at decision step"):
        collector.step()
    assert len(replay) == 4 * (resets - 1)
    assert collector.policy.calls == 4 * (resets - 1)


def test_a_non_finite_observation_of_a_reset_is_named_by_a_collector_that_goes_on_from_there(monkeypatch):
    monkeypatch.setattr("torchrl_etdmpc.collectors.step.load_simulator_state", lambda *_: True)
    monkeypatch.setattr("torchrl_etdmpc.collectors.step.simulator_state", lambda _: {})
    first, second = (make_collector(LineEnv(4, broken="reset", broken_at=2)) for _ in range(2))
    for _ in range(4):
        first.step()
    second.load_state_dict(first.state_dict())
    with pytest.raises(NonFiniteError, match="the environment returned a non-finite 'observation' at decision step 4"):
        second.step()
    assert len(second.replay_buffer) == second.policy.calls == 0


def test_a_non_finite_value_is_traced_to_its_environment():
    env = SerialEnv(3, [LineEnv, partial(LineEnv, broken="reward", broken_at=2), LineEnv])
    replay = make_replay()
    collector = StepCollector(env, RandomActions(), replay_buffer=replay)
    collector.step()
    with pytest.raises(NonFiniteError, match=r"at decision step 3 \(environments \[1\]\)"):
        collector.step()
    assert len(replay) == 3


@pytest.mark.parametrize("insertion", ["step", "episode"])
@pytest.mark.parametrize("broken", ["observation", "reward", "action"])
def test_collection_that_goes_on_after_a_non_finite_step_starts_a_fresh_episode(broken, insertion):
    replay = make_replay()
    policy = RandomActions(answer=_nan_at(6) if broken == "action" else None)
    env = LineEnv(4, broken=broken, broken_at=6)
    collector = StepCollector(env, policy, replay_buffer=replay, insertion=insertion)
    for _ in range(5):
        collector.step()
    with pytest.raises(NonFiniteError):
        collector.step()
    for _ in range(8):
        collector.step()
    rows = episodes(replay.storage[:])
    assert [len(steps) for steps in rows.values()] == [4, 1, 4, 4]
    assert [steps[-1]["next", "truncated"].item() for steps in rows.values()] == [True] * 4
    for steps in rows.values():
        assert [int(row["observation"][1]) for row in steps] == list(range(len(steps)))


@pytest.mark.parametrize("lengths", [(9,), (9, 9)], ids=["one-env", "two-envs"])
@pytest.mark.parametrize("storage", [LazyMemmapStorage, ListStorage, LazyStackStorage])
def test_a_fault_ends_episodes_in_other_storages_too(storage, lengths):
    replay = ReplayBuffer(storage=storage(100))
    collector = StepCollector(make_env(lengths, broken="reward", broken_at=3), RandomActions(), replay_buffer=replay)
    with pytest.raises(NonFiniteError, match="at decision step"):
        while True:
            collector.step()
    rows = [replay.storage[row] for row in range(len(replay))]
    flags = [[row["next", name].item() for row in rows] for name in ("truncated", "done", "terminated")]
    running = [False] * len(lengths)
    assert flags == [running + [True] * len(lengths)] * 2 + [running * 2]


@pytest.mark.parametrize("lengths", [(9,), (9, 9)], ids=["one-env", "two-envs"])
@pytest.mark.parametrize("capacity", [100, 8])  # 8: a ring that is written over
def test_a_sampler_that_followed_an_episode_learns_that_a_fault_ended_it(lengths, capacity):
    replay = make_replay(capacity, sampler=StepSliceSampler(3, partial=True), batch_size=6000)
    env = make_env(lengths, broken="reward", broken_at=14)
    collector = StepCollector(env, RandomActions(), replay_buffer=replay)
    with pytest.raises(NonFiniteError):
        while True:
            collector.step()
            if len(replay) > 2 * len(lengths):
                replay.sample()
    # All episodes have ended now, so a slice may begin in every row.
    assert set(replay.sample()["index"].reshape(-1, 3)[:, 0].tolist()) == set(range(len(replay)))


def test_no_gradient_is_recorded():
    weight = torch.nn.Parameter(torch.ones(1))
    policy = RandomActions(answer=lambda call, action: action * weight)
    (row,) = StepCollector(make_env(), policy, replay_buffer=make_replay(), total_frames=1)
    assert not row["action"].requires_grad


def test_a_step_is_its_two_halves():
    stored = []
    for step in (lambda collector: collector.step(), lambda collector: collector.finish_step(collector.act())):
        torch.manual_seed(0)
        replay = make_replay()
        collector = StepCollector(make_env((3, 5)), RandomActions(), replay_buffer=replay)
        collector.set_seed(0)
        rows = [step(collector) for _ in range(9)]
        assert collector.frames == 18
        assert all(row.batch_size == (2,) for row in rows)
        stored.append(replay.storage[:])
    assert (stored[0] == stored[1]).all()


def test_between_the_halves_the_action_is_chosen_and_the_environment_has_not_stepped():
    env, buffer = LineEnv(), make_replay()
    collector = StepCollector(env, RandomActions(), replay_buffer=buffer)
    for number in range(3):
        acted = collector.act()
        assert torch.is_grad_enabled()
        assert (len(buffer), env.steps, collector.frames) == (number, number, number)
        action = acted["action"].clone()
        stepped = collector.finish_step(acted)
        assert torch.equal(stepped["action"], action)
        assert (len(buffer), env.steps, collector.frames) == (number + 1, number + 1, number + 1)


@pytest.mark.parametrize("lengths", [(4,), (3, 5)], ids=["one-env", "two-envs"])
def test_that_a_plan_fell_back_is_in_the_step_and_not_in_the_buffer(lengths):
    replay, planner = make_replay(), make_planner()
    collector = StepCollector(make_env(lengths), planner, replay_buffer=replay)
    assert not collector.step()["plan", "fallback"].any()
    planner.score = FunctionScore(lambda returns: torch.full(returns.shape[:-3], torch.nan))
    assert collector.step()["plan", "fallback"].all()
    assert ("plan", "fallback") not in replay.storage[:].keys(True, True)
    assert ("plan", "loc") in replay.storage[:].keys(True, True)


def test_an_episode_that_terminated_is_not_called_truncated_by_a_fault_behind_it():
    replay = make_replay()
    policy = RandomActions(answer=lambda call, action: torch.ones_like(action))
    collector = StepCollector(LineEnv(border=0.5, broken="reward", broken_at=2), policy, replay_buffer=replay)
    collector.step()
    with pytest.raises(NonFiniteError):
        collector.step()
    (row,) = replay.storage[:]
    assert [row["next", name].item() for name in ("done", "terminated", "truncated")] == [True, True, False]


@pytest.mark.parametrize("insertion", ["step", "episode"])
def test_a_last_step_that_is_not_finite_is_not_stored_where_the_reset_behind_it_fails(insertion):
    replay = make_replay()
    env = FailingReset(3, broken="reward", broken_at=3)
    collector = StepCollector(env, RandomActions(), replay_buffer=replay, insertion=insertion)
    for _ in range(2):
        collector.step()
    with pytest.raises(SimulatorError):
        collector.step()
    rows = replay.storage[:]
    assert rows["next", "reward"].isfinite().all()
    assert rows["next", "truncated"].flatten().tolist() == [False, True]
