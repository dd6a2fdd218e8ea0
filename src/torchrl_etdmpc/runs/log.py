"""The tables of a run: rows on disk at once, and the same numbers to a TorchRL logger."""

from __future__ import annotations

import contextlib
import csv
import io
import json
import math
import os
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from torchrl import torchrl_logger
from torchrl.record.loggers import Logger

from torchrl_etdmpc.runs.directory import RunDirectory
from torchrl_etdmpc.runs.files import write_whole
from torchrl_etdmpc.runs.versions import library_versions

COUNTER_COLUMNS = ("env_steps", "decision_steps", "updates", "wall_time_s")
"""The first columns of ``train.csv`` and ``eval.csv``."""
EVAL_COLUMNS = (*COUNTER_COLUMNS, "return_mean", "return_std", "episodes")
"""The columns that every ``eval.csv`` has."""

Table = Literal["train", "eval"]


class RunLog:
    """Writes ``train.csv``, ``eval.csv`` and ``summary.json`` of a run directory.

    Every row is on disk when the call that wrote it returns, so a killed run loses nothing; rows that a full disk does
    not take are kept and written with the next one. A logger gets the same values under ``train/`` and ``eval/``, with
    environment steps on the x axis.

    Args:
        directory (RunDirectory): it exists when the first row is written.

    Keyword Args:
        total_env_steps (int): length of the run in environment steps, for the progress messages.

    Attributes:
        logger (Logger, optional): of TorchRL; see :func:`~torchrl_etdmpc.runs.make_logger`.

    >>> import tempfile
    >>> directory = RunDirectory(Path(tempfile.mkdtemp()) / "walker")
    >>> directory.begin({"task": "walker-walk", "seed": 1})
    >>> log = RunLog(directory, total_env_steps=2000)
    >>> counters = {"env_steps": 1000, "decision_steps": 500, "updates": 400, "wall_time_s": 9.5}
    >>> log.log_train({"loss_value": 0.25}, **counters)
    >>> log.log_eval({"return_mean": 31.0, "return_std": 4.0, "episodes": 10}, **counters)
    >>> log.finish({"task": "walker-walk", "seed": 1, "final_return": 31.0}).name
    'summary.json'
    """

    def __init__(self, directory: RunDirectory, *, total_env_steps: int) -> None:
        if total_env_steps < 1:
            raise ValueError(f"total_env_steps must be at least 1, got {total_env_steps}; choose a longer run.")
        self.directory = directory
        self.total_env_steps = total_env_steps
        self.logger: Logger | None = None
        self._files: dict[Table, Path] = {"train": directory.train, "eval": directory.eval}
        self._columns: dict[Table, list[str]] = {}
        self._content: dict[Table, bytearray] = {"train": bytearray(), "eval": bytearray()}  # of the whole files
        self._written: dict[Table, int] = {"train": 0, "eval": 0}  # bytes of it that are on disk

    def log_train(
        self, metrics: Mapping[str, Any], *, env_steps: int, decision_steps: int, updates: int, wall_time_s: float
    ) -> None:
        """Appends a row to ``train.csv``.

        Args:
            metrics (mapping): name to number or one-element tensor. The first call fixes the names; a name that is
                missing later leaves an empty cell.

        Keyword Args:
            env_steps (int): environment steps so far, action repeats counted.
            decision_steps (int): actions chosen so far.
            updates (int): gradient steps so far.
            wall_time_s (float): seconds since the run began.

        Raises:
            ValueError: a name that the first row did not have, or that is one of the counters.
            TypeError: a value that is not one number.
        """
        self._append("train", metrics, _counters(env_steps, decision_steps, updates, wall_time_s))

    def log_eval(
        self, results: Mapping[str, Any], *, env_steps: int, decision_steps: int, updates: int, wall_time_s: float
    ) -> None:
        """Appends a row to ``eval.csv``: :data:`EVAL_COLUMNS`, then what else an evaluation measured.

        Args:
            results (mapping): ``return_mean``, mean over the episodes of the undiscounted return; ``return_std``, its
                standard deviation over the episodes; ``episodes``, their number; further numbers by name.

        Keyword Args:
            env_steps (int): as for :meth:`log_train`, as are the others and the errors.
            decision_steps (int): actions chosen so far.
            updates (int): gradient steps so far.
            wall_time_s (float): seconds since the run began.
        """
        counters = _counters(env_steps, decision_steps, updates, wall_time_s)
        self._append("eval", results, counters)
        episodes = results["episodes"]
        torchrl_logger.info(
            f"env_steps={env_steps} of {self.total_env_steps}: return {float(results['return_mean']):.1f} "
            f"+- {float(results['return_std']):.1f} over {episodes} episode{'s' * (episodes != 1)}"
        )

    def finish(self, summary: Mapping[str, Any]) -> Path:
        """Writes rows that are still kept, then ``summary.json``. Numbers that JSON cannot hold (nan, inf) become null.

        Args:
            summary (mapping): what the run came to; ``versions`` is added from :func:`library_versions` unless given.

        Returns:
            Path: ``summary.json``.

        Raises:
            OSError: if something cannot be written; without ``summary.json`` the run is not finished.
        """
        for table in self._files:
            self._write(table)
        content = _to_json({**summary, "versions": summary.get("versions", library_versions())})
        write_whole(self.directory.summary, json.dumps(content, indent=2, allow_nan=False) + "\n")
        self.close()
        return self.directory.summary

    def close(self) -> None:
        """Closes the logger; the files need no closing."""
        logger, self.logger = self.logger, None
        if logger is not None:
            try:
                logger.shutdown()
            except OSError as error:
                self._warn_of_logger(logger, error)

    def state_dict(self) -> dict[str, Any]:
        """What the files hold: a run that goes on from here forgets what was written later, and what was damaged."""
        return {table: content.decode() for table, content in self._content.items()}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Gives the files the content that they had when :meth:`state_dict` was called.

        Raises:
            OSError: if a file cannot be written.
        """
        for table, file in self._files.items():
            content = state_dict[table].encode()
            present = file.read_bytes() if file.exists() else b""
            if not content:
                file.unlink(missing_ok=True)
            elif not content.startswith(present):  # otherwise the next row brings what is missing
                write_whole(file, content)
            self._content[table], self._written[table] = bytearray(content), min(len(present), len(content))
            self._columns.pop(table, None)
            if content:
                self._columns[table] = next(csv.reader([state_dict[table].splitlines()[0]]))

    def _append(self, table: Table, values: Mapping[str, Any], counters: dict[str, float]) -> None:
        file, columns = self._files[table], self._columns.get(table)
        for name in values:
            if name in counters:
                raise ValueError(f"metrics must not use the counter name {name!r}; rename that metric.")
            if columns is not None and name not in columns:
                raise ValueError(
                    f"metrics must keep to the columns of the first row of {file.name}, got the new name {name!r}; "
                    "log it from the first row on, as nan until it is known."
                )
        row = counters | {name: _to_number(name, value) for name, value in values.items()}
        text = io.StringIO()
        writer = csv.DictWriter(text, self._columns.setdefault(table, list(row)), lineterminator="\n")
        if not self._content[table]:
            writer.writeheader()
        writer.writerow(row)
        self._content[table] += text.getvalue().encode()
        try:
            self._write(table)
        except OSError as error:  # a full disk should not end the run
            warnings.warn(
                f"{file} cannot be written ({error.strerror}); its rows are kept and written with the next one.",
                stacklevel=4,
            )
        if self.logger is not None:
            shown = {f"{table}/{name}": value for name, value in row.items() if name != "env_steps"}
            try:
                self.logger.log_metrics(shown, step=int(row["env_steps"]))
            except OSError as error:
                self._warn_of_logger(self.logger, error)

    def _warn_of_logger(self, logger: Logger, error: OSError) -> None:
        warnings.warn(
            f"{type(logger).__name__} failed ({error.strerror or error}) and misses rows, which are in "
            f"{self.directory}/*.csv.",
            stacklevel=5,
        )

    def _write(self, table: Table) -> None:
        file, content, written = self._files[table], self._content[table], self._written[table]
        status = file.stat() if file.exists() else None
        size, names = (status.st_size, status.st_nlink) if status else (0, 1)
        # Somebody has changed it; or it is a file of a copy of the run as well, made by links (cp -al).
        if size != written or (names > 1 and len(content) > written):
            write_whole(file, content)
        elif len(content) > written:
            try:
                with file.open("ab") as opened:
                    opened.write(content[written:])
            except OSError:
                with contextlib.suppress(OSError):
                    os.truncate(file, written)  # no half row
                raise
        self._written[table] = len(content)


def _counters(env_steps: int, decision_steps: int, updates: int, wall_time_s: float) -> dict[str, float]:
    values = (int(env_steps), int(decision_steps), int(updates), round(float(wall_time_s), 3))
    return dict(zip(COUNTER_COLUMNS, values, strict=True))


def _to_number(name: str, value: Any) -> float:
    if isinstance(value, int):
        return value
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
