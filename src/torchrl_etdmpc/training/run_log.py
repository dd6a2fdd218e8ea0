"""The run directory: what a training run writes while it goes and when it is done.

==================  ==========================================================================
``config.yaml``     the resolved configuration, written before anything else
``train.csv``       one row per call of :meth:`RunLog.log_train`; columns fixed by the first row
``eval.csv``        one row per evaluation, columns :data:`EVAL_COLUMNS`
``curve.png``       evaluation return against environment steps, see :func:`plot_curve`
``summary.json``    written last: a directory that holds it is a finished run
==================  ==========================================================================
"""

from __future__ import annotations

import contextlib
import csv
import json
import math
import os
import warnings
import weakref
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from torchrl import torchrl_logger
from torchrl.record.loggers import Logger

from torchrl_etdmpc.training.atomic_file import replacing
from torchrl_etdmpc.training.curve import plot_curve
from torchrl_etdmpc.training.loggers import LOGGERS, make_logger, require_logger
from torchrl_etdmpc.training.run_lock import lock_run, unlock_run
from torchrl_etdmpc.training.versions import library_versions

__all__ = ["COUNTER_COLUMNS", "EVAL_COLUMNS", "RunLog"]

COUNTER_COLUMNS = ("env_steps", "decision_steps", "updates", "wall_time_s")
EVAL_COLUMNS = (*COUNTER_COLUMNS, "return_mean", "return_std", "episodes")

_RUN_ENTRIES = ("config.yaml", "eval.csv", "train.csv", "summary.json", "checkpoints")


