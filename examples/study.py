"""Studies of a trained planner: what it believes of its plans, beside what the simulator makes of them.

    python examples/study.py cross_scoring checkpoint=runs/walker-walk/cpu/seed1/checkpoints/best.pt states=500

The code is `torchrl_etdmpc/commands/study.py`; installed from a wheel, the command is `torchrl-etdmpc study`.
"""

from __future__ import annotations

from torchrl_etdmpc.commands import main

if __name__ == "__main__":
    main("study")
