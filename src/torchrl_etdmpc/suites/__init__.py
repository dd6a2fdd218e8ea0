"""Many runs: experiments as files, the engines that carry them out, and where each run is."""

from torchrl_etdmpc.suites.begun import extended, require_unchanged
from torchrl_etdmpc.suites.experiment import Experiment, Run, Search
from torchrl_etdmpc.suites.experiment_file import TASK_SETS, find_experiment, read_experiment, write_experiment
from torchrl_etdmpc.suites.index import Progress, RunIndex, read_progress
from torchrl_etdmpc.suites.local import run_locally
from torchrl_etdmpc.suites.ray_engine import run_on_ray
from torchrl_etdmpc.suites.run_queue import RunQueue
from torchrl_etdmpc.suites.slurm import write_slurm_script
from torchrl_etdmpc.suites.status import status_text
from torchrl_etdmpc.suites.sweep import Sweep

__all__ = [
    "TASK_SETS",
    "Experiment",
    "Progress",
    "Run",
    "RunIndex",
    "RunQueue",
    "Search",
    "Sweep",
    "extended",
    "find_experiment",
    "read_experiment",
    "read_progress",
    "require_unchanged",
    "run_locally",
    "run_on_ray",
    "status_text",
    "write_experiment",
    "write_slurm_script",
]
