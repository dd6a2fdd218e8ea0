from __future__ import annotations

import copy
import io
from collections.abc import Iterator
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torch.utils._pytree import tree_map_only
from torchrl.objectives import SoftUpdate

from torchrl_etdmpc.functional import updated_scale
from torchrl_etdmpc.modules import WorldModel
from torchrl_etdmpc.objectives import (
    EfficientTDMPCLoss,
    EfficientTDMPCModelLoss,
    EfficientTDMPCPolicyLoss,
    Term,
)
from torchrl_etdmpc.testing import random_slices
from torchrl_etdmpc.training import Updater

OBSERVATION_DIM, ACTION_DIM = 5, 3
LR, TAU, CLIP = 1e-3, 0.05, 20.0


@pytest.fixture(autouse=True)
def _double_precision() -> Iterator[None]:
    """Two ways to the same number agree to many digits."""
    torch.manual_seed(0)
    previous = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(previous)


def make_world_model(**options) -> WorldModel:
    """Small networks with no zero layer, so that every gradient flows from the first update on."""
    sizes = {"latent_dim": 16, "mlp_dim": 12, "encoder_dim": 10, "num_dynamics": 2, "simnorm_dim": 4, "num_bins": 21}
    world_model = WorldModel(OBSERVATION_DIM, ACTION_DIM, **(sizes | options))
    with torch.no_grad():
        for parameter in world_model.parameters():
            parameter.add_(0.3 * torch.randn_like(parameter))
    return world_model


def make_updater(world_model: WorldModel | None = None, *, tau: float = TAU, lr: float = LR, **options) -> Updater:
    world_model = make_world_model() if world_model is None else world_model
    loss = EfficientTDMPCLoss(world_model, discount=0.9, scale_tau=tau, ignore_termination=True, **options)
    return Updater(loss, lr=lr, grad_clip_norm=CLIP, tau=tau)


def make_batch(num_slices: int = 8) -> TensorDict:
    """Slices whose planner targets are sharp, so that the KL spreads by more than the running scale's floor of 1."""
    batch = random_slices(OBSERVATION_DIM, ACTION_DIM, num_slices=num_slices, terminated=True)
    batch["plan", "scale"] = 0.05 * batch["plan", "scale"]
    return batch


def seeded_step(updater: Updater, batch: TensorDict, *, seed: int = 7, distill: bool = True) -> TensorDict:
    torch.manual_seed(seed)
    return updater.step(batch, distill=distill)


def snapshot(updater: Updater) -> dict[str, Tensor]:
    """Copies of all weights, target weights and buffers."""
    state = {f"loss.{name}": value.clone() for name, value in updater.loss.state_dict().items()}
    world_model = updater.loss.world_model.state_dict()
    return state | {f"world_model.{name}": value.clone() for name, value in world_model.items()}


def targets_and_values(updater: Updater) -> list[tuple[Tensor, Tensor]]:
    """Each target weight of the value heads beside the weight that it follows."""
    targets = updater.loss.target_value_params.flatten_keys(".").items()
    values = dict(updater.loss.world_model.value_head.named_parameters())
    return [(target, values[name]) for name, target in targets]


def model_parameters(updater: Updater) -> list[Tensor]:
    return [parameter for part in ("encoder", "heads", "values") for parameter in updater.parts[part]]


def applied_gradients(updater: Updater) -> dict[str, list[list[Tensor]]]:
    """Fills up with the gradients of model and policy that the optimiser is handed at every update, by parameter."""
    recorded: dict[str, list[list[Tensor]]] = {"model": [], "policy": []}

    def record(optimizer, args, kwargs):
        gradients = {
            flat.untyped_storage().data_ptr(): flat.grad for group in optimizer.param_groups for flat in group["params"]
        }

        def of(parameter: Tensor) -> Tensor | None:
            gradient, begin = gradients[parameter.untyped_storage().data_ptr()], parameter.storage_offset()
            return gradient if gradient is None else gradient[begin : begin + parameter.numel()].view_as(parameter)

        for name, parameters in (("model", model_parameters(updater)), ("policy", updater.parts["policy"])):
            found = [of(parameter) for parameter in parameters]
            if any(gradient is not None for gradient in found):
                recorded[name].append([gradient.clone() for gradient in found])

    updater.optimizer.register_step_pre_hook(record)
    return recorded


def numbers(state: dict[str, Any]) -> dict[str, Any]:
    """Copies of all tensors as lists."""
    return tree_map_only(Tensor, Tensor.tolist, state)


def norm(gradients: list[Tensor]) -> Tensor:
    return torch.cat([gradient.flatten() for gradient in gradients]).norm()


@pytest.mark.parametrize("termination", [False, True])
def test_one_update_changes_every_weight(termination):
    updater = make_updater(make_world_model(termination=termination))
    before = snapshot(updater)
    seeded_step(updater, make_batch())
    for name, parameter in updater.loss.world_model.named_parameters():
        assert not torch.equal(parameter, before[f"world_model.{name}"]), name


