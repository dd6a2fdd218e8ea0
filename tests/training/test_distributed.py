"""Workers in the place of steps: quick ones in this process, real ones of both engines."""

from __future__ import annotations

import csv
import dataclasses
import itertools
import math
import os
import re
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cloudpickle
import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl import torchrl_logger
from torchrl.collectors import Collector
from torchrl.envs import ActionScaling, Compose, EnvBase, GymEnv, RewardScaling, StepCounter, TransformedEnv

pytest.importorskip("gymnasium")

import torchrl_etdmpc.training.distributed as distributed  # noqa: E402
from torchrl_etdmpc.checkpoints import CheckpointStore  # noqa: E402
from torchrl_etdmpc.collectors import NonFiniteError, SimulatorError  # noqa: E402
from torchrl_etdmpc.envs import Task, import_task, make_env, register_task, tasks  # noqa: E402
from torchrl_etdmpc.runs import RunDirectory  # noqa: E402
from torchrl_etdmpc.training import (  # noqa: E402
    DistributedConfig,
    Learner,
    TrainConfig,
    build_agent,
    build_replay,
    launch,
    load_agent,
    preset,
    read_run_config,
    resumed_config,
)
from torchrl_etdmpc.training.own_code import follow_own_code  # noqa: E402
from torchrl_etdmpc.training.ray_cluster import RayCluster  # noqa: E402
from torchrl_etdmpc.training.signals import RunInterrupted  # noqa: E402
from torchrl_etdmpc.training.workers import send_weights  # noqa: E402

TINY: dict[str, Any] = {
    "task": "gym/Pendulum-v1",
    "preset": "cpu",
    "total_env_steps": 200,
    "episode_length": 20,
    "compile": "off",
    "threads": 1,
    "eval_every": 100_000,
    "eval_episodes": 1,
    "log_every": 50,
    "rows_per_batch": 8,
    "send_every": 4,
    "model": {"latent_dim": 16, "mlp_dim": 16, "encoder_dim": 16, "num_dynamics": 1},
    "planner": {"horizon": 2, "num_samples": 8, "num_elites": 4, "num_proposals": 2, "iterations": 1},
    "reanalyze": {
        **{"horizon": 2, "num_samples": 6, "num_elites": 3, "num_proposals": 1, "iterations": 1},
        **{"every": 3, "num_slices": 2},
    },
    "optim": {"batch_size": 4},
    "replay": {"seed_decisions": 40, "pretrain_updates": 5},
}


def config_of(**changes: Any) -> DistributedConfig:
    return DistributedConfig.from_dict(TINY | changes)


class Workers:
    """Workers in this process, in turn, as the multi-process collectors drive them; batch ``fails_at`` fails."""

    def __init__(self, parts, numbers: range, rows: int, error: BaseException | None, fails_at: int) -> None:
        self.actors = [parts.make_actor() for _ in numbers]
        options: dict[str, Any] = {"frames_per_batch": rows, "auto_register_policy_transforms": True}
        makers = zip(numbers, self.actors, strict=True)
        self.workers = [Collector(parts.make_env(number), actor, **options) for number, actor in makers]
        self.error, self.fails_at, self.closed = error, fails_at, False
        self.sent: list[tuple[list[int] | None, bool, int]] = []

    def __iter__(self) -> Iterator[TensorDictBase]:
        iterators = [iter(worker) for worker in self.workers]
        batches = 0
        while True:
            for iterator in iterators:
                if batches == self.fails_at and self.error is not None:
                    raise self.error
                batches += 1
                yield next(iterator)

    def update_policy_weights_(self, weights: TensorDictBase, worker_ids: list[int] | None = None) -> None:
        places = range(len(self.actors)) if worker_ids is None else worker_ids
        for place in places:
            TensorDict.from_module(self.actors[place]).data.update_(weights)
        version = weights["planner", "module", "world_model", "version"]
        self.sent.append((worker_ids, bool(weights["planning"]), int(version)))

    def shutdown(self) -> None:
        self.closed = True
        for worker in self.workers:
            worker.shutdown()


