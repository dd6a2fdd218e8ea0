"""A score and terms of one's own, by a path on the command line: how many lines, and never from a file alone."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from torchrl_etdmpc import training
from torchrl_etdmpc.commands import evaluate, export, inspect_planner, study, train
from torchrl_etdmpc.training import TrainConfig, build_agent, load_agent, save_agent

pytest.importorskip("hydra")
pytest.importorskip("gymnasium")

# Each is the whole of what a user writes.
SCORE = """
def cautious(returns):
    return returns.amin((-2, -1)).mean(-1)
"""
TERMS = """
from torchrl_etdmpc.objectives import Term

def small_actions(world_model, slices, rollout):
    mean, _ = world_model.policy(rollout.predicted[:-1].detach())
    return mean.square().mean((1, -1))

def terms(world_model):
    return [Term("small_actions", small_actions, coef=0.1)]
"""
TINY = [
    *("task=gym/Pendulum-v1", "preset=cpu", "compile=off", "total_env_steps=230", "task.episode_length=20"),
    *("eval_every=1000", "checkpoint_every=1000", "log_every=50", "eval_episodes=1", "replay.seed_decisions=200"),
    *("replay.pretrain_updates=2", "model.latent_dim=8", "model.mlp_dim=8", "model.encoder_dim=8", "run_dir=run"),
    *("planner.horizon=2", "planner.num_samples=6", "planner.num_elites=3", "planner.iterations=1"),
]
SMALL = {
    "model": {"latent_dim": 8, "mlp_dim": 8, "encoder_dim": 8},
    "planner": {"horizon": 2, "num_samples": 6, "num_elites": 3, "num_proposals": 1, "iterations": 1},
}
OWN = ["planner.score=my_ideas:cautious", "loss.extra_terms=my_ideas:terms"]


@pytest.fixture
def call(tmp_path, monkeypatch) -> Callable[..., None]:
    (tmp_path / "my_ideas.py").write_text(SCORE + TERMS)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])

    def run(command, *arguments: str) -> None:
        # As in a process of its own.
        monkeypatch.setattr("torchrl_etdmpc.training.own_code._followed", {})
        sys.modules.pop("my_ideas", None)
        monkeypatch.setattr(sys, "argv", ["command", *arguments])
        command.main()

    return run


def test_a_score_and_terms_are_reached_from_the_command_line_and_from_there_alone(call, capsys):
    call(train, *TINY, *OWN)
    assert "small_actions_error" in Path("run/train.csv").read_text()
    agent = "checkpoint=run/checkpoints/last.pt"
    repeated = ["score=my_ideas:cautious", "extra_terms=my_ideas:terms"]
    call(evaluate, agent, "episodes=1", *repeated)
    assert "return -" in capsys.readouterr().out
    loaded, config, _ = load_agent(agent.partition("=")[2])
    assert config.planner.score == "my_ideas:cautious"
    assert loaded.planner.score.function.__name__ == "cautious"
    assert [term.name for term in loaded.loss.terms][-1] == "small_actions"

    # The files alone lead to no import.
    for command, arguments in (
        (evaluate, [agent]),
        (export, [agent]),
        (evaluate, [agent, repeated[1]]),
        (train, ["run_dir=run", "resume=on", "total_env_steps=260"]),
    ):
        with pytest.raises(
            SystemExit, match=r"planner\.score 'my_ideas:cautious' names code, which must be given on the"
        ):
            call(command, *arguments)
        assert command is not train or "my_ideas" not in sys.modules
    with pytest.raises(SystemExit, match=r"loss\.extra_terms 'my_ideas:terms' names code, which must be given on the"):
        call(evaluate, agent, repeated[0])


TRAINED = "must be what the agent was trained with"


@pytest.mark.parametrize(
    ("command", "typed", "message"),
    [
        (
            evaluate,
            "score=my_ideas:cautious",
            f"score {TRAINED}, mean, got my_ideas:cautious; leave it out, or plan with another score: "
            "planner.score=my_ideas:cautious.",
        ),
        (study, "study=all score=my_ideas:cautious", f"score {TRAINED}, mean, got my_ideas:cautious; leave it out."),
        (study, "study=all reanalyze_score=my_ideas:cautious", f"reanalyze_score {TRAINED}, final, got my_ideas:caut"),
        (export, "extra_terms=my_ideas:terms", f"extra_terms {TRAINED}, null, got my_ideas:terms; leave it out."),
        (inspect_planner, "extra_terms=my_ideas:terms", f"extra_terms {TRAINED}, null, got my_ideas:terms; leave it"),
        (
            evaluate,
            "score=final",
            "score must be the path of the code that the agent was trained with, got 'final'; leave it out. With "
            "evaluate and inspect_planner, planner.score=final plans with another score.",
        ),
        (evaluate, "score=cautious", "score 'cautious' must read package.module:attribute."),
        (export, "task.episode_length=20", "task.episode_length changes nothing of a policy or a planner; leave it"),
        (export, "task=gym/Acrobot-v1", "task must be that of the checkpoint, 'gym/Pendulum-v1', got 'gym/Acrobot-v1'"),
    ],
)
def test_what_would_change_nothing_is_refused(call, tmp_path, command, typed, message):
    config = TrainConfig.from_dict({"task": "gym/Pendulum-v1", "compile": "off", **SMALL})
    save_agent(tmp_path / "last.pt", build_agent(config, 3, 1), config, {"env_steps": 0})
    before = {*tmp_path.iterdir()}
    with pytest.raises(SystemExit) as caught:
        call(command, "checkpoint=last.pt", *typed.split())
    assert str(caught.value).startswith(f"error: {message}")
    assert {path for path in tmp_path.iterdir() if path.name != "__pycache__"} == before


@pytest.mark.parametrize(
    ("typed", "message"),
    [
        ("planner.score=nowhere:score", "planner.score 'nowhere:score': there is no module 'nowhere' on Python's path"),
        ("planner.score=my_ideas:brave", "planner.score 'my_ideas:brave': the module 'my_ideas' "),
        ("planner.score=median", "planner.score must be one of final, mean, adaptive, got 'median'."),
        ("loss.extra_terms=my_ideas", "loss.extra_terms 'my_ideas' must read package.module:attribute."),
        ("planner.score=my_ideas:__name__", "planner.score 'my_ideas:__name__' must be a function, got str."),
    ],
)
def test_a_path_that_leads_nowhere_is_refused_in_one_line(call, typed, message):
    with pytest.raises(SystemExit) as caught:
        call(train, *TINY, typed)
    assert message in str(caught.value) and "\n" not in str(caught.value)


def test_a_configuration_with_a_path_that_nobody_followed_is_refused():
    for values in ({"planner": {"score": "os:getcwd"}}, {"loss": {"extra_terms": "os:getcwd"}}):
        with pytest.raises(ValueError, match=r"'os:getcwd' names code, which must be given on the command line"):
            TrainConfig.from_dict({"preset": "cpu", **values})


def test_a_configuration_with_a_path_is_made_in_python_after_the_call_that_its_error_names(monkeypatch):
    monkeypatch.setattr("torchrl_etdmpc.training.own_code._followed", {})
    values = {"preset": "cpu", "planner": {"score": "os:getcwd"}}
    with pytest.raises(ValueError) as caught:
        TrainConfig.from_dict(values)
    named = re.search(
        r"In Python, call torchrl_etdmpc\.training\.(follow_own_code)\('(.*)', '(.*)'\) before\.$", str(caught.value)
    )
    assert named is not None
    getattr(training, named[1])(named[2], named[3])
    assert TrainConfig.from_dict(values).planner.score == "os:getcwd"


def test_they_cost_few_lines():
    def count(code: str) -> int:
        return len([line for line in code.splitlines() if line.strip()])

    assert count(SCORE) == 2
    assert count(TERMS) <= 10
