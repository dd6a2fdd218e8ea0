"""Compilation before a run begins, so that its time is known and no step of the run is slow."""

from __future__ import annotations

import contextlib
import pickle
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Sequence

import torch
from tensordict import TensorDict
from torchrl import torchrl_logger
from torchrl.envs import ExplorationType
from torchrl.envs.utils import set_exploration_type

from torchrl_etdmpc.runs import first_line, progress_bar, usable_cores
from torchrl_etdmpc.training.agent import Agent, build_agent
from torchrl_etdmpc.training.config import TrainConfig
from torchrl_etdmpc.training.distributed import DistributedConfig
from torchrl_etdmpc.training.own_code import follow_own_code

_HELP = "from torchrl_etdmpc.training.precompile import help_to_compile; help_to_compile()"


def precompile(config: TrainConfig, agent: Agent, batch: Sequence[int], eval_batch: Sequence[int]) -> float:
    """Compiles what the run will call, on made-up data; weights, running scale and random numbers do not move.

    On a GPU, and on a CPU with several threads, further processes compile too, which fill PyTorch's cache for this one.
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
    parts = _parts(config, agent, batch, eval_batch)
    calls = 1 if agent.compile_mode == "default" else 3  # CUDA graphs are recorded after a first run
    several = device.type == "cuda" or torch.get_num_threads() > 1
    processes = min(usable_cores(), len(parts)) if several else 1
    own, *others = ([*parts][first::processes] for first in range(processes))
    try:
        with contextlib.ExitStack() as stack:
            stack.enter_context(torch.random.fork_rng([device] if device.type == "cuda" else []))
            # Processes work side by side and parts differ in size: what is done says nothing about the time left.
            progress = stack.enter_context(progress_bar("compilation", len(parts), "parts", time_left=False))

            def call(names: Sequence[str]) -> None:
                for name in names:
                    parts[name]()
                    progress.advance()

            network = agent.world_model.observation_dim, agent.world_model.action_dim, str(device)
            requests = ((config, *network, batch, eval_batch, names) for names in others)
            helpers = [stack.enter_context(_helper(request)) for request in requests]
            before = _graphs_not_in_the_cache()
            call(own)
            if _graphs_not_in_the_cache() > before:
                for helper in helpers:
                    helper.wait()
            for names in others:
                call(names)
            for part in [*parts.values()] * (calls - 1):
                part()
    except Exception as error:
        if config.compile != "auto":
            raise
        agent.make_eager()
        warnings.warn(f"cannot compile here, so training is slower: {first_line(error)}", stacklevel=3)
    seconds = time.perf_counter() - tick
    torchrl_logger.info(f"compiled in {seconds:.0f} s")
    return seconds


def _graphs_not_in_the_cache() -> int:
    """Of this process, so far."""
    return torch._dynamo.utils.counters["inductor"]["fxgraph_cache_miss"]


@contextlib.contextmanager
def _helper(request: tuple[object, ...]) -> Iterator[subprocess.Popen[bytes]]:
    """A silent process that compiles some parts; what it does not manage to compile is left to this one."""
    settings = torch.get_num_threads(), torch.get_float32_matmul_precision()  # the cache goes by them too
    silent = subprocess.DEVNULL
    # -P: -c would import a random.py of the folder that the run was begun in. What this process finds, e.g. the module
    # of a user's task, is found behind what is installed.
    line = [sys.executable, "-P", "-c", f"import sys; sys.path += {sys.path!r}; {_HELP}"]
    process = subprocess.Popen(line, stdin=subprocess.PIPE, stdout=silent, stderr=silent)
    try:
        assert process.stdin is not None
        with contextlib.suppress(BrokenPipeError), process.stdin:
            pickle.dump((settings, request), process.stdin)
        yield process
    finally:
        process.kill()
        process.wait()


def help_to_compile() -> None:
    """What a helper runs: reads a request of :func:`precompile` from its input."""
    (threads, precision), (config, *network, batch, eval_batch, names) = pickle.load(sys.stdin.buffer)
    torch.set_num_threads(threads)
    if precision != torch.get_float32_matmul_precision():  # setting what it is changes what the cache goes by
        torch.set_float32_matmul_precision(precision)
    # As the process has that asks: code of the user's own behind a setting.
    follow_own_code("planner.score", config.planner.score)
    follow_own_code("reanalyze.score", config.reanalyze.score)
    follow_own_code("loss.extra_terms", config.loss.extra_terms or "null")
    parts = _parts(config, build_agent(config, *network), batch, eval_batch)
    for name in names:
        parts[name]()


def _parts(
    config: TrainConfig, agent: Agent, batch: Sequence[int], eval_batch: Sequence[int]
) -> dict[str, Callable[[], object]]:
    """One call of every compiled part, in the shapes of the run."""
    model, device = agent.world_model, agent.device
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
        if config.refreshed_states:
            with set_exploration_type(ExplorationType.RANDOM):
                agent.reanalyze_planner(states(config.refreshed_states).select("observation"))

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
        if config.partial_slices:
            rows["collector"] = {"mask": zeros(*slices, dtype=torch.bool).logical_not()}
        made_up = TensorDict(rows, slices)
        # What a term of the user's own reads beside these has a shape that only the buffer knows: the first update
        # compiles.
        if set(agent.loss.in_keys) <= set(made_up.keys(True, True)):
            agent.updater.warm_up(made_up)

    parts: dict[str, Callable[[], object]] = {"reanalyze": reanalyze, "evaluate": evaluate, "update": update}
    # Workers plan on CPUs, for which a learner on one fills the cache.
    elsewhere = isinstance(config, DistributedConfig) and device.type != "cpu"
    return parts if elsewhere else {"act": act} | parts