def test_the_planner_s_world_model_and_the_loss_stay_one_set_of_weights():
    updater = make_updater()
    seeded_step(updater, make_batch())
    online = {p.data_ptr() for p in updater.loss.world_model.parameters()}
    assert online == {p.data_ptr() for part in updater.parts.values() for p in part}


def test_the_parts_share_the_weights_out_between_them():
    updater = make_updater(make_world_model(termination=True))
    parts = {name: {id(p) for p in part} for name, part in updater.parts.items()}
    world_model = updater.loss.world_model
    assert sum(map(len, parts.values())) == len(set.union(*parts.values()))
    assert set.union(*parts.values()) == {id(p) for p in world_model.parameters()}
    for name, module in (
        ("encoder", world_model.encoder),
        ("values", world_model.value_head),
        ("policy", world_model.policy),
    ):
        assert parts[name] == {id(p) for p in module.parameters()}


class Decoder(nn.Module):
    """A term with networks of its own, one of which is the world model's."""

    def __init__(self, world_model: WorldModel) -> None:
        super().__init__()
        self.encoder, self.decoder, self.scale = world_model.encoder, nn.Linear(16, 5), nn.Parameter(torch.ones(()))

    def forward(self, world_model, slices, rollout):
        return (self.scale * self.decoder(rollout.predicted[1:])).square().mean((1, -1))


def test_every_parameter_of_the_loss_is_trained_once():
    world_model = make_world_model(termination=True)
    updater = make_updater(world_model, extra_terms=[Term("decoder", Decoder(world_model))])
    trained = [id(parameter) for part in updater.parts.values() for parameter in part]
    assert len(trained) == len(set(trained))
    assert set(trained) == {id(parameter) for parameter in updater.loss.parameters()}
    before = {name: parameter.clone() for name, parameter in updater.loss.named_parameters()}
    seeded_step(updater, make_batch())
    assert [name for name, p in updater.loss.named_parameters() if torch.equal(p, before[name])] == []


def test_a_frozen_parameter_stays_as_it_is():
    world_model = make_world_model()
    term = Term("decoder", Decoder(world_model))
    term.function.decoder.requires_grad_(False)
    before = term.function.decoder.weight.clone()
    updater = make_updater(world_model, extra_terms=[term])
    seeded_step(updater, make_batch())
    assert torch.equal(term.function.decoder.weight, before)
    assert term.function.scale != 1


@pytest.mark.parametrize("frozen", [["encoder"], ["value_head"], ["policy"], ["encoder", "dynamics", "value_head"]])
def test_a_wholly_frozen_network_stays_and_the_others_learn(frozen):
    world_model = make_world_model()
    for name in frozen:
        getattr(world_model, name).requires_grad_(False)
    updater = make_updater(world_model)
    before = {name: parameter.clone() for name, parameter in world_model.named_parameters()}
    seeded_step(updater, make_batch())
    moved = {name for name, p in world_model.named_parameters() if not torch.equal(p, before[name])}
    assert moved == {name for name, p in world_model.named_parameters() if p.requires_grad}
    assert updater.skipped == 0


def test_the_target_of_a_frozen_weight_stays_and_the_others_follow():
    updater = make_updater()
    names = [name for name, _ in updater.loss.value_params.flatten_keys(".").items()]
    values = dict(updater.loss.value_params.flatten_keys(".").items())
    values[names[0]].requires_grad_(False)
    updater = Updater(updater.loss, tau=0.5)
    targets = {name: target.clone() for name, target in updater.loss.target_value_params.flatten_keys(".").items()}
    seeded_step(updater, make_batch())
    followed = dict(updater.loss.target_value_params.flatten_keys(".").items())
    assert torch.equal(followed[names[0]], targets[names[0]])
    for name in names[1:]:
        torch.testing.assert_close(followed[name], torch.lerp(targets[name], values[name].detach(), 0.5))


def test_pretraining_with_the_policy_alone_to_train_changes_nothing():
    world_model = make_world_model().requires_grad_(False)
    world_model.policy.requires_grad_(True)
    updater = make_updater(world_model)
    before = [parameter.clone() for parameter in world_model.parameters()]
    updater.step(make_batch(), distill=False)
    assert all(torch.equal(*pair) for pair in zip(world_model.parameters(), before, strict=True))
    seeded_step(updater, make_batch())
    moved = [not torch.equal(*pair) for pair in zip(world_model.parameters(), before, strict=True)]
    assert moved == [parameter.requires_grad for parameter in world_model.parameters()]


def test_a_loss_with_nothing_to_train_is_refused():
    with pytest.raises(ValueError, match=r"^the loss has no parameter to train; all of them are frozen"):
        make_updater(make_world_model().requires_grad_(False))


