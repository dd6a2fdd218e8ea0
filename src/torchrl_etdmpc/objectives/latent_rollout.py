"""The latent rollout that all terms of the loss share, and the abstract loss that computes it."""

from __future__ import annotations

import abc
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, NamedTuple, get_args

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, TensorDictParams, unravel_key
from tensordict.nn import dispatch
from torch import Tensor, nn
from torchrl.objectives import LossModule

from torchrl_etdmpc.keys import ACTION, LOC, NEXT, OBSERVATION, PLAN, REWARD, SCALE, TERMINATED
from torchrl_etdmpc.modules import WorldModel

Reduction = Literal["none", "mean", "sum"]
KLDirection = Literal["backward", "forward"]


class Slices(NamedTuple):
    """Replayed slices, time first. Fields that a loss does not read are ``None``."""

    observation: Tensor
    """First observation of each slice, ``[B, O]``."""
    next_observation: Tensor
    """``[T, B, O]``"""
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


class LatentRollout(NamedTuple):
    """Encoded and predicted latents of replayed slices."""

    encoded: Tensor
    """Encodings z_0..z_T of the real observations, without gradient, ``[T + 1, B, L]``."""
    predicted: Tensor
    """Head i's own rollout zhat_0..zhat_T of the replayed actions, with gradient, ``[T + 1, F, B, L]``. All heads start
    from the same zhat_0."""


TermFunction = Callable[[WorldModel, Slices, LatentRollout], Tensor]


class ExtraTerm(NamedTuple):
    """A term of one's own that trains the networks at hand.

    Its gradient goes wherever the function lets it.

    >>> def small_actions(world_model, slices, rollout):
    ...     mean, _ = world_model.policy(rollout.predicted[:-1].detach())  # [T, F, B, A]
    ...     return mean.square().mean((1, -1))
    >>> from torchrl.objectives import SoftUpdate
    >>> from torchrl_etdmpc.objectives import EfficientTDMPCLoss
    >>> from torchrl_etdmpc.testing import random_slices
    >>> model = WorldModel(3, 2, latent_dim=16, mlp_dim=32)
    >>> loss = EfficientTDMPCLoss(model, discount=0.99, extra_terms={"small_actions": ExtraTerm(small_actions, 0.1)})
    >>> updater = SoftUpdate(loss, tau=0.01)
    >>> "loss_small_actions" in loss(random_slices(3, 2))
    True
    """

    function: TermFunction
    """World model, slices and their rollout to an error of every step of every slice, ``[T, B]``."""
    coef: float
    """Weight of the term."""


def latent_rollout(world_model: WorldModel, slices: Slices) -> LatentRollout:
    """Encodes every observation and rolls every dynamics head from the first one (spec of BMPC; thesis appendix B).

    ``zhat_{0,i} = h(s_0)`` with gradient into the encoder, ``zhat_{k+1,i} = f_i(zhat_{k,i}, a_k)``; the encodings of
    the later observations carry no gradient.

    Args:
        world_model (WorldModel): encoder and dynamics.
        slices (Slices): T transitions of B slices.

    Returns:
        LatentRollout: ``[T + 1, B, L]`` and ``[T + 1, F, B, L]``.
    """
    first = world_model.encode(slices.observation)
    with torch.no_grad():
        later = world_model.encode(slices.next_observation)
    latents = [first.expand(world_model.num_dynamics, *first.shape)]
    for action in slices.action.unbind(0):
        latents.append(world_model.next(latents[-1], action))
    return LatentRollout(torch.cat([first.detach().unsqueeze(0), later]), torch.stack(latents))


