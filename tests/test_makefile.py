from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
pytestmark = pytest.mark.skipif(
    shutil.which("make") is None or not (ROOT / "Makefile").exists(), reason="needs make and a full checkout"
)


# Nothing of a `make test` around them.
ENVIRONMENT = {name: value for name, value in os.environ.items() if not name.startswith(("MAKE", "MFLAGS"))}


def make(*typed: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(["make", *typed], cwd=ROOT, env=ENVIRONMENT, capture_output=True, text=True)


def training_command(*typed: str) -> list[str]:
    """What ``make train`` would run."""
    result = make("-n", "train", "THREADS=2", *typed)
    (line,) = (line for line in result.stdout.splitlines() if "train_dmc.py" in line)
    return line.split("train_dmc.py ")[1].split()


@pytest.fixture(params=["a run", "one"])
def run_dir(request, tmp_path):
    folder = tmp_path / request.param
    folder.mkdir()
    (folder / "config.yaml").touch()
    return folder


def test_a_new_run_has_the_settings_of_the_makefile_and_those_that_were_typed():
    command = training_command("RUN_DIR=runs/none", "ARGS=seed=2")
    assert command[:3] == ["task=walker-stand", "preset=cpu", "threads=2"]
    assert command[-2:] == ['run_dir="runs/none"', "seed=2"]
    # Without a run, going on is an error that the command words.
    assert "total_env_steps=20000" in training_command("RUN_DIR=runs/none", "ARGS=resume=true")


@pytest.mark.parametrize("how", ["true", "auto", "weights"])
def test_a_run_that_goes_on_keeps_its_own_settings(run_dir, how):
    typed = [f"RUN_DIR={run_dir}", f"ARGS=resume={how} total_env_steps=50000"]
    end = [*f'run_dir="{run_dir}"'.split(), f"resume={how}", "total_env_steps=50000"]
    assert training_command(*typed) == ["threads=2", *end]
    assert training_command("TASK=cup-catch", *typed) == ["task=cup-catch", "threads=2", *end]
    assert "seed=1" in training_command(f"RUN_DIR={run_dir}", "ARGS=resume=off")


@pytest.mark.parametrize(("target", "message"), [("watch", "holds no trained agent"), ("report", "there is no")])
def test_what_needs_a_run_says_how_to_make_one(tmp_path, target, message):
    venv = tmp_path / "venv"
    venv.mkdir()
    (venv / ".ready").touch()
    result = make(target, f"VENV={venv}", f"RUN_DIR={tmp_path}/none", "TASK=cup-catch")
    assert result.returncode != 0
    assert f"error: {tmp_path}/none {message}" in result.stderr or f"error: {message} {tmp_path}/none" in result.stderr
    assert f'run make train RUN_DIR="{tmp_path}/none" first' in result.stderr
