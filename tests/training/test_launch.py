from __future__ import annotations

import dataclasses
import importlib
import importlib.util
import multiprocessing
import os
import signal
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import ActionScaling, Compose, EnvBase, GymEnv, StepCounter, TransformedEnv

from torchrl_etdmpc.checkpoints import CheckpointError, CheckpointStore
from torchrl_etdmpc.collectors import StepCollector
from torchrl_etdmpc.envs import Task, register_task
from torchrl_etdmpc.runs import RunDirectory, RunLog
from torchrl_etdmpc.runs.dotted import flat
from torchrl_etdmpc.training import (
    Evaluator,
    RunInterrupted,
    TrainConfig,
    TrainingRun,
    build_agent,
    launch,
    plan_launch,
    preset,
    read_run_config,
    resumed_config,
    save_agent,
    with_stored_settings,
)

EPISODE = 20  # decisions


@pytest.fixture
def command(tmp_path, tiny_config) -> Callable[..., TrainConfig]:
    """The configuration of a command, in a directory that is not there yet."""

    def make(**changes: Any) -> TrainConfig:
        given = {"run_dir": str(tmp_path / "runs" / "run"), "episode_length": 2 * EPISODE, "eval_every": 100}
        return tiny_config(**(given | changes))

    return make


def begin(config: TrainConfig) -> RunDirectory:
    directory = RunDirectory(config.run_dir)
    directory.begin(config.to_dict())
    directory.close()
    return directory


def save(directory: RunDirectory, step: int = 80) -> None:
    CheckpointStore(directory.checkpoints).save(step, {}, TensorDictReplayBuffer(storage=LazyTensorStorage(10)))


def finish(directory: RunDirectory, config: TrainConfig) -> None:
    RunLog(directory, total_env_steps=config.total_env_steps).finish({"env_steps": config.total_env_steps})


def plan(config: TrainConfig, *explicit: str) -> tuple[str, TrainConfig]:
    """Action and configuration of a plan, which changed nothing."""
    run_dir = Path(config.run_dir)
    before = {path: path.stat().st_mtime_ns for path in (run_dir.parent, *run_dir.rglob("*")) if path.exists()}
    try:
        found = plan_launch(config, explicit)
    finally:
        assert {path: path.stat().st_mtime_ns for path in before} == before
        assert len(list(run_dir.rglob("*"))) == len([path for path in before if path != run_dir.parent])
    assert found.directory.path == run_dir
    return found.action, found.config


@pytest.mark.parametrize("resume", ["off", "auto"])
def test_where_there_is_nothing_a_new_run_begins(command, resume):
    config = command(resume=resume)
    assert plan(config) == ("begin", config)


def test_going_on_where_there_is_nothing_is_refused(command):
    with pytest.raises(FileNotFoundError, match=r"^run_dir=.*run holds no run to go on with; start it with resume=off"):
        plan(command(resume="on"))


@pytest.mark.parametrize("state", ["saved", "finished"])
def test_a_run_that_is_there_is_never_written_over(command, state):
    directory = begin(command())
    save(directory)
    if state == "finished":
        finish(directory, command())
    with pytest.raises(FileExistsError, match=r"^run_dir=.* already holds a run; go on with resume=auto, "):
        plan(command(resume="off"))


@pytest.mark.parametrize("file", ["train", "eval", "summary"])
@pytest.mark.parametrize("resume", ["off", "auto"])
def test_tables_without_a_configuration_are_not_written_over_either(command, resume, file):
    path = getattr(RunDirectory(command().run_dir), file)
    path.parent.mkdir(parents=True)
    path.write_text("1\n")
    error = (FileExistsError, "already holds a run") if resume == "off" else (FileNotFoundError, "settings are lost")
    with pytest.raises(error[0], match=error[1]):
        plan(command(resume=resume))


