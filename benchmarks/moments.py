"""How much does a run's return depend on the moment at which it is evaluated?

    python benchmarks/moments.py runs/mine                    # goes on for 8 x 300 env steps
    python benchmarks/moments.py runs/mine --every 100 --times 20 --out moments.csv
    python benchmarks/moments.py runs/mine --compare acting   # an elite acts, the mean, or as in training

Goes on from the last checkpoint of a run, in a copy of it, and every so many env steps plays the evaluation's episodes,
the same ones each time: by the weights of that moment, by their running averages (decay per decision) or in the other
ways of acting, and by the policy of that moment without the planner. Prints a table, with the mean return of the
training episodes that ended in between.
"""

from __future__ import annotations

import argparse
import csv
import dataclasses
import itertools
import math
import os
import shutil
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import ExplorationType
from torchrl.envs.utils import set_exploration_type

from torchrl_etdmpc.checkpoints import CheckpointError
from torchrl_etdmpc.envs import make_env
from torchrl_etdmpc.planners import EnsembleMPPIPlanner
from torchrl_etdmpc.runs import RunDirectory, RunLog
from torchrl_etdmpc.training import TrainingRun, read_run_config

DECAYS = (0.98, 0.995, 0.999)
COMPARED = {
    "averages": tuple(f"average {decay}" for decay in DECAYS),
    "acting": ("elite", "mean", "exploring"),
}


@contextmanager
def weights_of(parameters: list[Tensor], weights: list[Tensor]) -> Iterator[None]:
    """The parameters hold these weights for a while."""
    own = [parameter.detach().clone() for parameter in parameters]
    with torch.no_grad():
        torch._foreach_copy_(parameters, weights)
    yield
    with torch.no_grad():
        torch._foreach_copy_(parameters, own)


@contextmanager
def acting(planner: EnsembleMPPIPlanner, way: str) -> Iterator[None]:
    """The evaluation's planner acts with another choice for a while, or as in training."""
    forward = planner.forward

    def explore(tensordict: TensorDictBase) -> TensorDictBase:
        with set_exploration_type(ExplorationType.RANDOM):
            return forward(tensordict)

    own = planner.eval_first_action
    if way == "exploring":
        planner.forward = explore
    else:
        planner.eval_first_action = way
    yield
    planner.eval_first_action = own
    vars(planner).pop("forward", None)


def moments(run: TrainingRun, every: int, times: int, compared: str) -> Iterator[list[str]]:
    """A row per moment; ``every`` is in env steps."""
    parameters = [*run.learner.agent.world_model.parameters()]
    averages = {decay: [parameter.detach().clone() for parameter in parameters] for decay in DECAYS}
    latest = [parameter.detach() for parameter in parameters]  # follow the optimiser: they share its memory
    for moment in range(times + 1):
        goal = run.env_steps + every * (moment > 0)
        while run.env_steps < goal:
            run.learner.step(updates=True)
            for decay, average in averages.items():
                torch._foreach_lerp_(average, latest, 1 - decay)
        result, returns = run.evaluator(), []
        planner = run.learner.agent.eval_planner
        ways = (
            [weights_of(parameters, average) for average in averages.values()]
            if compared == "averages"
            else [acting(planner, way) for way in COMPARED["acting"]]
        )
        for way in ways:
            with way:
                returns.append(run.evaluator().return_mean)
        policy, trained = result.policy_return, run.learner.pop_row()["episode_return"]
        numbers = (result.return_mean, *returns, math.nan if policy is None else policy, trained)
        yield [str(run.env_steps), *("" if math.isnan(number) else f"{number:.0f}" for number in numbers)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run_dir", type=Path)
    parser.add_argument("--every", type=int, default=300, help="env steps")
    parser.add_argument("--times", type=int, default=8)
    parser.add_argument("--compare", choices=[*COMPARED], default="averages")
    parser.add_argument("--out", type=Path, help="a CSV file")
    arguments = parser.parse_args()
    if min(arguments.every, arguments.times) < 1:
        sys.exit("error: --every and --times must be at least 1.")
    if not RunDirectory(arguments.run_dir).holds_a_run:
        sys.exit(f"error: {arguments.run_dir} is not the directory of a run.")
    try:
        compare(arguments.run_dir, arguments.every, arguments.times, arguments.compare, arguments.out)
    except (CheckpointError, OSError, ValueError) as error:
        sys.exit(f"error: {error}")


def compare(run_dir: Path, every: int, times: int, compared: str, out: Path | None) -> None:
    """Prints the table and writes it to ``out``, row by row."""
    if read_run_config(RunDirectory(run_dir)).optim.average_decay:
        raise ValueError("the run plans with averaged weights already; choose one with optim.average_decay=0.")
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder, open(out or os.devnull, "w", newline="", encoding="utf-8") as file:
        directory = RunDirectory(shutil.copytree(run_dir, Path(folder) / "run"))
        config = dataclasses.replace(read_run_config(directory), eval_policy=True)
        env = make_env(config.task_spec, seed=config.seed, num_envs=config.num_envs)
        eval_env = make_env(config.task_spec, num_envs=config.eval_episodes, parallel=False)
        log = RunLog(directory, total_env_steps=config.total_env_steps)
        run = TrainingRun(config, env=env, eval_env=eval_env, log=log)
        directory.go_on()
        run.checkpoints.restore()
        run.precompile()
        table = csv.writer(file, lineterminator="\n")
        columns = ("env_steps", "latest", *COMPARED[compared], "policy", "in training")
        for row in itertools.chain([columns], moments(run, every, times, compared)):
            print(*row, sep="\t", flush=True)
            table.writerow(row)
            file.flush()
        run.learner.collector.shutdown()
        run.evaluator.close()


if __name__ == "__main__":
    main()
