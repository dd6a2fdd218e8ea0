"""``export``: an agent's policy and planner as ``torch.export`` programs."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path

import torch

from torchrl_etdmpc.commands.agent_command import AgentCommandConfig
from torchrl_etdmpc.commands.command_line import hydra_main
from torchrl_etdmpc.planners import export_planner, export_policy
from torchrl_etdmpc.runs.files import make_folder, write_whole


@dataclass(frozen=True, kw_only=True)
class ExportConfig(AgentCommandConfig):
    """What to export."""

    out: str = "exported"
    """Folder for policy.pt2 and planner.pt2."""
    batch_size: int = 1
    """States per call of the planner; the policy takes any number."""

    def __post_init__(self) -> None:
        if self.batch_size < 1:
            raise ValueError(f"batch_size must be at least 1, got {self.batch_size}.")


@hydra_main("export", ExportConfig)
def main(config: ExportConfig) -> None:
    """Writes an agent's policy and planner as programs that run where only PyTorch is installed."""
    out = Path(config.out).expanduser()
    agent, run, _ = config.load()
    if config.task not in (None, run.task):
        raise ValueError(f"task must be that of the checkpoint, {run.task!r}, got {config.task!r}; leave it out.")
    for name in config.changed_task:
        raise ValueError(f"task.{name} changes nothing of a policy or a planner; leave it out.")
    make_folder(out)
    model = agent.acting_model
    assert model.observation_dim is not None  # training takes vectors
    policy = export_policy(model)
    planner = export_planner(agent.eval_planner, batch_size=config.batch_size)
    horizon = agent.eval_planner.horizon
    observation = torch.randn(config.batch_size, model.observation_dim)
    plan_mean = torch.zeros(config.batch_size, horizon, model.action_dim)
    with torch.no_grad():
        torch.testing.assert_close(policy.module()(observation), model.policy(model.encode(observation))[0])
        actions = []
        for plan in (planner.module(), lambda *inputs: agent.eval_planner.plan(*inputs, explore=False)):
            torch.manual_seed(0)
            actions.append(plan(observation, plan_mean)[0])
        torch.testing.assert_close(*actions)
    for name, program in (("policy", policy), ("planner", planner)):
        memory = io.BytesIO()  # where a disk is full, PyTorch would end the process without a word of it
        torch.export.save(program, memory)
        write_whole(out / f"{name}.pt2", memory.getvalue())
    print(
        f"{run.task}: {out}/policy.pt2 and {out}/planner.pt2, observations {list(observation.shape)}, actions "
        f"{list(actions[0].shape)}, plan_mean {list(plan_mean.shape)}"
    )
