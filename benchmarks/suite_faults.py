"""Twelve runs under kill: what a suite finishes is what it would have been, and the rest is named with its reason.

    python benchmarks/suite_faults.py --engine local
    python benchmarks/suite_faults.py --engine ray     # on a cluster of this machine: a head, two nodes

Three tasks, two seeds, two variants, one of which always fails. While `suite` trains them, the suite's process is
killed (SIGKILL) three times and single runs five times, the newest checkpoint of one run is damaged, and with Ray one
node is killed and another one takes its place. After the last start nothing disturbs it. The evaluations of every run
that can finish must be those of a run left alone, to the last digit but for times; each of the others must be named
with its reason. Writes `benchmarks/results/cpu/suite_faults/<engine>.json`. Linux only (it looks for runs in /proc).
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import yaml
from cpu_learning import RESULTS, ROOT

from torchrl_etdmpc.runs import RunDirectory, library_versions
from torchrl_etdmpc.suites import Experiment, Run, read_experiment, read_progress

TASKS = ("cartpole-balance", "pendulum-swingup", "cup-catch")
SETTINGS = {
    "preset": "cpu",
    "device": "cpu",
    "threads": 1,
    "compile": "off",
    "task.episode_length": 200,
    "log_every": 40,
    "eval_every": 250,
    "eval_episodes": 1,
    "checkpoint_every": 50,
    "model.latent_dim": 16,
    "model.mlp_dim": 16,
    "model.encoder_dim": 16,
    "planner.horizon": 2,
    "planner.num_samples": 8,
    "planner.num_elites": 4,
    "planner.num_proposals": 2,
    "planner.iterations": 1,
    "reanalyze.num_samples": 6,
    "reanalyze.num_elites": 3,
    "reanalyze.iterations": 1,
    "optim.batch_size": 4,
    "replay.seed_decisions": 40,
    "replay.pretrain_updates": 4,
}
VARIANTS = {"good": {}, "bad": {"device": "cuda:99"}}  # which fails when it is begun, not when it is read
LIMIT_S = 3600


def write_experiment(file: Path, budget: int, **changes: Any) -> Experiment:
    values = {"tasks": list(TASKS), "seeds": 2, "budget": budget, "settings": SETTINGS, "variants": VARIANTS} | changes
    file.write_text(yaml.safe_dump(values, sort_keys=False))
    return read_experiment(file)


def start_suite(file: Path, runs_dir: Path, *more: str) -> subprocess.Popen:
    command = [sys.executable, str(ROOT / "examples" / "suite.py"), f"experiment={file}", f"runs_dir={runs_dir}"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT / "src")}
    with open(runs_dir.with_suffix(".log"), "ab") as log:
        return subprocess.Popen(
            [*command, "workers=2", "retries=1", *more],
            env=environment,
            stdout=log,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )


def processes_of(run: Run) -> list[int]:
    """Those that train a run, or are about to."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            if f"run_dir={run.path}" in (folder / "cmdline").read_bytes().decode(errors="replace").split("\0"):
                found.append(int(folder.name))
    return found


def kill_run(run: Run) -> bool:
    """Whether there was a process to be killed; it is gone afterwards, and the next one still has its imports to do."""
    for process in processes_of(run):
        with contextlib.suppress(ProcessLookupError):
            os.kill(process, signal.SIGKILL)
            while RunDirectory(run.path).in_use:
                time.sleep(0.01)
            return True
    return False


def learning(runs: list[Run]) -> list[Run]:
    """Runs that have made steps and have a process."""
    return [run for run in runs if read_progress(run).state == "running" and read_progress(run).env_steps > 0]


def ended(runs: list[Run]) -> int:
    return sum(read_progress(run).state == "finished" for run in runs)


def checkpoints(run: Run) -> list[Path]:
    return sorted((RunDirectory(run.path).checkpoints / "resume").glob("[0-9]*"))


