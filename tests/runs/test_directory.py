from __future__ import annotations

import errno
import gc
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable
from itertools import count
from pathlib import Path

import pytest
import torch
import yaml

from torchrl_etdmpc.runs import RunDirectory

CONFIG = {"task": "walker-walk", "preset": "efficient-tdmpc-utd4", "seed": 1, "planner": {"horizon": 3, "lr": 3e-4}}


def snapshot(directory: Path) -> dict[str, bytes]:
    files = (path for path in directory.rglob("*") if path.name != ".lock")  # whoever closes it gives up its lock
    return {str(path): path.read_bytes() if path.is_file() else b"" for path in files}


@pytest.fixture
def begun(tmp_path: Path) -> RunDirectory:
    directory = RunDirectory(tmp_path / "run")
    directory.begin(CONFIG)
    return directory


@pytest.fixture
def elsewhere(in_copy) -> Callable[[Callable[[], None]], str | None]:
    """What a function raises in another process, as one text; ``None`` if it returns."""

    def run(function: Callable[[], None]) -> str | None:
        read, write = os.pipe()

        def told() -> None:
            try:
                function()
            except Exception as error:
                os.write(write, f"{type(error).__name__}: {error}".encode())

        assert in_copy(told) == 0
        os.close(write)
        with os.fdopen(read) as pipe:
            return pipe.read() or None

    return run


def test_the_names_of_the_files_are_those_that_other_programs_read():
    directory = RunDirectory("runs/walker")
    names = {name: str(path) for name, path in vars(directory).items() if isinstance(path, Path)}
    assert names == {
        "path": "runs/walker",
        "config": "runs/walker/config.yaml",
        "train": "runs/walker/train.csv",
        "eval": "runs/walker/eval.csv",
        "curve": "runs/walker/curve.png",
        "summary": "runs/walker/summary.json",
        "checkpoints": "runs/walker/checkpoints",
        "last_agent": "runs/walker/checkpoints/last.pt",
        "best_agent": "runs/walker/checkpoints/best.pt",
        "tensorboard": "runs/walker/tensorboard",
        "wandb_id": "runs/walker/wandb_id",
        "lock": "runs/walker/.lock",
    }
    assert str(directory) == f"{directory}" == "runs/walker"


