"""Collection one environment step at a time, into a replay buffer."""

from __future__ import annotations

import contextlib
import warnings
from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Literal

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, unravel_key
from torch import nn
from torchrl.collectors import BaseCollector
from torchrl.data import ListStorage, ReplayBuffer
from torchrl.envs import EnvBase, ExplorationType
from torchrl.envs.utils import set_exploration_type

from torchrl_etdmpc.collectors.errors import NonFiniteError, SimulatorError
from torchrl_etdmpc.collectors.evaluate import decided, fitting_primers
from torchrl_etdmpc.envs.episode import (
    is_plain,
    load_simulator_state,
    load_transform_states,
    simulator_state,
    transform_states,
)
from torchrl_etdmpc.envs.worker import start_workers_anew
from torchrl_etdmpc.keys import FALLBACK, NEXT, PLAN, PLAN_MEAN, TRAJECTORY
from torchrl_etdmpc.runs.errors import first_line

Insertion = Literal["step", "episode"]


class StepCollector(BaseCollector):
    """Acts, steps and stores, one step of every environment per iteration (thesis 3.4.4, data freshness).

    With ``insertion="step"`` a transition is in the buffer before the next action is chosen; with ``"episode"`` it is
    kept back until its episode ends (BMPC). Rows of several environments are interleaved in the order of the
    environments; each row carries the id of its trajectory.

    Follows the contract of TorchRL's collectors: iterable, ``state_dict``, ``set_seed``, trajectory ids, exploration
    type, primers of the policy registered on the environment. The policy object is used as it is, so there are no
    weights to synchronise. One iteration yields the transitions just made, batch size ``[num_envs]``.

    Args:
        create_env_fn (EnvBase or callable): an environment with at most one batch dimension, or a function that makes
            it. It is closed by :meth:`shutdown`.
        policy (nn.Module): TensorDict module that writes the action, e.g. a planner.

    Keyword Args:
        replay_buffer (ReplayBuffer): where transitions go.
        total_frames (int): decisions to make, all environments together; -1 for no end. Default: -1.
        init_random_frames (int): length of the random phase in decisions, all environments together. Default: 0.
        seed_policy (nn.Module, optional): acts in the random phase; it must write what ``policy`` writes and
            the buffer keeps, e.g. :class:`SeedPolicy`. Required if ``init_random_frames`` is positive.
        insertion (str): ``"step"`` or ``"episode"``. Default: ``"step"``.
        exclude_keys (sequence of NestedKey): what not to store. Default: the warm start, ``"plan_mean"`` and
            ``("next", "plan_mean")``, and ``("plan", "fallback")``.
        exploration_type (ExplorationType): Default: ``RANDOM``.
        policy_device (torch.device, optional): where the policy's inputs go. Default: the environment's device.

    Attributes:
        begins_fresh (bool): whether :meth:`load_state_dict` could not bring the simulator back to where it was.

    Raises:
        ValueError: if an argument is out of range, or the environment does not fit a planner's model
            (:func:`~torchrl_etdmpc.envs.check_spaces`).
        NonFiniteError: while iterating, if an observation, a reward or an action is not finite. The step is not
            stored, the running episodes end at their last step, as truncated ones, and collection can go on with
            fresh ones.
        SimulatorError: while iterating, if the environment raises; the same holds. Where it raises in the reset after
            the end of an episode, the step that ended it is stored.

    >>> from torchrl.data import LazyTensorStorage
    >>> from torchrl.testing.mocking_classes import ContinuousActionVecMockEnv
    >>> from torchrl.envs.utils import RandomPolicy
    >>> env, buffer = ContinuousActionVecMockEnv(), ReplayBuffer(storage=LazyTensorStorage(100))
    >>> collector = StepCollector(env, RandomPolicy(env.action_spec), replay_buffer=buffer, total_frames=5)
    >>> for step in collector:
    ...     pass
    >>> len(buffer)
    5
    """

    def __init__(
        self,
        create_env_fn: EnvBase | Callable[[], EnvBase],
        policy: nn.Module,
        *,
        replay_buffer: ReplayBuffer,
        total_frames: int = -1,
        init_random_frames: int = 0,
        seed_policy: nn.Module | None = None,
        insertion: Insertion = "step",
        exclude_keys: Sequence[NestedKey] = (PLAN_MEAN, (NEXT, PLAN_MEAN), (PLAN, FALLBACK)),
        exploration_type: ExplorationType = ExplorationType.RANDOM,
        policy_device: torch.device | str | None = None,
    ) -> None:
        super().__init__()
        if init_random_frames > 0 and seed_policy is None:
            raise ValueError(
                f"init_random_frames={init_random_frames} needs a seed_policy that writes what the policy writes; pass "
                "seed_policy=SeedPolicy(env.action_spec)."
            )
        if replay_buffer is None:
            raise ValueError("StepCollector stores what it collects, got replay_buffer=None; pass a ReplayBuffer.")
        if insertion not in ("step", "episode"):
            raise ValueError(f"insertion must be 'step' or 'episode', got {insertion!r}.")
        if isinstance(exclude_keys, str) or "next" in exclude_keys:  # one key, taken for several
            raise ValueError(f"exclude_keys must be a list of keys, e.g. [('next', 'info')], got {exclude_keys!r}.")
        env = create_env_fn if isinstance(create_env_fn, EnvBase) else create_env_fn()
        if len(env.batch_size) > 1:
            raise ValueError(
                f"StepCollector takes an environment with at most one batch dimension, got {env.batch_size}."
            )
        if "done" not in env.done_keys:
            raise ValueError(f"StepCollector needs the key 'done' of an environment, got {env.done_keys}; rename one.")
        self.env = _with_primers(env, policy)
        self.policy = policy
        self.replay_buffer = replay_buffer
        self.total_frames = total_frames
        self.init_random_frames = init_random_frames
        self.seed_policy = seed_policy
        self.insertion = insertion
        self.exclude_keys = [unravel_key(key) for key in exclude_keys]
        self.exploration_type = exploration_type
        policy_device = None if policy_device is None else torch.device(policy_device)
        self.policy_device = None if policy_device == self.env.device else policy_device
        self.num_envs = max(self.env.batch_size.numel(), 1)
        self.requested_frames_per_batch = self.num_envs  # the base class' len() and stats() read it
        self.closed = False
        self._frames = 0
        self._next_trajectory = 0
        self._carrier: TensorDictBase | None = None
        self._after_reset = False
        self._last_rows: tuple[Any, torch.Tensor] | None = None  # of the buffer, and the trajectories that they are of
        self._ended_rows: dict[int, int] = {}  # row to trajectory, of episodes that a fault has ended
        self.begins_fresh = False
        self._pending: list[list[TensorDictBase]] = [[] for _ in range(self.num_envs)]
        self._schema: dict[bool, set] = {}
        excluded = set(self.exclude_keys)
        observation_keys = self.env.observation_spec.keys(True, True)
        self._checked_before = [key for key in observation_keys if unravel_key(key) not in excluded]
        self._checked_after = [unravel_key(("next", key)) for key in (*self._checked_before, *self.env.reward_keys)]

    @property
    def frames(self) -> int:
        """Decisions made so far, all environments together."""
        return self._frames

    @property
    def decisions_each(self) -> int:
        """Decisions made so far, of every environment."""
        return self._frames // self.num_envs

    @property
    def in_seed_phase(self) -> bool:
        """Whether the next decision belongs to the random phase."""
        return self._frames < self.init_random_frames

    def iterator(self) -> Iterator[TensorDictBase]:
        """Yields the transitions of one step of every environment, batch size [num_envs], until ``total_frames``."""
        while self.total_frames < 0 or self._frames < self.total_frames:
            yield self.step().exclude(*self.exclude_keys).reshape(-1)

    def __iter__(self) -> Iterator[TensorDictBase]:
        return self.iterator()

    def step(self) -> TensorDictBase:
        """One decision of every environment: act, step, check, store.

        Returns:
            The transitions, batch size of the environment; what is not stored is in them too.
        """
        return self.finish_step(self.act())

    @torch.no_grad()
    def act(self) -> TensorDictBase:
        """The first half of :meth:`step`: what the policy decides in the present states.

        Work that is queued on a device between the halves, e.g. an update, runs while the simulator steps; it sees the
        buffer without this step.
        """
        if self._carrier is None:
            self._carrier = self._start(self._ask(self.env.reset))
            self._after_reset = True
        if self._after_reset:
            self._check_finite(self._carrier, self._checked_before, "the environment")
        with set_exploration_type(self.exploration_type):
            tensordict = self._decide(self._carrier)
        self._check_finite(tensordict, self.env.action_keys, "the policy")
        return tensordict

    @torch.no_grad()
    def finish_step(self, acted: TensorDictBase) -> TensorDictBase:
        """The second half of :meth:`step`: steps the environments, checks and stores.

        Args:
            acted (TensorDictBase): what :meth:`act` returned.
        """
        stepped, carrier = self._ask(self.env.step_and_maybe_reset, acted)
        self._check_finite(stepped, self._checked_after, "the environment")
        kept = stepped.exclude(*self.exclude_keys)
        self._check_schema(kept)
        self._store(kept, stepped.get(TRAJECTORY))
        self._frames += self.num_envs
        self._carrier = self._next_carrier(carrier, stepped)
        return stepped

    def _ask(self, method: Callable[..., Any], *args: Any) -> Any:
        """Calls the environment; its exceptions end the episode and not the program, whose processes start anew."""
        try:
            return method(*args)
        except Exception as error:
            failure = SimulatorError(f"the environment failed at decision step {self._frames}: {first_line(error)}")
            failure.episode_ended = self._store_before_reset(*args)
            self._truncate_episodes()
            with contextlib.suppress(Exception):  # then the next step fails as well, and the run ends after a few
                start_workers_anew(self.env)
            raise failure from error

    def _store_before_reset(self, acted: TensorDictBase | None = None) -> bool:
        """Stores a step that was made where only the reset behind it failed, or ends of episodes would be lost.

        It is not counted, as a step that fails is not. Processes do not tell what they did before they failed.
        """
        if acted is None or acted.get(("next", "done"), None) is None or not acted["next", "done"].any():
            return False
        kept = acted.exclude(*self.exclude_keys)
        values = (acted.get(key, None) for key in self._checked_after)
        finite = all(value is not None and bool(value.isfinite().all()) for value in values)
        stored = finite and self._schema.get(self.in_seed_phase) in (None, set(kept.keys(True, True)))
        if stored:
            self._store(kept, acted.get(TRAJECTORY))
        return stored

    def _decide(self, tensordict: TensorDictBase) -> TensorDictBase:
        if self.in_seed_phase:
            return decided(self.seed_policy, tensordict, None, None)
        return decided(self.policy, tensordict, self.policy_device, self.env.device)

    def _start(self, tensordict: TensorDictBase) -> TensorDictBase:
        ids = torch.arange(self.num_envs, device="cpu") + self._next_trajectory
        self._next_trajectory += self.num_envs
        return tensordict.set(TRAJECTORY, ids.reshape(tensordict.batch_size))

    def _next_carrier(self, carrier: TensorDictBase, stepped: TensorDictBase) -> TensorDictBase:
        ids, done = stepped.get(TRAJECTORY), stepped.get(("next", "done"))
        self._after_reset = bool(done.any())
        if self._after_reset:
            ids = ids.clone()
            for position in done.reshape(self.num_envs).nonzero().flatten().tolist():
                ids.view(-1)[position] = self._next_trajectory
                self._next_trajectory += 1
        return carrier.set(TRAJECTORY, ids)

    def _store(self, kept: TensorDictBase, trajectories: torch.Tensor) -> None:
        if self.insertion == "step":
            if isinstance(getattr(self.replay_buffer, "storage", None), ListStorage):
                kept = kept.clone()  # it keeps what it is given, which the caller gets too
            # Adding one row takes half the time of extending by it.
            rows = self.replay_buffer.extend(kept) if kept.ndim else self.replay_buffer.add(kept)
            self._last_rows = rows, trajectories
            return
        for position, row in enumerate(kept.reshape(-1).unbind(0)):
            self._pending[position].append(row.clone())
            if row.get(("next", "done")).any():
                self.replay_buffer.extend(torch.stack(self._pending[position]))
                self._pending[position] = []

    def _abandon_episodes(self) -> None:
        self._carrier = None
        self._last_rows = None
        self._pending = [[] for _ in range(self.num_envs)]

    def _truncate_episodes(self) -> None:
        """Ends the running episodes at their last stored step, which becomes a truncated one."""
        for rows in self._pending:
            if rows:
                episode = torch.stack(rows)
                _truncate(episode[-1:])
                self.replay_buffer.extend(episode)
        if self._last_rows is not None:
            self._end_rows(*(torch.as_tensor(entry).reshape(-1).cpu() for entry in self._last_rows))
        self._abandon_episodes()

    def _end_rows(self, rows: torch.Tensor, trajectories: torch.Tensor) -> None:
        """Makes rows of the buffer truncated ends, where they still are of these trajectories."""
        storage, ended = self.replay_buffer.storage, {}
        for row, trajectory in zip(rows.tolist(), trajectories.tolist(), strict=True):
            held = storage.get(row).clone() if row < len(storage) else None  # one by one, as lists hold them
            if held is None or int(held.get(TRAJECTORY, trajectory)) != trajectory:
                continue
            _truncate(held)
            storage.set(row, held, set_cursor=False)
            ended[row] = trajectory
        if not ended:
            return
        self._ended_rows |= ended
        end_episodes = getattr(self.replay_buffer.sampler, "end_episodes", None)
        if end_episodes is not None:  # it may have followed the rows already
            end_episodes(torch.tensor(list(ended)), storage)

    def _check_finite(self, tensordict: TensorDictBase, keys: Sequence[NestedKey], source: str) -> None:
        for key in keys:
            value = tensordict.get(key, None)
            if value is None:
                raise KeyError(f"{source} wrote no {key!r}; it wrote {sorted(map(str, tensordict.keys(True, True)))}.")
            if value.is_floating_point() and not value.isfinite().all():
                rows = value.isfinite().reshape(self.num_envs, -1).all(-1).logical_not().nonzero().flatten().tolist()
                self._truncate_episodes()  # the environment may have moved on
                raise NonFiniteError(
                    f"{source} returned a non-finite {key!r} at decision step {self._frames} (environments {rows}); "
                    "the step was not stored"
                )

    def _check_schema(self, kept: TensorDictBase) -> None:
        seeding = self.in_seed_phase
        if seeding in self._schema:
            return
        self._schema[seeding] = keys = set(kept.keys(True, True))
        other = self._schema.get(not seeding)
        if other is not None and other != keys:
            raise ValueError(
                f"seed_policy and policy must write the same keys; they differ in {sorted(map(str, other ^ keys))}. "
                "A row without a key would hold uninitialised memory."
            )

    def set_seed(self, seed: int, static_seed: bool = False) -> int:
        """Seeds the environments; the running episode is abandoned."""
        self._abandon_episodes()
        return self.env.set_seed(seed, static_seed=static_seed)

    def update_policy_weights_(self, *args: Any, **kwargs: Any) -> None:
        """Nothing to do: the policy object is shared with the caller."""

    def shutdown(self, timeout: float | None = None, close_env: bool = True, raise_on_error: bool = True) -> None:
        """Closes the environments."""
        if close_env and not self.closed and not self.env.is_closed:
            self.env.close(raise_if_closed=raise_on_error)
        self.closed = True

    def _seeding_module(self) -> nn.Module | None:
        """The seed policy while it acts, if it has a state: TorchRL's ``RandomPolicy`` is no module."""
        return self.seed_policy if self.in_seed_phase and isinstance(self.seed_policy, nn.Module) else None

    def _simulator_state(self) -> dict[str, Any] | None:
        try:
            return simulator_state(self.env)
        except Exception as error:  # of a worker process that is gone: the next step finds it and starts others
            warnings.warn(
                f"the simulator cannot tell its state ({first_line(error)}): a run that goes on from here begins fresh "
                "episodes.",
                stacklevel=3,
            )
            return None

    def _transform_states(self) -> dict[str, Any] | None:
        with contextlib.suppress(Exception):  # of a transform that cannot tell its own
            states = transform_states(self.env)
            return states if is_plain(states) else None

    def state_dict(self) -> OrderedDict:
        """Counters, the place in the running episodes, the simulator's included, and in the random phase its policy's.

        Not the policy's weights. Plain dictionaries, numbers and tensors, so that ``torch.load(weights_only=True)``
        reads them. What transforms remember is there as well where the simulator has no state.
        """
        simulator = self._simulator_state()
        return OrderedDict(
            frames=self._frames,
            next_trajectory=self._next_trajectory,
            simulator=simulator,
            transforms=self._transform_states() if simulator is None else None,
            carrier=None if self._carrier is None else self._carrier.clone().to_dict(),
            pending=[[row.to_dict() for row in rows] for rows in self._pending],
            last_rows=self._last_rows and [torch.as_tensor(entry).reshape(-1).cpu() for entry in self._last_rows],
            ended_rows=dict(self._ended_rows),
            seed_policy=seeding.state_dict() if (seeding := self._seeding_module()) else None,
        )

    def load_state_dict(self, state_dict: OrderedDict) -> None:
        """Restores :meth:`state_dict`; collection goes on inside the episodes that were running.

        Where the environment cannot be brought back (:func:`~torchrl_etdmpc.envs.simulator_state`), the episodes that
        were running end at their last step, as truncated ones, fresh ones with fresh trajectory ids begin, and a
        warning says so; :attr:`begins_fresh` is ``True`` then. What transforms remember, such as the statistics of
        ``VecNormV2``, is restored nevertheless, if it is tensors and plain numbers. The environment begins as it would
        anew: give it another seed (:meth:`set_seed`) if it is not to repeat itself. Call this when the buffer and its
        sampler are restored: the ends that faults have made are written into the rows again.
        """
        self._frames = state_dict["frames"]
        self._next_trajectory = state_dict["next_trajectory"]
        seeding, held = self._seeding_module(), state_dict.get("seed_policy")  # checkpoints of before have none
        if seeding is not None and held is not None:
            seeding.load_state_dict(held)
        self._abandon_episodes()
        self._ended_rows = {}
        ended = state_dict.get("ended_rows") or {}  # nor have they this, and the last rows
        self._end_rows(torch.tensor(list(ended), dtype=torch.int64), torch.tensor(list(ended.values())))
        batch_size, device = self.env.batch_size, self.env.device
        self._pending = [[TensorDict(row, [], device=device) for row in rows] for rows in state_dict["pending"]]
        last_rows = state_dict.get("last_rows")
        self._last_rows = None if last_rows is None else (last_rows[0], last_rows[1])
        self.begins_fresh = self._frames > 0
        if state_dict.get("simulator") is None:
            lost = self._lost_of_transforms(state_dict.get("transforms"))
            if self._frames:
                warnings.warn(f"the environment cannot be restored, so fresh episodes begin{lost}.", stacklevel=2)
            self._truncate_episodes()
            return
        if not load_simulator_state(self.env, state_dict["simulator"]):
            warnings.warn(
                "the simulator did not come back to where it was (another version or processor?), so fresh episodes "
                "begin.",
                stacklevel=2,
            )
            self._truncate_episodes()
            return
        self.begins_fresh = False
        if state_dict["carrier"] is not None:  # else between episodes
            self._carrier = TensorDict(state_dict["carrier"], batch_size, device=device)
            self._after_reset = True  # if it is not, nothing is lost by looking twice

    def _lost_of_transforms(self, states: dict[str, Any] | None) -> str:
        """Restores what transforms remember, and says what could not be."""
        try:
            load_transform_states(self.env, states or {})
        except (RuntimeError, LookupError):
            return ", and its transforms begin anew: they are others than were saved"
        return ", and its transforms begin anew: what they remember could not be saved" if states is None else ""

    def __repr__(self) -> str:
        return f"{type(self).__name__}(num_envs={self.num_envs}, frames={self._frames}, insertion={self.insertion!r})"


def _truncate(rows: TensorDictBase) -> None:
    """Flags the rows that do not end an episode already as truncations, in place."""
    running = ~rows.get(("next", "done"))
    for name in ("truncated", "done"):
        flag = rows.get(("next", name), None)
        if flag is not None:
            flag |= running


def _with_primers(env: EnvBase, policy: nn.Module) -> EnvBase:
    """Registers the policy's primers, as TorchRL's collectors do, unless the environment carries their keys already."""
    for primer in fitting_primers(env, policy):
        present = set(env.full_observation_spec.keys(True, True)) | set(env.full_state_spec.keys(True, True))
        if not all(unravel_key(key) in present for key in primer.primers.keys(True, True)):
            env = env.append_transform(primer)
    return env
