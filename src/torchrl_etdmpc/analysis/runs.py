"""What a report knows of run directories: how far they are, how they learn, and their evaluations as seed curves."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd
import yaml

from torchrl_etdmpc.analysis.csv_table import ACTION_REPEAT, check_units, parse_table
from torchrl_etdmpc.envs import get_task
from torchrl_etdmpc.runs import RunDirectory
from torchrl_etdmpc.runs.dotted import flat
from torchrl_etdmpc.runs.files import load_yaml

CHANGED = ("action_repeat", "episode_length")
"""Settings of a task that a run may change, by their names in ``config.yaml``."""
_NO_SETTING_OF_THE_METHOD = (
    *("task", "seed", "run_dir", "resume", "total_env_steps", "eval_every", "eval_episodes", "eval_policy"),
    *("device", "threads", "compile", "logger", "log_every", "checkpoint_every", "checkpoint_minutes"),
    *("checkpoint_keep", "max_faults", "max_skipped", "workers", "engine", "address", "overlap"),
)
_EVAL = RunDirectory("").eval.name
_OF_A_RUN = {_EVAL, RunDirectory("").train.name, RunDirectory("").summary.name}


def find_runs(paths: Iterable[str | os.PathLike[str]]) -> list[Path]:
    """The run directories in or below the paths: those that hold an ``eval.csv``.

    A folder with a ``train.csv`` or a ``summary.json`` but no ``eval.csv`` is among them: reading it says what is
    missing.

    Args:
        paths (iterable of str or Path): run directories, or folders of run directories at any depth.

    Returns:
        list of Path: sorted, each once.

    Raises:
        FileNotFoundError: a path that does not exist, or without a run in or below it.

    >>> import tempfile
    >>> folder = Path(tempfile.mkdtemp())
    >>> (folder / "a" / "seed1").mkdir(parents=True)
    >>> _ = (folder / "a" / "seed1" / "eval.csv").write_text("")
    >>> [run.name for run in find_runs([folder])]
    ['seed1']
    """
    runs: set[Path] = set()
    for path in map(Path, paths):
        if not path.exists():
            raise FileNotFoundError(f"no such run directory: {path}.")
        found = _folders_with(_OF_A_RUN, path)
        if not found:
            raise FileNotFoundError(f"no runs found in {path}; a run directory holds an {_EVAL}.")
        runs |= found
    return sorted(runs)


def _folders_with(names: set[str], path: Path) -> set[Path]:
    """The folders that hold one of the files, each once; links to folders are followed.

    A folder that cannot be opened is among them, and so is a broken link beside a run: reading it says what is wrong.
    """
    found, seen, nowhere = {}, set(), []

    def refused(error: OSError) -> None:
        found[str(error.filename)] = Path(error.filename)

    for folder, folders, files in os.walk(path, followlinks=True, onerror=refused):
        folders.sort(key=lambda inner: (os.path.islink(os.path.join(folder, inner)), inner))  # links come last
        real = os.path.realpath(folder)
        if real in seen:  # a link that leads back
            folders.clear()
            continue
        seen.add(real)
        if not names.isdisjoint(files):
            found[real] = Path(folder)
        nowhere += [Path(folder, file) for file in files if not os.path.exists(os.path.join(folder, file))]
    beside = {run.parent for run in found.values()}
    return set(found.values()).union(link for link in nowhere if link.parent in beside)


@dataclass(frozen=True)
class Run:
    """What a report knows of one run directory.

    Args:
        path (Path): the directory.
        method (str): how figures and tables call it.
        task (str): its task.
        seed (int): its seed.
        finished (bool): whether it reached its budget.
        curve (DataFrame): seed curve, see :func:`read_run`.
        changed (tuple of str): settings of the task that are not its own, e.g. ``episode_length=100``.
        settings (mapping): those that say how it learns, by their dotted names; empty if they are not known.

    >>> Run(Path("runs/a/seed1"), "ours", "walker-walk", 1, True, pd.DataFrame()).method
    'ours'
    """

    path: Path
    method: str
    task: str
    seed: int
    finished: bool
    curve: pd.DataFrame
    changed: tuple[str, ...] = ()
    settings: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def read(cls, run_dir: str | os.PathLike[str], *, method: str | None = None) -> Run:
        """Reads the files of a run; see :func:`read_run`."""
        directory, (file, values) = RunDirectory(run_dir), _read_values(run_dir)
        header, table = _header(file, values), read_evaluations(run_dir)
        told = {name: header[name] for name in CHANGED if header[name] is not None}
        if header["task"] in ACTION_REPEAT:  # what a task has anyway is no change
            own = get_task(header["task"])
            told = {name: value for name, value in told.items() if value != getattr(own, name)}
        check_units(table.assign(task=header["task"]), directory.eval, told.get("action_repeat"))
        names = {"method": method or header["preset"], "task": header["task"], "seed": header["seed"]}
        columns = {name: table[name].astype(float) for name in ("env_steps", "return_mean")}
        curve = pd.DataFrame({**names, **columns})
        changed = tuple(f"{name}={value}" for name, value in told.items())
        known = flat(values) if file == directory.config else {}
        settings = {name: value for name, value in known.items() if name not in _NO_SETTING_OF_THE_METHOD}
        return cls(
            directory.path, **names, finished=directory.finished, curve=curve, changed=changed, settings=settings
        )

    @property
    def last(self) -> float:
        """Env steps of the last evaluation with a return, NaN if there is none."""
        return self.curve.dropna(subset="return_mean")["env_steps"].max()


def read_run(run_dir: str | os.PathLike[str], *, method: str | None = None) -> pd.DataFrame:
    """The seed curve of one run, which may still be running.

    A last line without its line end is still being written and is left out; of rows with the same ``env_steps`` (a run
    that was resumed) the last counts.

    Args:
        run_dir (str or Path): holds ``eval.csv`` and one of ``config.yaml`` and ``summary.json``, which give task,
            preset and seed.
        method (str, optional): how figures and tables call the run. Default: its preset.

    Returns:
        pandas.DataFrame: seed curve. Empty if the run has not evaluated yet.

    Raises:
        FileNotFoundError: a file is missing.
        ValueError: a file is not what it should be, or counts steps in other units.

    >>> import tempfile
    >>> folder = Path(tempfile.mkdtemp())
    >>> _ = (folder / "config.yaml").write_text("{task: walker-walk, preset: cpu, seed: 1}")
    >>> rows = ["env_steps,decision_steps,updates,wall_time_s,return_mean,return_std,episodes", "0,0,0,1,20,1,10", ""]
    >>> _ = (folder / "eval.csv").write_text(os.linesep.join(rows))
    >>> read_run(folder)["return_mean"].tolist()
    [20.0]
    """
    return Run.read(run_dir, method=method).curve


def read_header(run_dir: str | os.PathLike[str]) -> dict[str, Any]:
    """Task, preset and seed of a run, and what it changes of its task: ``CHANGED``, ``None`` for the task's own.

    Raises:
        FileNotFoundError: if it has neither ``config.yaml`` nor ``summary.json``.
        ValueError: if the file does not give them.
    """
    return _header(*_read_values(run_dir))


def _read_values(run_dir: str | os.PathLike[str]) -> tuple[Path, dict[str, Any]]:
    """The file that says what a run is, and what it says."""
    directory = RunDirectory(run_dir)
    files = [file for file in (directory.config, directory.summary) if file.is_file()]
    if not files:
        raise FileNotFoundError(
            f"{directory} has neither {directory.config.name} nor {directory.summary.name}, which name its task and "
            "seed."
        )
    text = files[0].read_text(encoding="utf-8", errors="replace")
    try:
        values = json.loads(text) if files[0] == directory.summary else load_yaml(text)
    except (ValueError, yaml.YAMLError) as error:
        raise ValueError(f"{files[0]} does not give the run's task, preset and seed.") from error
    return files[0], values if isinstance(values, dict) else {}


def _header(file: Path, values: Mapping[str, Any]) -> dict[str, Any]:
    kinds = {"task": str, "preset": str, "seed": int}
    header = {key: values.get(key) for key in kinds}
    if not all(isinstance(header[key], kind) and header[key] != "" for key, kind in kinds.items()):
        raise ValueError(f"{file} does not give the run's task, preset and seed.")
    return header | {name: values[name] if type(values.get(name)) is int else None for name in CHANGED}


def read_evaluations(run_dir: str | os.PathLike[str]) -> pd.DataFrame:
    """The rows of a run's ``eval.csv``, in the order of ``env_steps``; see :func:`read_run`.

    Raises:
        FileNotFoundError: if there is none.
        ValueError: if it is not what it should be.
    """
    file = RunDirectory(run_dir).eval
    if not file.is_file():
        raise FileNotFoundError(f"{run_dir} has no {file.name}, which holds the evaluations of a run.")
    text = file.read_text(encoding="utf-8", errors="replace")
    text = text[: text.rfind("\n") + 1]
    header, *rows = [line for line in text.split("\n") if line.strip()] or [""]
    for row in rows:  # what is left of its last number may look like one
        if row.count(",") < header.count(","):
            raise ValueError(
                f"{file} has a row with fewer cells than its header, {row.strip()!r}; remove what was cut."
            )
    table = parse_table(text, file, ("env_steps", "return_mean"), empty=True)
    return table.drop_duplicates("env_steps", keep="last").sort_values("env_steps", ignore_index=True)


def read_runs(paths: Iterable[str | os.PathLike[str]]) -> pd.DataFrame:
    """The seed curves of all runs in or below the paths.

    Raises:
        FileNotFoundError: no run in one of the paths.
        ValueError: two runs of the same method, task and seed, or a file that cannot be read.

    >>> import tempfile
    >>> folder = Path(tempfile.mkdtemp())
    >>> rows = ["env_steps,decision_steps,updates,wall_time_s,return_mean,return_std,episodes", "0,0,0,1,20,1,10", ""]
    >>> for seed in (1, 2):
    ...     run = folder / f"seed{seed}"
    ...     run.mkdir()
    ...     _ = (run / "config.yaml").write_text(f"{{task: walker-walk, preset: cpu, seed: {seed}}}")
    ...     _ = (run / "eval.csv").write_text(os.linesep.join(rows))
    >>> read_runs([folder])["seed"].tolist()
    [1, 2]
    """
    return join_runs([Run.read(run_dir) for run_dir in find_runs(paths)])


def join_runs(runs: Iterable[Run]) -> pd.DataFrame:
    """The seed curves of runs, at least one.

    Raises:
        ValueError: two runs of the same method, task and seed, or of the same method and task but with other settings
            of the task.

    >>> curve = {"method": "ours", "task": "walker-walk", "seed": 1, "env_steps": [0, 10], "return_mean": 1.0}
    >>> len(join_runs([Run(Path("a"), "ours", "walker-walk", 1, True, pd.DataFrame(curve))]))
    2
    """
    tables, seen, first = [], {}, {}
    for run in runs:
        other = first.setdefault((run.method, run.task), run)
        if run.changed != other.changed:
            kinds = " and ".join(", ".join(one.changed) or "the task's own settings" for one in (other, run))
            raise ValueError(
                f"runs of {run.method} on {run.task} with {kinds}: {other.path} and {run.path}; give one of them a "
                "name of its own."
            )
        key = (run.method, run.task, run.seed)
        if key in seen:
            raise ValueError(
                f"two runs of {key[0]} on {key[1]} with seed {key[2]}: {seen[key]} and {run.path}; leave one out, or "
                "give one of them a name of its own."
            )
        seen[key] = run.path
        tables.append(run.curve)
    return pd.concat(tables, ignore_index=True)


def mixed_settings(runs: Iterable[Run]) -> list[str]:
    """A line for every method whose runs were trained with different settings, which a mean over them would hide.

    Args:
        runs (iterable of Run): what is not known of a run's settings is taken to be as the others have it.

    >>> ours = [Run(Path(name), "ours", "walker-walk", seed, True, pd.DataFrame(), settings={"optim.lr": rate})
    ...         for name, seed, rate in (("a", 1, 1e-3), ("b", 2, 3e-4))]
    >>> mixed_settings(ours)
    ['ours has runs with different settings: optim.lr is 0.001 in a and 0.0003 in b']
    """
    first: dict[str, dict[str, Run]] = {}  # of each method, the first run that knows the setting
    lines: dict[str, str] = {}
    for run in runs:
        others = first.setdefault(run.method, {})
        names = [name for name in others if name in run.settings and run.settings[name] != others[name].settings[name]]
        others |= {name: run for name in run.settings if name not in others}
        if names and run.method not in lines:
            name, more = names[0], f", and {len(names) - 1} more" if len(names) > 1 else ""
            other = others[name]
            lines[run.method] = (
                f"{run.method} has runs with different settings: {name} is {other.settings[name]} in {other.path} and "
                f"{run.settings[name]} in {run.path}{more}"
            )
    return list(lines.values())