@pytest.fixture(autouse=True)
def own_registry(monkeypatch: pytest.MonkeyPatch) -> None:
    """Workers of this process register their task here, too."""
    monkeypatch.setattr(tasks, "_tasks", dict(tasks._tasks))
    monkeypatch.setattr(tasks, "_makers", dict(tasks._makers))


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> Callable[..., list[Workers]]:
    """Replaces processes by workers in this one; returns those that were started, as they are."""

    def replace(
        *, error: BaseException | None = None, fails_at: int = 0, again: BaseException | None = None
    ) -> list[Workers]:
        every: list[Workers] = []

        def start(parts, *, engine: str, numbers: range, rows: int) -> Any:
            fails = {0: (error, fails_at), 1: (again, 0)}.get(len(every), (None, 0))
            every.append(Workers(parts, numbers, rows, *fails))
            return every[-1]

        monkeypatch.setattr(distributed, "start_workers", start)
        return every

    return replace


def learner_of(config: DistributedConfig) -> Learner:
    torch.manual_seed(0)
    return Learner(config, make_env(config.task_spec, seed=0))


def explore_and_pretrain(learner: Learner) -> None:
    while learner.collector.in_seed_phase:
        learner.step()
    for _ in learner.pretrain():
        pass


def test_workers_act_at_random_until_they_get_weights_to_plan_with(started):
    workers, learner = started(), learner_of(config_of(reanalyze=TINY["reanalyze"] | {"every": 0}))
    explore_and_pretrain(learner)
    assert workers[0].sent == [(None, False, 0)]
    learner.step(updates=True)
    assert workers[0].sent[1:] == [(None, True, 5)]
    rows = learner.replay[:]
    assert rows["plan", "scale"][:40].eq(1).all() and rows["plan", "version"][:40].eq(0).all()
    assert rows["plan", "version"][40:].eq(5).all() and rows["plan", "scale"][40:].ne(1).any()
    learner.collector.shutdown()
    assert workers[0].closed and learner.collector.env.is_closed


def test_each_worker_holds_random_actions_of_its_own(started):
    started()
    learner = learner_of(config_of(replay=TINY["replay"] | {"seed_hold": 1e9}))
    while learner.collector.in_seed_phase:
        learner.step()
    rows = learner.replay[:]
    actions = [rows["action"][rows["worker"].squeeze(-1) == worker].unique(dim=0) for worker in (0, 1)]
    assert [len(own) for own in actions] == [1, 1]
    assert not torch.equal(*actions)
    learner.collector.shutdown()


@pytest.mark.parametrize(("send_every", "expected"), [(20, [0, 8, 16, 0, 8, 16]), (16, [0, 8, 0, 8])])
def test_a_row_says_how_many_updates_older_its_weights_were_than_the_learner_s(started, send_every, expected):
    """They are sent as soon as there are as many updates as are said; both workers read the same memory."""
    started()
    learner = learner_of(config_of(send_every=send_every))
    explore_and_pretrain(learner)
    ages = []
    for _ in expected:
        learner.collector.act()
        rows = learner.collector.finish_step()
        ages += rows["weight_age"].unique().tolist()
        learner.updates(rows.numel())
    assert ages == expected
    learner.collector.shutdown()


def test_a_random_action_has_no_age_whenever_it_arrives(started, monkeypatch):
    started()
    learner = learner_of(config_of())
    learner.collector.act()
    learner.agent.world_model.version += 5
    rows = learner.collector.finish_step()
    assert rows["weight_age"].eq(-1).all()
    rows["weight_age"][5:] = 4  # as of a worker that began to plan meanwhile
    monkeypatch.setattr(learner.collector, "finish_step", lambda acted: rows)
    learner.step(updates=True)
    assert learner.pop_row()["weight_age"] == 4
    learner.collector.shutdown()


def test_a_batch_of_one_worker_passes_every_interval_that_ends_in_it(started):
    started()
    learner = learner_of(config_of(workers=1))
    passed = []
    for _ in range(6):
        learner.step()
        passed.append(learner.passed(10))
    assert passed == [False, True, True, True, True, False]  # at 8, 16, ... 48
    learner.collector.shutdown()


