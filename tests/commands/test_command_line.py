"""What was typed, checked before Hydra sees it."""

from __future__ import annotations

import os
import sys
from typing import Any

import pytest

pytest.importorskip("hydra")

from torchrl_etdmpc.commands import train  # noqa: E402
from torchrl_etdmpc.commands.command_line import as_typed, hydra_main, one_line_errors  # noqa: E402
from torchrl_etdmpc.commands.evaluate import EvaluateConfig  # noqa: E402
from torchrl_etdmpc.commands.export import ExportConfig  # noqa: E402
from torchrl_etdmpc.runs.dotted import flat  # noqa: E402
from torchrl_etdmpc.training import PRESETS, TrainConfig  # noqa: E402


@pytest.fixture
def run_command(monkeypatch, capfd):
    """What a command line makes of the arguments: a configuration, or the message that it ends with."""
    monkeypatch.setenv("HYDRA_FULL_ERROR", "0")
    monkeypatch.delenv("TORCHRL_ETDMPC_TRACEBACK", raising=False)

    def run(*arguments: str, config_class: type = TrainConfig, config_name: str = "train") -> Any:
        received = []
        monkeypatch.setattr(sys, "argv", ["/bin/command", *arguments])
        try:
            hydra_main(config_name, config_class)(received.append)()
        except SystemExit as stop:
            assert capfd.readouterr() == ("", "")
            assert "\n" not in stop.code
            assert received == []
            return stop.code
        return received[0] if received else capfd.readouterr().out

    return run


NEAREST = "did you mean planner.horizon or reanalyze.horizon? --help lists all."
WRONG = [
    (("task", "walker-walk"), "a setting is written name=value, without dashes or spaces, got 'task'."),
    (("--task=walker-walk",), "a setting is written name=value, without dashes or spaces, got '--task=walker-walk'."),
    (("--preset", "cpu"), "a setting is written name=value, without dashes or spaces, got '--preset'."),
    (("-x",), "unknown option -x; settings are written name=value, and --help lists them."),
    (("--cfg", "jobs"), "--cfg must be followed by job, got 'jobs'."),
    (("~planner.horizon",), "a setting cannot be removed, got '~planner.horizon'; planner.horizon=null may do."),
    (("Task=walker-walk",), "unknown setting Task; did you mean task? --help lists all."),
    (("planner.horizn=3",), f"unknown setting planner.horizn; {NEAREST}"),
    (("horizon=3",), f"unknown setting horizon; {NEAREST}"),
    (("lr=1",), "unknown setting lr; did you mean optim.lr? --help lists all."),
    (("++zzz=4",), "unknown setting zzz; --help lists all."),
    (("hydra.run.dir=x",), "unknown setting hydra.run.dir; --help lists all."),
    (("planner=3",), "planner is a group of settings; --help planner lists them, e.g. planner.horizon=..."),
    (("planner.horizon=[1",), "planner.horizon must be a whole number, got '[1'."),
    (("planner.horizon=３",), "planner.horizon must be a whole number, got '３'."),
    (("task.episode_length=inf",), "task.episode_length must be a whole number, got 'inf'."),
    (("task.terminates=maybe",), "task.terminates must be true or false, got 'maybe'."),
    (("planner.horizon=",), "planner.horizon must not be empty."),
    (("optim.lr=1,2",), "optim.lr must be a number, got '1,2'."),
    (("eval_policy={}",), "eval_policy must be true or false, got '{}'."),
    (("planner.score=(",), "planner.score must be one of final, mean, adaptive, got '('."),
    (("optim.lr=inf",), "optim.lr must be a finite number below 1e30, got inf."),
    (("total_env_steps=1e400",), "total_env_steps must be a whole number below 2**53, got inf."),
    (("run_dir=${nope}",), "run_dir cannot be read: Interpolation key 'nope' not found"),
    (
        ("--multirun", "seed=1,2", "run_dir=here"),
        "run_dir=here would be that of several runs, which differ in seed; put what differs into it, e.g. "
        "run_dir='here/${seed}'.",
    ),
    (
        ("--multirun", "seed=1,2", "planner.horizon=range(3,5)"),
        "the default run_dir would be that of several runs, which differ in planner.horizon; put what differs into it, "
        "e.g. run_dir='runs/${seed}/${planner.horizon}'.",
    ),
    (
        ("-m", "seed=1,2", "planner.horizon=3,4", "task.episode_length=choice(200,400)", "run_dir=runs/${seed}"),
        "run_dir=runs/${seed} would be that of several runs, which differ in planner.horizon, episode_length; put what "
        "differs into it, e.g. run_dir='runs/${seed}/${planner.horizon}/${episode_length}'.",
    ),
    (("walker-walk",), "a setting is written name=value, got 'walker-walk'; did you mean task=walker-walk?"),
    (("horizn",), "unknown setting horizn; did you mean reanalyze.horizon? --help lists all."),
    (
        ("--multirun", "preset=cpu", "task=walker-walk,walker-wlk"),
        "unknown task 'walker-wlk'; did you mean walker-walk, walker-run, walker-stand? task=list on the command "
        "line lists all.",
    ),
    (
        ("--multirun", "preset=cpu", "seed=1,-1"),
        "seed must be in [0, 2**32 - 1], got -1.",
    ),
    (("--multirun", "preset=cpu,cpuu"), f"unknown preset 'cpuu'; choose one of {', '.join(PRESETS)}."),
    (("--help", "planer"), "there is no group and no setting 'planer'; did you mean planner? --help lists all."),
]


