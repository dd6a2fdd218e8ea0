from __future__ import annotations

import copy
import gc
import weakref

import pytest
import torch
from torchrl.checkpoint import Checkpoint
from torchrl.objectives import SoftUpdate

from torchrl_etdmpc.objectives import EfficientTDMPCModelLoss, EfficientTDMPCPolicyLoss, update_count
from torchrl_etdmpc.training import Updater


def train(loss, *optimizers, slices, total, steps=3, by_hand=False):
    for _ in range(steps):
        total(loss(slices)).backward()
        for optimizer in optimizers:
            optimizer.step()
            optimizer.zero_grad()
        if by_hand:
            loss.world_model.version += 1


def test_every_step_of_an_optimizer_counts_as_one_update(loss, world_model, slices, total):
    optimizer = torch.optim.Adam(loss.parameters())
    train(loss, optimizer, slices=slices, total=total)
    assert world_model.version == 3
    assert world_model.version.dtype == torch.int64


def test_of_the_optimizers_that_share_the_networks_one_counts(make_loss, world_model, slices, total):
    loss = make_loss("whole", world_model)
    policy = {id(p) for p in world_model.policy.parameters()}
    others = [p for p in loss.parameters() if id(p) not in policy]
    optimizers = [torch.optim.Adam(others), torch.optim.Adam(world_model.policy.parameters())]
    train(loss, *optimizers, slices=slices, total=total)
    assert world_model.version == 3


@pytest.mark.parametrize("frozen", ["before", "after"])
def test_an_optimizer_need_not_hold_what_is_frozen(make_loss, world_model, slices, total, frozen):
    if frozen == "before":
        world_model.encoder.requires_grad_(False)
    loss = make_loss("whole", world_model)
    world_model.encoder.requires_grad_(False)
    train(loss, torch.optim.Adam([p for p in loss.parameters() if p.requires_grad]), slices=slices, total=total)
    assert world_model.version == 3


def test_losses_that_share_a_world_model_count_a_step_once(make_world_model, slices, total):
    model = make_world_model()
    losses = [
        EfficientTDMPCPolicyLoss(model),
        EfficientTDMPCModelLoss(model, ignore_termination=True),
        EfficientTDMPCPolicyLoss(model),
    ]
    optimizer = torch.optim.SGD(model.parameters(), lr=0.1)
    for _ in range(2):
        sum(total(loss(slices)) for loss in losses).backward()
        optimizer.step()
    assert model.version == 2


def test_a_loss_of_other_networks_that_is_built_later_does_not_end_the_count(make_world_model, slices, total):
    model = make_world_model()
    loss = EfficientTDMPCModelLoss(model, ignore_termination=True)
    EfficientTDMPCPolicyLoss(model)
    train(loss, torch.optim.SGD(loss.parameters(), lr=0.1), slices=slices, total=total)
    assert model.version == 3


def test_optimizers_of_other_networks_do_not_count(loss, world_model):
    other = torch.nn.Linear(2, 2)
    optimizer = torch.optim.SGD(other.parameters(), lr=0.1)
    other(torch.ones(2)).sum().backward()
    optimizer.step()
    assert world_model.version == 0


def test_who_counts_by_hand_as_well_is_one_ahead_and_stays_so(make_loss, world_model, slices, total):
    loss = make_loss("whole", world_model)
    optimizer = torch.optim.Adam(loss.parameters())
    for steps in (1, 5, 20):
        before = world_model.version.item()
        train(loss, optimizer, slices=slices, total=total, steps=steps, by_hand=True)
        assert world_model.version == before + steps + (steps == 1)


def test_the_updater_counts_once_too(make_loss, make_world_model, slices):
    updater = Updater(make_loss("whole", make_world_model()))
    for number in range(1, 4):
        updater.step(slices)
        assert updater.loss.world_model.version == number


def test_a_copied_loss_counts_for_its_own_world_model(make_loss, world_model, slices, total):
    loss = make_loss("whole", world_model)
    other = copy.deepcopy(loss)
    train(other, torch.optim.Adam(other.parameters()), slices=slices, total=total)
    assert (world_model.version, other.world_model.version) == (0, 3)


def test_a_cast_loss_goes_on_counting(make_loss, world_model, slices, total):
    loss = make_loss("whole", world_model).double()
    train(loss, torch.optim.Adam(loss.parameters()), slices=slices.to(torch.float64), total=total)
    assert world_model.version == 3


def test_the_steps_of_a_compiled_world_model_count(make_loss, world_model, slices, total):
    loss = make_loss("whole", torch.compile(world_model, backend="eager"))
    train(loss, torch.optim.Adam(loss.parameters()), slices=slices, total=total)
    assert world_model.version == 3


