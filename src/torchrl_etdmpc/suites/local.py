"""The runs of an experiment on this machine: a pool of processes."""

from __future__ import annotations

import os
import subprocess
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch

from torchrl_etdmpc.runs import RunDirectory
from torchrl_etdmpc.suites.attempt import end, note_failure, start
from torchrl_etdmpc.suites.experiment import Run
from torchrl_etdmpc.suites.index import read_progress
from torchrl_etdmpc.training.estimate import decision_flops
from torchrl_etdmpc.training.signals import StopSignals

_POLL_S = 0.2
_LOOK_AGAIN_S = 2.0  # at a run that another process has


@dataclass
class _Place:
    """Room for one run at a time."""

    gpu: int | None = None
    run: Run | None = None
    process: subprocess.Popen[bytes] | None = None


class Retries:
    """How often a run is tried again: without limit while it gets on, ``most`` times without getting on.

    Args:
        most (int): tries after the first one.
    """

    def __init__(self, most: int) -> None:
        self.most = most
        self._tries: dict[str, tuple[int, int]] = {}  # env steps at the last try, tries without getting beyond them

    def again(self, run: Run) -> bool:
        """Whether a run that ended unfinished is to be tried again."""
        steps = read_progress(run).env_steps
        before, tries = self._tries.get(run.name, (0, 0))
        tries = 1 if steps > before else tries + 1
        self._tries[run.name] = (steps, tries)
        return tries <= self.most


def work(run: Run) -> float:
    """What a run costs, in floating-point operations: by it the longest begin first."""
    return sum(decision_flops(run.config)) * run.config.total_decisions


def run_locally(
    runs: Sequence[Run],
    *,
    workers: int | None = None,
    per_gpu: int = 1,
    retries: int = 2,
    say: Callable[[str], None] = lambda line: None,
) -> bool:
    """Trains what is not finished, several runs at a time, until all are or have failed.

    A run that is stopped is gone on with, a run that fails is tried again; one that another process is training is
    waited for. SIGTERM, SIGINT or SIGUSR1 stops all of them: each saves itself.

    Args:
        runs (sequence of Run): the finished ones cost nothing.

    Keyword Args:
        workers (int, optional): processes at a time. Default: ``per_gpu`` for each GPU; without one, a process for
            each core.
        per_gpu (int): processes that share a GPU. Default: ``1``.
        retries (int): tries of a run that fails or is killed without getting further. Default: ``2``.
        say (callable): gets a line on whatever happens. Default: silence.

    Returns:
        bool: ``False`` if a signal stopped it.
    """
    places = _places(runs, workers, per_gpu)
    threads = max((os.cpu_count() or 1) // len(places), 1)
    queue = sorted((run for run in runs if read_progress(run).state != "finished"), key=work, reverse=True)
    patience = dict.fromkeys([run.name for run in queue], 0.0)  # when a run that is elsewhere is looked at again
    tries = Retries(retries)
    with StopSignals() as stop:
        stop.nothing_to_save = False
        while not stop.requested and (queue or any(place.run for place in places)):
            for place in places:
                if place.process is None:
                    _begin_next(place, queue, patience, threads, tries, say)
                elif place.process.poll() is not None:
                    _note_end(place, queue, patience, tries, say)
            time.sleep(_POLL_S)
        if stop.requested:
            _stop(places, say)
    return not stop.requested


def _places(runs: Sequence[Run], workers: int | None, per_gpu: int) -> list[_Place]:
    gpus = torch.cuda.device_count() if any(run.config.device != "cpu" for run in runs) else 0
    count = workers or (gpus * per_gpu if gpus else os.cpu_count() or 1)
    return [_Place(gpu=index % gpus if gpus else None) for index in range(count)]


def _begin_next(
    place: _Place,
    queue: list[Run],
    patience: dict[str, float],
    threads: int,
    tries: Retries,
    say: Callable[[str], None],
) -> None:
    """Starts the first run of the queue that no other process has."""
    for run in list(queue):
        if time.monotonic() < patience[run.name]:
            continue
        directory = RunDirectory(run.path)
        if directory.in_use:
            if not patience[run.name]:
                say(f"{run.name}: another process trains it")
            patience[run.name] = time.monotonic() + _LOOK_AGAIN_S
            continue
        queue.remove(run)
        if read_progress(run).state == "finished":  # by that other process
            continue
        try:
            place.process, place.run = start(run, threads=threads, gpu=place.gpu), run
            say(f"{run.name}: begins" if not directory.holds_a_run else f"{run.name}: goes on")
        except OSError as error:
            say(f"{run.name}: cannot be started: {error.strerror}")
            if tries.again(run):
                queue.append(run)
                patience[run.name] = time.monotonic() + _LOOK_AGAIN_S
        return


def _note_end(
    place: _Place, queue: list[Run], patience: dict[str, float], tries: Retries, say: Callable[[str], None]
) -> None:
    run, process = place.run, place.process
    assert run is not None and process is not None
    place.run = place.process = None
    what = end(run, process.returncode)
    progress = read_progress(run)
    line = {
        "finished": f"{run.name}: finished, return {progress.latest_return:.1f}",
        "failed": f"{run.name}: failed: {progress.error}",
        "stopped": f"{run.name}: was stopped at {progress.env_steps} env steps (exit code {process.returncode})",
        "elsewhere": f"{run.name}: another process trains it",
    }[what]
    if what == "finished":
        say(line)
    elif what == "elsewhere" or tries.again(run):
        say(f"{line}; it is tried again")
        queue.insert(0, run)
        patience[run.name] = time.monotonic() + _LOOK_AGAIN_S * (what == "elsewhere")
    else:
        say(f"{line}; given up")
        if what == "stopped":
            note_failure(
                run, f"stopped {tries.most + 1} times without getting further (exit code {process.returncode})"
            )


def _stop(places: Sequence[_Place], say: Callable[[str], None]) -> None:
    """Asks every run to save itself and leave, and waits for it."""
    running = [place for place in places if place.process is not None]
    say(f"stopping: {len(running)} run{'s' * (len(running) != 1)} save themselves")
    for place in running:
        if place.process is not None and place.process.poll() is None:
            place.process.terminate()
    for place in running:
        if place.process is not None and place.run is not None:
            end(place.run, place.process.wait())
