"""Agent files: weights, optimiser, configuration and counters, in a file that holds no code."""

from __future__ import annotations

import dataclasses
import math
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchrl_etdmpc.checkpoints import CheckpointError
from torchrl_etdmpc.runs.files import (
    DamagedFileError,
    load_tensors,
    pack_tensors,
    read_whole,
    write_tensors,
    write_whole,
)
from torchrl_etdmpc.training.agent import Agent, build_agent
from torchrl_etdmpc.training.config import TASK_SETTINGS, TrainConfig
from torchrl_etdmpc.training.distributed import DistributedConfig

FORMAT = 2
_OF_WORKERS = {field.name for field in dataclasses.fields(DistributedConfig)} - {
    field.name for field in dataclasses.fields(TrainConfig)
}
_ENTRIES = {
    "config": dict,
    "observation_dim": int,
    "action_dim": int,
    "world_model": Mapping,
    "loss": Mapping,
    "updater": dict,
    "counters": dict,
}


class AgentFile:
    """An agent as a part of a checkpoint: its state is what an agent file holds.

    Args:
        agent (Agent): the parts.
        config (TrainConfig): the run.
        counters (callable): returns e.g. env_steps, decision_steps, updates.

    >>> from torchrl_etdmpc.training import build_agent, preset
    >>> agent = build_agent(preset("cpu"), observation_dim=3, action_dim=1)
    >>> file = AgentFile(agent, preset("cpu"), lambda: {"env_steps": 0})
    >>> content = file.state_dict()
    >>> content["config"]["preset"], content["observation_dim"], content["counters"]
    ('cpu', 3, {'env_steps': 0})
    """

    def __init__(self, agent: Agent, config: TrainConfig, counters: Callable[[], Mapping[str, int | float]]) -> None:
        self.agent = agent
        self.config = config
        self.counters = counters

    def state_dict(self) -> dict[str, Any]:
        """The content of the file."""
        settings = self.config.to_dict()
        if ":" in self.config.task:  # what the task was: a command that loads the agent may be told otherwise
            settings |= {name: getattr(self.config.task_spec, name) for name in TASK_SETTINGS}
        return {
            "format": FORMAT,
            "config": settings,
            "observation_dim": self.agent.world_model.observation_dim,
            "action_dim": self.agent.world_model.action_dim,
            "counters": dict(self.counters()),
            **self.agent.state_dict(),
        }

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Gives the agent the weights, targets, running scale and optimiser of :meth:`state_dict`."""
        self.agent.load_state_dict(state_dict)


class BestAgent:
    """The agent of the best evaluation so far: a file from the moment of that evaluation, and a part of checkpoints.

    Args:
        agent (AgentFile): the agent that trains.
        path (Path): the file.

    >>> import tempfile
    >>> from torchrl_etdmpc.training import build_agent, preset
    >>> agent = build_agent(preset("cpu"), observation_dim=3, action_dim=1)
    >>> file = AgentFile(agent, preset("cpu"), lambda: {"env_steps": 0})
    >>> best = BestAgent(file, Path(tempfile.mkdtemp()) / "best.pt")
    >>> best.note(200.0)
    >>> best.note(150.0)  # worse: the file stays
    >>> best.return_mean, best.path.exists()
    (200.0, True)
    """

    def __init__(self, agent: AgentFile, path: Path) -> None:
        self.agent, self.path = agent, path
        self.return_mean = -math.inf
        self._content, self._written = b"", True

    def note(self, return_mean: float) -> None:
        """Keeps the agent as it is now, unless an earlier one was better."""
        if return_mean >= self.return_mean:
            self.return_mean, self._content, self._written = return_mean, pack_tensors(self.agent.state_dict()), False
            self.write()

    def write(self) -> None:
        """Writes the file if it is not there yet; a disk that does not take it is a warning."""
        if self._written:
            return
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            write_whole(self.path, self._content)
            self._written = True
        except OSError as error:
            warnings.warn(f"{self.path} cannot be written ({error.strerror}); it is tried again later.", stacklevel=2)

    def state_dict(self) -> dict[str, Any]:
        """The file's content, and the return of its evaluation."""
        content = torch.from_numpy(np.frombuffer(self._content, dtype=np.uint8).copy())
        return {"return_mean": self.return_mean, "file": content}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Restores :meth:`state_dict`, and writes the file anew."""
        self.return_mean, self._content = state_dict["return_mean"], state_dict["file"].numpy().tobytes()
        self._written = not self._content
        self.write()


def save_agent(path: str | Path, agent: Agent, config: TrainConfig, counters: Mapping[str, int | float]) -> Path:
    """Writes an agent file; it is there whole or not at all.

    Args:
        path (str or Path): where to; missing folders are made.
        agent (Agent): what to save.
        config (TrainConfig): the run.
        counters (mapping): e.g. env_steps, decision_steps, updates.

    Returns:
        Path: the file.

    >>> import tempfile
    >>> from torchrl_etdmpc.training import build_agent, preset
    >>> agent = build_agent(preset("cpu"), observation_dim=3, action_dim=1)
    >>> save_agent(Path(tempfile.mkdtemp()) / "agent.pt", agent, preset("cpu"), {"env_steps": 0}).name
    'agent.pt'
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_tensors(path, AgentFile(agent, config, lambda: counters).state_dict())
    return path


