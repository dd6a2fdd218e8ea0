"""Evaluates a checkpoint: returns of whole episodes with the planner or with the bare policy, and a film if asked for.

    python examples/evaluate.py checkpoint=runs/walker-walk/cpu/seed1/checkpoints/last.pt episodes=10 video=walker.mp4

The code is `torchrl_etdmpc/commands/evaluate.py`; installed from a wheel, the command is `torchrl-etdmpc evaluate`.
"""

from __future__ import annotations

from torchrl_etdmpc.commands import main

if __name__ == "__main__":
    main("evaluate")