def test_a_parameter_of_another_dtype_is_refused_with_the_network_that_has_it():
    world_model = make_world_model()
    term = Term("decoder", Decoder(world_model))
    term.function.decoder.float()
    with pytest.raises(ValueError, match=r"^all parameters of the loss must be torch.float64 on cpu as its"):
        make_updater(world_model, extra_terms=[term])


def test_a_parameter_that_no_term_reads_is_an_error_that_names_it():
    world_model = make_world_model()
    term = Term("decoder", Decoder(world_model))
    term.function.forgotten = nn.Linear(2, 2)
    updater = make_updater(world_model, extra_terms=[term])
    with pytest.raises(RuntimeError, match=r"^no term sends a gradient into decoder.forgotten.weight, decoder"):
        seeded_step(updater, make_batch())


def test_every_parameter_begins_where_memory_of_its_own_could():
    updater = Updater(EfficientTDMPCLoss(make_world_model().float(), discount=0.9))
    assert all(parameter.data_ptr() % 64 == 0 for part in updater.parts.values() for parameter in part)


@pytest.mark.parametrize(
    "move",
    [
        lambda loss: loss.to(torch.float32),
        lambda loss: setattr(loss.world_model.encoder.output.weight, "data", torch.zeros(16, 10)),
    ],
    ids=["another dtype", "one layer"],
)
def test_parameters_with_other_memory_are_an_error_and_not_lost_updates(move):
    updater = make_updater()
    move(updater.loss)
    with pytest.raises(RuntimeError, match=r"^the loss's parameters have been moved; make a new Updater"):
        updater.step(make_batch())


@pytest.mark.parametrize("frozen_first", [True, False])
def test_what_is_frozen_or_thawed_after_the_updater_was_made_needs_a_new_one(frozen_first):
    world_model = make_world_model()
    world_model.encoder.requires_grad_(not frozen_first)
    updater = make_updater(world_model)
    seeded_step(updater, make_batch())
    world_model.encoder.requires_grad_(frozen_first)
    with pytest.raises(RuntimeError, match=r"^parameters of the loss were frozen, .*; make a new Updater"):
        updater.step(make_batch())
    before = next(world_model.encoder.parameters()).clone()
    seeded_step(make_updater(world_model), make_batch())
    assert torch.equal(next(world_model.encoder.parameters()), before) != frozen_first


def test_a_copied_updater_is_refused_too():
    updater = copy.deepcopy(make_updater())
    with pytest.raises(RuntimeError, match="been moved"):
        updater.step(make_batch())


def test_a_new_updater_takes_over_the_weights_of_an_old_one():
    first = make_updater()
    seeded_step(first, make_batch())
    second = Updater(first.loss, lr=LR, tau=TAU)
    before = snapshot(second)
    seeded_step(second, make_batch())
    assert not torch.equal(
        snapshot(second)["world_model.encoder.output.weight"], before["loss.encoder_params.output.weight"]
    )
    with pytest.raises(RuntimeError, match="been moved"):
        seeded_step(first, make_batch())


def test_each_update_counts_as_one_version_whether_it_distils_or_not():
    updater = make_updater()
    assert updater.updates == 0
    for number, distill in enumerate((False, True, True), start=1):
        seeded_step(updater, make_batch(), distill=distill)
        assert updater.updates == int(updater.loss.world_model.version) == number


def test_the_targets_move_by_tau_towards_the_new_values_after_each_update():
    updater = make_updater()
    for _ in range(3):
        before = [target.clone() for target, _ in targets_and_values(updater)]
        seeded_step(updater, make_batch())
        for old, (target, value) in zip(before, targets_and_values(updater), strict=True):
            torch.testing.assert_close(target, (1 - TAU) * old + TAU * value, rtol=1e-12, atol=1e-14)
            assert not torch.equal(target, old)


def test_the_targets_that_a_term_of_one_s_own_reads_move_too():
    def term(world_model, slices, rollout):
        return (slices.action.square().sum(-1) * next(iter(rollout.targets["encoder"].values())).mean()).detach()

    networks = ("encoder", "dynamics")
    world_model = make_world_model()
    world_model.encoder.requires_grad_(True)
    next(world_model.dynamics.parameters()).requires_grad_(False)
    updater = make_updater(world_model, extra_terms=[Term("mine", term, networks=networks, targets=networks)])
    loss = updater.loss
    followed = {
        name: (
            getattr(loss, f"target_{name}_params").flatten_keys("."),
            getattr(loss, f"{name}_params").flatten_keys("."),
        )
        for name in networks
    }
    for _ in range(3):
        before = {name: targets.clone() for name, (targets, _) in followed.items()}
        seeded_step(updater, make_batch())
        for name, (targets, leaders) in followed.items():
            for key, leader in leaders.items():
                expected = torch.lerp(before[name][key], leader.detach(), TAU)
                torch.testing.assert_close(targets[key], expected, rtol=1e-12, atol=1e-14)
                assert torch.equal(targets[key], before[name][key]) != leader.requires_grad
    targets = loss.targets()["encoder"]
    assert all(targets[key].equal(value) for key, value in followed["encoder"][0].items())
    kept = followed["encoder"][0].clone()
    Updater(loss)  # leaves them where they are
    assert all(loss.targets()["encoder"][key].equal(value) for key, value in kept.items())


