"""Writes a checkpoint's policy and planner as `torch.export` programs, which run where only PyTorch is installed.

    python examples/export.py checkpoint=runs/walker-walk/cpu/seed1/checkpoints/best.pt out=exported

    policy = torch.export.load("exported/policy.pt2").module()      # observation [B, O] -> action [B, A]
    planner = torch.export.load("exported/planner.pt2").module()    # observation, plan_mean -> action, plan_mean
    action, plan_mean = planner(observation, plan_mean)             # plan_mean [B, H, A]: zeros when an episode begins

Observations and actions are those of the training environment, e.g. walker's 24 numbers in dm_control's order and
actions in [-1, 1]. The code is `torchrl_etdmpc/commands/export.py`; installed from a wheel, the command is
`torchrl-etdmpc export`.
"""

from __future__ import annotations

from torchrl_etdmpc.commands import main

if __name__ == "__main__":
    main("export")
