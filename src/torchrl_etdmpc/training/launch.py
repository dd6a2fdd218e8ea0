"""From a command to a run: which directory, new or gone on with, and what may change on the way."""

from __future__ import annotations

import contextlib
import dataclasses
import math
import multiprocessing
import warnings
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from torchrl import torchrl_logger

from torchrl_etdmpc.checkpoints import CheckpointError, CheckpointStore
from torchrl_etdmpc.envs import make_env
from torchrl_etdmpc.envs.seeding import seed_everything
from torchrl_etdmpc.runs import RunDirectory, RunLog, make_logger, require_logger
from torchrl_etdmpc.runs.dotted import flat, nested
from torchrl_etdmpc.training.agent_file import read_agent_file
from torchrl_etdmpc.training.builders import resolve_device
from torchrl_etdmpc.training.config import TrainConfig, typed_name
from torchrl_etdmpc.training.distributed import DistributedConfig, is_distributed
from torchrl_etdmpc.training.estimate import what_it_takes
from torchrl_etdmpc.training.signals import RunInterrupted, StopSignals
from torchrl_etdmpc.training.train import TrainingRun

CHANGEABLE = {
    "resume",
    "run_dir",
    "total_env_steps",
    "device",
    "threads",
    "compile",
    "logger",
    "checkpoint_every",
    "checkpoint_minutes",
    "checkpoint_keep",
    "workers",
    "engine",
    "address",
}
"""Settings that may change when a run goes on."""


@dataclass(frozen=True)
class Launch:
    """What a command comes to.

    Attributes:
        config (TrainConfig): the command's, or the stored one with what the command changes.
        directory (RunDirectory): of the run.
        action (str): ``"begin"`` a new run, also where one ended before its first step; ``"resume"`` from the newest
            checkpoint; ``"nothing"`` to do, it is finished.

    >>> from torchrl_etdmpc.training import preset
    >>> Launch(preset("cpu"), RunDirectory("runs/a"), "begin").action
    'begin'
    """

    config: TrainConfig
    directory: RunDirectory
    action: Literal["begin", "resume", "nothing"]


def plan_launch(config: TrainConfig, explicit: Iterable[str] = ()) -> Launch:
    """Decides what a command does, by what is in its run directory. Changes nothing.

    Args:
        config (TrainConfig): of the command.
        explicit (iterable of str): settings that the command names, e.g. ``planner.horizon``.

    Raises:
        FileExistsError: if the directory holds a run and ``resume`` is off.
        FileNotFoundError: if there is no run to go on with and ``resume`` is on, or a run with results has no
            checkpoint to go on from.
        ValueError: as :func:`resumed_config` does, or if the run has made as many env steps as are asked for.

    >>> import tempfile
    >>> from torchrl_etdmpc.training import preset
    >>> run_dir = Path(tempfile.mkdtemp()) / "run"
    >>> from dataclasses import replace
    >>> plan_launch(replace(preset("cpu"), run_dir=str(run_dir))).action
    'begin'
    """
    directory = _directory(config.to_dict())
    there = _says_its_settings(directory, config.resume)
    if directory.leftover or config.resume == "off" or (config.resume == "auto" and not there):
        directory.require_new()
        return Launch(config, directory, "begin")
    stored = read_run_config(directory, type(config))
    # A directory that was moved or copied is where it is now.
    merged = resumed_config(stored, config, explicit)
    merged = dataclasses.replace(merged, run_dir=config.run_dir, resume=config.resume)
    if directory.finished and merged.total_env_steps <= stored.total_env_steps:
        return Launch(merged, directory, "nothing")
    made = CheckpointStore(directory.checkpoints).newest_step()
    if made is None:  # starting over would remove results
        raise FileNotFoundError(
            f"run_dir={directory} holds results but no checkpoint to go on from; choose another run_dir, or remove "
            "this one to train again."
        )
    if merged.total_env_steps < stored.total_env_steps and merged.total_env_steps <= made:
        raise ValueError(
            f"total_env_steps={merged.total_env_steps} is not above the {made} env steps that the run in {directory} "
            "has made; name more, or leave it out to go on."
        )
    return Launch(merged, directory, "resume")