@pytest.mark.parametrize(("arguments", "message"), WRONG, ids=[" ".join(arguments) for arguments, _ in WRONG])
def test_a_mistake_is_named_in_the_words_of_the_command(run_command, arguments, message):
    assert run_command(*arguments) == f"error: {message}"


@pytest.mark.parametrize(
    "path", ["my run", "it's", "a{b", "a=b", "a,b", "a\\b", "a\\'b", "ends in\\", "(1)", "[2]", "ü", "#x", '"']
)
def test_a_path_is_taken_as_it_is_typed(run_command, path):
    assert run_command(f"run_dir={path}").run_dir == path


def test_the_home_directory_may_be_short(run_command, monkeypatch):
    monkeypatch.setenv("HOME", "/somewhere")
    assert run_command("run_dir=~/my runs").run_dir == "/somewhere/my runs"
    export = {"config_class": ExportConfig, "config_name": "export"}
    assert run_command("checkpoint=~/a.pt", **export).checkpoint == "/somewhere/a.pt"


def test_quotes_of_hydra_and_its_plus_are_accepted(run_command):
    assert run_command("run_dir='a b'", "+planner.horizon=4").planner.horizon == 4
    assert run_command("run_dir='a b'").run_dir == "a b"


def test_a_setting_may_be_taken_back(run_command):
    config = run_command("task.episode_length=null", "checkpoint_minutes=None")
    assert (config.episode_length, config.checkpoint_minutes) == (None, None)


def test_the_last_of_two_values_counts(run_command):
    assert run_command("seed=2", "seed=3").seed == 3


