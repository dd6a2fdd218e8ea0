"""``suite``: the runs of an experiment, on this machine or on many, and where they are."""

from __future__ import annotations

import contextlib
import dataclasses
import shlex
import sys
import time
import typing
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from torchrl_etdmpc.commands.command_line import nearest, one_line_errors
from torchrl_etdmpc.commands.settings_help import Setting, help_text, settings_of
from torchrl_etdmpc.envs import import_task
from torchrl_etdmpc.runs import RunDirectory, console
from torchrl_etdmpc.runs.files import file_lock
from torchrl_etdmpc.suites import (
    Experiment,
    Run,
    RunIndex,
    RunQueue,
    Sweep,
    extended,
    find_experiment,
    read_experiment,
    require_unchanged,
    run_locally,
    run_on_ray,
    status_text,
    write_experiment,
    write_slurm_script,
)
from torchrl_etdmpc.suites.attempt import command
from torchrl_etdmpc.training import (
    EXIT_CODE,
    TASK_SETTINGS,
    TrainConfig,
    build_agent,
    build_reanalyze,
    build_replay,
    config_from_dict,
    follow_own_code,
)
from torchrl_etdmpc.training.config import typed_name

EXPERIMENTS = Path(__file__).parent / "config" / "experiments"
_FILE, _LOCK = "experiment.yaml", ".experiment.lock"
WHAT = """Trains every run of an experiment: tasks x seeds x variants.

  suite experiment=NAME               all runs, each gone on with wherever it is; finished ones cost nothing
  suite status experiment=NAME        where they are, also while they are trained elsewhere
  suite list                          the experiments by name
  suite experiment=insertion preset=cpu tasks=walker-walk,cup-catch seeds=2 total_env_steps=50000

Any setting of train does as well, for all variants, but for those of one run: task, seed, run_dir and resume."""


INSTEAD = {
    "task": "write tasks=walker-walk,cup-catch",
    "seed": "write seeds=3 for three of them, or seeds=[7] for this one",
    "run_dir": "write runs_dir=FOLDER",
    "resume": "leave it out, every run goes on from where it is",
}
"""Settings of train that a command line of a suite must not hold, and what to write."""


LEFT_OUT = {
    **dict.fromkeys(("tasks", "seeds", "variants"), "all that the experiment has"),
    "runs_dir": "runs/EXPERIMENT",
}
"""What settings that must not be empty stand for where they are left out."""


OF_ENGINE = {"local": ("per_gpu",), "ray": ("address", "cpus_per_run", "gpus_per_run"), "slurm": ("sbatch",)}
"""Settings that one engine alone has."""


