"""The picture of a run: evaluation return against environment steps."""

from __future__ import annotations

import csv
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torchrl_etdmpc.training.atomic_file import replacing

_OKABE_ITO_BLUE = "#0072B2"


def plot_curve(run_dir: str | os.PathLike[str]) -> Path:
    """Draw ``curve.png`` from ``eval.csv``: mean return against environment steps, with a band of one std.

    Args:
        run_dir: the directory of a run that is running or done; ``config.yaml`` gives the title.

    Returns:
        The path of ``curve.png``.

    Raises:
        ImportError: matplotlib or PyYAML is not installed.
        FileNotFoundError: ``run_dir`` has no ``eval.csv`` or no ``config.yaml``.
        ValueError: no evaluation has a finite return.
    """
    try:
        import yaml
        from matplotlib.figure import Figure  # not pyplot: no window, no global state, PNG by Agg
        from matplotlib.ticker import EngFormatter
    except ImportError as error:
        raise ImportError(
            f"plot_curve needs {error.name}, which is not installed; run `pip install matplotlib pyyaml`."
        ) from error
    run_dir = Path(run_dir).expanduser()
    for name in ("config.yaml", "eval.csv"):
        if not (run_dir / name).is_file():
            raise FileNotFoundError(f"run_dir={run_dir} has no {name}; give the directory of a run that has evaluated.")
    config = yaml.safe_load((run_dir / "config.yaml").read_text(encoding="utf-8"))
    with open(run_dir / "eval.csv", newline="", encoding="utf-8") as file:
        rows = [(float(r["env_steps"]), float(r["return_mean"]), float(r["return_std"])) for r in csv.DictReader(file)]
    if not any(math.isfinite(mean) for _, mean, _ in rows):
        raise ValueError(f"run_dir={run_dir} needs an evaluation with a finite return, got none; evaluate first.")
    steps, means, stds = zip(*rows, strict=True)

    figure = Figure(figsize=(6.4, 4.0), dpi=150, layout="tight")
    axes = figure.add_subplot()
    low, high = zip(*((mean - std, mean + std) for mean, std in zip(means, stds, strict=True)), strict=True)
    axes.fill_between(steps, low, high, color=_OKABE_ITO_BLUE, alpha=0.2, linewidth=0, label="\u00b1 1 std")
    axes.plot(steps, means, color=_OKABE_ITO_BLUE, linewidth=1.8, marker="o", markersize=3.5, label="mean")
    axes.set_xlabel("environment steps")
    axes.set_ylabel("episode return")
    axes.set_title(", ".join(_title_parts(config)))
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.set_xlim(left=0)
    axes.set_ylim(bottom=min(0.0, min(value for value in low + means if math.isfinite(value))))
    axes.grid(linewidth=0.5, alpha=0.4)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, loc="best")
    path = run_dir / "curve.png"
    with replacing(path) as partial:
        figure.savefig(partial, format="png")
    return path


def _title_parts(config: Mapping[str, Any]) -> list[str]:
    named = [str(config[key]) for key in ("task", "preset") if key in config]
    return named + ([f"seed {config['seed']}"] if "seed" in config else [])
