"""Learning curves, areas, tables and figures, from files: nothing here needs the learning code.

Needs ``pip install matplotlib pandas pyyaml scipy``.
"""

try:
    import matplotlib
    import pandas
    import scipy
    import yaml
except ImportError as error:
    raise ImportError(
        f"reports need {error.name}, which is not installed; run: pip install matplotlib pandas pyyaml scipy"
    ) from error

from torchrl_etdmpc.analysis.benchmarks import (
    BENCHMARKS,
    HUMANOIDBENCH_HARD,
    Benchmark,
    benchmark_of,
    get_benchmark,
    own_benchmark,
)
from torchrl_etdmpc.analysis.comparison import Comparison, compare, merge_estimates
from torchrl_etdmpc.analysis.curves import find_runs, join_curves, read_curves, read_run, read_runs
from torchrl_etdmpc.analysis.figures import method_styles, plot_aggregate, plot_auc, plot_curves, plot_run
from torchrl_etdmpc.analysis.report import write_report
from torchrl_etdmpc.analysis.robust import Interval, interquartile_mean, probability_of_improvement, scores_at
from torchrl_etdmpc.analysis.statistics import (
    add_interval,
    aggregate,
    auc,
    auc_standard_error,
    estimate,
    interpolate,
    normalise,
    normalisers,
    seed_estimates,
    shared_grid,
)
from torchrl_etdmpc.analysis.tables import AGGREGATE, rank_methods, result_table, to_csv, to_markdown

del matplotlib, pandas, scipy, yaml

__all__ = [
    "AGGREGATE",
    "BENCHMARKS",
    "HUMANOIDBENCH_HARD",
    "Benchmark",
    "Comparison",
    "Interval",
    "add_interval",
    "aggregate",
    "auc",
    "auc_standard_error",
    "benchmark_of",
    "compare",
    "estimate",
    "find_runs",
    "get_benchmark",
    "interpolate",
    "interquartile_mean",
    "join_curves",
    "merge_estimates",
    "method_styles",
    "normalise",
    "normalisers",
    "own_benchmark",
    "plot_aggregate",
    "plot_auc",
    "plot_curves",
    "plot_run",
    "probability_of_improvement",
    "rank_methods",
    "read_curves",
    "read_run",
    "read_runs",
    "result_table",
    "scores_at",
    "seed_estimates",
    "shared_grid",
    "to_csv",
    "to_markdown",
    "write_report",
]
