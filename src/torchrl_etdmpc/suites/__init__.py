"""Many runs: experiments as files, the engines that carry them out, and where each run is."""

from torchrl_etdmpc.suites.experiment import (
    TASK_SETS,
    Experiment,
    Run,
    extended,
    find_experiment,
    read_experiment,
    write_experiment,
)
from torchrl_etdmpc.suites.index import Progress, RunIndex, read_progress
from torchrl_etdmpc.suites.local import run_locally
from torchrl_etdmpc.suites.status import status_text

__all__ = [
    "TASK_SETS",
    "Experiment",
    "Progress",
    "Run",
    "RunIndex",
    "extended",
    "find_experiment",
    "read_experiment",
    "read_progress",
    "run_locally",
    "status_text",
    "write_experiment",
]
