"""The directory of one training run: what its files are called, whether it holds a run, and who may write to it."""

from __future__ import annotations

import contextlib
import csv
import hashlib
import os
import re
import shutil
import stat
import time
import weakref
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torchrl_etdmpc.runs.files import DamagedFileError, load_tensors, load_yaml, read_whole, write_whole

_CONFIG_BYTES = 2**20
_SEAL = "# what this run trains with, as it was written: sha256 "
IN_USE = "is in use by another process"
"""Part of the error where another process has the lock; a suite looks for it at the end of a run's log."""


class RunDirectory:
    """Names every file of a run, and keeps other processes out while one writes.

    Making one touches nothing. :meth:`begin` and :meth:`go_on` lock the directory until :meth:`close`.

    Args:
        path (str or Path): ``~`` is the home directory.

    Keyword Args:
        named (str, optional): what messages call it. Default: ``path``.

    Attributes:
        path (Path): the directory.
        config (Path): ``config.yaml``, the resolved configuration, written before anything else.
        train (Path): ``train.csv``, one row per interval.
        eval (Path): ``eval.csv``, one row per evaluation.
        curve (Path): ``curve.png``.
        summary (Path): ``summary.json``, written last: a directory that holds it is a finished run.
        checkpoints (Path): what the run goes on from.
        last_agent (Path): ``checkpoints/last.pt``, the weights of the newest checkpoint.
        best_agent (Path): ``checkpoints/best.pt``, those with the best evaluation.
        tensorboard (Path): that logger's files.
        wandb_id (Path): by which the run is known there.
        lock (Path): there while a process writes, and after one was killed.

    >>> RunDirectory("runs/walker").eval.name
    'eval.csv'
    """

    def __init__(self, path: str | os.PathLike[str], *, named: str | None = None) -> None:
        self.path = Path(path).expanduser()
        self._named = str(self.path) if named is None else named
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
        self.lock = self.path / ".lock"
        self._unlock: weakref.finalize | None = None
        self._locked = -1  # descriptor of the lock, while there is one
        self._made: list[Path] = []  # folders, the outermost first

    def __str__(self) -> str:
        return self._named

    @property
    def holds_a_run(self) -> bool:
        """Whether any file of a run is there."""
        return any(map(os.path.lexists, (self.config, self.eval, self.train, self.summary, self.checkpoints)))

    @property
    def leftover(self) -> bool:
        """Whether a run began here and ended before its first step, so that nothing is lost if another one begins."""
        try:
            ours = {"task", "preset", "seed"} <= set(self.read_config())
        except (OSError, ValueError, TypeError):
            return False
        # A checkpoint of the same step as the one that is being saved is called .STEP.old for a moment.
        saved = (folder for name in ("[0-9]*", ".*.old") for folder in self.checkpoints.glob(f"resume/{name}"))
        later = any(re.search("[1-9]", folder.name) for folder in saved)
        steps = later or any(map(_has_steps, (self.train, self.eval)))
        agents = self.last_agent, self.best_agent  # without tables, where somebody put them
        return ours and not (os.path.lexists(self.summary) or steps or any(map(_has_learned, agents)))

    @property
    def finished(self) -> bool:
        """Whether the run reached its budget."""
        return self.summary.is_file()

    @property
    def in_use(self) -> bool:
        """Whether a process has locked it; always false without system locks.

        To be asked by other processes only: a system lock of this process's own ends when the file is closed here.
        """
        if self._unlock is not None:
            return True
        try:
            import fcntl

            file = open(self.lock, "rb")
        except (ImportError, OSError):
            return False
        with file:
            try:
                fcntl.lockf(file, fcntl.LOCK_SH | fcntl.LOCK_NB)  # which reading is enough for
            except (BlockingIOError, PermissionError):
                return True
            except OSError:  # a file system without locks
                return False
        return False

    def read_config(self) -> Any:
        """The stored configuration as plain values.

        Raises:
            FileNotFoundError: if there is none.
            ValueError: if it is not YAML.
        """
        import yaml

        if not os.path.lexists(self.config):
            raise FileNotFoundError(f"run_dir={self} holds no run to go on with; start it with resume=off.")
        try:
            text = read_whole(self.config, _CONFIG_BYTES).decode()
            first, _, rest = text.partition("\n")
            if first.startswith(_SEAL) and first != _SEAL + _digest(rest):
                raise ValueError("it is not what the run wrote; settings are changed on the command line")
            return load_yaml(text)
        except (yaml.YAMLError, UnicodeDecodeError, DamagedFileError, ValueError, RecursionError) as error:
            raise ValueError(f"{self.config} is not a configuration: {' '.join(str(error).split())}") from error

    def require_new(self) -> None:
        """Raises FileExistsError if the directory already holds a run that made a step."""
        if self.holds_a_run and not self.leftover:
            raise FileExistsError(
                f"run_dir={self} already holds a run; go on with resume=auto, choose another run_dir or remove it."
            )

    def begin(self, config: Mapping[str, Any]) -> None:
        """Makes the directory of a new run, locks it and writes the configuration; checks come before any change.

        What is left of a run that ended before its first step is removed.

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
        missing = [folder for folder in (self.path, *self.path.parents) if not folder.exists()]
        try:
            self.path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise self._not_writable(error) from error
        self._made = missing[::-1]
        self._lock()
        try:
            self.require_new()  # two processes may have come this far; only one has the lock
            self._remove_files()
            self._write_config(text)
        except BaseException:
            self.close()
            self._remove_folders()
            raise

    def go_on(self) -> None:
        """Locks the directory of a run that goes on; a damaged configuration is for :meth:`write_config` to replace.

        Raises:
            FileNotFoundError: if it holds no run.
            OSError: if it cannot be written, or is in use by another process.
        """
        if not self.holds_a_run:
            raise FileNotFoundError(f"run_dir={self} holds no run to go on with; start it with resume=off.")
        self._lock()

    def write_config(self, config: Mapping[str, Any]) -> None:
        """Stores the configuration if it changed, e.g. to a longer budget.

        Raises:
            ValueError: if YAML cannot hold it.
            OSError: if it cannot be written; the directory is closed.
        """
        text = _to_yaml(config)
        if not self.config.is_file() or text.encode() != self.config.read_bytes():
            self._write_config(text)

    def abandon(self) -> None:
        """Forgets a run that made no step: its files go, and the folders that were made for it."""
        if not self._is_lost():
            self._remove_files()
        self.close()
        self._remove_folders()

    def require_held(self) -> None:
        """Raises OSError if the directory was moved or removed since it was locked, or is another process's now.

        To be asked before something is written into it, which would change the files of a run that began there since.
        """
        if self._is_lost():
            raise OSError(
                f"run_dir={self} was moved or removed while a run trained in it, or its {self.lock.name} was; so the "
                "run ends, and changes nothing of what is there now. Where its files are, it goes on with resume=true."
            )

    def close(self) -> None:
        """Lets other processes in, and leaves no lock behind."""
        if self._unlock is not None:
            self._unlock()
            self._unlock = None

    def _is_lost(self) -> bool:
        if self._unlock is None:
            return False
        try:
            return not os.path.samestat(os.stat(self.lock), os.fstat(self._locked))
        except FileNotFoundError:
            return not self.path.exists()
        except OSError:  # a file system that does not answer now
            return False

    def _remove_files(self) -> None:
        for file in (self.train, self.eval, self.curve, self.wandb_id):
            file.unlink(missing_ok=True)
        for folder in (self.checkpoints, self.tensorboard):
            shutil.rmtree(folder, ignore_errors=True)
        self.config.unlink(missing_ok=True)  # last: without it the rest is not a leftover

    def _remove_partial_files(self) -> None:
        """Of the run's own files; others may be writing theirs, e.g. a film, beside them."""
        for file in (self.config, self.train, self.eval, self.summary, self.curve, self.wandb_id):
            for left in self.path.glob(f".{file.stem}.*.partial{file.suffix}"):
                left.unlink(missing_ok=True)

    def _remove_folders(self) -> None:
        for folder in reversed(self._made):
            with contextlib.suppress(OSError):  # something else is in it now
                folder.rmdir()
        self._made = []

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

    def _require_own_files(self) -> None:
        """Raises OSError if a file of the run is a link or a device: writing it would change something elsewhere."""
        own = [path for path in vars(self).values() if isinstance(path, Path) and path != self.path]
        inside = [
            Path(folder, name)
            for top in (self.checkpoints, self.tensorboard)
            for folder, folders, files in os.walk(top)  # which does not follow links
            for name in (*folders, *files)
        ]
        for path in (*own, *inside):
            if os.path.lexists(path) and stat.S_IFMT(path.lstat().st_mode) not in (stat.S_IFREG, stat.S_IFDIR):
                raise OSError(
                    f"{path} is a link or a special file, through which a run would change something elsewhere; "
                    "put the file itself there, or choose another run_dir."
                )

    def _lock(self) -> None:
        """Keeps other processes out until :meth:`close`, or until this process ends; nothing without system locks."""
        self._require_own_files()
        try:
            import fcntl
        except ImportError:  # Windows
            return
        patience = time.monotonic() + 0.2
        while self._unlock is None:
            try:
                descriptor = os.open(self.lock, os.O_RDWR | os.O_CREAT, 0o644)
            except OSError as error:
                raise self._not_writable(error) from error
            try:  # unlike flock, lockf is not inherited by the environments' processes
                fcntl.lockf(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except (BlockingIOError, PermissionError) as error:
                os.close(descriptor)
                if time.monotonic() < patience:  # somebody may just be asking whether it is in use
                    time.sleep(0.05)
                    continue
                raise OSError(f"run_dir={self} {IN_USE}; wait for it or choose another run_dir.") from error
            except OSError:  # a file system without locks
                os.close(descriptor)
                return
            if os.fstat(descriptor).st_nlink:
                self._unlock = weakref.finalize(self, _unlock, self.lock, descriptor)
                self._locked = descriptor
                self._remove_partial_files()
            else:  # its owner has unlocked and removed it since it was opened
                os.close(descriptor)


def _unlock(lock: Path, descriptor: int) -> None:
    with contextlib.suppress(OSError):
        if os.path.samestat(os.stat(lock), os.fstat(descriptor)):  # otherwise it is another process's
            lock.unlink()
    os.close(descriptor)


def _has_steps(table: Path) -> bool:
    """Whether a table holds a row of a later moment than the start, or something else than rows."""
    if not os.path.lexists(table):
        return False
    try:
        rows = list(csv.DictReader(read_whole(table).decode().splitlines()))
        return any(int(row["env_steps"]) > 0 for row in rows)
    except (DamagedFileError, ValueError, KeyError, TypeError, csv.Error):
        return True


def _has_learned(agent: Path) -> bool:
    """Whether an agent file is of a later moment than the start; one that cannot be read holds nothing to lose."""
    if not os.path.lexists(agent):
        return False
    try:
        return load_tensors(read_whole(agent), agent)["counters"]["env_steps"] > 0
    except (DamagedFileError, KeyError, TypeError):
        return False


def _to_yaml(config: Mapping[str, Any]) -> str:
    try:
        import yaml
    except ImportError as error:
        raise ImportError("config.yaml needs PyYAML, which is not installed; run `pip install pyyaml`.") from error
    try:
        text = yaml.safe_dump(dict(config), sort_keys=False)
    except yaml.YAMLError as error:
        raise ValueError(
            f"config must hold plain dicts, lists, numbers and strings, got {error.args[-1]!r}; convert it first."
        ) from error
    return f"{_SEAL}{_digest(text)}\n{text}"


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()
