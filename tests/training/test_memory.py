from __future__ import annotations

import dataclasses

import pytest
import torch

pytest.importorskip("dm_control")

from torchrl_etdmpc.training import PRESETS, TrainConfig, build_world_model  # noqa: E402
from torchrl_etdmpc.training.config import ReplayConfig  # noqa: E402
from torchrl_etdmpc.training.memory import require_memory  # noqa: E402

BUDGET = {"total_env_steps": 10**14}


@pytest.mark.parametrize("name", PRESETS)
def test_every_preset_fits_into_four_gigabytes(monkeypatch, name):
    monkeypatch.setattr("torchrl_etdmpc.training.memory._memory_bytes", lambda device: 4 * 10**9)
    require_memory(PRESETS[name], 223, 38, torch.device("cpu"))  # dog's sizes, the largest


@pytest.mark.parametrize(
    ("settings", "name"),
    [
        ({"replay": {"capacity": 10**13}, **BUDGET}, "replay.capacity"),
        ({"model": {"mlp_dim": 10**7}}, "model.*"),
        ({"planner": {"num_samples": 10**9}}, "planner.*"),
        ({"planner": {"horizon": 10**9}}, "planner.*"),
        ({"reanalyze": {"num_samples": 10**9}}, "reanalyze.*"),
        ({"optim": {"batch_size": 10**9}}, "optim.batch_size"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_sizes_beyond_the_memory_are_refused_by_name(settings, name):
    with pytest.raises(ValueError, match="choose smaller sizes") as caught:
        require_memory(TrainConfig.from_dict(settings), 24, 6, torch.device("cpu"))
    assert str(caught.value).startswith(f"{name} would take ")
    assert "\n" not in str(caught.value)


def test_the_plans_of_all_episodes_of_an_evaluation_are_made_at_once(monkeypatch):
    monkeypatch.setattr("torchrl_etdmpc.training.memory._memory_bytes", lambda device: 4 * 10**9)
    require_memory(TrainConfig(), 24, 6, torch.device("cpu"))
    with pytest.raises(ValueError, match=r"^planner\.\* would take "):
        require_memory(TrainConfig(eval_episodes=1000), 24, 6, torch.device("cpu"))


def test_a_batch_is_rolled_by_every_dynamics_head(monkeypatch):
    monkeypatch.setattr("torchrl_etdmpc.training.memory._memory_bytes", lambda device: 4 * 10**9)
    settings = {"optim": {"batch_size": 100_000}, "model": {"num_dynamics": 1}}
    require_memory(TrainConfig.from_dict(settings), 24, 6, torch.device("cpu"))
    settings["model"] = {"num_dynamics": 4}
    with pytest.raises(ValueError, match=r"^optim\.batch_size would take "):
        require_memory(TrainConfig.from_dict(settings), 24, 6, torch.device("cpu"))


@pytest.mark.parametrize("name", ["efficient-tdmpc", "tdmpc2"])
def test_weights_count_with_their_targets_gradients_and_moments(monkeypatch, name):
    config = dataclasses.replace(PRESETS[name], replay=ReplayConfig(capacity=10_000, pretrain_policy=name == "tdmpc2"))
    model = build_world_model(config.model, observation_dim=24, action_dim=6)
    once = sum(parameter.numel() * parameter.element_size() for parameter in model.parameters())
    monkeypatch.setattr("torchrl_etdmpc.training.memory._memory_bytes", lambda device: 5.5 * once)
    require_memory(config, 24, 6, torch.device("cpu"))
    monkeypatch.setattr("torchrl_etdmpc.training.memory._memory_bytes", lambda device: 4.5 * once)
    with pytest.raises(ValueError, match=r"^model\.\* would take "):
        require_memory(config, 24, 6, torch.device("cpu"))
