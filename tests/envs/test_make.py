from __future__ import annotations

import contextlib
import dataclasses
import importlib.util
import inspect
import io
import multiprocessing
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torchrl.envs import ActionScaling, EnvBase, GymEnv, SerialEnv, StepCounter, TransformedEnv
from torchrl.envs.utils import check_env_specs

pytest.importorskip("dm_control")
pytest.importorskip("gymnasium")

from torchrl_etdmpc.envs import Task, check_env, get_task, make_env, register_task, worker  # noqa: E402
from torchrl_etdmpc.envs.worker import SilentWithoutOwner, make_in_worker, start_workers  # noqa: E402

needs_mujoco = pytest.mark.skipif(importlib.util.find_spec("imageio") is None, reason="needs gymnasium[mujoco]")


def own(task: Task, *, device: torch.device | str) -> EnvBase:
    """A user's maker, which obeys the task and leaves `is_init` and `episode_reward` out."""
    env = GymEnv("Pendulum-v1", frame_skip=task.action_repeat, device=device)
    env = TransformedEnv(env, ActionScaling())
    return env.append_transform(StepCounter(task.decision_steps_per_episode))


def own_walker(task: Task, *, device: torch.device | str) -> EnvBase:
    """A user's maker that makes a task of dm_control."""
    return make_env(get_task("walker-walk", episode_length=task.episode_length), device=device)


register_task(Task("own-pendulum", "mine", episode_length=200, terminates=False), own)
register_task(Task("own-walker", "mine", action_repeat=2, episode_length=1000, terminates=False), own_walker)

TASKS = [
    "pendulum-swingup",
    "quadruped-walk",
    "gym/Pendulum-v1",
    pytest.param("gym/InvertedPendulum-v5", marks=needs_mujoco),
    pytest.param("gym/Hopper-v5", marks=needs_mujoco),
    "own-pendulum",
]
every_suite = pytest.mark.parametrize("name", TASKS)
# Those whose episodes never end early, so that their time limit can be seen.
unending = pytest.mark.parametrize("name", ["pendulum-swingup", "quadruped-walk", "gym/Pendulum-v1", "own-pendulum"])
LENGTH = 7


def play(env: EnvBase, steps: int, seed: int = 0) -> list:
    torch.manual_seed(seed)
    state, rows = env.reset(), []
    for _ in range(steps):
        row, state = env.step_and_maybe_reset(state.set("action", torch.rand(env.action_spec.shape) * 2 - 1))
        rows.append(row.clone())
    return rows


@every_suite
def test_the_environment_keeps_the_contract_and_its_specs(name):
    env = make_env(name, seed=0)
    check_env(env)
    check_env_specs(env)
    assert env.batch_size == ()
    assert env.device == torch.device("cpu")
    kinds = {
        "observation": torch.float32,
        "action": torch.float32,
        ("next", "reward"): torch.float32,
        ("next", "episode_reward"): torch.float32,
        "is_init": torch.bool,
        ("next", "terminated"): torch.bool,
        ("next", "truncated"): torch.bool,
        ("next", "done"): torch.bool,
    }
    for row in play(env, 3):
        assert {key: row[key].dtype for key in kinds} == kinds
        assert {row[key].shape for key in kinds if key not in ("observation", "action")} == {(1,)}
        assert env.observation_spec["observation"].shape == row["observation"].shape
        assert row["next", "observation"].isfinite().all()


@every_suite
def test_the_episode_reward_and_is_init_start_over_with_each_episode(name):
    total, starts, ends = torch.zeros(1), [], []
    for step, row in enumerate(play(make_env(get_task(name, episode_length=LENGTH, action_repeat=1), seed=0), 20)):
        if row["is_init"]:
            total = torch.zeros(1)
            starts.append(step)
        assert not row["next", "is_init"]
        total = total + row["next", "reward"]
        assert torch.equal(row["next", "episode_reward"], total)
        assert row["next", "done"] == (row["next", "terminated"] | row["next", "truncated"])
        if row["next", "done"]:
            ends.append(step)
    assert len(ends) >= 2
    assert starts == [step for step in (0, *(end + 1 for end in ends)) if step < 20]


@unending
@pytest.mark.parametrize(("action_repeat", "decisions"), [(1, 7), (2, 4), (7, 1)])
def test_the_time_limit_truncates_in_env_steps(name, action_repeat, decisions):
    task = get_task(name, episode_length=LENGTH, action_repeat=action_repeat)
    assert task.decision_steps_per_episode == decisions
    rollout = make_env(task, seed=0).rollout(50)
    assert rollout.shape == (decisions,)
    ends = torch.arange(decisions).unsqueeze(-1) == decisions - 1
    assert torch.equal(rollout["next", "truncated"], ends)
    assert torch.equal(rollout["next", "done"], ends)
    assert not rollout["next", "terminated"].any()


