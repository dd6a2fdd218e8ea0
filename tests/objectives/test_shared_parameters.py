from __future__ import annotations

import copy
import pickle

import pytest
import torch
from torchrl.objectives import SoftUpdate

from torchrl_etdmpc import EfficientTDMPCLoss


def _identities(module):
    return {id(parameter) for parameter in module.parameters()}


def test_reset_parameters_recursive_draws_new_weights_for_the_networks_that_are_trained(
    loss, kind, world_model, networks, owned
):
    before = {}
    for name, network in networks(world_model).items():
        with torch.no_grad():
            for parameter in network.parameters():
                parameter.add_(1000.0)
        before[name] = [(parameter, parameter.clone()) for parameter in network.parameters()]
    loss.reset_parameters_recursive()
    for name, network in networks(world_model).items():
        for (parameter, value), now in zip(before[name], network.parameters(), strict=True):
            assert parameter is now
            if name in owned(kind):
                assert (now.abs() < 10).all()
            else:
                assert torch.equal(now, value)
    if "value" in owned(kind):
        for key, parameter in loss.value_params.items(True, True):
            assert torch.equal(loss.target_value_params[key], parameter)
            assert loss.target_value_params[key].data_ptr() != parameter.data_ptr()
    if "dynamics" in owned(kind):
        first, second = world_model.dynamics.hidden[0].weight
        assert first.any() and not torch.equal(first, second)


def test_a_reset_begins_the_running_scale_anew_and_one_of_the_whole_the_count_of_updates(make_loss):
    for kind, version in (("whole", 0), ("policy", 5)):
        loss = make_loss(kind)
        loss.world_model.version.fill_(5)
        loss.kl_scale.fill_(50)
        loss.reset_parameters_recursive()
        assert loss.world_model.version == version
        assert loss.kl_scale == 1


def test_the_parameters_are_the_trained_networks_own_and_targets_add_none(loss, kind, world_model, networks, owned):
    own = [network for name, network in networks(world_model).items() if name in owned(kind)]
    assert _identities(loss) == set.union(*(_identities(network) for network in own))
    assert len(list(loss.parameters())) == sum(len(list(network.parameters())) for network in own)
    if kind == "whole":
        assert _identities(loss) == _identities(world_model)


@pytest.mark.parametrize("called_before", [False, True])
def test_a_cast_keeps_the_networks_shared_and_takes_everything_along(
    loss, kind, world_model, networks, slices, called_before, total
):
    if called_before:
        loss(slices)
    shared = _identities(loss)
    for cast in (loss.double, lambda: loss.to("cpu"), loss.float, lambda: loss.to(torch.float64)):
        assert cast() is loss
        assert _identities(loss) == shared
        assert shared <= _identities(world_model)
    assert {parameter.dtype for parameter in world_model.parameters()} == {torch.float64}
    assert world_model.bins.dtype == torch.float64
    assert world_model.version.dtype == torch.int64
    assert {buffer.dtype for buffer in loss.buffers()} == {torch.float64}
    out = loss(slices.to(torch.float64))
    assert {value.dtype for value in out.values()} == {torch.float64}
    total(out).backward()
    assert all(parameter.grad.dtype == torch.float64 for parameter in loss.parameters())


def test_the_updater_still_works_after_calls_and_a_cast(make_loss, slices):
    loss = make_loss("whole", updater=False)
    updater = SoftUpdate(loss, tau=0.1)
    loss(slices)
    loss.double()
    loss(slices.to(torch.float64))
    with torch.no_grad():
        loss.world_model.value_head.output.bias.add_(1.0)
    before = loss.target_value_params["output", "bias"].clone()
    updater.step()
    torch.testing.assert_close(loss.target_value_params["output", "bias"], before + 0.1)


def test_what_a_target_follows_is_what_is_trained(make_loss):
    loss = make_loss("value")
    trained = list(loss.world_model.value_head.parameters())
    assert {id(own) for _, own in loss.target_parameters()["value"]} == set(map(id, trained))
    loss.world_model.value_head.output.requires_grad_(False)
    trained = [parameter for parameter in trained if parameter.requires_grad]
    assert {id(own) for _, own in loss.target_parameters()["value"]} == set(map(id, trained))


def test_an_optimizer_step_on_the_loss_is_seen_by_the_world_model(
    loss, kind, world_model, networks, slices, total, owned
):
    before = {name: [p.clone() for p in network.parameters()] for name, network in networks(world_model).items()}
    optimizer = torch.optim.SGD(loss.parameters(), lr=0.1)
    total(loss(slices)).backward()
    optimizer.step()
    for name, network in networks(world_model).items():
        for value, now in zip(before[name], network.parameters(), strict=True):
            assert torch.equal(value, now) == (name not in owned(kind))


