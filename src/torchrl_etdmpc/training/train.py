"""One training run: random phase, pretraining, learning."""

from __future__ import annotations

import math
import shutil
import time
import warnings
from typing import Any

import torch
from torchrl import torchrl_logger
from torchrl.envs import EnvBase

from torchrl_etdmpc.checkpoints import Part
from torchrl_etdmpc.collectors import NonFiniteError, SimulatorError
from torchrl_etdmpc.envs import success_return
from torchrl_etdmpc.runs import ProgressBar, RunDirectory, RunLog, first_line, processor, progress_bar, source_commit
from torchrl_etdmpc.training.agent_file import AgentFile, BestAgent
from torchrl_etdmpc.training.config import TrainConfig
from torchrl_etdmpc.training.distributed import WorkerCollector
from torchrl_etdmpc.training.evaluator import Evaluator
from torchrl_etdmpc.training.learner import Learner
from torchrl_etdmpc.training.precompile import precompile
from torchrl_etdmpc.training.run_checkpoints import RandomState, RunCheckpoints
from torchrl_etdmpc.training.run_state import Duty, RunState
from torchrl_etdmpc.training.signals import RunInterrupted, StopSignals, WorkLeftError


class TrainingRun:
    """Drives the learner through one run: random phase, pretraining, learning; evaluates, logs and saves it.

    Making one builds the parts and touches no file. What a run goes on from is ``parts``: an entry more is saved and
    restored with the others, in this order.

    Args:
        config (TrainConfig): the run.

    Keyword Args:
        env (EnvBase): batch size [] or [config.num_envs]; closed at the end.
        eval_env (EnvBase): batch size [config.eval_episodes]; closed at the end.
        log (RunLog): the tables; its directory exists when :meth:`run` is called.
        stop (StopSignals, optional): what is asked whether to stop. Default: nobody asks.

    Raises:
        ValueError: if a setting is out of range.

    >>> import tempfile
    >>> from torchrl_etdmpc.envs import make_env
    >>> from torchrl_etdmpc.training import preset
    >>> config = TrainConfig.from_dict(preset("cpu").to_dict() | {"task": "gym/Pendulum-v1", "eval_episodes": 2})
    >>> env, eval_env = make_env(config.task), make_env(config.task, num_envs=2, parallel=False)
    >>> log = RunLog(RunDirectory(tempfile.mkdtemp()), total_env_steps=config.total_env_steps)
    >>> run = TrainingRun(config, env=env, eval_env=eval_env, log=log)  # run.run() trains
    >>> run.env_steps, list(run.parts)[:2]
    (0, ['agent', 'best'])
    >>> run.learner.collector.shutdown()
    >>> run.evaluator.close()
    """

    def __init__(
        self, config: TrainConfig, *, env: EnvBase, eval_env: EnvBase, log: RunLog, stop: StopSignals | None = None
    ) -> None:
        self.config, self.log = config, log
        self.learner = Learner(config, env)
        agent, collector = self.learner.agent, self.learner.collector
        self.evaluator = Evaluator(
            eval_env,
            agent,
            episodes=config.eval_episodes,
            seed=(config.seed + 10_000) % 2**32,  # other episodes than those of training
            with_policy=config.eval_policy,
            with_lengths=config.task_spec.terminates,
            success_return=success_return(config.task_spec),
        )
        self.state = RunState()
        self.stop = StopSignals() if stop is None else stop
        if isinstance(collector, WorkerCollector):
            collector.while_waiting = self.stop.leave_work
        file = AgentFile(agent, config, self.counters)
        self.best = BestAgent(file, log.directory.best_agent)
        self.parts: dict[str, Part] = {
            "agent": file,
            "best": self.best,
            "sampler": self.learner.replay.sampler,
            "collector": collector,  # after the rows and who follows them: it may end episodes
            **({} if self.learner.reanalyze is None else {"reanalyze": self.learner.reanalyze}),
            "learner": self.learner,
            "log": log,
            "state": self.state,
            "random": RandomState(),  # last: restoring the others may draw from it
        }
        self.checkpoints = RunCheckpoints(config, log.directory, self.learner, self.best, self.parts)
        self._compile_s = 0.0
        self._commit = source_commit()  # now: by the end of a long run the files may be others than those that it runs
        self._threads = torch.get_num_threads()  # closing a batched environment changes it

    @property
    def env_steps(self) -> int:
        """Environment steps so far, action repeats counted."""
        return self.learner.env_steps

    def counters(self) -> dict[str, Any]:
        """The columns that every file of the run counts by."""
        return {
            "env_steps": self.env_steps,
            "decision_steps": self.learner.collector.frames,
            "updates": self.learner.agent.updater.updates,
            "wall_time_s": round(self.state.wall_time_s, 2),
        }

    def run(self) -> dict[str, Any]:
        """Trains to the budget, draws the curve and writes the summary.

        Returns:
            dict: what the run came to, as ``summary.json`` names it.

        Raises:
            RunInterrupted: if a signal asked the run to stop; it is saved.
            OSError: if the end cannot be saved: then the run is not finished, and goes on when there is room. Or if the
                directory is not this run's any more.
            NonFiniteError, SimulatorError: if environment, policy or updates keep failing; the run is saved first.
        """
        try:
            self.precompile()
            self.stop.nothing_to_save = not self.env_steps
            self._do_what_is_due()
            self.stop.nothing_to_save = False
            self._explore()
            self._pretrain()
            self._learn()
        except (NonFiniteError, SimulatorError):
            self.learner.faults_in_a_row = 0  # a run that goes on from here has as many new tries
            self.checkpoints.save()
            raise
        finally:
            self.learner.collector.shutdown(raise_on_error=False)
            self.evaluator.close()
        summary = self.summary()
        _draw_curve(self.log.directory)
        try:
            self.checkpoints.save_end()
            self.log.finish(summary)
        except OSError as error:
            raise OSError(
                f"run_dir={self.log.directory} made its {self.env_steps} env steps, but the end could not be saved "
                f"({error.strerror}), so it is not finished; make room and go on with resume=auto."
            ) from error
        return summary

    def precompile(self) -> None:
        """Compiles what the run will call; see ``training/precompile.py``."""
        batches = self.learner.collector.env.batch_size, self.evaluator.env.batch_size
        self._compile_s = precompile(self.config, self.learner.agent, *batches)

    def _explore(self) -> None:
        if self.state.stage != "random":
            return
        collector = self.learner.collector
        total = self.config.seed_decisions
        with progress_bar("random phase", total, "decisions", initial=collector.frames) as progress:
            while collector.in_seed_phase:
                self._step()
                self._after_work()
                progress.update(collector.frames)
        self.state.stage = "pretrain"

    def _pretrain(self) -> None:
        if self.state.stage != "pretrain":
            return
        done = self.learner.pretrained
        with progress_bar("pretraining", self.config.pretrain_updates, "updates", initial=done) as progress:
            for _ in self.learner.pretrain():
                self._after_work()
                progress.update(self.learner.pretrained)
        self.state.stage = "learn"
        if self.learner.passed(self.config.eval_every):
            self.state.due.append("evaluation")
        self._do_what_is_due()

    def _learn(self) -> None:
        config, state = self.config, self.state
        with progress_bar("learning", config.total_env_steps, "env steps", initial=self.env_steps) as progress:
            while self.env_steps < config.total_env_steps:
                tick = time.perf_counter()
                made = self._step(updates=True)
                state.learning_s += time.perf_counter() - tick
                if made:
                    self._note_duties()
                self._after_work()
                progress.update(self.env_steps, self._note())

    def _step(self, *, updates: bool = False) -> bool:
        """A step of the learner, or none if a signal comes while it waits for workers."""
        try:
            return self.learner.step(updates=updates)
        except WorkLeftError:
            return False

    def _note(self) -> str:
        """What the bar says besides its steps; a narrow terminal has no room for the speed."""
        state, learned = self.state, self.learner.collector.frames - self.config.seed_decisions
        parts = [f"return {state.eval_returns[-1]:.1f}"] if state.eval_returns else []
        if state.learning_s and shutil.get_terminal_size().columns >= 100:
            parts.append(f"{learned / state.learning_s:.1f} decisions/s")
        return ", ".join(parts)

    def _note_duties(self) -> None:
        config, last = self.config, self.env_steps >= self.config.total_env_steps
        intervals: dict[Duty, int] = {
            "train_row": config.log_every,
            "evaluation": config.eval_every,
            "checkpoint": config.checkpoint_every,
        }
        self.state.due.extend(duty for duty, interval in intervals.items() if last or self.learner.passed(interval))

    def _after_work(self) -> None:
        """Does what is due, and stops here if that was asked for."""
        if self.checkpoints.overdue and "checkpoint" not in self.state.due:
            self.state.due.append("checkpoint")
        self._do_what_is_due()

    def _do_what_is_due(self) -> None:
        due = self.state.due
        while due:
            self._stop_if_asked()
            if due[0] == "checkpoint":
                due.pop(0)  # a run that goes on from this checkpoint need not save it again
                self.checkpoints.save()
            else:
                {"evaluation": self.evaluate, "train_row": self.write_row}[due[0]]()
                due.pop(0)
        self._stop_if_asked()

    def _stop_if_asked(self) -> None:
        if self.stop.requested:
            if not self.env_steps:
                raise RunInterrupted("stopped before the first step, with nothing to save; start it again.")
            saved = "saved" if self.checkpoints.save() else "not saved: the checkpoint before it stays"
            raise RunInterrupted(
                f"stopped at {self.env_steps} env steps and {saved} in {self.log.directory}; go on with resume=true."
            )

    def evaluate(self) -> None:
        """Appends a row to ``eval.csv``."""
        steps = self.config.task_spec.decision_steps_per_episode * (1 + self.config.eval_policy)  # all side by side
        try:
            with progress_bar("evaluation", steps, "decisions", passing=True) as progress:
                result = self.evaluator(on_step=lambda _: self._on_evaluation_step(progress))
        except WorkLeftError:
            self._stop_if_asked()  # with training's random numbers; the evaluation is repeated from its beginning
            return
        except Exception as error:
            if not self.learner.collector.frames:
                raise  # nothing is lost yet
            warnings.warn(
                f"the evaluation at {self.env_steps} env steps failed ({first_line(error)}); training goes on.",
                stacklevel=2,
            )
            self.state.eval_returns.append(math.nan)
            return
        self.log.directory.require_held()  # an evaluation takes minutes
        self.state.eval_returns.append(result.return_mean)
        self.best.note(result.return_mean)
        row = {name: value for name, value in result._asdict().items() if value is not None}
        self.log.log_eval(row, **self.counters())

    def _on_evaluation_step(self, progress: ProgressBar) -> None:
        progress.advance()
        self.stop.leave_work()

    def write_row(self) -> None:
        """Appends a row to ``train.csv``: means over the interval, and counts since the run began."""
        self.log.directory.require_held()
        self.log.log_train(self.learner.pop_row(), **self.counters())

    def summary(self) -> dict[str, Any]:
        """What the run came to."""
        state, device = self.state, self.learner.agent.device
        evaluated = [value for value in state.eval_returns if not math.isnan(value)]
        learned = self.learner.collector.frames - self.config.seed_decisions
        return {
            "task": self.config.task,
            "preset": self.config.preset,
            "seed": self.config.seed,
            "env_steps": self.env_steps,
            "final_return": state.eval_returns[-1] if state.eval_returns else math.nan,
            "best_return": max(evaluated, default=math.nan),
            "wall_time_s": self.counters()["wall_time_s"],
            "compile_s": round(self._compile_s, 2),
            "decisions_per_second": learned / state.learning_s if state.learning_s else math.nan,
            "parameters": sum(parameter.numel() for parameter in self.learner.agent.world_model.parameters()),
            "device": torch.cuda.get_device_name(device) if device.type == "cuda" else "cpu",
            "processor": processor(),
            "threads": self._threads,
            "commit": self._commit,
        }


def _draw_curve(directory: RunDirectory) -> None:
    """Draws the curve; one that cannot be drawn is a warning, because the run is done and its summary matters more."""
    try:
        from torchrl_etdmpc.analysis import plot_run

        plot_run(directory.path)
    except Exception as error:  # a user's own matplotlibrc can make matplotlib raise anything, e.g. without LaTeX
        torchrl_logger.warning(f"{directory.curve.name} was not drawn: {first_line(error)}")
