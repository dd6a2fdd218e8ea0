"""Kills, signals, flipped bits, settings: a run ends as if nothing had happened, or says in a line what is wrong.

    python benchmarks/faults.py kills --number 300   # real processes, stopped at random moments from their imports on;
                                                     # --kind "one environment" for a part of them
    python benchmarks/faults.py flips --number 20000 # in any file of a run that is gone on with
    python benchmarks/faults.py settings --number 2000

*kills*: small runs with one environment, three environments, and compilation, each started with `resume=auto` until it
has finished, and stopped by SIGKILL, SIGTERM, SIGINT or SIGUSR1 at random moments. Nothing may print a traceback, hang,
or end with an unknown code; at the end curves, weights, best weights and buffer must be those of a run left alone.
*flips*: one bit anywhere in the directory of a run; what a new run restores must be what the run was at its newest
checkpoint or the one before, to the last bit, or an error in one line. *settings*: values that make no sense, drawn as
in `tests/commands/test_random_settings.py`. All write to `benchmarks/results/cpu/faults/`. POSIX only.
"""

from __future__ import annotations

import argparse
import contextlib
import copy
import csv
import dataclasses
import importlib.util
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from cpu_learning import RESULTS, ROOT
from torch import Tensor
from torchrl import torchrl_logger

from torchrl_etdmpc.checkpoints import CheckpointError, CheckpointStore
from torchrl_etdmpc.envs import make_env
from torchrl_etdmpc.runs import RunDirectory, RunLog, library_versions
from torchrl_etdmpc.training import (
    EXIT_CODE,
    TrainConfig,
    TrainingRun,
    build_replay,
    plan_launch,
    read_agent_file,
    read_run_config,
)

SETTINGS = {
    "task": "cartpole-balance",
    "preset": "cpu",
    "seed": 3,
    "device": "cpu",
    "threads": 1,
    "total_env_steps": 400,
    "episode_length": 200,
    "log_every": 40,
    "eval_every": 150,
    "eval_episodes": 1,
    "checkpoint_every": 30,
    "model": {"latent_dim": 16, "mlp_dim": 16, "encoder_dim": 16},
    "planner": {"horizon": 2, "num_samples": 8, "num_elites": 4, "num_proposals": 2, "iterations": 1},
    "reanalyze": {"num_samples": 6, "num_elites": 3, "iterations": 1},
    "optim": {"batch_size": 4},
    "replay": {"seed_decisions": 40, "pretrain_updates": 4},
}
KINDS = {"one environment": {"compile": "off"}, "three environments": {"compile": "off", "num_envs": 3}}
KINDS["compiled"] = {"compile": "default"}
if importlib.util.find_spec("humanoid_bench"):  # with the Python of `make humanoidbench`; episodes of different lengths
    KINDS["HumanoidBench"] = {"compile": "off", "num_envs": 3, "task": "h1hand-stand"}
SHARES = {"one environment": 0.55, "three environments": 0.4, "compiled": 0.05, "HumanoidBench": 0.1}  # of all kills
SIGNALS = (signal.SIGKILL, signal.SIGKILL, signal.SIGTERM, signal.SIGINT, signal.SIGUSR1)
EXPECTED = {0, EXIT_CODE, 130} | {-number for number in SIGNALS} | {128 + number for number in SIGNALS}
LIMIT_S = 600


def configuration(changes: Mapping[str, Any]) -> TrainConfig:
    return TrainConfig.from_dict({**SETTINGS, **changes})


def command(run_dir: Path, changes: Mapping[str, Any]) -> list[str]:
    values = {**SETTINGS, **changes, "task.episode_length": SETTINGS["episode_length"]}
    del values["episode_length"]
    flat = [
        f"{name}.{key}={item}" if isinstance(value, dict) else f"{name}={value}"
        for name, value in values.items()
        for key, item in (value.items() if isinstance(value, dict) else [("", value)])
    ]
    script = str(ROOT / "examples" / "train.py")
    return [sys.executable, script, *flat, f"run_dir={run_dir}", "resume=auto"]


