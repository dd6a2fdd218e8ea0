"""An agent that is looked at: its episodes, its plans of chosen states, and the work that makes them."""

from __future__ import annotations

import gc
import threading
from collections import OrderedDict
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchrl_etdmpc.envs import Task
from torchrl_etdmpc.inspector.episodes import Episode, Simulator, play_episode
from torchrl_etdmpc.inspector.settings import settings_of_class, with_settings
from torchrl_etdmpc.inspector.trace import Cancelled, Trace, add_simulation, trace_plan, watched
from torchrl_etdmpc.planners import BarePolicy, EnsembleMPPIPlanner

__all__ = ["Inspection", "Job", "State", "Strip"]

FRAME_SIZE = 160
STRIP_FRAMES = 12
KEPT = 16
"""Traces, and episodes, that are kept."""
# What an observation leaves open (velocities that it lacks, contacts, the simulator's warm start) is not made up.
_NO_SIMULATOR = (
    "There are no frames, and the plan is not rolled in the simulator: a row of the replay buffer holds what was "
    "observed, not the simulator's state; choose a state of an episode for both."
)
_COLD = "Planned without a warm start: {} no plan of the decision before."


class State(NamedTuple):
    """Which state is planned."""

    episode: int
    """Seed of the episode; with ``replay``, unused."""
    step: int
    """Decision of the episode, or row of the replay buffer."""
    replay: bool = False


class Strip(NamedTuple):
    """An episode in pictures."""

    steps: list[int]
    frames: list[np.ndarray]
    """uint8 ``[height, width, 3]`` each; none where nothing can be rendered."""


@dataclass
class Job:
    """Work that may take a while."""

    request: tuple[State, dict[str, Any], int] | None = None
    """What is planned: state, changed settings, seed."""
    like: int | None = None
    """Number of the trace in whose components it is drawn."""
    what: str = "waiting"
    done: int = 0
    of: int = 0
    future: Future[int] | None = None
    stop: threading.Event = field(default_factory=threading.Event)

    def begin(self, what: str) -> None:
        """Notes what is being done now."""
        self.what, self.done, self.of = what, 0, 0

    def tell(self, done: int, of: int) -> None:
        """Notes how far it is.

        Raises:
            Cancelled: if it was given up.
        """
        self.done, self.of = done, of
        if self.stop.is_set():
            raise Cancelled("cancelled; the plan before is still shown.")

    def wait(self, seconds: float | None = None) -> bool:
        """Whether it ended within so many seconds."""
        assert self.future is not None
        try:
            self.future.exception(seconds)
        except TimeoutError:
            return False
        return True