@dataclass(frozen=True)
class SuiteConfig:
    """What is to be run, where and how."""

    experiment: str = ""
    """The name of an experiment, or a path to a file like those of `suite list`."""
    engine: Literal["local", "ray", "slurm"] = "local"
    """local: processes on this machine. ray: tasks of a Ray cluster. slurm: writes an array job to be submitted."""
    runs_dir: str | None = None
    """Folder of the experiment's runs. Default: runs/EXPERIMENT."""
    tasks: str | None = None
    """Tasks or sets of tasks, "walker-walk,cup-catch" or "[walker-walk, cup-catch]", instead of the experiment's."""
    seeds: str | None = None
    """How many, or which ("7,8", and "[7]" where it is one), instead of the experiment's."""
    variants: str | None = None
    """Some of the experiment's variants, with commas between. Default: all."""
    workers: int | None = None
    """Runs at a time. Default: per_gpu for each GPU, or one for each core of a machine without; what a cluster has
    room for."""
    per_gpu: int = 1
    """Runs that share a GPU, with engine=local."""
    address: str | None = None
    """Of a Ray cluster, HOST:PORT or auto. Default: one of this machine alone, which ends with the command."""
    cpus_per_run: float = 1.0
    """Cores that Ray sets aside for a run."""
    gpus_per_run: float | None = None
    """GPUs that Ray sets aside for a run, also a fraction. Default: 1 where the cluster has any."""
    sbatch: str = ""
    """Options of sbatch with engine=slurm, e.g. "--partition=gpu --gres=gpu:1 --time=12:00:00"."""
    retries: int = 2
    """How often a run is tried again that fails, or is killed, without having got further."""
    code: str | None = None
    """Paths to code of your own, MODULE:FUNCTION with commas between, that the experiment's settings may name."""
    dry_run: bool = False
    """Whether to print what would be run, and to change nothing."""

    def __post_init__(self) -> None:
        for name, least in (("workers", 1), ("per_gpu", 1), ("retries", 0), ("cpus_per_run", 0), ("gpus_per_run", 0)):
            number = getattr(self, name)
            if number is not None and number < least:
                raise ValueError(f"{name} must be at least {least}, got {number}.")
        for engine, names in OF_ENGINE.items():
            for name in names if engine != self.engine else ():
                if getattr(self, name) != getattr(SuiteConfig, name):
                    raise ValueError(f"{name} is for engine={engine}; leave it out with engine={self.engine}.")


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
    asked = _experiment(config, settings)
    folder = Path(config.runs_dir or f"runs/{asked.name}").expanduser().absolute()
    if RunDirectory(folder).holds_a_run:
        raise ValueError(f"runs_dir={folder} is the directory of a run; choose a folder for many of them.")
    stored = _stored(folder)
    known = [asked] if stored is None else [stored] if words else [stored, asked]
    _import_own_code(config, settings, known)
    if words == ["status"]:
        if stored is None:
            raise FileNotFoundError(f"runs_dir={folder} holds no experiment; begin it, or name its folder.")
        runs = _named(config, asked, stored.runs(folder))
        if not runs:
            raise ValueError(f"runs_dir={folder} holds no run of these tasks, seeds and variants; leave some out.")
        print(status_text(runs, RunIndex(folder / "index.sqlite").read(runs), config.workers or 1))
        return
    whole = asked if stored is None else extended(stored, asked, folder)
    runs = asked.runs(folder)
    _require_differences(whole, folder)
    _require_parts([*{run.variant: run.config for run in runs}.items(), *asked.proposals(asked.tasks[0])])
    with console():
        require_unchanged(whole.runs(folder))
    if config.dry_run:
        print(_plan(asked, runs))
        return
    if config.engine == "slurm" and asked.searches:
        raise ValueError("engine=slurm cannot search: the next trial depends on those before it; use local or ray.")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with file_lock(folder / _LOCK):
            stored = _stored(folder)  # by now; another command may have added to it
            write_experiment(asked if stored is None else extended(stored, asked, folder), folder / _FILE)
    except OSError as error:
        raise OSError(
            f"runs_dir={folder} cannot be written ({error.strerror}); choose a folder that you can write to."
        ) from error
    if config.engine == "slurm":
        _write_for_slurm(config, asked, runs, folder)
        return
    sys.exit(_carry_out(config, asked, runs, folder))


def _stored(folder: Path) -> Experiment | None:
    """What the folder was begun with, if it was."""
    file = folder / _FILE
    return read_experiment(file) if file.exists() else None


def _require_differences(experiment: Experiment, folder: Path) -> None:
    """No two variants are one run under two names, as a command's settings can make them. A search may."""
    first: dict[tuple[str, str], str] = {}
    for run in experiment.runs(folder):
        if run.seed != experiment.seeds[0] or any(run.variant.startswith(f"{it} trial ") for it in experiment.searches):
            continue
        settings = {**run.config.to_dict(), "preset": None, "run_dir": None}
        twin = first.setdefault((run.task, repr(settings)), run.variant)
        if twin != run.variant:
            raise ValueError(
                f"variants {twin!r} and {run.variant!r} of experiment {experiment.name} have the same settings on "
                f"{run.task}: one run under two names. Settings of the command take the place of each variant's own; "
                f"leave those out, or write variants={run.variant!r} with a runs_dir of its own."
            )


def _require_parts(configs: Iterable[tuple[str, TrainConfig]]) -> None:
    """Makes the parts of each variant once: some settings are checked by them alone."""
    for variant, config in configs:
        try:
            agent = build_agent(dataclasses.replace(config, compile="off"), 3, 1)
            build_reanalyze(config, agent, build_replay(config))
        except ValueError as error:
            raise ValueError(f"variant {variant!r}: {error}") from error


