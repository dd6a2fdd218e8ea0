"""Workers that plan and step in processes of their own, on TorchRL's collectors: what runs in them, how they start."""

from __future__ import annotations

import contextlib
import math
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, TypeVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl import torchrl_logger
from torchrl.collectors import BaseCollector, MultiAsyncCollector
from torchrl.data import Composite, Unbounded
from torchrl.envs import EnvBase, TensorDictPrimer
from torchrl.weight_update import SharedMemWeightSyncScheme

from torchrl_etdmpc.collectors import SeedPolicy
from torchrl_etdmpc.envs import Task, import_task, make_env, register_task
from torchrl_etdmpc.envs.seeding import seed_everything
from torchrl_etdmpc.envs.tasks import Maker, registered_maker
from torchrl_etdmpc.envs.worker import signals_held_back, take_signals
from torchrl_etdmpc.keys import WORKER
from torchrl_etdmpc.planners import EnsembleMPPIPlanner
from torchrl_etdmpc.runs import first_line
from torchrl_etdmpc.training.agent import build_planner, build_world_model
from torchrl_etdmpc.training.config import TASK_SETTINGS, TrainConfig
from torchrl_etdmpc.training.own_code import follow_own_code

Engine = Literal["multi", "ray"]
T = TypeVar("T")

_LOOK_EVERY_S = 0.5
# How long a process may take to say that it has the weights; a thread of its own does, whatever it is busy with.
_PATIENCE_S = 300


class Actor(TensorDictModuleBase):
    """Acts as the seed policy does until it is told to plan: by ``planning``, a buffer that is sent with the weights.

    Args:
        planner (EnsembleMPPIPlanner): acts when ``planning`` is true.
        planning (bool): Default: ``False``.
        hold (float): of the seed policy. Default: 1.
    """

    planning: torch.Tensor

    def __init__(self, planner: EnsembleMPPIPlanner, *, planning: bool = False, hold: float = 1.0) -> None:
        super().__init__()
        self.planner = planner
        self.seed_policy = SeedPolicy(planner.action_spec, hold=hold)
        # TorchRL's types know one key only.
        self.in_keys = planner.in_keys  # pyright: ignore[reportAttributeAccessIssue]
        self.out_keys = planner.out_keys  # pyright: ignore[reportAttributeAccessIssue]
        self.register_buffer("planning", torch.tensor(planning))

    @property
    def spec(self) -> Composite:
        """That of the planner: a collector which asks need not try a plan."""
        return self.planner.spec

    def make_tensordict_primer(self) -> TensorDictPrimer:
        """That of the planner."""
        return self.planner.make_tensordict_primer()

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes an action and its plan."""
        return self.planner(tensordict) if self.planning else self.seed_policy(tensordict)


@dataclass(frozen=True)
class WorkerParts:
    """What a worker makes in its own process, by the settings of the run.

    Args:
        config (TrainConfig): the run.
        sizes (tuple of int): O and A.
        discount (float): of the planner.
        compile_mode (str, optional): of the planner. Default: ``None``, eager.
        registered (tuple of Task and callable, optional): the task's entry, and its maker if the program has registered
            one; not of a task that is imported by its name. Default: ``None``.
    """

    config: TrainConfig
    sizes: tuple[int, int]
    discount: float
    compile_mode: str | None = None
    registered: tuple[Task, Maker | None] | None = None

    def make_env(self, number: int) -> EnvBase:
        """The environment of one worker, whose rows carry its number.

        Args:
            number (int): of the worker, among all that the run has started.
        """
        self._prepare()
        seed = (self.config.seed * 1_000_003 + number) % 2**32
        seed_everything(seed)
        env = make_env(self.config.task_spec, seed=seed)
        primer = TensorDictPrimer({WORKER: Unbounded(1, dtype=torch.int64)}, default_value=number)
        return env.append_transform(primer)

    def make_actor(self) -> Actor:
        """The planner on networks of the run's sizes; their weights arrive later."""
        self._prepare()
        config = self.config
        world_model = build_world_model(config.model, *self.sizes, terminates=config.task_spec.terminates)
        options: dict[str, Any] = {"discount": self.discount, "compile_mode": self.compile_mode}
        planner = build_planner(world_model, config.planner, warm_start=True, **options)
        return Actor(planner, hold=config.replay.seed_hold)

    def _prepare(self) -> None:
        """Imports what the command line has made the owner import, and registers what its program may have."""
        config = self.config
        if self.registered is not None:
            register_task(*self.registered, replace=True)
        if ":" in config.task:
            import_task(config.task, **{name: getattr(config, name) for name in TASK_SETTINGS})
        follow_own_code("planner.score", config.planner.score)


def known_here(config: TrainConfig) -> tuple[Task, Maker | None] | None:
    """What this process knows of the task and another may not; ``None`` where its name says what to import."""
    return None if ":" in config.task else (config.task_spec, registered_maker(config.task_spec))


class _Processes(MultiAsyncCollector):
    """Workers that lose no batch.

    TorchRL's queue has one place for all of them. A worker that finds it taken for a second drops its batch, and goes
    on with the episode: the rows before and behind the hole would be taken for successive ones.
    """

    @property
    def _queue_len(self) -> int:
        return len(self.create_env_fn)  # one for each: a worker waits for an answer before its next batch


