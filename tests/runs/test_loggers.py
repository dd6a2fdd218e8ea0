from __future__ import annotations

import http.server
import importlib.util
import math
import os
import threading
import time
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
    """The real wandb, without what this machine knows of an account; its service process ends with the test."""
    wandb = pytest.importorskip("wandb")
    for name in [name for name in os.environ if name.startswith("WANDB_")]:
        monkeypatch.delenv(name)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setenv("NETRC", str(tmp_path / "home" / "netrc"))
    yield
    wandb.teardown()


def train_a_little(log: RunLog) -> None:
    log.log_train({"loss_value": 0.25}, **COUNTERS)
    log.log_eval({"return_mean": 31.0, "return_std": 4.0, "episodes": 10}, **COUNTERS)
    log.finish({})


def offline_records(run_dir: Path) -> list[Path]:
    return sorted((run_dir / "wandb").glob("offline-run-*/*.wandb"))


def assert_holds_the_run(record: Path) -> None:
    """Once wandb's own process, which is not waited for to the last byte, has written it."""
    missing, until = [b""], time.monotonic() + 20
    while missing and time.monotonic() < until:
        content = record.read_bytes()
        missing = [key for key in (b"loss_value", b"return_mean", b"walker-walk") if key not in content]
        time.sleep(0.1 if missing else 0)
    assert not missing


def test_a_run_that_goes_on_is_the_same_one_for_wandb(tmp_path, no_account):
    log = start(tmp_path / "run", "wandb")
    known = log.directory.wandb_id.read_text()
    log.close()
    make_logger("wandb", log.directory, CONFIG).shutdown()
    assert log.directory.wandb_id.read_text() == known
    # A folder of the same second has a number behind the id.
    assert [path.name.split("-")[3] for path in (tmp_path / "run" / "wandb").glob("offline-run-*")] == [known, known]
    assert {record.name for record in offline_records(tmp_path / "run")} == {f"run-{known}.wandb"}


def test_the_environment_s_mode_of_wandb_is_obeyed(tmp_path, monkeypatch, no_account):
    monkeypatch.setenv("WANDB_MODE", "disabled")
    train_a_little(start(tmp_path / "run", "wandb"))
    assert offline_records(tmp_path / "run") == []


def test_what_fails_offline_is_an_error_and_no_matter_of_the_network(tmp_path, monkeypatch, no_account):
    from wandb.errors import Error

    def fail(*_: object, **__: object) -> None:
        raise Error("no space left")

    monkeypatch.setattr("torchrl_etdmpc.runs.loggers.get_logger", fail)
    with pytest.raises(Error, match="^no space left$"):
        start(tmp_path / "run", "wandb")


@pytest.mark.slow  # wandb asks for 20 seconds
def test_a_service_that_cannot_be_reached_does_not_stop_a_run(tmp_path, monkeypatch, no_account):
    monkeypatch.setattr("torchrl_etdmpc.runs.loggers._WANDB_TIMEOUT_S", 4)
    monkeypatch.setenv("WANDB_API_KEY", "0" * 40)
    monkeypatch.setenv("WANDB_BASE_URL", "http://127.0.0.1:9")  # nobody listens to the port of discard
    with pytest.warns(
        UserWarning, match=r"^wandb cannot be reached \(.+\), so it is offline; `wandb sync` sends it later"
    ):
        log = start(tmp_path / "run", "wandb")
    train_a_little(log)
    assert_holds_the_run(offline_records(tmp_path / "run")[-1])


class _Refusing(http.server.BaseHTTPRequestHandler):
    """A service that knows nobody."""

    def do_POST(self) -> None:
        self.rfile.read(int(self.headers.get("Content-Length", 0)))
        body = b'{"errors": [{"message": "permission denied"}]}'
        self.send_response(401)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    do_GET = do_POST

    def log_message(self, format: str, *args: object) -> None:
        pass


def test_a_key_that_is_wrong_does_not_stop_a_run(tmp_path, monkeypatch, no_account):
    monkeypatch.setattr("torchrl_etdmpc.runs.loggers._WANDB_TIMEOUT_S", 4)
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), _Refusing) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        monkeypatch.setenv("WANDB_API_KEY", "1" * 40)
        monkeypatch.setenv("WANDB_BASE_URL", f"http://127.0.0.1:{server.server_port}")
        with pytest.warns(UserWarning, match=r"^wandb cannot be reached \(.+\), so it is offline"):
            log = start(tmp_path / "run", "wandb")
        train_a_little(log)
        server.shutdown()
    assert_holds_the_run(offline_records(tmp_path / "run")[-1])