@pytest.mark.parametrize("resume", ["off", "on", "auto"])
@pytest.mark.parametrize("saved", [False, True])
def test_a_run_that_made_no_step_is_begun_again_as_the_command_says(command, resume, saved):
    directory = begin(command())
    if saved:
        save(directory, 0)
    asked = command(resume=resume, planner={"horizon": 3})
    assert plan(asked, "planner.horizon") == ("begin", asked)


@pytest.mark.parametrize("resume", ["on", "auto"])
def test_a_run_that_made_no_step_has_its_settings_but_for_those_that_the_command_names(command, resume):
    own = command(planner={"horizon": 4}, seed=3)
    begin(own)
    typed = {**preset("efficient-tdmpc").to_dict(), "run_dir": own.run_dir, "resume": resume, "total_env_steps": 500}
    values = with_stored_settings(typed, ["run_dir", "resume", "total_env_steps"])
    assert values == {**own.to_dict(), "resume": resume, "total_env_steps": 500}
    # One that names what it trains means that, and not what was there.
    assert with_stored_settings(typed, ["run_dir", "resume", "task"]) == typed
    assert with_stored_settings({**typed, "resume": "off"}, ["run_dir", "resume"])["task"] == typed["task"]


@pytest.mark.parametrize("resume", ["on", "auto"])
def test_a_run_goes_on_from_its_checkpoint(command, resume):
    save(begin(command()))
    assert plan(command(resume=resume)) == ("resume", command(resume=resume))


@pytest.mark.parametrize("resume", ["on", "auto"])
@pytest.mark.parametrize("budget", [160, 100])
def test_there_is_nothing_to_do_for_a_finished_run(command, resume, budget):
    directory = begin(command())
    save(directory)
    finish(directory, command())
    assert plan(command(resume=resume, total_env_steps=budget), "total_env_steps")[0] == "nothing"


@pytest.mark.parametrize("resume", ["on", "auto"])
def test_a_finished_run_goes_on_with_a_larger_budget(command, resume):
    directory = begin(command())
    save(directory)
    finish(directory, command())
    asked = command(resume=resume, total_env_steps=161)
    action, config = plan(asked, "total_env_steps")
    assert (action, config.total_env_steps) == ("resume", 161)
    assert plan(asked)[0] == "nothing"  # the command did not name it


@pytest.mark.parametrize("budget", [70, 80])
def test_a_budget_that_is_spent_already_is_refused(command, budget):
    save(begin(command()))
    asked = command(resume="on", total_env_steps=budget)
    with pytest.raises(ValueError, match=rf"^total_env_steps={budget} is not above the 80 env steps that the run in "):
        plan(asked, "total_env_steps")
    assert plan(command(resume="on", total_env_steps=81), "total_env_steps")[0] == "resume"


def test_a_run_whose_last_step_was_saved_before_its_end_goes_on(command):
    config = command()
    save(begin(config), config.total_env_steps)
    assert plan(command(resume="on", total_env_steps=config.total_env_steps), "total_env_steps")[0] == "resume"


@pytest.mark.parametrize("run_dir", ["moved", None])
def test_a_directory_that_was_moved_goes_on_where_it_is(command, monkeypatch, tmp_path, run_dir):
    monkeypatch.chdir(tmp_path)
    there = begin(command())
    save(there)
    asked = dataclasses.replace(command(resume="auto"), run_dir=run_dir)
    place = Path(run_dir or Path("runs", asked.task, asked.preset, f"seed{asked.seed}"))
    place.parent.mkdir(parents=True, exist_ok=True)
    there.path.rename(place)
    settings = with_stored_settings(asked.to_dict(), ["resume"])
    found = plan_launch(TrainConfig.from_dict(settings), ["resume"])
    assert (found.action, found.directory.path) == ("resume", place)
    assert found.config.run_dir == run_dir


