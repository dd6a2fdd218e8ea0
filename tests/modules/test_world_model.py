from __future__ import annotations

from functools import partial

import pytest
import torch
from torch import nn

from torchrl_etdmpc import functional
from torchrl_etdmpc.functional import bounded_log_std, clipped_sample, simnorm, two_hot_decode, two_hot_encode
from torchrl_etdmpc.modules import MLP, DynamicsEnsemble, Encoder, GaussianPolicy, ValueEnsemble, WorldModel

O, A, L = 5, 2, 16  # noqa: E741
LEADING = [(), (7,), (3, 7)]


@pytest.fixture(autouse=True)
def seeded():
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        yield


def build(**options) -> WorldModel:
    return WorldModel(O, A, **{"latent_dim": L, "mlp_dim": 32, "encoder_dim": 24, **options})


def randomised(**options) -> WorldModel:
    """A model without the zeros and the small weights of its start."""
    model = build(**options)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.normal_(0.0, 0.5)
    return model


def assert_on_the_simplices(latent: torch.Tensor, group_size: int = 8) -> None:
    groups = latent.shape[-1] // group_size
    assert (latent >= 0).all()
    sums = latent.unflatten(-1, (group_size, groups)).sum(-2)
    torch.testing.assert_close(sums, torch.ones_like(sums), rtol=0, atol=1e-5)


# Initialisation


def test_every_weight_of_every_member_has_std_0_02_but_the_zero_outputs_of_reward_and_value():
    model = WorldModel(64, 64, latent_dim=128, mlp_dim=128, encoder_dim=64, num_dynamics=3, termination=True)
    zero = {"reward_head.output.weight", "value_head.output.weight"}
    weights = {name: w for name, w in model.named_parameters() if name.endswith(".weight")}
    assert zero < weights.keys()
    assert len(weights) == 2 + 5 * 3
    for name, weight in weights.items():
        for member in weight if weight.ndim == 3 else weight.unsqueeze(0):
            expected = 0.0 if name in zero else 0.02
            # Four standard errors of a sample standard deviation.
            tolerance = 4 / (2 * member.numel()) ** 0.5
            assert member.std().item() == pytest.approx(expected, rel=tolerance), name


def test_every_bias_starts_at_zero_and_every_layer_norm_as_the_identity():
    for name, parameter in build(termination=True).named_parameters():
        if name.endswith("bias"):
            assert parameter.count_nonzero() == 0, name
        elif name.endswith("norm_weight"):
            assert (parameter == 1).all(), name


def test_a_new_model_predicts_no_reward_and_no_value():
    model = build()
    latent, action = model.encode(torch.randn(7, O)), torch.rand(7, A)
    assert model.reward_head(latent, action).count_nonzero() == 0
    assert model.value_head(latent).count_nonzero() == 0
    # The decoded bins cancel up to rounding.
    torch.testing.assert_close(model.reward(latent, action), torch.zeros(7), rtol=0, atol=1e-6)
    torch.testing.assert_close(model.values(latent), torch.zeros(7, 2), rtol=0, atol=1e-6)


def test_dynamics_heads_start_different():
    model = build(num_dynamics=4)
    latent = model.next(model.encode(torch.randn(7, O)).unsqueeze(0), torch.rand(7, A))
    for i in range(4):
        for j in range(i):
            assert (latent[i] != latent[j]).any()


def test_the_default_sizes_are_the_papers():
    model = WorldModel(24, 6)
    assert (model.latent_dim, model.num_dynamics, model.num_values, model.bins.shape) == (512, 4, 2, (101,))
    assert (model.bins[0], model.bins[-1]) == (-10, 10)
    shapes = {name: tuple(p.shape) for name, p in model.named_parameters() if name.endswith(".weight")}
    assert shapes == {
        "encoder.hidden.0.weight": (24, 256),
        "encoder.output.weight": (256, 512),
        "dynamics.hidden.0.weight": (4, 518, 512),
        "dynamics.hidden.1.weight": (4, 512, 512),
        "dynamics.output.weight": (4, 512, 512),
        "reward_head.hidden.0.weight": (518, 512),
        "reward_head.hidden.1.weight": (512, 512),
        "reward_head.output.weight": (512, 101),
        "value_head.hidden.0.weight": (2, 512, 512),
        "value_head.hidden.1.weight": (2, 512, 512),
        "value_head.output.weight": (2, 512, 101),
        "policy.hidden.0.weight": (512, 512),
        "policy.hidden.1.weight": (512, 512),
        "policy.output.weight": (512, 12),
    }
    assert [layer.dropout for layer in model.value_head.hidden] == [0.01, 0.0]
    assert model.policy.log_std_bounds == (-3.0, 1.0)


