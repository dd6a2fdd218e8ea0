"""One process per run directory."""

from __future__ import annotations

import os
from pathlib import Path

LOCK = ".lock"


def lock_run(run_dir: Path) -> int | None:
    """Keeps other processes out of the run directory until :func:`unlock_run`, or until this process ends.

    Returns:
        int or None: a descriptor for :func:`unlock_run`; None where the system or the file system has no locks.

    Raises:
        OSError: another process has the lock, or the directory cannot be written.
    """
    try:
        import fcntl
    except ImportError:  # Windows
        return None
    while True:
        try:
            descriptor = os.open(run_dir / LOCK, os.O_RDWR | os.O_CREAT, 0o644)
        except OSError as error:
            raise OSError(
                f"run_dir={run_dir} cannot be written ({error.strerror}); choose a directory that you can write to."
            ) from error
        try:  # unlike flock, lockf is not inherited by the environments' processes
            fcntl.lockf(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except (BlockingIOError, PermissionError) as error:
            os.close(descriptor)
            raise OSError(
                f"run_dir={run_dir} is in use by another process; wait for it or choose another run_dir."
            ) from error
        except OSError:  # a file system without locks
            os.close(descriptor)
            return None
        if os.fstat(descriptor).st_nlink:
            return descriptor
        os.close(descriptor)  # its owner has unlocked and removed it since it was opened


def unlock_run(run_dir: Path, descriptor: int) -> None:
    """Lets other processes in, and leaves no file behind."""
    (run_dir / LOCK).unlink(missing_ok=True)
    os.close(descriptor)
