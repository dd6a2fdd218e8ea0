"""Our updates in the hands of TorchRL's Trainer."""

from __future__ import annotations

from typing import Any

from tensordict import TensorDictBase
from torchrl.trainers import OptimizationStepper, Trainer

from torchrl_etdmpc.training.updater import Updater


class UpdateStepper(OptimizationStepper):
    """Makes the updates of a :class:`torchrl.trainers.Trainer` with an :class:`Updater`.

    That is the two clipped gradients, Adam, the average of the targets and the count of updates. The batches are slices
    [B, T], as a buffer with ``StepSliceSampler(as_slices=True)`` samples them. With a stepper of one's own TorchRL's
    trainer (0.14) runs no ``post_loss`` hooks, so ``ReplayBufferTrainer`` does not update priorities: the new ones are
    in the batch.

    Args:
        updater (Updater): of the trainer's loss.

    >>> from torchrl_etdmpc import EfficientTDMPCLoss, WorldModel
    >>> from torchrl_etdmpc.testing import random_slices
    >>> loss = EfficientTDMPCLoss(WorldModel(3, 2, latent_dim=16, mlp_dim=32), discount=0.99)
    >>> stepper = UpdateStepper(Updater(loss))  # Trainer(..., loss_module=loss, optimization_stepper=stepper)
    """

    def __init__(self, updater: Updater) -> None:
        self.updater = updater

    def step(self, trainer: Trainer, sub_batch: TensorDictBase) -> TensorDictBase:
        """One update; returns losses, metrics and gradient norms."""
        loss = self.updater.loss
        there = sub_batch.to(loss.world_model.version.device)
        terms = self.updater.step(there)
        priority = there.get(loss.tensor_keys.priority, None)
        if there is not sub_batch and priority is not None:
            sub_batch.set(loss.tensor_keys.priority, priority)
        return terms

    def state_dict(self) -> dict[str, Any]:
        """That of the updater; the trainer saves the loss, and with it weights, targets and the count of updates."""
        return self.updater.state_dict()

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restores :meth:`state_dict`."""
        self.updater.load_state_dict(state_dict)