@pytest.mark.parametrize("resume", ["on", "auto"])
@pytest.mark.parametrize("finished", [True, False])
def test_a_run_without_checkpoints_keeps_its_results(command, resume, finished):
    directory = begin(command())
    if finished:
        finish(directory, command())
    else:
        directory.eval.write_text("env_steps,return_mean\n0,1.0\n40,2.0\n")
    with pytest.raises(FileNotFoundError, match=r"holds results but no checkpoint to go on from; choose another run"):
        plan(command(resume=resume, total_env_steps=161), "total_env_steps")


def test_a_command_changes_what_may_change_and_nothing_that_it_does_not_name(command):
    save(begin(command()))
    asked = command(resume="on", threads=2, checkpoint_every=7, planner={"horizon": 3}, seed=5)
    _, config = plan(asked, "threads", "resume")
    assert config == command(resume="on", threads=2)


def test_a_command_may_repeat_a_setting_of_the_run_but_not_change_it(command):
    save(begin(command()))
    asked = command(resume="on", planner={"horizon": 3})
    plan(asked, "planner.num_samples", "task")
    with pytest.raises(ValueError) as caught:
        plan(asked, "planner.horizon")
    assert str(caught.value) == (
        "planner.horizon=3 was asked for, but this run was started with planner.horizon=2; leave it out to go on, or "
        "start a new run_dir."
    )


FREE: dict[str, Any] = {"resume": "on", "run_dir": "elsewhere", "total_env_steps": 200}
FREE |= {"device": "cuda:1", "threads": 3, "compile": "default", "logger": "tensorboard"}
FREE |= {"checkpoint_every": 7, "checkpoint_minutes": 3.0, "checkpoint_keep": 5}


def test_every_setting_that_no_result_depends_on_may_change(command):
    assert resumed_config(command(), FREE, FREE) == command(**FREE)


def test_every_setting_that_a_result_depends_on_must_stay(command):
    saved = command()
    for name in flat(saved.to_dict()).keys() - FREE.keys():
        with pytest.raises(ValueError, match=f"=another was asked for, but this run was started with .*{name}="):
            resumed_config(saved, {name: "another"}, [name])


def test_a_setting_of_the_task_has_two_names_and_what_is_none_is_refused(command):
    saved = command()
    for name in ("action_repeat", "task.action_repeat"):
        with pytest.raises(ValueError, match=r"^task\.action_repeat=7 was asked for, but this run was started with "):
            resumed_config(saved, {"action_repeat": 7}, [name])
    for name in ("planner.horizont", "planner"):
        with pytest.raises(ValueError, match=f"^explicit names {name}, which is no setting; "):
            resumed_config(saved, saved, [name])


def test_settings_that_a_command_does_not_name_are_the_run_s_before_anything_is_checked(command):
    directory = begin(command())
    save(directory)
    typed = {"run_dir": str(directory), "total_env_steps": 200, "resume": True, "replay": {"seed_decisions": 5000}}
    values = TrainConfig.from_dict({**command().to_dict(), "task": "walker-walk", "total_env_steps": 50_000}).to_dict()
    completed = with_stored_settings(values | typed, ["run_dir", "total_env_steps", "resume"])
    assert TrainConfig.from_dict(completed) == command(total_env_steps=200, resume="on")
    with pytest.raises(ValueError, match=r"^replay\.seed_decisions=5000 was asked for, but this run was started with"):
        with_stored_settings(values | typed, ["run_dir", "resume", "replay.seed_decisions"])
    with pytest.raises(ValueError, match=r"^task\.action_repeat=3 was asked for, .* started with task\.action_rep"):
        with_stored_settings(values | typed | {"action_repeat": 3}, ["action_repeat"])
    for resume in (False, "off"):
        assert with_stored_settings(values | typed | {"resume": resume}, ["run_dir"])["task"] == "walker-walk"
    assert with_stored_settings(values | {"resume": "auto", "run_dir": "nowhere"})["run_dir"] == "nowhere"


def test_a_changed_setting_is_checked_with_the_others(command):
    with pytest.raises(ValueError, match="^total_env_steps must exceed the random phase"):
        resumed_config(command(replay={"seed_decisions": 70}), command(total_env_steps=100), ["total_env_steps"])


