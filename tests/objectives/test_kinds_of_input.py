from __future__ import annotations

import pytest
import torch
from tensordict import LazyStackedTensorDict
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from torchrl.objectives import SoftUpdate

from torchrl_etdmpc.modules import ActionValueWorldModel, WorldModel
from torchrl_etdmpc.objectives import EfficientTDMPCLoss, EfficientTDMPCModelLoss, TDMPC2Loss, Term
from torchrl_etdmpc.testing import random_slices


def test_a_memory_mapped_batch_gives_the_same_numbers(loss, slices, run_seeded, assert_same_output, tmp_path):
    expected = run_seeded(loss.eval(), slices)
    mapped = slices.memmap(tmp_path)
    assert mapped.is_memmap()
    assert_same_output(run_seeded(loss, mapped), expected)


@pytest.mark.parametrize("stack_dim", [0, 1])
def test_a_lazily_stacked_batch_gives_the_same_numbers(loss, slices, run_seeded, assert_same_output, stack_dim):
    expected = run_seeded(loss.eval(), slices)
    lazy = LazyStackedTensorDict(*slices.unbind(stack_dim), stack_dim=stack_dim)
    assert lazy.batch_size == (4, 3)
    assert_same_output(run_seeded(loss, lazy), expected)


@pytest.mark.parametrize(("num_slices", "slice_len"), [(4, 1), (1, 3), (1, 1)])
@pytest.mark.parametrize("heads", [1, 2])
def test_single_heads_slices_and_steps_are_ordinary_sizes(
    make_loss, make_world_model, make_slices, run_seeded, num_slices, slice_len, heads, total, terms_of
):
    world_model = make_world_model(num_dynamics=heads, num_values=heads, termination=True)
    loss = make_loss("whole", world_model, reduction="none")
    out = run_seeded(loss, make_slices(num_slices, slice_len))
    for term in terms_of["whole"]:
        assert out[f"loss_{term}"].shape == (num_slices, slice_len)
        assert out[f"loss_{term}"].isfinite().all()
    total(out).sum().backward()
    assert all(parameter.grad.isfinite().all() for parameter in loss.parameters())


@pytest.mark.usefixtures("double_precision")
@pytest.mark.parametrize(("num_dynamics", "num_values"), [(1, 1), (1, 2), (3, 1)])
@pytest.mark.parametrize("slice_len", [1, 3])
def test_the_plain_reference_holds_for_other_numbers_of_heads_and_steps(
    make_loss, make_world_model, make_slices, run_seeded, plain_errors, depth_mean, num_dynamics, num_values, slice_len
):
    world_model = make_world_model(num_dynamics=num_dynamics, num_values=num_values)
    loss = make_loss("whole", world_model, entropy_coef=0.1).eval()
    slices = make_slices(slice_len=slice_len)
    torch.manual_seed(7)
    errors = plain_errors(loss, slices)
    out = run_seeded(loss, slices)
    torch.testing.assert_close(out["loss_consistency"], 20 * depth_mean(errors["consistency"]))
    torch.testing.assert_close(out["loss_reward"], 0.1 * depth_mean(errors["reward"]))
    torch.testing.assert_close(out["loss_value"], 0.1 * depth_mean(errors["value"]))
    torch.testing.assert_close(out["loss_policy"], depth_mean(errors["kl"] - 0.1 * 3 * errors["entropy"]))


# tensordict reads a switch that torch deprecates
@pytest.mark.filterwarnings("ignore:torch._dynamo.config.inline_inbuilt_nn_modules:FutureWarning")
def test_the_compiled_loss_equals_the_eager_one_in_numbers_gradients_and_scale(
    make_loss, make_world_model, make_slices, run_seeded, assert_same_output, gradients, assert_same_gradients, total
):
    """With a term of one's own and a mask over what is no number, in one graph."""

    def far_from_one(world_model, slices, rollout):
        return (world_model.policy(rollout.encoded[:-1])[0] - 1).square().mean(-1)

    world_model = make_world_model(termination=True, dropout=0.0)
    loss = make_loss("whole", world_model, scale_tau=0.5, extra_terms=[Term("far_from_one", far_from_one, 2.0)])
    slices = make_slices(slice_len=2)
    slices["collector", "mask"] = torch.arange(2) < torch.tensor([[2], [1], [2], [0]])
    for key in ("action", ("next", "reward"), ("plan", "loc"), ("plan", "scale")):
        slices[key][~slices["collector", "mask"]] = torch.nan
    torch.compiler.reset()
    compiled = torch.compile(loss, fullgraph=True, backend="aot_eager")
    for seed in (1, 2):  # the scale moves in between
        loss.kl_scale.fill_(1.0 + seed)
        expected = run_seeded(loss, slices, seed=seed)
        loss.kl_scale.fill_(1.0 + seed)
        actual = run_seeded(compiled, slices, seed=seed)
        assert_same_output(actual, expected)
        assert actual["kl_scale"] == loss.kl_scale != 1.0 + seed
        expected, actual = gradients(total(expected), world_model), gradients(total(actual), world_model)
        assert_same_gradients(actual, expected)


