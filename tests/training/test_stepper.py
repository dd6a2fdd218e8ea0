from __future__ import annotations

import copy

import torch

from torchrl_etdmpc import EfficientTDMPCLoss, WorldModel
from torchrl_etdmpc.testing import random_slices
from torchrl_etdmpc.training import Updater, UpdateStepper


def make_updater() -> Updater:
    torch.manual_seed(0)
    model = WorldModel(3, 2, latent_dim=16, mlp_dim=16, encoder_dim=16)
    return Updater(EfficientTDMPCLoss(model, discount=0.99), lr=1e-2)


def test_a_step_of_the_trainer_is_an_update_targets_and_version_included():
    plain, stepped = make_updater(), make_updater()
    stepper, batch = UpdateStepper(stepped), random_slices(3, 2)
    for _ in range(3):
        torch.manual_seed(1)
        expected = plain.step(batch)
        torch.manual_seed(1)
        assert (stepper.step(None, batch) == expected).all()
    weights, others = plain.loss.state_dict(), stepped.loss.state_dict()
    assert all(torch.equal(weights[name], others[name]) for name in weights)
    assert others["version"] == 3


def test_a_batch_of_no_device_gets_the_new_priorities():
    for device in (None, "cpu"):
        batch = random_slices(3, 2)
        batch["priority_weight"] = torch.ones(*batch.batch_size)
        batch = batch.to("cpu") if device else batch.clear_device_()
        UpdateStepper(make_updater()).step(None, batch)
        assert (batch["td_error"] > 0).any()


def test_its_state_is_the_updater_s():
    stepper, batch = UpdateStepper(make_updater()), random_slices(3, 2)
    stepper.step(None, batch)
    other = UpdateStepper(make_updater())
    other.updater.loss.load_state_dict(stepper.updater.loss.state_dict())
    other.load_state_dict(copy.deepcopy(stepper.state_dict()))  # PyTorch's optimisers take the tensors themselves
    for one in (stepper, other):
        torch.manual_seed(1)
        one.step(None, batch)
    weights, others = (one.updater.loss.state_dict() for one in (stepper, other))
    assert all(torch.equal(weights[name], others[name]) for name in weights)
