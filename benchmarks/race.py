"""What else a user could pick on one CPU core: SAC and TQC of Stable-Baselines3 beside the cpu preset, by the clock.

    pip install --no-deps stable-baselines3==2.9.2 sb3-contrib==2.9.2
    python benchmarks/race.py                                # what is missing, run by run: 13 hours a seed
    python benchmarks/race.py --tasks walker-walk --algorithms tqc --settings zoo --seeds 1
    python benchmarks/race.py --report-only RUN_DIRECTORY... # figure and table, beside finished runs of ours
    python benchmarks/race.py --clock 2 --report-only RUN_DIRECTORY...  # with the minutes of seed 2 alone

The same physics, action repeat, evaluation (mean of 10 episodes without noise on starts that the run's seed gives) and
one thread. Two settings each, because a library is worth what its better one reaches: `default` is
Stable-Baselines3's own, `zoo` is what RL Baselines3 Zoo tuned for PyBullet's locomotion tasks (state-dependent
exploration; hyperparameters of HalfCheetahBulletEnv). Minutes count everything but imports: evaluations too, and for
ours compilation. They are compared where they are of one machine: those of the seeds that `--clock` names, whatever
seeds the returns are of. Writes `benchmarks/results/cpu/race/<method>/<task>/seed<k>/` and, there, `race.png` and
`README.md`, whose table has mean returns over seeds: after so many env steps, with the mean of the minutes until then,
and the last one that is reached within so many minutes, where a method that has ended keeps its last return.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import os
import sys
import time
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import gymnasium
import numpy as np
import pandas as pd
import torch
from cpu_learning import RESULTS
from dm_control import suite
from matplotlib.figure import Figure
from tensordict.nn import TensorDictModule

from torchrl_etdmpc.analysis import Run, add_interval, estimate, find_runs, join_runs
from torchrl_etdmpc.analysis.runs import read_evaluations
from torchrl_etdmpc.collectors import evaluate
from torchrl_etdmpc.envs import get_task, make_env
from torchrl_etdmpc.envs.dmc import domain_and_task
from torchrl_etdmpc.runs import RunDirectory, RunLog, library_versions, processor

FOLDER = RESULTS / "race"
TASKS = ("walker-walk", "cheetah-run", "reacher-easy", "cartpole-swingup")
ALGORITHMS = ("sac", "tqc")
SETTINGS: dict[str, dict[str, Any]] = {
    "default": {},
    "zoo": {
        "learning_rate": 7.3e-4,
        "buffer_size": 300_000,
        "batch_size": 256,
        "ent_coef": "auto",
        "gamma": 0.98,
        "tau": 0.02,
        "train_freq": 8,
        "gradient_steps": 8,
        "learning_starts": 10_000,
        "use_sde": True,
        "policy_kwargs": {"log_std_init": -3, "net_arch": [400, 300]},
    },
}
ENV_STEPS, EVAL_EVERY, EPISODES = 200_000, 10_000, 10
STEPS, MINUTES = (50_000, 100_000, 200_000), (10, 15, 25, 45)  # columns of the table


class DMCGym(gymnasium.Env):
    """A DMC task as Stable-Baselines3 takes it, without the layers of TorchRL."""

    def __init__(self, task: str, seed: int) -> None:
        spec = get_task(task)
        self.env = suite.load(
            *domain_and_task(task), task_kwargs={"random": seed}, environment_kwargs={"flat_observation": True}
        )
        self.env._step_limit = spec.episode_length  # dm_control has no other name for it in steps
        self.repeat = spec.action_repeat
        action = self.env.action_spec()
        size = self.env.observation_spec()["observations"].shape
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, size, np.float32)
        self.action_space = gymnasium.spaces.Box(-1, 1, action.shape, np.float32)
        self._middle, self._half = (action.maximum + action.minimum) / 2, (action.maximum - action.minimum) / 2

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        return self._observation(self.env.reset()), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        reward = 0.0
        for _ in range(self.repeat):
            step = self.env.step(self._middle + self._half * action.astype(np.float64))
            reward += step.reward
            if step.last():
                break
        return self._observation(step), reward, False, step.last(), {}  # DMC ends at its time limit alone

    def _observation(self, step: Any) -> np.ndarray:
        return step.observation["observations"].astype(np.float32)


def train(task: str, algorithm: str, settings: str, seed: int, target: Path, env_steps: int) -> str:
    """One run into ``target``, evaluated as ours are."""
    from stable_baselines3 import SAC

    made_of: Any = SAC
    if algorithm == "tqc":
        from sb3_contrib import TQC as made_of  # noqa: N811

    torch.set_num_threads(1)
    repeat = get_task(task).action_repeat
    model = made_of("MlpPolicy", DMCGym(task, seed), seed=seed, device="cpu", **SETTINGS[settings])
    starts = make_env(task, num_envs=EPISODES, parallel=False)

    def act(observation: torch.Tensor) -> torch.Tensor:
        return torch.from_numpy(model.predict(observation.numpy(), deterministic=True)[0])

    policy = TensorDictModule(act, in_keys=["observation"], out_keys=["action"])
    directory = RunDirectory(target)
    method = f"{algorithm.upper()} ({settings})"
    directory.begin({"task": task, "preset": method, "seed": seed})
    log = RunLog(directory, total_env_steps=env_steps)
    began = time.perf_counter()

    def note() -> float:
        with torch.random.fork_rng([]):
            torch.manual_seed(seed + 10_000)  # the episodes on which a run of ours with this seed is evaluated
            starts.set_seed(seed + 10_000)
            returns = evaluate(starts, policy, episodes=EPISODES).returns
        steps = model.num_timesteps
        counters = {"env_steps": steps * repeat, "decision_steps": steps, "updates": model._n_updates}
        row = {"return_mean": returns.mean().item(), "return_std": returns.std(correction=0).item()}
        log.log_eval({**row, "episodes": EPISODES}, **counters, wall_time_s=time.perf_counter() - began)
        return row["return_mean"]

    final = note()
    for _ in range(EVAL_EVERY, env_steps + 1, EVAL_EVERY):
        model.learn(EVAL_EVERY // repeat, reset_num_timesteps=False)
        final = note()
    versions = library_versions()
    versions |= {name: importlib.metadata.version(name) for name in ("stable-baselines3", "sb3-contrib")}
    summary = {"task": task, "preset": method, "seed": seed, "env_steps": env_steps, "final_return": final}
    summary |= {"wall_time_s": round(time.perf_counter() - began, 1), "processor": processor(), "threads": 1}
    log.finish({**summary, "versions": versions})
    directory.close()
    starts.close()
    return f"{task}, {method}, seed {seed}: return {final:.0f} in {(time.perf_counter() - began) / 60:.0f} min"


def _style(method: str) -> dict[str, str]:
    """A colour and a marker for each algorithm, a dash for its settings."""
    color, marker = {"SAC": ("#D55E00", "s"), "TQC": ("#009E73", "^")}.get(method.partition(" ")[0], ("#0072B2", "o"))
    return {"color": color, "marker": marker, "linestyle": "--" if "(zoo)" in method else "-"}


def _cell(mean: float, minutes: float) -> str:
    """``"834 (15.9)"``, or ``"834"`` where no minutes are known, or a dash where no return is."""
    if np.isnan(mean):
        return "–"
    return f"{mean:.0f}" if np.isnan(minutes) else f"{mean:.0f} ({minutes:.1f})"


def report(ours: list[Path], clock: list[int] | None = None) -> str:
    """Figure and table of every method over env steps and over minutes.

    Args:
        ours: run directories of the preset, finished or not.
        clock: the seeds whose minutes are shown; all of them by default.
    """
    runs = [run for run in map(Run.read, find_runs([FOLDER, *ours])) if run.task in TASKS and run.finished]
    timed = [run for run in runs if clock is None or run.seed in clock]
    if not timed:
        sys.exit("error: no finished run to time by; run this script first, or name other seeds by --clock.")
    curves = join_runs(runs)
    methods = [*sorted(set(curves["method"]) - {"cpu"}), "cpu"]
    styles = {method: _style(method) for method in methods}
    clocks = [read_evaluations(run.path).assign(task=run.task, method=run.method) for run in timed]
    minutes = pd.concat(clocks).assign(minutes=lambda rows: rows["wall_time_s"] / 60)
    minutes = minutes.groupby(["task", "method", "env_steps"])[["minutes"]].mean()
    found = add_interval(estimate(curves)).join(minutes, on=["task", "method", "env_steps"])
    tasks = [task for task in TASKS if task in set(found["task"])]
    figure = Figure(figsize=(3.1 * len(tasks), 5.2), layout="constrained")
    axes = figure.subplots(2, len(tasks), squeeze=False, sharey=True)
    for column, task in enumerate(tasks):
        for row, x in enumerate(("env_steps", "minutes")):
            axis = axes[row, column]
            for method in methods:
                line = found[(found["task"] == task) & (found["method"] == method) & (found["env_steps"] > 0)]
                places = line[x] / 1000 if row == 0 else line[x]
                axis.plot(places, line["mean"], label=method, linewidth=1.6, markersize=4, **styles[method])
                axis.fill_between(places, line["lower"], line["upper"], color=styles[method]["color"], alpha=0.15)
            axis.set(title=task if row == 0 else None, xlabel=("thousand env steps", "minutes on one core")[row])
            axis.grid(alpha=0.3)
    for axis in axes[:, 0]:
        axis.set_ylabel("episode return")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(labels))
    figure.savefig(FOLDER / "race.png", dpi=150)
    lines = ["# By the clock", "", *__doc__.split("\n\n")[-1].splitlines(), ""]
    ran = {run.path.relative_to(FOLDER).parts[0] for run in runs if run.path.is_relative_to(FOLDER)}
    missing = [f"{a}-{s}" for a in ALGORITHMS for s in SETTINGS if f"{a}-{s}" not in ran]
    lines += [f"Not run yet: {', '.join(missing)}.", ""] if missing else []
    heads = [f"{steps:,} env steps" for steps in STEPS] + [f"{limit} minutes" for limit in MINUTES]
    lines += [f"| task | method | seeds | {' | '.join(heads)} |"]
    lines += ["|---" * (3 + len(heads)) + "|"]
    for (task, method), rows in found.groupby(["task", "method"]):
        rows = rows.set_index("env_steps")
        seeds = curves[(curves["task"] == task) & (curves["method"] == method)]["seed"].nunique()
        cells = [_cell(mean, at) for mean, at in rows.reindex(STEPS)[["mean", "minutes"]].to_numpy()]
        within = [rows["mean"][rows["minutes"] <= limit] for limit in MINUTES]
        cells += [f"{each.iloc[-1]:.0f}" if len(each) else "–" for each in within]
        lines.append(f"| {task} | {method} | {seeds} | " + " | ".join(cells) + " |")
    own = [os.path.relpath(run.path, RESULTS) for run in runs if run.method == "cpu"]
    if clock is not None:
        lines += ["", f"Minutes are those of seed {', '.join(map(str, clock))}."]
    lines += ["", f"Runs of ours, below `benchmarks/results/cpu`: {', '.join(own)}."]
    versions = {json.dumps(json.loads(path.read_text())["versions"]) for path in FOLDER.rglob("summary.json")}
    lines += ["", "Versions: " + "; ".join(sorted(versions)).replace('"', "") + "."]
    return "\n".join([*lines, "", "![race](race.png)", ""])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tasks", nargs="+", default=list(TASKS))
    parser.add_argument("--algorithms", nargs="+", choices=ALGORITHMS, default=list(ALGORITHMS))
    parser.add_argument("--settings", nargs="+", choices=list(SETTINGS), default=list(SETTINGS))
    parser.add_argument("--seeds", nargs="+", type=int, default=[1, 2, 3])
    parser.add_argument("--env-steps", type=int, default=ENV_STEPS)
    parser.add_argument("--out", type=Path, default=FOLDER)
    parser.add_argument("--clock", nargs="+", type=int, metavar="SEED")
    parser.add_argument("--report-only", nargs="*", type=Path, metavar="RUNS")
    arguments = parser.parse_args()
    if arguments.report_only is None:
        if arguments.clock is not None:
            parser.error("--clock says whose minutes a report shows; give it together with --report-only.")
        for seed in arguments.seeds:
            for task in arguments.tasks:
                for algorithm in arguments.algorithms:
                    for settings in arguments.settings:
                        target = arguments.out / f"{algorithm}-{settings}" / task / f"seed{seed}"
                        if not RunDirectory(target).finished:
                            print(train(task, algorithm, settings, seed, target, arguments.env_steps), flush=True)
    else:
        (FOLDER / "README.md").write_text(report(arguments.report_only, arguments.clock))


if __name__ == "__main__":
    main()
