"""Trains every run of an experiment: tasks x seeds x variants.

    python examples/suite.py list
    python examples/suite.py experiment=dynamics-ensemble dry_run=true
    python examples/suite.py experiment=cpu-easy tasks=walker-walk,cup-catch seeds=2
    python examples/suite.py status experiment=cpu-easy

The code is `torchrl_etdmpc/commands/suite.py`; installed from a wheel, the command is `torchrl-etdmpc suite`.
"""

from __future__ import annotations

from torchrl_etdmpc.commands import main

if __name__ == "__main__":
    main("suite")