def read_agent_file(path: str | Path) -> dict[str, Any]:
    """The content of an agent file; never runs code from it (``weights_only=True``).

    Raises:
        CheckpointError: if the file is missing, is not an agent file or has another format.

    >>> import tempfile
    >>> from torchrl_etdmpc.training import build_agent, preset
    >>> agent = build_agent(preset("cpu"), observation_dim=3, action_dim=1)
    >>> file = save_agent(Path(tempfile.mkdtemp()) / "agent.pt", agent, preset("cpu"), {"env_steps": 0})
    >>> read_agent_file(file)["observation_dim"]
    3
    """
    path = Path(path).expanduser()
    if not path.exists() or path.is_dir():
        raise CheckpointError(f"{path} is not a file; pass a checkpoint such as RUN_DIR/checkpoints/last.pt.")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of what the bytes of a damaged file happen to look like
            content = load_tensors(read_whole(path), path)
    except DamagedFileError as error:
        what = str(error).removeprefix(f"{path} ").rstrip(".")
        raise CheckpointError(f"{path} is not a readable checkpoint (it {what}); use another checkpoint.") from error
    if not isinstance(content, dict) or "format" not in content or "world_model" not in content:
        raise CheckpointError(f"{path} is a PyTorch file but not a checkpoint of torchrl_etdmpc.")
    if content["format"] != FORMAT:
        raise CheckpointError(f"{path} has checkpoint format {content['format']}; this version reads format {FORMAT}.")
    missing = sorted(_ENTRIES.keys() - content.keys())
    if missing:
        raise CheckpointError(f"{path} is not a whole checkpoint: it lacks {', '.join(missing)}.")
    for name, kind in _ENTRIES.items():
        if not isinstance(content[name], kind):
            found = type(content[name]).__name__
            raise CheckpointError(f"{path} is not a checkpoint: its {name} is of type {found}, not {kind.__name__}.")
    for entry in ("task", "planner"):
        if entry not in content["config"]:
            raise CheckpointError(f"{path} is not a whole checkpoint: its config lacks {entry}.")
    averaged = content["updater"].get("averaged")
    acting = averaged if isinstance(averaged, dict) else {}  # anything else is refused where it is loaded
    for name, value in (*content["world_model"].items(), *content["loss"].items(), *acting.items()):
        if not isinstance(value, torch.Tensor):
            raise CheckpointError(
                f"{path} is not a checkpoint: {name} is no tensor but of type {type(value).__name__}."
            )
        if value.is_floating_point() and not value.isfinite().all():
            raise CheckpointError(f"{path} cannot be used: {name} holds numbers that are not finite.")
    return content


def config_of(path: str | Path, values: Mapping[str, Any]) -> TrainConfig:
    """The run that an agent file is of, from what it stores; who trained it, workers or not, is left out.

    Raises:
        CheckpointError: if this version, or this process, knows no such run.

    >>> from torchrl_etdmpc.training import preset
    >>> config_of("last.pt", preset("cpu").to_dict()).preset
    'cpu'
    """
    try:
        return TrainConfig.from_dict({name: value for name, value in values.items() if name not in _OF_WORKERS})
    except (ValueError, TypeError) as error:
        raise CheckpointError(
            f"{path} holds an agent that cannot be rebuilt: {' '.join(str(error).split())}"
        ) from error


def load_agent(
    path: str | Path,
    *,
    observation_dim: int | None = None,
    action_dim: int | None = None,
    device: torch.device | str = "cpu",
    compile_setting: str | None = None,
) -> tuple[Agent, TrainConfig, dict[str, int | float]]:
    """Rebuilds the agent of a file.

    Args:
        path (str or Path): the file.

    Keyword Args:
        observation_dim (int, optional): O of the environment it is meant for; checked if given.
        action_dim (int, optional): A of that environment; checked if given.
        device (torch.device or str): where the networks go. Default: ``"cpu"``.
        compile_setting (str, optional): overrides the run's ``compile``.

    Returns:
        tuple: agent, the run's configuration, the counters.

    Raises:
        CheckpointError: if the file cannot be used, or the sizes differ.

    >>> import tempfile
    >>> from torchrl_etdmpc.training import build_agent, preset
    >>> agent = build_agent(preset("cpu"), observation_dim=3, action_dim=1)
    >>> counters = {"env_steps": 0, "decision_steps": 0, "updates": 0, "wall_time_s": 0.0}
    >>> file = save_agent(Path(tempfile.mkdtemp()) / "agent.pt", agent, preset("cpu"), counters)
    >>> loaded, config, _ = load_agent(file)
    >>> loaded.planner.horizon, config.preset
    (3, 'cpu')
    """
    content = read_agent_file(path)
    saved = (content["observation_dim"], content["action_dim"])
    wanted = (observation_dim or saved[0], action_dim or saved[1])
    if saved != wanted:
        raise CheckpointError(
            f"{path} was trained with observation size {saved[0]} and action size {saved[1]}, the environment has "
            f"{wanted[0]} and {wanted[1]}; use the task it was trained on ({content['config'].get('task')})."
        )
    values = dict(content["config"])
    if compile_setting is not None:
        values["compile"] = compile_setting
    config = config_of(path, values)
    try:
        agent = build_agent(config, *saved, device=device)
        agent.load_state_dict(content)
    except (RuntimeError, ValueError, KeyError, TypeError, AttributeError) as error:
        reason = " ".join(str(error).split())[:160]
        raise CheckpointError(f"{path} does not fit its own configuration ({reason}).") from error
    return agent, config, content["counters"]
