"""The command of the wheel: what it says before anything heavy is imported, and that the wheel has all it needs."""

from __future__ import annotations

import io
import os
import signal
import subprocess
import sys
import time
import tomllib
from pathlib import Path
from types import SimpleNamespace

import pytest

from torchrl_etdmpc import __version__, commands

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


def test_the_wheel_s_command_is_the_examples_code():
    assert PROJECT["project"]["scripts"] == {"torchrl-etdmpc": "torchrl_etdmpc.commands:main"}
    names = ("train", "train_dmc", "distributed", "evaluate", "export", "report", "suite", "study", "inspect_planner")
    for name in names:
        assert f'main("{name}")' in (ROOT / "examples" / f"{name}.py").read_text(encoding="utf-8")


def test_a_folder_of_any_alphabet_can_be_named_where_output_is_ascii(monkeypatch):
    written = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(written, encoding="ascii"))
    monkeypatch.setattr(sys, "argv", ["/bin/torchrl-etdmpc", "--version"])
    with pytest.raises(SystemExit):
        commands.main()
    print("runs/größe", flush=True)
    assert written.getvalue().endswith(b"runs/gr\\xf6\\xdfe\n")


@pytest.mark.parametrize("name", ["stdout", "stderr"])
def test_a_stream_that_is_closed_takes_what_is_written(monkeypatch, name):
    monkeypatch.setattr(sys, name, None)  # as Python does, of `command >&-`
    monkeypatch.setattr(sys, "argv", ["/bin/torchrl-etdmpc", "--version"])
    with pytest.raises(SystemExit):
        commands.main()
    print("10 env steps", file=getattr(sys, name), flush=True)
    assert not getattr(sys, name).isatty()
    getattr(sys, name).close()


def test_the_wheel_holds_every_file_that_the_package_reads():
    package = ROOT / "src" / "torchrl_etdmpc"
    patterns = PROJECT["tool"]["setuptools"]["package-data"]["torchrl_etdmpc"]
    files = [path.relative_to(package).as_posix() for path in package.rglob("*") if path.is_file()]
    data = [file for file in files if not file.endswith((".py", ".pyc"))]
    assert {"py.typed", "commands/config/train.yaml", "analysis/reference/bmpc.csv"} <= set(data)
    found = {path.relative_to(package).as_posix() for pattern in patterns for path in package.glob(pattern)}
    assert sorted(set(data) - found) == []


def test_the_sdist_holds_the_checkout():
    listing = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=False)
    if listing.returncode:
        pytest.skip("not in a checkout")
    tops = {line.split("/")[0] for line in listing.stdout.splitlines()} - {".gitignore"}
    manifest = (ROOT / "MANIFEST.in").read_text(encoding="utf-8").split()
    assert tops - set(manifest) <= {"MANIFEST.in", "pyproject.toml"}  # these two are always there


@pytest.mark.parametrize("name", ["train", "distributed", "evaluate", "export", "report", "study", "inspect_planner"])
def test_every_command_has_a_help_that_says_what_it_takes(run_main, name):
    message, out, err = run_main(name, "--help")
    assert message in (None, 0)
    assert err == ""
    assert f"usage: torchrl-etdmpc {name} " in out
    assert max(map(len, out.splitlines())) <= 100


def test_without_a_command_the_commands_are_listed(run_main):
    for arguments in ((), ("--help",)):
        message, out, _ = run_main(*arguments)
        assert message == (0 if arguments else 2)
        assert all(name in out for name in ("train", "distributed", "evaluate", "export", "report", "study"))
    assert run_main("--version") == (0, f"torchrl-etdmpc {__version__}\n", "")
    known = "train, distributed, evaluate, export, report, suite, study, inspect_planner"
    assert run_main("tran")[0] == f"error: unknown command 'tran'; choose one of {known}."


def test_a_current_directory_that_was_removed_is_one_line(run_main, tmp_path, monkeypatch):
    gone = tmp_path / "gone"
    gone.mkdir()
    monkeypatch.chdir(gone)
    gone.rmdir()
    assert run_main("train", "--help")[0] == "error: the current directory was removed; change to another one."