def head_rows(steps: Tensor, num_heads: int | None = None) -> Tensor:
    """One row for every step and head of a rollout; step 0, on which the heads agree, has one row for all of them.

    Args:
        steps (Tensor): T steps, ``[T, F, B, ...]``, or ``[T, B, ...]`` with ``num_heads``: the same for all heads.
        num_heads (int, optional): F, for an entry without a head dimension.

    Returns:
        Tensor: ``[1 + (T - 1) F, B, ...]``.
    """
    # Departure from BMPC and the thesis, which read every head's rollout at step 0 as well, where they are equal: the
    # same average from fewer rows, but one dropout mask there instead of one per head, and the percentiles of the
    # running scale count each slice once.
    if num_heads is not None:
        steps = steps.unsqueeze(1).expand(-1, num_heads, *steps.shape[1:])
    return torch.cat([steps[0, :1], steps[1:].flatten(0, 1)])


def mean_of_head_rows(answers: Tensor, num_heads: int) -> Tensor:
    """Mean over heads of what was computed on :func:`head_rows`, ``[1 + (T - 1) F, B]`` to ``[T, B]``."""
    return torch.cat([answers[:1], answers[1:].unflatten(0, (-1, num_heads)).mean(1)]) if len(answers) > 1 else answers


def counted_mean(values: Tensor, counts: Tensor | None) -> Tensor:
    """Mean over the steps that count, 0 if none does.

    Args:
        values (Tensor): ``[T, B]``.
        counts (Tensor, optional): bool, ``[T, B]``. Default: every step counts.

    Returns:
        Tensor: a scalar.

    >>> counted_mean(torch.tensor([[1.0, 5.0]]), torch.tensor([[True, False]])).item()
    1.0
    """
    if counts is None:
        return values.mean()
    return torch.where(counts, values, 0).sum() / counts.sum().clamp_min(1)


def _reduced(term: Tensor, counts: Tensor | None, reduction: Reduction) -> Tensor:
    """A term ``[T, B]`` to a scalar, or to ``[B, T]`` without reduction; steps that do not count are zeros."""
    if reduction == "mean":
        return counted_mean(term, counts)
    if counts is not None:
        term = torch.where(counts, term, 0)
    return term.sum() if reduction == "sum" else term.transpose(0, 1)


