"""The runs of an experiment on Ray: on a cluster of this machine alone, or on one that is there already."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from typing import Any

from torchrl_etdmpc.runs import first_line, usable_cores
from torchrl_etdmpc.suites.attempt import start
from torchrl_etdmpc.suites.experiment import Run
from torchrl_etdmpc.suites.run_queue import RunQueue
from torchrl_etdmpc.training.ray_cluster import RayCluster
from torchrl_etdmpc.training.signals import StopSignals

_POLL_S = 0.2
_LOST = -9  # of a run whose node or worker is gone, as if it had been killed


def run_on_ray(
    queue: RunQueue,
    *,
    address: str | None = None,
    workers: int | None = None,
    cpus_per_run: float = 1.0,
    gpus_per_run: float | None = None,
) -> bool:
    """Trains what is not finished as Ray tasks, until all are or have failed; the rules are those of ``run_locally``.

    A run whose node or worker process dies is begun again on whichever node has room, and goes on from its directory:
    the folder of the runs must be the same on all nodes, and its file system must have locks. So must be the path of
    the Python environment.

    Args:
        queue (RunQueue): the runs.

    Keyword Args:
        address (str, optional): of a cluster, ``"host:6379"`` or ``"auto"``. Default: one is made of this machine and
            ends with this process.
        workers (int, optional): runs at a time. Default: as many as the cluster has room for.
        cpus_per_run (float): cores that Ray sets aside for a run, and its threads. Default: ``1``.
        gpus_per_run (float, optional): GPUs that Ray sets aside for a run, e.g. ``0.5``. Default: 1 if the cluster has
            any, else 0.

    Returns:
        bool: ``False`` if a signal stopped it.

    Raises:
        ImportError: if Ray is missing.
        OSError: if there is no cluster at the address.
        ValueError: if the address is none, or no node has what a run needs.

    >>> run_on_ray(RunQueue([]), address="head-node")
    Traceback (most recent call last):
        ...
    ValueError: address must be host:port, ray://host:port or auto, got 'head-node'.
    """
    with _cluster(address) as ray, StopSignals() as stop:
        stop.nothing_to_save = False
        has_gpus = ray.cluster_resources().get("GPU", 0) > 0
        gpus = float(has_gpus) if gpus_per_run is None else gpus_per_run
        task = ray.remote(num_cpus=cpus_per_run, num_gpus=gpus, max_retries=0)(_train)
        if not _room(ray, cpus_per_run, gpus):
            raise ValueError(
                f"no node of the cluster has {cpus_per_run:g} CPUs and {gpus:g} GPUs; lower cpus_per_run or "
                "gpus_per_run."
            )
        running: dict[Any, Run] = {}
        told: set[Any] = set()  # a second cancel would break off the run that saves itself
        try:
            while not stop.requested and (queue.left or running):
                room = workers or max(_room(ray, cpus_per_run, gpus), 1)
                while len(running) < room and (run := queue.next()) is not None:
                    queue.say(f"{run.name}: is given to the cluster")
                    running[task.remote(run, max(int(cpus_per_run), 1))] = run
                ended, _ = ray.wait(list(running), timeout=_POLL_S) if running else ([], None)
                for reference in ended:
                    _take_back(ray, reference, running.pop(reference), queue)
                pruned = queue.to_be_stopped()
                _cancel(ray, [reference for reference, run in running.items() if run.name in pruned], told)
                time.sleep(0 if running else _POLL_S)
        finally:
            _stop(ray, running, queue, told)
    return not stop.requested


def _train(run: Run, threads: int) -> int:
    """Trains a run on the node where this is called; gives its exit code. Cancelled, it saves the run and leaves."""
    process = start(run, threads=threads)
    try:
        while process.poll() is None:
            time.sleep(_POLL_S)
    except KeyboardInterrupt:  # of ray.cancel
        process.terminate()
    return process.wait()


def _take_back(ray: Any, reference: Any, run: Run, queue: RunQueue) -> None:
    try:
        queue.ended(run, ray.get(reference))
    except ray.exceptions.RayTaskError as error:
        if isinstance(error.cause, ray.exceptions.TaskCancelledError):  # before it had begun, or as it ended
            queue.ended(run, _LOST)
        else:  # the node cannot write the folder, or lacks the package
            queue.failed_to_begin(run, first_line(error.cause or error))
    except ray.exceptions.RayError:
        queue.ended(run, _LOST)


def _room(ray: Any, cpus: float, gpus: float) -> int:
    """Runs that the nodes have room for, together."""
    total = 0
    for node in ray.nodes():
        if node["Alive"]:
            has = node["Resources"]
            fits = [int(has.get(kind, 0.0) / need + 1e-9) for kind, need in (("CPU", cpus), ("GPU", gpus)) if need > 0]
            total += min(fits, default=usable_cores())
    return total


def _cancel(ray: Any, references: list[Any], told: set[Any]) -> None:
    for reference in references:
        if reference not in told:
            ray.cancel(reference)
    told.update(references)


def _stop(ray: Any, running: dict[Any, Run], queue: RunQueue, told: set[Any]) -> None:
    """Asks every run to save itself and leave, and waits for it."""
    if not running:
        return
    queue.say(f"stopping: {len(running)} run{'s save themselves' if len(running) > 1 else ' saves itself'}")
    _cancel(ray, list(running), told)
    ray.wait(list(running), num_returns=len(running))


@contextlib.contextmanager
def _cluster(address: str | None) -> Iterator[Any]:
    """Ray, connected."""
    with contextlib.closing(RayCluster(address, workers=usable_cores() if address is None else 1)):
        import ray

        yield ray
