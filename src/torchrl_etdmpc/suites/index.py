"""Where every run of an experiment is: read from the run directories, kept in one file so that it costs little."""

from __future__ import annotations

import contextlib
import csv
import json
import math
import os
import sqlite3
from collections.abc import Iterable, Sequence
from dataclasses import astuple, dataclass, fields
from pathlib import Path
from typing import Any, Literal

from torchrl_etdmpc.runs import RunDirectory
from torchrl_etdmpc.suites.attempt import last_verdict, log_file
from torchrl_etdmpc.suites.experiment import Run

State = Literal["finished", "running", "stopped", "waiting", "pruned", "failed"]
_TAIL_BYTES = 8192
_PATIENCE_S = 0.5  # with another process that has the index; all it holds can be read again


@dataclass(frozen=True)
class Progress:
    """How far one run is.

    Args:
        state (str): ``"finished"``; ``"running"``, in whatever process; ``"stopped"`` on its way; ``"waiting"``, not
            begun; ``"pruned"``, ended early by a search; ``"failed"``.
        env_steps (int): made so far.
        latest_return (float): of its last evaluation; NaN before the first one.
        decisions_per_second (float): lately; NaN if not known.
        error (str): the last line of a failed run, or why it was pruned.

    >>> Progress("running", env_steps=20_000).latest_return
    nan
    """

    state: State
    env_steps: int = 0
    latest_return: float = math.nan
    decisions_per_second: float = math.nan
    error: str = ""


def read_progress(run: Run) -> Progress:
    """How far a run is, from its directory alone; a damaged file counts as missing.

    >>> from pathlib import Path
    >>> from torchrl_etdmpc.suites import Experiment
    >>> experiment = Experiment("heads", ("walker-walk",), (1,), {"cpu": {"preset": "cpu"}}, budget=50_000)
    >>> (run,) = experiment.runs(Path("runs/nowhere"))
    >>> read_progress(run).state
    'waiting'
    """
    directory = RunDirectory(run.path)
    # In the reverse of the order in which a run ends (tables, summary, lock), so that one that ends meanwhile is whole.
    in_use, finished = directory.in_use, directory.finished
    evals, rows = last_rows(directory.eval), last_rows(directory.train)
    latest = number_of(evals[-1], "return_mean") if evals else math.nan
    steps = max((whole_of(row, "env_steps") for row in (*evals[-1:], *rows[-1:])), default=0)
    speed = _speed(rows)
    if finished:
        summary = _summary(directory.summary)
        steps = whole_of(summary, "env_steps") or steps
        if steps >= run.config.total_env_steps:
            if "final_return" in summary:  # null: the last evaluation failed, and an earlier one is not it
                latest = number_of(summary, "final_return")
            return Progress("finished", steps, latest, number_of(summary, "decisions_per_second", speed))
    if in_use:
        return Progress("running", steps, latest, speed)
    verdict = last_verdict(run)
    if verdict is not None:
        return Progress(verdict[0], steps, latest, speed, verdict[1])
    return Progress("stopped" if directory.holds_a_run else "waiting", steps, latest, speed)