# Shapes and ranges


@pytest.mark.parametrize("leading", LEADING)
@pytest.mark.parametrize(("heads", "values"), [(1, 1), (4, 2)])
def test_every_prediction_has_its_documented_shape(heads, values, leading):
    model = randomised(num_dynamics=heads, num_values=values, termination=True)
    latent, action = model.encode(torch.randn(*leading, O)), torch.rand(*leading, A)
    assert latent.shape == (*leading, L)
    step = model.next(latent.unsqueeze(0), action)
    assert step.shape == (heads, *leading, L)
    assert model.next(step, action).shape == (heads, *leading, L)
    assert model.reward(latent, action).shape == leading
    assert model.reward(step, action).shape == (heads, *leading)
    assert model.values(latent).shape == (*leading, values)
    assert model.values(step).shape == (heads, *leading, values)
    assert model.termination(step).shape == (heads, *leading)
    mean, log_std = model.policy(latent)
    assert mean.shape == log_std.shape == (*leading, A)
    assert model.act(latent, torch.randn(*leading, A)).shape == (*leading, A)


def test_an_empty_batch_gives_empty_predictions():
    model = randomised(termination=True)
    latent, action = model.encode(torch.zeros(0, O)), torch.zeros(0, A)
    assert model.next(latent.unsqueeze(0), action).shape == (4, 0, L)
    assert model.reward(latent, action).shape == (0,)
    assert model.values(latent).shape == (0, 2)
    assert model.termination(latent).shape == (0,)
    assert model.act(latent, action).shape == (0, A)


@pytest.mark.parametrize("simnorm_dim", [4, 8])
def test_latents_lie_on_the_simplices(simnorm_dim):
    model = randomised(simnorm_dim=simnorm_dim)
    latent = model.encode(10 * torch.randn(50, O))
    assert_on_the_simplices(latent, simnorm_dim)
    for _ in range(3):
        latent = model.next(latent if latent.ndim == 3 else latent.unsqueeze(0), torch.rand(50, A) * 2 - 1)
        assert_on_the_simplices(latent, simnorm_dim)


def test_a_batch_gives_the_predictions_of_its_parts():
    model = randomised(termination=True)
    observation, action = torch.randn(3, 7, O), torch.rand(3, 7, A)
    latent = model.encode(observation)
    close = partial(torch.testing.assert_close, rtol=1e-4, atol=1e-4)
    close(latent[1, 4], model.encode(observation[1, 4]))
    close(model.next(latent.unsqueeze(0), action)[:, 1, 4], model.next(latent[1, 4].unsqueeze(0), action[1, 4]))
    close(model.reward(latent, action)[1, 4], model.reward(latent[1, 4], action[1, 4]))
    close(model.values(latent)[1, 4], model.values(latent[1, 4]))
    close(model.termination(latent)[1, 4], model.termination(latent[1, 4]))


@pytest.mark.parametrize("bounds", [None, (-2.0, 1.0), (-0.5, 0.25)])
def test_the_policy_stays_within_its_bounds_and_reaches_them(bounds):
    model = randomised()
    with torch.no_grad():
        model.policy.output.weight.mul_(10)
        model.policy.output.bias.zero_()
    mean, log_std = model.policy(simnorm(100 * torch.randn(200, L)), bounds)
    low, high = bounds or (-3.0, 1.0)
    assert mean.abs().max() <= 1
    assert log_std.min() >= low - 1e-6
    assert log_std.max() <= high + 1e-6
    assert log_std.min() < low + 0.01 * (high - low)
    assert log_std.max() > high - 0.01 * (high - low)


