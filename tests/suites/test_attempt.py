"""One run in a process: its command says all of its settings, and its end is understood."""

from __future__ import annotations

import fcntl
import os
import signal
import subprocess
import sys

import pytest

from torchrl_etdmpc.commands import suite
from torchrl_etdmpc.suites import attempt, read_experiment, read_progress
from torchrl_etdmpc.suites.attempt import command, end, last_verdict, log_file, note, start
from torchrl_etdmpc.training import TrainConfig


@pytest.fixture
def parsed(monkeypatch):
    """What the command line of ``train`` makes of a command."""
    pytest.importorskip("hydra")
    from torchrl_etdmpc.commands import train

    monkeypatch.setenv("HYDRA_FULL_ERROR", "0")

    def parse(words: list[str]) -> TrainConfig:
        assert words[:5] == [sys.executable, "-P", "-m", "torchrl_etdmpc.commands", "train"]
        got: list[TrainConfig] = []
        monkeypatch.setattr(train, "train", got.append)
        monkeypatch.setattr(sys, "argv", ["torchrl-etdmpc train", *words[5:]])
        train.main()
        return got[0]

    return parse


def as_asked(run) -> TrainConfig:
    return TrainConfig.from_dict(run.config.to_dict() | {"run_dir": str(run.path), "resume": "auto"})


def assert_parsed_back(name: str, parsed, folder, variants: slice) -> None:
    runs = read_experiment(suite.EXPERIMENTS / f"{name}.yaml", seeds=[3]).runs(folder / "a folder, 'quoted'")
    for run in list({run.variant: run for run in runs}.values())[variants]:
        assert parsed(command(run)) == as_asked(run)


@pytest.mark.parametrize("name", ["utd", "cheap-reanalyze", "horizon"])
def test_the_command_of_a_variant_is_parsed_back_to_its_settings(name, parsed, tmp_path):
    assert_parsed_back(name, parsed, tmp_path, slice(-1, None))


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(file.stem for file in suite.EXPERIMENTS.glob("*.yaml")))
def test_the_command_of_every_variant_is_parsed_back_to_its_settings(name, parsed, tmp_path):
    assert_parsed_back(name, parsed, tmp_path, slice(None))


def test_settings_of_every_kind_are_parsed_back(parsed, small, tmp_path):
    variants = {
        "many": {
            "task.terminates": True,
            "task.action_repeat": 4,
            "checkpoint_minutes": None,
            "eval_policy": True,
            "optim.lr": 1.25e-7,
            "planner.scoring_dtype": "bfloat16",
            "replay.pretrain_updates": 0,
            "logger": "tensorboard",
        }
    }
    (run,) = small.experiment(variants=variants).runs(tmp_path)
    assert parsed(command(run)) == as_asked(run)
    assert parsed(command(run, threads=3)).threads == 3