@pytest.mark.parametrize("kind", [EfficientTDMPCModelLoss, EfficientTDMPCPolicyLoss])
def test_a_part_of_the_loss_can_be_trained_alone(kind):
    loss = kind(make_world_model(termination=True))
    updater = Updater(loss)
    before = {name: value.clone() for name, value in loss.named_parameters()}
    seeded_step(updater, make_batch())
    assert all(not torch.equal(value, before[name]) for name, value in loss.named_parameters())


def test_without_a_word_on_distillation_the_loss_decides():
    loss = EfficientTDMPCLoss(make_world_model(), discount=0.9, ignore_termination=True)
    updater = Updater(loss)
    loss.distill = False
    assert "loss_policy" not in updater.step(make_batch())
    assert not loss.distill
    assert "loss_policy" in updater.step(make_batch(), distill=True)
    assert "loss_policy" in updater.step(make_batch())


def test_the_returned_numbers_are_detached_finite_scalars():
    out = seeded_step(make_updater(), make_batch())
    assert {"loss_consistency", "loss_reward", "loss_value", "loss_policy"} <= set(out.keys())
    assert {"grad_norm_model", "grad_norm_policy", "kl_scale"} <= set(out.keys())
    for name, value in out.items():
        assert value.shape == (), name
        assert not value.requires_grad, name
        assert value.isfinite(), name


def test_the_loss_decides_whether_errors_are_averaged_or_summed():
    batch, world_model, metrics = make_batch(), make_world_model(), []
    for reduction in ("mean", "sum"):
        updater = make_updater(copy.deepcopy(world_model), reduction=reduction)
        torch.manual_seed(1)  # dropout
        metrics.append(updater.step(batch.clone()))
    mean, total = metrics
    for name in ("loss_reward", "loss_value", "loss_policy", "grad_norm_model", "grad_norm_policy"):
        torch.testing.assert_close(total[name], batch.numel() * mean[name])


def test_a_loss_that_reduces_nothing_is_refused():
    with pytest.raises(ValueError, match=r"^the loss must reduce its terms to scalars, got reduction='none'; take"):
        make_updater(reduction="none")


@pytest.mark.parametrize(
    ("huge", "clipped"),
    [
        ({"consistency_coef": 1e8}, {"model"}),
        ({"policy_coef": 1e8}, {"policy"}),
        ({"consistency_coef": 1e8, "policy_coef": 1e8}, {"model", "policy"}),
        ({}, set()),
    ],
    ids=["huge model gradient", "huge policy gradient", "both", "neither"],
)
def test_the_gradients_of_model_and_policy_are_clipped_apart(huge, clipped):
    world_model, batch = make_world_model(), make_batch()
    small = {"consistency_coef": 1.0, "policy_coef": 1e-2}
    reference = seeded_step(make_updater(copy.deepcopy(world_model), **small), batch)
    updater = make_updater(world_model, **(small | huge))
    recorded = applied_gradients(updater)
    out = seeded_step(updater, batch)
    for name in ("model", "policy"):
        before_clipping = out[f"grad_norm_{name}"]
        after_clipping = norm(recorded[name][0])
        if name in clipped:
            assert before_clipping > 1000 * CLIP
            torch.testing.assert_close(after_clipping, torch.tensor(CLIP), rtol=1e-4, atol=0)
        else:  # not touched by the other's size
            assert 0 < before_clipping < CLIP
            torch.testing.assert_close(after_clipping, before_clipping, rtol=1e-12, atol=0)
            torch.testing.assert_close(before_clipping, reference[f"grad_norm_{name}"], rtol=1e-12, atol=0)


@pytest.mark.parametrize(
    ("part", "rate", "epsilon"), [("encoder", 0.3 * LR, 1e-8), ("model", LR, 1e-8), ("policy", LR, 1e-5)]
)
def test_the_first_step_is_adam_s_with_the_learning_rate_and_epsilon_of_the_part(part, rate, epsilon):
    # From rest, Adam moves by rate * g / (|g| + epsilon).
    world_model = make_world_model()
    updater = make_updater(world_model, policy_coef=1e-4)  # small gradients, so that the policy's epsilon shows
    parameters = updater.parts["policy"] if part == "policy" else model_parameters(updater)
    encoder = {id(p) for p in world_model.encoder.parameters()}
    before = [parameter.detach().clone() for parameter in parameters]
    recorded = applied_gradients(updater)
    seeded_step(updater, make_batch())
    gradients = recorded["policy" if part == "policy" else "model"][0]
    checked = 0
    for parameter, old, gradient in zip(parameters, before, gradients, strict=True):
        if part == "policy" or (id(parameter) in encoder) == (part == "encoder"):
            torch.testing.assert_close(parameter.detach(), old - rate * gradient / (gradient.abs() + epsilon))
            checked += 1
    assert checked > 0
    if part == "policy":
        assert torch.cat([gradient.flatten() for gradient in gradients]).abs().median() < 1e-4