def _named(config: SuiteConfig, asked: Experiment, runs: list[Run]) -> list[Run]:
    """The runs of the tasks, seeds and variants that the command names; a search's name is of all its trials."""
    trials = tuple(f"{search} trial " for search in asked.searches)
    return [
        run
        for run in runs
        if (not config.tasks or run.task in asked.tasks)
        and (not config.seeds or run.seed in asked.seeds)
        and (not config.variants or run.variant in asked.variants or run.variant.startswith(trials))
    ]


def _carry_out(config: SuiteConfig, asked: Experiment, runs: list[Run], folder: Path) -> int:
    """Trains until nothing is left, and says where everything is; the command's exit code."""
    file = folder / _FILE

    def keep(variant: str, settings: dict[str, Any]) -> None:
        with file_lock(folder / _LOCK):
            known = read_experiment(file)
            if variant not in known.variants:
                write_experiment(dataclasses.replace(known, variants={**known.variants, variant: settings}), file)

    def check(run: Run) -> None:
        _require_parts([(run.variant, run.config)])

    sweeps = [Sweep(asked, name, folder, keep, check, _say) for name in asked.searches]
    runs = [*runs, *(run for sweep in sweeps for run in sweep.runs())]
    queue = RunQueue(runs, retries=config.retries, say=_say, trials=sweeps)
    with console():
        if config.engine == "ray":
            ended = run_on_ray(
                queue,
                address=config.address,
                workers=config.workers,
                cpus_per_run=config.cpus_per_run,
                gpus_per_run=config.gpus_per_run,
            )
        else:
            ended = run_locally(queue, workers=config.workers, per_gpu=config.per_gpu)
    progress = RunIndex(folder / "index.sqlite").read(queue.runs)
    with contextlib.suppress(BrokenPipeError):  # the exit code is still read
        print(status_text(queue.runs, progress, config.workers or 1))
        for sweep in sweeps:
            print(sweep.best())
        if not ended:
            print("stopped; the same command goes on.")
    if not ended:
        return EXIT_CODE
    return int(any(entry.state not in ("finished", "pruned") for entry in progress))


def _write_for_slurm(config: SuiteConfig, asked: Experiment, runs: list[Run], folder: Path) -> None:
    progress = RunIndex(folder / "index.sqlite").read(runs)
    left = [run for run, entry in zip(runs, progress, strict=True) if entry.state != "finished"]
    if not left:
        print(f"{asked.name}: all {len(runs)} runs are finished; nothing to do")
        return
    options = {"sbatch": config.sbatch, "workers": config.workers, "retries": config.retries}
    script = write_slurm_script(left, folder, asked.name, **options)
    print(f"{len(left)} runs; submit them: sbatch {shlex.quote(str(script))}")


def _import_own_code(config: SuiteConfig, settings: dict[str, Any], experiments: Iterable[Experiment]) -> None:
    """Follows the paths to code that the command line holds; a file may only repeat them."""
    for name, value in settings.items():
        if isinstance(value, str):
            follow_own_code(name, value)
    for path in (path for path in (*_listed(config.tasks), *_listed(config.code)) if ":" in path):
        told = [{**own, **settings} for one in experiments if path in one.tasks for own in _of_each_variant(one)]
        if told:
            import_task(path, **{name: _of_all(told, name) for name in TASK_SETTINGS})
        else:
            for setting in ("planner.score", "reanalyze.score", "loss.extra_terms"):
                follow_own_code(setting, path)


def _of_each_variant(experiment: Experiment) -> list[dict[str, Any]]:
    proposed = ({**search.settings, **search.points()[0]} for search in experiment.searches.values())
    return [{**experiment.settings, **own} for own in (*experiment.variants.values(), *proposed)]


def _of_all(told: Iterable[dict[str, Any]], name: str) -> Any:
    """A setting of a task for its import: the first one if every variant says its own, which then counts."""
    values = [own.get(typed_name(name)) for own in told]
    return None if None in values else values[0]


def _typed(setting: Setting, text: str, as_it_is: bool) -> Any:
    if text == "null" and type(None) in typing.get_args(setting.hint):  # as --help prints a default that is none
        return None
    return text if as_it_is else _value(text)