def leave_signals_to_the_owner() -> None:
    """In a worker: Ctrl-C signals all processes of a job, but it ends when its owner says so or is gone."""
    torchrl_logger.setLevel("WARNING")
    take_signals(signal.SIG_IGN)


def start_workers(parts: WorkerParts, *, engine: Engine, numbers: range, rows: int) -> BaseCollector:
    """Starts workers; they act as the seed policy until weights come.

    Args:
        parts (WorkerParts): what each of them makes.

    Keyword Args:
        engine (str): ``"multi"``, processes of this machine; ``"ray"``, actors of the cluster that is connected.
        numbers (range): of the workers.
        rows (int): decisions in a batch, which comes from one worker.

    Returns:
        BaseCollector: yields the batches as they come in.
    """
    makers: Any = [partial(parts.make_env, number) for number in numbers]
    options: dict[str, Any] = {"policy_factory": parts.make_actor, "frames_per_batch": rows}
    if engine == "multi":
        with signals_held_back():
            return _Processes(
                makers,
                **options,
                total_frames=-1,
                use_buffers=False,
                weight_sync_schemes={"policy": SharedMemWeightSyncScheme()},
                auto_register_policy_transforms=True,
                num_threads=torch.get_num_threads(),
                init_fn=leave_signals_to_the_owner,
            )
    from torchrl.collectors.distributed import RayCollector

    in_worker = {"auto_register_policy_transforms": True, "use_buffers": False}
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "The policy is not an nn.Module")  # its factory makes one
        return RayCollector(
            makers,
            **options,
            total_frames=sys.maxsize,
            collector_kwargs=[dict(in_worker) for _ in numbers],
            remote_configs={"num_cpus": 1},
        )


def send_weights(
    collector: BaseCollector,
    weights: TensorDictBase,
    worker: int | None = None,
    *,
    while_waiting: Callable[[], None] = lambda: None,
) -> None:
    """Sends weights to a worker, and waits until it has them.

    Args:
        collector (BaseCollector): that ``start_workers`` returned.
        weights (TensorDictBase): of an :class:`Actor`; nobody else may hold their memory.
        worker (int, optional): its place. Default: all of them.

    Keyword Args:
        while_waiting (callable): called every half second meanwhile; what it raises ends the wait.

    Raises:
        RuntimeError: if a worker has ended, or a process does not answer for five minutes.
    """
    deadline = time.monotonic() + (_PATIENCE_S if hasattr(collector, "procs") else math.inf)

    def look() -> None:
        while_waiting()
        ended = ended_worker(collector)
        if ended is not None:
            raise RuntimeError(ended)
        if time.monotonic() > deadline:
            raise RuntimeError(f"it has not answered for {_PATIENCE_S} seconds")

    places = None if worker is None else [worker]
    # TorchRL waits for the answer of a worker that has died for ever.
    waited_for(lambda: collector.update_policy_weights_(weights, worker_ids=places), look)


def waited_for(call: Callable[[], T], look: Callable[[], None]) -> T:
    """What a call returns that may never return: a thread of its own makes it, and is left where ``look`` raises.

    Args:
        call (callable): made once.
        look (callable): called every half second meanwhile.
    """
    returned: list[T] = []
    raised: list[BaseException] = []

    def make() -> None:
        try:
            returned.append(call())
        except BaseException as error:
            raised.append(error)

    thread = threading.Thread(target=make, daemon=True)
    thread.start()
    thread.join(_LOOK_EVERY_S)
    while thread.is_alive():
        look()
        thread.join(_LOOK_EVERY_S)
    if raised:
        raise raised[0]
    return returned[0]


def warns_that_nothing_comes(look: Callable[[], None]) -> Callable[[], None]:
    """``look`` for a wait for rows that begins now, which warns every five minutes."""
    began, told = time.monotonic(), 0

    def warn() -> None:
        nonlocal told
        look()
        waited = time.monotonic() - began
        if waited > (told + 1) * _PATIENCE_S:
            told += 1
            torchrl_logger.warning(
                f"no worker has sent rows for {waited / 60:.0f} minutes; if their simulators hang, Ctrl-C ends and "
                "saves the run, and resume=true goes on with new workers"
            )

    return warn


def ended_worker(collector: BaseCollector) -> str | None:
    """A sentence on a worker process of this machine that has ended, if there is one."""
    for number, process in enumerate(getattr(collector, "procs", ())):
        with contextlib.suppress(ValueError):  # TorchRL has closed it
            if process.exitcode is not None:
                raised = "; its own error stands above" if process.exitcode == 1 else ""
                return f"worker {number} ended (exit code {process.exitcode}{raised})"
    return None


def why_it_failed(collector: BaseCollector, error: BaseException) -> str:
    """What became of the workers, in one line.

    Args:
        collector (BaseCollector): that ``start_workers`` returned.
        error (BaseException): what it raised.
    """
    cause = getattr(error, "cause", None) or error  # of Ray, whose own text is a traceback
    return ended_worker(collector) or f"a worker failed: {first_line(cause).rstrip('.')}"
