"""Compares runs with each other and with published baselines: tables, figures and a page.

    python examples/report.py runs/                               # all runs below a folder
    python examples/report.py ours=runs/a other=runs/b --out report
    python examples/report.py runs/ --budget 50000 --grid-step 10000 --watch

A run directory holds an `eval.csv`. Runs with the same name are seeds of one method; the name is the preset unless
given (`NAME=PATH`). The code is `torchrl_etdmpc/commands/report.py`; installed from a wheel, the command is
`torchrl-etdmpc report`.
"""

from __future__ import annotations

from torchrl_etdmpc.commands import main

if __name__ == "__main__":
    main("report")
