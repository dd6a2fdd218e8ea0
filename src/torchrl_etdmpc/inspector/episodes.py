"""Episodes with every simulator state on the way, and a simulator that goes back to any of them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase, stack
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.envs import ExplorationType, step_mdp
from torchrl.envs.utils import set_exploration_type

from torchrl_etdmpc.envs import Task, get_task, load_simulator_state, make_env, render_frame, simulator_state
from torchrl_etdmpc.envs.episode import RecordedEnv
from torchrl_etdmpc.planners import EnsembleMPPIPlanner

__all__ = ["Episode", "Rolled", "Simulator", "play_episode"]


class Episode(NamedTuple):
    """An episode of T decisions, on the CPU.

    >>> from torchrl_etdmpc import WorldModel
    >>> from torchrl_etdmpc.planners import BarePolicy
    >>> episode = play_episode(BarePolicy(WorldModel(3, 1)), "gym/Pendulum-v1", seed=0, steps=5)
    >>> episode.action.shape, len(episode.states), episode.terminated
    (torch.Size([5, 1]), 6, False)
    """

    observation: Tensor
    """``[T + 1, O]``"""
    action: Tensor
    """``[T, A]``"""
    reward: Tensor
    """``[T]``"""
    plan_mean: Tensor | None
    """The warm start that each decision began from, ``[T, H, A]``; ``None`` for what carries no plan."""
    states: list[dict[str, Any] | None]
    """T + 1 of :func:`~torchrl_etdmpc.envs.simulator_state`, for :meth:`Simulator.restore`."""
    terminated: bool
    """Whether the last step ended the task, rather than the time limit or ``steps``."""
    task: str
    seed: int


class Rolled(NamedTuple):
    """What followed from a sequence of T actions; fewer where the episode ended on the way.

    >>> rolled = Simulator("gym/Pendulum-v1").roll(torch.zeros(4, 1))
    >>> rolled.observation.shape, rolled.reward.shape
    (torch.Size([5, 3]), torch.Size([4]))
    """

    observation: Tensor
    """``[T + 1, O]``, the one before the first action included."""
    reward: Tensor
    """``[T]``"""
    terminated: bool
    """Whether the last step ended the task."""


@torch.no_grad()
def play_episode(policy: TensorDictModuleBase, task: str | Task, *, seed: int, steps: int | None = None) -> Episode:
    """Plays an episode without exploration noise.

    The episode follows from ``policy``, ``task`` and ``seed``; PyTorch's global random state is left as it was.

    Args:
        policy (TensorDictModuleBase): a planner, with its warm start, or any module that writes the action.
        task (str or Task): as :func:`~torchrl_etdmpc.envs.make_env` takes it.

    Keyword Args:
        seed (int): of the initial state and the planner's samples.
        steps (int, optional): how many decisions at most. Default: until the episode ends.

    Raises:
        ValueError: if ``steps`` is below 1.

    >>> from torchrl_etdmpc import WorldModel
    >>> from torchrl_etdmpc.planners import BarePolicy
    >>> episode = play_episode(BarePolicy(WorldModel(24, 6)), "walker-walk", seed=0, steps=5)
    >>> episode.observation.shape, len(episode.states)
    (torch.Size([6, 24]), 6)
    """
    if steps is not None and steps < 1:
        raise ValueError(f"steps must be at least 1, got {steps}; leave it out for a whole episode.")
    spec = get_task(task) if isinstance(task, str) else task
    env = make_env(spec, seed=seed)
    planner = policy if isinstance(policy, EnsembleMPPIPlanner) else None
    if planner is not None and planner.warm_start:
        env = env.append_transform(planner.make_tensordict_primer())
    device = _device(policy)
    rows: list[TensorDictBase] = []
    try:
        with torch.random.fork_rng([device] if device.type == "cuda" else []):
            torch.manual_seed(seed)
            carrier, states, done = env.reset(), [simulator_state(env)], False
            while not done and (steps is None or len(rows) < steps):
                with set_exploration_type(ExplorationType.DETERMINISTIC):
                    written = policy(carrier.select(*policy.in_keys, strict=False).to(device))
                stepped = env.step(carrier.update(written.select(*policy.out_keys, strict=False).to("cpu")))
                rows.append(stepped)
                states.append(simulator_state(env))
                carrier, done = step_mdp(stepped), bool(stepped["next", "done"])
    finally:  # the caller may give the episode up
        env.close(raise_if_closed=False)
    whole = stack(rows)
    carried = None if planner is None else whole.get(planner.plan_mean_key, None)
    return Episode(
        observation=torch.cat([whole["observation"][:1], whole["next", "observation"]]),
        action=whole["action"],
        reward=whole["next", "reward"].squeeze(-1),
        plan_mean=carried,
        states=_sharing_actions(states),
        terminated=bool(whole["next", "terminated"][-1]),
        task=spec.name,
        seed=seed,
    )


class Simulator:
    """The true environment, for what would have happened from a state of an episode.

    Going back to a state repeats its episode from the reset on. The simulator then keeps the place, so that going back
    there again, or on to a later state of the same episode, is cheap where the suite allows it (dm_control), and just
    as exact.

    Args:
        task (str or Task): the one that the episode was played on.
        seed (int): of the initial state in which it begins. Default: 0.

    >>> from torchrl_etdmpc import WorldModel
    >>> from torchrl_etdmpc.planners import BarePolicy
    >>> episode = play_episode(BarePolicy(WorldModel(24, 6)), "walker-walk", seed=0, steps=5)
    >>> simulator = Simulator("walker-walk")
    >>> simulator.restore(episode.states[2])
    >>> torch.equal(simulator.roll(episode.action[2:]).observation, episode.observation[2:])
    True
    """

    def __init__(self, task: str | Task, seed: int = 0) -> None:
        self.task = get_task(task) if isinstance(task, str) else task
        self.env = make_env(self.task, seed=seed)
        self._now: tuple[Tensor, bool] = self.env.reset()["observation"], False  # and whether the episode is over
        self._place: tuple[dict[str, Tensor], Callable[[], None], tuple[Tensor, bool]] | None = None

    @property
    def observation(self) -> Tensor:
        """Of the present state, ``[O]``."""
        return self._now[0]

    def restore(self, state: dict[str, Any] | None) -> None:
        """Goes to a state.

        Args:
            state (dict): one of ``Episode.states``.

        Raises:
            ValueError: if the state does not lead back, exactly, to where it was taken.
        """
        if state is None or not isinstance(self.env, RecordedEnv):
            raise ValueError(
                f"state cannot be restored: the environment of task {self.task.name!r} does not record its episodes; "
                "take a task of dm_control or Gymnasium."
            )
        wanted = state.get("_extra_state")
        if not isinstance(wanted, dict) or wanted["actions"].shape[1:] != self.env.action_spec.shape:
            raise ValueError(
                f"state cannot be restored: it is not one of task {self.task.name!r}; make the simulator with the task "
                "of its episode."
            )
        self._now = self._lead_to(self.env, state, wanted)

    def _lead_to(self, env: RecordedEnv, state: dict[str, Any], wanted: dict[str, Tensor]) -> tuple[Tensor, bool]:
        """The observation there, and whether the episode is over."""
        if self._place is not None:
            reached, lead_back, there = self._place
            known = len(reached["actions"])
            if torch.equal(reached["random"], wanted["random"]) and torch.equal(
                reached["actions"], wanted["actions"][:known]
            ):
                lead_back()
                if known == len(wanted["actions"]):
                    return there
                env.go_on(wanted["actions"][known:])
                return self._keep(env, wanted)
        self._place = None  # it ends with the reset
        try:
            exact = load_simulator_state(env, state)
        except Exception as error:  # whatever the suite makes of another task's actions and random numbers
            raise ValueError(f"state cannot be restored on task {self.task.name!r}: {error}") from error
        if not exact:
            raise ValueError(_not_exact(self.task.name))
        return self._keep(env, wanted)

    def _keep(self, env: RecordedEnv, wanted: dict[str, Tensor]) -> tuple[Tensor, bool]:
        now = env.get_extra_state() or {}
        if not now.keys() >= wanted.keys() or not all(torch.equal(now[name], wanted[name]) for name in wanted):
            self._place = None
            raise ValueError(_not_exact(self.task.name))
        lead_back = env.bookmark()
        self._place = None if lead_back is None else (wanted, lead_back, env.restored)
        return env.restored

    @torch.no_grad()
    def roll(self, actions: Tensor) -> Rolled:
        """Takes actions from the present state on, until the episode ends.

        Args:
            actions (Tensor): in [-1, 1], ``[T, A]``.
        """
        observations, rewards, terminated = [self.observation], [], False
        for action in actions.to("cpu", torch.float32):
            if self._now[1]:
                break
            following = self.env.step(TensorDict({"action": action}))["next"]
            self._now = following["observation"], bool(following["done"])
            observations.append(following["observation"])
            rewards.append(following["reward"].squeeze(-1))
            terminated = bool(following["terminated"])
        reward = torch.stack(rewards) if rewards else torch.zeros(0)
        return Rolled(torch.stack(observations), reward, terminated)

    def frame(self, height: int | None = None, width: int | None = None) -> Tensor:
        """A picture of the present state, uint8 ``[height, width, 3]``.

        Raises:
            RuntimeError: if there is no renderer, or nothing that it could draw.
        """
        try:
            return render_frame(self.env, height, width)
        except ValueError as error:
            raise RuntimeError(f"task {self.task.name!r} cannot be rendered: {error}") from error


def _not_exact(task: str) -> str:
    return (
        f"state cannot be restored exactly on task {task!r}: repeating its episode led elsewhere; "
        "use the task's settings and the versions of its simulator with which it was played."
    )


def _sharing_actions(states: list[dict[str, Any] | None]) -> list[dict[str, Any] | None]:
    """The same states, whose actions so far are the beginnings of one tensor: T of them instead of T squared."""
    records = [None if state is None else state.get("_extra_state") for state in states]
    actions = records[-1].get("actions") if isinstance(records[-1], dict) else None
    if actions is None:
        return states
    for record in records:
        if isinstance(record, dict) and torch.equal(record["actions"], actions[: len(record["actions"])]):
            record["actions"] = actions[: len(record["actions"])]
    return states


def _device(policy: nn.Module) -> torch.device:
    return next((tensor.device for tensor in (*policy.parameters(), *policy.buffers())), torch.device("cpu"))