def test_without_distillation_the_policy_and_its_running_scale_stay_as_they_are():
    updater, batch = make_updater(), make_batch()
    before = snapshot(updater)
    for _ in range(3):
        out = seeded_step(updater, batch, distill=False)
        assert not {"loss_policy", "policy_kl", "grad_norm_policy"} & set(out.keys())
    after = snapshot(updater)
    policy = [name for name in before if ".policy" in name or "kl_scale" in name]
    assert any("kl_scale" in name for name in policy)
    assert any("policy" in name for name in policy)
    assert all(torch.equal(after[name], before[name]) for name in policy)
    trained = {id(flat) for flat in updater.optimizer.state}
    assert [all(id(flat) in trained for flat in group["params"]) for group in updater.optimizer.param_groups] == [
        True,
        True,
        False,
    ]
    assert not torch.equal(after["world_model.encoder.output.weight"], before["world_model.encoder.output.weight"])


def test_distillation_can_begin_after_pretraining():
    updater, batch = make_updater(), make_batch()
    seeded_step(updater, batch, distill=False)
    before = snapshot(updater)
    out = seeded_step(updater, batch)
    assert {"loss_policy", "policy_kl", "grad_norm_policy"} <= set(out.keys())
    assert updater.loss.kl_scale > before["loss.kl_scale"]
    for name, parameter in updater.loss.world_model.policy.named_parameters():
        assert not torch.equal(parameter, before[f"world_model.policy.{name}"]), name


def test_a_policy_target_leaves_the_world_model_and_a_reward_leaves_the_policy_alone():
    world_model, batch = make_world_model(), make_batch()
    other_targets, other_rewards = batch.clone(), batch.clone()
    other_targets["plan", "loc"] = -batch["plan", "loc"]
    other_rewards["next", "reward"] = 5 - batch["next", "reward"]
    trained = []
    for data in (batch, other_targets, other_rewards):
        updater = make_updater(copy.deepcopy(world_model))
        seeded_step(updater, data)
        trained.append(dict(updater.loss.world_model.named_parameters()))
    for name, parameter in trained[0].items():
        if name.startswith("policy"):
            assert torch.equal(parameter, trained[2][name]), name
        else:
            assert torch.equal(parameter, trained[1][name]), name
    assert not all(torch.equal(trained[0][name], trained[1][name]) for name in trained[0])
    assert not all(torch.equal(trained[0][name], trained[2][name]) for name in trained[0])


def test_one_backward_pass_equals_the_model_step_and_then_the_policy_step_on_the_old_latents():
    world_model = make_world_model()
    updater, separate = make_updater(world_model), SeparateSteps(copy.deepcopy(world_model))
    for seed in range(3):
        batch = make_batch()
        seeded_step(updater, batch, seed=seed)
        torch.manual_seed(seed)
        separate.step(batch)
    combined = snapshot(updater)
    for name, value in separate.loss.world_model.state_dict().items():
        if name != "version":
            torch.testing.assert_close(combined[f"world_model.{name}"], value, rtol=1e-8, atol=1e-10, msg=name)
    torch.testing.assert_close(updater.loss.kl_scale, separate.loss.kl_scale, rtol=1e-10, atol=0)
    assert updater.loss.kl_scale > 1.01  # or the scale would have been tested at its floor only


class SeparateSteps:
    """The same update as two backward passes and two optimisers, one after the other."""

    def __init__(self, world_model: WorldModel) -> None:
        self.loss = EfficientTDMPCLoss(world_model, discount=0.9, distill=False, ignore_termination=True)
        self.target_update = SoftUpdate(self.loss, tau=TAU)
        encoder = list(world_model.encoder.parameters())
        heads = [*world_model.dynamics.parameters(), *world_model.reward_head.parameters()]
        heads += world_model.value_head.parameters()
        self.model_parameters = encoder + heads
        self.policy_parameters = list(world_model.policy.parameters())
        self.model_optimizer = torch.optim.Adam([{"params": encoder, "lr": 0.3 * LR}, {"params": heads}], lr=LR)
        self.policy_optimizer = torch.optim.Adam(self.policy_parameters, lr=LR, eps=1e-5)

    def step(self, batch: TensorDict) -> None:
        world_model = self.loss.world_model
        with torch.no_grad():  # before the model step
            latents = [world_model.encode(batch["observation"][:, 0]).expand(2, -1, -1)]
            for k in range(batch.shape[1] - 1):
                latents.append(world_model.next(latents[-1], batch["action"][:, k]))
            latents = torch.stack(latents)

        out = self.loss(batch)
        self.model_optimizer.zero_grad()
        sum(value for name, value in out.items() if name.startswith("loss_")).backward()
        torch.nn.utils.clip_grad_norm_(self.model_parameters, CLIP)
        self.model_optimizer.step()

        mean, log_std = world_model.policy(latents)
        policy = torch.distributions.Normal(mean, log_std.exp())
        plan = [batch["plan", name].transpose(0, 1).unsqueeze(1) for name in ("loc", "scale")]
        kl = torch.distributions.kl_divergence(policy, torch.distributions.Normal(*plan)).mean(-1)
        self.loss.kl_scale.copy_(updated_scale(self.loss.kl_scale, kl[0, 0].detach(), TAU))  # alike for all heads
        term = kl / self.loss.kl_scale - 1e-4 * ACTION_DIM * policy.entropy().sum(-1)
        weights = 0.5 ** torch.arange(len(term), dtype=term.dtype)
        self.policy_optimizer.zero_grad()
        (weights * term.mean((1, 2))).mean().backward()
        torch.nn.utils.clip_grad_norm_(self.policy_parameters, CLIP)
        self.policy_optimizer.step()
        self.target_update.step()