def test_a_new_policy_is_centred_strictly_inside_the_action_range():
    mean, log_std = build().policy(simnorm(torch.randn(50, L)))
    assert mean.abs().max() < 1
    torch.testing.assert_close(mean, torch.zeros(50, A), rtol=0, atol=0.4)
    torch.testing.assert_close(log_std, torch.full((50, A), -1.0), rtol=0, atol=0.8)


def test_other_bounds_change_the_log_std_of_that_call_only():
    model = randomised()
    latent = simnorm(torch.randn(20, L))
    mean, log_std = model.policy(latent)
    widened_mean, widened = model.policy(latent, (-2.0, 1.0))
    assert torch.equal(widened_mean, mean)
    torch.testing.assert_close(widened, -2 + (log_std + 3) * 3 / 4)
    assert torch.equal(model.policy(latent)[1], log_std)


def test_the_policys_first_outputs_are_the_mean_and_its_last_the_log_std():
    model = randomised()
    latent = simnorm(torch.randn(20, L))
    raw = MLP.forward(model.policy, latent)
    mean, log_std = model.policy(latent)
    torch.testing.assert_close(mean, raw[:, :A].tanh())
    torch.testing.assert_close(log_std, bounded_log_std(raw[:, A:], -3.0, 1.0))


def test_act_without_noise_is_the_mean_and_with_noise_the_clipped_sample():
    model = randomised()
    latent, noise = simnorm(torch.randn(20, L)), 3 * torch.randn(20, A)
    mean, log_std = model.policy(latent)
    assert torch.equal(model.act(latent, torch.zeros(20, A)), mean)
    assert torch.equal(model.act(latent, noise), clipped_sample(mean, log_std.exp(), noise))
    assert model.act(latent, noise).abs().max() == 1
    bounds = (-2.0, 1.0)
    wide = clipped_sample(mean, model.policy(latent, bounds)[1].exp(), noise)
    assert torch.equal(model.act(latent, noise, bounds), wide)


# Heads


def test_reward_and_values_are_the_decoded_distributions_of_their_heads():
    model = randomised()
    latent, action = simnorm(torch.randn(7, L)), torch.rand(7, A)
    torch.testing.assert_close(
        model.reward(latent, action), two_hot_decode(model.reward_head(latent, action), model.bins)
    )
    values = model.values(latent)
    for j, logits in enumerate(model.value_head(latent)):
        torch.testing.assert_close(values[:, j], two_hot_decode(logits, model.bins))
    assert (values[:, 0] != values[:, 1]).all()


@pytest.mark.parametrize("scalar", [-40.0, 0.0, 0.7, 900.0])
def test_a_head_that_outputs_a_two_hot_distribution_predicts_its_scalar(scalar):
    model = build()
    logits = two_hot_encode(torch.tensor(scalar), model.bins).clamp_min(1e-30).log()
    with torch.no_grad():
        model.reward_head.output.bias.copy_(logits)
        model.value_head.output.bias[1] = logits
    latent, action = simnorm(torch.randn(7, L)), torch.rand(7, A)
    close = partial(torch.testing.assert_close, rtol=1e-4, atol=1e-4)
    close(model.reward(latent, action), torch.full((7,), scalar))
    close(model.values(latent), torch.tensor([0.0, scalar]).expand(7, 2))


def test_the_reward_depends_on_the_action_and_one_action_serves_all_heads():
    model = randomised()
    latent, action = simnorm(torch.randn(4, 7, L)), torch.rand(7, A)
    torch.testing.assert_close(model.reward(latent, action), model.reward(latent, action.expand(4, 7, A)))
    assert (model.reward(latent, action) != model.reward(latent, -action)).all()


def test_without_a_termination_head_there_is_no_termination():
    model = build()
    assert model.termination(torch.rand(7, L)) is None
    assert not any("termination" in name for name in model.state_dict())


def test_termination_is_a_probability_from_the_heads_logit():
    model = randomised(termination=True)
    latent = simnorm(torch.randn(7, L))
    torch.testing.assert_close(model.termination(latent), torch.sigmoid(model.termination_head(latent)))
    fresh = build(termination=True).termination(latent)
    torch.testing.assert_close(fresh, torch.full((7,), 0.5), rtol=0, atol=0.1)


