"""Any task: Gymnasium's by its id, or one in a file of the user's own, whose code runs only if the command names it."""

from __future__ import annotations

import contextlib
import csv
import json
import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

pytest.importorskip("gymnasium")
pytest.importorskip("hydra")

from torchrl_etdmpc.training import read_agent_file  # noqa: E402

ROOT = Path(__file__).resolve().parents[2]
SMALL_RUN = (
    "preset=cpu seed=3 device=cpu compile=off total_env_steps=140 log_every=20 eval_every=100000 eval_episodes=2 "
    "model.latent_dim=16 model.mlp_dim=16 model.encoder_dim=16 planner.horizon=2 planner.num_samples=8 "
    "planner.num_elites=4 planner.num_proposals=2 planner.iterations=1 reanalyze.num_samples=6 reanalyze.num_elites=3 "
    "reanalyze.iterations=1 optim.batch_size=4 replay.seed_decisions=40 replay.pretrain_updates=4"
).split()

# An environment without a time limit; its module leaves a mark whenever it is imported.
MODULE = """
from pathlib import Path

import gymnasium
from torchrl.envs import ActionScaling, GymEnv, GymWrapper, TransformedEnv

with Path(__file__).with_name("imported").open("a") as file:
    file.write("x")


def make_my_env():
    return TransformedEnv(GymWrapper(gymnasium.make("Pendulum-v1").unwrapped), ActionScaling())


def make_limited():
    return TransformedEnv(GymEnv("Pendulum-v1"), ActionScaling())


def make_unscaled():
    return GymEnv("Pendulum-v1")


def make_nothing():
    return 3


def fail():
    raise RuntimeError("the licence server\\ndoes not answer")
"""


def read_rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture
def run_main(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, run_here
) -> Iterator[Callable[..., tuple[str | None, str]]]:
    """Runs a script beside a module of the user's; returns its exit message and what it printed."""
    (tmp_path / "mymodule.py").write_text(MODULE)

    def run(script: str, *arguments: str) -> tuple[str | None, str]:
        monkeypatch.setattr("torchrl_etdmpc.envs.tasks._tasks", dict(TASKS))  # as a new process would know them
        sys.modules.pop("mymodule", None)
        (tmp_path / "imported").unlink(missing_ok=True)
        return run_here(script, *arguments)[:2]

    yield run
    sys.modules.pop("mymodule", None)


def import_tasks() -> dict:
    from torchrl_etdmpc.envs import tasks

    return dict(tasks._tasks)


TASKS = import_tasks()


def test_a_gymnasium_task_trains_in_an_empty_directory_with_an_action_repeat(tmp_path, run_script):
    task = ("task=gym/Pendulum-v1", "task.action_repeat=2", "num_envs=2")
    process = run_script("train.py", *task, *SMALL_RUN, cwd=tmp_path)
    assert process.returncode == 0, process.stderr
    assert "Warning" not in process.stderr
    run_dir = tmp_path / "runs" / "gym" / "Pendulum-v1" / "cpu" / "seed3"
    summary = json.loads((run_dir / "summary.json").read_text())
    assert process.stdout.splitlines()[-1].startswith(
        f"gym/Pendulum-v1: return {summary['final_return']:.1f} after 140 env steps in "
    )
    assert (summary["task"], summary["env_steps"]) == ("gym/Pendulum-v1", 140)
    evaluations = read_rows(run_dir / "eval.csv")
    assert [(row["env_steps"], row["decision_steps"]) for row in evaluations] == [("0", "0"), ("140", "70")]
    assert -200 * 16.3 < summary["final_return"] < 0  # 200 env steps, of which none costs more
    content = read_agent_file(run_dir / "checkpoints" / "last.pt")
    assert content["config"]["action_repeat"] == 2
    assert content["counters"]["updates"] == 4 + 30
    assert not any("termination" in name for name in content["world_model"])  # Pendulum never terminates


def test_a_task_of_the_user_s_own_file_is_trained_gone_on_with_evaluated_and_exported(tmp_path, run_main):
    """What is stored names it, and every command must name it again: no file makes a process import code."""
    name, limit = "task=mymodule:make_my_env", "task.episode_length=30"
    message, out = run_main("train.py", name, limit, *SMALL_RUN, "run_dir=run")
    assert message is None
    assert out.splitlines()[-1].startswith("mymodule:make_my_env: return ")
    assert [row["env_steps"] for row in read_rows(tmp_path / "run" / "eval.csv")] == ["0", "140"]
    commands = {
        "train.py": ("run_dir=run", "resume=true", *SMALL_RUN, "total_env_steps=160"),
        "evaluate.py": ("checkpoint=run/checkpoints/last.pt", "episodes=1", "device=cpu", "policy=bare"),
        "export.py": ("checkpoint=run/checkpoints/last.pt",),
    }
    for script, arguments in commands.items():
        message, _ = run_main(script, *arguments)
        assert "task 'mymodule:make_my_env' names code, which must be given on the command line: task=my" in message
        assert message.startswith("error: ") and "\n" not in message
        assert not (tmp_path / "imported").exists()
        fresh = pytest.warns(UserWarning, match="^the environment cannot be restored, so fresh episodes begin")
        with fresh if script == "train.py" else contextlib.nullcontext():
            message, out = run_main(script, name, limit, *arguments)
        assert message is None
        assert out.splitlines()[-1].startswith("mymodule:make_my_env")
        assert (tmp_path / "imported").exists()
    assert [row["env_steps"] for row in read_rows(tmp_path / "run" / "eval.csv")] == ["0", "140", "160"]
    assert (tmp_path / "exported" / "planner.pt2").exists()


