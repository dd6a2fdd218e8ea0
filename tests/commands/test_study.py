"""The command: files, lines, and mistakes in one line."""

from __future__ import annotations

import csv
import hashlib
import importlib
import json
from functools import partial
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
import torch

pytest.importorskip("dm_control")
pytest.importorskip("hydra")
pytest.importorskip("matplotlib")

from torchrl_etdmpc.commands import study as study_command  # noqa: E402
from torchrl_etdmpc.commands.agent_command import AgentCommandConfig  # noqa: E402
from torchrl_etdmpc.commands.study import StudyName  # noqa: E402
from torchrl_etdmpc.inspector import Simulator, play_episode  # noqa: E402
from torchrl_etdmpc.inspector.studies import advantage, choose_states, consistency  # noqa: E402
from torchrl_etdmpc.training import TrainConfig, build_agent, load_agent, save_agent  # noqa: E402

NAMES = [name for name in get_args(StudyName) if name != "all"]
FEW = ("episodes=2", "states=6", "device=cpu", "seed=4")


def untrained(folder: Path, *, num_dynamics: int, task: str = "cartpole-balance", observation_dim: int = 5) -> Path:
    """An agent of small networks, whose episodes have 30 decisions at most."""
    config = TrainConfig.from_dict(
        {
            "task": task,
            "episode_length": 60 if task == "cartpole-balance" else None,
            "compile": "off",
            "model": {"latent_dim": 16, "mlp_dim": 16, "encoder_dim": 16, "num_dynamics": num_dynamics},
            "planner": {"horizon": 2, "num_samples": 8, "num_elites": 4, "num_proposals": 2, "iterations": 1},
            "reanalyze": {"num_samples": 8, "num_elites": 4, "num_proposals": 2, "iterations": 1},
        }
    )
    torch.manual_seed(0)
    agent = build_agent(config, observation_dim=observation_dim, action_dim=1)
    return save_agent(folder / "last.pt", agent, config, {"env_steps": 400})


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory) -> Path:
    return untrained(tmp_path_factory.mktemp("run"), num_dynamics=2)


@pytest.fixture
def study(tmp_path, monkeypatch, run_main):
    """Runs the command in this process, in an empty directory; returns its exit message, stdout and stderr."""
    monkeypatch.chdir(tmp_path)
    return partial(run_main, "study")


def rows(file: Path) -> list[dict[str, str]]:
    with open(file, newline="", encoding="utf-8") as text:
        return list(csv.DictReader(text))


def made(folder: Path, name: str) -> None:
    """All four files of a study, and what they hold."""
    assert (folder / f"{name}.png").read_bytes().startswith(b"\x89PNG")
    about = json.loads((folder / f"{name}.json").read_text(encoding="utf-8"))
    assert (about["study"], about["task"], about["seed"]) == (name, "cartpole-balance", 4)
    assert (about["trained_env_steps"], about["episodes"], about["states_asked"]) == (400, 2, 6)
    assert len(about["checkpoint_sha256"]) == 64
    assert about["versions"]["torch"]
    assert len(about["lines"]) >= 1
    assert rows(folder / f"{name}.csv")
    assert np.load(folder / f"{name}.npz", allow_pickle=False).files


def test_a_study_is_what_its_function_returns_and_follows_from_the_seed(tmp_path, checkpoint, study):
    message, out, err = study("advantage", f"checkpoint={checkpoint}", "out=here", *FEW)
    assert (message, err) == (None, "")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["here"]
    assert sorted(path.suffix for path in (tmp_path / "here").iterdir()) == [".csv", ".json", ".npz", ".png"]
    made(tmp_path / "here", "advantage")
    agent, config, _ = load_agent(checkpoint)
    planner = agent.eval_planner
    episodes = [play_episode(planner, config.task_spec, seed=seed) for seed in (4, 5)]
    states = choose_states(episodes, 6, ahead=15, seed=4)
    result = advantage.advantage(planner, states, Simulator(config.task_spec), steps=10, horizon=15, seed=4)
    arrays = np.load(tmp_path / "here" / "advantage.npz")
    assert np.array_equal(arrays["planned"], result.planned)
    assert np.array_equal(arrays["latent"], result.latent)
    lines = out.splitlines()
    assert lines[0].startswith("cartpole-balance, trained for 400 env steps: 2 episodes, return ")
    assert lines[1:] == ["advantage: here/advantage.png", *(f"  {line}" for line in advantage.lines(result))]