def test_a_tilde_is_the_home_directory(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    assert RunDirectory("~/run").config == tmp_path / "run" / "config.yaml"


def test_making_one_and_asking_it_touches_nothing(tmp_path):
    directory = RunDirectory(tmp_path / "run")
    assert (directory.holds_a_run, directory.finished) == (False, False)
    directory.require_new()
    directory.close()
    assert list(tmp_path.iterdir()) == []


def test_a_run_begins_with_its_resolved_configuration_and_nothing_else(tmp_path):
    directory = RunDirectory(tmp_path / "runs" / "walker")
    directory.begin(CONFIG)
    assert sorted(path.name for path in directory.path.iterdir()) == [".lock", "config.yaml"]
    assert directory.read_config() == CONFIG
    assert list(yaml.safe_load(directory.config.read_text())) == list(CONFIG)  # in the order of the settings
    assert (directory.holds_a_run, directory.finished) == (True, False)
    directory.close()
    assert [path.name for path in directory.path.iterdir()] == ["config.yaml"]


@pytest.mark.parametrize("again", ["begin", "go_on"])
def test_what_a_kill_left_of_a_file_goes_and_other_people_s_files_stay(tmp_path, again):
    directory = RunDirectory(tmp_path / "run")
    if again == "go_on":
        directory.begin(CONFIG)
        directory.close()
    directory.path.mkdir(exist_ok=True)
    names = ("config.yaml", "train.csv", "eval.csv", "curve.png", "summary.json", "wandb_id")
    ours = [directory.path / f".{Path(name).stem}.0badcafe.partial{Path(name).suffix}" for name in names]
    film = directory.path / ".film.0badcafe.partial.mp4"
    for file in (*ours, film):
        file.touch()
    directory.begin(CONFIG) if again == "begin" else directory.go_on()
    assert not any(file.exists() for file in ours)
    assert film.exists()


def test_a_run_may_begin_in_a_directory_that_holds_something_else(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    RunDirectory(tmp_path).begin(CONFIG)
    assert (tmp_path / "notes.txt").read_text() == "mine"


@pytest.mark.parametrize("entry", ["config.yaml", "eval.csv", "train.csv", "summary.json", "checkpoints", "a link"])
def test_a_directory_that_holds_a_run_is_refused_and_not_touched(tmp_path, entry):
    if entry == "checkpoints":
        (tmp_path / entry).mkdir()
    elif entry == "a link":
        (tmp_path / "eval.csv").symlink_to(tmp_path / "on a disk that is not there")
    else:
        (tmp_path / entry).write_text("old")
    before = snapshot(tmp_path)
    directory = RunDirectory(tmp_path)
    for refuse in (directory.require_new, lambda: directory.begin(CONFIG)):
        with pytest.raises(FileExistsError) as caught:
            refuse()
        assert str(caught.value) == (
            f"run_dir={tmp_path} already holds a run; go on with resume=auto, choose another run_dir or remove it."
        )
    assert directory.holds_a_run
    assert snapshot(tmp_path) == before


@pytest.mark.parametrize("name", ["café".encode(), "café".encode("latin-1"), b"two words"])
def test_a_configuration_may_name_a_folder_in_any_bytes(tmp_path, name):
    directory = RunDirectory(tmp_path / os.fsdecode(name))
    config = CONFIG | {"run_dir": str(directory)}
    directory.begin(config)
    assert directory.read_config() == config


def test_a_configuration_that_yaml_cannot_hold_is_refused_before_anything_is_made(tmp_path):
    with pytest.raises(ValueError, match=r"^config must hold plain dicts, .*, got device\(type='cpu'\); convert it"):
        RunDirectory(tmp_path / "run").begin({"device": torch.device("cpu")})
    assert list(tmp_path.iterdir()) == []


def test_a_missing_yaml_is_named_before_anything_is_made(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "yaml", None)
    with pytest.raises(ImportError, match=r"needs PyYAML, which is not installed; run `pip install pyyaml`\.$"):
        RunDirectory(tmp_path / "run").begin(CONFIG)
    assert list(tmp_path.iterdir()) == []


def test_a_directory_that_cannot_be_made_is_one_clear_line(tmp_path):
    (tmp_path / "file").write_text("")
    run_dir = tmp_path / "file" / "run"
    with pytest.raises(OSError) as caught:
        RunDirectory(run_dir).begin(CONFIG)
    assert str(caught.value) == (
        f"run_dir={run_dir} cannot be written (Not a directory); choose a directory that you can write to."
    )


def test_a_read_only_directory_is_one_clear_line(small_disk):
    run_dir = small_disk / "run"
    run_dir.mkdir()
    subprocess.run(["mount", "-o", "remount,ro", str(small_disk)], check=True)
    with pytest.raises(OSError) as caught:
        RunDirectory(run_dir).begin(CONFIG)
    assert str(caught.value) == (
        f"run_dir={run_dir} cannot be written (Read-only file system); choose a directory that you can write to."
    )


@pytest.mark.parametrize("how", ["begin", "write_config"])
def test_a_full_disk_is_one_clear_line_and_keeps_nobody_out(small_disk, leave_free, elsewhere, how):
    directory = RunDirectory(small_disk / "run")
    config = {**CONFIG, "note": "x" * 20_000}
    if how == "write_config":
        directory.begin(CONFIG)
        directory.close()
    else:
        directory.path.mkdir()
    before = snapshot(directory.path)
    leave_free(small_disk, 4096)
    with pytest.raises(OSError) as caught:
        getattr(directory, how)(config)
    assert str(caught.value) == (
        f"run_dir={directory} cannot be written (No space left on device); choose a directory that you can write to."
    )
    assert snapshot(directory.path) == before
    leave_free(small_disk, None)
    assert elsewhere(lambda: getattr(RunDirectory(directory.path), how)(config)) is None


@pytest.fixture
def nothing_is_written(monkeypatch):
    def fail(*_) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("torchrl_etdmpc.runs.directory.write_whole", fail)


def test_a_run_whose_configuration_cannot_be_written_leaves_no_folder(tmp_path, nothing_is_written):
    with pytest.raises(OSError, match="cannot be written"):
        RunDirectory(tmp_path / "runs" / "walker" / "seed1").begin(CONFIG)
    assert list(tmp_path.iterdir()) == []


def test_a_configuration_that_cannot_be_stored_lets_others_in(begun, nothing_is_written, elsewhere):
    with pytest.raises(OSError, match="cannot be written"):
        begun.write_config(CONFIG | {"seed": 2})
    assert elsewhere(lambda: RunDirectory(begun.path).go_on()) is None


def test_another_process_is_kept_out_until_the_run_is_closed(begun, elsewhere):
    def go_on() -> None:
        RunDirectory(begun.path).go_on()

    busy = f"OSError: run_dir={begun} is in use by another process; wait for it or choose another run_dir."
    before = snapshot(begun.path)
    assert elsewhere(go_on) == busy
    assert snapshot(begun.path) == before
    begun.close()
    begun.close()  # a second time is nothing
    assert elsewhere(go_on) is None
    begun.go_on()
    assert elsewhere(go_on) == busy


def test_who_holds_a_run_may_ask_whether_it_is_in_use_and_keeps_it(begun, elsewhere):
    assert begun.in_use
    busy = elsewhere(lambda: RunDirectory(begun.path).go_on())
    assert busy is not None and "is in use by another process" in busy
    begun.close()
    assert not begun.in_use


def test_of_two_processes_that_begin_at_once_only_one_does(begun, elsewhere):
    """The other one looked before the configuration was there."""
    begun.config.unlink()
    message = elsewhere(lambda: RunDirectory(begun.path).begin(CONFIG | {"seed": 2}))
    assert message == f"OSError: run_dir={begun} is in use by another process; wait for it or choose another run_dir."
    assert not begun.config.exists()


def test_a_run_that_began_between_the_look_and_the_lock_is_not_overwritten(tmp_path, monkeypatch, elsewhere):
    directory, looked = RunDirectory(tmp_path / "run"), []
    require_new = RunDirectory.require_new

    def finish_another() -> None:
        other = RunDirectory(directory.path)
        other.begin(CONFIG | {"seed": 2})
        other.summary.write_text("{}")

    def slow(self: RunDirectory) -> None:
        require_new(self)
        if not looked:
            looked.append(True)
            assert elsewhere(finish_another) is None

    monkeypatch.setattr(RunDirectory, "require_new", slow)
    with pytest.raises(FileExistsError, match="already holds a run"):
        directory.begin(CONFIG)
    assert directory.read_config()["seed"] == 2
    assert elsewhere(lambda: RunDirectory(directory.path).go_on()) is None  # and nobody is kept out


@pytest.mark.parametrize("how", ["moved", "removed", "unlocked"])
def test_a_run_that_began_where_another_one_was_moved_or_removed_is_not_touched(begun, elsewhere, how):
    """The other one is still there, and does not know."""
    begun.require_held()
    if how == "unlocked":
        begun.lock.unlink()
        begun.require_held()  # nobody has taken its place
    elif how == "removed":
        shutil.rmtree(begun.path)
    else:
        begun.path.rename(begun.path.with_name("elsewhere"))
    if how != "unlocked":
        with pytest.raises(OSError, match=r"run was moved or removed while a run trained in it, or its \.lock was; "):
            begun.require_held()

    def begin_and_die() -> None:
        other = RunDirectory(begun.path)
        other.begin(CONFIG | {"seed": 2})
        other.eval.write_text(ROW.format(0))
        os._exit(0)

    assert elsewhere(begin_and_die) is None
    before, lock = snapshot(begun.path), begun.lock.stat()
    with pytest.raises(OSError, match="was moved or removed"):
        begun.require_held()
    begun.abandon()
    assert snapshot(begun.path) == before
    assert os.path.samestat(begun.lock.stat(), lock)


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="POSIX signals")
def test_a_process_that_was_killed_keeps_nobody_out(tmp_path, in_copy):
    directory = RunDirectory(tmp_path / "run")

    def begin_and_die() -> None:
        directory.begin(CONFIG)
        os.kill(os.getpid(), signal.SIGKILL)

    assert os.WIFSIGNALED(in_copy(begin_and_die))
    assert (directory.path / ".lock").exists()
    directory.go_on()
    directory.close()
    assert [path.name for path in directory.path.iterdir()] == ["config.yaml"]


def test_who_asks_whether_it_is_in_use_keeps_nobody_out(tmp_path, monkeypatch):
    pytest.importorskip("fcntl")
    directory = RunDirectory(tmp_path / "run")
    directory.path.mkdir()
    directory.lock.touch()
    ask = "import fcntl, sys; lock = open(sys.argv[1], 'rb'); fcntl.lockf(lock, fcntl.LOCK_SH)"
    command = [sys.executable, "-S", "-c", f"{ask}; print(flush=True); input()", str(directory.lock)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as asking:
        asking.stdout.readline()
        monkeypatch.setattr("torchrl_etdmpc.runs.directory.time.sleep", lambda _: asking.communicate(b"\n"))
        directory.begin(CONFIG)


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="becomes another user")
def test_another_user_sees_that_a_run_is_alive(in_copy):
    def look() -> None:
        os.setuid(65_534)
        assert RunDirectory(directory.path).in_use

    with tempfile.TemporaryDirectory() as folder:  # pytest's own are closed to others
        os.chmod(folder, 0o755)
        directory = RunDirectory(Path(folder) / "run")
        directory.begin(CONFIG)
        assert in_copy(look) == 0
        directory.close()


def test_a_directory_that_nobody_holds_on_to_is_unlocked(tmp_path, elsewhere):
    RunDirectory(tmp_path / "run").begin(CONFIG)
    gc.collect()
    assert elsewhere(lambda: RunDirectory(tmp_path / "run").go_on()) is None


def test_a_lock_that_its_owner_removed_in_the_last_moment_is_taken_again(tmp_path, monkeypatch):
    fcntl = pytest.importorskip("fcntl")
    lockf, calls = fcntl.lockf, []

    def removed_first(*args):
        calls.append(args)
        if len(calls) == 1:
            (tmp_path / ".lock").unlink()  # as the owner does between our opening the file and locking it
        return lockf(*args)

    monkeypatch.setattr(fcntl, "lockf", removed_first)
    directory = RunDirectory(tmp_path)
    directory.begin(CONFIG)
    assert len(calls) == 2
    assert os.fstat(calls[1][0]).st_ino == (tmp_path / ".lock").stat().st_ino
    directory.close()
    assert [path.name for path in tmp_path.iterdir()] == ["config.yaml"]


def test_a_lock_is_removed_before_it_is_let_go(begun, monkeypatch):
    """Afterwards the file may be that of another process, which would lose it."""
    close, there = os.close, []

    def watched(descriptor: int) -> None:
        there.append(begun.lock.exists())
        close(descriptor)

    monkeypatch.setattr(os, "close", watched)
    begun.close()
    assert there == [False]


def test_a_file_system_without_locks_does_without(tmp_path, monkeypatch):
    fcntl = pytest.importorskip("fcntl")

    def no_locks(*_):
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "lockf", no_locks)
    directory = RunDirectory(tmp_path / "run")
    directory.begin(CONFIG)
    assert directory.read_config() == CONFIG
    assert not directory.in_use


