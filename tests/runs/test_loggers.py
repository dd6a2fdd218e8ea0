from __future__ import annotations

import importlib.util
import math
from pathlib import Path

import pytest

from torchrl_etdmpc.runs import RunDirectory, RunLog, make_logger, require_logger

CONFIG = {"task": "walker-walk", "preset": "efficient-tdmpc-utd4", "seed": 1, "planner": {"horizon": 3, "lr": 3e-4}}
COUNTERS = {"env_steps": 1000, "decision_steps": 500, "updates": 400, "wall_time_s": 9.5}


def start(path: Path, logger: str) -> RunLog:
    directory = RunDirectory(path)
    directory.begin(CONFIG)
    log = RunLog(directory, total_env_steps=2000)
    log.logger = make_logger(logger, directory, CONFIG)
    return log


@pytest.mark.parametrize("check", [require_logger, lambda name: make_logger(name, RunDirectory("run"), CONFIG)])
def test_an_unknown_logger_is_refused(check):
    with pytest.raises(ValueError, match=r"^logger must be one of none, tensorboard, wandb, got 'csv'\.$"):
        check("csv")


def test_none_is_no_logger_and_needs_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    require_logger("none")
    assert make_logger("none", RunDirectory(tmp_path), CONFIG) is None
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("logger", ["tensorboard", "wandb"])
@pytest.mark.parametrize("check", [require_logger, lambda name: make_logger(name, RunDirectory("run"), CONFIG)])
def test_a_missing_package_is_named(monkeypatch, logger, check):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ImportError) as caught:
        check(logger)
    assert str(caught.value) == (f"logger={logger} needs {logger}, which is not installed; run `pip install {logger}`.")


def test_a_folder_called_wandb_does_not_pass_for_the_package(monkeypatch):
    namespace = importlib.util.spec_from_loader("wandb", loader=None, is_package=True)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: namespace)
    with pytest.raises(ImportError, match="logger=wandb needs wandb, which is not installed"):
        require_logger("wandb")


def test_tensorboard_holds_the_same_numbers_against_environment_steps(tmp_path):
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    log = start(tmp_path, "tensorboard")
    log.log_train({"loss_value": 0.25}, **COUNTERS)
    log.log_eval({"return_mean": 31.0, "return_std": math.nan, "episodes": 10}, **COUNTERS)
    log.finish({})
    events = EventAccumulator(str(log.directory.tensorboard)).Reload()
    counters = ["decision_steps", "updates", "wall_time_s"]
    expected = {f"train/{name}" for name in [*counters, "loss_value"]}
    expected |= {f"eval/{name}" for name in [*counters, "return_mean", "return_std", "episodes"]}
    assert set(events.Tags()["scalars"]) == expected
    assert [(event.step, event.value) for event in events.Scalars("train/loss_value")] == [(1000, 0.25)]
    assert [(event.step, event.value) for event in events.Scalars("eval/return_mean")] == [(1000, 31.0)]


@pytest.fixture
def no_account(tmp_path, monkeypatch):
    pytest.importorskip("wandb")
    for name in ("WANDB_API_KEY", "WANDB_MODE"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setenv("NETRC", str(tmp_path / "home" / "netrc"))


def test_wandb_works_offline_without_an_account(tmp_path, no_account):
    log = start(tmp_path / "run", "wandb")
    log.log_train({"loss_value": 0.25}, **COUNTERS)
    log.log_eval({"return_mean": 31.0, "return_std": 4.0, "episodes": 10}, **COUNTERS)
    log.finish({})
    (record,) = (tmp_path / "run" / "wandb").glob("offline-run-*/*.wandb")
    content = record.read_bytes()
    for key in (b"loss_value", b"return_mean", b"walker-walk"):
        assert key in content


def test_a_run_that_goes_on_is_the_same_one_for_wandb(tmp_path, no_account):
    log = start(tmp_path / "run", "wandb")
    known = log.directory.wandb_id.read_text()
    log.close()
    make_logger("wandb", log.directory, CONFIG).shutdown()
    assert log.directory.wandb_id.read_text() == known
    assert {path.name.split("-")[-1] for path in (tmp_path / "run" / "wandb").glob("offline-run-*")} == {known}
