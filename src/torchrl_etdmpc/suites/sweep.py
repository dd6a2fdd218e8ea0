"""Variants that are looked for: Optuna proposes settings, each proposal is trained like any variant."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path
from statistics import fmean
from typing import TYPE_CHECKING, Any

from torchrl_etdmpc.runs import RunDirectory, first_line
from torchrl_etdmpc.suites.attempt import BELOW_MEDIAN, last_verdict, note
from torchrl_etdmpc.suites.experiment import Experiment, Run, Search
from torchrl_etdmpc.suites.index import last_rows, number_of, read_progress, whole_of

if TYPE_CHECKING:
    import optuna


class Sweep:
    """The trials of one search, remembered in an SQLite file.

    A trial is a variant by the name of ``"{name} trial {number}"``; its value, which is maximised, is the mean over the
    experiment's tasks and seeds of the last return. After each evaluation that all runs of a trial have reached, the
    best of their means so far is compared with the means of the finished trials at the same env step: below the median
    of five or more, the trial ends (Optuna's ``MedianPruner``). A trial that was running when the process was killed,
    or that has a run which was given up, goes on in the next process with the same settings. A proposal whose settings
    do not go together is a failed trial. Processes that share the folder share the trials: each follows those that were
    open when it began and those that it proposed itself.

    Args:
        experiment (Experiment): that holds the search.
        name (str): of the search.
        folder (Path): of the runs; the studies are in its ``sweeps.sqlite``.
        keep (callable, optional): gets name and settings of a variant before its first run begins.
        check (callable, optional): gets a run of a proposal; raises ``ValueError`` if it cannot be trained.
        say (callable, optional): gets a line on a proposal that cannot.

    Raises:
        ImportError: if Optuna is missing.
        ValueError: if the file cannot be read.

    >>> import tempfile
    >>> search = Search({"optim.lr": {"low": 1e-4, "high": 3e-3, "log": True}}, trials=20, settings={"preset": "cpu"})
    >>> experiment = Experiment("rates", ("walker-walk",), (1, 2), {}, {"lr": search}, budget=50_000)
    >>> sweep = Sweep(experiment, "lr", Path(tempfile.mkdtemp()))
    >>> [f"{run.variant}, seed {run.seed}" for run in sweep.propose()]
    ['lr trial 0, seed 1', 'lr trial 0, seed 2']
    """

    def __init__(
        self,
        experiment: Experiment,
        name: str,
        folder: Path,
        keep: Callable[[str, dict[str, Any]], None] = lambda name, settings: None,
        check: Callable[[Run], None] = lambda run: None,
        say: Callable[[str], None] = lambda line: None,
    ) -> None:
        self.experiment, self.name, self.folder = experiment, name, folder
        self.search: Search = experiment.searches[name]
        self._keep, self._check, self._say = keep, check, say
        self._study = _study(folder / "sweeps.sqlite", name, self.search)
        self._open: dict[int, list[Run]] = {}
        self._spent = 0
        for trial in self._study.get_trials(deepcopy=False):
            self._spent += self._take_up(trial)

    @property
    def done(self) -> bool:
        """Whether no trial is open and none will be proposed."""
        return not self._open and self._spent >= self.search.trials

    def propose(self) -> list[Run]:
        """The runs of one more trial; none if there are enough."""
        import optuna

        while self._spent < self.search.trials:
            known = self._study.get_trials(deepcopy=False)
            self._spent = sum(map(self._is_whole, known))  # another process may have proposed some
            if self._spent >= self.search.trials:
                break
            # With one seed for all, a search that goes on after a kill would draw its first proposals again.
            self._study.sampler = optuna.samplers.TPESampler(seed=len(known))
            trial = self._study.ask(_distributions(self.search))
            self._spent += 1
            runs = self._begin(trial.number, trial.params)
            if runs:
                return runs
        return []

    def runs(self) -> list[Run]:
        """Those of the open trials."""
        return [run for runs in self._open.values() for run in runs]

    def best(self) -> str:
        """One line on the best trial so far."""
        from optuna.trial import TrialState

        ended = self._study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
        if not ended:
            return f"{self.name}: no trial is finished"
        trial = max(ended, key=lambda one: one.value or 0.0)
        point = " ".join(f"{name}={value}" for name, value in trial.params.items())
        return (
            f"{self.name}: the best of {len(ended)} finished trials is trial {trial.number}, {trial.value:.1f}: {point}"
        )

    def look(self) -> list[Run]:
        """Notes how far the open trials are; returns the runs of those that end early."""
        from optuna.trial import TrialState

        ended: list[Run] = []
        trials = self._study.get_trials(deepcopy=False) if self._open else []
        for number, runs in list(self._open.items()):
            if trials[number].state.is_finished():  # closed by another process
                del self._open[number]
                ended += runs if trials[number].state == TrialState.PRUNED else []
                continue
            last = [read_progress(run) for run in runs]
            if all(entry.state == "finished" for entry in last):
                self._report(number, runs)  # later trials are compared with it at each step
                self._tell(number, fmean(entry.latest_return for entry in last))
            elif self.search.prune and self._should_be_pruned(number, runs):
                self._tell(number, None)
                ended += runs
        return ended

    def give_up(self, run: Run) -> None:
        """Leaves a trial open whose run cannot be finished now: the next process tries it again."""
        self._open = {number: runs for number, runs in self._open.items() if run not in runs}

    def _take_up(self, trial: optuna.trial.FrozenTrial) -> bool:
        """Goes on with a trial of an earlier process; whether it counts as one."""
        import optuna

        if not self._is_whole(trial):  # killed while it was proposed, or another process proposes it now
            return False
        if not trial.state.is_finished():
            self._begin(trial.number, trial.params)
        elif trial.state == optuna.trial.TrialState.PRUNED:
            for run in self._runs(trial.number, trial.params):
                if last_verdict(run) is None and read_progress(run).state != "finished":
                    note(run, "pruned", BELOW_MEDIAN)
        return True

    def _is_whole(self, trial: optuna.trial.FrozenTrial) -> bool:
        """Whether every setting of the search was proposed."""
        return set(trial.params) == set(self.search.space)

    def _begin(self, number: int, point: dict[str, Any]) -> list[Run]:
        """The runs of a trial; none, and a failed trial, if they cannot be trained."""
        try:
            runs = self._runs(number, point)
            self._check(runs[0])
        except ValueError as error:
            self._say(f"{self._variant(number)}: cannot be trained: {first_line(error)}")
            self._tell(number, math.nan)
            return []
        self._keep(self._variant(number), {**self.search.settings, **point})
        self._open[number] = runs
        return runs

    def _runs(self, number: int, point: dict[str, Any]) -> list[Run]:
        variants = {self._variant(number): {**self.search.settings, **point}}
        return dataclasses.replace(self.experiment, variants=variants, searches={}, base=None).runs(self.folder)

    def _variant(self, number: int) -> str:
        return f"{self.name} trial {number}"

    def _tell(self, number: int, value: float | None) -> None:
        """Closes a trial: with its value, as failed if that is NaN, as pruned without one."""
        from optuna.trial import TrialState

        if value is None:
            self._study.tell(number, state=TrialState.PRUNED, skip_if_finished=True)
        elif math.isnan(value):
            self._study.tell(number, state=TrialState.FAIL, skip_if_finished=True)
        else:
            self._study.tell(number, value, skip_if_finished=True)
        self._open.pop(number, None)

    def _should_be_pruned(self, number: int, runs: list[Run]) -> bool:
        """Reports the evaluations; asks the pruner if one is new."""
        trial = self._report(number, runs)
        return trial is not None and trial.should_prune()

    def _report(self, number: int, runs: list[Run]) -> optuna.trial.Trial | None:
        """The trial, if there are new evaluations that all its runs have reached, but for the last one of a run."""
        import optuna

        frozen = self._study.get_trials(deepcopy=False)[number]
        trial = optuna.trial.Trial(self._study, frozen._trial_id)
        curves = [_evaluations(run) for run in runs]
        reached = set(curves[0]).intersection(*curves[1:]) - set(frozen.intermediate_values)
        try:
            for step in sorted(reached):
                trial.report(fmean(curve[step] for curve in curves), step)
        except optuna.exceptions.UpdateFinishedTrialError:  # by another process that looks for the same
            return None
        return trial if reached else None


def _study(file: Path, name: str, search: Search) -> optuna.Study:
    try:
        import optuna
        from sqlalchemy import URL
    except ImportError as error:
        raise ImportError(f"the search for {name!r} needs Optuna; run: pip install 'optuna>=5,<6'") from error
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    try:
        return optuna.create_study(
            storage=URL.create("sqlite", database=str(file)).render_as_string(),
            study_name=name,
            direction="maximize",
            pruner=optuna.pruners.MedianPruner(n_min_trials=5) if search.prune else optuna.pruners.NopPruner(),
            load_if_exists=True,
        )
    except Exception as error:  # SQLAlchemy has dozens
        raise ValueError(
            f"{file} cannot be used as a study ({first_line(error)}); remove it to search anew."
        ) from error


def _distributions(search: Search) -> dict[str, optuna.distributions.BaseDistribution]:
    from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

    found: dict[str, Any] = {}
    for name, values in search.space.items():
        if isinstance(values, list):
            found[name] = CategoricalDistribution(values)
        elif search.is_whole(name):
            found[name] = IntDistribution(int(values["low"]), int(values["high"]), log=values.get("log", False))
        else:
            found[name] = FloatDistribution(values["low"], values["high"], log=values.get("log", False))
    return found


def _evaluations(run: Run) -> dict[int, float]:
    """Returns by env step, without the one before learning and the one at the end."""
    rows = [
        (whole_of(row, "env_steps"), number_of(row, "return_mean")) for row in last_rows(RunDirectory(run.path).eval)
    ]
    return {step: value for step, value in rows if 0 < step < run.config.total_env_steps and math.isfinite(value)}