ROW = "env_steps,decision_steps,updates,wall_time_s,return_mean\n{},0,0,1.0,3.5\n"


def leave_behind(directory: RunDirectory, **files: str) -> None:
    """What a killed process leaves; the first words of a name are the folders."""
    directory.path.mkdir(exist_ok=True)
    directory.config.write_text(yaml.safe_dump(CONFIG))
    for name, text in files.items():
        file = directory.path.joinpath(*name.split("__")[:-1], name.split("__")[-1].replace("_", "."))
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)


@pytest.mark.parametrize(
    "files",
    [
        {},
        {"eval_csv": ROW.format(0), "train_csv": ""},
        {"checkpoints__resume__000000000000__manifest_json": "{}", "checkpoints__best_pt": "", "checkpoints__a_pt": ""},
        {"checkpoints__resume__.000000000000.old__manifest_json": "{}"},
        {"tensorboard__events": "", "curve_png": ""},
    ],
    ids=["configuration", "first evaluation", "first checkpoint", "the same moved aside", "loggers and curve"],
)
def test_a_run_that_made_no_step_is_taken_over(tmp_path, files):
    directory = RunDirectory(tmp_path / "run")
    leave_behind(directory, notes_txt="mine", **files)
    assert (directory.holds_a_run, directory.leftover) == (True, True)
    directory.begin(CONFIG | {"seed": 2})
    assert directory.read_config()["seed"] == 2
    directory.close()
    assert {path.name for path in directory.path.iterdir()} == {"config.yaml", "notes.txt"}


