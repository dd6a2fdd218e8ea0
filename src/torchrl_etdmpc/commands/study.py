"""``study``: what a trained planner believes beside what is true, as a figure, a table and two or three lines."""

from __future__ import annotations

import csv
import importlib
import importlib.util
import io
import json
import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any, Literal, get_args

import numpy as np
import torch

from torchrl_etdmpc.commands.agent_command import AgentCommandConfig
from torchrl_etdmpc.commands.command_line import hydra_main
from torchrl_etdmpc.envs import env_sizes, make_env
from torchrl_etdmpc.inspector import Episode, Simulator, play_episode
from torchrl_etdmpc.inspector.studies import choose_states
from torchrl_etdmpc.planners import EnsembleMPPIPlanner
from torchrl_etdmpc.runs import first_line, library_versions, processor, progress_bar, replacing
from torchrl_etdmpc.runs.files import make_folder, write_whole
from torchrl_etdmpc.training import resolve_device

StudyName = Literal[
    "all",
    "cross_scoring",
    "latent_gallery",
    "horizon_weights",
    "calibration",
    "value_bias",
    "consistency",
    "advantage",
    "solver",
]


@dataclass(frozen=True, kw_only=True)
class StudyConfig(AgentCommandConfig):
    """What to study."""

    study: StudyName
    """The study, also written without ``study=`` as the first argument; ``all`` makes every one."""
    out: str = "studies"
    """Folder for NAME.png, NAME.csv, NAME.npz and NAME.json."""
    episodes: int = 10
    """How many the planner plays; intervals are over episodes."""
    states: int = 200
    """How many are drawn from them."""
    seed: int = 0
    """Of the episodes, the choice of states and the plans."""
    device: str = "auto"
    """``auto``, ``cpu``, ``cuda`` or ``cuda:N``."""

    def __post_init__(self) -> None:
        for name in ("episodes", "states"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}.")
        if not 0 <= self.seed < 2**32 - self.episodes:
            raise ValueError(f"seed must be in [0, 2**32 - episodes), got {self.seed}.")


def main() -> None:
    """The command; the name of the study may stand alone."""
    if len(sys.argv) > 1 and re.fullmatch(r"(?!help$)\w+", sys.argv[1]):
        sys.argv[1] = f"study={sys.argv[1]}"
    _main()


@hydra_main("study", StudyConfig)
def _main(config: StudyConfig) -> None:
    """Measures what a trained planner believes, and what is true of it."""
    if importlib.util.find_spec("matplotlib") is None:
        raise ImportError("this command needs matplotlib; run: pip install matplotlib")
    task, device = config.task_spec, resolve_device(config.device)
    env = make_env(task, seed=config.seed)
    agent, counters, digest = config.load_known(**env_sizes(env), device=device)
    env.close(raise_if_closed=False)
    changed = config.changed_task
    folder = Path(config.out).expanduser()
    make_folder(folder)
    episodes: list[Episode] = []
    with progress_bar("playing", config.episodes, "episodes", passing=True) as bar:
        for number in range(config.episodes):
            episodes.append(play_episode(agent.eval_planner, task, seed=config.seed + number))
            bar.update(number + 1)
    returns = torch.stack([episode.reward.sum() for episode in episodes])
    about = {
        "task": task.name,
        "changed_task": changed,
        "checkpoint": config.checkpoint,
        "checkpoint_sha256": digest,
        "trained_env_steps": counters.get("env_steps"),
        "episodes": config.episodes,
        "mean_return": returns.mean().item(),
        "states_asked": config.states,
        "seed": config.seed,
        "device": str(device),
        "processor": processor(),
        "threads": torch.get_num_threads(),
        "versions": library_versions(),
    }
    settings = f" with {', '.join(f'{name}={value}' for name, value in changed.items())}" if changed else ""
    print(
        f"{task.name}{settings}, trained for {counters.get('env_steps', 'an unknown number of')} env steps: "
        f"{config.episodes} episodes, return {returns.mean():.1f}"
    )
    if config.episodes == 1:
        print("intervals are over whole episodes, so they are nan; episodes=2 is the least that has some")
    simulator = Simulator(task)
    names = [name for name in get_args(StudyName) if name != "all"] if config.study == "all" else [config.study]
    left_out = []
    for name in names:
        module = importlib.import_module(f"torchrl_etdmpc.inspector.studies.{name}")
        try:
            result = _study(module, name, agent.eval_planner, episodes, simulator, config)
            lines = module.lines(result)
            _write(folder, name, module, result, {**about, "study": name, "lines": lines})
        except ValueError as error:  # one head, a simulator that cannot be brought back, episodes that are too short
            left_out.append(name)
            if len(left_out) == len(names):
                raise
            print(f"{name}: left out: {first_line(error)}")
            continue
        print("\n".join([f"{name}: {folder / name}.png", *(f"  {line}" for line in lines)]))


def _study(
    module: ModuleType,
    name: str,
    planner: EnsembleMPPIPlanner,
    episodes: Sequence[Episode],
    simulator: Simulator,
    config: StudyConfig,
) -> Any:
    """The study's result, from states that have as many decisions after them as it looks ahead, or the task's end."""
    # Of the episodes that were played, which may have ended before their time limit.
    decisions = round(sum(len(episode.reward) for episode in episodes) / len(episodes))
    window = max(min(50, decisions // 2), 1)
    ahead = {
        "cross_scoring": 3,
        "latent_gallery": planner.horizon,
        "calibration": 6,
        "value_bias": max(decisions // 2, 1),  # so that what the time limit cut off weighs little
        "advantage": window,
    }
    limit = simulator.task.decision_steps_per_episode
    states = choose_states(episodes, config.states, ahead=ahead.get(name, 1), limit=limit, seed=config.seed)
    study = getattr(module, name)
    if name == "value_bias":
        return study(planner, episodes, states, seed=config.seed)
    if name in ("horizon_weights", "consistency", "solver"):
        return study(planner, states, seed=config.seed)
    options = {"cross_scoring": {"decisions": decisions}, "advantage": {"steps": min(10, window), "horizon": window}}
    return study(planner, states, simulator, seed=config.seed, **options.get(name, {}))


def _write(folder: Path, name: str, module: ModuleType, result: Any, about: dict[str, Any]) -> None:
    """The figure, the table, the arrays, and what they were made from."""
    picture = module.figure(result)
    with replacing(folder / f"{name}.png") as partial:
        picture.savefig(partial, dpi=100, metadata={"Software": None})
    rows = [{key: _short(value) for key, value in row.items()} for row in module.table(result)]
    text = io.StringIO()
    writer = csv.DictWriter(text, rows[0], lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_whole(folder / f"{name}.csv", text.getvalue())
    with replacing(folder / f"{name}.npz") as partial:
        arrays: dict[str, Any] = {key: np.asarray(value) for key, value in result._asdict().items()}
        np.savez_compressed(partial, **arrays)
    write_whole(folder / f"{name}.json", json.dumps(about, indent=2) + "\n")


def _short(value: Any) -> Any:
    return f"{value:.5g}" if isinstance(value, float) else value
