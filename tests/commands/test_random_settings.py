"""Settings with values that make no sense, drawn at random: each is accepted, or refused in one line that names it."""

from __future__ import annotations

import random
from collections import Counter
from typing import Any
from unittest import mock

import pytest
import torch

pytest.importorskip("dm_control")

from torchrl_etdmpc.commands.settings_help import settings_of  # noqa: E402
from torchrl_etdmpc.training import TrainConfig, build_agent, build_reanalyze, build_replay, memory  # noqa: E402

BASE = {
    "task": "walker-walk",
    "compile": "off",
    "model": {"latent_dim": 16, "mlp_dim": 16, "encoder_dim": 16, "num_dynamics": 2},
    "planner": {"horizon": 2, "num_samples": 8, "num_elites": 4, "num_proposals": 2, "iterations": 1},
    "reanalyze": {"num_samples": 6, "num_elites": 3, "num_proposals": 2, "iterations": 1},
}
INF, NAN = float("inf"), float("nan")
NUMBERS = [0, 1, 2, 3, 7, 64, 1000, 10**6, 2**31, 2**53, 10**30, 0.0, 1e-30, 0.5, 0.99, 1.5, 30.0, 1e9, 1e29, 1e300]
STRANGE = [INF, -INF, NAN, None, True, False, "", "text", "nan", "1e3", "cpu", [], [1], {}, {"a": 1}]
SETTINGS = settings_of(TrainConfig)


def draw_value(name: str, draw: random.Random) -> Any:
    choices = SETTINGS[name].choices
    if choices and draw.random() < 0.5:
        return draw.choice(choices)
    return draw.choice(STRANGE) if draw.random() < 0.3 else draw.choice([1, 1, -1]) * draw.choice(NUMBERS)


def draw_settings(draw: random.Random) -> dict[str, Any]:
    names = draw.sample(sorted(SETTINGS), draw.choice([1, 1, 2, 3]))
    return {name: draw_value(name, draw) for name in names}


def build(changes: dict[str, Any]) -> None:
    values: dict[str, Any] = {name: dict(value) if isinstance(value, dict) else value for name, value in BASE.items()}
    for name, value in changes.items():
        group, _, last = name.removeprefix("task.").rpartition(".")
        (values.setdefault(group, {}) if group else values)[last] = value
    config = TrainConfig.from_dict(values)
    memory.require_memory(config, 24, 6, torch.device("cpu"))
    agent = build_agent(config, 24, 6)
    replay = build_replay(config, sizes=(24, 6))
    build_reanalyze(config, agent, replay)


def judge(number: int) -> str:
    """What became of the settings of one drawing: accepted, or refused in one line that names one of them."""
    changes = draw_settings(random.Random(number))
    try:
        with mock.patch.object(memory, "_memory_bytes", lambda device: 10**8):  # what fits is really allocated here
            build(changes)
    except ValueError as error:
        message = str(error)
        assert "\n" not in message, changes
        said = [name for name in changes if name.rpartition(".")[2] in message]
        said += [name for name in changes if f"{name.partition('.')[0]}.*" in message]  # a group that is too large
        assert said or ("total_env_steps" in changes and "replay.capacity" in message), (changes, message)
        return "refused"
    values = [value for value in changes.values() if isinstance(value, float)]
    assert all(abs(value) < INF for value in values), changes
    return "accepted"


@pytest.mark.parametrize(
    ("first", "count"), [(0, 200), pytest.param(200, 1800, marks=pytest.mark.slow)], ids=["200", "1800 more"]
)
def test_settings_are_accepted_or_refused_in_one_line_that_names_one_of_them(first, count):
    outcomes = Counter(map(judge, range(first, first + count)))
    assert count / 20 < outcomes["accepted"] < count * 3 / 4
