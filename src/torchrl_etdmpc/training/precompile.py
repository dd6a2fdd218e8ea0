"""Compilation before a run begins, so that its time is known and no step of the run is slow."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Sequence

import torch
from tensordict import TensorDict
from torchrl import torchrl_logger
from torchrl.envs import ExplorationType
from torchrl.envs.utils import set_exploration_type

from torchrl_etdmpc.runs import first_line, progress_bar
from torchrl_etdmpc.training.agent import Agent
from torchrl_etdmpc.training.config import TrainConfig


def precompile(config: TrainConfig, agent: Agent, batch: Sequence[int], eval_batch: Sequence[int]) -> float:
    """Compiles what the run will call, on made-up data; weights, running scale and random numbers do not move.

    With ``compile=auto`` a failure to compile is a warning, and the run goes on without.

    Args:
        config (TrainConfig): the run.
        agent (Agent): its planners and its updater are called.
        batch (sequence of int): batch size of the training environment.
        eval_batch (sequence of int): batch size of the evaluation environment.

    Returns:
        float: seconds that it took; 0 if nothing is compiled.
    """
    if agent.compile_mode is None:
        return 0.0
    torchrl_logger.info("compiling, which takes minutes the first time and seconds from PyTorch's cache later")
    tick, device = time.perf_counter(), agent.device
    calls = 1 if agent.compile_mode == "default" else 3  # CUDA graphs are recorded after a first run
    try:
        with torch.random.fork_rng([device] if device.type == "cuda" else []):
            with progress_bar("compilation", 4 * calls, "parts") as progress:
                for _ in range(calls):
                    for call in _everything(config, agent, batch, eval_batch, device):
                        call()
                        progress.advance()
    except Exception as error:
        if config.compile != "auto":
            raise
        agent.make_eager()
        warnings.warn(f"cannot compile here, so training is slower: {first_line(error)}", stacklevel=3)
    seconds = time.perf_counter() - tick
    torchrl_logger.info(f"compiled in {seconds:.0f} s")
    return seconds


def _everything(
    config: TrainConfig, agent: Agent, batch: Sequence[int], eval_batch: Sequence[int], device: torch.device
) -> list[Callable[[], object]]:
    """One call of every compiled part, in the shapes of the run."""
    model = agent.world_model
    observation_dim = model.observation_dim
    assert observation_dim is not None  # training takes vectors

    def zeros(*shape: int, dtype: torch.dtype = torch.float32) -> torch.Tensor:
        return torch.zeros(shape, dtype=dtype, device=device)

    def states(*batch: int) -> TensorDict:
        carried = zeros(*batch, agent.planner.horizon, model.action_dim)
        is_init = zeros(*batch, 1, dtype=torch.bool)
        values = {"observation": zeros(*batch, observation_dim), "plan_mean": carried, "is_init": is_init}
        return TensorDict(values, batch)

    def act() -> None:
        with set_exploration_type(ExplorationType.RANDOM):
            agent.planner(states(*batch))

    def reanalyze() -> None:
        if config.reanalyze.every:
            rows = config.reanalyze.num_slices * config.loss.slice_len
            with set_exploration_type(ExplorationType.RANDOM):
                agent.reanalyze_planner(states(rows).select("observation"))

    def evaluate() -> None:
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            agent.eval_planner(states(*eval_batch))

    def update() -> None:
        slices = config.optim.batch_size, config.loss.slice_len
        action = zeros(*slices, model.action_dim)
        following = {"observation": zeros(*slices, observation_dim), "reward": zeros(*slices, 1)}
        following["terminated"] = zeros(*slices, 1, dtype=torch.bool)
        rows = {"observation": following["observation"], "action": action, "next": following}
        rows["plan"] = {"loc": action, "scale": action + 1}
        agent.updater.warm_up(TensorDict(rows, slices))

    return [act, reanalyze, evaluate, update]