def test_a_flag_may_stand_between_settings(run_command, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # a sweep of Hydra's keeps a folder
    assert "horizon: 4" in run_command("preset=cpu", "--cfg", "job", "planner.horizon=4")
    evaluate = {"config_class": EvaluateConfig, "config_name": "evaluate"}
    assert "checkpoint: ???" in run_command("--cfg", "job", **evaluate)  # what must be given may be missing here
    assert "run_dir: runs/3" in run_command("run_dir=runs/${seed}", "-c", "job", "--resolve", "seed=3")
    assert run_command("preset=cpu", "--multirun", "seed=3,4").seed == 3
    assert run_command("preset=cpu", "--multirun", "seed=3", "run_dir=one").run_dir == "one"
    assert run_command("preset=cpu", "--multirun", "run_dir=one,two").run_dir == "one"
    assert run_command("preset=cpu", "--multirun", "seed=3,4", "run_dir=runs/${seed}").run_dir == "runs/3"


@pytest.mark.parametrize("values", ["20,30", "range(20,40,10)", "choice(20,30)"])
def test_settings_of_the_task_are_swept_and_name_directories_as_they_are_typed(
    run_command, tmp_path, monkeypatch, values
):
    monkeypatch.chdir(tmp_path)
    task = ("task=gym/Pendulum-v1", "preset=cpu", f"task.episode_length={values}")
    config = run_command("--multirun", *task, "run_dir=runs/${task.episode_length}")
    assert (config.episode_length, config.run_dir) == (20, "runs/20")


SWEPT_CODE = """
from torchrl_etdmpc.envs import get_task

def lowest(returns):
    return returns.amin((-2, -1)).mean(-1)

def highest(returns):
    return returns.amax((-2, -1)).mean(-1)

slow, fast = get_task("walker-walk"), get_task("walker-run")
"""


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("preset", ["cpu", "tdmpc2-cpu"]),
        ("planner.score", ["swept_code:lowest", "swept_code:highest"]),
        ("task", ["swept_code:slow", "swept_code:fast"]),
    ],
)
def test_presets_and_code_of_one_s_own_are_swept(run_command, tmp_path, monkeypatch, name, values):
    (tmp_path / "swept_code.py").write_text(SWEPT_CODE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.delitem(sys.modules, "swept_code", raising=False)
    config = run_command("--multirun", f"{name}={','.join(values)}", f"run_dir=runs/${{{name}}}")
    assert (flat(config.to_dict())[name], config.run_dir) == (values[0], f"runs/{values[0]}")


def test_a_sweep_leaves_no_folder_but_those_of_its_runs(run_command, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    sweep = ("preset=cpu", "--multirun", "planner.horizon=3,4", "run_dir=runs/${planner.horizon}")
    assert run_command(*sweep).planner.horizon == 3
    assert list(tmp_path.iterdir()) == []
    assert run_command(*sweep, "hydra.sweep.dir=kept").planner.horizon == 3
    assert (tmp_path / "kept" / "multirun.yaml").is_file()


@pytest.mark.parametrize(
    ("output", "remedy"),
    [
        ("csv=a.csv", "csv='${seed}/a.csv'"),
        ("video=films/a.mp4", "video='films/${seed}/a.mp4'"),
        ("video=~/a.gif", "video='/somewhere/${seed}/a.gif'"),
        ("csv=~/a.csv", "csv='/somewhere/${seed}/a.csv'"),
    ],
)
def test_no_two_runs_of_a_sweep_write_the_same_file(run_command, monkeypatch, output, remedy):
    monkeypatch.setenv("HOME", "/somewhere")
    message = run_command(
        "--multirun", "checkpoint=a.pt", "seed=1,2", "planner.horizon=3", output, config_class=EvaluateConfig
    )
    assert message == (
        f"error: {output.replace('~', '/somewhere')} would be that of several runs, which differ in seed; put what "
        f"differs into it, e.g. {remedy}."
    )


def test_no_two_runs_of_a_sweep_write_into_the_same_folder(run_command):
    message = run_command("--multirun", "checkpoint=a.pt", "batch_size=1,2", config_class=ExportConfig)
    assert message == (
        "error: out=exported would be that of several runs, which differ in batch_size; put what differs into it, e.g. "
        "out='exported/${batch_size}'."
    )


def test_a_checkpoint_that_stands_alone_is_recognised(run_command):
    message = run_command("runs/a/best.pt", config_class=EvaluateConfig)
    assert message == (
        "error: a setting is written name=value, got 'runs/a/best.pt'; did you mean checkpoint=runs/a/best.pt?"
    )


def test_help_and_the_list_of_tasks_are_answered_without_a_run(run_command):
    assert "usage: command [SETTING=VALUE ...]" in run_command("--help")
    assert "planner.horizon=3 " in run_command("--help", "planner", "preset=cpu")
    assert run_command("-h", "planner.*") == run_command("help", "planner.") == run_command("--help", "planner")
    assert "walker-walk" in run_command("task=list")


def test_messages_speak_the_words_of_make(monkeypatch):
    text = "run_dir=runs/a already holds a run; go on with resume=true."
    assert as_typed(text) == text
    monkeypatch.setenv("TORCHRL_ETDMPC_MAKE", 'make train RUN_DIR="runs/a"')
    expected = 'RUN_DIR=runs/a already holds a run; go on with make train RUN_DIR="runs/a" ARGS="resume=true".'
    assert as_typed(text) == expected


def test_an_error_without_words_is_named_by_its_kind(monkeypatch):
    @one_line_errors
    def fail() -> None:
        raise NotImplementedError

    monkeypatch.delenv("TORCHRL_ETDMPC_TRACEBACK", raising=False)
    with pytest.raises(SystemExit, match="^error: NotImplementedError$"):
        fail()


@pytest.mark.parametrize("name", ["stdout", "stderr"])
def test_an_exit_code_stays_where_nobody_reads_what_is_written(monkeypatch, name):
    reader, writer = os.pipe()
    os.close(reader)  # as Ctrl-C ends the tee of `train | tee log`, too
    stream = open(writer, "w")
    monkeypatch.setattr(sys, name, stream)

    @one_line_errors
    def stopped() -> None:
        stream.write("stopped at 10 env steps")
        sys.exit(75)

    with pytest.raises(SystemExit, match="^75$"):
        stopped()
    stream.close()  # Python does so at its end; an error would become its exit code


def test_a_run_that_was_stopped_says_so_where_nobody_reads_what_it_prints(monkeypatch):
    def stopped(*_: Any) -> None:
        raise train.RunInterrupted("stopped at 10 env steps")

    reader, writer = os.pipe()
    os.close(reader)
    monkeypatch.setattr(train, "launch", stopped)
    monkeypatch.setattr(sys, "stdout", open(writer, "w", buffering=1))
    with pytest.raises(SystemExit, match="^75$"):
        one_line_errors(train.train)(TrainConfig())
    sys.stdout.close()


@pytest.mark.parametrize(("where", "code"), [("pipe", 141), ("/dev/full", "error: [Errno 28] No space left on device")])
def test_output_that_is_lost_is_no_success(monkeypatch, where, code):
    reader, writer = os.pipe() if where == "pipe" else (os.open(os.devnull, os.O_RDONLY), os.open(where, os.O_WRONLY))
    os.close(reader)
    monkeypatch.setattr(sys, "stdout", open(writer, "w"))
    monkeypatch.delenv("TORCHRL_ETDMPC_TRACEBACK", raising=False)

    with pytest.raises(SystemExit) as stop:
        one_line_errors(lambda: print("the answer"))()
    assert stop.value.code == code
    sys.stdout.close()