def test_no_worker_of_a_run_begins_as_one_of_a_run_with_another_seed_does():
    starts = set()
    for seed in (1, 2, 3):
        parts = distributed.WorkerParts(config_of(seed=seed), (3, 1), discount=0.99)
        starts |= {tuple(parts.make_env(number).reset()["observation"].tolist()) for number in range(3)}
    assert len(starts) == 9


def test_what_a_worker_draws_follows_from_its_number():
    parts, draws = distributed.WorkerParts(config_of(), (3, 1), discount=0.99), []
    for number in (0, 1, 0):
        parts.make_env(number)
        draws.append(torch.rand(3).tolist())
    assert draws[0] == draws[2] != draws[1]


def test_only_the_worker_that_sent_rows_gets_weights_where_each_has_its_own(started, monkeypatch):
    monkeypatch.setattr(distributed, "RayCluster", lambda address, *, workers: RayConnection())
    workers, learner = started(), learner_of(config_of(engine="ray"))
    explore_and_pretrain(learner)
    for _ in range(4):
        learner.step(updates=True)
    first = 40 // 8 % 2  # whose turn it is after the random phase
    assert [place for place, planning, _ in workers[0].sent if planning] == [None, *([[first], [1 - first]] * 2)[:3]]
    learner.collector.shutdown()


def test_a_run_that_cannot_begin_closes_the_cluster_that_it_began(tmp_path, monkeypatch):
    closed = []
    monkeypatch.setattr(RayConnection, "close", lambda self: closed.append(1))
    monkeypatch.setattr(distributed, "RayCluster", lambda address, *, workers: RayConnection())
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match="cannot be written"):
        launch(config_of(engine="ray", run_dir=str(tmp_path / "file" / "run")))
    assert closed == [1]


class RayConnection:
    def close(self) -> None:
        pass


def test_first_episodes_that_are_cut_early_are_told_however_many_workers_play(started, monkeypatch):
    started()
    make = distributed.WorkerParts.make_env
    monkeypatch.setattr(
        distributed.WorkerParts, "make_env", lambda *args: make(*args).append_transform(StepCounter(16))
    )
    learner = learner_of(config_of(workers=3))
    for _ in range(3):
        learner.step()
    with pytest.warns(UserWarning, match="truncated within its first 16 env steps, but its time limit is sai"):
        learner.step()
    learner.collector.shutdown()


def test_an_episode_of_full_length_is_not_told_where_one_worker_comes_first(started, monkeypatch):
    def one_after_the_other(workers: Workers) -> Iterator[TensorDictBase]:
        for worker in workers.workers:
            yield from itertools.islice(worker, 3)

    monkeypatch.setattr(Workers, "__iter__", one_after_the_other)
    started()
    learner = learner_of(config_of())
    for _ in range(6):  # with warnings as errors
        learner.step()
    assert learner.replay[:]["next", "truncated"].flatten().nonzero().flatten().tolist() == [19, 24 + 19]
    learner.collector.shutdown()


def test_slices_never_join_the_rows_of_two_workers(started):
    started()
    learner = learner_of(config_of(workers=3, rows_per_batch=7))
    explore_and_pretrain(learner)
    numbers = learner.replay[:]["worker"].flatten()
    assert numbers.unique().tolist() == [0, 1, 2]
    assert {"weight_age", ("next", "worker")}.isdisjoint(learner.replay[:].keys(True, True))
    assert learner.replay[:]["collector", "traj_ids"].unique().tolist() == [0]  # of each worker
    for _ in range(20):
        slices = learner.replay.sample().reshape(-1, 3)
        assert (slices["worker"] == slices["worker"][:, :1]).all()
        assert torch.equal(slices["next", "observation"][:, :-1], slices["observation"][:, 1:])
    learner.collector.shutdown()


def test_the_budget_is_kept_to_the_step(started):
    started()
    learner = learner_of(config_of(total_env_steps=53, replay=TINY["replay"] | {"seed_decisions": 30}))
    explore_and_pretrain(learner)
    while learner.env_steps < 53:
        learner.step(updates=True)
    assert learner.env_steps == len(learner.replay) == 53
    assert learner.agent.updater.updates == 5 + 53 - 32
    learner.collector.shutdown()


