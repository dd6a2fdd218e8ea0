"""One gradient step of everything: loss, clipping, optimiser, target average."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torch.optim.lr_scheduler import LambdaLR
from torchrl.objectives import SoftUpdate

from torchrl_etdmpc.objectives import LatentRolloutLoss, Slices
from torchrl_etdmpc.training.compilation import compile_call, tracing_gradients

_CLIPPED_TOGETHER = {"model": ("encoder", "heads", "values"), "policy": ("policy",)}
_ALIGNMENT = 16  # elements: every parameter begins at a multiple of 64 bytes, as memory of its own would


class Updater:
    """Updates world model, value heads and policy on a batch of slices.

    The policy's gradient never reaches the world model nor the other way round (thesis 2.4), so one backward pass of
    the summed loss is the model step followed by the policy step on the detached latents. The gradients of the two are
    clipped separately; Adam with ``eps=1e-5`` serves the policy (TD-MPC2).

    Where the model's gradient is not finite the update is skipped: weights and optimiser stay as they are. Where only
    the policy's is not, the policy alone stays. ``skipped`` and ``skipped_in_a_row`` count both, on the device.

    Every parameter of the loss is trained, also those that a term of the user's own brings; these are clipped with the
    model's. A frozen parameter (``requires_grad_(False)``) stays as it is.

    Targets begin where they are, which in a new loss is at the weights; TorchRL's own updaters copy the weights into
    them first. Where weights are loaded into a world model that has a loss already, make the loss anew, or load the
    loss.

    The weights of each part move into one piece of memory, of which the parameters become views, so that clipping, Adam
    and the target average are a few operations whatever the number of layers. Parameters that get new memory afterwards
    (``.to()``, ``copy.deepcopy``), or are frozen or thawed, need a new updater; :meth:`step` says so.

    Args:
        loss (LatentRolloutLoss): e.g. :class:`~torchrl_etdmpc.objectives.EfficientTDMPCLoss`,
            :class:`~torchrl_etdmpc.objectives.TDMPC2Loss` or one of their parts; on the device and in the dtype that it
            will keep.

    Keyword Args:
        lr (float): learning rate. Default: 3e-4.
        encoder_lr_scale (float): factor of the encoder's learning rate. Default: 0.3.
        grad_clip_norm (float): largest gradient norm of the model and of the policy. Default: 20.
        tau (float): rate of the target values, and of what other targets the loss's terms read. Default: 0.01.
        lr_halved_after (float, optional): updates after which the learning rates are half, after twice as many a third
            and so on: ``lr / (1 + updates / lr_halved_after)``. Not in the thesis. Default: ``None``, constant rates.
        average_decay (float): of averaged weights to plan with, per update; below 1. Not in the thesis. Default: 0,
            no average.
        compile_mode (str, optional): ``torch.compile`` mode of loss and clipped gradient, one graph. Default: ``None``,
            eager. An update without distillation is always eager: pretraining is short.

    Attributes:
        acting_model (nn.Module): what a planner should plan with: a copy of the loss's world model with the averaged
            weights, or that world model itself.

    Raises:
        ValueError: if an argument is out of range, the loss reduces nothing, parameters differ in dtype or device, or
            there is none to train.

    >>> from torchrl_etdmpc.modules import WorldModel
    >>> from torchrl_etdmpc.objectives import EfficientTDMPCLoss
    >>> from torchrl_etdmpc.testing import random_slices
    >>> updater = Updater(EfficientTDMPCLoss(WorldModel(3, 2, latent_dim=16, mlp_dim=32), discount=0.99))
    >>> updater.step(random_slices(3, 2))["grad_norm_policy"].isfinite().item()
    True
    """

    def __init__(
        self,
        loss: LatentRolloutLoss,
        *,
        lr: float = 3e-4,
        encoder_lr_scale: float = 0.3,
        grad_clip_norm: float = 20.0,
        tau: float = 0.01,
        lr_halved_after: float | None = None,
        average_decay: float = 0.0,
        compile_mode: str | None = None,
    ) -> None:
        for name, number in {"lr": lr, "grad_clip_norm": grad_clip_norm}.items():
            if not number > 0:
                raise ValueError(f"{name} must be positive, got {number}.")
        if lr_halved_after is not None and not lr_halved_after > 0:
            raise ValueError(f"lr_halved_after must be positive or None, got {lr_halved_after}.")
        if not encoder_lr_scale >= 0:
            raise ValueError(f"encoder_lr_scale must not be negative, got {encoder_lr_scale}.")
        if not 0 <= tau <= 1:
            raise ValueError(f"tau must be in [0, 1], got {tau}.")
        if not 0 <= average_decay < 1:
            raise ValueError(f"average_decay must be in [0, 1), got {average_decay}.")
        if loss.reduction == "none":
            raise ValueError("the loss must reduce its terms to scalars, got reduction='none'; take 'mean' or 'sum'.")
        self.loss = loss
        self.grad_clip_norm = grad_clip_norm
        self.tau = tau
        self.average_decay = average_decay
        model = loss.world_model
        self.acting_model = copy.deepcopy(model).requires_grad_(False) if average_decay else model
        self.parts = _parts(loss)
        if not self.parts:
            raise ValueError("the loss has no parameter to train; all of them are frozen.")
        self._flat = {part: nn.Parameter(_moved_together(tensors)) for part, tensors in self.parts.items()}
        self._clipped = {name: [p for p in parts if p in self.parts] for name, parts in _CLIPPED_TOGETHER.items()}
        followed = loss.target_parameters()
        if any(followed.values()):
            _tell_that_targets_follow(loss)
        values = {id(value): target for target, value in followed.pop("value", [])}
        self._flat_targets: Tensor | None = None
        if values:
            self._flat_targets = _moved_together([values[id(value)] for value in self.parts["values"]])
        self._other_targets = [(target.data, leader.data) for pairs in followed.values() for target, leader in pairs]
        self._views = [p for tensors in self.parts.values() for p in tensors]
        self._addresses = [p.data_ptr() for p in self._views]
        self._all = [*loss.parameters()]
        self._trained = [p.requires_grad for p in self._all]
        device = self._views[0].device
        groups: list[tuple[tuple[str, ...], dict[str, float]]] = [
            (("encoder",), {"lr": lr * encoder_lr_scale}),
            (("heads", "values"), {}),
            (("policy",), {"eps": 1e-5}),
        ]
        trained = [([self._flat[part] for part in parts if part in self._flat], rates) for parts, rates in groups]
        self.optimizer = torch.optim.Adam(
            [{"params": params, **rates} for params, rates in trained if params],
            lr=lr,
            fused=True,
            capturable=device.type == "cuda",
        )
        self._schedule = None
        if lr_halved_after is not None:
            self._schedule = LambdaLR(self.optimizer, lambda updates: 1 / (1 + updates / lr_halved_after))
        self.skipped = torch.zeros((), dtype=torch.int64, device=device)
        self.skipped_in_a_row = torch.zeros_like(self.skipped)
        self._compiled = None if compile_mode is None else compile_call(self._gradients, compile_mode, keep=False)

    @property
    def updates(self) -> int:
        """Gradient steps so far, skipped ones included."""
        return int(self.loss.world_model.version)

    def step(self, batch: TensorDictBase, *, distill: bool | None = None) -> TensorDictBase:
        """One update.

        Args:
            batch (TensorDictBase): slices, batch size [B, T]; if they have priority weights, their new priorities are
                written into it, as the loss does.
            distill (bool, optional): whether to train the policy, from now on (pretraining does not). Default: as the
                loss is set, ``loss.distill``.

        Returns:
            TensorDictBase: losses, metrics and gradient norms, detached scalars on the device.

        Raises:
            RuntimeError: if parameters of the loss have been given other memory, or were frozen or thawed.
        """
        if [p.data_ptr() for p in self._views] != self._addresses:
            raise RuntimeError("the loss's parameters have been moved; make a new Updater for this loss.")
        if [p.requires_grad for p in self._all] != self._trained:
            raise RuntimeError(
                "parameters of the loss were frozen, or are so no more; make a new Updater for this loss."
            )
        if distill is not None and self.loss.distill != distill:
            self.loss.distill = distill
        inputs = self.loss.slices(batch), self.loss.targets()
        if self._compiled is None or not self.loss.distill:
            metrics, gradients, skip = self._gradients(*inputs)
        else:
            with tracing_gradients():
                metrics, gradients, skip = self._compiled(*inputs)
        self.loss.write_priority(batch, metrics)
        for name, not_finite in skip.items():
            for part in self._clipped[name]:
                self._flat[part].grad = gradients[part]
            # The optimiser leaves the weights as they are on the device, as for AMP's gradient scaler.
            self.optimizer.grad_scale = None  # pyright: ignore[reportAttributeAccessIssue]
            self.optimizer.found_inf = not_finite  # pyright: ignore[reportAttributeAccessIssue]
            self.optimizer.step()
            self.optimizer.zero_grad()
        if self._schedule is not None:
            self._schedule.step()
        if skip:
            skipped = torch.stack(list(skip.values())).amax().long()
            self.skipped += skipped
            self.skipped_in_a_row.add_(1).mul_(skipped)
        self._follow()
        self.loss.world_model.version += 1
        self._average()
        # One copy for all: the memory may be that of a CUDA graph.
        copies = torch.stack([*metrics.values()]).unbind()
        return TensorDict(dict(zip(metrics, copies, strict=True)), batch_size=[])

    def _follow(self) -> None:
        """Moves the targets, of which most losses have those of the values alone."""
        if self._flat_targets is not None:
            self._flat_targets.lerp_(self._flat["values"].detach(), self.tau)
        if self._other_targets:
            targets, leaders = zip(*self._other_targets, strict=True)
            torch._foreach_lerp_(targets, leaders, self.tau)  # pyright: ignore

    @torch.no_grad()
    def _average(self) -> None:
        model, averaged = self.loss.world_model, self.acting_model
        if averaged is not model:
            followers, leaders = ([*network.parameters()] for network in (averaged, model))
            torch._foreach_lerp_(followers, leaders, 1 - self.average_decay)  # pyright: ignore
            for buffer, newest in zip(averaged.buffers(), model.buffers(), strict=True):
                buffer.copy_(newest)  # the version, by which plans are dated

    def warm_up(self, batch: TensorDictBase) -> None:
        """Compiles on a batch of the shapes to come; weights, running scale and optimiser stay as they are.

        Args:
            batch (TensorDictBase): slices, batch size [B, T]; the values do not matter.
        """
        if self._compiled is None:
            return
        distill, buffers = self.loss.distill, [(buffer, buffer.clone()) for buffer in self.loss.buffers()]
        self.loss.distill = True
        try:
            with tracing_gradients():
                self._compiled(self.loss.slices(batch), self.loss.targets())
        finally:
            for buffer, before in buffers:  # the running scale is one of them
                buffer.copy_(before)
            self.loss.distill = distill

    def make_eager(self) -> None:
        """Gives up compilation."""
        self._compiled = None

    def _gradients(
        self, slices: Slices, targets: dict[str, dict[str, Tensor]]
    ) -> tuple[dict[str, Tensor], dict[str, Tensor], dict[str, Tensor]]:
        """Losses and metrics, clipped gradients of the sum in the layout of each part, and 1.0 for what to skip.

        All of it is one graph when it is compiled, so nothing here may wait for the device or depend on a value.
        """
        # Departure from BMPC and TD-MPC2, which make two backward passes, the model's and then the policy's: neither
        # loss sends a gradient into what the other one trains, so the gradient of the sum is both. (A policy that
        # maximises action values does it with those of before the model's step, in TD-MPC2 with those of after it.)
        out = self.loss.evaluate(slices, targets, self.loss.reduction)
        total: Any = sum(value for key, value in out.items() if key.startswith("loss_"))
        metrics = {key: value.detach() for key, value in out.items()}
        clipped = {name: parts for name, parts in self._clipped.items() if parts}
        if not self.loss.distill:
            clipped.pop("policy", None)
        gradients = self._flat_gradients(total, [part for names in clipped.values() for part in names])
        for name, names in clipped.items():
            norm = torch.stack([gradients[part].norm() for part in names]).norm()
            factor = (self.grad_clip_norm / (norm + 1e-6)).clamp(max=1)  # as torch.nn.utils.clip_grad_norm_
            gradients.update({part: factor * gradients[part] for part in names})
            metrics[f"grad_norm_{name}"] = norm
        # Departure from BMPC and TD-MPC2, whose codes step on any gradient: one that is not finite would end the run.
        skip = {name: metrics[f"grad_norm_{name}"].isfinite().logical_not().float() for name in clipped}
        if len(skip) == 2:
            skip["policy"] = torch.maximum(skip["policy"], skip["model"])
        return metrics, gradients, skip

    def _flat_gradients(self, total: Tensor, parts: list[str]) -> dict[str, Tensor]:
        """The gradient of each part, in the layout of its piece of memory."""
        parameters = [p for part in parts for p in self.parts[part]]
        if not parameters:
            return {}
        found = torch.autograd.grad(total, parameters, allow_unused=True)
        if any(gradient is None for gradient in found):
            names = {id(parameter): name for name, parameter in self.loss.named_parameters()}
            unread = [names[id(p)] for p, gradient in zip(parameters, found, strict=True) if gradient is None]
            raise RuntimeError(
                f"no term sends a gradient into {', '.join(unread)}; freeze what is not to be trained with "
                "requires_grad_(False) before making the Updater."
            )
        every = iter(found)
        return {part: _joined([next(every) for _ in self.parts[part]]) for part in parts}

    def state_dict(self) -> dict[str, Any]:
        """State of optimiser and rates, averaged weights, counts of skipped updates (the weights are the loss's)."""
        state: dict[str, Any] = {"optimizer": self.optimizer.state_dict()}
        state |= {"skipped": self.skipped.clone(), "skipped_in_a_row": self.skipped_in_a_row.clone()}
        if self._schedule is not None:
            state["schedule"] = {"updates": self._schedule.last_epoch}
        if self.average_decay:
            state["averaged"] = self.acting_model.state_dict()
        return state

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restores :meth:`state_dict`.

        Raises:
            ValueError: if it is of an updater without a schedule or averages that this one has, or with a schedule that
                it lacks, or if moments of the optimiser have another size or are not finite.
        """
        needed = {"schedule": ("lr_halved_after", self._schedule), "averaged": ("average_decay", self.average_decay)}
        for entry, (argument, own) in needed.items():
            if own and entry not in state_dict:
                raise ValueError(f"the state is of an updater without {argument}; build this one without it, too.")
        if "schedule" in state_dict and self._schedule is None:  # the rates would stay where they have fallen to
            raise ValueError("the state is of an updater with lr_halved_after; build this one with it, too.")
        trained = dict(enumerate(p for group in self.optimizer.param_groups for p in group["params"]))
        for number, moments in state_dict["optimizer"]["state"].items():
            for name in ("exp_avg", "exp_avg_sq"):
                if moments[name].shape != trained[number].shape or not moments[name].isfinite().all():
                    raise ValueError(f"the optimiser's {name} has another size than the weights, or is not finite.")
        self.optimizer.load_state_dict(state_dict["optimizer"])
        self.skipped.copy_(state_dict["skipped"])
        self.skipped_in_a_row.copy_(state_dict["skipped_in_a_row"])
        if self._schedule is not None:
            self._schedule.last_epoch = state_dict["schedule"]["updates"]
            self._schedule.base_lrs = [group["initial_lr"] for group in self.optimizer.param_groups]
        if self.average_decay:
            self.acting_model.load_state_dict(state_dict["averaged"])


def _tell_that_targets_follow(loss: LatentRolloutLoss) -> None:
    """Registers an updater, without which TorchRL warns; its first act, weights copied into the targets, is undone."""
    targets: list[Any] = [part for name, part in loss.named_children() if name.startswith("target_")]
    before = [(entry.data, entry.data.clone()) for part in targets for entry in part.values(True, True)]
    SoftUpdate(loss, tau=0.5)  # of which nothing else is used
    for entry, value in before:
        entry.copy_(value)


def _parts(loss: LatentRolloutLoss) -> dict[str, list[nn.Parameter]]:
    """The trained parameters by how they are trained: what has no rule of its own is trained as the heads are."""
    parts: dict[str, list[nn.Parameter]] = {"encoder": [], "heads": [], "values": [], "policy": []}
    first = next(loss.parameters())
    for network, parameters in loss.network_parameters().items():
        part = {"encoder": "encoder", "value": "values", "policy": "policy"}.get(network, "heads")
        for parameter in parameters:
            if (parameter.dtype, parameter.device) != (first.dtype, first.device):
                raise ValueError(
                    f"all parameters of the loss must be {first.dtype} on {first.device} as its first one, got "
                    f"{parameter.dtype} on {parameter.device} in {network!r}; move the loss as a whole: loss.to(...)."
                )
            if parameter.requires_grad:
                parts[part].append(parameter)
    return {part: parameters for part, parameters in parts.items() if parameters}


def _joined(tensors: Sequence[Tensor]) -> Tensor:
    """The tensors end to end, zeros between them, as :func:`_moved_together` lays them out."""
    return torch.cat([nn.functional.pad(t.flatten(), (0, -t.numel() % _ALIGNMENT)) for t in tensors])


@torch.no_grad()
def _moved_together(tensors: Sequence[Tensor]) -> Tensor:
    """Moves tensors into one new piece of memory, of which each becomes a view."""
    flat, begin = _joined(tensors), 0
    for tensor in tensors:
        tensor.data = flat[begin : begin + tensor.numel()].view_as(tensor)
        begin += tensor.numel() + -tensor.numel() % _ALIGNMENT
    return flat
