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
from torchrl_etdmpc.analysis.comparison import (
    Comparison,
    begins,
    compare,
    evaluated_methods,
    merge_estimates,
    on_common_steps,
)
from torchrl_etdmpc.analysis.curves import join_curves, read_curves, read_points
from torchrl_etdmpc.analysis.experiment import Experiment, experiment_root, incomplete_runs, read_experiment
from torchrl_etdmpc.analysis.figures import method_styles, plot_aggregate, plot_auc, plot_curves, plot_run
from torchrl_etdmpc.analysis.paired import compare_paired
from torchrl_etdmpc.analysis.report import require_report_folder, write_report
from torchrl_etdmpc.analysis.robust import Interval, interquartile_mean, probability_of_improvement, scores_at
from torchrl_etdmpc.analysis.runs import Run, find_runs, join_runs, mixed_settings, read_run, read_runs
from torchrl_etdmpc.analysis.statistics import (
    add_interval,
    aggregate,
    auc,
    auc_of_seeds,
    estimate,
    interpolate,
    normalise,
    normalisers,
    seed_estimates,
    shared_grid,
)
from torchrl_etdmpc.analysis.steps import MEAN, STEPS, no_points, returns_at
from torchrl_etdmpc.analysis.tables import AGGREGATE, rank_methods, result_table, to_csv, to_markdown

del matplotlib, pandas, scipy, yaml

__all__ = [
    "AGGREGATE",
    "BENCHMARKS",
    "HUMANOIDBENCH_HARD",
    "MEAN",
    "STEPS",
    "Benchmark",
    "Comparison",
    "Experiment",
    "Interval",
    "Run",
    "add_interval",
    "aggregate",
    "auc",
    "auc_of_seeds",
    "begins",
    "benchmark_of",
    "compare",
    "compare_paired",
    "estimate",
    "evaluated_methods",
    "experiment_root",
    "find_runs",
    "get_benchmark",
    "incomplete_runs",
    "interpolate",
    "interquartile_mean",
    "join_curves",
    "join_runs",
    "mixed_settings",
    "merge_estimates",
    "method_styles",
    "no_points",
    "normalise",
    "normalisers",
    "on_common_steps",
    "own_benchmark",
    "plot_aggregate",
    "plot_auc",
    "plot_curves",
    "plot_run",
    "probability_of_improvement",
    "rank_methods",
    "read_curves",
    "read_experiment",
    "read_points",
    "read_run",
    "read_runs",
    "require_report_folder",
    "result_table",
    "returns_at",
    "scores_at",
    "seed_estimates",
    "shared_grid",
    "to_csv",
    "to_markdown",
    "write_report",
]