@pytest.mark.parametrize(
    ("command", "arguments", "before", "after"),
    [
        ("train", ["task=walker-walk"], "nonsense", "disable"),
        ("evaluate", ["checkpoint=a.pt"], "osmesa", "disable"),
        ("evaluate", ["checkpoint=a.pt", "video=a.mp4"], "osmesa", "osmesa"),
        ("evaluate", ["checkpoint=a.pt", "video=a.mp4"], None, "egl"),
        ("train", ["task=mine:make"], "egl", "egl"),
        ("train", ["task=mine:make"], None, "disable"),
        ("report", ["runs"], "nonsense", "disable"),
    ],
)
def test_a_renderer_is_asked_for_only_where_something_may_be_rendered(monkeypatch, command, arguments, before, after):
    if before is None:
        monkeypatch.delenv("MUJOCO_GL", raising=False)
    else:
        monkeypatch.setenv("MUJOCO_GL", before)
    commands._choose_renderer(command, arguments)
    assert os.environ["MUJOCO_GL"] == after


@pytest.mark.parametrize(
    ("command", "before", "remedy"),
    [
        ("evaluate", None, "try MUJOCO_GL=osmesa, or leave the film out."),
        ("evaluate", "osmesa", "try MUJOCO_GL=egl, or leave the film out."),
        ("inspect_planner", "egl", "try MUJOCO_GL=osmesa, or MUJOCO_GL=disable to do without."),
    ],
)
def test_a_renderer_that_fails_is_not_what_its_message_advises(monkeypatch, command, before, remedy):
    def fail(name):
        raise ImportError("no display")

    if before is None:
        monkeypatch.delenv("MUJOCO_GL", raising=False)
    else:
        monkeypatch.setenv("MUJOCO_GL", before)
    monkeypatch.delenv("TORCHRL_ETDMPC_TRACEBACK", raising=False)
    monkeypatch.setattr(commands, "importlib", SimpleNamespace(import_module=fail))
    monkeypatch.setattr(sys, "argv", ["command", "checkpoint=a.pt", "video=a.mp4"])
    with pytest.raises(SystemExit, match=remedy):
        commands.main(command)


def start(*arguments: str, **variables: str) -> subprocess.Popen[str]:
    environment = os.environ | {"PYTHONPATH": str(ROOT / "src"), "OMP_NUM_THREADS": "1", **variables}
    handler = signal.signal(signal.SIGINT, signal.default_int_handler)  # also where this process ignores it
    try:
        return subprocess.Popen(
            [sys.executable, str(ROOT / "examples" / "train.py"), *arguments],
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
    finally:
        signal.signal(signal.SIGINT, handler)


def test_a_missing_renderer_does_not_hurt_a_run_that_renders_nothing(tmp_path):
    process = start("task=cartpole-balance", "preset=cpu", "total_env_steps=1", MUJOCO_GL="nonsense")
    _, err = process.communicate(timeout=300)
    assert err.startswith("error: total_env_steps must exceed the random phase")  # it came as far as the settings


@pytest.mark.parametrize(
    "delay", [pytest.param(0.0, marks=pytest.mark.slow), 0.3, pytest.param(1.0, marks=pytest.mark.slow)]
)
def test_ctrl_c_while_pytorch_is_imported_is_one_line(delay):
    process = start("task=walker-walk", "preset=cpu", "total_env_steps=1")
    libraries = Path(f"/proc/{process.pid}/maps")
    while process.poll() is None and "libtorch" not in libraries.read_text():
        time.sleep(0.01)
    time.sleep(delay)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=300)
    if process.returncode == 1 and err.startswith("error: total_env_steps"):
        pytest.skip("the machine was too fast")
    assert (process.returncode, out, err) == (130, "", "\nstopped before anything was begun\n")


def test_ctrl_c_while_python_starts_prints_nothing_of_ours():
    process = start("task=walker-walk", "preset=cpu", "total_env_steps=1")
    time.sleep(0.15)
    process.send_signal(signal.SIGINT)
    out, _ = process.communicate(timeout=300)
    assert out == ""


def test_ctrl_c_while_libraries_are_imported_ends_a_command_whose_messages_nobody_reads(in_copy):
    def interrupted() -> None:
        reader, writer = os.pipe()
        os.close(reader)  # as Ctrl-C ends the tee of `train 2>&1 | tee log`, too
        os.dup2(writer, 2)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        commands.importlib = SimpleNamespace(import_module=lambda name: signal.raise_signal(signal.SIGINT))
        commands.main("train")

    assert os.waitstatus_to_exitcode(in_copy(interrupted)) == 128 + signal.SIGINT
