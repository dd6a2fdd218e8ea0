"""Training processes that are killed, asked to stop and started again."""

from __future__ import annotations

import contextlib
import csv
import fcntl
import json
import os
import random
import signal
import subprocess
import sys
import termios
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

pytest.importorskip("dm_control")
pytest.importorskip("hydra")

from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer  # noqa: E402

from torchrl_etdmpc.checkpoints import ReplayJournal  # noqa: E402
from torchrl_etdmpc.training import EXIT_CODE  # noqa: E402

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")

COMMAND = (
    "preset=cpu seed=3 device=cpu threads=1 compile=off total_env_steps=300 log_every=40 "
    "task.episode_length=100 eval_every=150 eval_episodes=1 checkpoint_every=30 "
    "model.latent_dim=16 model.mlp_dim=16 model.encoder_dim=16 "
    "planner.horizon=2 planner.num_samples=8 planner.num_elites=4 planner.num_proposals=2 planner.iterations=1 "
    "reanalyze.num_samples=6 reanalyze.num_elites=3 reanalyze.iterations=1 optim.batch_size=4 "
    "replay.seed_decisions=40 replay.pretrain_updates=4"
).split()


@pytest.fixture(scope="module")
def train(start) -> Callable[..., Any]:
    """Starts the run in a folder."""

    def begin(cwd: Path, *arguments: str, task: str = "cartpole-balance") -> Any:
        script = "train.py" if task.startswith("gym/") else "train_dmc.py"
        return start(script, f"task={task}", *COMMAND, *arguments, cwd=cwd)

    return begin


def finish(process: Any, code: int = 0) -> str:
    out, err = process.communicate(timeout=300)
    assert process.returncode == code, err
    return out + err


def wait_for(condition: Callable[[], bool], process: Any) -> None:
    limit = time.monotonic() + 120
    while not condition():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < limit
        time.sleep(0.01)


def checkpoints(run_dir: Path) -> list[str]:
    """Without the one before the first step."""
    return sorted(path.name for path in (run_dir / "checkpoints" / "resume").glob("[0-9]*[1-9]*"))


def results(run_dir: Path) -> dict[str, object]:
    """Curves without their wall times, weights and the buffer."""

    def rows(name: str) -> list[dict[str, str]]:
        with (run_dir / name).open(newline="") as file:
            return [{key: value for key, value in row.items() if key != "wall_time_s"} for row in csv.DictReader(file)]

    content = torch.load(run_dir / "checkpoints" / "last.pt", weights_only=True)
    weights = {name: value.tolist() for name, value in content["loss"].items()}
    manifest = json.loads((run_dir / "checkpoints" / "resume" / checkpoints(run_dir)[-1] / "manifest.json").read_text())
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(manifest["replay"]["capacity"]))
    ReplayJournal(run_dir / "checkpoints" / "replay").load(buffer, manifest["replay"])
    stored = buffer[:]
    replay = {str(key): stored[key].tolist() for key in stored.keys(True, True)}
    return {"train": rows("train.csv"), "eval": rows("eval.csv"), "weights": weights, "replay": replay}


@pytest.fixture(scope="module")
def straight(tmp_path_factory, train) -> dict[str, object]:
    """The results of a run without interruptions."""
    directory = tmp_path_factory.mktemp("straight")
    finish(train(directory, "run_dir=run"))
    return results(directory / "run")


def kill_and_go_on(
    train: Callable[..., Any], directory: Path, kills: int, seed: int, *arguments: str, **task: str
) -> None:
    """Kills the process at random moments, mostly between checkpoints and sometimes while one is written."""
    moments = random.Random(seed)
    run_dir, codes = directory / "run", []
    for _ in range(kills):
        process = train(directory, "run_dir=run", "resume=auto", *arguments, **task)
        before = checkpoints(run_dir)
        with contextlib.suppress(AssertionError):  # it may finish before it is killed
            wait_for(lambda known=before: checkpoints(run_dir) != known, process)
        time.sleep(moments.uniform(0, 0.3))
        process.kill()
        process.communicate()
        codes.append(process.returncode)
    assert -signal.SIGKILL in codes
    finish(train(directory, "run_dir=run", "resume=auto", *arguments, **task))


def test_a_run_that_is_killed_before_its_first_step_and_later_ends_as_if_it_had_not_been(tmp_path, train, straight):
    process = train(tmp_path, "run_dir=run", "resume=auto")
    wait_for((tmp_path / "run" / "eval.csv").exists, process)
    process.kill()
    process.communicate()
    assert checkpoints(tmp_path / "run") == []
    kill_and_go_on(train, tmp_path, kills=2, seed=0)
    assert results(tmp_path / "run") == straight


@pytest.mark.parametrize("num_envs", [1, pytest.param(3, marks=pytest.mark.slow)])
def test_a_run_on_a_task_that_terminates_is_exact_too(num_envs, tmp_path, train):
    pytest.importorskip("gymnasium")
    pytest.importorskip("mujoco")
    (tmp_path / "straight").mkdir()
    (tmp_path / "killed").mkdir()
    task, *arguments = "gym/InvertedPendulum-v5", f"num_envs={num_envs}", f"total_env_steps={num_envs * 180}"
    finish(train(tmp_path / "straight", "run_dir=run", *arguments, task=task))
    kill_and_go_on(train, tmp_path / "killed", 1, 0, *arguments, task=task)
    straight = results(tmp_path / "straight" / "run")
    assert results(tmp_path / "killed" / "run") == straight
    assert sum(flag for (flag,) in straight["replay"]["('next', 'terminated')"]) > 10  # the head had something to learn
    assert any(name.startswith("termination_params.") for name in straight["weights"])