def test_a_compiled_step_counts_whatever_models_come_and_go(make_loss, make_world_model, slices, total):
    compiled = []

    def collecting(graph, inputs):
        """A compiler while which the garbage collector runs."""
        gc.collect()
        compiled.append(graph)
        return graph.forward

    gone = make_loss("whole", make_world_model())
    gone.itself = [gone]  # goes with the next collection, not with its name
    loss = make_loss("whole", make_world_model())
    world_model = loss.world_model
    optimizer = torch.optim.SGD(loss.parameters(), lr=0.1)
    total(loss(slices)).backward()
    step = torch.compile(optimizer.step, backend=collecting)
    alive = weakref.ref(gone.world_model)
    gc.disable()
    try:
        del gone
        assert alive() is not None
        step()
    finally:
        gc.enable()
    assert alive() is None
    step()
    graphs = len(compiled)
    later = make_loss("whole", make_world_model())
    step()
    assert (world_model.version, later.world_model.version) == (3, 0)
    assert len(compiled) == graphs


def test_world_models_that_share_a_network_each_count(make_loss, make_world_model, slices, total):
    models = [make_world_model(), make_world_model()]
    models[1].encoder = models[0].encoder
    losses = [make_loss("whole", model) for model in models]
    train(losses[0], torch.optim.Adam(losses[0].parameters()), slices=slices, total=total)
    assert [int(model.version) for model in models] == [3, 3]


def test_a_world_model_that_nobody_holds_is_let_go_with_its_entries(make_loss, make_world_model):
    before = set(update_count._counts_by_parameter)
    loss = make_loss("whole", make_world_model())
    assert set(update_count._counts_by_parameter) > before
    alive = weakref.ref(loss.world_model)
    del loss
    gc.collect()
    assert alive() is None
    assert set(update_count._counts_by_parameter) <= before


@pytest.mark.parametrize("updates", [1, 3])
def test_the_count_is_part_of_the_state_and_goes_on_from_there(
    make_loss, make_world_model, kind, slices, total, updates
):
    loss = make_loss(kind, make_world_model(termination=True))
    train(loss, torch.optim.Adam(loss.parameters()), slices=slices, total=total, steps=updates)
    other = make_loss(kind, make_world_model(termination=True))
    keys = other.load_state_dict(loss.state_dict())
    assert not keys.missing_keys and not keys.unexpected_keys
    assert other.world_model.version == updates
    train(other, torch.optim.Adam(other.parameters()), slices=slices, total=total)
    assert other.world_model.version == updates + 3
    assert loss.world_model.version == updates  # the state was copied


def test_a_state_of_before_keeps_the_count_that_is_there(make_loss, world_model):
    loss = make_loss("whole", world_model)
    world_model.version.fill_(7)
    state = {name: value for name, value in loss.state_dict().items() if name != "version"}
    loss.load_state_dict(state)
    assert world_model.version == 7


def test_torchrl_s_checkpoint_of_the_loss_restores_the_count(make_loss, make_world_model, slices, total, tmp_path):
    loss = make_loss("whole", make_world_model(termination=True))
    train(loss, torch.optim.Adam(loss.parameters()), slices=slices, total=total)
    Checkpoint(loss=loss).save(tmp_path / "checkpoint")
    other = make_loss("whole", make_world_model(termination=True))
    Checkpoint(loss=other).load(tmp_path / "checkpoint")
    assert other.world_model.version == 3
    SoftUpdate(other, tau=0.1)


@pytest.mark.parametrize("stage", ["frozen", "deleted"])
def test_a_later_optimizer_that_holds_less_goes_on_counting(make_loss, world_model, slices, total, stage):
    loss = make_loss("whole", world_model)
    optimizer = torch.optim.Adam(loss.parameters())
    train(loss, optimizer, slices=slices, total=total)
    rest = [p for name, p in loss.named_parameters() if not name.startswith("encoder")]
    if stage == "frozen":
        world_model.encoder.requires_grad_(False)
    else:
        del optimizer
        gc.collect()
    later = torch.optim.Adam(rest)
    train(loss, later, slices=slices, total=total)
    assert world_model.version == 6


def test_freezing_what_the_counting_optimizer_holds_first_makes_no_other_one_count(
    make_loss, world_model, slices, total
):
    loss = make_loss("whole", world_model)
    policy = {id(p) for p in world_model.policy.parameters()}
    optimizers = [
        torch.optim.Adam([p for p in loss.parameters() if id(p) not in policy]),
        torch.optim.Adam(world_model.policy.parameters()),
    ]
    train(loss, *optimizers, slices=slices, total=total)
    world_model.encoder.requires_grad_(False)
    train(loss, *optimizers, slices=slices, total=total)
    assert world_model.version == 6


def test_an_optimizer_beside_the_one_that_counts_does_not(make_loss, world_model, slices, total):
    loss = make_loss("whole", world_model)
    whole, policy = torch.optim.Adam(loss.parameters()), torch.optim.Adam(world_model.policy.parameters())
    train(loss, policy, whole, slices=slices, total=total)
    # Its first step, before the other one's, counts: nothing could tell. From then on the other one's do.
    assert world_model.version == 4
    train(loss, whole, policy, slices=slices, total=total)
    assert world_model.version == 7


def test_the_count_stays_in_its_memory_for_graphs_that_read_it(loss, world_model, slices, total):
    optimizer = torch.optim.SGD(loss.parameters())
    train(loss, optimizer, slices=slices, total=total, steps=1)
    (count,) = update_count._counts_of(world_model.parameters())
    memory = count.after
    train(loss, optimizer, slices=slices, total=total, steps=2)
    assert count.after is memory
    assert memory == world_model.version == 3