def test_a_process_that_is_killed_while_it_takes_a_run_over_leaves_one_that_is_taken_over(tmp_path, killed_at):
    directory, files = RunDirectory(tmp_path / "run"), {"eval_csv": ROW.format(0), "checkpoints__best_pt": ""}
    for moment in count(1):
        leave_behind(directory, **files)
        killed = killed_at(lambda: RunDirectory(directory.path).begin(CONFIG), moment)
        assert directory.leftover or not directory.holds_a_run
        directory.begin(CONFIG)
        directory.close()
        if not killed:
            break
    assert moment > 5


def test_a_new_run_is_another_one_for_wandb_than_the_leftover_before_it(begun):
    begun.wandb_id.write_text("1234")
    begun.close()
    RunDirectory(begun.path).begin(CONFIG)
    assert not begun.wandb_id.exists()


@pytest.mark.parametrize(
    "files",
    [
        {"eval_csv": ROW.format(1000)},
        {"train_csv": ROW.format(1)},
        {"eval_csv": "my,own,table\n1,2,3\n"},
        {"eval_csv": "env_steps\nmany\n"},
        {"eval_csv": "a,env_steps\n1\n"},
        {"eval_csv": "a,env_steps\n" + "1" * 200_000 + ",0\n"},  # more than Python's reader takes
        {"summary_json": "{}"},
        {"checkpoints__resume__000000000050__manifest_json": "{}"},
        {"checkpoints__resume__.000000000050.old__manifest_json": "{}"},
        {"config_yaml": "my: own"},
        {"config_yaml": "- a list"},
        {"config_yaml": "3"},
        {"config_yaml": "\x00"},
    ],
)
def test_what_may_be_results_or_somebody_else_s_is_not_taken_over(tmp_path, files):
    directory = RunDirectory(tmp_path / "run")
    leave_behind(directory, **files)
    before = snapshot(directory.path)
    assert not directory.leftover
    with pytest.raises(FileExistsError, match="already holds a run"):
        directory.begin(CONFIG)
    assert snapshot(directory.path) == before


