"""The script for SLURM: bash reads it, and its body does what it should under a stand-in for sbatch's environment."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import shlex
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from torchrl_etdmpc.suites import slurm, write_slurm_script
from torchrl_etdmpc.suites.attempt import last_verdict, log_file

pytestmark = pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")


@pytest.fixture
def submit(tmp_path, monkeypatch):
    """Starts an index of the array as SLURM does: its variables are set, and `scontrol` is there."""
    tools = tmp_path / "tools"
    tools.mkdir()
    (tools / "scontrol").write_text(f'#!/bin/sh\necho "$@" >> {shlex.quote(str(tmp_path / "requeued"))}\n')
    (tools / "scontrol").chmod(0o755)

    def start(script, index: int) -> subprocess.Popen:
        environment = {
            **os.environ,
            "PATH": f"{tools}:{os.environ['PATH']}",
            "SLURM_ARRAY_JOB_ID": "70",
            "SLURM_ARRAY_TASK_ID": str(index),
            "SLURM_JOB_ID": str(71 + index),
            "SLURM_CPUS_PER_TASK": "3",
        }
        return subprocess.Popen(["bash", str(script)], env=environment, cwd=tools)  # wherever the node begins

    return start


def requeued(tmp_path) -> list[str]:
    file = tmp_path / "requeued"
    return file.read_text().splitlines() if file.exists() else []


def written(small, tmp_path, **options):
    folder = tmp_path / "runs of 'mine'"
    folder.mkdir(exist_ok=True)
    runs = small.experiment(seeds=(1, 2, 3)).runs(folder)
    return runs, write_slurm_script(runs, folder, "mine", **options)


def table_of(script) -> Path:
    (line,) = (line for line in script.read_text().splitlines() if line.startswith("eval "))
    return Path(shlex.split(line.rpartition('p" ')[2].removesuffix(')"'))[0])


def begun(run) -> None:
    deadline = time.monotonic() + 30
    while not (run.path / "eval.csv").exists() and time.monotonic() < deadline:
        time.sleep(0.01)


def test_bash_reads_it_and_the_options_are_there(small, tmp_path):
    runs, script = written(small, tmp_path, sbatch="--partition=gpu --gres=gpu:1 --comment='two words'", workers=2)
    checked = subprocess.run(["bash", "-n", str(script)], capture_output=True, text=True, check=False)
    assert (checked.returncode, checked.stderr) == (0, "")
    options = [shlex.split(line)[1] for line in script.read_text().splitlines() if line.startswith("#SBATCH")]
    assert options == [
        "--job-name=mine",
        "--array=0-2%2",
        "--requeue",
        "--open-mode=append",
        "--signal=B:USR1@120",
        f"--output={script.parent}/slurm-%A_%a.out",
        "--partition=gpu",
        "--gres=gpu:1",
        "--comment=two words",
    ]
    lines = [shlex.split(line) for line in table_of(script).read_text().splitlines()]
    assert [line[0] for line in lines] == [str(log_file(run)) for run in runs]
    assert all(line[1:6] == [sys.executable, "-P", "-m", "torchrl_etdmpc.commands", "train"] for line in lines)
    assert not any("SLURM_CPUS_PER_TASK" in word for line in lines for word in line)  # they say their own threads


def test_a_script_that_waits_keeps_its_table_when_another_part_is_written(small, tmp_path):
    runs, script = written(small, tmp_path)
    table = table_of(script)  # SLURM keeps the script as it was submitted
    before = table.read_text()
    write_slurm_script(runs[1:], script.parent, "the rest")
    assert table.read_text() == before
    assert table_of(script).read_text().splitlines() == before.splitlines()[1:]


@pytest.mark.parametrize("sbatch", ["--time='1", "gpu", "--a=1 b", "'--a=1\nrm'"])
def test_what_is_no_option_is_refused(small, tmp_path, sbatch):
    with pytest.raises(ValueError, match="sbatch must hold options "):
        written(small, tmp_path, sbatch=sbatch)


def test_a_path_that_a_line_cannot_hold_is_refused(small, tmp_path):
    runs = small.experiment().runs(tmp_path / "two\nlines")
    with pytest.raises(ValueError, match="a path or a setting holds a line break, which the table of commands cannot"):
        write_slurm_script(runs, tmp_path, "mine")


def test_an_index_trains_its_run_with_the_cores_that_it_has(small, tmp_path, stand_in, submit, monkeypatch):
    from torchrl_etdmpc.suites import slurm

    told = (
        "import os, sys, pathlib; words = os.environ['OMP_NUM_THREADS'], sys.argv[2], os.getcwd(); "
        "pathlib.Path(sys.argv[1]).write_text(' '.join(words))"
    )
    monkeypatch.setattr(slurm, "command", lambda run: [sys.executable, "-S", "-c", told, str(run.path / "told")])
    runs = small.experiment(settings=small.settings | {"threads": None}, seeds=(1, 2)).runs(tmp_path)
    script = write_slurm_script(runs, tmp_path, "mine")
    assert submit(script, 1).wait() == 0
    assert (runs[1].path / "told").read_text() == f"3 threads=3 {Path.cwd()}"  # paths of one's own are from here
    assert not runs[0].path.exists()


@pytest.fixture
def stand_in_script(small, tmp_path, stand_in, monkeypatch):
    from torchrl_etdmpc.suites import attempt, slurm

    def write(plans, **options):
        stand_in(plans)
        monkeypatch.setattr(slurm, "command", attempt.command)
        return written(small, tmp_path, **options)

    return write


def test_a_run_that_finishes_is_done(stand_in_script, submit, small, tmp_path):
    runs, script = stand_in_script({})
    process = submit(script, 2)
    assert process.wait() == 0
    assert [small.tries(run) for run in runs] == [0, 0, 1]
    assert small.log_of(runs[2]) == ["suite: begun"]
    assert requeued(tmp_path) == []


def test_a_run_that_fails_is_tried_again_and_then_named(stand_in_script, submit, small, tmp_path):
    runs, script = stand_in_script({"": [("fail", 0)]}, retries=2)
    process = submit(script, 0)
    assert process.wait() == 1
    assert small.tries(runs[0]) == 3
    assert last_verdict(runs[0]) == ("failed", "the simulator is gone")
    assert requeued(tmp_path) == []


def test_a_run_that_fails_is_tried_again_as_long_as_it_gets_further(stand_in_script, submit, small):
    runs, script = stand_in_script({"": [("fail", 100), ("fail", 200), ("fail", 300), ("finish", 400)]}, retries=0)
    assert submit(script, 0).wait() == 0
    assert small.tries(runs[0]) == 4


def test_a_run_that_fails_at_the_same_step_again_and_again_is_given_up(stand_in_script, submit, small):
    runs, script = stand_in_script({"": [("fail", 100)] * 5 + [("finish", 400)]}, retries=1)
    assert submit(script, 0).wait() == 1
    assert small.tries(runs[0]) == 3  # the first one got further than nothing


@contextlib.contextmanager
def locked(run):
    """As if another process trained it."""
    run.path.mkdir(parents=True, exist_ok=True)
    with open(run.path / ".lock", "w") as lock:
        fcntl.lockf(lock, fcntl.LOCK_EX)
        yield


def test_a_run_that_another_process_trains_is_waited_for(stand_in_script, submit, small, tmp_path, monkeypatch):
    monkeypatch.setattr(slurm, "_LOOK_AGAIN_S", 0.05)
    runs, script = stand_in_script({}, retries=0)
    with locked(runs[0]):
        process = submit(script, 0)
        deadline = time.monotonic() + 30
        while not log_file(runs[0]).exists() or small.log_of(runs[0]).count("suite: begun") < 3:
            assert time.monotonic() < deadline
            time.sleep(0.01)
        assert process.poll() is None and small.tries(runs[0]) == 0
    assert process.wait(30) == 0
    assert small.tries(runs[0]) == 1
    assert requeued(tmp_path) == []


def test_a_job_that_waits_for_another_process_leaves_when_it_is_told(stand_in_script, submit, small, tmp_path):
    runs, script = stand_in_script({}, retries=0)
    with locked(runs[0]):
        process = submit(script, 0)
        deadline = time.monotonic() + 30
        while not log_file(runs[0]).exists() or "in use" not in log_file(runs[0]).read_text():
            assert time.monotonic() < deadline
            time.sleep(0.01)
        time.sleep(0.2)
        process.send_signal(signal.SIGUSR1)
        assert process.wait(30) == 75
    assert requeued(tmp_path) == ["requeue 71"]
    assert last_verdict(runs[0]) is None


def test_what_the_script_says_stands_behind_a_line_that_was_left_open(stand_in_script, submit, small):
    runs, script = stand_in_script({"": [("fail", 0)]}, retries=0)
    runs[0].path.mkdir(parents=True, exist_ok=True)
    log_file(runs[0]).write_text("compiling: 40%")
    assert submit(script, 0).wait() == 1
    assert small.log_of(runs[0])[:2] == ["compiling: 40%", "suite: begun"]
    assert last_verdict(runs[0]) == ("failed", "the simulator is gone")


def test_a_run_that_is_killed_is_tried_again(stand_in_script, submit, small):
    runs, script = stand_in_script({"": [("kill", 100), ("fail", 100), ("finish", 400)]})
    assert submit(script, 0).wait() == 0
    assert small.tries(runs[0]) == 3


def test_before_the_time_is_up_the_run_saves_itself_and_is_queued_again(stand_in_script, submit, small, tmp_path):
    runs, script = stand_in_script({"": [("wait", 100), ("finish", 400)]})
    # The stand-in knows SIGTERM; USR1 ends it at once, as it does a run that is still importing.
    process = submit(script, 1)
    begun(runs[1])
    process.send_signal(signal.SIGUSR1)
    assert process.wait(30) == 75
    assert requeued(tmp_path) == ["requeue 72"]
    assert last_verdict(runs[1]) is None
    again = submit(script, 1)
    assert again.wait() == 0
    assert json.loads((runs[1].path / "summary.json").read_text())["env_steps"] == 400


def test_a_run_that_leaves_by_itself_to_go_on_is_queued_again(stand_in_script, submit, tmp_path):
    runs, script = stand_in_script({"": [("wait", 100)]})
    process = submit(script, 0)
    begun(runs[0])
    pid = int(subprocess.run(["pgrep", "-P", str(process.pid)], capture_output=True, text=True, check=True).stdout)
    os.kill(pid, signal.SIGTERM)
    assert process.wait(30) == 75
    assert requeued(tmp_path) == ["requeue 71"]


def test_a_job_that_is_cancelled_saves_itself_and_stays_away(stand_in_script, submit, small, tmp_path):
    runs, script = stand_in_script({"": [("wait", 100)]})
    process = submit(script, 0)
    begun(runs[0])
    process.send_signal(signal.SIGTERM)
    assert process.wait(30) == 75
    assert requeued(tmp_path) == []
    assert small.tries(runs[0]) == 1


@pytest.mark.slow
def test_a_real_run_that_is_signalled_goes_on_to_the_end_of_one_left_alone(small, tmp_path, submit):
    evaluated = []
    for name, signalled in (("alone", False), ("signalled", True)):
        (tmp_path / name).mkdir()
        (run,) = small.experiment(budget=600).runs(tmp_path / name)
        script = write_slurm_script([run], tmp_path / name, name)
        process = submit(script, 0)
        if signalled:
            begun(run)
            process.send_signal(signal.SIGUSR1)
            assert process.wait(120) == 75
            assert requeued(tmp_path) == ["requeue 71"]
            process = submit(script, 0)
        assert process.wait(300) == 0
        rows = [line.split(",") for line in (run.path / "eval.csv").read_text().splitlines()]
        evaluated.append([[*row[:3], *row[4:]] for row in rows])  # without the wall time
    assert evaluated[0] == evaluated[1]
