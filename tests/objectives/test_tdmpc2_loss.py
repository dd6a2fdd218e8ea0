"""TD-MPC2's loss against the same written once more, head by head and step by step, on plain weights."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from typing import NamedTuple

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.objectives import SoftUpdate

from torchrl_etdmpc.modules import ActionValueWorldModel, WorldModel
from torchrl_etdmpc.objectives import (
    EfficientTDMPCLoss,
    EfficientTDMPCValueLoss,
    TDMPC2Loss,
    Term,
    action_value_target,
    latent_rollout,
    policy_value,
)
from torchrl_etdmpc.testing import random_slices

pytestmark = pytest.mark.usefixtures("double_precision")

O, A, B, T, V = 5, 3, 4, 3, 5  # noqa: E741
GAMMA, RHO = 0.9, 0.5


def make_model(**options) -> ActionValueWorldModel:
    sizes = {"latent_dim": 16, "mlp_dim": 12, "encoder_dim": 10, "simnorm_dim": 4, "num_bins": 21}
    model = ActionValueWorldModel(O, A, **(sizes | options))
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.3 * torch.randn_like(parameter))
    return model


def make_loss(model: ActionValueWorldModel | None = None, **options) -> TDMPC2Loss:
    options = {"discount": GAMMA, "ignore_termination": True} | options
    loss = TDMPC2Loss(make_model() if model is None else model, **options)
    SoftUpdate(loss, tau=0.01)
    for target in loss.target_value_params.buffers():
        target.data.add_(0.3 * torch.randn_like(target))
    return loss


class Draws(NamedTuple):
    """What a loss draws after a seed, in its order."""

    target_noise: Tensor
    target_heads: list[int]
    policy_noise: Tensor
    policy_heads: list[int]


def draws(heads: int = 1, seed: int = 7) -> Draws:
    torch.manual_seed(seed)
    return Draws(
        torch.randn_like(torch.empty(B, T, A).transpose(0, 1)),  # drawn in the layout of the batch
        torch.rand(V).argsort(descending=True)[:2].tolist(),
        torch.randn(1 + (T - 1) * heads, B, A),
        torch.rand(V).argsort(descending=True)[:2].tolist(),
    )


def evaluate(loss: TDMPC2Loss, batch: TensorDict, seed: int = 7) -> TensorDict:
    torch.manual_seed(seed)
    return loss(batch)


def network(weights: Mapping[str, Tensor], x: Tensor, member: int | None = None) -> Tensor:
    """Linear, LayerNorm, Mish, twice; then linear: one network, or one member of a stack of them."""

    def of(name: str) -> Tensor:
        return weights[name] if member is None else weights[name][member]

    for layer in ("hidden.0.", "hidden.1."):
        x = x @ of(layer + "weight") + of(layer + "bias")
        centred = x - x.mean(-1, keepdim=True)
        x = centred / (centred.pow(2).mean(-1, keepdim=True) + 1e-5).sqrt()
        x = x * of(layer + "norm_weight") + of(layer + "norm_bias")
        x = x * torch.tanh(torch.log1p(x.exp()))
    return x @ of("output.weight") + of("output.bias")


def scalar(logits: Tensor) -> Tensor:
    mean = (torch.softmax(logits, -1) * torch.linspace(-10, 10, 21)).sum(-1)
    return mean.sign() * (mean.abs().exp() - 1)


def cross_entropy(logits: Tensor, target: Tensor) -> Tensor:
    position = target.sign() * (1 + target.abs()).log() + 10  # bins one apart
    below = position.floor().long().clamp(0, 19)
    share = (position - below).unsqueeze(-1)
    logs = logits.log_softmax(-1)
    low, high = (logs.gather(-1, (below + i).unsqueeze(-1)) for i in (0, 1))
    return -((1 - share) * low + share * high).squeeze(-1)


def gaussian(model: ActionValueWorldModel, latent: Tensor) -> tuple[Tensor, Tensor]:
    mean, raw = network(dict(model.policy.named_parameters()), latent).chunk(2, -1)
    return mean, (-10 + 6 * (raw.tanh() + 1)).exp()


def plain_loss(loss: TDMPC2Loss, batch: TensorDict, drawn: Draws, *, squashed: bool = True, ends: bool = False):
    """The value and the policy term, and the mean target."""
    model: ActionValueWorldModel = loss.world_model
    heads = model.num_dynamics
    critic, targets = dict(model.value_head.named_parameters()), loss.targets()["value"]
    value, policy, all_targets = [], [], []
    start = model.encode(batch["observation"][:, 0])
    rolled = [start] * heads
    steps = []
    for k in range(T):
        action, reward = batch["action"][:, k], batch["next", "reward"][:, k, 0]
        with torch.no_grad():
            following = model.encode(batch["next", "observation"][:, k])
            mean, std = gaussian(model, following)
            rows = torch.cat([following, torch.tanh(mean + std * drawn.target_noise[k])], -1)
            least = torch.minimum(*(scalar(network(targets, rows, j)) for j in drawn.target_heads))
            if ends:
                least = least * (1 - batch["next", "terminated"][:, k, 0].double())
            target = reward + GAMMA * least
        all_targets.append(target)
        errors = [
            cross_entropy(network(critic, torch.cat([latent, action], -1), j), target)
            for latent in rolled
            for j in range(V)
        ]
        value.append(RHO**k * torch.stack(errors).mean())
        steps.append(rolled)
        rolled = [model.next(torch.stack(rolled), action)[i] for i in range(heads)]
    detached = {name: weight.detach() for name, weight in critic.items()}
    row, worth, entropies = 0, [], []
    for k, latents in enumerate(steps):
        of_step, entropy_of_step = [], []
        for latent in latents[:1] if k == 0 else latents:
            mean, std = gaussian(model, latent.detach())
            sample = mean + std * drawn.policy_noise[row]
            row += 1
            rows = torch.cat([latent.detach(), sample.tanh()], -1)
            of_step.append(sum(scalar(network(detached, rows, j)) for j in drawn.policy_heads) / 2)
            entropy = std.log() + 0.5 * math.log(2 * math.pi * math.e)
            if squashed:
                entropy = entropy + (1 - sample.tanh() ** 2).log()
            entropy_of_step.append(entropy.sum(-1))
        worth.append(torch.stack(of_step).mean(0))
        entropies.append(torch.stack(entropy_of_step).mean(0))
    low, high = (torch.quantile(worth[0].detach(), level) for level in (0.05, 0.95))
    scale = loss.q_scale.clone()
    if loss.training:
        scale = 0.99 * scale + 0.01 * max(float(high - low), 1.0)
    for k, (q, entropy) in enumerate(zip(worth, entropies, strict=True)):
        policy.append(-(RHO**k) * (q / scale + 1e-4 * A * entropy).mean())
    return 0.1 * sum(value) / T, sum(policy) / T, torch.stack(all_targets).mean()


@pytest.fixture
def batch(make_slices) -> TensorDict:
    slices = make_slices(B, T)
    slices["next", "reward"] = 5 * torch.randn(B, T, 1)
    return slices


@pytest.mark.parametrize("heads", [1, 2])
@pytest.mark.parametrize("squashed", [True, False])
def test_the_loss_equals_a_plain_reference(batch, heads, squashed):
    loss = make_loss(make_model(num_dynamics=heads), squashed_entropy=squashed).eval()
    value, policy, target = plain_loss(loss, batch, draws(heads), squashed=squashed)
    out = evaluate(loss, batch)
    torch.testing.assert_close(out["loss_value"], value)
    torch.testing.assert_close(out["loss_policy"], policy)
    torch.testing.assert_close(out["value_target"], target)


def test_the_gradient_of_every_network_is_that_of_the_plain_reference(batch):
    loss = make_loss(make_model(num_dynamics=2)).eval()
    names, parameters = zip(*loss.named_parameters(), strict=True)
    value, policy, _ = plain_loss(loss, batch, draws(2))
    out = evaluate(loss, batch)
    for actual, expected in ((out["loss_value"], value), (out["loss_policy"], policy)):
        pairs = (torch.autograd.grad(total, parameters, allow_unused=True) for total in (actual, expected))
        for name, *pair in zip(names, *pairs, strict=True):
            torch.testing.assert_close(*pair, msg=lambda text, name=name: f"{name}: {text}")


def test_gradients_stop_where_another_term_trains(batch):
    loss = make_loss()
    out = evaluate(loss, batch)
    trained = {"value": {"encoder", "dynamics", "value"}, "policy": {"policy"}}
    trained |= {"consistency": {"encoder", "dynamics"}, "reward": {"encoder", "dynamics", "reward"}}
    networks = loss.network_parameters()
    for term, names in trained.items():
        for name, parameters in networks.items():
            found = torch.autograd.grad(out[f"loss_{term}"], parameters, retain_graph=True, allow_unused=True)
            assert {gradient is not None for gradient in found} == {name in names}, (term, name)
    assert set(networks) == set().union(*trained.values())
    assert not any(target.requires_grad for target in loss.target_value_params.buffers())


def test_the_running_scale_follows_the_action_values_in_training_alone(batch):
    loss = make_loss(make_model(dropout=0.0))
    with torch.no_grad():
        loss.world_model.value_head.output.weight.mul_(20)  # values that spread by more than one
    _, policy, _ = plain_loss(loss, batch, draws())
    out = evaluate(loss, batch)
    torch.testing.assert_close(out["loss_policy"], policy)
    assert out["q_scale"] == loss.q_scale > 1.001
    before = loss.q_scale.clone()
    evaluate(loss.eval(), batch)
    assert loss.q_scale == before


def test_dropout_is_active_in_training_in_the_trained_heads_and_never_in_targets(batch):
    loss = make_loss(make_model(dropout=0.5))
    training, evaluation = evaluate(loss, batch), evaluate(loss.eval(), batch)
    assert training["value_target"] == evaluation["value_target"]
    assert training["value_error"] != evaluation["value_error"]
    assert training["policy_value"] != evaluation["policy_value"]


def test_the_policy_learns_from_values_with_dropout_and_is_evaluated_without(batch):
    # Both heads, and actions without spread: dropout alone is left to chance.
    loss = make_loss(make_model(dropout=0.5, num_values=2, log_std_min=-40.0, log_std_max=-39.0))
    first, second = (evaluate(loss, batch, seed)["policy_value"] for seed in (1, 2))
    assert (first - second).abs() > 1e-3
    loss.eval()
    torch.testing.assert_close(*(evaluate(loss, batch, seed)["policy_value"] for seed in (1, 2)))


@pytest.mark.parametrize("head", [True, False])
def test_a_replayed_termination_ends_the_bootstrap_where_the_task_terminates(batch, head):
    loss = make_loss(make_model(termination=head)).eval()
    value, _, target = plain_loss(loss, batch, draws(), ends=head)
    out = evaluate(loss, batch)
    torch.testing.assert_close(out["value_target"], target)
    torch.testing.assert_close(out["loss_value"], value)


def test_rows_that_terminate_without_a_head_are_refused(batch):
    with pytest.raises(ValueError, match="termination=True"):
        make_loss(ignore_termination=False)(batch)


def test_the_target_takes_the_least_of_the_drawn_heads():
    model = make_model()
    latent, reward = torch.rand(7, 16), torch.randn(7)

    def values(latent: Tensor, action: Tensor) -> Tensor:
        return torch.tensor([5.0, -3.0, 1.0, 4.0, 2.0]).expand(7, 5)

    target = action_value_target(
        model, values, latent, reward, None, torch.zeros(7, A), torch.tensor([0, 3]), discount=0.5
    )
    torch.testing.assert_close(target, reward + 0.5 * 4.0)


def test_every_pair_of_heads_is_drawn_alike(batch):
    loss = make_loss(make_model()).eval()
    with torch.no_grad():  # head j is worth symexp(bin 10 + j) whatever it is asked
        loss.world_model.value_head.output.weight.zero_()
        loss.world_model.value_head.output.bias.copy_(torch.eye(21)[10:15] * 1e3)
    values = loss.world_model.action_values(torch.rand(1, 16), torch.zeros(1, A))[0]
    means = {round(((values[i] + values[j]) / 2).item(), 6) for i in range(V) for j in range(i)}
    seen = [round(evaluate(loss, batch, seed)["policy_value"].item(), 6) for seed in range(60)]
    assert set(seen) == means


def test_the_entropy_is_that_of_the_squashed_actions_unless_the_published_one_is_asked_for():
    model = make_model()
    latent = torch.rand(1, 16)
    mean, log_std = model.policy.before_tanh(latent)
    noise = torch.randn(20_000, A)
    both = [
        policy_value(
            model, latent.expand(20_000, 16), noise, torch.tensor([0, 1]), squashed_entropy=squashed
        ).entropy.mean()
        for squashed in (True, False)
    ]
    base = torch.distributions.Normal(mean, log_std.exp())
    action = torch.distributions.TransformedDistribution(base, torch.distributions.TanhTransform(cache_size=1))
    with torch.no_grad():
        expected = -action.log_prob(action.sample((20_000,))).sum(-1).mean()
    torch.testing.assert_close(both[0].detach(), expected, rtol=0, atol=0.05)
    torch.testing.assert_close(both[1], base.entropy().sum())
    assert both[1] - both[0] > 0.2


def test_entropy_and_gradient_stay_finite_where_the_tanh_is_saturated():
    model = make_model()
    with torch.no_grad():
        model.policy.output.bias[:A] = 500.0
    result = policy_value(model, torch.rand(7, 16), torch.randn(7, A), torch.tensor([0, 1]))
    (result.entropy.mean() + result.value.mean()).backward()
    assert result.entropy.isfinite().all()
    assert (model.policy.output.bias.grad[:A] < 0).all()  # more entropy by less of the mean


def test_masked_steps_count_for_nothing(batch):
    loss = make_loss()
    masked, spoilt = batch.clone(), batch.clone()
    mask = torch.ones(B, T, dtype=torch.bool)
    mask[0, 1:] = False
    for each in (masked, spoilt):
        each["collector", "mask"] = mask
    for key in ("action", ("next", "observation"), ("next", "reward")):
        spoilt[key][0, 1:] = torch.nan
    outs = []
    for each in (masked, spoilt):
        twin = copy.deepcopy(loss)
        out = evaluate(twin, each)
        sum(out[key] for key in out.keys() if key.startswith("loss_")).backward()
        outs.append((out.detach(), [parameter.grad for parameter in twin.parameters()], twin.q_scale))
    for key, value in outs[0][0].items():
        torch.testing.assert_close(outs[1][0][key], value)
    torch.testing.assert_close(outs[1][1:], outs[0][1:])


def test_the_running_scale_is_that_of_the_slices_that_count(batch):
    loss = make_loss(make_model(dropout=0.0), scale_tau=1.0)
    with torch.no_grad():
        loss.world_model.value_head.output.weight.mul_(20)
    evaluate(loss, batch)
    assert loss.q_scale > 1.1
    batch["collector", "mask"] = (torch.arange(B) == 2).unsqueeze(-1).expand(B, T).clone()
    evaluate(loss, batch)
    assert loss.q_scale == 1  # one value has no spread


def test_a_prioritised_batch_gets_the_td_errors_of_its_slices(batch):
    model = make_model(num_dynamics=2)
    loss = make_loss(model).eval()
    batch["priority_weight"] = torch.ones(B, T)
    evaluate(loss, batch)
    read, drawn = loss.slices(batch), draws(2)
    rollout = latent_rollout(model, read)

    def target_values(latent, action):
        with loss.target_value_params.to_module(model.value_head):
            return model.action_values(latent, action)

    following, heads = rollout.encoded[1:], torch.tensor(drawn.target_heads)
    target = action_value_target(
        model, target_values, following, read.reward, None, drawn.target_noise, heads, loss.discount
    )
    values = model.action_values(rollout.predicted[:-1], read.action.unsqueeze(1).expand(-1, 2, -1, -1))  # [T, F, B, V]
    expected = (values - target[:, None, :, None]).abs().mean((0, 1, 3))
    torch.testing.assert_close(batch["td_error"], expected.unsqueeze(-1).expand(B, T))


def test_the_policy_term_can_be_left_out(batch):
    loss = make_loss()
    loss.distill = False
    assert "loss_policy" not in evaluate(loss, batch)
    loss.distill = True
    assert "loss_policy" in evaluate(loss, batch)


def test_a_reset_begins_the_count_of_updates_the_targets_and_the_running_scale_anew():
    loss = make_loss()
    loss.world_model.version.fill_(7)
    loss.q_scale.fill_(50)
    loss.reset_parameters_recursive()
    assert loss.world_model.version == 0
    assert loss.q_scale == 1
    torch.testing.assert_close(loss.target_value_params.data, loss.value_params.data)


def test_every_option_arrives():
    coefs = {"consistency_coef": 2.0, "reward_coef": 3.0, "value_coef": 4.0, "termination_coef": 5.0}
    options = coefs | {"policy_coef": 6.0, "entropy_coef": 0.5, "scale_tau": 0.25, "rho": 0.75, "reduction": "sum"}
    loss = make_loss(make_model(termination=True), **options)
    assert {name: getattr(loss, name) for name in options} == options


@pytest.mark.parametrize("cls", [EfficientTDMPCLoss, EfficientTDMPCValueLoss])
def test_a_critic_of_the_other_kind_is_refused(cls):
    with pytest.raises(TypeError, match="TDMPC2Loss"):
        cls(make_model(), discount=0.9)
    with pytest.raises(TypeError, match="ActionValueWorldModel"):
        TDMPC2Loss(WorldModel(O, A, latent_dim=16, mlp_dim=12), discount=0.9)
    for wrong in ({"discount": 0.0}, {"discount": 0.9, "scale_tau": 2.0}):
        with pytest.raises(ValueError, match=next(reversed(wrong))):
            TDMPC2Loss(make_model(), **wrong)


def test_a_backward_pass_may_come_after_the_next_call():
    loss = make_loss()
    first = loss(random_slices(O, A))["loss_policy"]
    loss(random_slices(O, A))
    first.backward()  # fails if the second call has moved the scale in place


def test_tdmpc2_takes_terms_of_one_s_own():
    term = Term("mine", lambda model, slices, rollout: slices.action.square().mean(-1))
    loss, batch = make_loss(extra_terms=[term]), random_slices(O, A)
    torch.testing.assert_close(loss(batch)["mine_error"], batch["action"].square().mean())


def test_a_term_that_reads_ends_does_not_end_the_bootstrap(batch):
    def ends(world_model, slices, rollout):
        return slices.terminated.float()

    found = []
    for terms in ([], [Term("ends", ends, keys=("terminated",))]):
        torch.manual_seed(0)
        world_model = ActionValueWorldModel(3, 2, latent_dim=16, mlp_dim=16)
        with torch.no_grad():
            for parameter in world_model.parameters():
                parameter.add_(0.3 * torch.randn_like(parameter))
        loss = TDMPC2Loss(world_model, discount=0.99, ignore_termination=True, extra_terms=terms)
        SoftUpdate(loss, tau=0.01)
        data = random_slices(3, 2, terminated=True)
        data["next", "terminated"][:] = True
        torch.manual_seed(0)
        found.append(loss.eval()(data)["value_target"])
    assert torch.equal(*found)
