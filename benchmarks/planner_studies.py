"""What agents of the cpu preset believe of their plans and what is true of it: agents, studies, tables.

    python benchmarks/planner_studies.py                 # trains four agents and studies them: over an hour
    python benchmarks/planner_studies.py --report-only   # the tables from the committed files

Agents stand in `runs/planner-agents`, where `examples/suite.py` goes on with interrupted ones; the best of each one's
evaluations is studied. `benchmarks/results/cpu/planner-studies/<task>-seed<k>` gets the tables and what they were made
from, `docs/studies/planner` the figures of seed 1. Writes `README.md` beside the tables.
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pandas as pd
from cpu_learning import RESULTS, ROOT

from torchrl_etdmpc.runs import RunDirectory

TASKS, SEEDS, ENV_STEPS = ("walker-walk", "reacher-easy"), (1, 2), 50_000
EPISODES, STATES = 20, 400
FOLDER, FIGURES = RESULTS / "planner-studies", ROOT / "docs" / "studies" / "planner"
RUNS = ROOT / "runs" / "planner-agents"


def train() -> None:
    """The agents that are missing."""
    command = [sys.executable, str(ROOT / "examples" / "suite.py"), "experiment=cpu-easy", f"tasks={','.join(TASKS)}"]
    command += [f"seeds={list(SEEDS)}", f"total_env_steps={ENV_STEPS}", f"runs_dir={RUNS}"]
    subprocess.run(command, check=True)


def study(task: str, seed: int) -> None:
    """All studies of one agent; that of the solver is about no agent, and not kept."""
    run, out = RunDirectory(RUNS / "cpu" / task / f"seed{seed}"), RUNS / "studies" / f"{task}-seed{seed}"
    agent = [f"checkpoint={run.best_agent.relative_to(ROOT)}", f"episodes={EPISODES}", f"states={STATES}"]
    command = [sys.executable, str(ROOT / "examples" / "study.py"), "all", *agent, f"out={out}"]
    subprocess.run(command, check=True, cwd=ROOT)
    folder = FOLDER / out.name
    folder.mkdir(parents=True, exist_ok=True)
    for name in (table.__name__ for table in TABLES):
        for suffix in (".csv", ".json"):
            shutil.copy(out / f"{name}{suffix}", folder)
        if seed == SEEDS[0]:
            shutil.copy(out / f"{name}.png", FIGURES / f"{out.name}-{name.replace('_', '-')}.png")


def written(row: Any, name: str, digits: int, *, signed: bool = True, without: float | None = None) -> str:
    """``+0.55 [+0.19, +0.99]``, bold where the interval does not hold a number."""
    sign = "+" if signed else ""
    mean, low, high = (f"{row[key]:{sign}.{digits}f}" for key in (name, "low", "high"))
    bold = without is not None and not row["low"] <= without <= row["high"]
    return f"**{mean} [{low}, {high}]**" if bold else f"{mean} [{low}, {high}]"


def cross_scoring(folder: Path) -> list[list[str]]:
    """Gains over the policy's actions by who planned and who scores."""
    rows = pd.read_csv(folder / "cross_scoring.csv").set_index(["found_by", "scored_by"])
    names = {"single head": "one head", "ensemble": "all heads"}
    truth: dict[str, float | None] = {"single head": None, "ensemble": None, "simulator": 0}
    return [
        [name, *(written(rows.loc[by, on], "gain", 0, without=without) for on, without in truth.items())]
        for by, name in names.items()
    ]


def latent_gallery(folder: Path) -> list[list[str]]:
    """What ``beta`` 10 does to a plan, at the last depth."""
    number = r"([-+]?[\d.]+) \[([-+]?[\d.]+), ([-+]?[\d.]+)\]$"
    cells = []
    spread, deviation, difference = lines(folder, "latent_gallery")
    for line, signed in ((spread, False), (deviation, False), (difference, True)):
        found = re.search(number, line)
        assert found is not None, line
        row = dict(zip(("mean", "low", "high"), map(float, found.groups()), strict=True))
        cells.append(written(row, "mean", 2, signed=signed, without=0 if signed else 1))
    return [cells]


def horizon_weights(folder: Path) -> list[list[str]]:
    """Mean depth of the weights in the first and the last iteration."""
    pattern = r"beta (\d+): mean depth ([\d.]+) in the first iteration, ([\d.]+) in the last, change (.*)"
    return [list(re.fullmatch(pattern, line).groups()) for line in lines(folder, "horizon_weights")]  # pyright: ignore


