"""One gradient step of everything: loss, clipping, both optimisers, target average."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.objectives import SoftUpdate

from torchrl_etdmpc.objectives import EfficientTDMPCLoss, Slices
from torchrl_etdmpc.training.compilation import compile_call, tracing_gradients


class Updater:
    """Updates world model, value heads and policy on a batch of slices.

    The policy's gradient never reaches the world model nor the other way round (thesis 2.4), so one backward pass of
    the summed loss is the model step followed by the policy step on the detached latents. The gradients of the two are
    clipped separately; Adam with ``eps=1e-5`` serves the policy (TD-MPC2).

    An update whose gradient is not finite is skipped: weights and optimisers stay as they are, and ``skipped`` and
    ``skipped_in_a_row`` count it, on the device.

    Args:
        loss (EfficientTDMPCLoss): on the device and in the dtype that it will keep.

    Keyword Args:
        lr (float): learning rate. Default: 3e-4.
        encoder_lr_scale (float): factor of the encoder's learning rate. Default: 0.3.
        grad_clip_norm (float): largest gradient norm of the model and of the policy. Default: 20.
        tau (float): rate of the target values. Default: 0.01.
        compile_mode (str, optional): ``torch.compile`` mode of loss and gradient, one graph. Default: ``None``, eager.
            An update without distillation is always eager: pretraining is short.

    >>> from torchrl_etdmpc.modules import WorldModel
    >>> from torchrl_etdmpc.testing import random_slices
    >>> updater = Updater(EfficientTDMPCLoss(WorldModel(3, 2, latent_dim=16, mlp_dim=32), discount=0.99))
    >>> updater.step(random_slices(3, 2))["grad_norm_policy"].isfinite().item()
    True
    """

    def __init__(
        self,
        loss: EfficientTDMPCLoss,
        *,
        lr: float = 3e-4,
        encoder_lr_scale: float = 0.3,
        grad_clip_norm: float = 20.0,
        tau: float = 0.01,
        compile_mode: str | None = None,
    ) -> None:
        self.loss = loss
        self.grad_clip_norm = grad_clip_norm
        networks = [
            name for name in ("dynamics", "reward", "value", "termination") if f"{name}_params" in loss._modules
        ]
        encoder = list(loss.encoder_params.parameters())
        heads = [parameter for name in networks for parameter in getattr(loss, f"{name}_params").parameters()]
        self.model_parameters = encoder + heads
        self.policy_parameters = list(loss.policy_params.parameters())
        device = self.policy_parameters[0].device
        options = {"lr": lr, "fused": True, "capturable": device.type == "cuda"}
        self.model_optimizer = torch.optim.Adam(
            [{"params": encoder, "lr": lr * encoder_lr_scale}, {"params": heads}], **options
        )
        self.policy_optimizer = torch.optim.Adam(self.policy_parameters, eps=1e-5, **options)
        self.target_update = SoftUpdate(loss, tau=tau)
        self.skipped = torch.zeros((), dtype=torch.int64, device=device)
        self.skipped_in_a_row = torch.zeros_like(self.skipped)
        self._compiled = None if compile_mode is None else compile_call(self._gradients, compile_mode, keep=False)

    @property
    def updates(self) -> int:
        """Gradient steps so far."""
        return int(self.loss.world_model.version)

    def step(self, batch: TensorDictBase, *, distill: bool = True) -> TensorDictBase:
        """One update.

        Args:
            batch (TensorDictBase): slices, batch size [B, T]; priorities and masks are not read.
            distill (bool): whether to train the policy (pretraining does not).

        Returns:
            TensorDictBase: losses, metrics and gradient norms, detached scalars on the device.
        """
        if self.loss.distill != distill:
            self.loss.distill = distill
        inputs = self.loss.slices(batch), self.loss.target_values()
        if self._compiled is None or not distill:
            metrics, gradients = self._gradients(*inputs)
        else:
            with tracing_gradients():
                metrics, gradients = self._compiled(*inputs)
        out = TensorDict(metrics, batch_size=[]).clone()
        for parameter, gradient in zip(self._trained(), gradients, strict=True):
            parameter.grad = gradient
        groups = {"model": (self.model_parameters, self.model_optimizer)}
        if distill:
            groups["policy"] = self.policy_parameters, self.policy_optimizer
        for name, (parameters, _) in groups.items():
            out[f"grad_norm_{name}"] = torch.nn.utils.clip_grad_norm_(parameters, self.grad_clip_norm)
        self._count_skipped(torch.stack([out[f"grad_norm_{name}"] for name in groups]).isfinite().all(), groups)
        for _, optimizer in groups.values():
            optimizer.step()
            optimizer.zero_grad()
        self.target_update.step()
        self.loss.world_model.version += 1
        return out

    def _count_skipped(self, finite: Tensor, groups: dict[str, Any]) -> None:
        """Tells the optimisers, on the device and as AMP's gradient scaler does, to leave the weights as they are."""
        skip = finite.logical_not()
        for _, optimizer in groups.values():
            optimizer.grad_scale, optimizer.found_inf = None, skip.float()
        self.skipped += skip
        self.skipped_in_a_row.add_(1).mul_(skip)

    def warm_up(self, batch: TensorDictBase) -> None:
        """Compiles on a batch of the shapes to come; weights, running scale and optimisers stay as they are.

        Args:
            batch (TensorDictBase): slices, batch size [B, T]; the values do not matter.
        """
        if self._compiled is None:
            return
        distill, scale = self.loss.distill, self.loss.kl_scale.clone()
        self.loss.distill = True
        try:
            with tracing_gradients():
                self._compiled(self.loss.slices(batch), self.loss.target_values())
        finally:
            self.loss.kl_scale.copy_(scale)
            self.loss.distill = distill

    def make_eager(self) -> None:
        """Gives up compilation."""
        self._compiled = None

    def _trained(self) -> list[torch.nn.Parameter]:
        return self.model_parameters + (self.policy_parameters if self.loss.distill else [])

    def _gradients(
        self, slices: Slices, target_values: dict[str, Tensor]
    ) -> tuple[dict[str, Tensor], tuple[Tensor, ...]]:
        """Losses and metrics, and the gradient of the summed losses for every trained parameter."""
        out = self.loss.evaluate(slices, target_values)
        total = sum(value for key, value in out.items() if key.startswith("loss_"))
        gradients = torch.autograd.grad(total, self._trained())
        return {key: value.detach() for key, value in out.items()}, gradients

    def state_dict(self) -> dict[str, Any]:
        """State of both optimisers and the counts of skipped updates (the weights belong to the loss)."""
        counts = {"skipped": self.skipped.clone(), "skipped_in_a_row": self.skipped_in_a_row.clone()}
        return {"model": self.model_optimizer.state_dict(), "policy": self.policy_optimizer.state_dict()} | counts

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restores :meth:`state_dict`."""
        self.model_optimizer.load_state_dict(state_dict["model"])
        self.policy_optimizer.load_state_dict(state_dict["policy"])
        for name in ("skipped", "skipped_in_a_row"):
            if name in state_dict:  # not in checkpoints of the first versions
                getattr(self, name).copy_(state_dict[name])
