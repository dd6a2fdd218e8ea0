"""Example scripts: in this process, or as processes of their own without the seconds that imports would take each."""

from __future__ import annotations

import multiprocessing
import os
import runpy
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from multiprocessing.forkserver import _forkserver  # the one of this process
from pathlib import Path

import pytest
import torch

from torchrl_etdmpc.training import TrainConfig, build_agent, save_agent

collect_ignore = ["script.py"]  # no test, and nothing to import
ROOT = Path(__file__).resolve().parents[2]
FORKS = multiprocessing.get_context("forkserver")
IMPORTS = (
    "torchrl_etdmpc.training torchrl_etdmpc.analysis torch._dynamo dm_control.suite gymnasium hydra.main "
    "matplotlib.pyplot pandas tqdm"
).split()


def shell_environment() -> dict[str, str]:
    """That of a user's shell: without what tests or a script in this process have set."""
    names = ("MUJOCO_GL", "HYDRA", "TORCHRL_ETDMPC")
    environment = {name: value for name, value in os.environ.items() if not name.startswith(names)}
    return environment | {"PYTHONPATH": str(ROOT / "src"), "OMP_NUM_THREADS": "1"}


class Script:
    """A script in a process of its own: the part of :class:`subprocess.Popen` that the tests use, and what it printed.

    It is forked from a process that has imported the libraries and done nothing else.
    """

    def __init__(self, script: str | Path, *arguments: str, cwd: Path) -> None:
        self._files = [Path(tempfile.mkstemp(suffix=".txt")[1]) for _ in range(2)]
        out, err = map(str, self._files)
        given = {
            "script": str(ROOT / "examples" / script),
            "arguments": arguments,
            "cwd": str(cwd),
            "environment": shell_environment(),
            "out": out,
            "err": err,
        }
        self._process = FORKS.Process(target=runpy.run_path, args=(str(Path(__file__).with_name("script.py")), given))
        self._process.start()
        self.pid = self._process.pid

    @property
    def returncode(self) -> int | None:
        return self._process.exitcode

    def poll(self) -> int | None:
        return self.returncode

    def printed(self) -> str:
        """Standard output so far."""
        return self._files[0].read_text()

    def communicate(self, timeout: float | None = None) -> tuple[str, str]:
        self._process.join(timeout)
        if self.returncode is None:
            raise subprocess.TimeoutExpired("script", timeout or 0)
        out, err = (file.read_text() if file.exists() else "" for file in self._files)
        return out, err

    def send_signal(self, number: int) -> None:
        os.kill(self.pid, number)

    def kill(self) -> None:
        self._process.kill()

    def terminate(self) -> None:
        self._process.terminate()

    def remove(self) -> None:
        if self._process.is_alive():
            os.killpg(self.pid, signal.SIGKILL)
        self._process.join()
        for file in self._files:
            file.unlink()


@pytest.fixture
def run_here(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture
) -> Iterator[Callable[..., tuple[str | None, str, str]]]:
    """Runs ``examples/<script>`` with arguments in this process, in an empty folder: exit message, stdout and stderr.

    What a script sets for its process is as it was afterwards.
    """
    precision, threads = torch.get_float32_matmul_precision(), torch.get_num_threads()
    monkeypatch.setenv("HYDRA_FULL_ERROR", "0")
    monkeypatch.setenv("MUJOCO_GL", os.environ.get("MUJOCO_GL", "disable"))
    monkeypatch.delenv("TORCHRL_ETDMPC_TRACEBACK", raising=False)
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.chdir(tmp_path)

    def run(script: str, *arguments: str) -> tuple[str | None, str, str]:
        path = str(ROOT / "examples" / script)
        monkeypatch.setattr(sys, "argv", [path, *arguments])
        message = None
        try:
            runpy.run_path(path, run_name="__main__")
        except SystemExit as stop:
            message = stop.code
        return message, *capfd.readouterr()

    yield run
    torch.set_float32_matmul_precision(precision)
    torch.set_num_threads(threads)


@pytest.fixture(scope="session")
def save_untrained() -> Callable[..., Path]:
    """Saves an untrained agent of small networks, as if 400 env steps had been made."""

    def save(folder: Path, observation_dim: int, **settings: object) -> Path:
        config = TrainConfig.from_dict(
            {
                "compile": "off",
                "model": {"latent_dim": 16, "mlp_dim": 16, "encoder_dim": 16, "num_dynamics": 2},
                "planner": {"horizon": 2, "num_samples": 12, "num_elites": 4, "num_proposals": 2, "iterations": 2},
                **settings,
            }
        )
        torch.manual_seed(0)
        agent = build_agent(config, observation_dim=observation_dim, action_dim=1)
        return save_agent(folder / "last.pt", agent, config, {"env_steps": 400})

    return save


@pytest.fixture(scope="session", autouse=True)
def _imports() -> None:
    before = dict(os.environ)
    os.environ.update(shell_environment(), MUJOCO_GL="disable")
    FORKS.set_forkserver_preload(IMPORTS)
    _forkserver.ensure_running()
    os.environ.clear()
    os.environ.update(before)


@pytest.fixture(scope="module")
def start() -> Iterator[Callable[..., Script]]:
    """Starts ``examples/<script>`` with arguments in a folder."""
    started: list[Script] = []

    def begin(script: str | Path, *arguments: str, cwd: Path) -> Script:
        started.append(Script(script, *arguments, cwd=cwd))
        return started[-1]

    yield begin
    for script in started:
        script.remove()


@pytest.fixture(scope="module")
def run_script(start: Callable[..., Script]) -> Callable[..., subprocess.CompletedProcess[str]]:
    """Runs ``examples/<script>`` with arguments in a folder, to its end."""

    def run(script: str | Path, *arguments: str, cwd: Path) -> subprocess.CompletedProcess[str]:
        process = start(script, *arguments, cwd=cwd)
        out, err = process.communicate(timeout=600)
        return subprocess.CompletedProcess([str(script), *arguments], process.returncode, out, err)

    return run


@pytest.fixture(scope="session")
def run_process() -> Callable[..., subprocess.CompletedProcess[str]]:
    """Runs Python with these arguments as a shell would, with all imports of its own."""

    def run(*arguments: str, cwd: Path) -> subprocess.CompletedProcess[str]:
        command, options = [sys.executable, *arguments], {"capture_output": True, "text": True, "timeout": 600}
        return subprocess.run(command, cwd=cwd, env=shell_environment(), check=False, **options)

    return run
