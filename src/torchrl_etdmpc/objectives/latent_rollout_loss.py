"""The loss that evaluates a list of terms on one latent rollout."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import torch
import torch.distributed as dist
from tensordict import NestedKey, TensorDict, TensorDictBase, unravel_key
from tensordict.nn import dispatch
from torch import Tensor, nn

from torchrl_etdmpc.keys import ACTION, DONE, LOC, NEXT, OBSERVATION, PLAN, REWARD, SCALE, TERMINATED
from torchrl_etdmpc.modules import WorldModel
from torchrl_etdmpc.modules.new_weights import draw_new_weights
from torchrl_etdmpc.objectives.latent_rollout import counted_mean, latent_rollout
from torchrl_etdmpc.objectives.shared_networks import SharedNetworksLoss
from torchrl_etdmpc.objectives.slices import FIELDS, OBSERVATION_FIELDS, SliceReader, Slices
from torchrl_etdmpc.objectives.terms import PRIORITY, KLDirection, Term, check_terms
from torchrl_etdmpc.objectives.update_count import count_updates

Reduction = Literal["none", "mean", "sum"]
"""What a loss makes of the errors of its steps."""

_REDUCTIONS = get_args(Reduction)
_RUNNING_SCALES = ("kl_scale", "q_scale")


def _scalar_dtype(world_model: WorldModel) -> torch.dtype:
    """Of coefficients and scales: that of the weights, at least float32; in it 0.99 is a discount of 0.99."""
    return torch.promote_types(world_model.bins.dtype, torch.float32)


def _check_reduction(reduction: str) -> None:
    if reduction not in _REDUCTIONS:
        raise ValueError(f"reduction must be one of {', '.join(_REDUCTIONS)}, got {reduction!r}.")


def _reduced(term: Tensor, slices: Slices, reduction: Reduction) -> Tensor:
    """A term ``[T, B]`` to a scalar, or to ``[B, T]`` without reduction; steps that do not count are zeros."""
    _check_reduction(reduction)
    if slices.weights is None and reduction == "mean":
        return counted_mean(term, slices.counts)
    weights = slices.weights
    if slices.counts is not None:
        term = torch.where(slices.counts, term, 0)
        weights = None if weights is None else torch.where(slices.counts, weights, 0)
    if weights is not None:
        term = term * weights
        if reduction == "mean":  # as TorchRL's losses: the weighted average
            return term.sum() / weights.sum().clamp_min(torch.finfo(weights.dtype).tiny)
    return term.sum() if reduction == "sum" else term.transpose(0, 1)


class LatentRolloutLoss(SharedNetworksLoss):
    """A loss made of terms, which trains a :class:`~torchrl_etdmpc.modules.WorldModel` on replayed slices.

    What it trains, reads and returns follows from its terms. Every term is weighted once, by the coefficient buffer
    ``<term>_coef``; ``loss_*`` entries can therefore be summed as they are. A coefficient is assigned like a number or
    a tensor of no dimension (``loss.reward_coef = 0.3``), in place.

    Networks stay shared with the world model that was passed: the planner that holds it sees every update. Every step
    of a PyTorch optimiser that trains them counts as one in ``world_model.version``, which dates the planner's targets
    and is part of this loss' state. So are the coefficients and the discount, as with TorchRL's losses: whoever loads a
    state takes them over, while options that are plain numbers (``value_beta``, ``scale_tau``) stay as constructed.

    Padded steps count for nothing: not in losses, gradients, running scale or metrics. The mask is found as TorchRL's
    losses find it: at ``("collector", "mask")``, which collectors write with ``split_trajs=True``, and at
    ``"shifted_valid"``, where the batch has them; or at the key ``loss.loss_mask_key``. A step counts if no step of its
    slice up to it is masked, since the rollout goes through all of them; means divide by the number of those.

    Where a prioritised sampler has written ``priority_weight``, the mean is weighted by it, slice by slice. The new
    priorities of the slices, the mean absolute errors of their values against the targets, are written into the batch
    at ``td_error``, the only entry that a loss writes to its input. ``buffer.update_tensordict_priority(batch[:, 0])``
    gives them to the rows that the drawn slices begin with, and to no others.
    ``loss.use_prioritized_weights = False`` leaves the weights aside, not the priorities. A loss without values has no
    priority to offer.

    The term named ``"policy"`` can be turned off: ``loss.distill = False``, while pretraining on random data, say.

    Args:
        world_model (WorldModel): the networks, shared with the caller.
        terms (sequence of Term): in the order in which they are evaluated.

    Keyword Args:
        extra_terms (sequence of Term): terms of the user's own, after the others.
        rho (float): weight decay per step of the rollout, in (0, 1]. Default: 0.5.
        ignore_termination (bool): whether to accept rows that terminate although the world model has no termination
            head. Default: ``True``.
        reduction (str): ``"mean"`` (default), ``"sum"`` or ``"none"`` (``[B, T]``).

    Raises:
        TypeError: if a term is not a :class:`Term`.
        ValueError: if an argument is out of range, a term names a network that there is not, or two names of terms,
            coefficients or metrics are the same.

    >>> from torchrl_etdmpc.objectives import EfficientTDMPCModelLoss
    >>> from torchrl_etdmpc.testing import random_slices
    >>> loss = EfficientTDMPCModelLoss(WorldModel(3, 2, latent_dim=16, mlp_dim=32))
    >>> loss(random_slices(3, 2))["loss_reward"].shape
    torch.Size([])
    """

    # TorchRL sums every entry that starts with "loss_" (its Trainer does, and so do users), so the entries must carry
    # their weight; the unweighted values are the metrics that end in "_error" or "_kl".

    @dataclass
    class _AcceptedKeys:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Configurable tensordict keys.

        Attributes:
            observation (NestedKey): observation, ``[B, T, O]`` or what the encoder takes: any shape and dtype, or a
                dictionary of entries, with [B, T] in front; its successor is read at ``("next", observation)``.
            action (NestedKey): replayed action ``[B, T, A]`` in [-1, 1].
            reward (NestedKey): read at ``("next", reward)``, ``[B, T, 1]``.
            terminated (NestedKey): read at ``("next", terminated)``, ``[B, T, 1]``, if there is a termination head;
                without one it is looked at only to refuse termination.
            done (NestedKey): looked at below ``"next"``, ``[B, T, 1]``, to refuse slices that join two episodes;
                optional.
            plan_loc (NestedKey): mean of the planner's target, ``[B, T, A]``.
            plan_scale (NestedKey): standard deviation of the planner's target, ``[B, T, A]``; zeros for a step that has
                no plan, and then trains everything but the policy.
            priority_weight (NestedKey): importance weight of each slice, ``[B, T]``, which a prioritised sampler
                writes; optional.
            priority (NestedKey): where the new priorities are written, ``[B, T]``, if the batch has weights.
        """

        observation: NestedKey = OBSERVATION
        action: NestedKey = ACTION
        reward: NestedKey = REWARD
        terminated: NestedKey = TERMINATED
        done: NestedKey = DONE
        plan_loc: NestedKey = (PLAN, LOC)
        plan_scale: NestedKey = (PLAN, SCALE)
        priority_weight: NestedKey = "priority_weight"
        priority: NestedKey = "td_error"

    tensor_keys: _AcceptedKeys  # pyright: ignore[reportIncompatibleMethodOverride]
    default_keys = _AcceptedKeys
    default_value_estimator = None  # pyright: ignore[reportAssignmentType]

    reduction: Reduction  # pyright: ignore[reportIncompatibleVariableOverride]
    rho: Tensor
    # Each loss has what its terms need of the following.
    discount: Tensor
    entropy_coef: Tensor
    kl_scale: Tensor
    q_scale: Tensor
    scale_tau: float
    kl_direction: KLDirection

    def __init__(
        self,
        world_model: WorldModel,
        terms: Sequence[Term],
        *,
        extra_terms: Sequence[Term] = (),
        rho: float = 0.5,
        ignore_termination: bool = True,
        reduction: Reduction | None = None,
    ) -> None:
        super().__init__(world_model)
        self._in_keys = None
        self._out_keys = None
        self.reduction = "mean" if reduction is None else reduction
        _check_reduction(self.reduction)
        if not 0 < rho <= 1:
            raise ValueError(f"rho must be in (0, 1], got {rho}.")
        self.ignore_termination = ignore_termination
        self.terms = (*terms, *extra_terms)
        reserved = {"rho", "scale_tau", "kl_direction", *vars(self), *dir(type(self))}
        check_terms(terms, extra_terms, networks=self._attributes, reserved=reserved)
        trained = {name for term in self.terms for name in term.networks}
        self._share_networks(trained, {name for term in self.terms for name in term.targets})
        like = {"device": world_model.version.device, "dtype": _scalar_dtype(world_model)}
        for term in self.terms:
            numbers = {f"{term.name}_coef": term.coef, **term.scalars}
            for name, number in numbers.items():
                if not math.isfinite(number):
                    raise ValueError(f"{name} must be finite, got {number}.")
                self.register_coeff_buffer(name, float(number), **like)
            if isinstance(term.function, nn.Module):
                self.add_module(term.name, term.function)
        self.register_buffer("rho", torch.tensor(float(rho), **like))
        self.distill = True
        count_updates(world_model, self.parameters())

    def make_value_estimator(self, value_type: Any = None, **hyperparams: Any) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """There is none to choose: the value targets are the terms' own.

        Raises:
            NotImplementedError: always.
        """
        raise NotImplementedError(
            f"{type(self).__name__} makes its value targets itself, imagined ones and with value_replayed=... n-step "
            "returns of what was replayed; there is no estimator to choose."
        )

    def _make_vmap(self) -> None:
        """TorchRL's hook for losses that use vmap with random numbers: the ensembles here are stacked, without it."""

    def _forward_value_estimator_keys(self, **kwargs) -> None:
        self._in_keys = None  # a new name for a key changes what dispatch expects

    @property
    def distill(self) -> bool:
        """Whether the policy term is computed."""
        return self._distill

    @distill.setter
    def distill(self, value: bool) -> None:
        self._distill = bool(value)
        self._in_keys = None

    @property
    def active_terms(self) -> tuple[Term, ...]:
        """The terms that :meth:`forward` evaluates; that of the policy only while :attr:`distill` is on."""
        return self.terms if self._distill else tuple(term for term in self.terms if term.name != "policy")

    def _reads(self) -> dict[NestedKey, NestedKey]:
        """Where each field of the slices is read, and each further key of the terms."""
        names = dict.fromkeys(
            [*OBSERVATION_FIELDS, "action", *(key for term in self.active_terms for key in term.keys)]
        )
        return {name: self._key(name) for name in names}

    def _key(self, name: NestedKey) -> NestedKey:
        if name not in FIELDS:
            return unravel_key(name)
        key = getattr(self.tensor_keys, name.removeprefix("next_"))
        return unravel_key((NEXT, key)) if name in ("next_observation", "reward", "terminated") else unravel_key(key)

    @property
    def in_keys(self) -> list[NestedKey]:
        """Keys that ``forward`` reads."""
        # Not kept: what the first call would note here, torch.compile would compile the second one anew for.
        return list(self._reads().values()) if self._in_keys is None else self._in_keys

    @in_keys.setter
    def in_keys(self, keys: list[NestedKey]) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        self._in_keys = keys

    @property
    def out_keys(self) -> list[str]:
        """Keys that ``forward`` returns: the ``loss_*`` terms, then the metrics."""
        terms = self.active_terms
        written = [f"loss_{term.name}" for term in terms] + [name for term in terms for name in term.metric_names]
        return written if self._out_keys is None else [key for key in self._out_keys if key in written]

    @out_keys.setter
    def out_keys(self, keys: list[str]) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        self._out_keys = keys

    def reset_out_keys(self) -> LatentRolloutLoss:
        """Takes back ``select_out_keys``."""
        super().reset_out_keys()
        self._out_keys = None  # the base class hands back those of when they were selected
        return self

    def reset_parameters_recursive(self) -> None:
        """Draws new weights for the networks that this loss trains; target parameters become copies of the new ones.

        Running scales begin anew.
        """
        super().reset_parameters_recursive()
        for term in self.terms:
            if isinstance(term.function, nn.Module):
                draw_new_weights(term.function)
        for name in _RUNNING_SCALES:
            if name in self._buffers:
                self.get_buffer(name).fill_(1)

    def slices(self, tensordict: TensorDictBase) -> Slices:
        """The entries that this loss reads, time first.

        Args:
            tensordict (TensorDictBase): batch size [B, T].

        Raises:
            ValueError: if the batch is empty, an entry is not of shape [B, T, features] (one that the encoder owns:
                [B, T, ...]), or of another size or dtype than the networks need, a next observation is not finite, or
                steps of a slice do not follow each other; without ``ignore_termination`` also if a row terminates
                although the world model has no termination head. What depends on values, the last three, is checked on
                a CPU alone, where it does not wait for the device, and not under ``torch.compile``.
            KeyError: if a key is missing.
            RuntimeError: if the world model's weights are no longer those that this loss trains, or its targets are
                elsewhere.
        """
        self._refuse_other_weights()
        refused = not self.ignore_termination and self.world_model.termination_head is None
        reader = SliceReader(
            type(self).__name__,
            self.world_model,
            mask_keys=self._loss_mask_keys(),
            weight_key=self.tensor_keys.priority_weight,
            use_weights=bool(self.use_prioritized_weights),  # or "auto": where there are some
            terminated_key=self._key("terminated") if refused else None,
            done_key=unravel_key((NEXT, self.tensor_keys.done)),
        )
        return reader.read(tensordict, self._reads())

    def write_priority(self, tensordict: TensorDictBase, evaluated: dict[str, Tensor]) -> None:
        """Moves the priorities of a batch, if there are some, from what :meth:`evaluate` returned into the batch."""
        priority = evaluated.pop(PRIORITY, None)
        if priority is not None:
            # A copy: the memory may be that of a CUDA graph, which its next replay overwrites.
            tensordict.set(self.tensor_keys.priority, priority.clone())

    @dispatch  # pyright: ignore[reportArgumentType]
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Computes the terms on a batch of slices.

        Args:
            tensordict (TensorDictBase): slices of T consecutive transitions of one episode each, batch size [B, T].

        Returns:
            TensorDictBase: ``loss_*`` entries (scalars, or ``[B, T]`` with ``reduction="none"``), weighted by their
            coefficients and by ``rho^k`` at step k, and detached scalar metrics. Means are over the steps that count.

        Raises:
            ValueError: as ``slices``.
            KeyError: if a key is missing.
        """
        terms = self.evaluate(self.slices(tensordict), self.targets(), self.reduction)
        self.write_priority(tensordict, terms)
        unread = self._parameters_without_a_term()
        if unread and terms and dist.is_available() and dist.is_initialized():
            # DistributedDataParallel waits for a gradient of every parameter and cannot look for those without one in a
            # TensorDict. Nobody sees this zero, and the gradient of these parameters is one.
            name = next(iter(terms))
            terms[name] = terms[name] + 0 * torch.stack([parameter.sum() for parameter in unread]).sum()
        out = TensorDict(terms, batch_size=[])
        self._clear_weakrefs(tensordict, out)
        return out

    @property
    def _trains_the_encoder(self) -> bool:
        """Whether this loss trains the encoder now: in training mode, unless all its parameters are frozen."""
        if not self.training or "encoder_params" not in self._modules:
            return False
        trained = [parameter.requires_grad for parameter in self.world_model.encoder.parameters()]
        return not trained or any(trained)

    def _parameters_without_a_term(self) -> list[nn.Parameter]:
        """Of the networks that only terms train which are not active."""
        active = {name for term in self.active_terms for name in (term.name, *term.networks)}
        idle = {name for term in self.terms for name in (term.name, *term.networks)} - active
        return [p for name, own in self.network_parameters().items() if name in idle for p in own] if idle else []

    def evaluate(
        self, slices: Slices, targets: Mapping[str, Mapping[str, Tensor]], reduction: Reduction = "mean"
    ) -> dict[str, Tensor]:
        """What :meth:`forward` returns, from plain tensors: the part that compiles as one graph.

        Args:
            slices (Slices): from ``slices``.
            targets (mapping): from :meth:`targets`.
            reduction (str): ``"mean"`` (default), ``"sum"`` or ``"none"`` (``[B, T]``).

        Returns:
            dict: ``loss_*`` terms weighted by their coefficients, and detached metrics; with weights also the
            priorities ``[B, T]``, which :meth:`write_priority` takes out.
        """
        if self._trains_the_encoder:  # and moves its statistics, too
            observe = getattr(self.world_model.encoder, "observe", None)
            if observe is not None:
                counts = None if slices.counts is None else slices.counts[0]
                observe(slices.observation, counts)  # the first of each slice
        rollout = latent_rollout(self.world_model, slices)._replace(targets=targets)
        losses, metrics = {}, {}
        for term in self.active_terms:
            error, reported = term.evaluate(self.world_model, slices, rollout)
            weighted = self._discount_depth(error) if term.decayed else error
            coef = self.get_buffer(f"{term.name}_coef")
            losses[f"loss_{term.name}"] = coef * _reduced(weighted, slices, reduction)
            if PRIORITY in reported:
                metrics[PRIORITY] = self._priority(reported[PRIORITY], slices)
            for name in term.metric_names:
                metric = reported[name]
                metrics[name] = (counted_mean(metric, slices.counts) if metric.ndim else metric).detach()
        return losses | metrics

    def _priority(self, error: Tensor, slices: Slices) -> Tensor:
        """The mean of the errors ``[T, B]`` of each slice, for all of its rows, ``[B, T]``."""
        counts = torch.ones_like(error) if slices.counts is None else slices.counts.to(error.dtype)
        mean = (error * counts).sum(0) / counts.sum(0).clamp_min(1)
        return mean.detach().unsqueeze(-1).repeat(1, len(error))

    def _discount_depth(self, error: Tensor) -> Tensor:
        """Weights ``[T, B]`` errors by ``rho^k``."""
        powers = self.rho ** torch.arange(error.shape[0], device=error.device, dtype=error.dtype)
        return error * powers.unsqueeze(-1)
