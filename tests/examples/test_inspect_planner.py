from __future__ import annotations

import builtins
import os
import socket
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("hydra")
pytest.importorskip("gymnasium")
pytest.importorskip("dash")

from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer  # noqa: E402

from torchrl_etdmpc import commands  # noqa: E402
from torchrl_etdmpc.checkpoints import CheckpointStore  # noqa: E402
from torchrl_etdmpc.inspector import load_trace  # noqa: E402
from torchrl_etdmpc.testing import random_slices  # noqa: E402
from torchrl_etdmpc.training import load_agent  # noqa: E402

SCRIPT = Path(__file__).resolve().parents[2] / "examples" / "inspect_planner.py"


PENDULUM = "gym/Pendulum-v1"


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory, save_untrained) -> Path:
    return save_untrained(tmp_path_factory.mktemp("run"), 3, task=PENDULUM)


@pytest.fixture
def run_main(run_here) -> Callable[..., tuple[str | None, str, str]]:
    return partial(run_here, "inspect_planner.py")


def test_a_page_is_saved_without_a_server(checkpoint, run_main, tmp_path):
    arguments = ("state=3:1", "steps=3", "save=page", "planner.horizon=4", "device=cpu")
    message, out, err = run_main(f"checkpoint={checkpoint}", *arguments)
    assert message is None, err
    assert out == "gym/Pendulum-v1: page/index.html, which any browser opens\n"
    trace = load_trace(tmp_path / "page" / "trace.npz")
    assert trace.manifest["state"] == {"from": "episode", "seed": 3, "step": 1}
    assert (trace.settings["horizon"], trace.settings["num_samples"]) == (4, 12)  # told, and as it was trained
    agent, _, _ = load_agent(checkpoint)
    assert trace.settings["discount"] == agent.eval_planner.discount
    assert trace.manifest["checkpoint"]["name"] == str(checkpoint)
    assert len(trace.manifest["checkpoint"]["sha256"]) == 64
    assert trace["frames"].shape == (5, 160, 160, 3)


def test_a_random_state_is_that_of_the_seed(checkpoint, run_main, tmp_path):
    for folder in ("one", "two"):
        assert run_main(f"checkpoint={checkpoint}", "seed=5", "steps=4", f"save={folder}", "play=bare")[0] is None
    one, two = (load_trace(tmp_path / folder / "trace.npz") for folder in ("one", "two"))
    assert one.manifest["state"] == two.manifest["state"]
    assert one.manifest["state"]["seed"] == 5


def test_a_random_state_lies_within_an_episode_that_ended_early(run_main, tmp_path, save_untrained):
    checkpoint = save_untrained(tmp_path / "hopper", 4, task="gym/InvertedPendulum-v5", model={"termination": True})
    for seed in range(3):  # the pole falls within some 20 of 1000 steps
        message, _, err = run_main(f"checkpoint={checkpoint}", f"seed={seed}", f"save=page{seed}", "play=bare")
        assert message is None, err
    steps = [load_trace(tmp_path / f"page{seed}" / "trace.npz").manifest["state"]["step"] for seed in range(3)]
    assert max(steps) < 100


def test_a_row_of_the_saved_buffer_is_a_state(run_main, tmp_path, monkeypatch, save_untrained):
    checkpoint = save_untrained(tmp_path / "checkpoints", 3, task=PENDULUM)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(20))
    rows = random_slices(3, 1).flatten(0, 1)
    buffer.extend(rows)
    CheckpointStore(checkpoint.parent).save(1, {}, buffer)
    with monkeypatch.context() as patch:  # which needs no simulator
        patch.setattr("torchrl_etdmpc.commands.inspect_planner.make_env", lambda *_: pytest.fail("it was made"))
        message, _, _ = run_main(f"checkpoint={checkpoint}", "state=replay:7", "save=page")
    assert message is None
    trace = load_trace(tmp_path / "page" / "trace.npz")
    assert trace["observation"].tolist() == rows["observation"][7].tolist()
    message, _, _ = run_main(f"checkpoint={checkpoint}", "state=replay:12", "save=other")
    assert message == "error: the row must be in [0, 12), the rows of the replay buffer, got 12."
    assert not (tmp_path / "other").exists()
    for manifest in checkpoint.parent.glob("resume/*/manifest.json"):
        manifest.write_text("cut off")  # the agent is whole
    message, _, _ = run_main(f"checkpoint={checkpoint}", "state=0:0", "steps=1", "save=whole")
    assert message is None
    row_of = f"a row of {PENDULUM}, on which the agent was trained, and none of walker-walk;"
    message, _, _ = run_main(f"checkpoint={checkpoint}", "state=replay:7", "task=walker-walk", "save=third")
    assert message is not None and message.startswith(f"error: state=replay:7 is {row_of} leave task=... out, or")
    assert not (tmp_path / "third").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["state=7"], "error: state must be EPISODE:STEP, replay:ROW or random, got '7'."),
        (
            ["state=0:9", "steps=3", "save=page"],
            r"error: the step must be in [0, 3), the decisions of episode 0, got 9.",
        ),
        (
            ["state=replay:0", "save=page"],
            "error: state cannot be a row of the replay buffer: this checkpoint has none",
        ),
        (["save=/proc/page"], "error: /proc/page cannot be written (No such file or directory); choose another path."),
        (["planner.num_elites=99"], "error: planner.num_elites must be at most num_samples=12, got 99."),
        (["planner.horizn=3"], "error: unknown setting planner.horizn; did you mean planner.horizon?"),
        (["host=0.0.0.0"], "error: host must be this machine's own address, 127.0.0.1, got '0.0.0.0'"),
        (["port=70000"], "error: port must be in [0, 65535], got 70000."),
        (["port=-1"], "error: port must be in [0, 65535], got -1."),
        (["seed=2147483648"], "error: seed must be in [0, 2**31 - 1], got 2147483648."),
        (["steps=0"], "error: steps must be at least 1, got 0."),
    ],
)
def test_what_cannot_be_is_one_line(checkpoint, run_main, arguments, message):
    told, out, err = run_main(f"checkpoint={checkpoint}", "play=bare", *arguments)
    assert told is not None and told.startswith(message), told
    assert "\n" not in told and out == ""