def launch(config: TrainConfig, explicit: Iterable[str] = ()) -> str:
    """Trains, from an empty directory or from where the run was stopped, to ``summary.json``.

    Sets the number of threads, the precision of matrix products and the random numbers of this process.

    Args:
        config (TrainConfig): of the command.
        explicit (iterable of str): settings that the command names, e.g. ``planner.horizon``.

    Returns:
        str: one line on what came out.

    Raises:
        RunInterrupted: if a signal asked the run to stop; the text says whether it is saved.
        ValueError, OSError, RuntimeError: if something is wrong with the command or its directory. A run that made no
            step leaves nothing behind.

    >>> import tempfile
    >>> from torchrl_etdmpc.training import preset
    >>> short = {"total_env_steps": 20, "episode_length": 10, "replay": {"seed_decisions": 19, "pretrain_updates": 0}}
    >>> more = {"task": "gym/Pendulum-v1", "compile": "off", "eval_episodes": 1, "run_dir": tempfile.mkdtemp()}
    >>> config = TrainConfig.from_dict(preset("cpu").to_dict() | short | more)
    >>> launch(config)
    'gym/Pendulum-v1: return ... after 20 env steps in ... s; curve, tables and checkpoint are in ...'
    >>> RunDirectory(config.run_dir).finished
    True
    """
    plan = plan_launch(config, explicit)
    if plan.action == "nothing":
        return f"{plan.directory} is finished; nothing to do"
    require_logger(plan.config.logger)
    resolve_device(plan.config.device)
    others = set(multiprocessing.active_children())
    with StopSignals() as stop:
        try:
            summary = _train(plan, stop)
        except (SystemExit, Exception):
            # The signal raises SystemExit wherever the program is; a library that it interrupts may make another error
            # of it.
            if not (stop.requested and stop.nothing_to_save):
                raise
            for worker in set(multiprocessing.active_children()) - others:
                worker.kill()  # one that is just starting would complain that its owner has gone
            state = "with nothing to save" if plan.action == "begin" else f"{plan.directory} goes on from where it was"
            raise RunInterrupted(f"stopped before the first step, {state}; start it again.") from None
    last = summary["final_return"]
    outcome = "the last evaluation failed" if math.isnan(last) else f"return {last:.1f}"
    return (
        f"{plan.config.task}: {outcome} after {summary['env_steps']} env steps in "
        f"{summary['wall_time_s']:.0f} s; curve, tables and checkpoint are in {plan.directory}"
    )


def _train(plan: Launch, stop: StopSignals) -> dict[str, Any]:
    config = plan.config
    # Absolute: the code of an environment may change the current directory.
    directory = RunDirectory(plan.directory.path.absolute(), named=str(plan.directory))
    with contextlib.ExitStack() as stack:
        if config.threads is not None:
            stack.callback(torch.set_num_threads, torch.get_num_threads())  # a sweep's next run may leave them open
            torch.set_num_threads(config.threads)
        torch.set_float32_matmul_precision("high")
        seed_everything(config.seed)
        env = make_env(config.task_spec, seed=config.seed, num_envs=config.num_envs)
        stack.callback(env.close, raise_if_closed=False)
        eval_env = make_env(config.task_spec, num_envs=config.eval_episodes, parallel=False)
        stack.callback(eval_env.close, raise_if_closed=False)
        log = RunLog(directory, total_env_steps=config.total_env_steps)
        run = TrainingRun(config, env=env, eval_env=eval_env, log=log, stop=stop)  # may find that settings are wrong
        stack.callback(lambda: run.learner.collector.shutdown(raise_on_error=False))  # it may have begun a Ray cluster
        if plan.action == "begin":
            directory.begin(config.to_dict())
        else:
            directory.go_on()
        stack.callback(directory.close)
        stack.callback(log.close)
        try:
            log.logger = make_logger(config.logger, directory, config.to_dict())
            if plan.action == "resume":
                run.checkpoints.restore()  # before anything of the run is changed: it may not be possible
            directory.summary.unlink(missing_ok=True)  # with a longer budget the run is not finished any more
            directory.write_config(config.to_dict())
            what = f"{config.task} with preset {config.preset}"
            agent = run.learner.agent
            takes = what_it_takes(config, agent.device, run.env_steps, compiled=agent.compile_mode is not None)
            torchrl_logger.info(f"{what}, {config.total_env_steps:,} env steps into {directory}: {takes}")
            return run.run()
        except BaseException:
            if plan.action == "begin" and not run.env_steps:
                directory.abandon()
            raise