def test_gradients_do_not_accumulate_over_updates():
    # A rate that moves nothing, so every gradient is the first again.
    updater, batch = make_updater(tau=0.0, lr=1e-300), make_batch()
    weights = [parameter.clone() for parameter in updater.loss.world_model.parameters()]
    recorded = applied_gradients(updater)
    for distill in (True, True, False, True):
        seeded_step(updater, batch, distill=distill)
        assert all(parameter.grad is None for parameter in updater.loss.world_model.parameters())
    assert all(map(torch.equal, weights, updater.loss.world_model.parameters()))
    assert (len(recorded["model"]), len(recorded["policy"])) == (4, 3)
    for first, *others in recorded.values():
        assert norm(first) > 0
        for other in others:
            assert all(torch.equal(a, b) for a, b in zip(first, other, strict=True))


@pytest.mark.parametrize(("argument", "value"), [("lr_halved_after", 100), ("average_decay", 0.9)])
def test_a_state_that_lacks_what_this_updater_needs_is_refused_before_anything_changes(argument, value):
    def make(**options):
        return Updater(EfficientTDMPCLoss(WorldModel(3, 2, latent_dim=16, mlp_dim=16), discount=0.99), **options)

    plain, other = make(), make(**{argument: value})
    plain.step(random_slices(3, 2))
    with pytest.raises(ValueError, match=f"is of an updater without {argument}; build this one without it, too"):
        other.load_state_dict(plain.state_dict())
    assert not other.optimizer.state_dict()["state"]


@pytest.mark.parametrize("name", ["exp_avg", "exp_avg_sq"])
@pytest.mark.parametrize("change", [lambda x: x[:3], lambda x: x.clone().index_fill_(0, torch.tensor(2), torch.nan)])
def test_a_state_whose_moments_do_not_fit_is_refused_before_anything_changes(name, change):
    updater, other = make_updater(), make_updater()
    updater.step(make_batch())
    state = copy.deepcopy(updater.state_dict())
    state["optimizer"]["state"][1][name] = change(state["optimizer"]["state"][1][name])
    with pytest.raises(ValueError, match=rf"^the optimiser's {name} has another size than the weights, or is not"):
        other.load_state_dict(state)
    assert not other.optimizer.state_dict()["state"]


def test_training_goes_on_bit_for_bit_from_a_saved_state():
    original, batches = make_updater(), [make_batch() for _ in range(5)]
    for seed, batch in enumerate(batches[:3]):
        seeded_step(original, batch, seed=seed)
    file = io.BytesIO()
    parts = {"world_model": original.loss.world_model, "loss": original.loss, "optimisers": original}
    torch.save({name: part.state_dict() for name, part in parts.items()}, file)
    file.seek(0)
    content = torch.load(file, weights_only=True)

    restored = make_updater()
    assert not torch.equal(restored.parts["policy"][0], original.parts["policy"][0])
    restored.loss.world_model.load_state_dict(content["world_model"])
    restored.loss.load_state_dict(content["loss"])
    restored.load_state_dict(content["optimisers"])
    assert restored.updates == 3
    for seed, batch in enumerate(batches[3:]):
        first, second = (seeded_step(updater, batch, seed=seed) for updater in (original, restored))
        assert all(torch.equal(first[name], second[name]) for name in first.keys())
    before, after = snapshot(original), snapshot(restored)
    assert before.keys() == after.keys()
    assert [name for name in before if not torch.equal(before[name], after[name])] == []