def calibration(folder: Path) -> list[list[str]]:
    """Rank correlation of disagreement and error, and how much larger the error is."""
    rows = pd.read_csv(folder / "calibration.csv").set_index(["actions", "depth"])
    table = []
    for actions in ("planned", "random"):
        cells = [written(rows.loc[actions, depth], "rank_correlation", 2, signed=False) for depth in (1, 3, 6)]
        ratios = ", ".join(f"{rows.loc[(actions, depth), 'error_over_disagreement']:.1f}" for depth in (1, 6))
        table.append([actions, *cells, ratios])
    return table


def value_bias(folder: Path) -> list[list[str]]:
    """Value and score of the plan minus the return that followed."""
    rows = pd.read_csv(folder / "value_bias.csv").set_index("prediction")
    value = rows.loc["value"]
    followed = f"{value['mean_followed']:.1f} +- {value['std_followed']:.1f}"
    biases = [written(rows.loc[name], "bias", 1, without=0) for name in ("value", "plan")]
    return [[*biases, followed, f"{value['correlation']:.2f}"]]


def consistency(folder: Path) -> list[list[str]]:
    """How far the first action moves, in standard deviations."""
    rows = pd.read_csv(folder / "consistency.csv").set_index(["compared", "depth"])
    compared = ("warm start", "cold start", "other samples")
    return [[written(rows.loc[name, 1], "change_in_std", 2, signed=False) for name in compared]]


def advantage(folder: Path) -> list[list[str]]:
    """Rewards of the next 50 decisions, ten of them planned, minus the policy's."""
    row = pd.read_csv(folder / "advantage.csv").loc[0]
    shares = f"{row['planner_better']:.0%}, {row['policy_better']:.0%}"
    return [[written(row, "difference", 2, without=0), f"{row['median']:+.2f}", f"{row['mean_policy']:.1f}", shares]]


TABLES: dict[Callable[[Path], list[list[str]]], tuple[str, str]] = {
    cross_scoring: ("Cross-scoring", "planned with | one head says | all heads say | the simulator says"),
    latent_gallery: (
        "Latent gallery",
        "spread of the heads in latent space | deviation of the returns | true return of the plan, difference",
    ),
    horizon_weights: ("Weights of the horizons", "beta | first | last | change"),
    calibration: ("Calibration", "actions | depth 1 | depth 3 | depth 6 | error over disagreement at 1, 6"),
    value_bias: ("Bias of values and plans", "value | plan | followed | correlation of the value"),
    consistency: ("Consistency", "new plan, warm start | new plan, cold start | same state, other samples"),
    advantage: ("Advantage over the policy", "difference | median | the policy's | planner more, policy more"),
}
"""Title and header of each table by the function of an agent's folder, which has the name of the study."""


def lines(folder: Path, name: str) -> list[str]:
    """What the study says in words."""
    return json.loads((folder / f"{name}.json").read_text())["lines"]


def report(folder: Path) -> str:
    """The agents and a table for every study."""
    agents = {
        path.name.replace("-seed", ", seed "): path for task in TASKS for path in sorted(folder.glob(f"{task}-*"))
    }
    page = ["# What planners of the cpu preset believe", "", *__doc__.strip().split("\n\n")[-1].splitlines(), ""]
    page += [
        "[The page](../../../../docs/studies/planner.md) says what the columns are and what they mean. In brackets are",
        "95% intervals over episodes. What is compared with the truth, the policy or another plan is in bold where its",
        "interval is without 0, or for a ratio without 1.",
        "",
        "| agent | env steps | episodes | return | states |",
        "|---|---|---|---|---|",
    ]
    for name, path in agents.items():
        about = json.loads((path / "value_bias.json").read_text())
        steps, mean = about["trained_env_steps"], about["mean_return"]
        page.append(f"| {name} | {steps:,} | {about['episodes']} | {mean:.0f} | {about['states_asked']} |")
    for table, (title, header) in TABLES.items():
        page += ["", f"## {title}", "", f"| agent | {header} |", "|---" * (2 + header.count("|")) + "|"]
        for name, path in agents.items():
            first, *others = table(path)
            page += [f"| {name} | {' | '.join(first)} |", *(f"|  | {' | '.join(row)} |" for row in others)]
    about = [json.loads(file.read_text()) for file in sorted(folder.rglob("*.json"))]
    versions = "; ".join(sorted({json.dumps(each["versions"]) for each in about})).replace('"', "")
    processors = ", ".join(sorted({each["processor"] for each in about}))
    return "\n".join([*page, "", f"Versions: {versions}. Processor: {processors}.", ""])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--report-only", action="store_true")
    if not parser.parse_args().report_only:
        train()
        for task in TASKS:
            for seed in SEEDS:
                study(task, seed)
    (FOLDER / "README.md").write_text(report(FOLDER))
    print(f"written: {FOLDER / 'README.md'}")


if __name__ == "__main__":
    main()