class Inspection:
    """Episodes and traces of one agent, made by one thread: a renderer belongs to the thread that began it.

    Args:
        planner (EnsembleMPPIPlanner): the agent's.
        task (Task, optional): that it acts in. Default: none, then there are states of the replay buffer alone.

    Keyword Args:
        bare (bool): whether the agent's policy plays the episodes, and not the planner. Default: ``False``.
        steps (int, optional): decisions of an episode, at most. Default: whole episodes.
        replay (callable, optional): a row's number to its observation ``[O]``.
        rows (int): of the replay buffer. Default: 0.
        about (mapping, optional): plain values for the manifests, e.g. ``checkpoint``.

    >>> from torchrl_etdmpc import LatentEnv, WorldModel
    >>> from torchrl_etdmpc.envs import get_task
    >>> env = LatentEnv(WorldModel(5, 1, latent_dim=16, mlp_dim=16))
    >>> planner = EnsembleMPPIPlanner(env, horizon=2, num_samples=16, num_elites=4, num_proposals=2, iterations=2)
    >>> inspection = Inspection(planner, get_task("cartpole-balance"), steps=3)
    >>> trace = inspection.plan(State(episode=0, step=2), {"horizon": 3})
    >>> trace.horizon, trace["real_rewards"].shape
    (3, (3,))
    >>> inspection.close()
    """

    def __init__(
        self,
        planner: EnsembleMPPIPlanner,
        task: Task | None = None,
        *,
        bare: bool = False,
        steps: int | None = None,
        replay: Callable[[int], Tensor] | None = None,
        rows: int = 0,
        about: Mapping[str, Any] | None = None,
    ) -> None:
        self.planner, self.task, self.steps, self.replay, self.rows = planner, task, steps, replay, rows
        self.bare = bare
        self.about = dict(about or {})
        self.settings = settings_of_class(type(planner))
        self.cannot_render = ""
        self.traces: OrderedDict[int, Trace] = OrderedDict()
        self._episodes: OrderedDict[int, tuple[Episode, Strip]] = OrderedDict()
        self._simulator: Simulator | None = None
        self._worker = ThreadPoolExecutor(max_workers=1, thread_name_prefix="inspection")
        self._number = 0
        self._job: Job | None = None

    def start(self, state: State, changes: Mapping[str, Any], *, like: int | None = None, seed: int = 0) -> Job:
        """Begins to plan a state; what is still being planned is given up.

        Args:
            state (State): which.
            changes (mapping): settings that differ from the planner's.

        Keyword Args:
            like (int, optional): number of a trace whose principal components are taken.
            seed (int): of the plan's noise. Default: 0.

        Returns:
            Job: its result is the number of the trace in :attr:`traces`.
        """
        if self._job is not None:
            self._job.stop.set()
        job = self._job = Job(request=(state, dict(changes), seed), like=like)
        job.future = self._worker.submit(self._make, job, state, dict(changes), like, seed)
        return job

    def plan(self, state: State, changes: Mapping[str, Any] | None = None, **options: Any) -> Trace:
        """Plans a state and waits for it: the arguments of :meth:`start`."""
        job = self.start(state, changes or {}, **options)
        assert job.future is not None
        return self.traces[job.future.result()]

    def strip(self, episode: int) -> Strip | None:
        """The pictures of an episode that was played."""
        known = self._episodes.get(episode)
        return None if known is None else known[1]

    def play(self, episode: int) -> int:
        """Plays an episode, or remembers it, and returns how many decisions it has."""
        return len(self._worker.submit(self._episode, Job(), episode).result().action)

    def length(self, episode: int) -> int | None:
        """Decisions of an episode that was played."""
        known = self._episodes.get(episode)
        return None if known is None else len(known[0].action)

    @property
    def decisions(self) -> int:
        """Of an episode, at most."""
        return self.steps or (1 if self.task is None else self.task.decision_steps_per_episode)

    def close(self) -> None:
        """Gives up what is being planned."""
        if self._job is not None:
            self._job.stop.set()
        self._worker.submit(self._leave_simulator)
        self._worker.shutdown()

    def _leave_simulator(self) -> None:
        """Frees the renderer, where it lives."""
        if self._simulator is not None:
            self._simulator.env.close(raise_if_closed=False)
            self._simulator = None
            gc.collect()

    def _make(self, job: Job, state: State, changes: dict[str, Any], like: int | None, seed: int) -> int:
        planner = with_settings(self.planner, **changes)  # a setting that cannot be is found before any work
        if job.stop.is_set():
            raise Cancelled("cancelled; the plan before is still shown.")
        observation, plan_mean, place, about = self._state(job, state)
        job.begin("planning")
        held = None
        if like is not None and like in self.traces:
            held = self.traces[like]
            self.traces.move_to_end(like)  # it is still looked at
        trace = trace_plan(
            planner,
            observation,
            plan_mean=plan_mean,
            seed=seed,
            like=held,
            progress=job.tell,
            **self.about,
            **about,
        )
        notes = [_NO_SIMULATOR] if state.replay else []
        if place is not None:
            job.begin("rolling the plan in the simulator")
            trace, notes = self._simulated(trace, planner, place)
        if planner.warm_start and plan_mean is None:
            lacks = "a row of the replay buffer holds" if state.replay else "the bare policy, which played, makes"
            notes.append(_COLD.format(lacks))
        trace = replace(trace, manifest={**trace.manifest, "notes": notes})
        self._number += 1
        _keep(self.traces, self._number, trace)
        return self._number

    def _state(self, job: Job, state: State) -> tuple[Tensor, Tensor | None, Any, dict[str, Any]]:
        """Observation, warm start and simulator's state, and what the manifest says of them."""
        if state.replay:
            if self.replay is None:
                raise ValueError("state cannot be a row of the replay buffer: this checkpoint has none beside it.")
            if not 0 <= state.step < self.rows:
                raise ValueError(
                    f"the row must be in [0, {self.rows}), the rows of the replay buffer, got {state.step}."
                )
            about = {"state": {"from": "replay", "row": state.step}, "task": self.task and self.task.name}
            return self.replay(state.step), None, None, about
        episode = self._episode(job, state.episode)
        if not 0 <= state.step < len(episode.action):
            raise ValueError(
                f"the step must be in [0, {len(episode.action)}), the decisions of episode {state.episode}, got "
                f"{state.step}."
            )
        plan_mean = None if episode.plan_mean is None else episode.plan_mean[state.step]
        about = {"state": {"from": "episode", "seed": episode.seed, "step": state.step}, "task": episode.task}
        return episode.observation[state.step], plan_mean, episode.states[state.step], about

    def _episode(self, job: Job, seed: int) -> Episode:
        known = self._episodes.get(seed)
        if known is not None:
            return known[0]
        if self.task is None:
            raise ValueError("state cannot be one of an episode: there is no task to play.")
        job.begin(f"playing episode {seed}")
        if self.bare:
            policy: Any = BarePolicy(self.planner.world_model)  # pyright: ignore[reportArgumentType]
        else:
            iterations = self.planner.iterations
            policy = watched(self.planner, lambda asked: job.tell(asked // iterations, self.decisions))
        episode = play_episode(policy, self.task, seed=seed, steps=self.steps)
        job.begin("filming the episode")
        _keep(self._episodes, seed, (episode, self._film(episode)))
        return episode

    def _film(self, episode: Episode) -> Strip:
        count = min(STRIP_FRAMES, len(episode.action))
        steps = sorted({int(step) for step in np.linspace(0, len(episode.action) - 1, count)})
        frames: list[np.ndarray] = []
        try:
            for step in steps:
                self.simulator.restore(episode.states[step])
                frames.append(self.simulator.frame(FRAME_SIZE, FRAME_SIZE).numpy())
        except (RuntimeError, ValueError) as error:
            self.cannot_render = f"There are no frames: {_sentence(error)}"
            frames = []
        return Strip(steps, frames)

    @property
    def simulator(self) -> Simulator:
        """That the episodes were played in; only for the thread that works."""
        if self._simulator is None:
            assert self.task is not None
            self._simulator = Simulator(self.task)
        return self._simulator

    def _simulated(self, trace: Trace, planner: EnsembleMPPIPlanner, place: Any) -> tuple[Trace, list[str]]:
        """The trace with what became of its plan in the simulator, or why that is not known."""
        actions, notes = torch.from_numpy(trace["chosen_actions"]), []
        if self.cannot_render:
            notes.append(self.cannot_render)
        try:
            self.simulator.restore(place)
            frames = None
            if not self.cannot_render:
                frames = [self.simulator.frame(FRAME_SIZE, FRAME_SIZE)]
            observations, rewards = [self.simulator.observation], []
            for action in actions:  # one by one, for frames of a smaller size
                rolled = self.simulator.roll(action[None])
                if not len(rolled.reward):  # the time limit came before
                    break
                observations.append(rolled.observation[-1])
                rewards.append(rolled.reward[0])
                if frames is not None:
                    frames.append(self.simulator.frame(FRAME_SIZE, FRAME_SIZE))
                if rolled.terminated:
                    break
        except (RuntimeError, ValueError) as error:
            return trace, [*notes, f"The plan was not rolled in the simulator: {_sentence(error)}"]
        pictures = None if frames is None else torch.stack(frames)
        seen = add_simulation(trace, torch.stack(rewards), torch.stack(observations), pictures, planner.world_model)
        return seen, notes


def _sentence(error: Exception) -> str:
    return " ".join(str(error).split()).rstrip(".") + "."


def _keep(kept: OrderedDict[int, Any], key: int, value: Any) -> None:
    kept[key] = value
    while len(kept) > KEPT:
        kept.popitem(last=False)