def test_averaged_weights_follow_those_that_are_trained():
    world_model = make_world_model(normalize_observations=True)
    updater = Updater(EfficientTDMPCLoss(world_model, discount=0.9, ignore_termination=True), average_decay=0.75)
    averaged = updater.acting_model
    expected = {name: parameter.detach().clone() for name, parameter in world_model.named_parameters()}
    for seed in range(3):
        seeded_step(updater, make_batch(), seed=seed)
        for name, parameter in world_model.named_parameters():
            expected[name] = 0.75 * expected[name] + 0.25 * parameter.detach()
    for name, parameter in averaged.named_parameters():
        torch.testing.assert_close(parameter, expected[name])
        assert not parameter.requires_grad
        assert not torch.equal(parameter, world_model.get_parameter(name))
    assert averaged.version == world_model.version == 3
    assert averaged.encoder.norm.batches == 3
    assert torch.equal(averaged.encoder.norm.mean, world_model.encoder.norm.mean)
    other = make_world_model(normalize_observations=True)
    again = Updater(EfficientTDMPCLoss(other, discount=0.9, ignore_termination=True), average_decay=0.75)
    again.load_state_dict(updater.state_dict())
    assert all(map(torch.equal, again.acting_model.parameters(), averaged.parameters()))


def test_without_an_average_the_model_that_is_trained_acts():
    updater = make_updater()
    assert updater.acting_model is updater.loss.world_model
    with pytest.raises(ValueError, match=r"^average_decay must be in \[0, 1\), got 1.0.$"):
        Updater(updater.loss, average_decay=1.0)


def test_learning_rates_fall_with_the_updates_and_go_on():
    def make() -> Updater:
        return Updater(
            EfficientTDMPCLoss(make_world_model(), discount=0.9, ignore_termination=True),
            lr=0.01,
            encoder_lr_scale=0.3,
            lr_halved_after=2,
        )

    def rates(updater: Updater) -> list[float]:
        return [group["lr"] for group in updater.optimizer.param_groups]

    updater = make()
    for updates, rate in enumerate((0.01, 0.01 / 1.5, 0.005, 0.004)):
        assert rates(updater) == pytest.approx([0.3 * rate, rate, rate])
        if updates == 3:
            break
        seeded_step(updater, make_batch(), seed=updates)
    again = make()
    again.load_state_dict(updater.state_dict())
    assert rates(again) == rates(updater)
    for one in (updater, again):
        seeded_step(one, make_batch(), seed=9)
    assert rates(again) == rates(updater) == pytest.approx([0.3 * 0.01 / 3, 0.01 / 3, 0.01 / 3])


def test_the_first_update_has_the_whole_rate_and_the_second_a_smaller_one():
    world_model, batch = make_world_model(), make_batch()
    steady, falling = (
        Updater(
            EfficientTDMPCLoss(copy.deepcopy(world_model), discount=0.9, ignore_termination=True), lr_halved_after=after
        )
        for after in (None, 1)
    )
    falling.loss.target_value_params.update_(steady.loss.target_value_params)
    for same in (True, False):
        for updater in (steady, falling):
            seeded_step(updater, batch.clone())
        first, second = (updater.loss.world_model.parameters() for updater in (steady, falling))
        assert all(map(torch.equal, first, second)) == same


@pytest.mark.parametrize("after", [0, -3.0, float("nan")])
def test_a_schedule_that_makes_no_sense_is_refused(after):
    with pytest.raises(ValueError, match=r"^lr_halved_after must be positive or None, got "):
        Updater(EfficientTDMPCLoss(make_world_model(), discount=0.9, ignore_termination=True), lr_halved_after=after)


def test_the_caller_s_batch_is_left_as_it_is():
    batch = make_batch()
    before = batch.clone()
    seeded_step(make_updater(), batch)
    assert (batch == before).all()
    assert set(batch.keys(True, True)) == set(before.keys(True, True))


@pytest.mark.parametrize("poison", [("next", "reward"), "observation"])
@pytest.mark.parametrize("distill", [True, False])
def test_an_update_without_a_finite_gradient_changes_nothing_but_the_count(poison, distill):
    updater = Updater(EfficientTDMPCLoss(WorldModel(3, 2, latent_dim=16, mlp_dim=16), discount=0.99))
    good, bad = (random_slices(3, 2, num_slices=4) for _ in range(2))
    bad[poison][0] = torch.nan
    updater.step(good, distill=distill)
    weights = [parameter.clone() for parameter in updater.loss.world_model.parameters()]
    optimiser = numbers(updater.optimizer.state_dict())
    for number in (1, 2):
        updater.step(bad, distill=distill)
        assert (int(updater.skipped), int(updater.skipped_in_a_row)) == (number, number)
    assert all(map(torch.equal, weights, updater.loss.world_model.parameters()))
    assert numbers(updater.optimizer.state_dict()) == optimiser
    assert updater.loss.kl_scale.isfinite()
    metrics = updater.step(good, distill=distill)
    assert metrics["loss_reward"].isfinite()
    assert (int(updater.skipped), int(updater.skipped_in_a_row)) == (2, 0)
    assert not any(map(torch.equal, weights[:1], updater.loss.world_model.parameters()))


