"""Processes that step environments die, hang or return what is no number; collection goes on with fresh ones."""

from __future__ import annotations

import os
import signal

import pytest
import torch
from tensordict import TensorDictBase
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import SerialEnv, StepCounter

pytest.importorskip("dm_control")

from torchrl_etdmpc import NonFiniteError, SeedPolicy, SimulatorError, StepCollector  # noqa: E402
from torchrl_etdmpc.envs import Task, make_env, register_task  # noqa: E402
from torchrl_etdmpc.envs.worker import start_workers_anew  # noqa: E402


def make_faulty(task: Task, *, device: torch.device | str):
    """A pendulum that writes NaN where it is pushed to the very end."""
    env = make_env("pendulum-swingup", device=device)
    step = env._step

    def faulty(tensordict: TensorDictBase) -> TensorDictBase:
        after = step(tensordict)
        if tensordict["action"] == 1:
            after["observation"] = torch.full_like(after["observation"], float("nan"))
        return after

    env._step = faulty
    return env


def collect(env, policy=None) -> StepCollector:
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(100), batch_size=4)
    policy = SeedPolicy(env.action_spec) if policy is None else policy
    return StepCollector(env, policy, replay_buffer=buffer, total_frames=60)


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(signal, "SIGSTOP"), reason="needs POSIX signals")
@pytest.mark.parametrize(
    ("number", "reason"),
    [(signal.SIGKILL, "Cannot proceed, worker 1 dead"), (signal.SIGSTOP, "Failed to run all workers within the 2 sec")],
)
def test_a_process_that_dies_or_hangs_costs_its_episodes_and_is_replaced(number, reason):
    env = make_env("pendulum-swingup", seed=0, num_envs=2)
    env.BATCHED_PIPE_TIMEOUT = 2
    collector = collect(env.append_transform(StepCounter()))
    for _ in range(3):
        collector.step()
    before = [worker.pid for worker in env._workers]
    os.kill(before[1], number)
    with pytest.raises(SimulatorError, match=f"^the environment failed at decision step 6: {reason}"):
        collector.step()
    assert not {worker.pid for worker in env._workers} & set(before)
    assert collector.replay_buffer[:]["next", "truncated"].flatten().tolist() == [False] * 4 + [True] * 2
    for _ in range(2):
        stepped = collector.step()
    assert stepped["next", "step_count"].flatten().tolist() == [2, 2]
    assert len(set(stepped["collector", "traj_ids"].tolist()) - {0, 1}) == 2
    assert not torch.equal(stepped["observation"][0], stepped["observation"][1])
    collector.shutdown()


def test_new_processes_have_seeds_which_follow_from_the_random_numbers_of_the_run(monkeypatch):
    class Workers:
        is_closed, _owns_workers, _workers, parent_channels = False, True, (), ()

        def start(self) -> None:
            pass

        def set_seed(self, seed: int) -> None:
            seeds.append(seed)

    monkeypatch.setattr("torchrl_etdmpc.envs.worker.ParallelEnv", Workers)
    env, seeds = Workers(), []
    for seed in (5, 5, 6):
        torch.manual_seed(seed)
        start_workers_anew(env)
        env.is_closed = False
    assert seeds[0] == seeds[1] != seeds[2]


def test_what_is_left_of_failed_processes_is_ended_before_others_start(monkeypatch):
    happened = []

    class Process:
        def kill(self) -> None:
            happened.append("kill")

        def join(self) -> None:
            happened.append("join")

    class Closed(Process):
        def kill(self) -> None:
            raise ValueError("process object is closed")

    class Channel:
        def close(self) -> None:
            happened.append("close")

    class Workers:
        is_closed, _owns_workers = False, True
        _workers, parent_channels = (Process(), Closed(), Process()), (Channel(), Channel())

        def start(self) -> None:
            assert self.is_closed  # or TorchRL would not start anything
            happened.append("start")

        def set_seed(self, seed: int) -> None:
            happened.append("seed")

    monkeypatch.setattr("torchrl_etdmpc.envs.worker.ParallelEnv", Workers)
    env = Workers()
    start_workers_anew(env)
    assert happened == ["kill", "join"] * 2 + ["close"] * 2 + ["start", "seed"]
    happened.clear()
    start_workers_anew(env)  # of an environment that is closed, and of one whose processes are another's
    env.is_closed, env._owns_workers = False, False
    start_workers_anew(env)
    assert happened == []


def test_what_is_no_number_names_its_environment():
    task = Task("faulty-pendulum", "mine", action_repeat=2, episode_length=1000, terminates=False)
    register_task(task, make_faulty, replace=True)
    env = make_env(task, seed=0, num_envs=3, parallel=False)

    def push(tensordict: TensorDictBase) -> TensorDictBase:
        return tensordict.set("action", torch.tensor([[0.5], [1.0], [0.5]]))

    collector = collect(env, push)
    with pytest.raises(NonFiniteError, match=r"a non-finite .*observation.* at decision step 0 \(environments \[1\]\)"):
        collector.step()
    assert len(collector.replay_buffer) == 0


def test_an_environment_without_processes_has_none_to_start():
    env = make_env("pendulum-swingup", seed=0, num_envs=2, parallel=False)
    assert isinstance(env, SerialEnv)
    start_workers_anew(env.append_transform(StepCounter()))


def test_processes_that_cannot_start_again_hide_no_failure(monkeypatch):
    asked = []

    def refuse(env):
        asked.append(env)
        raise EOFError

    monkeypatch.setattr("torchrl_etdmpc.collectors.step.start_workers_anew", refuse)
    env = make_env("pendulum-swingup", seed=0)
    collector = collect(env)
    collector.step()

    def fail(tensordict):
        raise RuntimeError("worker 1 dead")

    monkeypatch.setattr(env, "step_and_maybe_reset", fail)
    with pytest.raises(SimulatorError, match="^the environment failed at decision step 1: worker 1 dead"):
        collector.step()
    assert asked == [env]