@needs_mujoco
def test_an_early_end_terminates_and_does_not_truncate():
    rollout = make_env("gym/InvertedPendulum-v5", seed=0).rollout(1000)
    assert len(rollout) < 100
    assert [rollout["next", flag][-1].item() for flag in ("terminated", "truncated", "done")] == [True, False, True]
    assert not rollout["next", "done"][:-1].any()


@every_suite
def test_a_decision_repeats_its_action_and_sums_the_rewards(name):
    once, twice = (make_env(get_task(name, action_repeat=repeat), seed=3) for repeat in (1, 2))
    state, other = once.reset(), twice.reset()
    assert torch.equal(state["observation"], other["observation"])
    for _ in range(2):
        action = torch.full(once.action_spec.shape, 0.3)
        rewards = []
        for _ in range(2):
            state = once.step(state.set("action", action))
            rewards.append(state["next", "reward"])
            state = once.step_mdp(state)
        other = twice.step(other.set("action", action))
        torch.testing.assert_close(other["next", "reward"], sum(rewards), rtol=1e-6, atol=1e-6)
        other = twice.step_mdp(other)
        assert torch.equal(other["observation"], state["observation"])


@every_suite
def test_a_seed_repeats_the_sequence_of_episodes_and_each_episode_is_another(name):
    def resets(seed):
        env = make_env(name, seed=seed)
        return [env.reset()["observation"] for _ in range(3)]

    first, again, other = resets(1), resets(1), resets(2)
    assert all(torch.equal(one, two) for one, two in zip(first, again, strict=True))
    assert not torch.equal(first[0], first[1])
    assert not torch.equal(first[1], first[2])
    assert not torch.equal(first[0], other[0])


@every_suite
def test_without_a_seed_two_environments_start_differently(name):
    first, second = make_env(name), make_env(name)
    assert not torch.equal(first.reset()["observation"], second.reset()["observation"])


@every_suite
def test_several_environments_have_the_entries_of_one_and_seeds_of_their_own(name):
    env = make_env(name, seed=5, num_envs=2, parallel=False)
    check_env(env)
    assert isinstance(env, SerialEnv)
    rows = play(env, 2)
    assert rows[0].shape == (2,)
    single = make_env(name, seed=5)
    assert set(rows[0].keys(True, True)) == set(play(single, 1)[0].keys(True, True))
    env.set_seed(5)
    start = env.reset()["observation"]
    assert not torch.equal(start[0], start[1])
    single.set_seed(5)
    assert torch.equal(start[0], single.reset()["observation"])


@pytest.mark.parametrize("name", [pytest.param("gym/Pendulum-v1", marks=pytest.mark.slow), "own-walker"])
def test_worker_processes_play_what_this_process_would(name):
    threads = torch.get_num_threads()
    rows = []
    for parallel in (True, False):
        env = make_env(get_task(name, episode_length=LENGTH), seed=5, num_envs=2, parallel=parallel)
        rows.append(play(env, 2 * LENGTH))
        env.close()
    assert torch.get_num_threads() == threads
    for one, other in zip(*rows, strict=True):
        assert (one == other).all()


def test_an_environment_that_lacks_something_is_refused_with_the_tasks_name():
    task = Task("unscaled", "mine", episode_length=200)
    register_task(task, lambda task, *, device: GymEnv("Pendulum-v1", device=device))
    for options in ({}, {"num_envs": 2, "parallel": False}):
        with pytest.raises(ValueError) as error:
            make_env("unscaled", **options)
        assert str(error.value) == (
            "task 'unscaled': this environment cannot be used as it is: action has bounds of -2 and 2 instead of -1 "
            "and 1 (append ActionScaling())."
        )


def test_a_maker_that_makes_no_single_environment_is_refused():
    register_task(Task("a-number", "mine", episode_length=5), lambda task, *, device: 3)
    with pytest.raises(ValueError, match=r"^the maker of task 'a-number' must return a TorchRL environment, got 3\.$"):
        make_env("a-number")
    register_task(
        Task("two-at-once", "mine", episode_length=5),
        lambda task, *, device: SerialEnv(2, lambda: GymEnv("Pendulum-v1")),
    )
    with pytest.raises(ValueError, match=r"^task 'two-at-once' must be a single environment, got batch size \[2\]\.$"):
        make_env("two-at-once")


def test_a_suite_that_nobody_makes_is_refused():
    with pytest.raises(ValueError, match="^nothing makes the suite 'other' of task 'x'; suites are dm_control, gymnas"):
        make_env(Task("x", "other", episode_length=5))


