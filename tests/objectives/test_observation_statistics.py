"""The losses show every training batch to an encoder that keeps statistics of what it sees."""

from __future__ import annotations

import copy
import operator

import pytest
import torch
from torch import nn
from torchrl.objectives import SoftUpdate

from torchrl_etdmpc.functional import simnorm
from torchrl_etdmpc.modules import ActionValueWorldModel, RunningNorm, WorldModel
from torchrl_etdmpc.objectives import EfficientTDMPCLoss, TDMPC2Loss, Term
from torchrl_etdmpc.testing import random_slices


@pytest.fixture(params=["whole", "model", "value"])
def make_normalising_loss(make_world_model, make_loss, request):
    """A loss of each kind that trains the encoder, which standardises."""
    kind = request.param
    return lambda **options: make_loss(kind, make_world_model(normalize_observations=True, **options))


def test_a_loss_in_training_mode_counts_the_first_observations_of_its_slices_in(make_normalising_loss, make_slices):
    loss = make_normalising_loss()
    norm, batches = loss.world_model.encoder.norm, [make_slices() for _ in range(3)]
    for batch in batches:
        loss(batch)
    seen = torch.cat([batch["observation"][:, 0] for batch in batches])
    torch.testing.assert_close(norm.mean, seen.mean(0))
    torch.testing.assert_close(norm.variance, seen.var(0, correction=0))
    assert norm.batches == 3


def test_a_loss_in_evaluation_mode_leaves_the_statistics_alone(make_normalising_loss, make_slices):
    loss = make_normalising_loss()
    loss(make_slices())
    before = copy.deepcopy(loss.world_model.encoder.norm.state_dict())
    loss.eval()(make_slices())
    after = loss.world_model.encoder.norm.state_dict()
    assert all(torch.equal(before[name], after[name]) for name in before)


@pytest.mark.parametrize("frozen", ["world_model.encoder", "encoder_params"])
def test_a_frozen_encoder_keeps_its_statistics_until_it_is_thawed(make_normalising_loss, make_slices, frozen):
    loss = make_normalising_loss()
    norm, part = loss.world_model.encoder.norm, operator.attrgetter(frozen)(loss)
    part.requires_grad_(False)
    loss(make_slices())
    assert norm.batches == 0
    loss.world_model.encoder.requires_grad_(True)
    loss(make_slices())
    assert norm.batches == 1


def test_the_policys_loss_alone_trains_no_encoder_and_moves_no_statistics(make_world_model, make_loss, make_slices):
    loss = make_loss("policy", make_world_model(normalize_observations=True))
    loss(make_slices())
    assert loss.world_model.encoder.norm.batches == 0


def test_the_loss_is_that_of_standardised_observations_without_the_option(make_world_model, make_loss, make_slices):
    loss, batch = make_loss("model", make_world_model(normalize_observations=True)), make_slices()
    batch["observation"] = 7 + 100 * batch["observation"]
    batch["next", "observation"] = 7 + 100 * batch["next", "observation"]
    plain = make_loss("model", make_world_model())
    weights = loss.world_model.state_dict()
    plain.world_model.load_state_dict({k: v for k, v in weights.items() if not k.startswith("encoder.norm.")})
    got = loss(batch)
    for key in ("observation", ("next", "observation")):
        batch[key] = loss.world_model.encoder.norm(batch[key])
    expected = plain(batch)
    for key in ("loss_consistency", "loss_reward"):
        torch.testing.assert_close(got[key], expected[key])


def test_what_lies_beyond_the_end_of_an_episode_is_not_counted_in(make_world_model, make_loss, make_slices):
    batch = make_slices()
    batch["collector", "mask"] = torch.arange(batch.shape[1]).expand(batch.shape) < 1
    batch["observation"][:, 1:] = 1e6
    batch["next", "observation"][:, 1:] = 1e6
    loss = make_loss("whole", make_world_model(normalize_observations=True))
    loss(batch)
    assert loss.world_model.encoder.norm.mean.abs().max() < 10


def test_the_state_of_the_loss_holds_the_statistics(make_normalising_loss, make_slices):
    loss, other = make_normalising_loss(), make_normalising_loss()
    loss(make_slices())
    other.load_state_dict(loss.state_dict())
    assert torch.equal(other.world_model.encoder.norm.mean, loss.world_model.encoder.norm.mean)
    copied = copy.deepcopy(loss)
    copied(make_slices())
    assert copied.world_model.encoder.norm.batches == 2
    assert loss.world_model.encoder.norm.batches == 1


def test_action_values_are_learned_from_standardised_observations_too():
    model = ActionValueWorldModel(3, 2, latent_dim=16, mlp_dim=12, normalize_observations=True)
    loss = TDMPC2Loss(model, discount=0.9)
    SoftUpdate(loss, tau=0.01)
    loss(random_slices(3, 2))
    assert model.encoder.norm.batches == 1


