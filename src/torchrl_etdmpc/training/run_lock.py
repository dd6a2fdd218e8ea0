"""One process per run directory."""

from __future__ import annotations

import os
from pathlib import Path

LOCK = ".lock"


def lock_run(run_dir: Path) -> int | None:
    """Keeps other processes out of the run directory until the descriptor is closed, or the process ends.

    Returns:
        int or None: the descriptor; None where the system or the file system has no locks.

    Raises:
        OSError: another process has the lock, or the directory cannot be written.
    """
    try:
        import fcntl
    except ImportError:  # Windows
        return None
    try:
        descriptor = os.open(run_dir / LOCK, os.O_RDWR | os.O_CREAT, 0o644)
    except OSError as error:
        raise OSError(
            f"run_dir={run_dir} cannot be written ({error.strerror}); choose a directory that you can write to."
        ) from error
    try:
        fcntl.lockf(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)  # unlike flock, not inherited by environments' processes
    except (BlockingIOError, PermissionError) as error:
        os.close(descriptor)
        raise OSError(
            f"run_dir={run_dir} is in use by another process; wait for it or choose another run_dir."
        ) from error
    except OSError:  # a file system without locks
        os.close(descriptor)
        return None
    return descriptor