def test_a_run_imports_nothing_of_the_folder_that_its_suite_was_begun_in(small, tmp_path):
    (tmp_path / "random.py").write_text("raise SystemExit('another module')")
    words = command(small.experiment().runs(tmp_path)[0])
    line = [*words[: words.index("train")], "--help"]
    asked = subprocess.run(line, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (asked.returncode, asked.stderr) == (0, "")


def test_a_run_begins_in_a_directory_of_its_own_with_its_own_threads_and_gpu(small, tmp_path, monkeypatch):
    (run,) = small.experiment(settings=small.settings | {"threads": None}).runs(tmp_path)
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    told = (
        "import os, sys; assert os.getsid(0) == os.getpid(); "  # Ctrl-C in the terminal does not reach it
        "print(os.environ['OMP_NUM_THREADS'], os.environ.get('CUDA_VISIBLE_DEVICES'), sys.argv[1:])"
    )
    monkeypatch.setattr(attempt, "command", lambda run, **more: [sys.executable, "-c", told, *map(str, more.values())])
    assert start(run, threads=2, gpu="3").wait() == 0
    assert small.log_of(run) == ["suite: begun", "2 3 ['2']"]
    (own,) = small.experiment(variants={"own": {"threads": 5}}).runs(tmp_path)
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    assert start(own, threads=2).wait() == 0
    assert small.log_of(own) == ["suite: begun", "7 None []"]  # it sets them itself


def test_the_end_of_a_process_is_understood(small, tmp_path):
    (run,) = small.experiment().runs(tmp_path)
    run.path.mkdir(parents=True)
    log_file(run).write_text("suite: begun\n12:00:00 learning\nerror: the simulator is gone\n")
    assert end(run, 1) == ("failed", "the simulator is gone")
    for code in (75, 130, -signal.SIGKILL, 128 + signal.SIGTERM):
        assert end(run, code) == ("stopped", f"exit code {code}")
    assert end(run, 0) == ("failed", "the simulator is gone")  # it says that it is done, and there is no summary
    small.write_finished(run)
    assert end(run, 0) == ("finished", "")
    log_file(run).unlink()
    assert end(run, 3) == ("failed", "exit code 3")


def test_a_directory_that_is_in_use_is_no_failure(small, tmp_path, in_copy):
    (run,) = small.experiment().runs(tmp_path)
    run.path.mkdir(parents=True)
    log_file(run).write_text(f"error: run_dir={run.path} is in use by another process; wait for it.\n")
    assert end(run, 1)[0] == "elsewhere"
    log_file(run).write_text("error: run_dir=... already holds a run\n")  # it began between our look and our start
    with open(run.path / ".lock", "w") as lock:
        fcntl.lockf(lock, fcntl.LOCK_EX)

        def other() -> None:
            assert end(run, 1)[0] == "elsewhere"

        assert in_copy(other) == 0
    assert end(run, 1)[0] == "failed"


def test_a_verdict_holds_until_the_next_process_begins(small, tmp_path, monkeypatch):
    (run,) = small.experiment().runs(tmp_path)
    assert last_verdict(run) is None
    note(run, "failed", "no such thing")
    assert last_verdict(run) == ("failed", "no such thing")
    note(run, "pruned", "below the median")
    assert last_verdict(run) == ("pruned", "below the median")
    monkeypatch.setattr(attempt, "command", lambda run: [sys.executable, "-S", "-c", ""])
    start(run).wait()
    assert last_verdict(run) is None


@pytest.mark.parametrize("table", ["eval.csv", "train.csv"])
def test_a_verdict_is_over_when_the_run_went_on_by_hand(small, tmp_path, table):
    (run,) = small.experiment().runs(tmp_path)
    small.write_tables(run, 200)
    note(run, "failed", "CUDA out of memory")
    assert read_progress(run).state == "failed"
    log = log_file(run).stat()
    os.utime(run.path / table, ns=(log.st_atime_ns, log.st_mtime_ns + 10**9))
    assert read_progress(run).state == "stopped"


def test_a_verdict_stands_behind_a_line_that_a_killed_process_left_open(small, tmp_path, monkeypatch):
    (run,) = small.experiment().runs(tmp_path)
    run.path.mkdir(parents=True)
    log_file(run).write_text("suite: begun\ncompiling: 40%")
    note(run, "failed", "exit code 134")
    assert last_verdict(run) == ("failed", "exit code 134")
    log_file(run).write_text("compiling: 40%")
    monkeypatch.setattr(attempt, "command", lambda run: [sys.executable, "-S", "-c", ""])
    start(run).wait()
    assert small.log_of(run) == ["compiling: 40%", "suite: begun"]


def test_a_verdict_that_cannot_be_written_ends_nothing(small, tmp_path):
    (run,) = small.experiment().runs(tmp_path)
    run.path.parent.mkdir(parents=True)
    run.path.write_text("a file where the directory should be")
    note(run, "failed", "no space left")
    assert last_verdict(run) is None
    with pytest.raises(OSError):
        start(run)


def test_the_last_line_of_a_long_or_strange_log_is_found(small, tmp_path):
    (run,) = small.experiment().runs(tmp_path)
    run.path.mkdir(parents=True)
    log_file(run).write_bytes(b"x" * 100_000 + b"\n\xff\xfe progress\r 50%\n" + b"error: at last\n\n  \n")
    assert end(run, 1) == ("failed", "at last")