# Ensembles


@pytest.mark.parametrize("leading", LEADING)
def test_a_dynamics_head_equals_the_same_network_built_alone(leading):
    stack = randomised(num_dynamics=3).dynamics
    latent, action = simnorm(torch.randn(3, *leading, L)), torch.rand(*leading, A)
    out = stack(latent, action)
    for i in range(3):
        alone = MLP(L + A, [32, 32], L, output_activation=simnorm)
        alone.load_state_dict({name: tensor[i] for name, tensor in stack.state_dict().items()})
        torch.testing.assert_close(out[i], alone(torch.cat([latent[i], action], dim=-1)), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("leading", LEADING)
def test_a_value_head_equals_the_same_network_built_alone(leading):
    stack = randomised(num_values=3).value_head
    latent = simnorm(torch.randn(*leading, L))
    out = stack(latent)
    for j in range(3):
        alone = MLP(L, [32, 32], 101)
        alone.load_state_dict({name: tensor[j] for name, tensor in stack.state_dict().items()})
        torch.testing.assert_close(out[j], alone(latent), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("ensemble", ["dynamics", "value_head"])
def test_the_gradient_of_one_head_by_the_weights_of_another_is_exactly_zero(ensemble):
    model = randomised(num_dynamics=3, num_values=3)
    latent = simnorm(torch.randn(7, L))
    out = model.next(latent.unsqueeze(0), torch.rand(7, A)) if ensemble == "dynamics" else model.value_head(latent)
    parameters = list(getattr(model, ensemble).parameters())
    for i in range(3):
        gradients = torch.autograd.grad(out[i].square().sum(), parameters, retain_graph=True)
        for gradient in gradients:
            for j in range(3):
                assert (gradient[j].count_nonzero() > 0) == (i == j)


def test_heads_step_their_own_latents():
    model = randomised(num_dynamics=3)
    latent, action = simnorm(torch.randn(3, 7, L)), torch.rand(7, A)
    changed = latent.clone()
    changed[1] = simnorm(torch.randn(7, L))
    same = (model.next(changed, action) == model.next(latent, action)).flatten(1).all(1)
    assert same.tolist() == [True, False, True]


def test_one_latent_for_all_heads_equals_a_copy_per_head():
    model = randomised(num_dynamics=3)
    latent, action = simnorm(torch.randn(1, 7, L)), torch.rand(7, A)
    torch.testing.assert_close(model.next(latent, action), model.next(latent.repeat(3, 1, 1), action))
    assert (model.next(latent, action)[0] != model.next(latent, action)[1]).any()


def test_heads_may_take_their_own_actions():
    model = randomised(num_dynamics=3)
    latent, action = simnorm(torch.randn(1, 7, L)), torch.rand(3, 7, A)
    out = model.next(latent, action)
    for i in range(3):
        torch.testing.assert_close(out[i], model.next(latent, action[i])[i])


# Dropout


@pytest.mark.parametrize("training", [True, False])
def test_value_dropout_acts_only_when_asked_for_and_never_through_the_training_mode(training):
    model = randomised(dropout=0.5).train(training)
    latent = simnorm(torch.randn(7, L))
    assert torch.equal(model.values(latent), model.values(latent))
    assert torch.equal(model.value_head(latent), model.value_head(latent))
    dropped = model.value_head(latent, dropout=True)
    assert not torch.equal(dropped, model.value_head(latent, dropout=True))
    assert not torch.equal(dropped, model.value_head(latent))


def test_values_do_not_depend_on_the_dropout_rate():
    model, other = randomised(dropout=0.0), randomised(dropout=0.9)
    other.load_state_dict(model.state_dict())
    latent = simnorm(torch.randn(7, L))
    assert torch.equal(other.values(latent), model.values(latent))


def test_value_heads_drop_independently():
    head = randomised(dropout=0.5).value_head
    with torch.no_grad():
        for parameter in head.parameters():
            parameter[1] = parameter[0]
    latent = simnorm(torch.randn(7, L))
    first, second = head(latent)
    torch.testing.assert_close(first, second)
    first, second = head(latent, dropout=True)
    assert (first != second).all()


def test_no_other_network_drops():
    model = randomised(dropout=0.5, termination=True)
    dropouts = {name: m.dropout for name, m in model.named_modules() if getattr(m, "dropout", 0.0)}
    assert dropouts == {"value_head.hidden.0": 0.5}


# Errors


@pytest.mark.parametrize(("latent_dim", "nearest"), [(500, 496), (510, 512), (3, 8), (9, 8)])
def test_a_latent_size_that_simnorm_cannot_split_is_refused_with_the_nearest_multiple(latent_dim, nearest):
    with pytest.raises(ValueError) as error:
        WorldModel(O, A, latent_dim=latent_dim)
    assert str(error.value) == (
        f"latent_dim must be a multiple of simnorm_dim=8, got {latent_dim}; the nearest is {nearest}."
    )


@pytest.mark.parametrize("size", [0, -3])
@pytest.mark.parametrize(
    "name",
    [
        "observation_dim",
        "action_dim",
        "latent_dim",
        "mlp_dim",
        "encoder_dim",
        "encoder_layers",
        "num_dynamics",
        "num_values",
        "simnorm_dim",
    ],
)
def test_a_size_below_one_is_refused_by_name(name, size):
    with pytest.raises(ValueError, match=rf"^{name} must be at least 1, got {size}\.$"):
        WorldModel(**{"observation_dim": O, "action_dim": A, name: size})


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"num_bins": 1}, r"num_bins must be at least 2, got 1\."),
        ({"bin_min": 3.0, "bin_max": 3.0}, r"bin_min must be below bin_max=3\.0, got 3\.0\."),
        ({"bin_min": 10.5}, r"bin_min must be below bin_max=10\.0, got 10\.5\."),
        ({"log_std_min": 1.0}, r"log_std_min must be below log_std_max=1\.0, got 1\.0\."),
        ({"log_std_max": -4.0}, r"log_std_min must be below log_std_max=-4\.0, got -3\.0\."),
        ({"dropout": 1.0}, r"dropout must be in \[0, 1\), got 1\.0\."),
        ({"dropout": -0.1}, r"dropout must be in \[0, 1\), got -0\.1\."),
    ],
    ids=str,
)
def test_bins_bounds_and_rates_out_of_range_are_refused(options, message):
    with pytest.raises(ValueError, match=rf"^{message}$"):
        build(**options)