def read_run_config(directory: RunDirectory, kind: type[TrainConfig] = TrainConfig) -> TrainConfig:
    """The configuration in a run directory; if that file is damaged, what its newest weights were trained with.

    Args:
        directory (RunDirectory): of the run.
        kind (type): of configuration. Default: :class:`TrainConfig`.

    Raises:
        FileNotFoundError: if there is none.
        ValueError: if it is not a configuration of this version.

    >>> import tempfile
    >>> directory = RunDirectory(Path(tempfile.mkdtemp()) / "run")
    >>> directory.begin(TrainConfig(task="walker-walk", preset="cpu", seed=3).to_dict())
    >>> read_run_config(directory).seed
    3
    >>> directory.close()
    """
    try:
        values = directory.read_config()
    except (ValueError, FileNotFoundError) as error:
        try:
            values = read_agent_file(directory.last_agent)["config"]
        except CheckpointError:
            raise error from None
        lost = isinstance(error, FileNotFoundError)
        why = f"{directory.config} is missing" if lost else str(error).rstrip(".")
        # Commands read it more than once; from one place the warning is shown once.
        warnings.warn(f"{why}; the settings are those of {directory.last_agent}.", stacklevel=1)
    by_workers = is_distributed(values)
    if isinstance(values, Mapping) and by_workers != issubclass(kind, DistributedConfig):
        who, command = ("workers", "distributed") if by_workers else ("one process", "train")
        raise ValueError(f"{directory} is a run of {who}; go on with the command {command}, or start a new run_dir.")
    try:
        return kind.from_dict(values)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{directory.config} cannot be used: {error}") from error


def with_stored_settings(
    values: Mapping[str, Any], explicit: Iterable[str] = (), kind: type[TrainConfig] = TrainConfig
) -> dict[str, Any]:
    """The settings of a command that goes on with a run: what it does not name is the run's, not the preset's.

    A run that was killed before it had anything to go on from is begun again, with its settings but for those that the
    command names, or with the command's if that names a task or a preset.

    Args:
        values (mapping): the command's settings, not checked yet.
        explicit (iterable of str): those that it names.
        kind (type): of configuration. Default: :class:`TrainConfig`.

    Returns:
        dict: ``values``, if no run is to go on.

    Raises:
        ValueError: as :func:`resumed_config` does.

    >>> with_stored_settings({"task": "walker-walk", "preset": "cpu", "seed": 1, "resume": "off"})["preset"]
    'cpu'
    """
    directory, resume = _directory(values), values.get("resume", "off")
    resume = "off" if resume in (False, "false") else str(resume)
    if not _says_its_settings(directory, resume) or resume == "off":
        return dict(values)
    if directory.leftover:  # begun again: as the command says, if that says which run it means
        if {"task", "preset"} & {*explicit}:
            return dict(values)
        told, wanted = flat(read_run_config(directory, kind).to_dict()), flat(values)
        told |= {name: wanted[name] for name in explicit if name in wanted}
        return {**nested(told), "run_dir": values.get("run_dir")}
    stored = resumed_config(read_run_config(directory, kind), values, explicit).to_dict()
    return {**stored, "run_dir": values.get("run_dir")}


def _says_its_settings(directory: RunDirectory, resume: str) -> bool:
    """Whether there is a file that says the settings of the run.

    Raises:
        FileNotFoundError: if a run is to go on and there is none: with other settings it would be another run.
    """
    there = directory.config.exists() or directory.last_agent.exists()
    if directory.holds_a_run and resume != "off" and not there:
        weights = directory.last_agent.relative_to(directory.path)
        raise FileNotFoundError(
            f"run_dir={directory} holds a run whose settings are lost: {directory.config.name} and {weights} are gone. "
            "Put one of them back, choose another run_dir, or remove this one."
        )
    return there


def _directory(values: Mapping[str, Any]) -> RunDirectory:
    task = str(values.get("task")).replace(":", ".")
    default = Path("runs", task, str(values.get("preset")), f"seed{values.get('seed')}")
    return RunDirectory(values.get("run_dir") or default)


def resumed_config(saved: TrainConfig, asked: TrainConfig | Mapping[str, Any], explicit: Iterable[str]) -> TrainConfig:
    """The saved configuration with the settings that may change.

    Args:
        saved (TrainConfig): of the run directory.
        asked (TrainConfig or mapping): of this command.
        explicit (iterable of str): settings that the command names, e.g. ``planner.horizon``; the others are taken
            from the run.

    Raises:
        ValueError: if the command names what is no setting, or a setting with another value than the run's, and it may
            not change.

    >>> from torchrl_etdmpc.training import preset
    >>> resumed_config(preset("cpu"), {"total_env_steps": 100_000}, ["total_env_steps"]).total_env_steps
    100000
    """
    values = flat(saved.to_dict())
    wanted = flat(asked.to_dict() if isinstance(asked, TrainConfig) else asked)
    known = {typed_name(name): name for name in values} | {name: name for name in values}
    for named in explicit:
        if named not in known:
            raise ValueError(f"explicit names {named}, which is no setting; name one, e.g. planner.horizon.")
        name = known[named]
        if name in CHANGEABLE:
            values[name] = wanted[name]
        elif values[name] != wanted.get(name):
            raise ValueError(
                f"{typed_name(name)}={wanted.get(name)} was asked for, but this run was started with "
                f"{typed_name(name)}={values[name]}; leave it out to go on, or start a new run_dir."
            )
    return type(saved).from_dict(nested(values))
