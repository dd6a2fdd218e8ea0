"""What is still to be trained, and what the end of a process means for it: the same for every engine."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from typing import Protocol

from torchrl_etdmpc.runs import RunDirectory
from torchrl_etdmpc.suites.attempt import BELOW_MEDIAN, end, note
from torchrl_etdmpc.suites.experiment import Run
from torchrl_etdmpc.suites.index import read_progress
from torchrl_etdmpc.training.estimate import decision_flops

_LOOK_AGAIN_S = 2.0  # at a run that another process has, and at the trials of a search


class Trials(Protocol):
    """Runs that are proposed as the others end; :class:`~torchrl_etdmpc.suites.sweep.Sweep` is one."""

    @property
    def done(self) -> bool:
        """Whether no trial is open and none will be proposed."""
        ...

    def propose(self) -> list[Run]:
        """The runs of one more trial; none if there are enough."""
        ...

    def look(self) -> list[Run]:
        """Notes how far the open trials are; returns the runs of those that end early."""
        ...

    def give_up(self, run: Run) -> None:
        """Notes that a run cannot be finished."""
        ...


class Retries:
    """How often a run is tried again: without limit while it gets further, ``most`` times without.

    Args:
        most (int): retries in a row that may end without getting further.
    """

    def __init__(self, most: int) -> None:
        self.most = most
        self._tries: dict[str, tuple[int, int]] = {}  # the furthest env step so far, tries without getting beyond it

    def again(self, run: Run) -> bool:
        """Whether a run that ended unfinished is to be tried again."""
        steps = read_progress(run).env_steps
        before, tries = self._tries.get(run.name, (0, 0))
        tries = 0 if steps > before else tries + 1
        self._tries[run.name] = (max(steps, before), tries)
        return tries <= self.most


def work(run: Run) -> float:
    """What a run costs, in floating-point operations: by it the longest begin first."""
    return sum(decision_flops(run.config)) * run.config.total_decisions


class RunQueue:
    """Hands out runs to be trained, the longest first, and takes back what ended.

    Args:
        runs (sequence of Run): the finished ones cost nothing.

    Keyword Args:
        retries (int): tries of a run that fails or is killed without getting further. Default: ``2``.
        say (callable): gets a line on whatever happens. Default: silence.
        trials (iterable of Trials): proposed when nothing else can begin. Default: none.

    Attributes:
        runs (list of Run): all that it ever had.

    >>> import tempfile
    >>> from pathlib import Path
    >>> from torchrl_etdmpc.suites import Experiment
    >>> experiment = Experiment("heads", ("walker-walk",), (1, 2), {"cpu": {"preset": "cpu"}}, budget=50_000)
    >>> RunQueue(experiment.runs(Path(tempfile.mkdtemp()))).next().seed
    1
    """

    def __init__(
        self,
        runs: Sequence[Run],
        *,
        retries: int = 2,
        say: Callable[[str], None] = lambda line: None,
        trials: Iterable[Trials] = (),
    ) -> None:
        self.say = say
        self._trials = list(trials)
        self._tries = Retries(retries)
        self.runs: list[Run] = []
        self._waiting: list[Run] = []
        self._not_before: dict[str, float] = {}
        self._pruned: set[str] = set()
        self._elsewhere: set[str] = set()  # runs that another process has, or had
        self._next_look = 0.0
        self._add(runs)

    @property
    def left(self) -> bool:
        """Whether there is, or may come, something to begin."""
        return bool(self._waiting) or not all(trials.done for trials in self._trials)

    def next(self) -> Run | None:
        """A run that no other process has; ``None`` if there is none now."""
        run = self._next()
        for trials in self._trials:
            if run is None:
                self._add(trials.propose())
                run = self._next()
        return run

    def to_be_stopped(self) -> set[str]:
        """Names of the runs whose trial has ended early."""
        if self._trials and time.monotonic() >= self._next_look:
            self._next_look = time.monotonic() + _LOOK_AGAIN_S
            for run in [run for trials in self._trials for run in trials.look()]:
                self._pruned.add(run.name)
                if run in self._waiting:
                    self._prune(run)
        return self._pruned

    def failed_to_begin(self, run: Run, why: str) -> None:
        """Takes back a run whose process could not be started."""
        self._again(run, f"cannot be started: {why}", _LOOK_AGAIN_S)

    def ended(self, run: Run, code: int) -> None:
        """Takes back a run whose process has ended.

        Args:
            run (Run): of :meth:`next`.
            code (int): its exit code; negative for the signal that ended it.
        """
        what, why = end(run, code)
        progress = read_progress(run)
        if what == "finished" and progress.state != "finished":
            what, why = "failed", "it is finished, but its tables cannot be read"
        if what == "finished":
            self.say(f"{run.name}: finished, return {progress.latest_return:.1f}")
        elif run.name in self._pruned:
            self._prune(run)
        elif what == "elsewhere":
            self._wait_for_it(run)
        elif what == "stopped":
            self._again(run, f"was stopped at {progress.env_steps} env steps ({why})")
        else:
            note(run, "failed", why)
            self._again(run, f"failed: {why}")

    def _add(self, runs: Iterable[Run]) -> None:
        known = {run.name for run in self.runs}
        # A trial that is open is a variant of the folder's experiment as well.
        new = [run for name, run in {run.name: run for run in runs}.items() if name not in known]
        self.runs += new
        self._waiting += [run for run in new if read_progress(run).state not in ("finished", "pruned")]
        self._waiting.sort(key=work, reverse=True)

    def _next(self) -> Run | None:
        for run in list(self._waiting):
            if time.monotonic() < self._not_before.get(run.name, 0.0):
                continue
            self._waiting.remove(run)
            if RunDirectory(run.path).in_use:
                self._wait_for_it(run)
            elif read_progress(run).state == "finished":  # by the other process that had it
                self.say(f"{run.name}: finished")
            else:
                return run
        return None

    def _wait_for_it(self, run: Run) -> None:
        if run.name not in self._elsewhere:
            self.say(f"{run.name}: another process trains it")
            self._elsewhere.add(run.name)
        self._not_before[run.name] = time.monotonic() + _LOOK_AGAIN_S
        self._waiting.append(run)

    def _again(self, run: Run, what: str, pause_s: float = 0.0) -> None:
        if self._tries.again(run):
            self.say(f"{run.name}: {what}; it is tried again")
            self._not_before[run.name] = time.monotonic() + pause_s
            self._waiting.insert(0, run)
            return
        self.say(f"{run.name}: {what}; given up")
        if read_progress(run).state != "failed":
            note(run, "failed", f"{what}, {self._tries.most + 1} times without getting further")
        for trials in self._trials:
            trials.give_up(run)

    def _prune(self, run: Run) -> None:
        if run in self._waiting:
            self._waiting.remove(run)
        self.say(f"{run.name}: ended early, its trial is {BELOW_MEDIAN}")
        note(run, "pruned", BELOW_MEDIAN)