def test_after_a_failure_other_workers_go_on_in_fresh_episodes(started):
    workers, learner = started(error=RuntimeError("the physics is invalid"), fails_at=8), learner_of(config_of())
    explore_and_pretrain(learner)
    with pytest.warns(UserWarning, match="a worker failed: the physics is invalid; all workers are started anew; "):
        while learner.step(updates=True):
            pass
    assert learner.faults == 1 and workers[0].closed
    for _ in range(2):
        learner.step(updates=True)
    assert workers[1].sent[0] == (None, True, learner.agent.updater.updates - 16)
    assert learner.collector.decisions_each == 8  # of those that play now
    assert learner.replay[:]["worker"].unique().tolist() == [0, 1, 2, 3]
    learner.collector.shutdown()


def test_workers_that_fail_while_they_are_started_anew_are_one_failure_more(started):
    errors = RuntimeError("the physics is invalid"), RuntimeError("Cannot allocate memory")
    workers, learner = started(error=errors[0], fails_at=8, again=errors[1]), learner_of(config_of())
    explore_and_pretrain(learner)
    with pytest.warns(UserWarning, match="a worker failed: ") as warned:
        while len(workers) < 3:
            learner.step(updates=True)
    assert [str(error) in str(warning.message) for error, warning in zip(errors, warned, strict=True)] == [True, True]
    frames = learner.collector.frames
    learner.step(updates=True)
    assert learner.collector.frames > frames
    learner.collector.shutdown()


def test_a_worker_that_fails_before_its_first_rows_ends_the_run(started):
    started(error=ValueError("no such simulator\nmore"))
    learner = learner_of(config_of())
    with pytest.raises(RuntimeError, match="^a worker failed: no such simulator, before it sent a row$") as caught:
        learner.step()
    assert not isinstance(caught.value, SimulatorError)
    learner.collector.shutdown()


def test_a_worker_has_the_maker_that_the_program_has_registered(monkeypatch):
    def paid(task: Task, *, device: torch.device | str) -> EnvBase:
        return TransformedEnv(
            GymEnv("Pendulum-v1", device=device), Compose(ActionScaling(), RewardScaling(1000.0, 1.0))
        )

    def rewards_in_another_process() -> torch.Tensor:
        parts = distributed.WorkerParts(config, (3, 1), 0.99, None, distributed.known_here(config))
        sent = cloudpickle.dumps(parts)
        with monkeypatch.context() as other:
            other.setattr(tasks, "_tasks", {})
            other.setattr(tasks, "_makers", {})
            return cloudpickle.loads(sent).make_env(0).rollout(5)["next", "reward"]

    config = config_of()
    assert (rewards_in_another_process() < 0).all()
    register_task(Task(config.task, "gymnasium", episode_length=200), paid)
    assert (rewards_in_another_process() > 900).all()


def test_a_worker_knows_a_task_that_the_program_has_registered_without_a_maker(monkeypatch):
    pytest.importorskip("dm_control")
    register_task(Task("swimmer-swimmer6", "dm_control", action_repeat=2, episode_length=1000, terminates=False))
    config = config_of(task="swimmer-swimmer6")
    parts = distributed.WorkerParts(config, (25, 5), 0.99, None, distributed.known_here(config))
    for registry in (dict(tasks._tasks), {}):  # as it is without what the run changes, or not at all
        monkeypatch.setattr(tasks, "_tasks", registry)
        assert parts.make_env(0).rollout(2)["action"].shape == (2, 5)


def test_a_worker_imports_a_task_of_ones_own_as_it_was_told(tmp_path, monkeypatch):
    (tmp_path / "workers_task.py").write_text(
        "from gymnasium.envs.classic_control.pendulum import PendulumEnv\n"
        "from torchrl.envs import ActionScaling, GymWrapper, TransformedEnv\n"
        "def make(): return TransformedEnv(GymWrapper(PendulumEnv()), ActionScaling())\n"  # shows no time limit
    )
    monkeypatch.syspath_prepend(tmp_path)
    import_task("workers_task:make", episode_length=20)
    config = config_of(task="workers_task:make")
    parts = distributed.WorkerParts(config, (3, 1), 0.99, None, distributed.known_here(config))
    for registry in ("_tasks", "_makers"):  # as in another process
        monkeypatch.setattr(tasks, registry, {})
    assert parts.make_env(0).rollout(30).shape == (20,)


