from __future__ import annotations

import csv
import importlib.util
import json
import math
import os
import struct
import sys
from pathlib import Path

import pytest
import torch
import yaml
from torchrl_etdmpc.training.curve import plot_curve
from torchrl_etdmpc.training.run_lock import lock_run, unlock_run
from torchrl_etdmpc.training.run_log import RunLog
from torchrl_etdmpc.training.versions import library_versions

from torchrl_etdmpc.training import run_log

CONFIG = {"task": "walker-walk", "preset": "efficient-tdmpc-utd4", "seed": 1, "planner": {"horizon": 3, "lr": 3e-4}}
COUNTERS = {"env_steps": 1000, "decision_steps": 500, "updates": 400, "wall_time_s": 9.5}


def create(run_dir: Path, **options) -> RunLog:
    return RunLog.create(run_dir, **{"config": CONFIG, "total_env_steps": 2000, **options})


def read_csv(path: Path) -> list[list[str]]:
    with open(path, newline="") as file:
        return list(csv.reader(file))


def snapshot(directory: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() if path.is_file() else b"" for path in directory.rglob("*")}


def png_size(path: Path) -> tuple[int, int]:
    header = path.read_bytes()[:24]
    assert header[:8] == b"\x89PNG\r\n\x1a\n"
    return struct.unpack(">II", header[16:24])


def test_create_writes_the_resolved_config_and_nothing_else(tmp_path):
    log = create(tmp_path / "runs" / "walker")
    assert sorted(path.name for path in log.run_dir.iterdir()) == [".lock", "config.yaml"]
    assert yaml.safe_load((tmp_path / "runs" / "walker" / "config.yaml").read_text()) == CONFIG


def test_create_accepts_an_existing_directory_without_a_run(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    create(tmp_path)
    assert (tmp_path / "notes.txt").read_text() == "mine"


@pytest.mark.parametrize("entry", ["config.yaml", "eval.csv", "train.csv", "summary.json", "checkpoints"])
def test_create_refuses_a_directory_that_holds_a_run_and_touches_nothing(tmp_path, entry):
    if entry == "checkpoints":
        (tmp_path / entry).mkdir()
    else:
        (tmp_path / entry).write_text("old")
    before = snapshot(tmp_path)
    with pytest.raises(FileExistsError) as caught:
        create(tmp_path)
    assert str(caught.value) == f"run_dir={tmp_path} already holds a run; choose another run_dir or remove it."
    assert snapshot(tmp_path) == before


def test_create_refuses_an_unknown_logger_before_it_makes_the_directory(tmp_path):
    with pytest.raises(ValueError, match=r"^logger must be one of none, tensorboard, wandb, got 'csv'; choose one"):
        create(tmp_path / "run", logger="csv")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("total", [0, -5])
def test_create_refuses_an_empty_run(tmp_path, total):
    with pytest.raises(ValueError, match=rf"^total_env_steps must be at least 1, got {total};"):
        create(tmp_path / "run", total_env_steps=total)
    assert not (tmp_path / "run").exists()


def test_create_refuses_a_config_that_yaml_cannot_hold(tmp_path):
    with pytest.raises(ValueError, match=r"^config must hold plain dicts, .*, got device\(type='cpu'\); convert it"):
        create(tmp_path / "run", config={"device": torch.device("cpu")})
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("logger", ["tensorboard", "wandb"])
def test_a_missing_logger_extra_is_named_before_anything_is_created(tmp_path, monkeypatch, logger):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ImportError) as caught:
        create(tmp_path / "run", logger=logger)
    expected = f"logger={logger} needs {logger}, which is not installed; run `pip install torchrl_etdmpc[{logger}]`."
    assert str(caught.value) == expected
    assert not (tmp_path / "run").exists()


def test_a_folder_called_wandb_does_not_pass_for_the_package(tmp_path, monkeypatch):
    (tmp_path / "wandb").mkdir()
    namespace = importlib.util.spec_from_loader("wandb", loader=None, is_package=True)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: namespace)
    with pytest.raises(ImportError, match="logger=wandb needs wandb, which is not installed"):
        create(tmp_path / "run", logger="wandb")


