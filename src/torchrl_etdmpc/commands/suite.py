"""``suite``: the runs of an experiment, on this machine or on many, and where they are."""

from __future__ import annotations

import dataclasses
import shlex
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from torchrl_etdmpc.commands.command_line import nearest, one_line_errors
from torchrl_etdmpc.commands.settings_help import help_text, settings_of
from torchrl_etdmpc.runs import console
from torchrl_etdmpc.suites import (
    Experiment,
    Run,
    RunIndex,
    extended,
    find_experiment,
    read_experiment,
    run_locally,
    status_text,
    write_experiment,
)
from torchrl_etdmpc.suites.attempt import command
from torchrl_etdmpc.training import EXIT_CODE, TrainConfig, config_from_dict, follow_own_code

EXPERIMENTS = Path(__file__).parent / "config" / "experiments"
WHAT = """Trains every run of an experiment: tasks x seeds x variants.

  suite experiment=NAME               all runs, each gone on with wherever it is; finished ones cost nothing
  suite status experiment=NAME        where they are, also while they are trained elsewhere
  suite list                          the experiments by name
  suite experiment=NAME preset=cpu tasks=walker-walk,cup-catch seeds=2 total_env_steps=50000

Any setting of train does as well, for all variants."""


@dataclass(frozen=True)
class SuiteConfig:
    """What is to be run, where and how."""

    experiment: str = ""
    """The name of an experiment, or a path to a file like those of `suite list`."""
    engine: Literal["local"] = "local"
    """local: processes on this machine."""
    runs_dir: str | None = None
    """Folder of the experiment's runs. Default: runs/EXPERIMENT."""
    tasks: str | None = None
    """Tasks or sets of tasks, with commas between, instead of the experiment's."""
    seeds: str | None = None
    """How many, or seeds with commas between, instead of the experiment's."""
    variants: str | None = None
    """Some of the experiment's variants, with commas between. Default: all."""
    workers: int | None = None
    """Runs at a time. Default: per_gpu for each GPU, or one for each core of a machine without."""
    per_gpu: int = 1
    """Runs that share a GPU."""
    retries: int = 2
    """How often a run is tried again that fails, or is killed, without having got further."""
    code: str | None = None
    """Paths to code of your own, MODULE:FUNCTION with commas between, that the experiment's settings may name."""
    dry_run: bool = False
    """Whether to print what would be run, and to change nothing."""

    def __post_init__(self) -> None:
        for name, least in (("workers", 1), ("per_gpu", 1), ("retries", 0)):
            number = getattr(self, name)
            if number is not None and number < least:
                raise ValueError(f"{name} must be at least {least}, got {number}.")


@one_line_errors
def main() -> None:
    """The command."""
    words = [word for word in sys.argv[1:] if "=" not in word]
    if {"--help", "-h", "help"} & set(words):
        settings = help_text(SuiteConfig, "", "suite", tuple(settings_of(SuiteConfig)))
        print(f"{WHAT}\n\nsettings and their defaults:\n{settings}")
        return
    if words == ["list"]:
        print(_list())
        return
    if words not in ([], ["status"]):
        raise ValueError(f"unknown word {words[0]!r}; a setting is written name=value, --help lists them.")
    config, settings = _read(sys.argv[1:])
    for path in (config.code or "").split(",") if config.code else []:
        for setting in ("planner.score", "reanalyze.score", "loss.extra_terms"):
            follow_own_code(setting, path)
    asked = _experiment(config, settings)
    folder = Path(config.runs_dir or f"runs/{asked.name}").expanduser().absolute()
    stored = folder / "experiment.yaml"
    whole = extended(read_experiment(stored), asked, folder) if stored.exists() else asked
    index, workers = RunIndex(folder / "index.sqlite"), config.workers or 1
    if words == ["status"]:
        if not stored.exists():
            raise FileNotFoundError(f"runs_dir={folder} holds no experiment; begin it, or name its folder.")
        runs = whole.runs(folder)
        print(status_text(runs, index.read(runs), workers))
        return
    runs = asked.runs(folder)
    if config.dry_run:
        print(_plan(runs))
        return
    folder.mkdir(parents=True, exist_ok=True)
    write_experiment(whole, stored)
    with console():
        ended = run_locally(runs, workers=config.workers, per_gpu=config.per_gpu, retries=config.retries, say=_say)
    progress = index.read(runs)
    print(status_text(runs, progress, workers))
    if not ended:
        print("stopped; the same command goes on.")
        sys.exit(EXIT_CODE)
    if any(entry.state != "finished" for entry in progress):
        sys.exit(1)


def _read(arguments: list[str]) -> tuple[SuiteConfig, dict[str, Any]]:
    """The suite's own settings, and those of training."""
    own, training = settings_of(SuiteConfig), settings_of(TrainConfig)
    values, settings = {}, {}
    for argument in arguments:
        name, equals, text = argument.partition("=")
        if not equals:
            continue
        name = f"task.{name}" if f"task.{name}" in training else name
        if name in own:
            values[name] = text if own[name].is_text or own[name].choices else _value(text)
        elif name in training:
            settings[name] = text if training[name].is_text else _value(text)
        else:
            raise ValueError(f"unknown setting {name}; {nearest(name, [*own, *training])}")
    if not values.get("experiment") and values.get("runs_dir"):
        values["experiment"] = str(Path(values["runs_dir"]).expanduser() / "experiment.yaml")
    if not values.get("experiment"):
        raise ValueError("experiment=... is missing: the name of an experiment; `suite list` lists them.")
    return config_from_dict(SuiteConfig, values), settings


def _value(text: str) -> Any:
    """What a setting's text means.

    >>> _value("1e-3"), _value("3"), _value("true"), _value("null"), _value("mish")
    (0.001, 3, True, None, 'mish')
    """
    words = {"null": None, "true": True, "false": False}
    if text.lower() in words:
        return words[text.lower()]
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            pass
    return text


def _experiment(config: SuiteConfig, settings: dict[str, Any]) -> Experiment:
    changes: dict[str, Any] = {"settings": settings}
    if config.tasks:
        changes["tasks"] = config.tasks.split(",")
    if config.seeds:
        seeds = [_value(seed) for seed in config.seeds.split(",")]
        changes["seeds"] = seeds[0] if len(seeds) == 1 else seeds
    experiment = read_experiment(find_experiment(config.experiment, EXPERIMENTS), **changes)
    if not config.variants:
        return experiment
    chosen = config.variants.split(",")
    for name in chosen:
        if name not in experiment.variants:
            raise ValueError(f"variants must be some of {', '.join(experiment.variants)}, got {name!r}.")
    base = experiment.base if experiment.base in chosen else chosen[0]
    return dataclasses.replace(experiment, variants={name: experiment.variants[name] for name in chosen}, base=base)


def _list() -> str:
    lines = []
    for file in sorted(EXPERIMENTS.glob("*.yaml")):
        experiment = read_experiment(file)
        count = len(experiment.tasks) * len(experiment.seeds) * len(experiment.variants)
        lines.append(f"{file.stem:24} {count:5} runs  {experiment.title}")
    return "\n".join(lines)


def _plan(runs: list[Run]) -> str:
    steps = sum(run.config.total_env_steps for run in runs)
    lines = [shlex.join(command(run)[1:]) for run in runs]
    return "\n".join([*lines, "", f"{len(runs)} runs, {steps:,} env steps"])


def _say(line: str) -> None:
    print(f"{time.strftime('%H:%M:%S')} {line}", flush=True)