def test_a_worker_plans_with_a_score_of_ones_own(tmp_path, monkeypatch):
    (tmp_path / "workers_score.py").write_text("def cautious(returns): return returns.mean((-3, -2, -1))\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr("torchrl_etdmpc.training.own_code._followed", {})
    follow_own_code("planner.score", "workers_score:cautious")
    parts = distributed.WorkerParts(
        config_of(planner=TINY["planner"] | {"score": "workers_score:cautious"}), (3, 1), 0.99
    )
    monkeypatch.setattr("torchrl_etdmpc.training.own_code._followed", {})  # as in another process
    assert parts.make_actor().planner.score.function.__name__ == "cautious"


def test_rows_that_are_not_finite_are_not_stored(started):
    workers, learner = started(), learner_of(config_of(workers=1))
    learner.step()
    next_rows = iter(workers[0])

    def broken() -> Iterator[TensorDictBase]:
        for key in ("plan", "value"), ("next", "reward"):
            rows = next(next_rows)
            rows[key][3] = math.nan
            yield rows

    learner.collector._batches = broken()
    learner.step()  # a plan that fell back has no value
    assert len(learner.replay) == 16
    learner.collector.act()
    with pytest.raises(NonFiniteError, match=r"worker 0 sent a non-finite \('next', 'reward'\) after 16 decisions"):
        learner.collector.finish_step()
    assert len(learner.replay) == 16 and workers[0].closed
    learner.collector.shutdown()


def test_rows_that_do_not_continue_those_before_are_not_stored(started):
    workers, learner = started(), learner_of(config_of(workers=1))
    learner.step()
    every = iter(workers[0])
    next(every)  # is lost
    learner.collector._batches = every
    learner.collector.act()
    with pytest.raises(SimulatorError, match=r"^worker 0 sent rows that do not continue those before, after 8 decisi"):
        learner.collector.finish_step()
    assert len(learner.replay) == 8 and workers[0].closed
    for _ in range(4):
        learner.step()  # others
    assert len(learner.replay) == 40
    learner.collector.shutdown()


def test_what_goes_on_from_a_checkpoint_numbers_its_workers_on(started):
    started()
    first = learner_of(config_of())
    first.step()
    second = learner_of(config_of())
    second.collector.load_state_dict(first.collector.state_dict())
    second.step()
    assert second.collector.frames == 16
    assert set(second.replay[:]["worker"].flatten().tolist()) <= {2, 3}
    for learner in (first, second):
        learner.collector.shutdown()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"workers": 0}, "workers must be at least 1, got 0."),
        ({"workers": 5000}, "workers must be at most 4096, got 5000."),
        ({"rows_per_batch": 0}, "rows_per_batch must be at least 1, got 0."),
        ({"send_every": 0}, "send_every must be at least 1, got 0."),
        ({"engine": "slurm"}, "engine must be one of multi, ray, got 'slurm'."),
        ({"address": "auto"}, "address must be null with engine=multi, got 'auto'; say address=null or engine=ray."),
        (
            {"workers": 8, "rows_per_batch": 2, "replay": {"seed_decisions": 16}},
            "replay.seed_decisions must be at least 24 with workers=8 whose batches (rows_per_batch=2) are shor",
        ),
        (
            {"workers": 8, "rows_per_batch": 2, "replay": {"seed_decisions": 24, "capacity": 47}},
            "replay.capacity must be at least 48 with workers=8 ",
        ),
        (
            {"rows_per_batch": 300},
            "total_env_steps must exceed the random phase of 300 env steps, got 200; raise the budget or lower "
            "rows_per_batch.",
        ),
        ({"num_envs": 2}, "num_envs must be 1 with workers, got 2: each worker has one environment; raise workers."),
        ({"overlap": True}, "overlap must be false with workers, got true: workers step while the learner updates"),
        (
            {"replay": {"insertion": "episode", "seed_decisions": 40}, "total_env_steps": 300},
            "replay.insertion must be step with workers, got episode: rows are stored when they arrive.",
        ),
    ],
)
def test_settings_that_workers_cannot_follow_are_refused(changes, message):
    with pytest.raises(ValueError) as caught:
        config_of(**changes)
    assert str(caught.value).startswith(message)