class RunIndex:
    """What :func:`read_progress` says of many runs; a finished one is read again only if its files changed.

    The file can be removed at any time. Where it cannot be used (a read-only folder, a damaged file), all is read from
    the directories.

    Args:
        file (Path): an SQLite file.

    >>> import tempfile
    >>> from torchrl_etdmpc.suites import Experiment
    >>> folder = Path(tempfile.mkdtemp())
    >>> experiment = Experiment("heads", ("walker-walk",), (1, 2), {"cpu": {"preset": "cpu"}}, budget=50_000)
    >>> [progress.state for progress in RunIndex(folder / "index.sqlite").read(experiment.runs(folder))]
    ['waiting', 'waiting']
    """

    def __init__(self, file: Path) -> None:
        self.file = file

    def read(self, runs: Sequence[Run]) -> list[Progress]:
        """The progress of every run, in their order."""
        known = self._load()
        answers, changed = [], []
        for run in runs:
            stamp = _stamp(run)
            before = known.get(str(run.path))
            # A process that goes on with one that is not finished need not have changed a file yet.
            if before is not None and before[0] == stamp and before[1].state == "finished":
                answers.append(before[1])
                continue
            answers.append(read_progress(run))
            row = (stamp, *astuple(answers[-1]))
            if before is None or repr(row) != repr((before[0], *astuple(before[1]))):  # in which NaN is NaN
                changed.append((str(run.path), run.variant, run.task, run.seed, *row))
        if changed:
            self._store(changed)
        return answers

    def _load(self) -> dict[str, tuple[str, Progress]]:
        try:
            with contextlib.closing(
                sqlite3.connect(f"{self.file.absolute().as_uri()}?mode=ro", uri=True, timeout=_PATIENCE_S)
            ) as database:
                rows = database.execute(f"SELECT path, stamp, {', '.join(_COLUMNS)} FROM runs").fetchall()
            return {path: (stamp, _progress(values)) for path, stamp, *values in rows}
        except (sqlite3.Error, TypeError, ValueError):  # missing, damaged, of another version
            return {}

    def _store(self, rows: Iterable[tuple[Any, ...]]) -> None:
        columns = ("path", "variant", "task", "seed", "stamp", *_COLUMNS)
        for _ in range(2):
            try:
                with contextlib.closing(sqlite3.connect(self.file, timeout=_PATIENCE_S)) as database, database:
                    database.execute(f"CREATE TABLE IF NOT EXISTS runs ({', '.join(columns)}, PRIMARY KEY (path))")
                    marks = ", ".join("?" * len(columns))
                    database.executemany(f"INSERT OR REPLACE INTO runs ({', '.join(columns)}) VALUES ({marks})", rows)
                return
            except sqlite3.OperationalError as error:
                if "has no column" not in str(error):  # the folder is read-only, or somebody else is writing
                    return
            except sqlite3.DatabaseError:
                pass
            with contextlib.suppress(OSError):  # it can be made anew from the directories
                self.file.unlink()


_COLUMNS = tuple(entry.name for entry in fields(Progress))


def _progress(values: Sequence[Any]) -> Progress:
    state, steps, latest, speed, error = values
    return Progress(state, int(steps), _float(latest), _float(speed), str(error))


def _stamp(run: Run) -> str:
    """Changes when a file that :func:`read_progress` reads does, or the budget."""
    directory = RunDirectory(run.path)
    parts: list[str] = [str(run.config.total_env_steps)]
    for file in (directory.summary, directory.eval, directory.train, directory.lock, log_file(run)):
        try:
            status = os.stat(file)
            parts.append(f"{status.st_mtime_ns}:{status.st_size}")
        except OSError:
            parts.append("-")
    return " ".join(parts)


def last_rows(table: Path) -> list[dict[str, str]]:
    """The last whole rows of a table, without reading all of it."""
    try:
        with open(table, "rb") as file:
            header = file.readline(_TAIL_BYTES)
            start = max(file.seek(0, os.SEEK_END) - _TAIL_BYTES, len(header))
            file.seek(start)
            text = file.read(_TAIL_BYTES).decode(errors="replace")
    except OSError:
        return []
    lines = text[: text.rfind("\n") + 1].splitlines()
    if start > len(header):
        lines = lines[1:]  # cut in the middle
    return list(csv.DictReader([header.decode(errors="replace"), *lines]))


def _summary(file: Path) -> dict[str, Any]:
    try:
        values = json.loads(file.read_text())
        return values if isinstance(values, dict) else {}
    except (OSError, ValueError):
        return {}


def _speed(rows: Sequence[dict[str, str]]) -> float:
    """Decisions per second over the last rows of train.csv."""
    if len(rows) < 2:
        return math.nan
    first, last = rows[max(len(rows) - 10, 0)], rows[-1]
    seconds = number_of(last, "wall_time_s") - number_of(first, "wall_time_s")
    decisions = number_of(last, "decision_steps") - number_of(first, "decision_steps")
    return decisions / seconds if seconds > 0 and decisions > 0 else math.nan


def number_of(row: Any, name: str, default: float = math.nan) -> float:
    """A column of a row; the default if it holds no number."""
    return _float(row.get(name), default)


def whole_of(row: Any, name: str) -> int:
    """A column of a row as a whole number; 0 if it holds none."""
    value = number_of(row, name, 0.0)
    return int(value) if math.isfinite(value) else 0


def _float(value: Any, default: float = math.nan) -> float:
    try:
        return float(value)
    except (TypeError, ValueError):
        return default
