from __future__ import annotations

import json
import runpy
import subprocess
import sys
from pathlib import Path

import pytest
import torch

pytest.importorskip("hydra")

from torchrl_etdmpc.training import TrainConfig, build_agent, load_agent, preset, save_agent  # noqa: E402

ROOT = Path(__file__).resolve().parents[2]
WITHOUT = ("torchrl", "tensordict", "torchrl_etdmpc", "dm_control", "hydra")
# A plan is exported step by step, and the fewer there are, the sooner it is.
SHORT = {"compile": "off", "planner": {"horizon": 2, "iterations": 1}}


def make_agent():
    torch.manual_seed(0)
    config = TrainConfig.from_dict(preset("cpu").to_dict() | SHORT | {"task": "walker-walk"})
    agent = build_agent(config, 24, 6)
    for parameter in agent.world_model.parameters():
        if parameter.ndim > 1:
            torch.nn.init.normal_(parameter, std=parameter.shape[-2] ** -0.5)
    return agent, config


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory) -> Path:
    agent, config = make_agent()
    return save_agent(tmp_path_factory.mktemp("run") / "last.pt", agent, config, {"env_steps": 0})


def test_the_files_run_in_a_process_that_has_pytorch_only(checkpoint, tmp_path, run_script):
    process = run_script("export.py", f"checkpoint={checkpoint}", "out=exported", cwd=tmp_path)
    assert (process.returncode, process.stderr) == (0, "")
    assert process.stdout == (
        "walker-walk: exported/policy.pt2 and exported/planner.pt2, observations [1, 24], actions [1, 6], "
        "plan_mean [1, 2, 6]\n"
    )
    code = f"""
import sys
for name in {WITHOUT!r}:
    sys.modules[name] = None
import torch
observation, plan_mean = torch.full((1, 24), 0.5), torch.zeros(1, 2, 6)
print(torch.export.load("exported/policy.pt2").module()(observation).tolist())
torch.manual_seed(0)
print(torch.export.load("exported/planner.pt2").module()(observation, plan_mean)[0].tolist())
"""
    process = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert process.returncode == 0, process.stderr
    policy, planned = (torch.tensor(json.loads(line)) for line in process.stdout.splitlines())
    agent, _, _ = load_agent(checkpoint)
    observation = torch.full((1, 24), 0.5)
    with torch.no_grad():
        torch.testing.assert_close(policy, agent.world_model.policy(agent.world_model.encode(observation))[0])
    torch.manual_seed(0)
    plan = agent.eval_planner.plan(observation, torch.zeros(1, 2, 6), explore=False)
    torch.testing.assert_close(planned, plan.action)


def test_an_agent_of_a_gymnasium_task_is_exported(tmp_path, monkeypatch, capsys):
    pytest.importorskip("gymnasium")
    config = TrainConfig.from_dict(preset("cpu").to_dict() | SHORT | {"task": "gym/InvertedPendulum-v5"})
    agent = build_agent(config, 4, 1)
    assert agent.world_model.termination_head is not None
    save_agent(tmp_path / "last.pt", agent, config, {"env_steps": 0})
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HYDRA_FULL_ERROR", "0")  # set by the script; this restores it
    monkeypatch.setattr(sys, "argv", ["export.py", "checkpoint=last.pt", "out=exported", "batch_size=2"])
    runpy.run_path(str(ROOT / "examples" / "export.py"), run_name="__main__")
    assert capsys.readouterr().out.startswith("gym/InvertedPendulum-v5: exported/policy.pt2 and exported/planner.pt2")
    planner = torch.export.load(tmp_path / "exported" / "planner.pt2").module()
    action, plan_mean = planner(torch.randn(2, 4), torch.zeros(2, 2, 1))
    assert (action.shape, plan_mean.shape) == ((2, 1), (2, 2, 1))
    policy = torch.export.load(tmp_path / "exported" / "policy.pt2").module()
    observation = torch.randn(1, 4)
    with torch.no_grad():
        torch.testing.assert_close(
            policy(observation), agent.world_model.policy(agent.world_model.encode(observation))[0]
        )


def test_a_full_disk_is_one_line(checkpoint, small_disk, leave_free, tmp_path, run_script):
    leave_free(small_disk, 0)
    process = run_script("export.py", f"checkpoint={checkpoint}", "out=disk/exported", cwd=tmp_path)
    assert process.returncode == 1
    assert process.stderr == "error: [Errno 28] No space left on device: 'disk/exported/policy.pt2'\n"


def test_a_missing_checkpoint_is_one_line(tmp_path, run_script):
    process = run_script("export.py", "checkpoint=none.pt", cwd=tmp_path)
    assert process.returncode == 1
    assert process.stderr == "error: none.pt is not a file; pass a checkpoint such as RUN_DIR/checkpoints/last.pt.\n"
    assert not (tmp_path / "exported").exists()
