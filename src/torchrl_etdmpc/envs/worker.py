"""Processes that step environments: what they do about signals, and when their owner is gone."""

from __future__ import annotations

import contextlib
import math
import multiprocessing
import multiprocessing.connection
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from multiprocessing import resource_tracker
from typing import Any, TextIO

import torch
from torchrl.envs import EnvBase, ParallelEnv

from torchrl_etdmpc.envs.layers import simulator_of
from torchrl_etdmpc.envs.seeding import seed_everything

# How long a worker process may take for a step, in seconds.
_PATIENCE_S = 300
# How often a worker process looks for its owner after a signal to stop, in seconds.
_GRACE_S = 10
# How long a worker that writes waits for an owner that may just be going, and how often, in seconds.
_GOING_S, _WAIT_EVERY_S = 0.05, 1.0
# Signals to stop: of the keyboard, of SLURM and of Kubernetes, and of a terminal that is closed.
STOP_SIGNALS = tuple(
    getattr(signal, name) for name in ("SIGTERM", "SIGINT", "SIGUSR1", "SIGHUP") if hasattr(signal, name)
)


@contextlib.contextmanager
def signals_held_back() -> Iterator[None]:
    """Holds signals to stop back from processes that are started here, until they call :func:`take_signals`.

    Ctrl-C signals all processes of a job, and one that is still importing would answer with a traceback.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    resource_tracker.ensure_running()  # starting it would let SIGINT and SIGTERM through again
    before = signal.pthread_sigmask(signal.SIG_BLOCK, STOP_SIGNALS)  # processes inherit it
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def take_signals(handler: Any) -> None:
    """In a worker: answers signals to stop from now on, also the one that has been held back."""
    for number in STOP_SIGNALS:
        signal.signal(number, handler)
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, STOP_SIGNALS)


def start_workers(env: ParallelEnv) -> None:
    """Starts the processes of an environment; one that is silent for five minutes counts as failed.

    TorchRL waits for 10,000 seconds, unless the environment variable ``BATCHED_PIPE_TIMEOUT`` says otherwise.
    """
    with signals_held_back():
        env.start()
    if "BATCHED_PIPE_TIMEOUT" not in os.environ:
        env.BATCHED_PIPE_TIMEOUT = _PATIENCE_S


def start_workers_anew(env: EnvBase) -> None:
    """After a failure: ends the processes of a :class:`~torchrl.envs.ParallelEnv` and starts new ones.

    One that died, hangs or has answered half a question would fail every later step, too. The new ones get new seeds,
    drawn from PyTorch's generator. Other environments are left as they are.

    Args:
        env (EnvBase): with any transforms around it.
    """
    env = simulator_of(env)
    if not isinstance(env, ParallelEnv) or env.is_closed or not env._owns_workers:
        return
    for process in env._workers:
        with contextlib.suppress(ValueError):  # closed by now
            process.kill()
            process.join()
    for channel in env.parent_channels:
        channel.close()
    env.is_closed = True
    start_workers(env)
    env.set_seed(int(torch.randint(2**31, ())))


def make_in_worker(make: Callable[..., EnvBase], owner: int) -> EnvBase:
    """In a worker process: a signal to stop is left to the ``owner``, who finishes its step, saves and ends the worker.

    Job schedulers signal all processes of a job at once, as Ctrl-C does. TorchRL calls this once in the owner's process
    too.
    """
    process = multiprocessing.parent_process()
    if process is not None and os.getpid() != owner:
        sys.stderr = SilentWithoutOwner(sys.stderr, process.sentinel)
        if hasattr(signal, "SIGALRM"):
            _outlive_signals(process.sentinel)
    env = make(device="cpu")
    env.set_seed = partial(_set_seed, env.set_seed)
    return env


def _set_seed(set_seed: Callable[..., int | None], seed: int | None = None, static_seed: bool = False) -> int | None:
    """Seeds a worker's environment, and what its simulator may draw from besides: the process is the worker's alone."""
    if seed is not None:
        seed_everything(seed)
    return set_seed(seed, static_seed=static_seed)


def _outlive_signals(owner: int) -> None:
    """After a signal to stop, ends this process once its owner is gone; saving may take the owner a while."""

    def look(*_: Any) -> None:
        if multiprocessing.connection.wait([owner], 0):
            os._exit(1)
        signal.alarm(_GRACE_S)

    signal.signal(signal.SIGALRM, look)
    take_signals(lambda *_: signal.alarm(_GRACE_S))


class SilentWithoutOwner:
    """The stderr of a worker. One whose owner was killed finds its pipe broken; it ends without a traceback."""

    def __init__(self, stream: TextIO, owner: int) -> None:
        self._stream, self._owner = stream, owner
        self._waited = -math.inf

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        patience = 0.0
        if time.monotonic() - self._waited > _WAIT_EVERY_S:  # a simulator may write at every step
            self._waited, patience = time.monotonic(), _GOING_S
        if multiprocessing.connection.wait([self._owner], patience):
            os._exit(1)
        return self._stream.write(text)