@pytest.mark.parametrize("name", ["last_agent", "best_agent"])
@pytest.mark.parametrize("env_steps", [0, 50])
def test_an_agent_that_learned_is_a_result_also_without_tables(tmp_path, name, env_steps):
    directory = RunDirectory(tmp_path / "run")
    leave_behind(directory)
    agent = getattr(directory, name)
    agent.parent.mkdir()
    torch.save({"counters": {"env_steps": env_steps}}, agent)
    assert directory.leftover == (env_steps == 0)


def test_an_abandoned_run_leaves_nothing_behind(tmp_path):
    directory = RunDirectory(tmp_path / "runs" / "walker")
    directory.begin(CONFIG)
    directory.eval.write_text(ROW.format(0))
    (directory.checkpoints / "resume").mkdir(parents=True)
    directory.abandon()
    assert list(tmp_path.iterdir()) == []


def test_an_abandoned_run_leaves_what_it_did_not_make(begun):
    (begun.path / "notes.txt").write_text("mine")
    begun.abandon()
    assert [path.name for path in begun.path.iterdir()] == ["notes.txt"]
    RunDirectory(begun.path).begin(CONFIG)


OWN = ["config.yaml", "eval.csv", "train.csv", "curve.png", ".lock", "wandb_id", "tensorboard", "tensorboard/events"]
OWN += ["checkpoints", "checkpoints/replay", "checkpoints/resume", "checkpoints/last.pt"]
OWN += ["checkpoints/resume/000000000100/agent.pt"]


