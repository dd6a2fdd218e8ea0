"""Writes a checkpoint's policy and planner as `torch.export` programs, which run where only PyTorch is installed.

    python examples/export.py checkpoint=runs/walker-walk/cpu/seed1/checkpoints/best.pt out=exported

    policy = torch.export.load("exported/policy.pt2").module()      # observation [B, O] -> action [B, A]
    planner = torch.export.load("exported/planner.pt2").module()    # observation, plan_mean -> action, plan_mean
    action, plan_mean = planner(observation, plan_mean)             # plan_mean [B, H, A]: zeros when an episode begins

Observations and actions are those of the training environment, e.g. walker's 24 numbers in dm_control's order and
actions in [-1, 1].
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch

from torchrl_etdmpc import export_planner, export_policy
from torchrl_etdmpc.runs import replacing
from torchrl_etdmpc.training import hydra_main, load_agent


@dataclass(frozen=True)
class ExportConfig:
    """What to export; see config/export.yaml."""

    checkpoint: str
    out: str = "exported"
    batch_size: int = 1
    task: str | None = None
    action_repeat: int | None = None
    episode_length: int | None = None
    terminates: bool | None = None


@hydra_main(str(Path(__file__).resolve().parent / "config"), "export", ExportConfig)
def main(config: ExportConfig) -> None:
    """Exports, compares with the live agent, writes."""
    agent, run, _ = load_agent(config.checkpoint, compile_setting="off")
    if config.task not in (None, run.task):
        raise ValueError(f"task must be that of the checkpoint, {run.task!r}, got {config.task!r}; leave it out.")
    model = agent.world_model
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
    out = Path(config.out).expanduser()
    out.mkdir(parents=True, exist_ok=True)
    for name, program in (("policy", policy), ("planner", planner)):
        with replacing(out / f"{name}.pt2") as partial:
            torch.export.save(program, partial)
    print(
        f"{run.task}: {out}/policy.pt2 and {out}/planner.pt2, observations {list(observation.shape)}, actions "
        f"{list(actions[0].shape)}, plan_mean {list(plan_mean.shape)}"
    )


if __name__ == "__main__":
    main()
