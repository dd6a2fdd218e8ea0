"""A run directory: its files, its tables, its progress. Knows nothing of learning."""

from torchrl_etdmpc.runs.console import console
from torchrl_etdmpc.runs.directory import RunDirectory
from torchrl_etdmpc.runs.errors import first_line
from torchrl_etdmpc.runs.files import DamagedFileError, replacing
from torchrl_etdmpc.runs.interval_means import IntervalMeans
from torchrl_etdmpc.runs.log import COUNTER_COLUMNS, EVAL_COLUMNS, RunLog
from torchrl_etdmpc.runs.loggers import LoggerName, make_logger, require_logger
from torchrl_etdmpc.runs.machine import machine_memory, processor, usable_cores
from torchrl_etdmpc.runs.progress_bar import ProgressBar, progress_bar
from torchrl_etdmpc.runs.versions import library_versions, source_commit
from torchrl_etdmpc.runs.video import write_film, write_mp4

__all__ = [
    "COUNTER_COLUMNS",
    "EVAL_COLUMNS",
    "DamagedFileError",
    "IntervalMeans",
    "LoggerName",
    "ProgressBar",
    "RunDirectory",
    "RunLog",
    "console",
    "first_line",
    "library_versions",
    "machine_memory",
    "make_logger",
    "processor",
    "progress_bar",
    "replacing",
    "require_logger",
    "source_commit",
    "usable_cores",
    "write_film",
    "write_mp4",
]