def test_a_study_names_the_file_that_it_loaded_and_what_was_changed_of_the_task(
    tmp_path, checkpoint, study, monkeypatch
):
    """A run that goes on writes its files anew while the episodes are played."""
    own = tmp_path / "last.pt"
    own.write_bytes(checkpoint.read_bytes())
    play = study_command.play_episode

    def play_and_replace(*arguments, **options):
        own.write_bytes(b"newer")
        return play(*arguments, **options)

    monkeypatch.setattr(study_command, "play_episode", play_and_replace)
    message, out, _ = study("consistency", f"checkpoint={own}", "task.episode_length=40", "out=here", *FEW)
    assert message is None
    about = json.loads((tmp_path / "here" / "consistency.json").read_text(encoding="utf-8"))
    assert about["checkpoint_sha256"] == hashlib.sha256(checkpoint.read_bytes()).hexdigest()
    assert about["changed_task"] == {"episode_length": 40}
    assert out.startswith("cartpole-balance with episode_length=40, trained for 400 env steps: ")


def test_the_checksum_is_that_of_the_file_that_was_loaded(tmp_path, checkpoint, monkeypatch):
    """A run may replace it while it is read."""
    own = tmp_path / "last.pt"
    own.write_bytes(checkpoint.read_bytes())
    load, loaded = AgentCommandConfig.load, []

    def load_and_replace(config, **options):
        agent = load(config, **options)
        loaded.append(hashlib.sha256(own.read_bytes()).hexdigest())
        if len(loaded) == 1:
            untrained(tmp_path, num_dynamics=3)
        return agent

    monkeypatch.setattr(AgentCommandConfig, "load", load_and_replace)
    agent, _, digest = AgentCommandConfig(checkpoint=str(own)).load_known()
    assert len(set(loaded)) == 2 and digest == loaded[-1]
    assert agent.world_model.num_dynamics == 3


@pytest.mark.slow  # the gradients alone take seconds
def test_all_makes_every_study(tmp_path, checkpoint, study):
    message, out, err = study("all", f"checkpoint={checkpoint}", *FEW)
    assert (message, err) == (None, "")
    for name in NAMES:
        made(tmp_path / "studies", name)
    assert [line.split(":")[0] for line in out.splitlines()[1:] if not line.startswith(" ")] == NAMES


def test_every_study_has_a_function_of_its_name_and_the_three_others():
    for name in NAMES:
        module = importlib.import_module(f"torchrl_etdmpc.inspector.studies.{name}")
        assert all(callable(getattr(module, part)) for part in (name, "table", "lines", "figure"))


@pytest.mark.parametrize(
    ("arguments", "error"),
    [
        (("cross", "checkpoint=a.pt"), "error: study must be one of all, cross_scoring, "),
        (("checkpoint=a.pt",), "error: study=... is missing: the study, also written without"),
        (("all",), "error: checkpoint=... is missing: an agent file"),
        (("all", "checkpoint=a.pt"), "error: a.pt is not a file; pass a checkpoint such as "),
        (("all", "checkpoint=a.pt", "episodes=0"), "error: episodes must be at least 1, got 0."),
        (("all", "checkpoint=a.pt", "states=0"), "error: states must be at least 1, got 0."),
        (
            ("all", "checkpoint=a.pt", "seed=4294967295"),
            "error: seed must be in [0, 2**32 - episodes), got 4294967295.",
        ),
    ],
)
def test_a_mistake_is_one_line(study, arguments, error):
    message, out, err = study(*arguments)
    assert str(message).startswith(error)
    assert "\n" not in str(message)
    assert (out, err) == ("", "")


def test_what_cannot_be_measured_or_drawn_is_left_out_and_said_and_costs_no_other_study(study, tmp_path, monkeypatch):
    def figure(result):
        raise ValueError("nothing to draw")

    monkeypatch.setattr(consistency, "figure", figure)
    checkpoint = untrained(tmp_path, num_dynamics=1)
    message, out, _ = study("all", f"checkpoint={checkpoint}", *FEW)
    assert message is None
    assert "calibration: left out: num_dynamics must be at least 2 for heads to disagree, got 1." in out.splitlines()
    assert "consistency: left out: nothing to draw" in out.splitlines()
    for kind in ("json", "png"):
        assert {path.stem for path in Path("studies").glob(f"*.{kind}")} == {*NAMES} - {"calibration", "consistency"}
    message, _, _ = study("calibration", f"checkpoint={checkpoint}", *FEW)
    assert str(message) == "error: num_dynamics must be at least 2 for heads to disagree, got 1."


def test_an_agent_of_another_task_is_refused(checkpoint, study):
    message, _, _ = study("all", f"checkpoint={checkpoint}", "task=walker-walk", *FEW)
    assert "the environment has 24 and 6; use the task it was trained on (cartpole-balance)." in str(message)


def test_episodes_that_are_too_short_are_refused(checkpoint, study):
    message, _, _ = study("calibration", f"checkpoint={checkpoint}", "task.episode_length=8", *FEW)
    assert str(message) == (
        "error: states must be at least 1 and have 6 decisions after them, got states=6 and episodes of at most 4 "
        "decisions; take longer episodes."
    )