@pytest.mark.filterwarnings("ignore:torch._dynamo.config.inline_inbuilt_nn_modules:FutureWarning")
@pytest.mark.parametrize("kind", ["whole", "model", "value", "policy", "action values"])
def test_a_loss_that_is_compiled_by_its_user_is_compiled_once(make_loss, slices, total, kind):
    graphs = []

    def keep(graph, inputs):
        graphs.append(graph)
        return graph.forward

    if kind == "action values":
        sizes = {"latent_dim": 16, "mlp_dim": 12, "encoder_dim": 10}
        dims = (slices["observation"].shape[-1], slices["action"].shape[-1])
        loss = TDMPC2Loss(ActionValueWorldModel(*dims, **sizes), discount=0.9)
    else:
        loss = make_loss(kind)
    has_targets = any(name.startswith("target_") for name, _ in loss.named_buffers())
    optimizer, targets = torch.optim.SGD(loss.parameters()), SoftUpdate(loss, tau=0.1) if has_targets else None
    torch.compiler.reset()
    compiled = torch.compile(loss, fullgraph=True, backend=keep)
    for _ in range(3):
        total(compiled(slices)).backward()
        optimizer.step()
        optimizer.zero_grad()
        if targets is not None:
            targets.step()
    assert len(graphs) == 1


@pytest.mark.parametrize("kind", [torch.float32, torch.int64, torch.uint8])
@pytest.mark.parametrize("replayed", [0.0, 0.5])
def test_flags_of_other_kinds_count_as_flags(
    make_loss, make_world_model, slices, run_seeded, assert_same_output, kind, replayed
):
    loss = make_loss("whole", make_world_model(termination=True), value_replayed=replayed).eval()
    slices["collector", "mask"] = torch.ones(slices.shape, dtype=torch.bool)
    expected = run_seeded(loss, slices)
    for flag in ("terminated", "done"):
        slices["next", flag] = slices["next", flag].to(kind)
    assert_same_output(run_seeded(loss, slices), expected)


def test_flags_of_other_kinds_count_as_flags_of_action_values(slices, run_seeded, assert_same_output):
    sizes = {"latent_dim": 16, "mlp_dim": 12, "encoder_dim": 10, "termination": True}
    dims = (slices["observation"].shape[-1], slices["action"].shape[-1])
    loss = TDMPC2Loss(ActionValueWorldModel(*dims, **sizes), discount=0.9).eval()
    SoftUpdate(loss, tau=0.01)
    expected = run_seeded(loss, slices)
    slices["next", "terminated"] = slices["next", "terminated"].float()
    assert_same_output(run_seeded(loss, slices), expected)


def test_a_loss_is_where_its_world_model_is(kind, make_world_model, make_loss):
    loss = make_loss(kind, make_world_model().to("meta"), updater=False)
    assert {buffer.device.type for buffer in loss.buffers()} <= {"meta"}
    assert {parameter.device.type for parameter in loss.parameters()} == {"meta"}


@pytest.mark.parametrize(
    ("model", "kind"), [(WorldModel, EfficientTDMPCLoss), (ActionValueWorldModel, TDMPC2Loss)], ids=["bmpc", "tdmpc2"]
)
def test_a_loss_computes_on_one_device_alone(model, kind, monkeypatch):
    """On the meta device, which every machine has: a CPU tensor among those of another device fails there, or waits."""
    monkeypatch.setattr(torch, "is_autocast_enabled", lambda device: False)  # which does not know that device
    mixed = []

    class Watch(TorchDispatchMode):
        def __torch_dispatch__(self, function, types, args=(), kwargs=None):
            out = function(*args, **(kwargs or {}))
            tensors = [leaf for leaf in tree_leaves((args, kwargs, out)) if isinstance(leaf, torch.Tensor)]
            if len({tensor.device for tensor in tensors}) > 1:
                mixed.append(function)
            return out

    loss = kind(model(3, 2, latent_dim=16, mlp_dim=32, normalize_observations=True).to("meta"), discount=0.99)
    batch = random_slices(3, 2)
    batch["collector", "mask"] = torch.ones(batch.shape, dtype=torch.bool)
    batch = batch.to("meta")
    with Watch():
        out = loss.evaluate(loss.slices(batch), loss.targets())
    assert mixed == []
    assert {value.device.type for value in out.values()} == {"meta"}


def test_half_precision_leaves_the_discount_as_it_is():
    loss = EfficientTDMPCLoss(WorldModel(5, 3, latent_dim=16, mlp_dim=16), discount=0.995, rho=0.3)
    loss.to(torch.bfloat16)
    SoftUpdate(loss, tau=0.01)
    assert next(loss.parameters()).dtype == torch.bfloat16
    assert (loss.discount.item(), loss.rho.item()) == pytest.approx((0.995, 0.3), rel=1e-7)
    batch = random_slices(5, 3, num_slices=4, slice_len=3)
    assert torch.isfinite(loss(batch.apply(lambda x: x.bfloat16() if x.is_floating_point() else x))["loss_value"])
    for dtype in (torch.float64, torch.float32):
        assert loss.to(dtype).discount.dtype == dtype


