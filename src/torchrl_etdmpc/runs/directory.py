"""The directory of one training run: what its files are called, whether it holds a run, and who may write to it."""

from __future__ import annotations

import os
import weakref
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torchrl_etdmpc.runs.files import write_whole

_LOCK = ".lock"


class RunDirectory:
    """Names every file of a run, and keeps other processes out while one writes.

    Making one touches nothing. :meth:`begin` and :meth:`go_on` lock the directory until :meth:`close`.

    Args:
        path (str or Path): ``~`` is the home directory.

    Attributes:
        path (Path): the directory.
        config (Path): ``config.yaml``, the resolved configuration, written before anything else.
        train (Path): ``train.csv``, one row per interval.
        eval (Path): ``eval.csv``, one row per evaluation.
        curve (Path): ``curve.png``.
        summary (Path): ``summary.json``, written last: a directory that holds it is a finished run.
        checkpoints (Path): what the run goes on from.
        last_agent (Path): ``checkpoints/last.pt``, the weights of the newest checkpoint.
        best_agent (Path): ``checkpoints/best.pt``, those of the checkpoint with the best evaluation before it.
        tensorboard (Path): that logger's files.
        wandb_id (Path): by which the run is known there.

    >>> RunDirectory("runs/walker").eval.name
    'eval.csv'
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path).expanduser()
        self.config = self.path / "config.yaml"
        self.train = self.path / "train.csv"
        self.eval = self.path / "eval.csv"
        self.curve = self.path / "curve.png"
        self.summary = self.path / "summary.json"
        self.checkpoints = self.path / "checkpoints"
        self.last_agent = self.checkpoints / "last.pt"
        self.best_agent = self.checkpoints / "best.pt"
        self.tensorboard = self.path / "tensorboard"
        self.wandb_id = self.path / "wandb_id"
        self._unlock: weakref.finalize | None = None

    def __str__(self) -> str:
        return str(self.path)

    @property
    def holds_a_run(self) -> bool:
        """Whether any file of a run is there."""
        return any(map(os.path.lexists, (self.config, self.eval, self.train, self.summary, self.checkpoints)))

    @property
    def finished(self) -> bool:
        """Whether the run reached its budget."""
        return self.summary.is_file()

    def read_config(self) -> Any:
        """The stored configuration as plain values.

        Raises:
            FileNotFoundError: if there is none.
            ValueError: if it is not YAML.
        """
        import yaml

        if not self.config.is_file():
            raise FileNotFoundError(f"run_dir={self} holds no run to go on with; start it with resume=off.")
        try:
            return yaml.safe_load(self.config.read_text(encoding="utf-8"))
        except (yaml.YAMLError, UnicodeDecodeError) as error:
            raise ValueError(f"{self.config} is not a configuration: {' '.join(str(error).split())}") from error

    def require_new(self) -> None:
        """Raises FileExistsError if the directory already holds a run."""
        if self.holds_a_run:
            raise FileExistsError(f"run_dir={self} already holds a run; choose another run_dir or remove it.")

    def begin(self, config: Mapping[str, Any]) -> None:
        """Makes the directory of a new run, locks it and writes the configuration; checks come before any change.

        Args:
            config (mapping): nested dicts of numbers, strings, booleans, None and lists; ``task``, ``preset`` and
                ``seed`` at its top level name the run in reports.

        Raises:
            ValueError: if YAML cannot hold ``config``.
            ImportError: if PyYAML is missing.
            FileExistsError: if the directory already holds a run; nothing in it is touched.
            OSError: if it cannot be written, or is in use by another process.
        """
        text = _to_yaml(config)
        self.require_new()
        try:
            self.path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise self._not_writable(error) from error
        self._lock()
        try:
            self.require_new()  # two processes may have come this far; only one has the lock
        except FileExistsError:
            self.close()
            raise
        self._write_config(text)

    def go_on(self) -> None:
        """Locks the directory of a run that goes on.

        Raises:
            FileNotFoundError: if it holds no run.
            OSError: if it cannot be written, or is in use by another process.
        """
        self.read_config()
        self._lock()

    def write_config(self, config: Mapping[str, Any]) -> None:
        """Stores the configuration if it changed, e.g. to a longer budget.

        Raises:
            ValueError: if YAML cannot hold it.
            OSError: if it cannot be written; the directory is closed.
        """
        text = _to_yaml(config)
        if not self.config.is_file() or text != self.config.read_text(encoding="utf-8"):
            self._write_config(text)

    def abandon(self) -> None:
        """Forgets a run that never began, so that its directory is free again."""
        self.config.unlink(missing_ok=True)
        self.close()

    def close(self) -> None:
        """Lets other processes in, and leaves no lock behind."""
        if self._unlock is not None:
            self._unlock()
            self._unlock = None

    def _write_config(self, text: str) -> None:
        try:
            write_whole(self.config, text)
        except OSError as error:
            self.close()
            raise self._not_writable(error) from error

    def _not_writable(self, error: OSError) -> OSError:
        return OSError(
            f"run_dir={self} cannot be written ({error.strerror}); choose a directory that you can write to."
        )

    def _lock(self) -> None:
        """Keeps other processes out until :meth:`close`, or until this process ends; nothing without system locks."""
        try:
            import fcntl
        except ImportError:  # Windows
            return
        while self._unlock is None:
            try:
                descriptor = os.open(self.path / _LOCK, os.O_RDWR | os.O_CREAT, 0o644)
            except OSError as error:
                raise self._not_writable(error) from error
            try:  # unlike flock, lockf is not inherited by the environments' processes
                fcntl.lockf(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except (BlockingIOError, PermissionError) as error:
                os.close(descriptor)
                raise OSError(
                    f"run_dir={self} is in use by another process; wait for it or choose another run_dir."
                ) from error
            except OSError:  # a file system without locks
                os.close(descriptor)
                return
            if os.fstat(descriptor).st_nlink:
                self._unlock = weakref.finalize(self, _unlock, self.path / _LOCK, descriptor)
            else:  # its owner has unlocked and removed it since it was opened
                os.close(descriptor)


def _unlock(lock: Path, descriptor: int) -> None:
    lock.unlink(missing_ok=True)
    os.close(descriptor)


def _to_yaml(config: Mapping[str, Any]) -> str:
    try:
        import yaml
    except ImportError as error:
        raise ImportError("config.yaml needs PyYAML, which is not installed; run `pip install pyyaml`.") from error
    try:
        return yaml.safe_dump(dict(config), sort_keys=False)
    except yaml.YAMLError as error:
        raise ValueError(
            f"config must hold plain dicts, lists, numbers and strings, got {error.args[-1]!r}; convert it first."
        ) from error
