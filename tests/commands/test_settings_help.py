from __future__ import annotations

from dataclasses import dataclass

import pytest

from torchrl_etdmpc.commands.evaluate import EvaluateConfig
from torchrl_etdmpc.commands.export import ExportConfig
from torchrl_etdmpc.commands.settings_help import groups_of, help_text, settings_of
from torchrl_etdmpc.training import TrainConfig, preset


@pytest.mark.parametrize("config_class", [TrainConfig, EvaluateConfig, ExportConfig])
def test_every_setting_has_a_meaning_in_a_docstring(config_class):
    assert [name for name, setting in settings_of(config_class).items() if len(setting.meaning) < 8] == []


def test_the_names_are_those_of_the_command_line():
    names = set(settings_of(TrainConfig))
    assert {"task", "task.action_repeat", "planner.horizon", "reanalyze.every", "optim.lr"} <= names
    assert "action_repeat" not in names


def test_a_meaning_comes_from_the_class_that_takes_the_argument_without_its_default_or_markup():
    settings = settings_of(TrainConfig)
    assert settings["model.dropout"].meaning == "of the first hidden layer of the value heads, in [0, 1)."
    assert settings["optim.grad_clip_norm"].meaning == "largest gradient norm of the model and of the policy."
    assert not any(mark in setting.meaning for setting in settings.values() for mark in '`"')


def test_a_meaning_does_not_repeat_the_setting_s_name():
    for config_class in (TrainConfig, EvaluateConfig):
        settings = settings_of(config_class)
        assert settings["task.action_repeat"].meaning.startswith("Environment steps per decision. Default: ")
        assert settings["task.terminates"].meaning.startswith("Whether episodes can end before their time limit. ")


def test_a_field_s_own_docstring_comes_first_and_a_group_inherits_those_of_its_base():
    settings = settings_of(TrainConfig)
    assert settings["planner.iterations"].meaning == settings["reanalyze.iterations"].meaning
    assert settings["reanalyze.num_slices"].meaning.startswith("slices to re-plan")
    assert settings["planner.score"].choices == ("final", "mean", "adaptive")


def test_the_main_help_holds_usage_main_settings_defaults_and_groups_in_80_columns(monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    text = help_text(TrainConfig, "Trains.", "python examples/train.py")
    assert "usage: python examples/train.py [SETTING=VALUE ...]" in text
    assert "  total_env_steps=200000 " in text
    assert "  eval_policy=false " in text
    assert all(f"  {group}.*" in text for group in groups_of(TrainConfig))
    assert "planner.horizon" not in text
    groups = help_text(TrainConfig, "", "", tuple(groups_of(TrainConfig)))
    assert max(map(len, [*text.splitlines(), *groups.splitlines()])) <= 80
    assert "  reanalyze.proposal_log_std_min=-2.0" in groups.splitlines()  # too long for its column


def test_a_wide_terminal_gets_lines_that_can_be_read(monkeypatch):
    monkeypatch.setenv("COLUMNS", "300")
    assert 90 < max(map(len, help_text(TrainConfig, "Trains.", "train").splitlines())) <= 100


def test_what_must_be_given_and_what_the_command_has_of_its_own_comes_first():
    assert list(settings_of(ExportConfig))[:3] == ["checkpoint", "out", "batch_size"]


@dataclass
class Bare:
    """A configuration without a task, without groups, and with a setting that nobody explains."""

    size: int = 3


def test_the_help_offers_what_the_command_can_do_and_nothing_else():
    expected = {TrainConfig: "task=a,b", EvaluateConfig: "seed=1,2", ExportConfig: None, Bare: None}
    for config_class, swept in expected.items():
        text = help_text(config_class, "", "")
        assert ("task=list" in text) == (config_class is not Bare)
        assert ("--help preset=cpu" in text) == (config_class is TrainConfig)
        assert f"--multirun {swept} " in text if swept else "--multirun" not in text
    assert "  size=3\n" in text


@pytest.mark.parametrize("columns", ["1", "20", "37"])
def test_a_narrow_terminal_gets_help_too(monkeypatch, columns):
    monkeypatch.setenv("COLUMNS", columns)
    assert "  total_env_steps=200000 " in help_text(TrainConfig, "Trains.", "python examples/train.py")
    assert "planner.horizon=6" in help_text(TrainConfig, "", "", ("planner",))


def test_a_group_or_one_setting_can_be_asked_for():
    text = help_text(TrainConfig, "", "", ("planner",))
    assert "planner.horizon=6" in text
    assert "One of final, mean, adaptive." in " ".join(text.split())
    assert "reanalyze" not in text
    assert help_text(TrainConfig, "", "", ("optim.lr",)).splitlines() == [
        "  optim.lr=0.0003                    Learning rate."
    ]


def test_a_preset_s_values_take_the_place_of_the_defaults():
    values = {"planner.horizon": preset("cpu").planner.horizon}
    assert "planner.horizon=3 " in help_text(TrainConfig, "", "", ("planner",), values)


def test_what_must_be_given_is_in_the_usage():
    assert "usage: torchrl-etdmpc evaluate checkpoint=... [" in help_text(EvaluateConfig, "", "torchrl-etdmpc evaluate")
