"""Agent files: weights, optimiser, configuration and counters, in a file that holds no code."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch

from torchrl_etdmpc.checkpoints import CheckpointError
from torchrl_etdmpc.runs.files import write_tensors
from torchrl_etdmpc.training.agent import Agent, build_agent
from torchrl_etdmpc.training.config import TrainConfig

FORMAT = 2
_ENTRIES = {"config", "observation_dim", "action_dim", "world_model", "loss", "updater", "counters"}


class AgentFile:
    """An agent as a part of a checkpoint: its state is what an agent file holds.

    Args:
        agent (Agent): the parts.
        config (TrainConfig): the run.
        counters (callable): returns e.g. env_steps, decision_steps, updates.
    """

    def __init__(self, agent: Agent, config: TrainConfig, counters: Callable[[], Mapping[str, int | float]]) -> None:
        self.agent = agent
        self.config = config
        self.counters = counters

    def state_dict(self) -> dict[str, Any]:
        """The content of the file."""
        return {
            "format": FORMAT,
            "config": self.config.to_dict(),
            "observation_dim": self.agent.world_model.observation_dim,
            "action_dim": self.agent.world_model.action_dim,
            "counters": dict(self.counters()),
            **self.agent.state_dict(),
        }

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Gives the agent the weights, targets, running scale and optimiser of :meth:`state_dict`."""
        self.agent.load_state_dict(state_dict)


def save_agent(path: str | Path, agent: Agent, config: TrainConfig, counters: Mapping[str, int | float]) -> Path:
    """Writes an agent file; it is there whole or not at all.

    Args:
        path (str or Path): where to; missing folders are made.
        agent (Agent): what to save.
        config (TrainConfig): the run.
        counters (mapping): e.g. env_steps, decision_steps, updates.

    Returns:
        Path: the file.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_tensors(path, AgentFile(agent, config, lambda: counters).state_dict())
    return path


def read_agent_file(path: str | Path) -> dict[str, Any]:
    """The content of an agent file; never runs code from it (``weights_only=True``).

    Raises:
        CheckpointError: if the file is missing, is not an agent file or has another format.
    """
    path = Path(path).expanduser()
    if not path.is_file():
        raise CheckpointError(f"{path} is not a file; pass a checkpoint such as RUN_DIR/checkpoints/last.pt.")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of what the bytes of a damaged file happen to look like
            content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # damaged files raise errors of a dozen types, whose texts advise to run the file's code
        raise CheckpointError(
            f"{path} is not a readable checkpoint ({type(error).__name__}): it is cut off, damaged or another kind of "
            "file; use another checkpoint."
        ) from error
    if not isinstance(content, dict) or "format" not in content or "world_model" not in content:
        raise CheckpointError(f"{path} is a PyTorch file but not a checkpoint of torchrl_etdmpc.")
    if content["format"] != FORMAT:
        raise CheckpointError(f"{path} has checkpoint format {content['format']}; this version reads format {FORMAT}.")
    missing = sorted(_ENTRIES - content.keys())
    if missing:
        raise CheckpointError(f"{path} is not a whole checkpoint: it lacks {', '.join(missing)}.")
    return content


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
    try:
        config = TrainConfig.from_dict(values)
        agent = build_agent(config, *saved, device=device)
        agent.load_state_dict(content)
    except (RuntimeError, ValueError, KeyError) as error:
        reason = " ".join(str(error).split())[:160]
        raise CheckpointError(f"{path} does not fit its own configuration ({reason}).") from error
    return agent, config, content["counters"]
