"""The learner: decisions of the environments, and the gradient steps that they call for."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Mapping
from typing import Any

from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from torchrl_etdmpc.collectors import NonFiniteError, SimulatorError
from torchrl_etdmpc.envs import env_sizes
from torchrl_etdmpc.runs import IntervalMeans
from torchrl_etdmpc.training.agent import build_agent
from torchrl_etdmpc.training.builders import (
    build_collector,
    build_reanalyze,
    build_replay,
    resolve_device,
)
from torchrl_etdmpc.training.config import TrainConfig
from torchrl_etdmpc.training.distributed import WEIGHT_AGE, DistributedConfig
from torchrl_etdmpc.training.memory import require_memory


class Learner:
    """Agent, buffer, reanalyze and collector of one run, and what they measure between two rows of ``train.csv``.

    Args:
        config (TrainConfig): the run.
        env (EnvBase): batch size [] or [config.num_envs].

    Attributes:
        pretrained (int): updates of the pretraining so far.
        faults (int): failures of simulator or policy so far.
        faults_in_a_row (int): without a finished episode in between.

    Raises:
        ValueError: if a setting is out of range.

    >>> from torchrl_etdmpc.envs import make_env
    >>> from torchrl_etdmpc.training import TrainConfig, preset
    >>> config = TrainConfig.from_dict(preset("cpu").to_dict() | {"task": "gym/Pendulum-v1", "compile": "off"})
    >>> learner = Learner(config, make_env("gym/Pendulum-v1", seed=0))
    >>> learner.env_steps
    0
    >>> learner.collector.shutdown()
    """

    def __init__(self, config: TrainConfig, env: EnvBase) -> None:
        self.config = config
        device = resolve_device(config.device)
        sizes = env_sizes(env)
        require_memory(config, **sizes, device=device)
        self.agent = build_agent(config, **sizes, device=device)
        self.replay = build_replay(config, device, sizes=(sizes["observation_dim"], sizes["action_dim"]))
        self.reanalyze = build_reanalyze(config, self.agent, self.replay)
        self.collector = build_collector(config, self.agent, env, self.replay)
        self.pretrained = self.faults = self.faults_in_a_row = 0
        self._updates, self._decisions = IntervalMeans(), IntervalMeans()
        self._range_noted = self._limit_noted = False

    @property
    def env_steps(self) -> int:
        """Environment steps so far, action repeats counted."""
        return self.collector.frames * self.config.task_spec.action_repeat

    def passed(self, interval: int) -> bool:
        """Whether the last step passed a multiple of ``interval`` environment steps."""
        before = self.env_steps - self.config.decisions_per_step * self.config.task_spec.action_repeat
        return self.env_steps // interval > before // interval

    def step(self, *, updates: bool = False) -> bool:
        """One decision of every environment, and with ``updates`` those that it calls for.

        Returns:
            bool: whether it was made. A simulator that fails costs its episode, and counts.
        """
        overlap = updates and self.config.overlap
        try:
            acted: Any = self.collector.act()
            if overlap:
                self.updates(self.config.num_envs)  # queued on a device, they run while the simulator steps
            stepped = self.collector.finish_step(acted)
        except (NonFiniteError, SimulatorError) as error:
            self._count_fault(error)
            return False
        if not self._range_noted:
            reward = stepped["next", "reward"]
            self._note_range("rewards", reward.min().item(), reward.max().item())
        self._note_episodes(stepped)
        if updates:
            self._decisions.add({"plan_fallbacks": stepped["plan", "fallback"].float().mean()})
            self._note_weight_age(stepped)
        if updates and not overlap:
            self.updates(stepped.numel())
        return True

    def _note_weight_age(self, stepped: TensorDictBase) -> None:
        """Where workers plan; -1 is the age of a random action."""
        age = stepped.get(WEIGHT_AGE, None)
        if age is not None and (age >= 0).any():
            self._decisions.add({"weight_age": age[age >= 0].float().mean()})

    def _note_range(self, what: str, least: float, most: float) -> None:
        """Says once that something is beyond the bins, where the losses do not show that it is cut."""
        model = self.config.model
        low, high = (math.copysign(math.expm1(abs(end)), end) for end in (model.bin_min, model.bin_max))
        if (least < low or most > high) and not self._range_noted:
            self._range_noted = True
            warnings.warn(
                f"{what} lie outside [{low:.3g}, {high:.3g}], all that the bins can say, and are cut there; scale the "
                "rewards down (RewardScaling in the task), or widen model.bin_min and model.bin_max.",
                stacklevel=3,
            )

    def _note_episodes(self, stepped: TensorDictBase) -> None:
        done = stepped["next", "done"]
        if not done.any():
            return
        self.faults_in_a_row = 0
        for episode_return in stepped["next", "episode_reward"][done].unbind(0):
            self._decisions.add({"episode_return": episode_return})
        if stepped["next", "terminated"].any() and not self.config.task_spec.terminates:
            raise ValueError(
                f"an episode of {self.config.task} terminated, but the task is said never to; "
                "say task.terminates=true (model.termination=false to bootstrap through its ends)."
            )
        if self.config.loss.discount is None and not self._limit_noted:
            self._note_limit(stepped.get(("next", "truncated"), None))

    def _note_limit(self, truncated: Tensor | None) -> None:
        """Says once that first episodes are cut before the time limit that the discount is chosen by."""
        task, decisions = self.config.task_spec, self.collector.decisions_each
        if truncated is not None and decisions < task.decision_steps_per_episode and truncated.any():
            self._limit_noted = True
            warnings.warn(
                f"an episode of {self.config.task} was truncated within its first {decisions * task.action_repeat} env "
                f"steps, but its time limit is said to be {task.episode_length}, by which the discount is chosen; if "
                "it is shorter, say so (task.episode_length).",
                stacklevel=4,
            )

    def _count_fault(self, error: NonFiniteError | SimulatorError) -> None:
        if isinstance(error, SimulatorError) and error.episode_ended:
            self.faults_in_a_row = 0
        self.faults += 1
        self.faults_in_a_row += 1
        if self.faults_in_a_row >= self.config.max_faults:
            raise error
        warnings.warn(f"{error}; training goes on with a fresh episode (failure {self.faults}).", stacklevel=3)

    def update(self, *, distill: bool = True, measured: bool = True) -> None:
        """One gradient step on a fresh sample, of the policy too with ``distill``; counted in the row if measured."""
        batch = self.replay.sample().to(self.agent.device)
        metrics = self.agent.updater.step(batch, distill=distill)
        if measured:
            self._updates.add(dict(metrics.items()))
            if self.reanalyze is not None and self.reanalyze.target_age is not None:
                self._updates.add({"target_age": self.reanalyze.target_age})

    def updates(self, decisions: int) -> None:
        """The updates that so many decisions call for."""
        # Departure from the thesis, whose table counts updates per env step: per decision, as BMPC counts them.
        for _ in range(self.config.optim.updates_per_decision * decisions):
            self.update()

    def pretrain(self) -> Iterator[None]:
        """Updates on the random data, one at a time; of the policy only with ``replay.pretrain_policy``."""
        if self.reanalyze is not None:
            self.reanalyze.enabled = False
        while self.pretrained < self.config.pretrain_updates:
            self.update(distill=self.config.replay.pretrain_policy, measured=False)
            self.pretrained += 1
            yield
        if self.reanalyze is not None:
            self.reanalyze.enabled = True

    def pop_row(self) -> dict[str, Any]:
        """A row of ``train.csv``: means since the last one, and counts since the run began.

        Raises:
            NonFiniteError: if the last ``max_skipped`` updates were all skipped.
        """
        row: dict[str, Any] = self._updates.means()
        self._check_updates(row)
        nothing = {"episode_return": math.nan}
        if isinstance(self.config, DistributedConfig):
            nothing["weight_age"] = math.nan
        row |= nothing | self._decisions.means()
        if row.get("plan_fallbacks") == 1:
            warnings.warn(
                "no plan since the last row had finite scores, so the policy acted instead; a lower "
                "planner.beta, optim.lr or optim.grad_clip_norm may help.",
                stacklevel=2,
            )
        if "value_target" in row:
            self._note_range("value targets", row["value_target"], row["value_target"])
        row |= {"simulator_faults": self.faults, "updates_skipped": int(self.agent.updater.skipped)}
        if self.reanalyze is not None:
            row.setdefault("target_age", math.nan)
            row |= {"targets_refreshed": self.reanalyze.refreshed, "targets_stale": self.reanalyze.stale}
        self._updates.clear()
        self._decisions.clear()
        return row

    def _check_updates(self, row: dict[str, float]) -> None:
        in_a_row = int(self.agent.updater.skipped_in_a_row)
        if in_a_row < self.config.max_skipped:
            return
        broken = [
            name for name, value in row.items() if name.startswith(("loss_", "grad_")) and not math.isfinite(value)
        ]
        self.agent.updater.skipped_in_a_row.zero_()  # a run that goes on from here has as many new tries
        raise NonFiniteError(
            f"the last {in_a_row} updates had no finite gradient and were skipped; not finite are {', '.join(broken)}. "
            "In a new run a lower optim.lr or optim.grad_clip_norm may help."
        )

    def state_dict(self) -> dict[str, Any]:
        """Counts and what was measured since the last row; the parts have states of their own."""
        names = ("pretrained", "faults", "faults_in_a_row")
        means = {"updates": self._updates.state_dict(), "decisions": self._decisions.state_dict()}
        return {name: getattr(self, name) for name in names} | means

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Restores :meth:`state_dict`."""
        self.pretrained = state_dict["pretrained"]
        self.faults, self.faults_in_a_row = state_dict["faults"], state_dict["faults_in_a_row"]
        self._updates.load_state_dict(state_dict["updates"])
        self._decisions.load_state_dict(state_dict["decisions"])