@pytest.mark.parametrize("observation", ["pixels", "dictionary"])
def test_other_observations_than_vectors_are_refused(observation):
    task = dataclasses.replace(get_task("walker-walk"), observation=observation)
    with pytest.raises(ValueError, match=rf"^observation of task 'walker-walk' must be 'vector', got '{observation}'"):
        make_env(task)


@pytest.mark.parametrize("num_envs", [0, -1])
def test_no_environments_at_all_is_refused(num_envs):
    with pytest.raises(ValueError, match=rf"^num_envs must be at least 1, got {num_envs}\.$"):
        make_env("gym/Pendulum-v1", num_envs=num_envs)


def test_a_task_that_is_not_called_by_its_id_is_refused():
    with pytest.raises(ValueError, match="^the task 'mine' of suite 'gymnasium' must be called gym/<id>"):
        make_env(Task("mine", "gymnasium", episode_length=5))


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@every_suite
def test_on_a_gpu_every_entry_is_there(name):
    env = make_env(name, seed=0, device="cuda")
    check_env_specs(env)
    assert all(value.device.type == "cuda" for value in env.rollout(3).values(True, True))


def fatal(task: Task, *, device: torch.device | str) -> EnvBase:
    if multiprocessing.parent_process() is not None:
        os._exit(1)
    return own(task, device=device)


@pytest.mark.slow  # worker processes
def test_a_process_that_ends_before_its_environment_is_made_is_one_line():
    task = Task("fatal-pendulum", "mine", episode_length=200, terminates=False)
    register_task(task, fatal, replace=True)
    with pytest.raises(RuntimeError, match=r"^a process of task .fatal-pendulum. ended before its env"):
        make_env(task, num_envs=2)


@pytest.mark.parametrize(("told", "seconds"), [(None, 300), ("50", 10_000)])
def test_a_silent_process_counts_as_failed_after_five_minutes_unless_torchrl_is_told_a_time(told, seconds, monkeypatch):
    class Workers:
        BATCHED_PIPE_TIMEOUT = 10_000

        def start(self) -> None:
            pass

    monkeypatch.delenv("BATCHED_PIPE_TIMEOUT", raising=False)
    if told is not None:
        monkeypatch.setenv("BATCHED_PIPE_TIMEOUT", told)
    env = Workers()
    start_workers(env)
    assert env.BATCHED_PIPE_TIMEOUT == seconds


def test_a_worker_s_seed_is_that_of_the_generators_that_simulators_share_too():
    env, drawn = make_in_worker(partial(own, get_task("own-pendulum")), os.getpid()), []
    for seed in (3, 3, 4):
        following = env.set_seed(seed)
        drawn.append((np.random.rand(), random.random(), env.reset()["observation"].tolist()))
    assert drawn[0] == drawn[1] != drawn[2]
    assert following == own(get_task("own-pendulum"), device="cpu").set_seed(4)
    assert env.set_seed(5, static_seed=True) == 5


@pytest.mark.parametrize("is_owner", [True, False])
def test_a_process_that_owns_workers_is_none_also_where_another_one_started_it(monkeypatch, is_owner):
    """TorchRL makes an environment in the owner's process, too."""
    looked_for = []
    monkeypatch.setattr(multiprocessing, "parent_process", lambda: SimpleNamespace(sentinel=7))
    monkeypatch.setattr("torchrl_etdmpc.envs.worker._outlive_signals", looked_for.append)
    monkeypatch.setattr(sys, "stderr", sys.stderr)  # comes back
    make_in_worker(partial(own, get_task("own-pendulum")), os.getpid() if is_owner else os.getppid())
    assert looked_for == ([] if is_owner else [7])
    assert isinstance(sys.stderr, SilentWithoutOwner) != is_owner


def test_a_worker_whose_owner_was_killed_ends_without_a_word(monkeypatch):
    class LeftError(BaseException):
        pass

    def leave(code: int) -> None:
        raise LeftError(code)

    monkeypatch.setattr(os, "_exit", leave)
    sentinel, owner = multiprocessing.Pipe(duplex=False)
    text = io.StringIO()
    stderr = SilentWithoutOwner(text, sentinel.fileno())
    assert stderr.write("a warning") == len("a warning")
    stderr.flush()
    owner.close()  # as the system does when the owner's process ends
    with pytest.raises(LeftError):
        print("Traceback", file=stderr)
    assert text.getvalue() == "a warning"