def test_a_port_in_use_is_one_line(checkpoint, run_main):
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        message, _, _ = run_main(f"checkpoint={checkpoint}", f"port={port}")
    assert message.startswith(f"error: port={port} cannot be used (Address already in use); choose another one")


def test_what_is_not_a_checkpoint_or_of_another_size_is_one_line(run_main, tmp_path, save_untrained):
    (tmp_path / "notes.pt").write_text("hello")
    message, _, _ = run_main("checkpoint=notes.pt", "save=page")
    assert message.startswith("error: notes.pt is not a readable checkpoint")
    larger = save_untrained(tmp_path / "larger", 7, task=PENDULUM)
    message, _, _ = run_main(f"checkpoint={larger}", "state=0:0", "steps=2", "save=page")
    assert "was trained with observation size 7 and action size 1, the environment has 3 and 1" in message
    assert not (tmp_path / "page").exists()


@pytest.mark.parametrize("play", ["planner", "bare"])
def test_an_agent_of_another_task_is_refused(checkpoint, run_main, play):
    message, _, _ = run_main(f"checkpoint={checkpoint}", "task=gym/InvertedPendulum-v5", f"play={play}", "save=page")
    assert message.startswith("error: ") and "the environment has 4 and 1; use the task it was trained on" in message


def test_a_folder_of_other_files_is_refused_before_any_work(checkpoint, run_main, tmp_path, monkeypatch):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "index.html").write_text("mine")
    work = "torchrl_etdmpc.commands.agent_command.load_agent"
    monkeypatch.setattr(work, lambda *_, **__: pytest.fail("the agent was read"))
    message, _, _ = run_main(f"checkpoint={checkpoint}", "save=mine")
    assert message == "error: save=mine holds other files; choose an empty or a new folder."


def test_the_seed_and_who_may_reach_it_reach_the_page(checkpoint, run_main, monkeypatch):
    made: dict[str, Any] = {}
    served: dict[str, Any] = {}
    monkeypatch.setattr("torchrl_etdmpc.commands.inspect_planner.make_page", lambda _, **given: made.update(given))
    monkeypatch.setattr("torchrl_etdmpc.commands.inspect_planner.serve", lambda _, **given: served.update(given))
    settings = ("seed=17", "host=0.0.0.0", "port=0", "allow_remote=true")
    assert run_main(f"checkpoint={checkpoint}", "state=0:0", *settings)[0] is None
    assert (made["seed"], made["allow_remote"]) == (17, True)
    assert (served["host"], served["port"], served["allow_remote"]) == ("0.0.0.0", 0, True)


def test_a_missing_package_is_named_with_its_command(checkpoint, run_main, monkeypatch):
    real = builtins.__import__

    def without(name, *args, **kwargs):
        if name.split(".")[0] in ("dash", "plotly"):
            raise ImportError(f"No module named {name!r}")
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without)
    message, _, _ = run_main(f"checkpoint={checkpoint}")
    assert message == "error: the page needs dash and plotly; in the checkout: pip install -e '.[inspect]'"


@pytest.mark.parametrize(
    ("before", "library", "after"),
    [(None, "libEGL.so.1", "egl"), (None, None, "disable"), ("osmesa", "libEGL.so.1", "osmesa")],
)
def test_a_renderer_is_looked_for(monkeypatch, before, library, after):
    monkeypatch.setattr(commands, "find_library", lambda name: library)
    monkeypatch.setenv("MUJOCO_GL", "")
    if before is None:
        monkeypatch.delenv("MUJOCO_GL")
    else:
        monkeypatch.setenv("MUJOCO_GL", before)
    commands._choose_renderer("inspect_planner", ["checkpoint=a.pt"])
    assert os.environ["MUJOCO_GL"] == after
    assert commands.renderer_is_a_guess() == (after == "egl")
    commands._choose_renderer("train", [])
    assert not commands.renderer_is_a_guess()


@pytest.mark.slow
def test_a_machine_without_a_renderer_gets_the_page_without_frames(tmp_path, save_untrained):
    """A process of its own: it begins anew when the renderer that it found cannot be imported."""
    checkpoint = save_untrained(tmp_path, 5, task="cartpole-balance")
    environment = {name: value for name, value in os.environ.items() if name != "MUJOCO_GL"}
    environment["__EGL_VENDOR_LIBRARY_DIRS"] = str(tmp_path)  # a library of EGL without any device
    command = [sys.executable, str(SCRIPT), f"checkpoint={checkpoint}", "state=0:1", "steps=2", "save=page"]
    run = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert (run.returncode, run.stderr) == (0, "")
    trace = load_trace(tmp_path / "page" / "trace.npz")
    assert trace["real_rewards"].shape == (2,)
    assert trace.get("frames") is None
    assert trace.manifest["notes"][0].startswith("There are no frames: cannot render")