def test_batches_of_a_whole_slice_need_no_more_rows_than_those_of_one_process():
    config = config_of(workers=8, rows_per_batch=3, replay={"seed_decisions": 16})
    assert (config.seed_decisions, config.loss.slice_len) == (16, 3)


def test_an_agent_file_is_loaded_by_one_process_and_its_run_gone_on_with_by_workers(started, tmp_path):
    started()
    line = launch(config_of(run_dir=str(tmp_path / "run"), total_env_steps=60, log_every=10))
    directory = RunDirectory(tmp_path / "run")
    assert line.startswith("gym/Pendulum-v1: return ") and directory.finished
    agent, loaded, _ = load_agent(directory.last_agent)
    assert type(loaded) is TrainConfig and loaded.task == "gym/Pendulum-v1"
    stored = read_run_config(directory, DistributedConfig)
    assert (stored.workers, stored.rows_per_batch) == (2, config_of().rows_per_batch)
    text = directory.config.read_text()
    directory.config.write_text(text[:-20])
    with pytest.warns(UserWarning, match="the settings are those of"):
        assert read_run_config(directory, DistributedConfig) == stored
    with pytest.warns(UserWarning, match="the settings are those of"), pytest.raises(ValueError, match="is a run of w"):
        read_run_config(directory)
    directory.config.write_text(text)
    assert CheckpointStore(directory.checkpoints).exists()
    with directory.train.open() as file:
        rows = list(csv.DictReader(file))
    assert float(rows[-1]["weight_age"]) >= 0
    # It may go on, with other workers, and a run of one process may not go on with it.
    longer = config_of(run_dir=str(tmp_path / "run"), total_env_steps=80, workers=1, resume="on")
    assert "80 env steps" in launch(longer, ["total_env_steps", "workers", "resume"])
    with pytest.raises(ValueError, match="is a run of workers; go on with the command distributed, or start a new"):
        read_run_config(directory)


def test_a_run_may_go_on_with_other_workers():
    changes = {"workers": 3, "engine": "ray", "address": "auto"}
    assert resumed_config(config_of(), changes, changes) == config_of(**changes)


def test_a_run_of_one_process_is_not_gone_on_with_by_workers(tmp_path):
    directory = RunDirectory(tmp_path / "run")
    directory.begin(TrainConfig.from_dict({key: TINY[key] for key in ("task", "total_env_steps", "replay")}).to_dict())
    with pytest.raises(ValueError, match="is a run of one process; go on with the command train, or start a new"):
        read_run_config(directory, DistributedConfig)
    directory.close()


@pytest.mark.parametrize(
    ("address", "error", "message"),
    [
        ("127.0.0.1:1", OSError, r"address=127.0.0.1:1 cannot be reached \(Connection refused\); start Ray there"),
        ("ray://127.0.0.1:1", OSError, r"address=ray://127.0.0.1:1 cannot be reached \(Connection refused\)"),
        ("localhost", ValueError, "address must be host:port, ray://host:port or auto, got 'localhost'."),
    ],
)
def test_an_address_where_no_cluster_is_costs_one_line_and_nothing_else(address, error, message, tmp_path):
    pytest.importorskip("ray")
    with pytest.raises(error, match=message):
        launch(config_of(engine="ray", address=address, run_dir=str(tmp_path / "run")))
    assert not (tmp_path / "run").exists()


def processes_of(owner: int) -> set[int]:
    """The children of a process, without what Python itself keeps for semaphores and forks."""
    found = set()
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            stat = (folder / "stat").read_text().rpartition(")")[2].split()
            if int(stat[1]) == owner and stat[0] != "Z" and b"spawn_main" in (folder / "cmdline").read_bytes():
                found.add(int(folder.name))
        except (OSError, IndexError):
            continue
    return found