@pytest.mark.slow
@pytest.mark.parametrize("arguments", [("compile=off",), ("compile=default",), ("num_envs=3",)], ids=" ".join)
def test_a_run_that_is_killed_twenty_times_ends_as_if_it_had_not_been(tmp_path, train, arguments):
    (tmp_path / "straight").mkdir()
    (tmp_path / "killed").mkdir()
    finish(train(tmp_path / "straight", "run_dir=run", *arguments))
    kill_and_go_on(train, tmp_path / "killed", 20, 1, *arguments)
    assert results(tmp_path / "killed" / "run") == results(tmp_path / "straight" / "run")


@pytest.mark.parametrize(
    "number",
    [signal.SIGTERM, *(pytest.param(number, marks=pytest.mark.slow) for number in (signal.SIGINT, signal.SIGUSR1))],
    ids=lambda number: number.name,
)
def test_a_run_that_is_asked_to_stop_saves_and_goes_on_later(tmp_path, train, straight, number):
    process = train(tmp_path, "run_dir=run")
    wait_for(lambda: len(checkpoints(tmp_path / "run")) > 0, process)
    process.send_signal(number)
    tick = time.monotonic()
    text = finish(process, EXIT_CODE)
    assert time.monotonic() - tick < 30
    assert "env steps and saved in run; go on with resume=true." in text
    assert "Traceback" not in text
    finish(train(tmp_path, "run_dir=run", "resume=true"))
    assert results(tmp_path / "run") == straight


@pytest.mark.slow  # six worker processes, half a minute
def test_a_signal_that_reaches_the_environments_too_is_left_to_the_run(tmp_path, train):
    (tmp_path / "straight").mkdir()
    finish(train(tmp_path / "straight", "run_dir=run", "num_envs=2"))
    process = train(tmp_path, "run_dir=run", "num_envs=2")
    wait_for(lambda: len(checkpoints(tmp_path / "run")) > 0, process)
    os.killpg(process.pid, signal.SIGINT)  # as Ctrl-C does, and job schedulers
    assert "env steps and saved in run; go on with resume=true." in finish(process, EXIT_CODE)
    finish(train(tmp_path, "run_dir=run", "resume=true"))
    assert results(tmp_path / "run") == results(tmp_path / "straight" / "run")


@pytest.mark.slow  # five worker processes, and imports from the beginning
def test_a_run_whose_terminal_is_closed_is_saved_and_goes_on_later(tmp_path, train):
    (tmp_path / "straight").mkdir()
    finish(train(tmp_path / "straight", "run_dir=run", "num_envs=2"))
    screen, terminal = os.openpty()

    def take_the_terminal() -> None:
        fcntl.ioctl(0, termios.TIOCSCTTY, 0)
        signal.signal(signal.SIGHUP, signal.SIG_DFL)  # also where the tests were started by nohup

    script = Path(__file__).parents[2] / "examples" / "train_dmc.py"
    process = subprocess.Popen(
        [sys.executable, str(script), "task=cartpole-balance", *COMMAND, "run_dir=run", "num_envs=2"],
        cwd=tmp_path,
        stdin=terminal,
        stdout=terminal,
        stderr=terminal,
        start_new_session=True,
        preexec_fn=take_the_terminal,
    )
    os.close(terminal)
    wait_for(lambda: len(checkpoints(tmp_path / "run")) > 0, process)
    os.close(screen)  # the system signals all processes of the session
    assert process.wait(60) == EXIT_CODE
    for _ in range(100):
        left = subprocess.run(["pgrep", "-l", "-g", str(process.pid)], capture_output=True, text=True, check=False)
        if not left.stdout:
            break
        time.sleep(0.1)
    assert left.stdout == ""
    finish(train(tmp_path, "run_dir=run", "resume=true", "num_envs=2"))
    assert results(tmp_path / "run") == results(tmp_path / "straight" / "run")


@pytest.mark.slow  # four worker processes, and imports from the beginning
def test_a_signal_that_reaches_environments_that_are_just_starting(tmp_path):
    # A process of a shell's: those of `train` are forked, and so would be its workers.
    script = Path(__file__).parents[2] / "examples" / "train_dmc.py"
    process = subprocess.Popen(
        [sys.executable, str(script), "task=cartpole-balance", "num_envs=4", *COMMAND, "run_dir=run"],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),  # also in the background
    )
    workers = ["pgrep", "-g", str(process.pid), "-f", "spawn_main"]
    wait_for(lambda: subprocess.run(workers, stdout=subprocess.DEVNULL, check=False).returncode == 0, process)
    os.killpg(process.pid, signal.SIGINT)
    text = finish(process, EXIT_CODE)
    assert "stopped before the first step" in text
    assert "Traceback" not in text


def test_another_process_is_kept_out_until_a_second_signal_ends_the_first_at_once(tmp_path, train, straight):
    process = train(tmp_path, "run_dir=run")
    wait_for(lambda: len(checkpoints(tmp_path / "run")) > 0, process)
    process.send_signal(signal.SIGSTOP)
    text = finish(train(tmp_path, "run_dir=run", "resume=true"), 1)
    assert "error: run_dir=run is in use by another process; wait for it or choose another run_dir." in text
    # Both arrive before the step is finished.
    process.send_signal(signal.SIGTERM)
    process.send_signal(signal.SIGINT)
    process.send_signal(signal.SIGCONT)
    out, err = process.communicate(timeout=30)
    assert process.returncode in {128 + signal.SIGTERM, 128 + signal.SIGINT}, err
    assert "again: stopping at once; the last checkpoint stays." in err
    finish(train(tmp_path, "run_dir=run", "resume=true"))
    assert results(tmp_path / "run") == straight
