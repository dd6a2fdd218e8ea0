"""A run whose decisions are made by workers: its settings, and the collector that stands where the steps were."""

from __future__ import annotations

import warnings
from collections import Counter, OrderedDict
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl import torchrl_logger
from torchrl.collectors import BaseCollector
from torchrl.data import ReplayBuffer
from torchrl.envs import EnvBase

from torchrl_etdmpc.collectors import NonFiniteError, SimulatorError
from torchrl_etdmpc.keys import NEXT, OBSERVATION, PLAN, VALUE, VERSION, WORKER
from torchrl_etdmpc.runs import first_line
from torchrl_etdmpc.training.agent import Agent
from torchrl_etdmpc.training.compilation import resolve_compile
from torchrl_etdmpc.training.config import TrainConfig
from torchrl_etdmpc.training.ray_cluster import RayCluster
from torchrl_etdmpc.training.signals import WorkLeftError
from torchrl_etdmpc.training.workers import (
    Actor,
    Engine,
    WorkerParts,
    known_here,
    send_weights,
    start_workers,
    waited_for,
    warns_that_nothing_comes,
    why_it_failed,
)

WEIGHT_AGE = "weight_age"
"""Key of a batch of rows: updates that the learner has made since the weights that each row was planned with."""


@dataclass(frozen=True)
class DistributedConfig(TrainConfig):
    """A run whose decisions are made by workers; see :class:`WorkerCollector`.

    >>> DistributedConfig(task="gym/Pendulum-v1", workers=2).num_envs
    1
    """

    workers: int = 2
    """Processes that plan and step, one environment each."""
    engine: Engine = "multi"
    """``multi``, processes of this machine; ``ray``, of a Ray cluster."""
    address: str | None = None
    """Of the Ray cluster: host:port, ray://host:port or auto. Default: one on this machine, for this run."""
    rows_per_batch: int = 10
    """Decisions that a worker makes before it sends them; fewer are fresher."""
    send_every: int = 10
    """Updates after which a worker that has sent its rows gets the weights anew."""

    _step_setting = "rows_per_batch"

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, most in {"workers": 4096, "rows_per_batch": 100_000, "send_every": None}.items():
            value = getattr(self, name)
            if value < 1 or (most is not None and value > most):
                bound = "at least 1" if value < 1 else f"at most {most}"
                raise ValueError(f"{name} must be {bound}, got {value}.")
        if self.address is not None and self.engine != "ray":
            raise ValueError(
                f"address must be null with engine={self.engine}, got {self.address!r}; say address=null or engine=ray."
            )
        # A worker whose batches are shorter than a slice may have sent one while the others have sent theirs.
        apart = self.loss.slice_len * self.workers if self.rows_per_batch < self.loss.slice_len else 0
        for name, number, least in (
            ("replay.seed_decisions", self.seed_decisions, apart),
            ("replay.capacity", self.replay.capacity, 2 * apart),
        ):
            if number < least:
                raise ValueError(
                    f"{name} must be at least {least} with workers={self.workers} whose batches (rows_per_batch="
                    f"{self.rows_per_batch}) are shorter than a slice, got {number}."
                )
        refused = {
            "num_envs": (self.num_envs, 1, "each worker has one environment; raise workers"),
            "overlap": (self.overlap, False, "workers step while the learner updates anyway"),
            "replay.insertion": (self.replay.insertion, "step", "rows are stored when they arrive"),
        }
        for name, (value, needed, why) in refused.items():
            if value != needed:
                must, got = (str(word).lower() for word in (needed, value))
                raise ValueError(f"{name} must be {must} with workers, got {got}: {why}.")


def is_distributed(settings: Any) -> bool:
    """Whether stored settings are those of a run of workers."""
    return isinstance(settings, Mapping) and "workers" in settings