@pytest.mark.parametrize("text", ["planner: 3\n", "sede: 1\n", "- 1\n", "3\n", "a: [\n"])
def test_a_configuration_of_something_else_is_refused_in_one_line(command, text):
    directory = begin(command())
    directory.config.write_text(text)
    with pytest.raises(ValueError, match=r"config\.yaml (is not a configuration|cannot be used): ") as caught:
        plan(command(resume="auto"))
    assert "\n" not in str(caught.value)


def test_the_directory_is_named_by_task_preset_and_seed(tmp_path, monkeypatch, tiny_config):
    monkeypatch.chdir(tmp_path)
    assert plan_launch(tiny_config(seed=3)).directory.path == Path("runs/cartpole-balance/cpu/seed3")
    register_task(Task("some.module:make", "user", episode_length=40), lambda task, *, device: None, replace=True)
    config = tiny_config(task="some.module:make")
    assert plan_launch(config).directory.path == Path("runs/some.module.make/cpu/seed1")  # no colon in a file's name


def test_the_home_directory_may_be_written_short(tmp_path, monkeypatch, tiny_config):
    monkeypatch.setenv("HOME", str(tmp_path))
    assert plan_launch(tiny_config(run_dir="~/run")).directory.path == tmp_path / "run"


@pytest.fixture
def process() -> Iterator[None]:
    """Restores what a launch sets for its process."""
    threads, precision, state = torch.get_num_threads(), torch.get_float32_matmul_precision(), torch.get_rng_state()
    yield
    torch.set_num_threads(threads)
    torch.set_float32_matmul_precision(precision)
    torch.set_rng_state(state)