def plain(value: Any) -> Any:
    """A value that can be compared: tensors as their bytes, without times."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items() if "wall" not in str(key)}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return (str(value.dtype), value.shape, value.cpu().numpy().tobytes()) if isinstance(value, Tensor) else value


def results(run_dir: Path) -> dict[str, Any]:
    """What a run came to, without times."""
    directory = RunDirectory(run_dir)
    answer: dict[str, Any] = {}
    for file in (directory.train, directory.eval):
        with file.open(newline="") as opened:
            rows = csv.DictReader(opened)
            answer[file.name] = [{key: value for key, value in row.items() if key != "wall_time_s"} for row in rows]
    for file in (directory.last_agent, directory.best_agent):
        content = read_agent_file(file)
        answer[file.name] = plain({name: content[name] for name in ("loss", "world_model", "updater", "counters")})
    buffer = build_replay(read_run_config(directory))
    CheckpointStore(directory.checkpoints).load({}, buffer)  # the rows, as a run that goes on has them
    answer["buffer"] = plain({"rows": buffer.storage[:].to_dict(), "writer": buffer.writer.state_dict()})
    return answer


# -- kills ------------------------------------------------------------------------------------------------------------


def run_once(run_dir: Path, changes: Mapping[str, Any], stop: tuple[float, int] | None) -> tuple[int, str, float]:
    """Exit code, what was printed and seconds of one process, stopped after so many seconds by a signal.

    What is printed ends with ``Orphans`` if processes that it started are still there after 15 seconds.
    """
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "MUJOCO_GL": "disable"}
    tick = time.monotonic()
    process = subprocess.Popen(
        command(run_dir, changes),
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),  # also in the background
    )
    try:
        if stop is not None:
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(stop[0])
            if process.poll() is None:
                os.killpg(process.pid, stop[1]) if stop[1] == signal.SIGINT else process.send_signal(stop[1])
        text, _ = process.communicate(timeout=LIMIT_S)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        text, _ = process.communicate()
        return 10_000, text, LIMIT_S
    seconds = time.monotonic() - tick
    for _ in range(15):  # the environments' processes go within ten seconds
        session = subprocess.run(["pgrep", "-s", str(process.pid)], capture_output=True, text=True, check=False).stdout
        if not session:
            return process.returncode, text, seconds
        time.sleep(1)
    return process.returncode, f"{text}\nOrphans: {session.split()}", seconds


class Complaints(list[str]):
    """Told at once, because the rest may take an hour."""

    def append(self, text: str) -> None:
        print(text, flush=True)
        super().append(text)


def kills(number: int, seed: int, folder: Path, kind: str) -> dict[str, Any]:
    chance, stopped, complaints = random.Random(f"{kind} {seed}"), 0, Complaints()
    codes: Counter[str] = Counter()
    series, equal, changes = 0, 0, KINDS[kind]
    for run_dir in (folder / "first", folder / "second"):  # the first one fills the compilation cache
        code, text, alone_s = run_once(run_dir, changes, None)
        if code:
            raise RuntimeError(text)
        expected = results(run_dir)
        shutil.rmtree(run_dir)
    print(f"{kind}: {alone_s:.0f} s when left alone", flush=True)
    while stopped < number:
        run_dir = folder / f"series-{series}"
        series += 1
        for attempt in range(40):
            last = attempt == 39 or stopped >= number
            stop = None if last else (chance.uniform(0, 1.1 * alone_s), chance.choice(SIGNALS))
            code, text, _ = run_once(run_dir, changes, stop)
            codes[signal.Signals(-code).name if code < 0 else str(code)] += 1
            what = f"{kind}, series {series}, attempt {attempt}, {stop}, code {code}"
            bad = any(word in text for word in ("Traceback", "Exception ignored", "Orphans"))
            if bad or code not in EXPECTED:
                complaints.append(f"{what}: {text[-2000:]}")
            stopped += stop is not None and code != 0
            if code == 0:
                break
        try:
            same = results(run_dir) == expected
        except Exception as error:
            same = False
            complaints.append(f"{kind}, series {series}: {error}")
        equal += same
        if not same:
            shutil.move(run_dir, folder / f"different-{series}")
            complaints.append(f"{kind}, series {series}: another end than the run that was left alone")
        else:
            shutil.rmtree(run_dir)
        print(f"{stopped} stopped, {series} series, {equal} equal, {len(complaints)} bad", flush=True)
    return {"stopped": stopped, "series": series, "equal": equal, "exit_codes": codes, "complaints": complaints}


# -- flips ------------------------------------------------------------------------------------------------------------


def make_run(config: TrainConfig, run_dir: Path) -> TrainingRun:
    env = make_env(config.task_spec, seed=config.seed)
    eval_env = make_env(config.task_spec, num_envs=config.eval_episodes, parallel=False)
    log = RunLog(RunDirectory(run_dir), total_env_steps=config.total_env_steps)
    return TrainingRun(config, env=env, eval_env=eval_env, log=log)


def state(run: TrainingRun) -> Any:
    """Everything of a run and its files that a checkpoint brings back, the generators apart."""
    parts = {name: plain(part.state_dict()) for name, part in run.parts.items() if name != "random"}
    directory = run.log.directory
    files = {file.name: file.read_bytes() if file.exists() else b"" for file in (directory.train, directory.eval)}
    best = plain(read_agent_file(directory.best_agent)["counters"])
    return parts, plain(run.learner.replay.storage[:].to_dict()), files, best


def train(config: TrainConfig, run_dir: Path) -> list[Any]:
    """A whole run, left as if it had not finished; its states when it wrote its last checkpoints, the newest first."""
    run, states = make_run(config, run_dir), []
    save = run.checkpoints.store.save

    def save_and_note(*arguments: Any, **options: Any) -> Path:
        folder = save(*arguments, **options)
        if run.log.directory.best_agent.exists():  # not yet at the first one
            states.insert(0, state(run))
        return folder

    run.checkpoints.store.save = save_and_note
    run.log.directory.begin(config.to_dict())
    run.run()
    run.log.directory.close()
    RunDirectory(run_dir).summary.unlink()  # so that there is something to go on with
    return states[: config.checkpoint_keep]


def went_on(restored: Callable[..., Any]) -> str:
    """What came of a run that said that resume=weights goes on with it."""
    try:
        restored(resume="weights")
    except CheckpointError as error:
        if "rows of the buffer are left" not in str(error):
            raise
        return "refused, too few rows are left"
    return "refused, and gone on with by resume=weights"


def flips(number: int, seed: int, folder: Path) -> dict[str, Any]:
    chance, found, complaints = random.Random(seed), Counter(), Complaints()
    run_dir = folder / "run"
    config = configuration({"compile": "off", "run_dir": str(run_dir), "resume": "on", "total_env_steps": 200})
    whole = folder / "whole"
    states = train(config, run_dir)
    shutil.copytree(run_dir, whole)
    files = sorted(path for path in whole.rglob("*") if path.is_file() and path.name != "curve.png")
    run = make_run(config, run_dir)  # has other weights and no counts: nothing of what it is to restore
    made = {name: copy.deepcopy(part.state_dict()) for name, part in run.parts.items() if name != "random"}

    def forget() -> None:
        """Makes the run what it was before it restored anything, and its directory whole again."""
        run.learner.replay.empty()
        run.learner.collector.env.reset()
        for name, values in made.items():
            run.parts[name].load_state_dict(copy.deepcopy(values))
        shutil.rmtree(run_dir)
        shutil.copytree(whole, run_dir)

    def restored(**changes: Any) -> Any:
        run.config = run.checkpoints.config = plan_launch(dataclasses.replace(config, **changes), changes).config
        run.learner.replay.empty()
        directory = RunDirectory(run_dir)
        directory.go_on()
        try:
            run.checkpoints.restore()
            directory.write_config(run.config.to_dict())
        finally:
            directory.close()
        return run.config.to_dict(), state(run)

    settings = plan_launch(config, {}).config.to_dict()
    expected = [(settings, values) for values in states]
    by_file: Counter[str] = Counter()
    for count in range(number):
        forget()
        source = chance.choice(files)
        target = run_dir / source.relative_to(whole)
        data = bytearray(source.read_bytes())
        place = chance.randrange(len(data))
        data[place] ^= 1 << chance.randrange(8)
        target.unlink()
        target.write_bytes(data)
        name = re.sub(r"\d+|-[0-9a-f]{8}", "*", str(source.relative_to(whole)))
        by_file[name] += 1
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            try:
                outcome = restored()
            except (CheckpointError, ValueError, OSError) as error:
                if "\n" in str(error):
                    complaints.append(f"{name}, byte {place}: {error}")
                found[went_on(restored) if "resume=weights" in str(error) else "refused"] += 1
                continue
            except Exception as error:
                complaints.append(f"{name}, byte {place}: {type(error).__name__}: {error}")
                continue
        if outcome == expected[0]:
            found["exact, with a warning" if said else "exact"] += 1
        elif outcome == expected[1] and said:
            found["passed over for the checkpoint before"] += 1
        else:
            complaints.append(f"{name}, byte {place}: restored something else")
        if count % 500 == 0:
            print(count, dict(found), len(complaints), flush=True)
    return {"flips": number, "outcomes": found, "by_file": by_file, "complaints": complaints}


# -- settings ---------------------------------------------------------------------------------------------------------


def settings(number: int, seed: int, folder: Path) -> dict[str, Any]:
    file = ROOT / "tests" / "commands" / "test_random_settings.py"
    spec = importlib.util.spec_from_file_location(file.stem, file)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    found, complaints = Counter(), Complaints()
    for drawn in range(seed * 1_000_000, seed * 1_000_000 + number):  # others than the test's
        try:
            found[module.judge(drawn)] += 1
        except Exception as error:
            complaints.append(f"drawn with seed {drawn}: {type(error).__name__}: {error}")
    return {"settings": number, "outcomes": found, "complaints": complaints}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=["kills", "flips", "settings"])
    parser.add_argument("--number", type=int)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--kind", choices=KINDS, help="of kills: this kind only; the others' results are kept")
    parser.add_argument("--out", type=Path, default=RESULTS / "faults")
    arguments = parser.parse_args()
    torchrl_logger.setLevel("WARNING")
    torch.set_num_threads(1)
    number = arguments.number or {"kills": 300, "flips": 20_000, "settings": 2_000}[arguments.what]
    if arguments.what != "kills":
        report(arguments.out, arguments.what, measured(globals()[arguments.what], number, arguments.seed))
        return
    for kind in [arguments.kind] if arguments.kind else KINDS:
        answer = measured(kills, round(SHARES[kind] * number), arguments.seed, kind=kind)
        report(arguments.out, f"kills-{kind.replace(' ', '-')}", answer)


def measured(measure: Callable[..., dict[str, Any]], number: int, seed: int, **options: Any) -> dict[str, Any]:
    tick = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        answer = {"seed": seed} | measure(number, seed, Path(folder), **options)
    return answer | {"minutes": round((time.monotonic() - tick) / 60, 1), "versions": library_versions()}


def report(out: Path, name: str, answer: dict[str, Any]) -> None:
    out.mkdir(parents=True, exist_ok=True)
    (out / f"{name}.json").write_text(json.dumps(answer, indent=1) + "\n")
    print(json.dumps({name: value for name, value in answer.items() if name != "complaints"}, indent=1))
    if answer["complaints"]:
        sys.exit("error: " + "\n".join(answer["complaints"][:20]))


if __name__ == "__main__":
    main()
