"""Shows what the planner of a trained agent sees, on a page in the browser; save= writes the page as files instead.

    python examples/inspect_planner.py checkpoint=runs/walker-walk/cpu/seed1/checkpoints/best.pt state=0:100

The code is `torchrl_etdmpc/commands/inspect_planner.py`; installed from a wheel, the command is
`torchrl-etdmpc inspect_planner`.
"""

from __future__ import annotations

from torchrl_etdmpc.commands import main

if __name__ == "__main__":
    main("inspect_planner")