class OwnEncoder(nn.Module):
    """Begins with a module that has buffers and no parameter."""

    def __init__(self) -> None:
        super().__init__()
        self.norm = RunningNorm(3)
        self.linear = nn.Linear(3, 16)

    def observe(self, observation: torch.Tensor, counts: torch.Tensor | None) -> None:
        self.norm.observe(observation, counts)

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        return simnorm(self.linear(self.norm(observation)), 8)


def test_an_encoder_that_only_standardises_has_nothing_to_learn_and_moves_its_statistics():
    class Standardising(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.norm = RunningNorm(16)

        def observe(self, observation: torch.Tensor, counts: torch.Tensor | None) -> None:
            self.norm.observe(observation, counts)

        def forward(self, observation: torch.Tensor) -> torch.Tensor:
            return simnorm(self.norm(observation), 8)

    model = WorldModel(None, 2, latent_dim=16, mlp_dim=12, encoder=Standardising())
    loss = EfficientTDMPCLoss(model, discount=0.9)
    SoftUpdate(loss, tau=0.01)
    for _ in range(2):
        assert loss(random_slices(16, 2))["loss_value"].isfinite()
    assert model.encoder.norm.batches == 2


def test_an_encoder_of_ones_own_that_begins_with_buffers_is_trained_and_shown_what_it_sees():
    model = WorldModel(None, 2, latent_dim=16, mlp_dim=12, encoder=OwnEncoder())
    loss = EfficientTDMPCLoss(model, discount=0.9)
    SoftUpdate(loss, tau=0.01)
    before = model.encoder.linear.weight.detach().clone()
    optimizer = torch.optim.SGD(loss.parameters(), lr=1.0)
    terms = loss(random_slices(3, 2))
    sum(value for key, value in terms.items() if key.startswith("loss_")).backward()
    optimizer.step()
    assert model.encoder.norm.batches == 1
    assert not torch.equal(model.encoder.linear.weight, before)


def test_slices_that_are_all_padding_are_not_counted_in(make_normalising_loss, make_slices):
    loss, batch = make_normalising_loss(), make_slices()
    norm, valid = loss.world_model.encoder.norm, torch.ones(batch.shape[:2], dtype=torch.bool)
    valid[2:] = False
    batch["collector", "mask"] = valid
    loss(batch)
    seen = batch["observation"][:2, 0]
    torch.testing.assert_close(norm.mean, seen.mean(0))
    torch.testing.assert_close(norm.variance, seen.var(0, correction=0))
    before = copy.deepcopy(norm.state_dict())
    batch["collector", "mask"] = torch.zeros_like(valid)
    loss(batch)
    assert all(torch.equal(before[name], value) for name, value in norm.state_dict().items())


def test_after_a_cast_the_loss_saves_and_loads_the_statistics_that_its_model_uses(make_normalising_loss, make_slices):
    loss, other = make_normalising_loss().double(), make_normalising_loss().double()
    loss(make_slices().double())
    mean = loss.world_model.encoder.norm.mean
    assert mean.dtype == torch.float64 and mean.abs().min() > 0
    assert torch.equal(loss.state_dict()["encoder_params.norm.mean"], mean)
    other.load_state_dict(loss.state_dict())
    assert torch.equal(other.world_model.encoder.norm.mean, mean)


def test_a_target_encoder_standardises_as_the_encoder_does(make_world_model, make_slices):
    def own(world_model, slices, rollout):
        return rollout.predicted[1:].square().mean((1, -1))

    term = Term("own", own, networks=("encoder",), targets=("encoder",))
    model = make_world_model(normalize_observations=True)
    loss = EfficientTDMPCLoss(model, discount=0.9, extra_terms=[term], ignore_termination=True)
    update = SoftUpdate(loss, tau=0.5)
    batch = make_slices()
    for tensordict in (batch, batch["next"]):
        tensordict["observation"] = tensordict["observation"] + 50
    for _ in range(3):
        loss(batch)
        update.step()
    targets = loss.targets()["encoder"]
    for name, statistic in model.encoder.norm.named_buffers():
        assert torch.equal(targets[f"norm.{name}"], statistic), name
    assert targets["norm.mean"].min() > 40


def test_a_target_encoder_standardises_by_what_was_seen_before_the_batch():
    seen = []

    def look(world_model, slices, rollout):
        seen.append(rollout.targets["encoder"]["norm.mean"].clone())
        return torch.zeros(slices.action.shape[:2])

    term = Term("look", look, networks=("encoder",), targets=("encoder",))
    world_model = WorldModel(3, 2, latent_dim=16, mlp_dim=32, normalize_observations=True)
    loss = EfficientTDMPCLoss(world_model, discount=0.99, extra_terms=[term])
    SoftUpdate(loss, tau=0.01)
    slices = random_slices(3, 2)
    slices["observation"] += 50
    slices["next", "observation"] += 50
    for _ in range(2):
        loss(slices)
    torch.testing.assert_close(torch.stack(seen), torch.stack([torch.zeros(3), slices["observation"][:, 0].mean(0)]))