def test_two_processes_collect_every_row_for_a_slow_learner_and_none_is_left(tmp_path, monkeypatch):
    before = processes_of(os.getpid())
    monkeypatch.setenv("MUJOCO_GL", "disable")
    finish_step, batches = distributed.WorkerCollector.finish_step, []

    def slowly(collector: distributed.WorkerCollector, acted: None) -> TensorDictBase:
        batches.append(finish_step(collector, acted).clone())
        if len(batches) in (8, 9, 10):
            time.sleep(1.5)  # TorchRL's workers wait for a second
        return batches[-1]

    monkeypatch.setattr(distributed.WorkerCollector, "finish_step", slowly)
    line = launch(config_of(run_dir=str(tmp_path / "run")))
    for worker in (0, 1):
        rows = torch.cat([batch for batch in batches if batch["worker"][0] == worker])
        goes_on = ~rows["next", "done"][:-1, 0]
        assert goes_on.any()
        assert torch.equal(rows["observation"][1:][goes_on], rows["next", "observation"][:-1][goes_on])
    assert "after 200 env steps" in line
    directory = RunDirectory(tmp_path / "run")
    with directory.train.open() as file:
        rows = list(csv.DictReader(file))
    assert int(rows[-1]["env_steps"]) == 200 and int(rows[-1]["updates"]) == 5 + 160
    assert 0 <= float(rows[-1]["weight_age"]) < 60 and float(rows[-1]["target_age"]) >= 0
    assert processes_of(os.getpid()) <= before


@pytest.mark.parametrize(("where", "batches"), [("batch", 3), ("batch", 12), ("weights", 5)])
def test_a_signal_is_obeyed_while_the_workers_hang(tmp_path, monkeypatch, where, batches):
    """In the random phase, which has five batches, and after it."""
    goes_on, answered = threading.Event(), []

    def hang() -> None:
        os.kill(os.getpid(), signal.SIGTERM)
        answered.append(goes_on.wait(60))

    class Hanging(Workers):
        def __iter__(self) -> Iterator[TensorDictBase]:
            every = super().__iter__()
            yield from itertools.islice(every, batches)
            if where == "batch":
                hang()
            yield from every

        def update_policy_weights_(self, weights: TensorDictBase, worker_ids: list[int] | None = None) -> None:
            if where == "weights" and weights["planning"]:
                hang()
            super().update_policy_weights_(weights, worker_ids)

    monkeypatch.setattr(
        distributed, "start_workers", lambda parts, *, engine, numbers, rows: Hanging(parts, numbers, rows, None, 0)
    )
    run_dir, made = tmp_path / "run", 8 * batches
    with pytest.raises(RunInterrupted, match=f"^stopped at {made} env steps and saved in {re.escape(str(run_dir))}; "):
        launch(config_of(run_dir=str(run_dir), workers=1))
    assert not answered
    goes_on.set()
    assert CheckpointStore(RunDirectory(run_dir).checkpoints).newest_step() == made


def test_workers_that_send_nothing_are_told_of_again_and_again(monkeypatch):
    goes_on, told, waited = threading.Event(), [], []

    def warning(text: str) -> None:
        told.append(text)
        if len(told) == 3:
            waited.append(time.monotonic() - began)
            goes_on.set()

    class Hanging(Workers):
        def __iter__(self) -> Iterator[TensorDictBase]:
            assert goes_on.wait(60)
            yield from super().__iter__()

    for name, seconds in {"_PATIENCE_S": 0.2, "_LOOK_EVERY_S": 0.01}.items():
        monkeypatch.setattr(f"torchrl_etdmpc.training.workers.{name}", seconds)
    monkeypatch.setattr(
        distributed, "start_workers", lambda parts, *, engine, numbers, rows: Hanging(parts, numbers, rows, None, 0)
    )
    learner = learner_of(config_of(workers=1))
    learner.collector.act()
    monkeypatch.setattr(torchrl_logger, "warning", warning)
    began = time.monotonic()
    assert len(learner.collector.finish_step()) == 8
    assert all(
        text.startswith("no worker has sent rows for 0 minutes; if their simulators hang, Ctrl-C") for text in told
    )
    assert waited[0] > 3 * 0.2  # once in every such time
    learner.collector.shutdown()