class LatentRolloutLoss(LossModule):
    """Base of the losses that train a :class:`~torchrl_etdmpc.modules.WorldModel` on replayed slices.

    A subclass names the networks it trains, the keys it reads and the terms it returns. Every term is weighted once, by
    the coefficient buffer ``<term>_coef``; ``loss_*`` entries can therefore be summed as they are.

    Networks stay shared with the world model that was passed: the planner that holds it sees every update.

    Padded steps count for nothing: not in losses, gradients, running scale or metrics. The mask is found as TorchRL's
    losses find it: at ``("collector", "mask")``, which collectors write with ``split_trajs=True``, and at
    ``"shifted_valid"``, where the batch has them; or at the key ``loss.loss_mask_key``. A step counts if no step of its
    slice up to it is masked, since the rollout goes through all of them; means divide by the number of those.
    """

    # TorchRL sums every entry that starts with "loss_" (its Trainer does, and so do users), so the entries must carry
    # their weight; the unweighted values are the metrics that end in "_error" or "_kl".

    @dataclass
    class _AcceptedKeys:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Configurable tensordict keys.

        Attributes:
            observation (NestedKey): flat observation ``[B, T, O]``; its successor is read at ``("next", observation)``.
            action (NestedKey): replayed action ``[B, T, A]`` in [-1, 1].
            reward (NestedKey): read at ``("next", reward)``, ``[B, T, 1]``.
            terminated (NestedKey): read at ``("next", terminated)``, ``[B, T, 1]``, if there is a termination head;
                without one it is looked at only to refuse termination.
            plan_loc (NestedKey): mean of the planner's target, ``[B, T, A]``.
            plan_scale (NestedKey): standard deviation of the planner's target, ``[B, T, A]``.
        """

        observation: NestedKey = OBSERVATION
        action: NestedKey = ACTION
        reward: NestedKey = REWARD
        terminated: NestedKey = TERMINATED
        plan_loc: NestedKey = (PLAN, LOC)
        plan_scale: NestedKey = (PLAN, SCALE)

    tensor_keys: _AcceptedKeys  # pyright: ignore[reportIncompatibleMethodOverride]
    default_keys = _AcceptedKeys
    default_value_estimator = None  # pyright: ignore[reportAssignmentType]

    world_model: WorldModel
    reduction: Reduction  # pyright: ignore[reportIncompatibleVariableOverride]
    rho: Tensor
    # Each loss has what its networks and terms need of the following.
    encoder: nn.Module
    encoder_params: TensorDictParams
    target_encoder_params: TensorDictParams
    dynamics: nn.Module
    dynamics_params: TensorDictParams
    target_dynamics_params: TensorDictParams
    reward: nn.Module
    reward_params: TensorDictParams
    target_reward_params: TensorDictParams
    value: nn.Module
    value_params: TensorDictParams
    target_value_params: TensorDictParams
    termination: nn.Module
    termination_params: TensorDictParams
    target_termination_params: TensorDictParams
    policy: nn.Module
    policy_params: TensorDictParams
    target_policy_params: TensorDictParams
    discount: Tensor
    entropy_coef: Tensor
    kl_scale: Tensor
    scale_tau: float
    kl_direction: KLDirection

    _attributes: ClassVar[dict[str, str]] = {
        "encoder": "encoder",
        "dynamics": "dynamics",
        "reward": "reward_head",
        "value": "value_head",
        "termination": "termination_head",
        "policy": "policy",
    }

    def __init__(
        self,
        world_model: WorldModel,
        *,
        networks: tuple[str, ...],
        coefficients: dict[str, float],
        rho: float,
        reduction: Reduction | None,
        ignore_termination: bool = True,
        extra_terms: Mapping[str, ExtraTerm] | None = None,
    ) -> None:
        super().__init__()
        self._in_keys = None
        self._out_keys = None
        self.reduction = "mean" if reduction is None else reduction
        if self.reduction not in get_args(Reduction):
            raise ValueError(f"reduction must be one of {', '.join(get_args(Reduction))}, got {reduction!r}.")
        if not 0 < rho <= 1:
            raise ValueError(f"rho must be in (0, 1], got {rho}.")
        for name in networks:
            module = getattr(world_model, self._attributes[name])
            if module is not None:
                self.convert_to_functional(module, name, create_target_params=name == "value")
        vars(self)["world_model"] = world_model
        for term, coefficient in coefficients.items():
            self.register_coeff_buffer(f"{term}_coef", float(coefficient))
        self.register_buffer("rho", torch.tensor(float(rho)))
        self.ignore_termination = ignore_termination
        self.extra_terms = dict(extra_terms or {})
        for term, extra in self.extra_terms.items():
            if not isinstance(extra, ExtraTerm):
                raise TypeError(f"extra_terms must be of type ExtraTerm(function, coef), got {extra!r} for {term!r}.")
            if term in (*self._attributes, *coefficients):
                raise ValueError(f"extra_terms must have names of their own, got {term!r}; choose another one.")
            self.register_coeff_buffer(f"{term}_coef", float(extra.coef))

    def _apply(self, fn, *args, **kwargs):
        # The world model is not a submodule (its parameters are already here), but its buffers must follow a cast.
        super()._apply(fn, *args, **kwargs)
        self.__dict__["world_model"]._apply(fn)
        return self

    def _forward_value_estimator_keys(self, **kwargs) -> None:
        self._in_keys = None  # a new name for a key changes what dispatch expects

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        # The entries of <name>_params are the very parameters of the world model's networks, and planner, loss and
        # updater rely on it. A copy or an unpickled loss gets the networks as one object graph (they stand in __dict__,
        # where convert_to_functional put them), but tensordict clones its entries: the loss would train weights that
        # nobody reads. So they are read anew from the networks. The targets are nobody else's and stay as copied.
        for name in self._attributes:
            if f"{name}_params" in self._modules:
                self._modules[f"{name}_params"] = TensorDict.from_module(self.__dict__[name], as_module=True)

    def reset_parameters_recursive(self) -> None:
        """Draws new weights for the networks that this loss trains; target parameters become copies of the new ones."""
        for name in self._attributes:
            if f"{name}_params" in self._modules:
                self.__dict__[name].reset_parameters_recursive()
        parameters: dict[str, Any] = self._modules
        for name, target in parameters.items():
            if name.startswith("target_"):
                target.data.update_(parameters[name.removeprefix("target_")].data)

    @property
    @abc.abstractmethod
    def _reads(self) -> tuple[str, ...]:
        """Names of the accepted keys that this loss reads."""

    @property
    @abc.abstractmethod
    def _term_names(self) -> tuple[str, ...]:
        """Names of the terms, in order."""

    @property
    @abc.abstractmethod
    def _metric_names(self) -> tuple[str, ...]:
        """Names of the detached metrics, in order."""

    @abc.abstractmethod
    def _terms(
        self, slices: Slices, rollout: LatentRollout, target_values: dict[str, Tensor] | None
    ) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """Unreduced terms ``[T, B]`` by name, and metrics by name: scalars, or ``[T, B]`` to take the mean of."""

    def _key(self, name: str) -> NestedKey:
        key = getattr(self.tensor_keys, name.removeprefix("next_"))
        return unravel_key((NEXT, key)) if name in ("next_observation", "reward", "terminated") else unravel_key(key)

    @property
    def in_keys(self) -> list[NestedKey]:
        """Keys that ``forward`` reads."""
        if self._in_keys is None:
            self._in_keys = [self._key(name) for name in self._reads]
        return self._in_keys

    @in_keys.setter
    def in_keys(self, keys: list[NestedKey]) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        self._in_keys = keys

    @property
    def out_keys(self) -> list[str]:
        """Keys that ``forward`` returns: the ``loss_*`` terms, then the metrics."""
        if self._out_keys is None:
            extra = [f"{name}_error" for name in self.extra_terms]
            return [f"loss_{name}" for name in (*self._term_names, *self.extra_terms)] + [*self._metric_names, *extra]
        return self._out_keys

    @out_keys.setter
    def out_keys(self, keys: list[str]) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        self._out_keys = keys

    def slices(self, tensordict: TensorDictBase) -> Slices:
        """The entries that this loss reads, time first.

        Args:
            tensordict (TensorDictBase): batch size [B, T].

        Raises:
            ValueError: if an entry is not of shape [B, T, features], or a row of a CPU tensor terminates although the
                world model has no termination head. Elsewhere that check would wait for the device and is skipped.
            KeyError: if a key is missing.
        """
        fields: dict[str, Any] = dict.fromkeys(Slices._fields)
        for name in self._reads:
            value = tensordict.get(self._key(name), None)
            if value is None:
                raise KeyError(
                    f"{type(self).__name__} needs the key {self._key(name)!r} in its input; rename it with "
                    f"loss.set_keys({name.removeprefix('next_')}=...) or store it in the replay buffer."
                )
            # The batch size is no guide: dispatch infers a longer one where all entries agree in size.
            if value.ndim != 3:
                raise ValueError(
                    f"{type(self).__name__} needs a batch of slices [B, T] and entries of shape [B, T, features], got "
                    f"{self._key(name)!r} of shape {list(value.shape)}; reshape a flat replay sample with "
                    "sample.reshape(-1, slice_len)."
                )
            fields[name] = value
        counts = self._counted_steps(tensordict, fields["action"].shape[:2])
        self._refuse_termination(tensordict, counts)
        for name in self._reads:
            value = fields[name]
            if counts is not None:
                # Before any maths: a zero in the place of a scale, say, has an infinite gradient, and 0 * inf is NaN.
                harmless = torch.ones_like if name == "plan_scale" else torch.zeros_like
                value = torch.where(counts.unsqueeze(-1), value, harmless(value))
            fields[name] = value.transpose(0, 1)
        fields["observation"] = fields["observation"][0]
        for name in ("reward", "terminated"):
            if fields[name] is not None:
                fields[name] = fields[name].squeeze(-1)
        fields["counts"] = None if counts is None else counts.transpose(0, 1)
        return Slices(**fields)

    def _counted_steps(self, tensordict: TensorDictBase, shape: torch.Size) -> Tensor | None:
        """The steps up to which nothing in their slice is masked, bool ``[B, T]``; ``None`` without a mask."""
        counts = None
        for key in self._loss_mask_keys():
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

    def _refuse_termination(self, tensordict: TensorDictBase, counts: Tensor | None) -> None:
        if self.ignore_termination or self.world_model.termination_head is not None or torch.compiler.is_compiling():
            return
        terminated = tensordict.get(self._key("terminated"), None)
        if terminated is None or terminated.device.type != "cpu":
            return
        if counts is not None:
            terminated = terminated.squeeze(-1) & counts
        if terminated.any():
            raise ValueError(
                f"{self._key('terminated')!r} holds True, but the world model has no termination head, so values would "
                "be bootstrapped through the end of an episode; build WorldModel(..., termination=True), or pass "
                f"{type(self).__name__}(..., ignore_termination=True) if that is what you want."
            )

    @dispatch  # pyright: ignore[reportArgumentType]
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Computes the terms on a batch of slices.

        Args:
            tensordict (TensorDictBase): slices of T consecutive transitions of one episode each, batch size [B, T].

        Returns:
            TensorDictBase: ``loss_*`` entries (scalars, or ``[B, T]`` with ``reduction="none"``), weighted by their
            coefficients and by ``rho^k`` at step k, and detached scalar metrics. Means are over the steps that count.

        Raises:
            ValueError: as :meth:`slices`.
            KeyError: if a key is missing.
        """
        terms = self.evaluate(self.slices(tensordict), self.target_values(), self.reduction)
        out = TensorDict(terms, batch_size=[])
        self._clear_weakrefs(tensordict, out)
        return out

    def target_values(self) -> dict[str, Tensor] | None:
        """The target parameters of the value heads by name, or ``None`` if this loss has none."""
        targets: Any = self._modules.get("target_value_params")
        if targets is None:
            return None
        names = ((name, ".".join((name,) if isinstance(name, str) else name)) for name in targets.keys(True, True))
        return {dotted: targets.get(name).data for name, dotted in names}

    def evaluate(
        self, slices: Slices, target_values: dict[str, Tensor] | None, reduction: Reduction = "mean"
    ) -> dict[str, Tensor]:
        """What :meth:`forward` returns, from plain tensors: the part that compiles as one graph.

        Args:
            slices (Slices): from :meth:`slices`.
            target_values (dict): from :meth:`target_values`.
            reduction (str): ``"mean"`` (default), ``"sum"`` or ``"none"`` (``[B, T]``).

        Returns:
            dict: ``loss_*`` terms weighted by their coefficients, and detached metrics.
        """
        rollout = latent_rollout(self.world_model, slices)
        terms, metrics = self._terms(slices, rollout, target_values)
        for name, extra in self.extra_terms.items():
            error = extra.function(self.world_model, slices, rollout)
            if error.shape != slices.action.shape[:2]:
                raise ValueError(
                    f"extra_terms[{name!r}] must return an error of shape [T, B]={list(slices.action.shape[:2])}, got "
                    f"{list(error.shape)}."
                )
            terms[name], metrics[f"{name}_error"] = self._discount_depth(error), error
        out = {
            f"loss_{name}": getattr(self, f"{name}_coef") * _reduced(term, slices.counts, reduction)
            for name, term in terms.items()
        }
        for name, metric in metrics.items():
            out[name] = (counted_mean(metric, slices.counts) if metric.ndim else metric).detach()
        return out

    def _discount_depth(self, error: Tensor) -> Tensor:
        """Weights ``[T, ...]`` errors by ``rho^k``."""
        powers = self.rho ** torch.arange(error.shape[0], device=error.device, dtype=error.dtype)
        return error * powers.view(-1, *(1,) * (error.ndim - 1))