def test_no_state_looks_beyond_the_time_limit(tmp_path, study):
    pytest.importorskip("gymnasium")
    checkpoint = untrained(tmp_path, num_dynamics=2, task="gym/InvertedPendulum-v5", observation_dim=4)
    arguments = (f"checkpoint={checkpoint}", "task.episode_length=3", *FEW, "out=st")
    message, _, _ = study("cross_scoring", *arguments)  # it falls at the third decision, which is the last
    assert message is None
    assert np.load(Path("st", "cross_scoring.npz"))["episode"].tolist() == [0, 1]  # three steps ahead of the starts


def test_plans_have_the_command_s_seed_and_the_study_s_name_may_be_written_as_a_setting(checkpoint, study):
    message, out, err = study("study=consistency", f"checkpoint={checkpoint}", *FEW)
    assert (message, err) == (None, "")
    assert "consistency: studies/consistency.png" in out
    made(Path("studies"), "consistency")
    agent, config, _ = load_agent(checkpoint)
    episodes = [play_episode(agent.eval_planner, config.task_spec, seed=seed) for seed in (4, 5)]
    states = choose_states(episodes, 6, ahead=1, seed=4)
    change = np.load(Path("studies", "consistency.npz"))["change"]
    same, other = (consistency.consistency(agent.eval_planner, states, seed=seed).change for seed in (4, 0))
    np.testing.assert_array_equal(change, same)
    assert not np.allclose(change, other)


def test_every_study_is_asked_with_the_command_s_seed(checkpoint, study, monkeypatch):
    given = {}
    for name in NAMES:

        def ask(*_, seed: int = 0, name: str = name, **__) -> None:
            given[name] = seed
            raise ValueError("no more is needed")

        monkeypatch.setattr(importlib.import_module(f"torchrl_etdmpc.inspector.studies.{name}"), name, ask)
    message, _, _ = study("all", f"checkpoint={checkpoint}", *FEW)
    assert message == "error: no more is needed"
    assert given == dict.fromkeys(NAMES, 4)


def test_values_are_asked_for_in_the_first_half_of_an_episode(checkpoint, study):
    message, _, _ = study("value_bias", f"checkpoint={checkpoint}", "episodes=2", "states=40", "device=cpu", "out=st")
    assert message is None
    steps = np.load(Path("st", "value_bias.npz"))["step"]
    assert sorted({*steps.tolist()}) == list(range(16))  # of 30, so that 15 follow


def test_whole_plans_fit_into_the_rest_of_the_episode(checkpoint, study):
    few = ("task.episode_length=10", "episodes=2", "states=40", "device=cpu")
    message, _, _ = study("latent_gallery", f"checkpoint={checkpoint}", *few, "out=st")
    assert message is None
    returns = np.load(Path("st", "latent_gallery.npz"))["true_returns"]
    assert returns.shape == (2 * 4, 2, 2)  # four of five decisions, of which two are planned
    assert np.isfinite(returns).all()


def test_episodes_that_end_early_count_as_long_as_they_were(tmp_path, study):
    pytest.importorskip("gymnasium")
    checkpoint = untrained(tmp_path, num_dynamics=2, task="gym/InvertedPendulum-v5", observation_dim=4)
    for name in ("value_bias", "advantage", "cross_scoring"):
        assert study(name, f"checkpoint={checkpoint}", *FEW, "out=st")[0] is None
    about = json.loads(Path("st", "cross_scoring.json").read_text(encoding="utf-8"))
    assert about["mean_return"] < 100  # of 1,000 decisions, each of which is worth 1
    true = [row for row in rows(Path("st", "cross_scoring.csv")) if row["scored_by"] == "simulator"]
    assert all(abs(float(row["gain"])) < 100 for row in true)
    played = about["mean_return"] + 1  # the decision that ends it pays nothing
    assert np.load(Path("st", "cross_scoring.npz"))["scale"] == pytest.approx(round(played) / 3)


@pytest.mark.parametrize(
    ("out", "error"),
    [
        ("notes.txt", "error: notes.txt is a file; name a folder."),
        ("/proc/study", "error: /proc/study cannot be written (No such file or directory); choose another path."),
    ],
)
def test_a_folder_that_cannot_be_written_is_an_error_before_the_episodes(study, checkpoint, tmp_path, out, error):
    (tmp_path / "notes.txt").write_text("mine")
    message, said, _ = study("value_bias", f"checkpoint={checkpoint}", *FEW, f"out={out}")
    assert message == error
    assert said == ""


def test_one_episode_has_no_interval_and_says_so(study, checkpoint):
    _, said, _ = study("value_bias", f"checkpoint={checkpoint}", "episodes=1", "states=4", "device=cpu", "out=out")
    assert "intervals are over whole episodes, so they are nan; episodes=2 is the least that has some" in said