def test_a_worker_that_writes_at_every_step_waits_for_its_owner_once_a_second(monkeypatch):
    waits, clock = [], [7.0]
    monkeypatch.setattr(multiprocessing.connection, "wait", lambda owners, patience: waits.append(patience))
    monkeypatch.setattr(time, "monotonic", lambda: clock[0])
    stderr = SilentWithoutOwner(io.StringIO(), 0)
    for step in range(3):
        print("step", step, file=stderr)
    assert waits == [0.05, *[0.0] * 11]
    clock[0] += 1.5
    stderr.write("a warning")
    assert waits[12:] == [0.05]


@pytest.fixture
def copied(begin_in_copy: Callable[[Callable[[], None]], int]) -> Iterator[Callable[[Callable[[], None]], int]]:
    """Begins a function in a copy of this process, which ends with the test."""
    processes = []

    def run(function: Callable[[], None]) -> int:
        processes.append(begin_in_copy(function))
        return processes[-1]

    yield run
    for process in processes:
        with contextlib.suppress(ChildProcessError):  # it was waited for
            if os.waitpid(process, os.WNOHANG) == (0, 0):
                os.kill(process, signal.SIGKILL)
                os.waitpid(process, 0)


def exit_code(process: int, seconds: float = 30) -> int | None:
    """That of a process of these tests; ``None`` if it is still there after some seconds."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        ended, status = os.waitpid(process, os.WNOHANG)
        if ended:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.01)
    return None


@pytest.mark.skipif(not hasattr(signal, "SIGALRM"), reason="needs POSIX signals")
def test_a_worker_outlives_a_signal_for_as_long_as_its_owner_lives(monkeypatch, copied):
    monkeypatch.setattr(worker, "_GRACE_S", 1)
    sentinel, owner = os.pipe()
    ready, tell = os.pipe()

    def work() -> None:
        os.close(owner)
        worker._outlive_signals(sentinel)
        os.write(tell, b"!")
        while True:
            time.sleep(60)

    process = copied(work)
    os.close(tell)
    assert os.read(ready, 1) == b"!"
    os.kill(process, signal.SIGTERM)
    assert exit_code(process, 2.5) is None
    os.close(owner)  # as the system does when the owner's process ends
    assert exit_code(process) == 1


@pytest.mark.skipif(not hasattr(signal, "pthread_sigmask"), reason="needs POSIX signals")
def test_a_process_that_is_just_starting_answers_a_signal_when_it_is_ready(copied):
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [])
    signalled, signal_sent = os.pipe()
    told, tell = os.pipe()

    def start() -> None:
        os.read(signalled, 1)
        os.write(tell, b"importing ")
        worker.take_signals(lambda number, _: os.write(tell, signal.Signals(number).name.encode()))

    with worker.signals_held_back():
        process = copied(start)
    os.close(tell)
    assert signal.pthread_sigmask(signal.SIG_BLOCK, []) == before
    os.kill(process, signal.SIGINT)
    os.write(signal_sent, b"!")
    assert exit_code(process) == 0
    assert os.read(told, 100) == b"importing SIGINT"


@pytest.mark.skipif(not hasattr(signal, "pthread_sigmask"), reason="needs POSIX signals")
def test_signals_stay_held_back_when_the_first_semaphore_is_made():
    """It starts the process that tracks semaphores, after which Python unblocks SIGINT and SIGTERM."""
    program = (
        "from __future__ import annotations\n"
        "import contextlib, multiprocessing, signal\n"
        "from multiprocessing import resource_tracker\n"
        f"STOP_SIGNALS = {[number.value for number in worker.STOP_SIGNALS]}\n"
        f"{inspect.getsource(worker.signals_held_back)}\n"  # alone: the package's imports take seconds
        "with signals_held_back():\n"
        "    multiprocessing.get_context('spawn').Event()\n"
        "    held = signal.pthread_sigmask(signal.SIG_BLOCK, [])\n"
        "print({signal.SIGINT, signal.SIGTERM, signal.SIGUSR1} <= held, signal.pthread_sigmask(signal.SIG_BLOCK, []))\n"
    )
    process = subprocess.run([sys.executable, "-c", program], text=True, capture_output=True, check=True)
    assert process.stdout.split() == ["True", "set()"]


@pytest.mark.parametrize("name", ["pendulum-swingup", "gym/Pendulum-v1"])
def test_an_environment_plays_whatever_the_default_device_is(name):
    env = make_env(name, seed=0)
    action = torch.zeros(1)
    torch.set_default_device("meta")
    try:
        state = env.reset()
        following = env.step(state.set("action", action))["next"]
    finally:
        torch.set_default_device(None)
    assert {value.device.type for value in following.values(True, True)} == {"cpu"}
    assert following["episode_reward"].item() == following["reward"].item()
