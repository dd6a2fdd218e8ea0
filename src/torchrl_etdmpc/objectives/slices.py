"""Slices as replay hands them out, read into plain tensors: what a batch may look like."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from tensordict import NestedKey, TensorDictBase, is_tensor_collection
from torch import Tensor

from torchrl_etdmpc.keys import DONE, NEXT
from torchrl_etdmpc.modules import WorldModel
from torchrl_etdmpc.objectives.slice_checks import (
    refuse_gaps,
    refuse_termination,
    refuse_unknown_ends,
    warn_of_holes,
    warn_of_range,
)

_FEATURES = ("action", "reward", "terminated", "plan_loc", "plan_scale")
OBSERVATION_FIELDS = ("observation", "next_observation")
"""Fields that the encoder reads."""
FIELDS = (*OBSERVATION_FIELDS, *_FEATURES)
"""Fields of :class:`Slices` that stand in a batch."""


class Slices(NamedTuple):
    """Replayed slices, time first. Fields that a loss does not read are ``None``.

    >>> Slices(torch.zeros(4, 3), torch.zeros(2, 4, 3), torch.zeros(2, 4, 1), None, None, None, None).action.shape
    torch.Size([2, 4, 1])
    """

    observation: Any
    """First observation of each slice, ``[B, O]``, or what the encoder takes: a tensor ``[B, ...]`` or a ``TensorDict``
    with the batch size [B]."""
    next_observation: Any
    """``[T, B, O]``, or likewise."""
    action: Tensor
    """``[T, B, A]``"""
    reward: Tensor | None
    """``[T, B]``"""
    terminated: Tensor | None
    """``[T, B]`` bool; entry k says whether step k *reached* a terminal state."""
    plan_loc: Tensor | None
    """``[T, B, A]``"""
    plan_scale: Tensor | None
    """``[T, B, A]``"""
    counts: Tensor | None = None
    """``[T, B]`` bool: the steps that count; the content of the others has been replaced by harmless values. ``None``:
    all of them count."""
    weights: Tensor | None = None
    """``[T, B]``: how much each step counts in the losses, from a prioritised sampler. ``None``: all the same."""
    prioritised: bool = False
    """Whether the batch is a prioritised sampler's, and terms offer new priorities."""
    extra: Mapping[NestedKey, Tensor] | None = None
    """What else the terms read, by its key, ``[T, B, ...]``."""