def test_skipped_updates_are_counted_on_from_a_saved_state():
    updater, restored, batch = make_updater(), make_updater(), make_batch()
    batch["next", "reward"][0] = torch.nan
    for _ in range(3):
        updater.step(batch)
    restored.load_state_dict(updater.state_dict())
    for skipped in (3, 4):
        assert (int(restored.skipped), int(restored.skipped_in_a_row)) == (skipped, skipped)
        restored.step(batch)


def test_a_saved_state_does_not_go_on_counting():
    updater, batch = make_updater(), make_batch()
    state = updater.state_dict()
    batch["next", "reward"][0] = torch.nan
    updater.step(batch)
    assert (int(state["skipped"]), int(state["skipped_in_a_row"])) == (0, 0)


def test_a_policy_gradient_that_is_not_finite_stops_the_policy_alone():
    world_model, batch = make_world_model(), make_batch()
    updater, usual = make_updater(world_model), make_updater(copy.deepcopy(world_model))
    before = {name: weight.clone() for name, weight in world_model.named_parameters()}
    bad = batch.clone()
    bad["plan", "loc"][0] = torch.nan
    seeded_step(updater, bad)
    seeded_step(usual, batch)
    usual_weights = dict(usual.loss.world_model.named_parameters())
    for name, weight in world_model.named_parameters():
        assert torch.equal(weight, before[name] if name.startswith("policy") else usual_weights[name]), name
    for (target, _), (expected, _) in zip(targets_and_values(updater), targets_and_values(usual), strict=True):
        assert torch.equal(target, expected)
    assert updater.loss.kl_scale.isfinite()
    seeded_step(updater, bad)
    assert (int(updater.skipped), int(updater.skipped_in_a_row)) == (2, 2)
    seeded_step(updater, batch)
    assert (int(updater.skipped), int(updater.skipped_in_a_row)) == (2, 0)
    assert not any(
        torch.equal(weight, before[f"policy.{name}"]) for name, weight in world_model.policy.named_parameters()
    )


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ({"lr": 0.0}, "lr must be positive, got 0.0."),
        ({"grad_clip_norm": -1.0}, "grad_clip_norm must be positive, got -1.0."),
        ({"encoder_lr_scale": -0.1}, "encoder_lr_scale must not be negative, got -0.1."),
        ({"tau": 1.5}, "tau must be in [0, 1], got 1.5."),
    ],
    ids=lambda case: next(iter(case)) if isinstance(case, dict) else "",
)
def test_an_option_out_of_range_is_refused(option, message):
    loss = EfficientTDMPCLoss(make_world_model(), discount=0.9)
    with pytest.raises(ValueError) as caught:
        Updater(loss, **option)
    assert str(caught.value) == message


def test_warming_up_leaves_weights_scale_statistics_and_distillation_as_they_are(monkeypatch):
    monkeypatch.setattr("torchrl_etdmpc.training.updater.compile_call", lambda function, mode, keep: function)
    loss = EfficientTDMPCLoss(make_world_model(normalize_observations=True), discount=0.9, ignore_termination=True)
    updater = Updater(loss, compile_mode="default")
    loss.distill = False
    before = snapshot(updater)
    updater.warm_up(make_batch())
    assert not loss.distill
    for name, value in snapshot(updater).items():
        assert torch.equal(value, before[name]), name


def test_a_new_updater_leaves_the_targets_where_they_are():
    updater = make_updater()
    for _ in range(3):
        updater.step(make_batch())
    state = copy.deepcopy(updater.loss.state_dict())
    again = EfficientTDMPCLoss(make_world_model(), discount=0.9, ignore_termination=True)
    again.load_state_dict(state)
    for loss in (again, updater.loss):
        Updater(loss)
        assert all(torch.equal(value, state[name]) for name, value in loss.state_dict().items())
    targets = {name: value for name, value in state.items() if name.startswith("target_value")}
    assert targets
    assert not all(torch.equal(value, state[name.removeprefix("target_")]) for name, value in targets.items())


def test_a_state_with_a_schedule_needs_one_and_brings_its_rates():
    def make(lr, **options):
        loss = EfficientTDMPCLoss(make_world_model(), discount=0.9, ignore_termination=True)
        return Updater(loss, lr=lr, **options)

    updater = make(1e-3, lr_halved_after=2)
    for _ in range(2):
        updater.step(make_batch())
    state = copy.deepcopy(updater.state_dict())
    with pytest.raises(ValueError, match=r"^the state is of an updater with lr_halved_after; build this one with it"):
        make(1e-3).load_state_dict(state)
    other = make(5e-2, lr_halved_after=2)
    other.load_state_dict(state)
    for _ in range(2):
        for each in (updater, other):
            each.step(make_batch())
        assert [g["lr"] for g in other.optimizer.param_groups] == [g["lr"] for g in updater.optimizer.param_groups]
