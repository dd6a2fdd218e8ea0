"""All tasks of a benchmark with a preset at full size: build, collect, plan, reanalyze, update for a handful of steps.

    python benchmarks/all_tasks.py                              # DMC's 28, about fifteen minutes on two cores
    python benchmarks/all_tasks.py --tasks dog-run humanoid-run --preset bmpc --out part.csv
    .venv-humanoidbench/bin/python benchmarks/all_tasks.py --benchmark humanoidbench

Checks that everything is finite; where episodes can end early, how many did in the random phase, and that their head
learns. Prints a row per task; writes `benchmarks/results/<device>/all_tasks.csv`, all_tasks_humanoidbench.csv for
HumanoidBench, or what ``--out`` names, which some of the tasks or another preset need. A task that fails has no row;
then it exits with 1. Times are of the first call, in eager mode.
"""

from __future__ import annotations

import argparse
import csv
import dataclasses
import math
import os
import sys
import time
from pathlib import Path

os.environ.setdefault("MUJOCO_GL", "disable")

import torch  # noqa: E402

from torchrl_etdmpc.envs import DMC_TASKS, HUMANOIDBENCH_HARD, env_sizes, get_task, make_env  # noqa: E402
from torchrl_etdmpc.training import (  # noqa: E402
    build_agent,
    build_collector,
    build_reanalyze,
    build_replay,
    preset,
    resolve_device,
)

ROOT = Path(__file__).resolve().parent.parent
COLUMNS = ("task", "observation", "action", "iterations", "parameters", "plan_s", "reanalyze_s", "update_s", "loss")
SEED_DECISIONS = 30
EARLY_ENDS = 300  # random decisions where episodes can end early; most of them do so within 100
# File, tasks, preset, columns.
BENCHMARKS = {
    "dmc": ("all_tasks", DMC_TASKS, "efficient-tdmpc-utd4", COLUMNS),
    "humanoidbench": (
        "all_tasks_humanoidbench",
        HUMANOIDBENCH_HARD,
        "humanoidbench",
        (*COLUMNS, "random_decisions", "terminations", "termination_loss"),
    ),
}


def timed(device: torch.device, function):
    """The result and the seconds it took."""
    start = time.perf_counter()
    result = function()
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return result, time.perf_counter() - start


def exercise(task: str, preset_name: str, device: torch.device) -> dict[str, object]:
    """A handful of steps of one task.

    Raises:
        RuntimeError: if a loss, a gradient norm or a weight is not finite, a target was not refreshed, or the
            termination head has nothing to learn where episodes can end early.
    """
    base = preset(preset_name)
    terminates = get_task(task).terminates
    decisions = EARLY_ENDS if terminates else SEED_DECISIONS
    replay_config = dataclasses.replace(base.replay, seed_decisions=decisions, insertion="step")
    config = dataclasses.replace(base, task=task, compile="off", total_env_steps=5000, replay=replay_config)
    torch.manual_seed(0)
    env = make_env(task, seed=0)
    agent = build_agent(config, **env_sizes(env), device=device)
    replay = build_replay(config, device)
    reanalyze = build_reanalyze(config, agent, replay)
    collector = build_collector(config, agent, env, replay)
    reanalyze.enabled = False
    terminations = sum(int(collector.step()["next", "terminated"].sum()) for _ in range(decisions))
    agent.updater.step(replay.sample().to(device), distill=False)  # pretraining
    _, plan_s = timed(device, collector.step)
    batch, reanalyze_s = timed(device, lambda: reanalyze.refresh(replay.sample()))
    metrics, update_s = timed(device, lambda: agent.updater.step(batch.to(device), distill=True))
    collector.shutdown()
    values = {name: float(value) for name, value in metrics.items()}
    if terminates and not values["loss_termination"] > 0:
        raise RuntimeError(f"the loss of the terminations is {values['loss_termination']}")
    broken = [name for name, value in values.items() if not math.isfinite(value)]
    broken += [name for name, weight in agent.world_model.named_parameters() if not weight.isfinite().all()]
    if broken:
        raise RuntimeError(f"not finite: {', '.join(broken)}")
    if reanalyze.refreshed == 0 or reanalyze.stale:
        raise RuntimeError(f"reanalyze refreshed {reanalyze.refreshed} targets and found {reanalyze.stale} stale")
    return {
        "task": task,
        "observation": agent.world_model.observation_dim,
        "action": agent.world_model.action_dim,
        "iterations": agent.planner.iterations,
        "parameters": sum(parameter.numel() for parameter in agent.world_model.parameters()),
        "plan_s": round(plan_s, 3),
        "reanalyze_s": round(reanalyze_s, 3),
        "update_s": round(update_s, 3),
        "loss": round(sum(value for name, value in values.items() if name.startswith("loss_")), 4),
        "random_decisions": decisions,
        "terminations": terminations,
        "termination_loss": round(values.get("loss_termination", 0.0), 4),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--benchmark", choices=BENCHMARKS, default="dmc")
    parser.add_argument("--tasks", nargs="+", help="default: all of the benchmark")
    parser.add_argument("--preset", help="default: efficient-tdmpc-utd4, or humanoidbench")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--out", type=Path, help="a CSV file; default: the benchmark's, for all tasks and its preset")
    arguments = parser.parse_args()
    if arguments.out is None and (arguments.tasks or arguments.preset):
        sys.exit("error: --tasks and --preset make another table than the committed one; name a file for it by --out.")
    device = resolve_device(arguments.device)
    name = "cpu" if device.type == "cpu" else torch.cuda.get_device_name(device).lower().replace(" ", "-")
    file_name, tasks, preset_name, columns = BENCHMARKS[arguments.benchmark]
    tasks, preset_name = arguments.tasks or tasks, arguments.preset or preset_name
    path = arguments.out or ROOT / "benchmarks" / "results" / name / f"{file_name}.csv"
    path.parent.mkdir(parents=True, exist_ok=True)
    failed = 0
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, columns, lineterminator="\n", extrasaction="ignore")
        writer.writeheader()
        print(" ".join(f"{column:>12}" for column in columns))
        for task in tasks:
            try:
                row = exercise(task, preset_name, device)
            except Exception as error:  # the point is to see which of the tasks fail
                failed += 1
                print(f"{task}: {type(error).__name__}: {error}", flush=True)
                continue
            writer.writerow(row)
            file.flush()
            print(" ".join(f"{row[column]!s:>12}" for column in columns), flush=True)
    print(f"{len(tasks) - failed} of {len(tasks)} tasks passed; rows are in {path}")
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    main()
