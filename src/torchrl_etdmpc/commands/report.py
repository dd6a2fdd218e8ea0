"""Compares runs with each other and with published baselines: tables, figures and a page.

  report runs/                               all runs below a folder
  report ours=runs/a other=runs/b --out report
  report runs/ --budget 50000 --grid-step 10000 --watch
  report runs/exp --paired base              variants of an experiment against one of them

Runs with the same name are seeds of one method; the name is the preset unless
given (`NAME=PATH`), and the variant below a folder with an experiment.yaml.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import NoReturn

from torchrl_etdmpc.commands.command_line import one_line_errors

MOST_SECONDS = 1e9  # that a process can sleep


class _OneLineParser(argparse.ArgumentParser):
    """Answers a mistake as the other commands do."""

    def error(self, message: str) -> NoReturn:
        raise ValueError(f"{message}; --help lists the options.")


def parse() -> argparse.Namespace:
    """The command line.

    Raises:
        ValueError: if an option makes no sense.
    """
    from torchrl_etdmpc.analysis import BENCHMARKS, get_benchmark
    from torchrl_etdmpc.commands.report_runs import DEFAULT_POINTS, DEFAULT_REFERENCES, named

    parser = _OneLineParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", metavar="[NAME=]PATH", help="run directories, or folders of them")
    parser.add_argument("--benchmark", help=f"one of {', '.join(BENCHMARKS)}; default: that of the runs' tasks")
    parser.add_argument(
        "--reference",
        nargs="*",
        metavar="CSV",
        default=DEFAULT_REFERENCES,
        help="files of baselines, per seed or as means, in the place of BMPC, TD-MPC2, DR.Q, ...; none: no baselines",
    )
    parser.add_argument(
        "--points",
        nargs="*",
        metavar="CSV",
        help="files of single means that are quoted with a source (default: DC-MPC, MR.Q, ..., unless --reference)",
    )
    parser.add_argument(
        "--paired",
        metavar="BASE",
        help="compares the others with BASE, paired by task and seed (default: the experiment's, or the first name)",
    )
    parser.add_argument("--out", default="report", help="folder of the report (default: report)")
    parser.add_argument("--all-tasks", action="store_true", help="all tasks of the benchmark, not only those with runs")
    parser.add_argument(
        "--budget", type=int, help="env steps; default: the benchmark's, or the largest that all runs reach"
    )
    parser.add_argument("--grid-step", type=int, help="env steps between points of the AUC's grid (default: 100,000)")
    parser.add_argument("--grid-start", type=int, help="first point of the AUC's grid (default: the runs' first)")
    parser.add_argument("--vector", choices=("pdf", "svg"), help="write every figure in this format as well")
    parser.add_argument(
        "--watch", nargs="?", type=float, const=30.0, metavar="SECONDS", help="refresh when new rows arrive, until ^C"
    )
    arguments = parser.parse_args()
    if arguments.points is None:
        theirs = arguments.reference is not parser.get_default("reference")
        arguments.points = [] if theirs else DEFAULT_POINTS
    if arguments.benchmark is not None:
        get_benchmark(arguments.benchmark)  # a wrong name ends here, also when watching
    if not arguments.out:  # of an unset variable of the shell, as below
        raise ValueError("--out must not be empty; leave it out for report.")
    if Path(arguments.out).expanduser().is_file():
        raise ValueError(f"--out={arguments.out} is a file; name a folder.")
    for argument in arguments.runs:
        name, path = named(argument)
        if not path or name == "":
            raise ValueError(f"runs are PATH or NAME=PATH, and neither may be empty, got {argument!r}.")
        if name is not None and hasattr(arguments, name.replace("-", "_")):
            raise ValueError(f"{argument} would call runs {name!r}; an option is written --{name} {path}.")
    for name in ("budget", "grid_step", "grid_start", "watch"):
        value = getattr(arguments, name)
        if value is not None and value <= 0:
            raise ValueError(f"--{name.replace('_', '-')} must be positive, got {value:g}.")
    if arguments.watch is not None and not arguments.watch < MOST_SECONDS:
        raise ValueError(f"--watch must be a number of seconds below {MOST_SECONDS:g}, got {arguments.watch:g}.")
    return arguments


@one_line_errors
def main() -> None:
    """Writes the report, once or again and again."""
    arguments = parse()
    from torchrl_etdmpc.analysis import read_curves, read_points, require_report_folder
    from torchrl_etdmpc.commands.report_runs import report, stamp

    require_report_folder(Path(arguments.out).expanduser())
    references = [(file, read_curves(file)) for file in arguments.reference]
    points = [(file, read_points(file)) for file in arguments.points]
    if arguments.watch is None:
        print(report(arguments, references, points))
        return
    seen = None
    while True:
        try:
            now = stamp(arguments.runs)
            if now != seen:
                print(report(arguments, references, points), flush=True)
                seen = now
        except BrokenPipeError:
            raise
        except (ValueError, OSError) as error:  # a run that is just being made is complete the next time
            print(f"waiting: {error}", file=sys.stderr, flush=True)
        time.sleep(arguments.watch)