class RunLog:
    """A run directory and, if asked for, a TorchRL logger that receives the same numbers.

    Start one with :meth:`create`. Every row is on disk when the call that wrote it returns, so a
    killed run loses nothing. The TorchRL logger gets the same values under ``train/`` and
    ``eval/``, with environment steps on the x axis.

    Args:
        run_dir: an existing directory.
        total_env_steps: length of the run in environment steps, for the progress messages.
        logger: a TorchRL logger, or None to write files only.

    Examples:
        >>> import tempfile
        >>> run_dir = Path(tempfile.mkdtemp()) / "walker"
        >>> log = RunLog.create(run_dir, config={"task": "walker-walk", "seed": 1}, total_env_steps=2000)
        >>> counters = {"env_steps": 1000, "decision_steps": 500, "updates": 400, "wall_time_s": 9.5}
        >>> log.log_train({"loss_value": 0.25}, **counters)
        >>> log.log_eval(return_mean=31.0, return_std=4.0, episodes=10, **counters)
        >>> log.finish({"task": "walker-walk", "seed": 1, "final_return": 31.0}).name
        'summary.json'
        >>> sorted(path.name for path in run_dir.iterdir())
        ['config.yaml', 'curve.png', 'eval.csv', 'summary.json', 'train.csv']
    """

    def __init__(self, run_dir: str | os.PathLike[str], *, total_env_steps: int, logger: Logger | None = None):
        self.run_dir = Path(run_dir).expanduser()
        self.total_env_steps = total_env_steps
        self._logger = logger
        self._train_columns: tuple[str, ...] | None = None
        self._unwritten: dict[str, list[dict[str, float]]] = {"train": [], "eval": []}
        lock = lock_run(self.run_dir)
        self._unlock = None if lock is None else weakref.finalize(self, unlock_run, self.run_dir, lock)

    @classmethod
    def reopen(
        cls,
        run_dir: str | os.PathLike[str],
        *,
        config: Mapping[str, Any],
        logger: Literal["none", "tensorboard", "wandb"] = "none",
        total_env_steps: int,
    ) -> RunLog:
        """The log of a run that goes on; arguments and errors as for :meth:`create`.

        Rows are appended where the files end, until :meth:`load_state_dict` says where the run goes on from.

        Raises:
            FileNotFoundError: ``run_dir`` holds no run.
        """
        run_dir = Path(run_dir).expanduser()
        if not (run_dir / "config.yaml").is_file():
            raise FileNotFoundError(f"run_dir={run_dir} holds no run to go on with; start it with resume=off.")
        log = cls(run_dir, total_env_steps=total_env_steps)
        text = _to_yaml(config)
        if text != (run_dir / "config.yaml").read_text(encoding="utf-8"):  # e.g. a longer budget
            with replacing(run_dir / "config.yaml") as partial:
                partial.write_text(text, encoding="utf-8")
        log._logger = make_logger(logger, run_dir, config)
        return log

    @classmethod
    def create(
        cls,
        run_dir: str | os.PathLike[str],
        *,
        config: Mapping[str, Any],
        logger: Literal["none", "tensorboard", "wandb"] = "none",
        total_env_steps: int,
    ) -> RunLog:
        """Make a new run directory and write ``config.yaml``; everything is checked before anything is written.

        Args:
            run_dir: the directory, made with its parents; it may exist if it holds no run.
            config: the resolved configuration: nested dicts of numbers, strings, booleans, None and lists.
                ``task``, ``preset`` and ``seed`` at its top level become the title of the curve.
            logger: who receives the numbers besides our CSV files. ``wandb`` is offline where there is no
                API key; the environment variable ``WANDB_MODE`` is obeyed.
            total_env_steps: length of the run in environment steps, at least 1.

        Returns:
            The log of the new run.

        Raises:
            ValueError: unknown ``logger``, ``total_env_steps`` below 1, or a ``config`` that YAML cannot hold.
            ImportError: the extra that ``logger`` needs, or PyYAML, is not installed.
            FileExistsError: ``run_dir`` already holds a run; nothing in it is touched.
            OSError: ``run_dir`` cannot be written.
        """
        if logger not in LOGGERS:
            raise ValueError(f"logger must be one of {', '.join(LOGGERS)}, got {logger!r}; choose one of them.")
        if total_env_steps < 1:
            raise ValueError(f"total_env_steps must be at least 1, got {total_env_steps}; choose a longer run.")
        if logger != "none":
            require_logger(logger)
        text = _to_yaml(config)
        run_dir = Path(run_dir).expanduser()
        if any(os.path.lexists(run_dir / name) for name in _RUN_ENTRIES):
            raise FileExistsError(f"run_dir={run_dir} already holds a run; choose another run_dir or remove it.")
        try:
            run_dir.mkdir(parents=True, exist_ok=True)
            with open(run_dir / "config.yaml", "x", encoding="utf-8") as file:  # "x": two runs cannot both win
                file.write(text)
        except OSError as error:
            raise OSError(
                f"run_dir={run_dir} cannot be written ({error.strerror}); choose a directory that you can write to."
            ) from error
        try:
            backend = make_logger(logger, run_dir, config)
        except BaseException:
            (run_dir / "config.yaml").unlink()  # a run that never began must not block its directory
            raise
        return cls(run_dir, total_env_steps=total_env_steps, logger=backend)

    def log_train(
        self, metrics: Mapping[str, float], *, env_steps: int, decision_steps: int, updates: int, wall_time_s: float
    ) -> None:
        """Append a row to ``train.csv``.

        Args:
            metrics: name -> number or one-element tensor. The first call fixes the names; a name that is
                missing later leaves an empty cell.
            env_steps: environment steps so far, action repeats counted.
            decision_steps: actions chosen so far.
            updates: gradient steps so far.
            wall_time_s: seconds since the run began.

        Raises:
            ValueError: a name that the first row did not have, or that is one of the counters.
            TypeError: a value that is not one number.
        """
        counters = _counters(env_steps, decision_steps, updates, wall_time_s)
        for name in metrics:
            if name in counters:
                raise ValueError(f"metrics must not use the counter name {name!r}; rename that metric.")
            if self._train_columns is not None and name not in self._train_columns:
                raise ValueError(
                    f"metrics must keep to the columns of the first row of train.csv, got the new name {name!r}; "
                    "log it from the first row on, as nan until it is known."
                )
        row = {**counters, **{name: _to_float(name, value) for name, value in metrics.items()}}
        self._train_columns = self._train_columns or tuple(row)
        self._append("train", row, self._train_columns)

    def log_eval(
        self,
        *,
        env_steps: int,
        decision_steps: int,
        updates: int,
        wall_time_s: float,
        return_mean: float,
        return_std: float,
        episodes: int,
    ) -> None:
        """Append a row to ``eval.csv``, whose columns are :data:`EVAL_COLUMNS`.

        Args:
            env_steps: environment steps so far, action repeats counted.
            decision_steps: actions chosen so far.
            updates: gradient steps so far.
            wall_time_s: seconds since the run began.
            return_mean: mean over the episodes of the undiscounted return; may be nan.
            return_std: its standard deviation over the episodes.
            episodes: number of evaluation episodes.

        Raises:
            TypeError: ``return_mean`` or ``return_std`` is not one number.
        """
        row = {
            **_counters(env_steps, decision_steps, updates, wall_time_s),
            "return_mean": _to_float("return_mean", return_mean),
            "return_std": _to_float("return_std", return_std),
            "episodes": int(episodes),
        }
        self._append("eval", row, EVAL_COLUMNS)
        torchrl_logger.info(
            f"env_steps={row['env_steps']} of {self.total_env_steps}: return {row['return_mean']:.1f} "
            f"+- {row['return_std']:.1f} over {row['episodes']} episodes"
        )

    def finish(self, summary: Mapping[str, Any]) -> Path:
        """Write ``curve.png``, then ``summary.json``, and close the logger.

        A curve that cannot be drawn (matplotlib missing, no evaluation) is a warning: the run is done and
        its summary matters more. Numbers that JSON cannot hold (nan, inf) become null.

        Args:
            summary: what the run came to; ``versions`` is added from :func:`library_versions` unless given.

        Returns:
            The path of ``summary.json``.
        """
        try:
            plot_curve(self.run_dir)
        except (ImportError, OSError, ValueError) as error:
            torchrl_logger.warning(f"curve.png was not drawn: {error}")
        path = self.run_dir / "summary.json"
        content = _to_json({**summary, "versions": summary.get("versions", library_versions())})
        with replacing(path) as partial:
            partial.write_text(json.dumps(content, indent=2, allow_nan=False) + "\n", encoding="utf-8")
        self.close()
        return path

    def close(self) -> None:
        """Close the logger; the files need no closing. :meth:`finish` does it, an aborted run may."""
        if self._logger is not None:
            self._logger.shutdown()
            self._logger = None
        if self._unlock is not None:
            self._unlock()

    def start_over(self) -> None:
        """Removes the rows of a run that ended before its first checkpoint."""
        empty = {"sizes": {"train.csv": 0, "eval.csv": 0}, "unwritten": {"train": [], "eval": []}}
        self.load_state_dict(empty)

    def state_dict(self) -> dict[str, Any]:
        """How long the files are: a run that goes on from here forgets what was written later."""
        files = {name: self.run_dir / name for name in ("train.csv", "eval.csv")}
        sizes = {name: file.stat().st_size if file.exists() else 0 for name, file in files.items()}
        return {"sizes": sizes, "unwritten": {split: list(rows) for split, rows in self._unwritten.items()}}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Cuts the files off where they ended when :meth:`state_dict` was called.

        Raises:
            OSError: a file is shorter than it was.
        """
        self._unwritten = {split: list(rows) for split, rows in state_dict["unwritten"].items()}
        for name, size in state_dict["sizes"].items():
            path = self.run_dir / name
            present = path.stat().st_size if path.exists() else 0
            if present < size:
                raise OSError(f"{path} has {present} bytes but the checkpoint saw {size}: rows were removed from it.")
            if size:
                os.truncate(path, size)
            else:
                path.unlink(missing_ok=True)
        if state_dict["sizes"]["train.csv"]:
            with (self.run_dir / "train.csv").open(newline="", encoding="utf-8") as file:
                self._train_columns = tuple(next(csv.reader(file)))

    def _append(self, split: Literal["train", "eval"], row: dict[str, float], columns: tuple[str, ...]) -> None:
        self._unwritten[split].append(row)
        path = self.run_dir / f"{split}.csv"
        size = path.stat().st_size if path.exists() else 0
        try:
            with path.open("a", newline="", encoding="utf-8") as file:
                writer = csv.DictWriter(file, columns, lineterminator="\n")
                if not size:
                    writer.writeheader()
                writer.writerows(self._unwritten[split])
            self._unwritten[split] = []
        except OSError as error:  # a full disk should not end the run
            with contextlib.suppress(OSError):
                os.truncate(path, size)  # no half row
            warnings.warn(
                f"{path} cannot be written ({error.strerror}); its rows are kept and written with the next one.",
                stacklevel=4,
            )
        if self._logger is not None:
            values = {f"{split}/{name}": value for name, value in row.items() if name != "env_steps"}
            self._logger.log_metrics(values, step=row["env_steps"])


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


def _counters(env_steps: int, decision_steps: int, updates: int, wall_time_s: float) -> dict[str, float]:
    values = (int(env_steps), int(decision_steps), int(updates), round(float(wall_time_s), 3))
    return dict(zip(COUNTER_COLUMNS, values, strict=True))


def _to_float(name: str, value: Any) -> float:
    try:
        return float(value)
    except (TypeError, ValueError, RuntimeError) as error:
        raise TypeError(
            f"{name} must be a number or a one-element tensor, got {type(value).__name__}; reduce it, e.g. by its mean."
        ) from error


def _to_json(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _to_json(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_to_json(item) for item in value]
    if hasattr(value, "tolist"):  # a tensor or a numpy number
        return _to_json(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value if value is None or isinstance(value, bool | int | float | str) else str(value)