class WorkerCollector:
    """Stands where :class:`~torchrl_etdmpc.collectors.StepCollector` does in a run; a step is a batch of one worker.

    The workers plan and step in processes of their own (``start_workers``) and go on while the learner updates, each at
    most a batch ahead of it. What is lost against one process:

    - freshness of each step: a decision is made with weights that are some updates old (``weight_age`` in
      ``train.csv``), and a row is stored when its batch arrives. Weights that arrive while a plan is made may mix with
      those before them.
    - exactness: which rows arrive when differs from run to run, and a run that goes on begins fresh episodes.

    Where a worker fails, all are started anew, with other numbers and fresh episodes, and the failure counts as one of
    the simulator. A worker that fails before any has sent a batch is an error: it would do so again.

    Args:
        config (DistributedConfig): the run.
        agent (Agent): whose planner's weights are sent.
        env (EnvBase): one that nobody steps, for its specs.
        replay_buffer (ReplayBuffer): where rows go.
        exclude_keys (sequence of NestedKey): what is not stored.

    Attributes:
        while_waiting (callable): called every half second of waiting for workers; a ``WorkLeftError`` of it ends the
            wait, and nothing is stored.

    Raises:
        ImportError, OSError, ValueError: if there is no Ray, or not the cluster that is asked for.

    >>> from torchrl_etdmpc.envs import make_env
    >>> from torchrl_etdmpc.training import build_agent, build_replay, preset
    >>> config = DistributedConfig.from_dict(preset("cpu").to_dict() | {"task": "gym/Pendulum-v1", "workers": 2})
    >>> agent = build_agent(config, observation_dim=3, action_dim=1)
    >>> options = {"replay_buffer": build_replay(config), "exclude_keys": ()}
    >>> collector = WorkerCollector(config, agent, make_env(config.task), **options)
    >>> collector.frames, collector.in_seed_phase  # the first act() starts the workers
    (0, True)
    >>> collector.shutdown()
    """

    begins_fresh = True  # workers begin new episodes, each from a seed of its own

    def __init__(
        self, config: DistributedConfig, agent: Agent, env: EnvBase, replay_buffer: ReplayBuffer, *, exclude_keys: tuple
    ) -> None:
        self.config, self.agent, self.env, self.replay_buffer = config, agent, env, replay_buffer
        self.exclude_keys = (*exclude_keys, (NEXT, WORKER))
        self.while_waiting: Callable[[], None] = lambda: None
        agent.planner.make_tensordict_primer().check(env)
        self._cluster = RayCluster(config.address, workers=config.workers) if config.engine == "ray" else None
        self._frames = 0
        self._next_number = 0  # of a worker: never twice in a run, so that no trajectory goes on in another one
        self._workers: BaseCollector | None = None
        self._batches: Iterator[TensorDictBase] = iter(())
        self._numbers = range(0)
        self._planning = False
        self._arrived = False
        self._sent: dict[int, int] = {}  # by worker, the updates that its weights had
        self._last_worker: int | None = None
        self._ends: dict[int, TensorDictBase] = {}  # by worker, the last row that came from it
        self._played: Counter[int] = Counter()  # by worker, the rows that came from it

    @property
    def frames(self) -> int:
        """Decisions so far that were stored."""
        return self._frames

    @property
    def decisions_each(self) -> int:
        """Decisions of the worker that has made most, since the workers were started."""
        return max(self._played.values(), default=0)

    @property
    def in_seed_phase(self) -> bool:
        """Whether the workers act at random."""
        return self._frames < self.config.seed_decisions

    def act(self) -> None:
        """Sees to it that the workers are there, and have weights that are fresh enough."""
        try:
            if self._workers is None:
                self._start()
            elif self._planning == self.in_seed_phase:
                self._planning = not self.in_seed_phase
                self._send(None)
            elif self._planning:
                self._send(self._last_worker)
        except WorkLeftError:
            raise
        except Exception as error:
            raise self._failed(error) from error

    def finish_step(self, acted: None = None) -> TensorDictBase:
        """Waits for the next batch of a worker, checks and stores it.

        Returns:
            TensorDictBase: the rows, batch size [n]; what is not stored is in them too.

        Raises:
            SimulatorError: if a worker failed, or its rows do not continue those before; the next call of :meth:`act`
                starts all of them anew.
            NonFiniteError: if a row is not finite; likewise.
        """
        try:
            rows = waited_for(lambda: next(self._batches), warns_that_nothing_comes(self.while_waiting)).reshape(-1)
        except WorkLeftError:
            raise
        except Exception as error:
            raise self._failed(error) from error
        rows = rows[: self.config.total_decisions - self._frames]  # the last batch may be more than the budget
        self._check_finite(rows)
        self._check_continuous(rows)
        self._arrived = True
        self._last_worker = int(rows[WORKER][0])
        self._played[self._last_worker] += len(rows)
        planned = rows[PLAN, VERSION]
        rows[WEIGHT_AGE] = torch.where(planned > 0, self.agent.updater.updates - planned, -1)
        self.replay_buffer.extend(rows.exclude(WEIGHT_AGE, *self.exclude_keys))
        self._frames += len(rows)
        return rows

    def _start(self) -> None:
        config, agent = self.config, self.agent
        observation_dim = agent.world_model.observation_dim
        assert observation_dim is not None  # training takes vectors
        sizes = observation_dim, agent.world_model.action_dim
        compiled = None
        if agent.planner.compiled_plan is not None:  # for the CPU, where workers plan, wherever the learner is
            decisions = config.total_decisions - config.seed_decisions
            compiled = resolve_compile(config.compile, torch.device("cpu"), decisions)
        parts = WorkerParts(config, sizes, agent.planner.discount, compiled, known_here(config))
        self._numbers = range(self._next_number, self._next_number + config.workers)
        self._next_number += config.workers
        self._last_worker = None
        self._ends, self._played = {}, Counter()
        torchrl_logger.info(f"starting {config.workers} workers")
        self._workers = start_workers(parts, engine=config.engine, numbers=self._numbers, rows=config.rows_per_batch)
        self._planning = not self.in_seed_phase
        self._send(None)
        self._batches = iter(self._workers)

    def _send(self, number: int | None) -> None:
        """Sends the weights to one worker that has old ones, or to all of them."""
        assert self._workers is not None
        updates = self.agent.updater.updates
        if number is not None and updates - self._sent[number] < self.config.send_every:
            return
        actor = Actor(self.agent.planner, planning=self._planning)
        live: Any = TensorDict.from_module(actor)
        weights = live.data.cpu().clone()  # in memory that may be shared
        if number is not None and self.config.engine == "multi":
            number = None  # they read the same memory
        place = None if number is None else number - self._numbers.start
        send_weights(self._workers, weights, place, while_waiting=self.while_waiting)
        self._sent |= dict.fromkeys(self._numbers if number is None else [number], updates)

    def _failed(self, error: BaseException) -> Exception:
        """The error to raise: of the simulator if new workers may do better."""
        if self._workers is None:
            text = at_first = f"the workers cannot be started: {first_line(error)}"
        else:
            text = why_it_failed(self._workers, error)
            at_first = f"{text}, before it sent a row"
            self._stop()
        if not self._arrived:
            return RuntimeError(at_first)
        return SimulatorError(f"{text}; all workers are started anew")

    def _check_finite(self, rows: TensorDictBase) -> None:
        # A plan that fell back has no value.
        for key, value in rows.exclude((PLAN, VALUE), *self.exclude_keys).items(True, True):
            if value.is_floating_point() and not value.isfinite().all():
                number = int(rows[WORKER][0]) - self._numbers.start
                self._stop()
                raise NonFiniteError(
                    f"worker {number} sent a non-finite {key!r} after {self._frames} decisions; its rows were not "
                    "stored, and all workers are started anew"
                )

    def _check_continuous(self, rows: TensorDictBase) -> None:
        """What is missing between two batches would be taken for a step."""
        worker = int(rows[WORKER][0])
        end, self._ends[worker] = self._ends.get(worker), rows[-1].clone()
        if end is None or bool(end[NEXT, "done"]):
            return
        if not torch.equal(rows[OBSERVATION][0], end[NEXT, OBSERVATION]):
            self._stop()
            raise SimulatorError(
                f"worker {worker - self._numbers.start} sent rows that do not continue those before, after "
                f"{self._frames} decisions; they were not stored, and all workers are started anew"
            )

    def _stop(self) -> None:
        workers, self._workers, self._batches = self._workers, None, iter(())
        if workers is None:
            return
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                workers.shutdown()
        except Exception as error:  # whatever is broken is given up
            torchrl_logger.warning(f"workers did not end in order: {first_line(error)}")

    def shutdown(self, raise_on_error: bool = True) -> None:
        """Ends the workers, and the cluster if it is the run's own."""
        self._stop()
        if self._cluster is not None:
            self._cluster.close()
            self._cluster = None
        if not self.env.is_closed:
            self.env.close(raise_if_closed=raise_on_error)

    def set_seed(self, seed: int, static_seed: bool = False) -> int:
        """Nothing to do: new workers have seeds of their own."""
        return seed

    def state_dict(self) -> OrderedDict:
        """Counters; the episodes that are running are given up."""
        return OrderedDict(frames=self._frames, next_number=self._next_number)

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Restores :meth:`state_dict`; fresh episodes begin."""
        self._frames, self._next_number = state_dict["frames"], state_dict["next_number"]