def test_a_run_dir_that_cannot_be_written_is_one_clear_line(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError) as caught:
        create(tmp_path / "file" / "run")
    message = str(caught.value)
    assert message.startswith(f"run_dir={tmp_path / 'file' / 'run'} cannot be written (Not a directory); choose a")
    assert "\n" not in message


def test_a_logger_that_fails_to_start_leaves_the_directory_free(tmp_path, monkeypatch):
    def fail(*args):
        raise RuntimeError("no connection")

    monkeypatch.setattr(run_log, "make_logger", fail)
    with pytest.raises(RuntimeError, match="no connection"):
        create(tmp_path / "run")
    monkeypatch.undo()
    create(tmp_path / "run")


def test_train_rows_start_with_the_counters_and_are_on_disk_at_once(tmp_path):
    log = create(tmp_path)
    log.log_train({"loss/value": torch.tensor([0.25]), "grad_norm": 1}, **COUNTERS)
    assert read_csv(tmp_path / "train.csv") == [
        ["env_steps", "decision_steps", "updates", "wall_time_s", "loss/value", "grad_norm"],
        ["1000", "500", "400", "9.5", "0.25", "1.0"],
    ]


def test_a_metric_that_is_missing_later_leaves_an_empty_cell(tmp_path):
    log = create(tmp_path)
    log.log_train({"a": 1.0, "b": 2.0}, **COUNTERS)
    log.log_train({"b": 3.0}, **COUNTERS)
    assert [row[4:] for row in read_csv(tmp_path / "train.csv")] == [["a", "b"], ["1.0", "2.0"], ["", "3.0"]]


def test_a_metric_that_is_new_later_is_refused_and_writes_nothing(tmp_path):
    log = create(tmp_path)
    log.log_train({"a": 1.0}, **COUNTERS)
    before = snapshot(tmp_path)
    with pytest.raises(ValueError, match=r"^metrics must keep to the columns .* got the new name 'b'; log it from"):
        log.log_train({"a": 1.0, "b": 2.0}, **COUNTERS)
    assert snapshot(tmp_path) == before


def test_a_metric_must_not_take_a_counters_name(tmp_path):
    log = create(tmp_path)
    with pytest.raises(ValueError, match=r"^metrics must not use the counter name 'updates'; rename"):
        log.log_train({"updates": 1.0}, **COUNTERS)
    assert not (tmp_path / "train.csv").exists()


def test_a_metric_must_be_one_number(tmp_path):
    log = create(tmp_path)
    with pytest.raises(TypeError, match=r"^loss must be a number or a one-element tensor, got Tensor; reduce it"):
        log.log_train({"loss": torch.zeros(2)}, **COUNTERS)
    assert not (tmp_path / "train.csv").exists()


def test_eval_rows_have_exactly_the_published_columns(tmp_path):
    log = create(tmp_path)
    log.log_eval(return_mean=31.0, return_std=4.0, episodes=10, **COUNTERS)
    log.log_eval(return_mean=math.nan, return_std=math.nan, episodes=10, **COUNTERS)
    assert (tmp_path / "eval.csv").read_text() == (
        "env_steps,decision_steps,updates,wall_time_s,return_mean,return_std,episodes\n"
        "1000,500,400,9.5,31.0,4.0,10\n"
        "1000,500,400,9.5,nan,nan,10\n"
    )


def test_tensorboard_holds_the_same_numbers_against_environment_steps(tmp_path):
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    log = create(tmp_path, logger="tensorboard")
    log.log_train({"loss_value": 0.25}, **COUNTERS)
    log.log_eval(return_mean=31.0, return_std=math.nan, episodes=10, **COUNTERS)
    log.finish({})
    events = EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    counters = ["decision_steps", "updates", "wall_time_s"]
    expected = {f"train/{name}" for name in [*counters, "loss_value"]}
    expected |= {f"eval/{name}" for name in [*counters, "return_mean", "return_std", "episodes"]}
    assert set(events.Tags()["scalars"]) == expected
    assert [(event.step, event.value) for event in events.Scalars("train/loss_value")] == [(1000, 0.25)]
    assert [(event.step, event.value) for event in events.Scalars("eval/return_mean")] == [(1000, 31.0)]