def damage(run: Run, chance: random.Random) -> str:
    """Flips a bit of the largest file of the newest checkpoint; says which file it was."""
    newest = checkpoints(run)[-1]
    file = max((path for path in newest.rglob("*") if path.is_file()), key=lambda path: path.stat().st_size)
    data = bytearray(file.read_bytes())
    data[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
    file.unlink()  # it may be linked to another checkpoint's
    file.write_bytes(data)
    return f"{run.name}: {file.relative_to(run.path)}"


def evaluations(run: Run) -> list[dict[str, str]]:
    with open(RunDirectory(run.path).eval, newline="") as file:
        return [{name: value for name, value in row.items() if name != "wall_time_s"} for row in csv.DictReader(file)]


def wait_for(condition, process: subprocess.Popen, limit_s: float = 600.0) -> bool:
    """Whether it came true before the suite ended."""
    deadline = time.monotonic() + limit_s
    while time.monotonic() < deadline and process.poll() is None:
        if condition():
            return True
        time.sleep(0.1)
    return False


class Nodes:
    """A Ray cluster on this machine: a head without CPUs and two nodes with one each."""

    def __init__(self) -> None:
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        from ray.cluster_utils import Cluster

        head = {"num_cpus": 0, "include_dashboard": False, "object_store_memory": 2**27}
        self._node = head | {"num_cpus": 1}
        self.cluster = Cluster(initialize_head=True, head_node_args=head)
        self.nodes = [self.cluster.add_node(**self._node) for _ in range(2)]

    @property
    def address(self) -> str:
        return self.cluster.address

    def replace_one(self) -> None:
        self.cluster.remove_node(self.nodes.pop(0), allow_graceful=False)
        self.nodes.append(self.cluster.add_node(**self._node))

    def close(self) -> None:
        self.cluster.shutdown()


def disturb(
    file: Path,
    runs_dir: Path,
    good: list[Run],
    more: tuple[str, ...],
    chance: random.Random,
    *,
    suite_kills: int,
    run_kills: int,
    nodes: Nodes | None,
) -> dict[str, Any]:
    """Kills and damages until there is nothing more to be done, then waits for the end; says what was done."""
    done: dict[str, Any] = {"suite_kills": 0, "run_kills": [], "node_kills": 0, "damaged": None}
    deadline = time.monotonic() + LIMIT_S
    process = start_suite(file, runs_dir, *more)
    # In an order that holds for all: a kill of the suite after every second kill of a run.
    while len(done["run_kills"]) < run_kills or done["suite_kills"] < suite_kills:
        faults = done["suite_kills"] + len(done["run_kills"])  # spread over the time that all runs take
        if time.monotonic() > deadline or not wait_for(
            lambda n=faults: learning(good) and n // 2 <= ended(good), process
        ):
            process.kill()
            raise RuntimeError(f"the suite ended too early; raise --steps: {runs_dir.with_suffix('.log').read_text()}")
        time.sleep(chance.uniform(0.0, 3.0))
        running = learning(good)
        if not running:
            continue
        if len(done["run_kills"]) < run_kills and (
            done["suite_kills"] == suite_kills or len(done["run_kills"]) <= 2 * done["suite_kills"]
        ):
            run = chance.choice(running)
            steps = read_progress(run).env_steps
            if kill_run(run):
                done["run_kills"].append(f"{run.name} at {steps} env steps")
                if done["damaged"] is None and len(checkpoints(run)) > 1:
                    done["damaged"] = damage(run, chance)
                print(done["run_kills"][-1], done["damaged"], flush=True)
        elif nodes is not None and not done["node_kills"]:
            nodes.replace_one()
            done["node_kills"] += 1
            print("a node", flush=True)
        else:
            process.kill()
            process.wait()
            done["suite_kills"] += 1
            print("the suite", flush=True)
            process = start_suite(file, runs_dir, *more)
    code = process.wait(LIMIT_S)
    return done | {"exit_code": code}


def main(arguments: list[str] | None = None) -> dict[str, Any]:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--engine", choices=["local", "ray"], default="local")
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--suite-kills", type=int, default=3)
    parser.add_argument("--run-kills", type=int, default=5)
    parser.add_argument("--out", type=Path, default=RESULTS / "suite_faults")
    options = parser.parse_args(arguments)
    tick = time.monotonic()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        file = folder / "faults.yaml"
        experiment = write_experiment(file, options.steps)
        code = start_suite(file, folder / "alone", "variants=good").wait(LIMIT_S)
        if code:
            raise RuntimeError((folder / "alone.log").read_text())
        alone = {run.name: evaluations(run) for run in experiment.runs(folder / "alone") if run.variant == "good"}
        print(f"left alone: {time.monotonic() - tick:.0f} s", flush=True)
        runs = experiment.runs(folder / "runs")
        good = [run for run in runs if run.variant == "good"]
        nodes = Nodes() if options.engine == "ray" else None
        more = () if nodes is None else ("engine=ray", f"address={nodes.address}")
        try:
            chance = random.Random(options.seed)
            kills = {"suite_kills": options.suite_kills, "run_kills": options.run_kills, "nodes": nodes}
            done = disturb(file, folder / "runs", good, more, chance, **kills)
        finally:
            if nodes is not None:
                nodes.close()
        progress = {run.name: read_progress(run) for run in runs}
        said = (folder / "runs.log").read_text().rpartition("variant ")[2]
        answer = {
            "engine": options.engine,
            "env_steps": options.steps,
            "seed": options.seed,
            **done,
            "finished": sum(entry.state == "finished" for entry in progress.values()),
            "same_evaluations": sum(evaluations(run) == alone[run.name] for run in good),
            "failed_and_named": {
                name: entry.error
                for name, entry in progress.items()
                if entry.state == "failed" and entry.error and f"failed: {name}: {entry.error}" in said
            },
            "other": {
                name: entry.state for name, entry in progress.items() if entry.state not in ("finished", "failed")
            },
            "tracebacks": sum("Traceback" in (run.path / "suite.log").read_text() for run in good)
            + (folder / "runs.log").read_text().count("Traceback"),
            "minutes": round((time.monotonic() - tick) / 60, 1),
            "versions": library_versions(),
        }
        if answer["other"] or answer["same_evaluations"] < len(good):
            print((folder / "runs.log").read_text())
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / f"{options.engine}.json").write_text(json.dumps(answer, indent=1) + "\n")
    print(json.dumps(answer, indent=1))
    return answer


if __name__ == "__main__":
    answer = main()
    whole = answer["finished"] == answer["same_evaluations"] == len(answer["failed_and_named"]) == 6
    sys.exit(0 if whole and not answer["tracebacks"] else 1)
