"""One training run, from an empty directory to ``summary.json``."""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl import torchrl_logger
from torchrl.envs import EnvBase

from torchrl_etdmpc.collectors import NonFiniteError, SimulatorError
from torchrl_etdmpc.envs import simulator_state
from torchrl_etdmpc.training.builders import (
    build_agent,
    build_collector,
    build_reanalyze,
    build_replay,
    resolve_device,
    row_bytes,
)
from torchrl_etdmpc.training.config import TrainConfig
from torchrl_etdmpc.training.evaluate import BarePolicy, evaluate
from torchrl_etdmpc.training.progress import ProgressBar, progress_bar
from torchrl_etdmpc.training.run_log import RunLog
from torchrl_etdmpc.training.run_state import capture, restore
from torchrl_etdmpc.training.signals import RunInterrupted, StopSignals
from torchrl_etdmpc.training.store import CheckpointStore
from torchrl_etdmpc.training.warm_up import warm_up


class _EvaluationLeftError(Exception):
    """A signal came while the environment was evaluated."""


class TrainingRun:
    """Owns the parts of one run and drives them: seed phase, pretraining, then act and update at every decision.

    Args:
        config (TrainConfig): the run.
        env (EnvBase): batch size [] or [config.num_envs]; closed at the end.
        eval_env (EnvBase): batch size [config.eval_episodes]; closed at the end.
        log (RunLog): the run directory.

    Keyword Args:
        resume (bool): go on from the newest checkpoint in the run directory, exactly as if nothing had happened.

    Raises:
        CheckpointError: if ``resume`` finds no checkpoint that is whole.
    """

    def __init__(
        self, config: TrainConfig, *, env: EnvBase, eval_env: EnvBase, log: RunLog, resume: bool = False
    ) -> None:
        self.config = config
        self.log = log
        self.device = resolve_device(config.device)
        sizes = env.observation_spec["observation"].shape[-1], env.action_spec.shape[-1]
        self.agent = build_agent(config, *sizes, self.device)
        self.eval_env = eval_env.append_transform(self.agent.eval_planner.make_tensordict_primer())
        self.replay = build_replay(config, self.device, sizes=sizes)
        rows, where = self.replay.storage.max_size, self.replay.storage.device
        torchrl_logger.info(f"replay: {rows:,} rows, {rows * row_bytes(*sizes) / 1e6:,.0f} MB when full, on {where}")
        self.reanalyze = build_reanalyze(config, self.agent, self.replay)
        self.collector = build_collector(config, self.agent, env, self.replay)
        self.action_repeat = config.task_spec.action_repeat
        self.store = CheckpointStore(log.run_dir / "checkpoints", keep=config.checkpoint_keep)
        self.stage = "seed"  # then "pretrain", then "learn"
        self.pretrained = 0
        self.pending = ["evaluate"]  # what the last step called for and is not done yet
        self.eval_returns: list[float] = []
        self.eval_simulator = simulator_state(self.eval_env)  # as the last evaluation left it
        self.episode_returns: list[float] = []  # training episodes since the last row of train.csv
        self.metrics: dict[str, torch.Tensor] = {}
        self.start = time.perf_counter()
        self.best_saved = -math.inf  # latest evaluation before the best checkpoint
        self.faults = self.faults_in_a_row = 0
        self.learning_s = 0.0  # acting and updating, without seed phase, pretraining and evaluations
        self._threads = torch.get_num_threads()  # closing a batched environment changes it
        self._compile_s = 0.0
        self._saved_at = self.start
        self._stop = StopSignals()
        if resume:
            restored = self.store.load(self.agent, self.replay)
            restore(self, restored.state)
            torchrl_logger.info(f"going on from {restored.folder} ({self.env_steps} env steps)")

    @property
    def env_steps(self) -> int:
        """Environment steps so far, action repeats counted."""
        return self.collector.frames * self.action_repeat

    @property
    def wall_s(self) -> float:
        """Seconds of work so far, those before an interruption included."""
        return time.perf_counter() - self.start

    def counters(self) -> dict[str, int | float]:
        """The columns that every file of the run counts by."""
        return {
            "env_steps": self.env_steps,
            "decision_steps": self.collector.frames,
            "updates": self.agent.updater.updates,
            "wall_time_s": round(self.wall_s, 2),
        }

    def run(self) -> dict[str, Any]:
        """Trains to the budget and writes the summary, which it returns.

        Raises:
            RunInterrupted: if a signal asked the run to stop; it is saved.
            NonFiniteError, SimulatorError: if environment, policy or updates keep failing; the run is saved first.
        """
        try:
            with self._stop, progress_bar(self.config.total_env_steps, initial=self.env_steps) as progress:
                self._stop.nothing_to_save = True
                self.warm_up()
                self._stop.nothing_to_save = False
                self._catch_up()
                self._seed()
                self._pretrain()
                self._learn(progress)
        except (NonFiniteError, SimulatorError):
            self.save()
            raise
        finally:
            self.collector.shutdown(raise_on_error=False)
            self.eval_env.close(raise_if_closed=False)
        summary = self.summary()
        self.log.finish(summary)
        return summary

    def _seed(self) -> None:
        while self.stage == "seed":
            if not self.collector.in_seed_phase:
                self.stage = "pretrain"
                return
            self.step()
            self._after_work()

    def _pretrain(self) -> None:
        if self.stage != "pretrain":
            return
        self.pretrain(self._after_work)
        self.stage = "learn"
        if self.config.seed_decisions and self._passed(self.config.eval_every):
            self.pending.append("evaluate")
        self._catch_up()

    def _learn(self, progress: ProgressBar) -> None:
        config = self.config
        while self.env_steps < config.total_env_steps:
            tick = time.perf_counter()
            made = self.step(meanwhile=self.updates if config.overlap else None)
            if made and not config.overlap:
                self.updates()
            self.learning_s += time.perf_counter() - tick
            if made:
                last = self.env_steps >= config.total_env_steps
                due = {"write_metrics": config.log_every, "evaluate": config.eval_every}
                due["save"] = config.checkpoint_every
                self.pending += [name for name, interval in due.items() if last or self._passed(interval)]
            self._after_work()
            latest = self.eval_returns[-1] if self.eval_returns else None
            progress.update(env_steps=self.env_steps, decision_steps=self.collector.frames, last_return=latest)

    def _after_work(self) -> None:
        """Does what is due, and stops here if that was asked for."""
        minutes = self.config.checkpoint_minutes
        if minutes is not None and "save" not in self.pending and time.perf_counter() - self._saved_at > 60 * minutes:
            self.pending.append("save")
        self._catch_up()

    def _catch_up(self) -> None:
        while self.pending:
            self._stop_if_asked()
            name = self.pending[0]
            if name == "save":
                self.pending.pop(0)  # a run that goes on from this checkpoint need not save it again
                self.save()
            else:
                getattr(self, name)()
                self.pending.pop(0)
        self._stop_if_asked()

    def _stop_if_asked(self) -> None:
        if self._stop.requested:
            saved = "saved" if self.save() else "not saved: the checkpoint before it stays"
            raise RunInterrupted(
                f"stopped at {self.env_steps} env steps and {saved} in {self.log.run_dir}; go on with resume=true."
            )

    def warm_up(self) -> None:
        """Compiles what the run will call; see :func:`~torchrl_etdmpc.training.warm_up.warm_up`."""
        batches = self.collector.env.batch_size, self.eval_env.batch_size
        self._compile_s = warm_up(self.config, self.agent, *batches, device=self.device)

    def step(self, meanwhile: Callable[[], None] | None = None) -> bool:
        """One decision of every environment; ``meanwhile`` is called before the environments step.

        Returns:
            bool: whether it was made. A simulator that fails costs its episode, and counts.
        """
        try:
            stepped = self.collector.step(meanwhile)
        except (NonFiniteError, SimulatorError) as error:
            self._count_fault(error)
            return False
        done = stepped["next", "done"]
        self.episode_returns.extend(stepped["next", "episode_reward"][done].tolist())
        if done.any():
            self.faults_in_a_row = 0
        return True

    def _count_fault(self, error: NonFiniteError | SimulatorError) -> None:
        self.faults += 1
        self.faults_in_a_row += 1
        if self.faults_in_a_row >= self.config.max_faults:
            raise error
        warnings.warn(f"{error}; training goes on with a fresh episode (failure {self.faults}).", stacklevel=3)

    def update(self, *, distill: bool = True) -> None:
        """One gradient step on a fresh sample."""
        batch = self.replay.sample().to(self.device).reshape(-1, self.config.loss.slice_len)
        self.metrics.update(self.agent.updater.step(batch, distill=distill).items())

    def updates(self) -> None:
        """The updates that one decision of every environment calls for."""
        for _ in range(self.config.optim.updates_per_decision * self.config.num_envs):
            self.update()

    def pretrain(self, after_update: Callable[[], None] | None = None) -> None:
        """Updates of world model and value on the seed data; the policy has nothing to learn from random actions."""
        if self.reanalyze is not None:
            self.reanalyze.enabled = False
        while self.pretrained < self.config.pretrain_updates:
            self.update(distill=False)
            self.pretrained += 1
            if after_update is not None:
                after_update()
        if self.reanalyze is not None:
            self.reanalyze.enabled = True

    def evaluate(self) -> None:
        """Appends a row to ``eval.csv``. Training draws the same random numbers whether it is evaluated or not."""
        options = {
            "episodes": self.config.eval_episodes,
            "policy_device": self.device,
            "on_step": self._leave_evaluation,
        }
        try:
            with torch.random.fork_rng([self.device] if self.device.type == "cuda" else []):
                returns = evaluate(self.eval_env, self.agent.eval_planner, **options)
                bare = (
                    evaluate(self.eval_env, BarePolicy(self.agent.world_model), **options)
                    if self.config.eval_policy
                    else None
                )
        except _EvaluationLeftError:
            self._stop_if_asked()  # with training's random numbers; the evaluation is repeated from its beginning
        except Exception as error:
            if not self.collector.frames:
                raise  # nothing is lost yet
            reason = (str(error).strip() or type(error).__name__).splitlines()[0]
            warnings.warn(
                f"the evaluation at {self.env_steps} env steps failed ({reason}); training goes on.", stacklevel=2
            )
            return
        if bare is not None:
            self.metrics["policy_return"] = bare.mean()
        self.eval_simulator = simulator_state(self.eval_env)
        self.eval_returns.append(returns.mean().item())
        self.log.log_eval(
            **self.counters(),
            return_mean=self.eval_returns[-1],
            return_std=returns.std(correction=0).item(),
            episodes=len(returns),
        )

    def _leave_evaluation(self, _: TensorDictBase) -> None:
        if self._stop.requested:
            raise _EvaluationLeftError

    def write_metrics(self) -> None:
        """Appends a row to ``train.csv``."""
        row = {name: float(value) for name, value in self.metrics.items()}
        row["simulator_faults"] = self.faults
        row["updates_skipped"] = int(self.agent.updater.skipped)
        self._check_updates(row)
        finished = self.episode_returns
        row["episode_return"] = sum(finished) / len(finished) if finished else math.nan
        self.episode_returns = []
        if self.reanalyze is not None:
            row["targets_refreshed"] = self.reanalyze.refreshed
            row["targets_stale"] = self.reanalyze.stale
            age = self.reanalyze.target_age
            row["target_age"] = math.nan if age is None else float(age)
        self.log.log_train(row, **self.counters())

    def _check_updates(self, row: dict[str, float]) -> None:
        in_a_row = int(self.agent.updater.skipped_in_a_row)
        if in_a_row < self.config.max_skipped:
            return
        broken = [
            name for name, value in row.items() if name.startswith(("loss_", "grad_")) and not math.isfinite(value)
        ]
        raise NonFiniteError(
            f"the last {in_a_row} updates had no finite gradient and were skipped; not finite are {', '.join(broken)}. "
            "A lower optim.lr or optim.grad_clip_norm may help."
        )

    def save(self) -> bool:
        """Writes a checkpoint; one that cannot be written is a warning, and the next one is tried in its time.

        Returns:
            bool: whether it was written.
        """
        self._saved_at = time.perf_counter()
        latest = self.eval_returns[-1] if self.eval_returns else -math.inf
        before = self.best_saved
        self.best_saved = max(latest, before)
        try:
            self.store.save(self.agent, self.config, self.counters(), self.replay, capture(self), best=latest >= before)
        except OSError as error:
            self.best_saved = before
            reason = error.strerror or str(error)
            warnings.warn(f"no checkpoint at {self.env_steps} env steps ({reason}); training goes on.", stacklevel=2)
            return False
        return True

    def summary(self) -> dict[str, Any]:
        """What the run came to."""
        learned = self.collector.frames - self.config.seed_decisions
        return {
            "task": self.config.task,
            "preset": self.config.preset,
            "seed": self.config.seed,
            "env_steps": self.env_steps,
            "final_return": self.eval_returns[-1] if self.eval_returns else math.nan,
            "best_return": max(self.eval_returns, default=math.nan),
            "wall_time_s": self.counters()["wall_time_s"],
            "compile_s": round(self._compile_s, 2),
            "decisions_per_second": learned / self.learning_s if self.learning_s else math.nan,
            "parameters": sum(parameter.numel() for parameter in self.agent.world_model.parameters()),
            "device": torch.cuda.get_device_name(self.device) if self.device.type == "cuda" else "cpu",
            "threads": self._threads,
        }

    def _passed(self, interval: int) -> bool:
        """Whether the last step passed a multiple of ``interval`` environment steps."""
        before = self.env_steps - self.config.num_envs * self.action_repeat
        return self.env_steps // interval > before // interval