def test_an_unknown_activation_is_refused_with_the_choices():
    with pytest.raises(ValueError, match=r"^activation must be one of mish, silu, relu, got 'gelu'\.$"):
        build(activation="gelu")


def test_the_activation_reaches_every_network():
    mish, relu = build(termination=True), build(termination=True, activation="relu")
    relu.load_state_dict(mish.state_dict())
    networks = [name for name, _ in mish.named_children()]
    assert networks == ["encoder", "dynamics", "reward_head", "value_head", "policy", "termination_head"]
    for name in networks:
        activations = [{layer.activation for layer in getattr(m, name).hidden} for m in (mish, relu)]
        assert activations == [{functional.mish}, {nn.functional.relu}], name


# State


def test_a_state_dict_carries_everything():
    model, other = randomised(termination=True), build(termination=True, bin_min=-5.0, bin_max=5.0)
    model.version.fill_(41)
    result = other.load_state_dict(model.state_dict())
    assert not result.missing_keys
    assert not result.unexpected_keys
    assert other.version == 41
    observation, action = torch.randn(7, O), torch.rand(7, A)
    latent = model.encode(observation)
    assert torch.equal(other.encode(observation), latent)
    assert torch.equal(other.next(latent.unsqueeze(0), action), model.next(latent.unsqueeze(0), action))
    assert torch.equal(other.reward(latent, action), model.reward(latent, action))
    assert torch.equal(other.values(latent), model.values(latent))
    assert torch.equal(other.termination(latent), model.termination(latent))
    assert torch.equal(other.act(latent, action), model.act(latent, action))