def test_where_episodes_can_end_early_their_lengths_and_successes_are_reported(tmp_path, run_main):
    pytest.importorskip("mujoco")
    message, _ = run_main("train.py", "task=gym/InvertedPendulum-v5", *SMALL_RUN, "run_dir=run")
    assert message is None
    rows = read_rows(tmp_path / "run" / "eval.csv")
    assert list(rows[0])[-3:] == ["episodes", "length_mean", "success"]
    # 1 for every step on its feet, and 0 for the one that falls.
    assert all(float(row["length_mean"]) == float(row["return_mean"]) + 1 for row in rows)
    message, out = run_main("evaluate.py", "checkpoint=run/checkpoints/last.pt", "episodes=2", "device=cpu")
    assert message is None
    assert re.search(r"over 2 episodes of \d+ decisions in the mean, 0 of them at 950 or more, a success\n$", out)


def test_a_task_that_terminates_against_its_word_is_an_error_that_names_the_remedy(run_main):
    pytest.importorskip("mujoco")
    message, _ = run_main("train.py", "task=gym/InvertedPendulum-v5", "task.terminates=false", *SMALL_RUN)
    assert message == (
        "error: an episode of gym/InvertedPendulum-v5 terminated, but the task is said never to; say "
        "task.terminates=true (model.termination=false to bootstrap through its ends)."
    )


REFUSED = [
    ("task=gym/Pendulm-v1", "unknown task 'gym/Pendulm-v1'; did you mean gym/Pendulum-v1, "),
    ("task=gym/CartPole-v1", "gym/CartPole-v1 has discrete actions (Discrete); only continuous actions are supported."),
    ("task=gym/Blackjack-v1", "Gymnasium sets no time limit for Blackjack-v1; give one in env steps: task.episode_"),
    ("task=gym/Pendulum-v1 task.action_repeat=0", "task.action_repeat of task 'gym/Pendulum-v1' must be at least 1"),
    (
        "task=gym/Pendulum-v1 task.episode_length=2",
        "loss.slice_len must fit into an episode of 2 decisions (task.episode_length=2, task.action_repeat=1), got 3.",
    ),
    ("task=nowhere:make", "task 'nowhere:make': there is no module 'nowhere' on Python's path or in "),
    ("task=mymodule:nothing", "task 'mymodule:nothing': the module 'mymodule' ("),
    ("task=mymodule:", "task 'mymodule:' must read package.module:attribute."),
    ("task=mymodule:make_my_env", "task 'mymodule:make_my_env' shows no time limit; give one in env steps: task.epis"),
    ("task=mymodule:make_nothing", "task 'mymodule:make_nothing' must return a TorchRL environment, got int."),
    ("task=mymodule:fail", "task 'mymodule:fail': RuntimeError: the licence server does not answer (mymodule.py, line"),
    ("task=mymodule:make_unscaled", "task 'mymodule:make_unscaled': this environment cannot be used as it is: action"),
    (
        "task=mymodule:make_limited task.episode_length=500",
        "task.episode_length of task 'mymodule:make_limited' must be at most 200, its environment's own limit, got ",
    ),
    (
        "task=mymodule:make_limited task.action_repeat=2",
        "task.action_repeat of task 'mymodule:make_limited' must be 1, which is how often its environment repeats ",
    ),
]


@pytest.mark.parametrize(("arguments", "message"), REFUSED, ids=[arguments for arguments, _ in REFUSED])
def test_a_bad_task_ends_in_one_line_and_leaves_nothing_behind(tmp_path, run_main, arguments, message):
    error, out = run_main("train.py", *arguments.split(), *SMALL_RUN)
    assert error.startswith(f"error: {message}")
    assert "\n" not in error
    assert out == ""
    assert {path.name for path in tmp_path.iterdir()} <= {"mymodule.py", "imported", "__pycache__"}


def test_the_script_for_the_benchmarks_does_not_take_it(tmp_path, run_main):
    message, out = run_main("train_dmc.py", "task=gym/Pendulum-v1", *SMALL_RUN)
    assert message == "error: train_dmc.py knows the 28 DMC tasks, not 'gym/Pendulum-v1'; use examples/train.py."
    assert out == ""
    assert [path.name for path in tmp_path.iterdir()] == ["mymodule.py"]
