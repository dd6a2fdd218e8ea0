"""A connection to a Ray cluster, without a word on the terminal."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import socket
import tempfile
import threading
import warnings
from collections.abc import Iterator
from typing import Any

from torchrl_etdmpc.envs.worker import STOP_SIGNALS
from torchrl_etdmpc.runs import first_line

_OBJECT_STORE_BYTES = 128 * 2**20  # batches of rows pass through it, and nothing else
_REACH_S = 10.0


@contextlib.contextmanager
def _same_signals() -> Iterator[None]:
    """Leaves the handlers of signals as they were."""
    before = {number: signal.getsignal(number) for number in STOP_SIGNALS}
    try:
        yield
    finally:
        if threading.current_thread() is threading.main_thread():
            for number, handler in before.items():
                signal.signal(number, handler)


class RayCluster:
    """A connection to a Ray cluster: one of its own on this machine, or the one at an address.

    Args:
        address (str, optional): ``host:port``, ``ray://host:port`` or ``auto``; ``None`` is a cluster of this machine
            that lives as long as the connection.

    Keyword Args:
        workers (int): CPUs that are needed.

    Raises:
        ImportError: if Ray is missing.
        OSError: if nothing answers at the address, or a cluster of this machine cannot be started.
        ValueError: if the address has another form, or the cluster has fewer CPUs than workers.
    """

    def __init__(self, address: str | None, *, workers: int) -> None:
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # nothing is sent anywhere
        try:
            import ray
        except ImportError as error:
            raise ImportError("engine=ray needs Ray, which is missing; run: pip install 'ray>=2.60,<3'") from error
        self._folder: str | None = None
        options: dict[str, Any] = {"log_to_driver": False, "logging_level": "error"}
        if address is None:
            self._folder = tempfile.mkdtemp(prefix="ray")  # sockets lie in it, whose names must be short
            options |= {"num_cpus": workers, "object_store_memory": _OBJECT_STORE_BYTES, "_temp_dir": self._folder}
            options["include_dashboard"] = False
        else:
            _require_reachable(address)
            options["address"] = address
        try:
            with _same_signals(), warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of what later versions will do
                ray.init(**options)
        except Exception as error:
            self.close()
            reason = first_line(error).rstrip(".")
            if address is None:
                raise OSError(f"a local Ray cluster cannot be started ({reason}); take another engine.") from error
            raise OSError(
                f"address={address} is no cluster ({reason}); leave address out for one of this machine, or take "
                "another engine."
            ) from error
        there = int(ray.cluster_resources().get("CPU", 0))
        if there < workers:
            self.close()
            raise ValueError(f"workers must be at most the {there} CPUs of the Ray cluster, got {workers}.")

    def close(self) -> None:
        """Ends the connection, and the cluster if it is ours."""
        import ray

        with _same_signals():
            ray.shutdown()
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)


def _require_reachable(address: str) -> None:
    """Ray itself would try for a minute, and say so in many lines."""
    host, colon, port = address.removeprefix("ray://").rpartition(":")
    if address == "auto":
        return
    if not (host and colon and port.isdigit()):
        raise ValueError(f"address must be host:port, ray://host:port or auto, got {address!r}.")
    try:
        socket.create_connection((host.strip("[]"), int(port)), timeout=_REACH_S).close()
    except (OSError, OverflowError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise OSError(
            f"address={address} cannot be reached ({reason}); start Ray there (ray start --head), or leave address out "
            "for a cluster on this machine."
        ) from error