@pytest.mark.parametrize("kind", ["link", "link to nowhere", "pipe"])
@pytest.mark.parametrize("name", OWN)
def test_a_link_or_a_pipe_in_place_of_a_file_is_refused_and_nothing_elsewhere_changes(tmp_path, name, kind):
    directory, victim, path = RunDirectory(tmp_path / "run"), tmp_path / "victim", tmp_path / "run" / name
    directory.path.mkdir()
    directory.config.write_text(yaml.safe_dump(CONFIG))
    path.parent.mkdir(parents=True, exist_ok=True)
    victim.mkdir() if "." not in name[1:] else victim.write_text(yaml.safe_dump(CONFIG))
    path.unlink(missing_ok=True)
    os.mkfifo(path) if kind == "pipe" else path.symlink_to(victim if kind == "link" else tmp_path / "nowhere")
    before = snapshot(tmp_path)
    for use in (directory.go_on, lambda: directory.begin(CONFIG)):
        with pytest.raises((OSError, ValueError)) as caught:
            use()
        assert "\n" not in str(caught.value)
    assert snapshot(tmp_path) == before
    assert os.path.lexists(path)
    if name != "config.yaml":
        with pytest.raises(OSError, match=f"^{path} is a link or a special file, through which a run would change so"):
            directory.go_on()


def test_the_directory_itself_may_be_a_link(tmp_path):
    (tmp_path / "disk").mkdir()
    (tmp_path / "run").symlink_to(tmp_path / "disk")
    RunDirectory(tmp_path / "run").begin(CONFIG)
    assert (tmp_path / "disk" / "config.yaml").exists()


@pytest.mark.parametrize(
    "text", ["a: &a [x]\nb: [*a, *a]", "a: &a\n  b: *a", "x" * 2**21, "[" * 5000, "a: \x00", "a: [1", "\xff\xfe"]
)
def test_what_is_no_configuration_is_refused_in_one_line_and_quickly(tmp_path, text):
    directory = RunDirectory(tmp_path)
    directory.config.write_text(text, encoding="latin-1")
    with pytest.raises(ValueError, match=rf"^{directory.config} is not a configuration: .{{5,200}}$"):
        directory.read_config()


def test_a_configuration_that_changed_is_stored_and_another_left_alone(begun):
    begun.close()
    before = begun.config.stat()
    begun.go_on()
    begun.write_config(CONFIG)
    assert (begun.config.stat().st_ino, begun.config.stat().st_mtime_ns) == (before.st_ino, before.st_mtime_ns)
    begun.write_config(CONFIG | {"seed": 2})
    assert begun.read_config() == CONFIG | {"seed": 2}


def test_a_configuration_that_somebody_changed_is_refused(begun):
    begun.config.write_text(begun.config.read_text().replace("seed: 1", "seed: 2"))
    with pytest.raises(ValueError, match=r"yaml is not a configuration: it is not what the run wrote; settings are ch"):
        begun.read_config()


def test_there_must_be_a_run_to_go_on_with(tmp_path):
    directory = RunDirectory(tmp_path / "run")
    for look in (directory.read_config, lambda: directory.go_on()):
        with pytest.raises(FileNotFoundError) as caught:
            look()
        assert str(caught.value) == f"run_dir={directory} holds no run to go on with; start it with resume=off."
    assert list(tmp_path.iterdir()) == []


def test_a_summary_ends_a_run(begun):
    begun.summary.write_text("{}")
    assert begun.finished