@pytest.mark.parametrize(
    ("exitcode", "message"),
    [
        (1, r"^worker 1 ended \(exit code 1; its own error stands above\)$"),
        (-9, r"^worker 1 ended \(exit code -9\)$"),
        (None, r"^it has not answered for 0\.1 seconds$"),
    ],
)
def test_a_worker_that_takes_no_weights_is_not_waited_for(monkeypatch, exitcode, message):
    class Hanging:
        procs = [SimpleNamespace(exitcode=None), SimpleNamespace(exitcode=exitcode)]

        def update_policy_weights_(self, weights: TensorDictBase, worker_ids: list[int] | None) -> None:
            goes_on.wait(60)

    goes_on = threading.Event()
    for name, seconds in {"_PATIENCE_S": 0.1, "_LOOK_EVERY_S": 0.01}.items():
        monkeypatch.setattr(f"torchrl_etdmpc.training.workers.{name}", seconds)
    with pytest.raises(RuntimeError, match=message):
        send_weights(Hanging(), TensorDict())
    goes_on.set()


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.parametrize(
    ("fate", "message"),
    [
        (signal.SIGKILL, r"worker \d ended \(exit code -9\)"),
        (signal.SIGSTOP, "a worker failed: it has not answered for 3 seconds"),
    ],
)
def test_a_worker_process_that_is_killed_or_hangs_is_replaced(monkeypatch, fate, message):
    monkeypatch.setattr("torchrl_etdmpc.training.workers._PATIENCE_S", 3)
    learner = learner_of(config_of(total_env_steps=2000))
    before = processes_of(os.getpid())
    explore_and_pretrain(learner)
    os.kill(min(processes_of(os.getpid()) - before), fate)
    with pytest.warns(UserWarning, match=f"{message}; all workers are started anew"):
        while learner.step(updates=True):
            pass
    assert all(learner.step(updates=True) for _ in range(4))
    learner.collector.shutdown()
    assert processes_of(os.getpid()) <= before


@pytest.mark.slow
def test_actors_of_a_ray_cluster_collect_and_the_cluster_ends(tmp_path, monkeypatch, capfd):
    ray = pytest.importorskip("ray")
    line = launch(config_of(run_dir=str(tmp_path / "run"), engine="ray"))
    assert "after 200 env steps" in line and not ray.is_initialized()
    with RunDirectory(tmp_path / "run").train.open() as file:
        rows = list(csv.DictReader(file))
    assert int(rows[-1]["updates"]) == 5 + 160
    assert 0 <= float(rows[-1]["weight_age"]) < 60
    assert "ray" not in capfd.readouterr().err.lower(), "Ray is not silent"
    with pytest.raises(ValueError, match="workers must be at most the 1 CPUs of the Ray cluster, got 3"):
        monkeypatch.setattr(ray, "cluster_resources", lambda: {"CPU": 1.0})
        RayCluster(None, workers=3)
    assert not ray.is_initialized()


def test_workers_plan_as_a_cpu_compiles_wherever_the_learner_is(monkeypatch):
    settings = {"task": "gym/Pendulum-v1", "workers": 2, "compile": "default", "total_env_steps": 20_000}
    config = DistributedConfig.from_dict(preset("cpu").to_dict() | settings)
    agent = build_agent(config, observation_dim=3, action_dim=1)
    agent = dataclasses.replace(agent, compile_mode="reduce-overhead")  # as on a GPU
    agent.planner.compiled_plan = agent.planner.plan
    told = []

    def start(parts, **_):
        told.append(parts.compile_mode)
        raise RuntimeError("no workers are needed here")

    monkeypatch.setattr(distributed, "start_workers", start)
    options = {"replay_buffer": build_replay(config), "exclude_keys": ()}
    collector = distributed.WorkerCollector(config, agent, make_env(config.task), **options)
    with pytest.raises(RuntimeError, match="^the workers cannot be started: no workers are needed here$"):
        collector.act()
    collector.shutdown()
    assert told[0] == "default"
