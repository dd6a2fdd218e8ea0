"""Reanalyze: fresh planner targets for replayed states, written back to the buffer."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, unravel_key
from torch import Tensor, nn
from torchrl.data import TensorDictReplayBuffer
from torchrl.envs import ExplorationType, Transform
from torchrl.envs.utils import set_exploration_type

from torchrl_etdmpc.keys import OBSERVATION, PLAN, TARGETS, VERSION

_COUNTS = ("samples", "refreshed", "stale", "target_age")


class ReanalyzeTransform(Transform):
    """Re-plans part of every ``interval``-th sample and refreshes its targets in the batch and in the buffer.

    The states of the first ``num_slices`` slices of the sample are planned in one batched call with the current
    networks (thesis 2.4 and 3.4.3; BMPC). The new targets replace those in the sample that is about to be trained on
    and, through the buffer's generation-checked update, those in the buffer: a row that was overwritten in the meantime
    is left alone and counted as stale. A row that the slices share is given one target.

    Read ``buffer.storage[...]`` to look at rows: TorchRL sends ``buffer[...]`` through the transforms as if it were a
    sample.

    The planner is any TensorDict module that reads an observation and writes the targets below ``plan_key``; it is
    called in the exploring mode and without a warm start.

    Args:
        planner (nn.Module): e.g. :class:`~torchrl_etdmpc.planners.EnsembleMPPIPlanner` with ``warm_start=False``.

    Keyword Args:
        slice_len (int): T, rows per slice of the sample.
        interval (int): every how many samples to re-plan. With U updates per decision step and one reanalyze every k
            decision steps this is U k.
        num_slices (int): slices to re-plan; all of them if the sample has fewer. Default: 20.
        observation_key (NestedKey): Default: ``"observation"``.
        plan_key (NestedKey): root of ``loc``, ``scale``, ``value`` and ``version``. Default: ``"plan"``.

    The counts below are the transform's state: they are in its ``state_dict``, and so in that of the buffer.

    Attributes:
        enabled (bool): whether samples are re-planned; pretraining on random data turns it off.
        samples (int): samples that took their turn, so far.
        refreshed (int): rows whose target was renewed in the buffer, so far (every copy in a sample counts).
        stale (int): rows that had been overwritten before their new target arrived, so far.
        target_age (Tensor, optional): mean age, in updates, of the targets of the last refreshed sample, before it
            was refreshed. ``None`` before the first one.

    Raises:
        ValueError: if an argument is out of range.

    >>> from torchrl.data import LazyTensorStorage, TensorDictRoundRobinWriter
    >>> from torchrl_etdmpc import EnsembleMPPIPlanner, LatentEnv, StepSliceSampler, WorldModel
    >>> planner = EnsembleMPPIPlanner(LatentEnv(WorldModel(3, 2)), horizon=3, warm_start=False)
    >>> buffer = TensorDictReplayBuffer(
    ...     storage=LazyTensorStorage(100), sampler=StepSliceSampler(3),
    ...     writer=TensorDictRoundRobinWriter(track_generations=True), batch_size=12)
    >>> reanalyze = ReanalyzeTransform(planner, slice_len=3, interval=10).attach(buffer)
    """

    planner: nn.Module
    replay_buffer: TensorDictReplayBuffer | None

    def __init__(
        self,
        planner: nn.Module,
        *,
        slice_len: int,
        interval: int,
        num_slices: int = 20,
        observation_key: NestedKey = OBSERVATION,
        plan_key: NestedKey = PLAN,
    ) -> None:
        for name, number in {"slice_len": slice_len, "interval": interval, "num_slices": num_slices}.items():
            if number < 1:
                raise ValueError(f"{name} must be at least 1, got {number}.")
        super().__init__()
        # Outside the module tree: the buffer's state must not contain the planner, nor the transform the buffer.
        self.__dict__["planner"] = planner
        self.__dict__["replay_buffer"] = None
        self.slice_len = slice_len
        self.interval = interval
        self.num_slices = num_slices
        self.observation_key = unravel_key(observation_key)
        self.plan_keys = {name: unravel_key((plan_key, name)) for name in TARGETS}
        self.enabled = True
        self.samples = 0
        self.refreshed = 0
        self.stale = 0
        self.target_age: Tensor | None = None

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.extra_repr()})"  # the base class shows keys, which it has none of

    def extra_repr(self) -> str:
        """When it re-plans how much, and what it has done so far."""
        names = ("slice_len", "interval", "num_slices", "enabled", "samples", "refreshed", "stale")
        return ", ".join(f"{name}={getattr(self, name)!r}" for name in names)

    def get_extra_state(self) -> dict[str, Any]:
        """The counts, as plain values and one tensor."""
        return {name: getattr(self, name) for name in _COUNTS}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Restores :meth:`get_extra_state`."""
        for name in _COUNTS:
            setattr(self, name, state[name])

    def attach(self, replay_buffer: TensorDictReplayBuffer) -> ReanalyzeTransform:
        """Appends the transform to a buffer, after checking that the buffer can take the write-back.

        Args:
            replay_buffer (TensorDictReplayBuffer): with ``TensorDictRoundRobinWriter(track_generations=True)`` and no
                prefetching.

        Returns:
            ReanalyzeTransform: itself.

        Raises:
            ValueError: if the buffer's writer does not track generations, the buffer prefetches, its storage has more
                than one dimension, its sampler makes slices of another length, the planner has other keys, or the
                transform has a buffer already.
        """
        if not getattr(replay_buffer.writer, "tracks_generations", False):
            raise ValueError(
                "reanalyze writes back to the buffer and must know whether a row was overwritten; build the buffer "
                "with writer=TensorDictRoundRobinWriter(track_generations=True)."
            )
        if getattr(replay_buffer, "_prefetch", False):
            raise ValueError(
                "reanalyze runs the planner inside sample(), which a prefetching buffer would do in a thread beside "
                "the optimiser; build the buffer without prefetch."
            )
        if getattr(replay_buffer.storage, "ndim", 1) > 1:
            raise ValueError(
                f"reanalyze writes back row by row and needs a one-dimensional storage, got ndim="
                f"{replay_buffer.storage.ndim}; use LazyTensorStorage(capacity) and write flat rows."
            )
        if self.replay_buffer is not None:
            raise ValueError(
                "this ReanalyzeTransform has a buffer already and would write the targets of one into the other; make "
                "one for each buffer."
            )
        self._check_planner("reads", getattr(self.planner, "in_keys", None), [self.observation_key])
        self._check_planner("writes", getattr(self.planner, "out_keys", None), [*self.plan_keys.values()])
        sampled = _sampled_slice_len(replay_buffer)
        if sampled not in (None, self.slice_len):
            raise ValueError(
                f"slice_len={self.slice_len} of reanalyze is not that of the buffer's sampler, {sampled}, so it would "
                f"re-plan parts of slices; pass slice_len={sampled}."
            )
        self.__dict__["replay_buffer"] = replay_buffer
        replay_buffer.append_transform(self)
        return self

    def _check_planner(self, what: str, keys: Sequence[NestedKey] | None, own: Sequence[NestedKey]) -> None:
        """``keys`` may name an entry or one that it is below."""
        named = {(key,) if isinstance(key, str) else key for key in map(unravel_key, keys or ())}
        parts = {key: (key,) if isinstance(key, str) else key for key in own}
        absent = [key for key, path in parts.items() if not any(path[:end] in named for end in range(1, len(path) + 1))]
        if keys is not None and absent:
            raise ValueError(
                f"the planner {what} {', '.join(map(repr, keys))}, but reanalyze needs {', '.join(map(repr, absent))}; "
                "give it the planner's observation_key and plan_key."
            )

    def _check_order(self, buffer: TensorDictReplayBuffer) -> None:
        """A transform that comes later would change what the losses see, and not what the planner has seen."""
        transforms: list[Transform] = list(buffer._transform)  # pyright: ignore[reportArgumentType]  # a Compose
        for later in transforms[transforms.index(self) + 1 :]:
            if self.observation_key in map(unravel_key, later.out_keys or ()):
                raise RuntimeError(
                    f"{type(later).__name__} changes {self.observation_key!r} after reanalyze has planned from it, so "
                    "targets would be of other observations than the losses see; append it first, attach reanalyze "
                    "last."
                )

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Called on every sample ``[B * T]`` or ``[B, T]``; re-plans it if it is its turn.

        Rows that are read as ``buffer[...]`` come here too and count as a sample, except for a single one.
        """
        if not self.enabled or not tensordict.batch_dims:
            return tensordict
        self.samples += 1
        if self.samples % self.interval:
            return tensordict
        return self.refresh(tensordict)

    @torch.no_grad()
    def refresh(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Re-plans the first slices of a sample now, whatever the interval.

        Args:
            tensordict (TensorDictBase): a sample of the attached buffer, batch size [B * T] or [B, T], with ``index``.
                With ``index_generation`` (present in what ``buffer.sample()`` returned) a row that was overwritten
                since is recognised; without it, a row that is overwritten during the planning.

        Returns:
            TensorDictBase: the sample with its targets refreshed.

        Raises:
            RuntimeError: if the transform is not attached to a buffer, or a later one changes the observation.
            KeyError: if the sample lacks the observation, the targets or the index.
        """
        if tensordict.batch_dims > 1:
            return self.refresh(tensordict.reshape(-1)).reshape(tensordict.batch_size)
        buffer = self.replay_buffer
        if buffer is None:
            raise RuntimeError("ReanalyzeTransform has no buffer to write to; use reanalyze.attach(replay_buffer).")
        self._check_order(buffer)
        index = tensordict.get("index", None)
        if tensordict.get(self.observation_key, None) is None:
            raise KeyError(
                f"reanalyze needs the observation {self.observation_key!r} in the sample; store it, or name it by "
                "observation_key=."
            )
        missing = [key for key in self.plan_keys.values() if tensordict.get(key, None) is None]
        if index is None or missing:
            raise KeyError(
                f"reanalyze needs 'index' and {', '.join(map(repr, self.plan_keys.values()))} in the sample; use a "
                "TensorDictReplayBuffer whose rows hold planner targets from the first one on."
            )
        rows = min(self.num_slices * self.slice_len, tensordict.batch_size[0])
        index = index.reshape(tensordict.batch_size[0], -1)[:rows, 0]
        generation = tensordict.get("index_generation", None)
        generation = buffer.writer.generations_of(index) if generation is None else generation.reshape(-1)[:rows]

        # Fixed shapes: duplicates are planned too, but every copy of a row takes the first copy's target.
        copies = index.unsqueeze(0) == index.unsqueeze(1)
        original = copies.to(torch.uint8).argmax(1)
        observation = tensordict.get(self.observation_key)[:rows]
        weight = next(self.planner.parameters(), observation)  # the buffer and the networks may live on two devices
        states = TensorDict({self.observation_key: observation.to(weight.device)}, [rows])
        with set_exploration_type(ExplorationType.RANDOM):
            planned = self.planner(states)
        planned = planned.select(*self.plan_keys.values()).to(observation.device)
        held = {key: tensordict.get(key) for key in self.plan_keys.values()}
        # Rows may hold numbers [B] for the planner's [B, 1].
        fresh = {key: planned.get(key).reshape(old[:rows].shape) for key, old in held.items()}
        version = self.plan_keys[VERSION]
        self.target_age = (fresh[version] - held[version][:rows]).float().mean()
        patch = {key: new[original] for key, new in fresh.items()}
        result = buffer.update_if_present(index=index, generation=generation, patch=patch)
        self.refreshed += result.updated_count
        self.stale += result.stale_count
        for key, value in patch.items():
            stored = held[key].clone()
            stored[:rows] = value
            tensordict.set(key, stored)
        # Rows beyond the first slices may be copies of re-planned ones; they keep their old target in this batch.
        return tensordict


def _sampled_slice_len(replay_buffer: TensorDictReplayBuffer) -> int | None:
    """Rows per slice that the buffer's sampler makes, as far as it says so."""
    slice_len = getattr(replay_buffer.sampler, "slice_len", None)
    num_slices = getattr(replay_buffer.sampler, "num_slices", None)  # TorchRL's slice samplers have one of the two
    if slice_len is None and num_slices and replay_buffer.batch_size:
        slice_len = replay_buffer.batch_size // num_slices
    return slice_len