def test_a_reset_draws_every_network_anew_and_keeps_what_starts_at_zero():
    model = build(termination=True)
    before = {name: p.detach().clone() for name, p in model.named_parameters()}
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(1.0)
    model.version.fill_(41)
    model.reset_parameters_recursive()
    assert model.version == 0
    for name, parameter in model.named_parameters():
        if name.endswith(".weight") and name not in ("reward_head.output.weight", "value_head.output.weight"):
            assert (parameter != before[name]).all(), name
            assert parameter.abs().max() < 0.2, name
        else:  # zeros, and the ones of a LayerNorm
            assert torch.equal(parameter, before[name]), name


def test_models_of_equal_seed_are_equal():
    torch.manual_seed(3)
    first = build().state_dict()
    torch.manual_seed(3)
    second = build().state_dict()
    assert all(torch.equal(first[name], second[name]) for name in first)


def test_double_precision_works_throughout_and_agrees_with_single():
    model = randomised(termination=True)
    observation, action, noise = torch.randn(7, O), torch.rand(7, A), torch.randn(7, A)

    def predictions(observation, action, noise):
        latent = model.encode(observation)
        step = model.next(latent.unsqueeze(0), action)
        policy = model.policy(latent)
        heads = model.reward(step, action), model.values(step), model.termination(step)
        return latent, step, *policy, *heads, model.act(latent, noise)

    single = predictions(observation, action, noise)
    model.double()
    double = predictions(observation.double(), action.double(), noise.double())
    assert {x.dtype for x in double} == {torch.float64}
    for a, b in zip(single, double, strict=True):
        torch.testing.assert_close(a.double(), b, rtol=1e-3, atol=1e-4)


def test_predictions_send_gradients_to_their_own_networks_only():
    model = randomised(termination=True)
    latent, action = simnorm(torch.randn(7, L)), torch.rand(7, A)
    predictions = {
        "dynamics": lambda: model.next(latent.unsqueeze(0), action).square(),
        "reward_head": lambda: model.reward(latent, action),
        "value_head": lambda: model.values(latent),
        "policy": lambda: model.act(latent, torch.zeros(7, A)),
        "termination_head": lambda: model.termination(latent),
    }
    for name, predict in predictions.items():
        model.zero_grad()
        predict().sum().backward()
        assert {n.split(".")[0] for n, p in model.named_parameters() if p.grad is not None} == {name}


def test_inputs_are_left_alone():
    model = randomised(termination=True)
    latent, action, noise = simnorm(torch.randn(4, 7, L)), torch.rand(7, A), torch.randn(4, 7, A)
    before = latent.clone(), action.clone(), noise.clone()
    model.next(latent, action), model.reward(latent, action), model.values(latent), model.act(latent, noise)
    assert all(torch.equal(a, b) for a, b in zip((latent, action, noise), before, strict=True))


def test_compiled_predictions_equal_eager_ones_without_a_graph_break():
    model = randomised()

    def predict(latent, action):
        latent = model.next(latent, action)
        return latent, model.reward(latent, action), model.values(latent)

    latent, action = simnorm(torch.randn(4, 7, L)), torch.rand(7, A)
    torch._dynamo.reset()
    compiled = torch.compile(predict, fullgraph=True, backend="eager")(latent, action)
    for a, b in zip(compiled, predict(latent, action), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-6)  # mish is written otherwise there
    torch._dynamo.reset()


# The networks on their own


def test_the_encoder_has_as_many_hidden_layers_as_asked_for():
    encoder = Encoder(O, L, hidden_dim=24, num_layers=3)
    assert [tuple(layer.weight.shape) for layer in encoder.hidden] == [(O, 24), (24, 24), (24, 24)]
    assert_on_the_simplices(encoder(torch.randn(7, O)))


def test_the_networks_work_outside_a_world_model():
    latent = simnorm(torch.randn(7, L))
    assert DynamicsEnsemble(L, A, num_heads=3, hidden_dim=8)(latent.unsqueeze(0), torch.rand(7, A)).shape == (3, 7, L)
    assert ValueEnsemble(L, num_heads=3, num_bins=21, hidden_dim=8)(latent).shape == (3, 7, 21)
    mean, log_std = GaussianPolicy(L, A, hidden_dim=8, log_std_min=0.0, log_std_max=0.5)(latent)
    assert ((log_std > 0) & (log_std < 0.5)).all()
    assert mean.shape == (7, A)