def test_wandb_works_offline_without_an_account(tmp_path, monkeypatch):
    pytest.importorskip("wandb")
    for name in ("WANDB_API_KEY", "WANDB_MODE"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setenv("NETRC", str(tmp_path / "home" / "netrc"))
    log = create(tmp_path / "run", logger="wandb")
    log.log_train({"loss_value": 0.25}, **COUNTERS)
    log.log_eval(return_mean=31.0, return_std=4.0, episodes=10, **COUNTERS)
    log.finish({})
    (record,) = (tmp_path / "run" / "wandb").glob("offline-run-*/*.wandb")
    content = record.read_bytes()
    for key in (b"loss_value", b"return_mean", b"walker-walk"):
        assert key in content


def test_finish_writes_valid_json_with_null_for_what_is_not_finite(tmp_path):
    log = create(tmp_path)
    log.log_eval(return_mean=31.0, return_std=4.0, episodes=10, **COUNTERS)
    summary = {"task": "walker-walk", "final_return": math.nan, "best_return": torch.tensor(31.0), "device": Path("x")}
    path = log.finish({**summary, "nested": [math.inf, {"a": -math.inf, "done": True}]})

    def refuse(constant):
        raise AssertionError(f"{constant} is not JSON")

    content = json.loads(path.read_text(), parse_constant=refuse)
    assert path == tmp_path / "summary.json"
    assert content.pop("versions") == library_versions()
    assert content == {
        "task": "walker-walk",
        "final_return": None,
        "best_return": 31.0,
        "device": "x",
        "nested": [None, {"a": None, "done": True}],
    }
    assert sorted(path.name for path in tmp_path.iterdir()) == ["config.yaml", "curve.png", "eval.csv", "summary.json"]


def test_finish_keeps_the_summary_when_no_curve_can_be_drawn(tmp_path):
    path = create(tmp_path).finish({"final_return": 1.0})
    assert json.loads(path.read_text())["final_return"] == 1.0
    assert not (tmp_path / "curve.png").exists()


def test_library_versions_names_the_installed_core():
    versions = library_versions()
    assert versions["torch"].split("+")[0] == torch.__version__.split("+")[0]
    assert {"python", "torch", "torchrl", "tensordict"} <= set(versions)


def test_the_curve_is_a_picture_of_sensible_size_even_with_a_nan_return(tmp_path):
    log = create(tmp_path)
    for step, mean in enumerate([10.0, math.nan, 300.0, 700.0]):
        log.log_eval(**{**COUNTERS, "env_steps": 1000 * step}, return_mean=mean, return_std=mean / 5, episodes=10)
    path = plot_curve(tmp_path)
    assert path == tmp_path / "curve.png"
    assert png_size(path) == (960, 600)
    assert path.stat().st_size > 10_000


def test_a_single_evaluation_without_a_spread_is_drawn_too(tmp_path):
    create(tmp_path).log_eval(return_mean=-31.0, return_std=math.nan, episodes=1, **COUNTERS)
    assert png_size(plot_curve(tmp_path)) == (960, 600)


def test_the_curve_needs_a_finite_return(tmp_path):
    create(tmp_path).log_eval(return_mean=math.nan, return_std=math.nan, episodes=10, **COUNTERS)
    with pytest.raises(ValueError, match=r"needs an evaluation with a finite return, got none; evaluate first\.$"):
        plot_curve(tmp_path)
    assert not (tmp_path / "curve.png").exists()


def test_the_curve_needs_the_directory_of_a_run(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"has no config\.yaml; give the directory of a run"):
        plot_curve(tmp_path)


def test_the_curve_says_which_package_is_missing(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(ImportError, match=r"not installed; run `pip install matplotlib pyyaml`\.$"):
        plot_curve(tmp_path)


def test_a_lock_that_its_owner_removed_in_the_last_moment_is_taken_again(tmp_path, monkeypatch):
    fcntl = pytest.importorskip("fcntl")
    lockf, calls = fcntl.lockf, []

    def removed_first(*args):
        calls.append(args)
        if len(calls) == 1:
            (tmp_path / ".lock").unlink()  # as the owner does between our opening the file and locking it
        return lockf(*args)

    monkeypatch.setattr(fcntl, "lockf", removed_first)
    descriptor = lock_run(tmp_path)
    assert len(calls) == 2
    assert os.fstat(descriptor).st_ino == (tmp_path / ".lock").stat().st_ino
    unlock_run(tmp_path, descriptor)
    assert list(tmp_path.iterdir()) == []