@pytest.mark.parametrize("kind", ["efficient", "tdmpc2"])
def test_a_loss_never_puts_the_targets_weights_into_the_world_model(kind):
    """A planner in another thread, as behind TorchRL's AsyncBatchedCollector, would plan with them."""
    sizes = {"latent_dim": 16, "mlp_dim": 16}
    if kind == "efficient":
        model = WorldModel(5, 3, **sizes)
        loss = EfficientTDMPCLoss(model, discount=0.99)
    else:
        model = ActionValueWorldModel(5, 3, **sizes)
        loss = TDMPC2Loss(model, discount=0.99)
    SoftUpdate(loss, tau=0.01)
    own, seen = [*model.value_head.parameters()], []
    model.value_head.register_forward_pre_hook(lambda head, _: seen.append([*head.parameters()]))
    batch, found = random_slices(5, 3), []
    for _ in range(2):
        torch.manual_seed(0)
        found.append(loss(batch)["value_target"])
        for target, _ in loss.target_parameters()["value"]:
            target.data.add_(torch.randn_like(target.data))
    assert found[0] != found[1]  # they are used
    if kind == "efficient":  # the policy of TD-MPC2's critic maximises values by constant copies of these weights
        assert all(now is then for parameters in seen for now, then in zip(parameters, own, strict=True))
    weights = {id(target) for target, _ in loss.target_parameters()["value"]}
    assert not weights & {id(parameter) for parameters in seen for parameter in parameters}
    addresses = {target.data_ptr() for target, _ in loss.target_parameters()["value"]}
    assert not addresses & {parameter.data_ptr() for parameters in seen for parameter in parameters}


def test_a_loss_without_targets_saves_the_statistics_of_a_model_that_was_cast_without_it():
    model = WorldModel(5, 3, latent_dim=16, mlp_dim=16, normalize_observations=True)
    loss = EfficientTDMPCModelLoss(model)
    model.double()
    batch = random_slices(5, 3).apply(lambda x: x.double() if x.is_floating_point() else x)
    loss(batch)
    saved = loss.state_dict()
    statistics = {name: value for name, value in saved.items() if name.endswith("mean")}
    assert statistics
    for name, value in model.encoder.named_buffers():
        torch.testing.assert_close(saved[f"encoder_params.{name}"], value)
    assert any(value.abs().sum() > 0 for value in statistics.values())
    held = loss.encoder_params
    loss.state_dict()
    assert loss.encoder_params is held  # read anew only where there was something to read


@pytest.mark.parametrize(("kind", "name"), [("efficient", "kl_scale"), ("tdmpc2", "q_scale")])
def test_a_running_scale_moves_in_half_precision(kind, name):
    sizes = {"latent_dim": 16, "mlp_dim": 16}
    if kind == "efficient":
        loss = EfficientTDMPCLoss(WorldModel(5, 3, **sizes), discount=0.99, scale_tau=0.001)
    else:
        loss = TDMPC2Loss(ActionValueWorldModel(5, 3, **sizes), discount=0.99, scale_tau=0.001)
    loss.to(torch.bfloat16)
    SoftUpdate(loss, tau=0.01)
    loss.get_buffer(name).fill_(100.0)
    batch = random_slices(5, 3, num_slices=4, slice_len=3)
    loss(batch.apply(lambda x: x.bfloat16() if x.is_floating_point() else x))
    assert 99.89 < loss.get_buffer(name).item() < 99.95  # towards 1 or more by a thousandth; in bfloat16 it would stay


def test_a_loss_of_weights_in_double_precision_has_such_numbers():
    for dtype in (torch.float64, torch.bfloat16):
        loss = EfficientTDMPCLoss(WorldModel(5, 3, latent_dim=16, mlp_dim=16).to(dtype), discount=0.99, rho=0.3)
        numbers = {buffer.dtype for buffer in loss.buffers() if buffer.ndim == 0 and buffer.is_floating_point()}
        assert numbers == {torch.promote_types(dtype, torch.float32)}
        assert (loss.discount.item() == 0.99) == (loss.rho.item() == 0.3) == (dtype == torch.float64)


def test_a_network_of_a_world_model_that_no_loss_trains_is_a_warning():
    class Larger(WorldModel):
        def __init__(self, *sizes, **options):
            super().__init__(*sizes, **options)
            self.embed = torch.nn.Linear(5, 5)

    model = Larger(5, 3, latent_dim=16, mlp_dim=16)
    with pytest.warns(UserWarning, match="^no loss trains or saves embed of Larger; put it into one of its networks"):
        EfficientTDMPCLoss(model, discount=0.99)
    model.embed.requires_grad_(False)
    EfficientTDMPCLoss(model, discount=0.99)
