"""The runs of an experiment on this machine: a pool of processes."""

from __future__ import annotations

import os
import subprocess
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import torch

from torchrl_etdmpc.runs import RunDirectory, usable_cores
from torchrl_etdmpc.suites.attempt import start
from torchrl_etdmpc.suites.experiment import Run
from torchrl_etdmpc.suites.run_queue import RunQueue
from torchrl_etdmpc.training.signals import StopSignals

_POLL_S = 0.2


@dataclass
class _Place:
    """Room for one run at a time."""

    gpu: str | None = None
    run: Run | None = None
    process: subprocess.Popen[bytes] | None = None
    told: bool = False
    """Whether it was asked to stop."""

    def tell(self) -> None:
        """Asks the process to save itself and leave; asked twice, it would leave at once."""
        if self.process is not None and self.process.poll() is None and not self.told:
            self.process.terminate()
            self.told = True


def run_locally(queue: RunQueue, *, workers: int | None = None, per_gpu: int = 1) -> bool:
    """Trains what is not finished, several runs at a time, until all are or have failed.

    A run that is stopped is gone on with, a run that fails is tried again; one that another process is training is
    waited for. SIGTERM, SIGINT, SIGUSR1 or SIGHUP stops all of them: each saves itself.

    Args:
        queue (RunQueue): the runs.

    Keyword Args:
        workers (int, optional): processes at a time. Default: ``per_gpu`` for each GPU; without one, a process for
            each core.
        per_gpu (int): processes that share a GPU. Default: ``1``.

    Returns:
        bool: ``False`` if a signal stopped it.

    >>> import tempfile
    >>> from pathlib import Path
    >>> from torchrl_etdmpc.runs import RunLog
    >>> from torchrl_etdmpc.suites import Experiment
    >>> experiment = Experiment("heads", ("walker-walk",), (1,), {"cpu": {"preset": "cpu"}}, budget=50_000)
    >>> (run,) = experiment.runs(Path(tempfile.mkdtemp()))
    >>> directory = RunDirectory(run.path)
    >>> directory.begin(run.config.to_dict())
    >>> _ = RunLog(directory, total_env_steps=50_000).finish({"env_steps": 50_000, "decisions_per_second": 30.0})
    >>> directory.close()
    >>> run_locally(RunQueue([run]), workers=2)  # what is finished is not trained again
    True
    """
    gpus = visible_gpus()
    cores = usable_cores()
    count = workers or len(gpus) * per_gpu or cores
    places = [_Place(gpu=gpus[index % len(gpus)] if gpus else None) for index in range(count)]
    threads = max(cores // count, 1)
    with StopSignals() as stop:
        stop.nothing_to_save = False
        stop.at_once = lambda: _tell(places)  # they are in sessions of their own, and would train on
        try:
            while not stop.requested and (queue.left or any(place.run for place in places)):
                for place in places:
                    _look_at(place, queue, threads)
                pruned = queue.to_be_stopped()
                for place in places:
                    if place.run is not None and place.run.name in pruned:
                        place.tell()
                time.sleep(_POLL_S)
        finally:
            _stop([place for place in places if place.process is not None], queue)
    return not stop.requested


def visible_gpus() -> list[str]:
    """The GPUs that this process may use, as ``CUDA_VISIBLE_DEVICES`` calls them."""
    count = torch.cuda.device_count()
    told = [name.strip() for name in os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",") if name.strip()]
    return told[:count] if told else [str(index) for index in range(count)]


def _look_at(place: _Place, queue: RunQueue, threads: int) -> None:
    """Takes a run that ended off its place, and puts the next one there."""
    if place.process is not None and place.run is not None:
        if place.process.poll() is None:
            return
        ended, place.run = place.run, None
        queue.ended(ended, place.process.returncode)
        place.process = None
    run = queue.next()
    if run is None:
        return
    begins = not RunDirectory(run.path).holds_a_run
    try:
        gpu = place.gpu if run.config.device in ("auto", "cuda") else None  # cuda:N counts those of this machine
        place.process, place.run, place.told = start(run, threads=threads, gpu=gpu), run, False
        queue.say(f"{run.name}: {'begins' if begins else 'goes on'}")
    except OSError as error:
        queue.failed_to_begin(run, error.strerror or str(error))


def _stop(places: Sequence[_Place], queue: RunQueue) -> None:
    """Asks every run to save itself and leave, and waits for it."""
    if places:
        queue.say(f"stopping: {len(places)} run{'s save themselves' if len(places) > 1 else ' saves itself'}")
    _tell(places)
    for place in places:
        if place.process is not None:
            place.process.wait()


def _tell(places: Iterable[_Place]) -> None:
    for place in places:
        place.tell()