def test_a_state_dict_carries_weights_targets_and_the_scale_to_a_fresh_loss(
    make_loss, make_world_model, kind, slices, run_seeded, assert_same_output, owned
):
    trained = make_loss(kind, make_world_model(termination=True))
    if kind in ("whole", "policy"):
        trained.scale_tau = 1.0
    trained(slices)
    fresh = make_loss(kind, make_world_model(termination=True))
    others = [network for network in ("reward_head", "termination_head", "policy", "encoder", "dynamics")]
    for name in others:  # what a part does not own is not in its state
        if name.removesuffix("_head") not in owned(kind):
            getattr(fresh.world_model, name).load_state_dict(getattr(trained.world_model, name).state_dict())
    assert not (run_seeded(fresh.eval(), slices) == run_seeded(trained.eval(), slices)).any()
    state = copy.deepcopy(trained.state_dict())
    keys = fresh.load_state_dict(state)
    assert not keys.missing_keys and not keys.unexpected_keys
    assert_same_output(run_seeded(fresh.eval(), slices), run_seeded(trained.eval(), slices), rtol=0, atol=0)
    if kind in ("whole", "value"):
        target, online = fresh.target_value_params["output", "weight"], fresh.value_params["output", "weight"]
        assert torch.equal(target, trained.target_value_params["output", "weight"])
        assert not torch.equal(target, online)
    if kind in ("whole", "policy"):
        assert fresh.kl_scale == trained.kl_scale > 1
    assert _identities(fresh) <= _identities(fresh.world_model)


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda loss: pickle.loads(pickle.dumps(loss))])
@pytest.mark.parametrize("called_before", [False, True])
def test_a_copy_gives_the_same_numbers_and_trains_its_own_world_model(
    loss, slices, run_seeded, assert_same_output, duplicate, called_before, total
):
    if called_before:
        loss(slices)
    twin = duplicate(loss)
    assert not _identities(twin) & _identities(loss)
    assert _identities(twin) <= _identities(twin.world_model)
    assert_same_output(run_seeded(twin.eval(), slices), run_seeded(loss.eval(), slices), rtol=0, atol=0)
    total(twin(slices)).backward()
    assert all(parameter.grad is not None for parameter in twin.parameters())
    assert all(parameter.grad is None for parameter in loss.parameters())


def test_copying_a_loss_together_with_its_world_model_keeps_them_shared(loss, world_model):
    world_model_twin, twin = copy.deepcopy((world_model, loss))
    assert twin.world_model is world_model_twin
    assert _identities(twin) <= _identities(world_model_twin)


def test_weights_that_others_took_the_place_of_are_noticed(make_loss, make_world_model, slices):
    loss = make_loss("whole")
    loss.world_model.load_state_dict(make_world_model().state_dict(), assign=True)
    with pytest.raises(
        RuntimeError, match=r"the weights of world_model\.encoder are others than this loss trains: load_"
    ):
        loss(slices)
    loss = make_loss("whole")
    loss.world_model.policy = make_world_model().policy
    with pytest.raises(RuntimeError, match=r"the weights of world_model\.policy are others than this loss trains"):
        loss(slices)
    loss = make_loss("whole")
    loss.world_model.load_state_dict(make_world_model().state_dict())
    loss(slices)
    # A layer, not the first one.
    other = make_world_model()
    loss.world_model.reward_head.output = other.reward_head.output
    with pytest.raises(RuntimeError, match=r"world_model\.reward_head are others .* to_module\(\) put"):
        loss(slices)


def test_a_copy_and_a_cast_loss_still_know_their_weights(make_loss, slices):
    loss = make_loss("whole")
    loss(slices)
    for twin in (copy.deepcopy(loss), pickle.loads(pickle.dumps(loss)), loss.double()):
        twin(slices if twin is not loss else slices.double())


def test_a_world_model_that_was_cast_without_its_loss_is_noticed(make_loss, slices):
    loss = make_loss("whole")
    loss.world_model.double()
    with pytest.raises(
        RuntimeError, match=r"is torch\.float64 on cpu, its targets are torch\.float32 on cpu; .* loss\.to"
    ):
        loss(slices.double())
    loss.double()(slices.double())


def test_rewards_and_values_over_other_bins_are_refused(make_loss, make_world_model, kind):
    state = make_loss(kind, make_world_model()).state_dict()
    other = make_loss(kind, make_world_model(bin_min=-5.0, bin_max=5.0))
    if kind == "policy":
        other.load_state_dict(state)
        return
    with pytest.raises(RuntimeError, match="of another world model: its bins reach from -10 to 10, here from -5 to 5"):
        other.load_state_dict(state)
    with pytest.raises(RuntimeError, match="its bins reach from -10 to 10, here from -10 to 5"):
        make_loss(kind, make_world_model(bin_max=5.0)).load_state_dict(state)
    make_loss(kind, make_world_model()).load_state_dict(make_loss(kind).bfloat16().state_dict())
    state.pop("bins")  # a file of before
    other.load_state_dict(state)


@pytest.mark.parametrize(
    ("options", "fault"),
    [
        ({"num_dynamics": 3}, r"dynamics_params\.hidden\.0\.weight is \[2, .*\] there and \[3, .*\] here, and 11 more"),
        ({"normalize_observations": True}, r"it lacks encoder_params\.norm\.mean, and 2 more"),
    ],
)
def test_a_state_of_another_world_model_is_refused_before_anything_is_loaded(make_world_model, options, fault):
    state = EfficientTDMPCLoss(make_world_model(num_dynamics=2), discount=0.99).state_dict()
    other = EfficientTDMPCLoss(make_world_model(**({"num_dynamics": 2} | options)), discount=0.99)
    before = copy.deepcopy(other.state_dict())
    with pytest.raises(RuntimeError, match=rf"^the state is of another world model: {fault}; build this one like"):
        other.load_state_dict(state)
    for name, value in other.state_dict().items():
        torch.testing.assert_close(value, before[name], rtol=0, atol=0, msg=name)