@dataclass(frozen=True)
class SliceReader:
    """How a batch of slices is read: by whom, for which networks, and at which keys it may hold more.

    >>> from torchrl_etdmpc.testing import random_slices
    >>> reader = SliceReader("MyLoss", WorldModel(3, 2, latent_dim=16, mlp_dim=32))
    >>> keys = {"observation": "observation", "next_observation": ("next", "observation"), "action": "action"}
    >>> reader.read(random_slices(3, 2, num_slices=4, slice_len=3), keys).action.shape
    torch.Size([3, 4, 2])
    """

    owner: str
    """Who reads, for errors."""
    world_model: WorldModel
    """Whose sizes and dtype the entries must have."""
    mask_keys: Iterable[NestedKey] = ()
    """Masks of the steps that count."""
    weight_key: NestedKey | None = None
    """Importance weights of a prioritised sampler."""
    use_weights: bool = True
    """Whether the weights count."""
    terminated_key: NestedKey | None = None
    """Where a step that terminates is refused. ``None``: nowhere."""
    done_key: NestedKey = (NEXT, DONE)
    """Where the ends of episodes are marked, behind which no step of a slice may count."""

    def read(self, tensordict: TensorDictBase, keys: Mapping[NestedKey, NestedKey]) -> Slices:
        """Reads a batch ``[B, T]``, time first.

        Args:
            tensordict (TensorDictBase): the slices.
            keys (mapping): where each field of :class:`Slices` stands, and each further entry, which becomes one of
                ``extra``.

        Raises:
            KeyError: if a key is missing.
            ValueError: if the batch is empty, an entry has another shape, size or dtype than the networks need, or
                steps do not follow each other.
        """
        entries: dict[NestedKey, Any] = {name: self._entry(tensordict, name, key) for name, key in keys.items()}
        for name, entry in entries.items():
            if entry.shape[:2] != entries["action"].shape[:2]:  # it would be spread over the batch, or fail elsewhere
                raise self._shape_error(keys[name], entry)
        if 0 in entries["action"].shape[:2]:
            raise ValueError(f"{self.owner} needs at least one step, got {list(tensordict.batch_size)} slices.")
        shape = entries["action"].shape[:2]
        counts = self._counted_steps(tensordict, shape)
        if self.terminated_key is not None:
            refuse_termination(tensordict, self.terminated_key, counts, shape, self.owner)
        refuse_gaps(tensordict, self.done_key, counts, shape)
        if counts is not None:
            # Before any maths: a zero in the place of a scale, say, has an infinite gradient, and 0 * inf is NaN. What
            # networks of the user's own read may be refused by them where it is zero, so they get what counts.
            harmless: dict[NestedKey, Any] = dict.fromkeys(_FEATURES, torch.zeros_like)
            harmless["plan_scale"] = torch.ones_like
            repeated = _Repeated(counts)
            entries = {name: _where(counts, entry, harmless.get(name, repeated)) for name, entry in entries.items()}
        refuse_unknown_ends(tensordict, self.done_key, counts, entries, keys["next_observation"])
        warn_of_range(entries["action"], keys["action"])
        warn_of_holes(entries, counts, keys)
        entries = {name: entry.transpose(0, 1) for name, entry in entries.items()}
        fields: dict[str, Any] = {name: entries.pop(name, None) for name in FIELDS}
        fields["observation"] = fields["observation"][0]
        for name in ("reward", "terminated"):
            if fields[name] is not None:
                fields[name] = fields[name].squeeze(-1)
        if fields["terminated"] is not None:
            fields["terminated"] = fields["terminated"].bool()
        counts = None if counts is None else counts.transpose(0, 1)
        weights = None if self.weight_key is None else tensordict.get(self.weight_key, None)
        prioritised = weights is not None
        if not self.use_weights:
            weights = None
        if weights is not None:
            # One weight per slice: that of its first row, which the sampler drew.
            steps, slices = fields["action"].shape[:2]
            if weights.numel() not in (slices, slices * steps):
                raise ValueError(
                    f"{self.owner} needs one weight for each slice or each step at {self.weight_key!r}, here "
                    f"[{slices}, {steps}], got {list(weights.shape)}."
                )
            weights = weights.reshape(slices, -1)[:, 0].expand(steps, slices).to(fields["action"].dtype)
        return Slices(**fields, counts=counts, weights=weights, prioritised=prioritised, extra=entries or None)

    def _entry(self, tensordict: TensorDictBase, name: NestedKey, key: NestedKey) -> Tensor | TensorDictBase:
        value = tensordict.get(key, None)
        if value is None:
            rename = f"loss.set_keys({name.removeprefix('next_')}=...)" if name in FIELDS else "Term(keys=...)"
            raise KeyError(
                f"{self.owner} needs the key {key!r} in its input; rename it with {rename} or store it in the "
                "replay buffer."
            )
        # The batch size is no guide: dispatch infers a longer one where all entries agree in size.
        vector = name in _FEATURES or (name in OBSERVATION_FIELDS and self.world_model.observation_dim is not None)
        if value.ndim != 3 if vector else value.ndim < 2:
            raise self._shape_error(key, value)
        if vector:
            self._check_features(name, key, value)
        return value

    def _check_features(self, name: NestedKey, key: NestedKey, value: Any) -> None:
        """A last dimension of 1 would be spread over an action, and another size fail where no key is known."""
        model = self.world_model
        size = model.observation_dim if name in OBSERVATION_FIELDS else 1 if name in ("reward", "terminated") else None
        size = model.action_dim if size is None else size
        if value.shape[-1] != size:
            raise ValueError(
                f"{self.owner} needs {size} features in the last dimension of {key!r}, got {value.shape[-1]} "
                f"(shape {list(value.shape)}); store the entry so, or build the world model for it."
            )
        if name == "action" and not value.is_floating_point():
            raise ValueError(
                f"{self.owner} needs continuous actions in [-1, 1], got {key!r} of {value.dtype}; discrete "
                "actions have no Gaussian policy."
            )
        dtype = model.bins.dtype
        if name in ("action", *OBSERVATION_FIELDS) and torch.promote_types(value.dtype, dtype) != dtype:
            raise ValueError(
                f"{self.owner} needs {key!r} in {model.bins.dtype}, as the weights are, got {value.dtype}; "
                "convert the batch, or append a transform to the environment: of float64 DoubleToFloat()."
            )

    def _shape_error(self, key: NestedKey, value: Tensor | TensorDictBase) -> ValueError:
        return ValueError(
            f"{self.owner} needs a batch of slices [B, T] and entries of shape [B, T, features], got "
            f"{key!r} of shape {list(value.shape)}; reshape a flat replay sample with sample.reshape(-1, slice_len)."
        )

    def _counted_steps(self, tensordict: TensorDictBase, shape: torch.Size) -> Tensor | None:
        """The steps up to which nothing in their slice is masked, bool ``[B, T]``; ``None`` without a mask."""
        counts = None
        for key in self.mask_keys:
            mask = tensordict.get(key, None)
            if mask is None:
                continue
            if mask.numel() != shape.numel() or mask.shape[:2] != shape:
                raise ValueError(
                    f"the mask {key!r} must have the shape [B, T]={list(shape)}, got {list(mask.shape)}; set "
                    "loss.loss_mask_key to the key of another mask, or to None for no mask."
                )
            mask = mask.reshape(shape).bool()
            counts = mask if counts is None else counts & mask
        return None if counts is None else counts.int().cumprod(1) > 0


class _Repeated:
    """Stands in for entries of steps ``[B, T]`` that do not count: with the first step of their slice.

    In a slice without a step that counts, with that of another slice; where nothing counts at all, with zeros.
    """

    def __init__(self, counts: Tensor) -> None:
        self.first = counts[:, :1]  # with a step that counts, the first one does
        self.any, self.other = self.first.any(), self.first.squeeze(1).int().argmax(0, keepdim=True)

    def __call__(self, entry: Tensor) -> Tensor:
        own = entry[:, :1]
        begins = self.first.view(*self.first.shape, *(1,) * (entry.ndim - 2))
        found = torch.where(begins, own, own.index_select(0, self.other))
        return torch.where(self.any, found, torch.zeros_like(found))


def _where(counts: Tensor, entry: Any, harmless: Callable[[Tensor], Tensor]) -> Any:
    """The entry ``[B, T, ...]``, or each of a dictionary, where the step counts, and harmless values elsewhere."""
    if is_tensor_collection(entry):
        # A lazy stack would hand out its entries one by one, without the dimension that they are stacked in.
        return entry.contiguous().apply(lambda value: _where(counts, value, harmless))
    return torch.where(counts.view(*counts.shape, *(1,) * (entry.ndim - 2)), entry, harmless(entry))