def is_free(directory: RunDirectory) -> bool:
    """Whether another process could write there."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of a fork beside PyTorch's threads
        child = os.fork()
    if child == 0:
        try:
            other = RunDirectory(directory.path)
            other.go_on()
        except BaseException:
            os._exit(1)
        os._exit(0)
    return os.waitpid(child, 0)[1] == 0


needs_dm_control = pytest.mark.skipif(importlib.util.find_spec("dm_control") is None, reason="needs dm_control")


def test_files_of_a_run_stay_where_they_were_named_if_an_environment_changes_the_directory(
    monkeypatch, tmp_path, process, tiny_config
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "elsewhere").mkdir()

    def make(task: Task, *, device: torch.device | str) -> EnvBase:
        os.chdir(tmp_path / "elsewhere")
        return TransformedEnv(GymEnv("Pendulum-v1", device=device), Compose(ActionScaling(), StepCounter(EPISODE)))

    register_task(Task("restless", "user", episode_length=EPISODE), make, replace=True)
    config = tiny_config(task="restless", run_dir="run", episode_length=EPISODE, total_env_steps=40)
    assert launch(config).endswith("curve, tables and checkpoint are in run")
    assert RunDirectory(tmp_path / "run").finished
    assert not any((tmp_path / "elsewhere").iterdir())


@needs_dm_control
def test_a_command_trains_to_its_summary_and_lets_others_in(command, process, read_table):
    config = command(threads=1)
    torch.set_num_threads(2)
    torch.set_float32_matmul_precision("highest")
    line = launch(config)
    assert torch.get_num_threads() == 2  # a sweep's next run may choose its own
    assert torch.get_float32_matmul_precision() == "high"
    directory = RunDirectory(config.run_dir)
    assert line.startswith("cartpole-balance: return ")
    assert line.endswith(f"curve, tables and checkpoint are in {config.run_dir}")
    assert directory.finished
    assert read_run_config(directory) == config
    assert [row["env_steps"] for row in read_table(directory.eval)] == [0, 100, 160]
    assert is_free(directory)
    assert launch(command(resume="auto")) == f"{config.run_dir} is finished; nothing to do"


@needs_dm_control
@pytest.mark.parametrize(
    ("changes", "error"),
    [
        ({"planner": {"num_elites": 100}}, r"^planner\.num_elites must be at most num_samples=8, got 100\.$"),
        ({"loss": {"rho": 0.0}}, r"^loss\.rho must be in"),
        ({"optim": {"lr": 0.0}}, r"^optim\.lr must be positive"),
        ({"reanalyze": {"num_slices": 0}}, r"^reanalyze\.num_slices must be at least 1"),
        ({"device": "cuda"}, r"^device=cuda needs a CUDA device"),
        ({"logger": "wandb"}, r"^logger=wandb needs wandb"),
    ],
    ids=lambda case: next(iter(case)) if isinstance(case, dict) else "",
)
def test_what_is_wrong_with_a_command_is_said_before_anything_is_written(
    command, tmp_path, monkeypatch, process, changes, error
):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    find_spec = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *rest: None if name == "wandb" else find_spec(name))
    with pytest.raises((ValueError, ImportError), match=error):
        launch(command(**changes))
    assert list(tmp_path.iterdir()) == []


@needs_dm_control
def test_a_logger_that_does_not_start_leaves_the_directory_free(command, monkeypatch, process):
    module = importlib.import_module("torchrl_etdmpc.training.launch")

    def fail(*_: Any) -> None:
        raise OSError("the logger's disk is full")

    with monkeypatch.context() as patched:
        patched.setattr(module, "make_logger", fail)
        with pytest.raises(OSError, match="the logger's disk is full"):
            launch(command())
    assert not RunDirectory(command().run_dir).holds_a_run
    assert plan(command())[0] == "begin"
    directory = begin(command())
    save(directory)
    with monkeypatch.context() as patched:
        patched.setattr(module, "make_logger", fail)
        with pytest.raises(OSError, match="the logger's disk is full"):
            launch(command(resume="auto"))
    assert plan(command(resume="auto"))[0] == "resume"  # a run that was there stays
    assert is_free(directory)


@needs_dm_control
@pytest.mark.parametrize("error", [RuntimeError, RunInterrupted, KeyboardInterrupt])
def test_others_are_kept_out_while_it_trains_and_nothing_is_left_of_a_run_that_made_no_step(
    command, tmp_path, monkeypatch, process, error
):
    directory, free = RunDirectory(command().run_dir), []

    def end(run: TrainingRun) -> None:
        free.append(is_free(directory))
        raise error("enough")

    monkeypatch.setattr(TrainingRun, "run", end)
    with pytest.raises(error, match="enough"):
        launch(command())
    assert free == [False]
    assert list(tmp_path.iterdir()) == []


@needs_dm_control
def test_a_run_that_cannot_begin_closes_its_environments(command, monkeypatch, process):
    module, made = importlib.import_module("torchrl_etdmpc.training.launch"), []
    make_env = module.make_env

    def watched(*args: Any, **options: Any) -> Any:
        made.append(make_env(*args, **options))
        return made[-1]

    monkeypatch.setattr(module, "make_env", watched)
    with pytest.raises(ValueError, match="num_elites"):
        launch(command(planner={"num_elites": 100}))
    assert [env.is_closed for env in made] == [True, True]


@needs_dm_control
def test_a_logger_is_closed_though_the_run_fails(command, monkeypatch, process):
    closed, logger = [], SimpleNamespace(shutdown=lambda: closed.append(True))
    monkeypatch.setattr(importlib.import_module("torchrl_etdmpc.training.launch"), "make_logger", lambda *_: logger)
    monkeypatch.setattr(TrainingRun, "run", lambda run: kill())
    with pytest.raises(Killed):
        launch(command())
    assert closed == [True]


@needs_dm_control
def test_a_finished_run_that_cannot_be_restored_stays_finished(command, process):
    directory = begin(command())
    save(directory)  # of a run that had no parts
    finish(directory, command())
    asked = command(resume="auto", total_env_steps=200)
    with pytest.raises(CheckpointError, match=r"^cannot resume: .*/000000000080 lacks agent, "):
        launch(asked, ["total_env_steps"])
    assert directory.finished
    assert read_run_config(directory) == command()
    assert is_free(directory)


@pytest.mark.parametrize("how", ["changed", "missing", "cut off", "no text", "a pipe"])
def test_a_damaged_configuration_is_taken_from_the_weights(command, tiny_config, how):
    directory = begin(command())
    agent = build_agent(command(), observation_dim=5, action_dim=1)
    save_agent(directory.last_agent, agent, command(), {"env_steps": 80})
    save(directory)
    text = directory.config.read_text()
    directory.config.unlink()
    if how == "a pipe":
        os.mkfifo(directory.config)
    elif how != "missing":
        changed = {"changed": text.replace("horizon: 2", "horizon: 3"), "cut off": text[:-20], "no text": f"\xff{text}"}
        directory.config.write_text(changed[how], encoding="latin-1")
    with pytest.warns(UserWarning, match=r"config\.yaml is .*; the settings are those of .*last\.pt\.$"):
        assert plan(command(resume="on")) == ("resume", command(resume="on"))
    directory.last_agent.unlink()
    lost = "missing" if how == "missing" else "damaged"
    errors = {
        "missing": (
            FileNotFoundError,
            r"holds a run whose settings are lost: config\.yaml and checkpoints/last\.pt are gone",
        ),
        "damaged": (ValueError, r"config\.yaml is not a configuration: "),
    }
    for resume in ("on", "auto"):
        with pytest.raises(errors[lost][0], match=errors[lost][1]):
            plan(command(resume=resume))


@needs_dm_control
@pytest.mark.parametrize("how", ["changed", "missing"])
def test_a_run_with_a_damaged_configuration_goes_on_and_has_it_back(command, process, read_table, how):
    launch(command(total_env_steps=100))
    directory = RunDirectory(command().run_dir)
    text = directory.config.read_text()
    directory.config.unlink()
    if how == "changed":
        directory.config.write_text(text.replace("horizon: 2", "horizon: 3"))
    asked = command(total_env_steps=110, resume="auto")
    with pytest.warns(UserWarning, match=r"config\.yaml is .*; the settings are those of .*last\.pt\.$"):
        launch(asked, ["total_env_steps"])
    assert directory.finished
    assert [row["env_steps"] for row in read_table(directory.eval)] == [0, 100, 110]
    assert directory.read_config() == asked.to_dict()


class Killed(BaseException):
    pass


def at_decision(monkeypatch: pytest.MonkeyPatch, number: int, act: Callable[[], None]) -> None:
    """Calls ``act`` before the given decision of every collector."""
    original = StepCollector.act

    def watched(collector: StepCollector) -> Any:
        if collector.frames == number - 1:
            act()
        return original(collector)

    monkeypatch.setattr(StepCollector, "act", watched)


def kill() -> None:
    raise Killed


@needs_dm_control
@pytest.mark.parametrize("number", [1, 20])
def test_a_run_that_was_killed_before_its_first_interval_ends_the_same(
    command, monkeypatch, process, read_table, number
):
    with monkeypatch.context() as patched:
        at_decision(patched, number, kill)
        with pytest.raises(Killed):
            launch(command(total_env_steps=110))
    directory = RunDirectory(command().run_dir)
    assert directory.path.exists() == (number > 1)
    launch(command(resume="auto", total_env_steps=110))
    assert [row["env_steps"] for row in read_table(directory.eval)] == [0, 100, 110]


@needs_dm_control
@pytest.mark.parametrize("place", ["make_env", "precompile", "_train", "evaluate"])
def test_a_signal_before_the_first_step_leaves_nothing_behind(command, tmp_path, monkeypatch, process, place):
    owners = {"precompile": TrainingRun, "evaluate": Evaluator}
    owner = owners.get(place, importlib.import_module("torchrl_etdmpc.training.launch"))
    name = "__call__" if place == "evaluate" else place
    original, went_on = getattr(owner, name), []

    def interrupted(*args: Any, **kwargs: Any) -> Any:
        signal.raise_signal(signal.SIGINT)
        went_on.append(place)
        return original(*args, **kwargs)

    monkeypatch.setattr(owner, name, interrupted)
    with pytest.raises(RunInterrupted, match=r"^stopped before the first step, with nothing to save; start it ag"):
        launch(command())
    assert list(tmp_path.iterdir()) == []
    assert not went_on


@needs_dm_control
def test_the_environment_begins_with_the_seed_of_the_run(command, monkeypatch, process):
    module, seeds = importlib.import_module("torchrl_etdmpc.training.launch"), []
    make_env = module.make_env

    def watched(*args: Any, **options: Any) -> Any:
        seeds.append(options.get("seed"))
        return make_env(*args, **options)

    monkeypatch.setattr(module, "make_env", watched)
    monkeypatch.setattr(TrainingRun, "run", lambda run: kill())
    with pytest.raises(Killed):
        launch(command(seed=7))
    assert seeds == [7, None]  # evaluations have a seed of their own


@needs_dm_control
def test_a_library_that_makes_another_error_of_a_signal_does_not_hide_it(command, tmp_path, monkeypatch, process):
    """Seen in one of some 200 kills: tensordict, interrupted while it was built, complained of something else."""

    def interrupted(*args: Any, **options: Any) -> None:
        try:
            os.kill(os.getpid(), signal.SIGTERM)
        except SystemExit:
            raise RuntimeError("Converting a tensordict to boolean value is not permitted") from None

    monkeypatch.setattr(TrainingRun, "precompile", interrupted)
    with pytest.raises(RunInterrupted, match=r"^stopped before the first step, with nothing to save; start it ag"):
        launch(command())
    assert list(tmp_path.iterdir()) == []


@needs_dm_control
def test_a_signal_before_the_first_step_ends_the_run_s_processes_and_nobody_else_s(command, monkeypatch, process):
    killed = []

    class Child:
        def kill(self) -> None:
            killed.append(self)

    children, own = [Child()], Child()
    monkeypatch.setattr(multiprocessing, "active_children", lambda: list(children))

    def interrupted(*_: Any) -> None:
        children.append(own)
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(TrainingRun, "precompile", interrupted)
    with pytest.raises(RunInterrupted):
        launch(command())
    assert killed == [own]


@needs_dm_control
def test_a_run_that_was_asked_to_stop_goes_on_to_the_same_end(command, tmp_path, monkeypatch, process):
    straight = command(run_dir=str(tmp_path / "straight"), total_env_steps=110)
    launch(straight)
    with monkeypatch.context() as patched:
        at_decision(patched, 47, lambda: signal.raise_signal(signal.SIGTERM))
        with pytest.raises(
            RunInterrupted, match=r"^stopped at 94 env steps and saved in .*; go on with resume=true\.$"
        ):
            launch(command(total_env_steps=110))
    directory = RunDirectory(command().run_dir)
    assert is_free(directory)
    launch(command(resume="auto"))
    tables = []
    for path in (directory, RunDirectory(straight.run_dir)):
        columns = [line.split(",") for file in (path.train, path.eval) for line in file.read_text().splitlines()]
        tables.append([line[:3] + line[4:] for line in columns])  # without the wall time
    assert tables[0] == tables[1]


@needs_dm_control
def test_a_finished_run_that_is_made_longer_is_not_finished_until_it_is(command, monkeypatch, process, read_table):
    launch(command(total_env_steps=100))
    asked = command(total_env_steps=120, resume="auto")
    with monkeypatch.context() as patched:
        at_decision(patched, 55, kill)
        with pytest.raises(Killed):
            launch(asked, ["total_env_steps"])
    assert plan(asked, "total_env_steps")[0] == "resume"
    launch(asked, ["total_env_steps"])
    directory = RunDirectory(asked.run_dir)
    assert directory.finished
    assert [row["env_steps"] for row in read_table(directory.eval)] == [0, 100, 120]