def _read(arguments: list[str]) -> tuple[SuiteConfig, dict[str, Any]]:
    """The suite's own settings, and those of training."""
    own = settings_of(SuiteConfig)
    training = {name: setting for name, setting in settings_of(TrainConfig).items() if name not in INSTEAD}
    values, settings = {}, {}
    for argument in arguments:
        name, equals, text = argument.partition("=")
        if not equals:
            continue
        name = typed_name(name)
        if not text and name in LEFT_OUT:  # of an unset variable of the shell
            raise ValueError(f"{name} must not be empty; leave it out for {LEFT_OUT[name]}.")
        if name in own:
            value = _typed(own[name], text, own[name].is_text or bool(own[name].choices))
            values |= {} if value is None else {name: value}  # the default of all that may be null
        elif name in training:
            settings[name] = _typed(training[name], text, training[name].is_text)
        elif name in INSTEAD:
            raise ValueError(f"{name} is not for a suite, which gives it to each run; {INSTEAD[name]}.")
        else:
            raise ValueError(f"unknown setting {name}; {nearest(name, [*own, *training])}")
    if not values.get("experiment") and values.get("runs_dir"):
        file = Path(values["runs_dir"]).expanduser() / _FILE
        if not file.is_file():
            raise FileNotFoundError(f"runs_dir={file.parent} holds no experiment; begin it with experiment=NAME.")
        values["experiment"] = str(file)
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


def _listed(text: str | None) -> list[str]:
    """The entries of a list, in brackets or not, in quotes or not.

    >>> _listed("walker-walk,cup-catch"), _listed("[walker-walk, 'cup-catch']"), _listed(None)
    (['walker-walk', 'cup-catch'], ['walker-walk', 'cup-catch'], [])
    """
    if not text:
        return []
    text = text.strip()
    text = text[1:-1] if text.startswith("[") and text.endswith("]") else text
    entries = [entry.strip() for entry in text.split(",")]
    return [entry[1:-1] if entry[:1] == entry[-1:] and entry[:1] in ("'", '"') else entry for entry in entries]


def _experiment(config: SuiteConfig, settings: dict[str, Any]) -> Experiment:
    changes: dict[str, Any] = {"settings": settings}
    if config.tasks:
        changes["tasks"] = _listed(config.tasks)
    if config.seeds:
        seeds = [_value(seed) for seed in _listed(config.seeds)]
        changes["seeds"] = seeds if "," in config.seeds or config.seeds.startswith("[") else seeds[0]
    experiment = read_experiment(find_experiment(config.experiment, EXPERIMENTS), **changes)
    base = experiment.base or next(iter(experiment.variants), None)  # whichever command comes first
    if not config.variants:
        return dataclasses.replace(experiment, base=base)
    chosen, known = _listed(config.variants), [*experiment.variants, *experiment.searches]
    for name in chosen:
        if name not in known:
            raise ValueError(f"variants must be some of {', '.join(known)}, got {name!r}.")
    return dataclasses.replace(
        experiment,
        variants={name: settings for name, settings in experiment.variants.items() if name in chosen},
        searches={name: search for name, search in experiment.searches.items() if name in chosen},
        base=base if base in chosen else None,  # then it is the folder's, if that has one
    )


def _list() -> str:
    lines = []
    for file in sorted(EXPERIMENTS.glob("*.yaml")):
        experiment = read_experiment(file)
        variants = len(experiment.variants) + sum(search.trials for search in experiment.searches.values())
        count = len(experiment.tasks) * len(experiment.seeds) * variants
        lines.append(f"{file.stem:24} {count:5} runs  {experiment.title}")
    return "\n".join(lines)


def _plan(experiment: Experiment, runs: list[Run]) -> str:
    steps = sum(run.config.total_env_steps for run in runs)
    lines = [shlex.join(["python", *command(run)[1:]]) for run in runs]
    each = len(experiment.tasks) * len(experiment.seeds)
    searches = [
        f"{name}: a search of {search.trials} trials, {each} runs each" for name, search in experiment.searches.items()
    ]
    return "\n".join([*lines, "", f"{len(runs)} runs, {steps:,} env steps", *searches])


def _say(line: str) -> None:
    with contextlib.suppress(OSError):  # whoever read it has gone: the runs are still to be stopped
        print(f"{time.strftime('%H:%M:%S')} {line}", flush=True)
