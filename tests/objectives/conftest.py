"""Warm networks, random slices, and the losses written once more in plain PyTorch."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.objectives import LossModule, SoftUpdate

from torchrl_etdmpc.modules import WorldModel
from torchrl_etdmpc.objectives import (
    EfficientTDMPCLoss,
    EfficientTDMPCModelLoss,
    EfficientTDMPCPolicyLoss,
    EfficientTDMPCValueLoss,
)
from torchrl_etdmpc.testing import random_slices

OBSERVATION_DIM, ACTION_DIM = 5, 3
LOSSES = {
    "whole": EfficientTDMPCLoss,
    "model": EfficientTDMPCModelLoss,
    "value": EfficientTDMPCValueLoss,
    "policy": EfficientTDMPCPolicyLoss,
}
_TRAINED_BY_TERM = {
    "consistency": {"encoder", "dynamics"},
    "reward": {"encoder", "dynamics", "reward"},
    "value": {"encoder", "dynamics", "value"},
    "termination": {"encoder", "dynamics", "termination"},
    "policy": {"policy"},
}
_TERMS = {
    "whole": ["consistency", "reward", "termination", "value", "policy"],
    "model": ["consistency", "reward", "termination"],
    "value": ["value"],
    "policy": ["policy"],
}
_METRICS = {
    "consistency": ["consistency_error"],
    "reward": ["reward_error"],
    "termination": ["termination_error"],
    "value": ["value_error", "value_target"],
    "policy": ["policy_kl", "policy_entropy", "kl_scale"],
}
_READ = {
    "whole": ["observation", "next_observation", "action", "next_reward", "next_terminated", "plan_loc", "plan_scale"],
    "model": ["observation", "next_observation", "action", "next_reward", "next_terminated"],
    "value": ["observation", "next_observation", "action"],
    "policy": ["observation", "next_observation", "action", "plan_loc", "plan_scale"],
}
_KEYS = {
    "next_observation": ("next", "observation"),
    "next_reward": ("next", "reward"),
    "next_terminated": ("next", "terminated"),
    "plan_loc": ("plan", "loc"),
    "plan_scale": ("plan", "scale"),
}


@pytest.fixture(autouse=True)
def _seed() -> None:
    torch.manual_seed(0)


@pytest.fixture
def double_precision() -> Iterator[None]:
    """Everything that the test builds is in float64, so that two ways to the same number agree to many digits."""
    previous = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(previous)


@pytest.fixture(params=sorted(LOSSES))
def kind(request: pytest.FixtureRequest) -> str:
    """The name of each loss in turn."""
    return request.param


@pytest.fixture
def make_world_model() -> Callable[..., WorldModel]:
    """Builds small networks with random biases and no zero layer: nothing is the same by accident."""

    def make(**options) -> WorldModel:
        sizes = {"latent_dim": 16, "mlp_dim": 12, "encoder_dim": 10, "num_dynamics": 2, "num_values": 2}
        sizes |= {"observation_dim": OBSERVATION_DIM, "action_dim": ACTION_DIM, "simnorm_dim": 4, "num_bins": 21}
        world_model = WorldModel(**(sizes | options))
        _disturb(world_model.parameters())
        return world_model

    return make


@pytest.fixture
def make_loss(make_world_model: Callable[..., WorldModel]) -> Callable[..., LossModule]:
    """Builds a loss by name; its target values have an updater and differ from the values, unless declined."""

    def make(kind: str = "whole", world_model: WorldModel | None = None, *, updater: bool = True, **options):
        has_targets = kind in ("whole", "value")
        if has_targets:
            options = {"discount": 0.9, **options}
        if kind != "policy":
            options = {"ignore_termination": True, **options}  # the flags of make_slices are random
        loss = LOSSES[kind](make_world_model() if world_model is None else world_model, **options)
        if has_targets and updater:
            SoftUpdate(loss, tau=0.01)
            _disturb(loss.target_value_params.buffers())
        return loss

    return make


@pytest.fixture
def make_slices() -> Callable[..., TensorDict]:
    """Builds random slices with random flags in every step, and episodes that may be done at their last one."""

    def make(num_slices: int = 4, slice_len: int = 3, **dims) -> TensorDict:
        sizes = {"observation_dim": OBSERVATION_DIM, "action_dim": ACTION_DIM} | dims
        slices = random_slices(**sizes, num_slices=num_slices, slice_len=slice_len)
        for flag in ("terminated", "truncated", "done"):
            slices["next", flag] = torch.rand(num_slices, slice_len, 1) < 0.5
        slices["next", "done"][:, :-1] = False
        return slices

    return make


@pytest.fixture
def slices(make_slices: Callable[..., TensorDict]) -> TensorDict:
    """Four slices of three steps."""
    return make_slices()


@pytest.fixture
def run_seeded() -> Callable[..., TensorDict]:
    """Runs a loss on a fixed seed, so that two calls see the same policy noise (and dropout)."""

    def run(loss: LossModule, *args, seed: int = 7, **kwargs) -> TensorDict:
        torch.manual_seed(seed)
        return loss(*args, **kwargs)

    return run


@pytest.fixture
def assert_same_output() -> Callable[..., None]:
    """Asserts that two outputs have the same keys and numbers."""

    def check(actual: TensorDict, expected: TensorDict, **tolerances) -> None:
        assert sorted(actual.keys()) == sorted(expected.keys())
        for key, value in expected.items():
            torch.testing.assert_close(actual[key], value, msg=lambda text, key=key: f"{key}: {text}", **tolerances)

    return check


@pytest.fixture
def world_model(make_world_model: Callable[..., WorldModel]) -> WorldModel:
    """Small networks with a termination head."""
    return make_world_model(termination=True)


@pytest.fixture
def loss(kind: str, make_loss: Callable[..., LossModule], world_model: WorldModel) -> LossModule:
    """Each loss in turn."""
    return make_loss(kind, world_model)


@pytest.fixture
def total() -> Callable[[TensorDict], Tensor]:
    """Sums the terms of an output."""
    return lambda out: sum(value for key, value in out.items() if key.startswith("loss_"))


@pytest.fixture
def terms_of() -> dict[str, list[str]]:
    """The terms of each loss, by its name."""
    return _TERMS


@pytest.fixture
def metrics_of() -> dict[str, list[str]]:
    """The metrics of each term."""
    return _METRICS


@pytest.fixture
def trained_by_term() -> dict[str, set[str]]:
    """The networks that each term trains."""
    return _TRAINED_BY_TERM


@pytest.fixture
def key_of() -> Callable[[str], str | tuple[str, str]]:
    """The default key of what a loss reads, by the name of its keyword."""
    return lambda name: _KEYS.get(name, name)


@pytest.fixture
def owned() -> Callable[[str], set[str]]:
    """The networks that a loss trains, by its name."""
    return lambda kind: set.union(*(_TRAINED_BY_TERM[term] for term in _TERMS[kind]))


@pytest.fixture
def keywords_of() -> Callable[..., dict[str, Tensor]]:
    """What a loss reads from slices, as keyword arguments in the order of its in_keys."""

    def keywords(kind: str, slices: TensorDict, *, termination: bool = True) -> dict[str, Tensor]:
        names = [name for name in _READ[kind] if termination or name != "next_terminated"]
        return {name: slices[_KEYS.get(name, name)] for name in names}

    return keywords


@pytest.fixture
def networks() -> Callable[[WorldModel], dict[str, nn.Module]]:
    """The networks of a world model by the names that the losses give them."""

    def by_name(world_model: WorldModel) -> dict[str, nn.Module]:
        return {name.removesuffix("_head"): network for name, network in world_model.named_children()}

    return by_name


@pytest.fixture
def gradients() -> Callable[[Tensor, WorldModel], dict[str, dict[str, Tensor | None]]]:
    """Gradients of a scalar by network and parameter; ``None`` where the graph does not reach."""

    def compute(scalar: Tensor, world_model: WorldModel) -> dict[str, dict[str, Tensor | None]]:
        named = dict(world_model.named_parameters())
        found = torch.autograd.grad(scalar, list(named.values()), allow_unused=True, retain_graph=True)
        by_network: dict[str, dict[str, Tensor | None]] = {}
        for name, gradient in zip(named, found, strict=True):
            network, parameter = name.split(".", 1)
            by_network.setdefault(network.removesuffix("_head"), {})[parameter] = gradient
        return by_network

    return compute


@pytest.fixture
def assert_same_gradients() -> Callable[..., None]:
    """Asserts that two results of ``gradients`` agree, also in where there is none."""

    def check(actual: dict, expected: dict, networks: set[str] | None = None) -> None:
        for network in expected if networks is None else networks:
            torch.testing.assert_close(
                actual[network], expected[network], msg=lambda text, network=network: f"{network}: {text}"
            )

    return check


@pytest.fixture
def constant_policy() -> Callable[[WorldModel, Tensor, Tensor], None]:
    """Makes the policy the same Gaussian at every latent."""

    def make_constant(world_model: WorldModel, mean: Tensor, std: Tensor) -> None:
        low, high = world_model.policy.log_std_bounds
        raw = torch.atanh((std.log() - low) * 2 / (high - low) - 1)
        with torch.no_grad():
            world_model.policy.output.weight.zero_()
            world_model.policy.output.bias.copy_(torch.cat([torch.atanh(mean), raw]))

    return make_constant


@pytest.fixture
def plain_errors() -> Callable[..., dict[str, Tensor]]:
    """The reference: see :func:`_plain_errors`."""
    return _plain_errors


@pytest.fixture
def depth_mean() -> Callable[..., Tensor]:
    """``mean_{B,T} rho^k error_k`` of an error ``[B, T]``, step by step."""

    def reduce(error: Tensor, rho: float = 0.5) -> Tensor:
        steps = error.shape[1]
        return sum(rho**k * error[:, k].mean() for k in range(steps)) / steps

    return reduce


def _disturb(tensors) -> None:
    with torch.no_grad():
        for tensor in tensors:
            tensor.add_(0.3 * torch.randn_like(tensor))


# The losses of the paper, written again head by head and step by step. Of the package, nothing is used but the weights.


def _plain_errors(
    loss: LossModule,
    slices: TensorDict,
    *,
    seed: int = 7,
    discount: float = 0.9,
    value_beta: float = 0.0,
    value_replayed: float = 0.0,
    value_expectile: float = 0.5,
    kl_direction: str = "backward",
) -> dict[str, Tensor]:
    """Unweighted errors ``[B, T]`` with gradient, without dropout.

    Args:
        loss (LossModule): the weights; the targets are the value heads' own where the loss has none.
        slices (TensorDict): ``[B, T]``.
        seed (int): of the policy's noise in the value targets, which a loss draws likewise.
        discount (float): of the value targets.
        value_beta (float): as in the loss.
        value_replayed (float): as in the loss.
        value_expectile (float): as in the loss.
        kl_direction (str): as in the loss.
    """
    torch.manual_seed(seed)
    noise = torch.randn_like(slices["action"].transpose(0, 1))
    world_model = loss.world_model
    group = world_model.encoder.output.activation.keywords["group_size"]
    bins = world_model.bins
    weights = {name: dict(network.named_parameters()) for name, network in world_model.named_children()}
    target_values = weights["value_head"]
    if "target_value_params" in loss._modules:
        target_values = dict(loss._modules["target_value_params"].named_buffers())
    num_dynamics, num_values = world_model.num_dynamics, world_model.num_values
    steps = slices.shape[1]

    def encode(observation: Tensor) -> Tensor:
        return _simnorm(_network(weights["encoder"], observation, hidden=1), group)

    def step(head: int, latent: Tensor, action: Tensor) -> Tensor:
        return _simnorm(_network(weights["dynamics"], torch.cat([latent, action], -1), hidden=2, member=head), group)

    def reward_logits(latent: Tensor, action: Tensor) -> Tensor:
        return _network(weights["reward_head"], torch.cat([latent, action], -1), hidden=2)

    def termination_logit(latent: Tensor) -> Tensor:
        return _network(weights["termination_head"], latent, hidden=2)[..., 0]

    def policy(latent: Tensor) -> tuple[Tensor, Tensor]:
        out = _network(weights["policy"], latent, hidden=2)
        size = out.shape[-1] // 2
        low, high = world_model.policy.log_std_bounds
        return torch.tanh(out[..., :size]), torch.exp(low + (high - low) * (torch.tanh(out[..., size:]) + 1) / 2)

    def paid_from(k: int) -> Tensor:
        """What was paid in the rest of the slice, and the worth of the state at its end."""
        worth = torch.stack(
            [_expected(_network(target_values, encoded[steps], hidden=2, member=j), bins) for j in range(num_values)]
        )
        total, alive = torch.zeros(len(slices)), torch.ones(len(slices))
        for later in range(k, steps):
            total = total + alive * discount ** (later - k) * slices["next", "reward"][:, later, 0]
            if "termination_head" in weights:
                alive = alive * ~slices["next", "terminated"][:, later, 0]
        future = worth.mean(0) - value_beta * worth.std(0) / math.sqrt(num_values)
        return total + alive * discount ** (steps - k) * future

    encoded = [encode(slices["observation"][:, 0])]
    encoded += [encode(slices["next", "observation"][:, k]).detach() for k in range(steps)]
    rollouts = []
    for head in range(num_dynamics):
        rollout = [encoded[0]]
        for k in range(steps):
            rollout.append(step(head, rollout[k], slices["action"][:, k]))
        rollouts.append(rollout)

    errors: dict[str, list[Tensor]] = {}
    for k in range(steps):
        action = slices["action"][:, k]
        with torch.no_grad():
            mean, std = policy(encoded[k])
            imagined_action = torch.clip(mean + std * noise[k], -1, 1)
            futures = []
            for i in range(num_dynamics):
                imagined = step(i, encoded[k], imagined_action)
                alive = 1.0
                if "termination_head" in weights:
                    alive = 1 - 1 / (1 + torch.exp(-termination_logit(imagined)))
                for j in range(num_values):
                    value = _expected(_network(target_values, imagined, hidden=2, member=j), bins)
                    futures.append(alive * value)
            future = torch.stack(futures).mean(0)
            if value_beta:
                future = future - value_beta * torch.stack(futures).std(0) / math.sqrt(len(futures))
            target = _expected(reward_logits(encoded[k], imagined_action), bins) + discount * future
            if value_replayed:
                target = (1 - value_replayed) * target + value_replayed * paid_from(k)
        here: dict[str, list[Tensor]] = {}
        for i in range(num_dynamics):
            latent, successor = rollouts[i][k], rollouts[i][k + 1]
            here.setdefault("consistency", []).append((successor - encoded[k + 1].detach()).pow(2).mean(-1))
            reward = slices["next", "reward"][:, k, 0]
            here.setdefault("reward", []).append(_cross_entropy(reward_logits(latent, action), reward, bins))
            for j in range(num_values):
                logits = _network(weights["value_head"], latent, hidden=2, member=j)
                weight = torch.where(target > _expected(logits, bins), value_expectile, 1 - value_expectile)
                here.setdefault("value", []).append(2 * weight.detach() * _cross_entropy(logits, target, bins))
            if "termination_head" in weights:
                logit = termination_logit(successor)
                flag = slices["next", "terminated"][:, k, 0]
                here.setdefault("termination", []).append(torch.log(1 + torch.exp(torch.where(flag, -logit, logit))))
            mean, std = policy(latent.detach())
            pi = torch.distributions.Normal(mean, std)
            plan = torch.distributions.Normal(slices["plan", "loc"][:, k], slices["plan", "scale"][:, k])
            pair = (pi, plan) if kl_direction == "backward" else (plan, pi)
            here.setdefault("kl", []).append(torch.distributions.kl_divergence(*pair).mean(-1))
            here.setdefault("entropy", []).append(pi.entropy().sum(-1))
        here["value_target"] = [target]
        for name, values in here.items():
            errors.setdefault(name, []).append(sum(values) / len(values))
    return {name: torch.stack(values, 1) for name, values in errors.items()}


def _network(weights: dict[str, Tensor], x: Tensor, *, hidden: int, member: int | None = None) -> Tensor:
    def take(name: str) -> Tensor:
        return weights[name] if member is None else weights[name][member]

    def normed(layer: str, x: Tensor) -> Tensor:
        x = x @ take(f"{layer}.weight") + take(f"{layer}.bias")
        x = (x - x.mean(-1, keepdim=True)) / torch.sqrt(x.var(-1, keepdim=True, unbiased=False) + 1e-5)
        return x * take(f"{layer}.norm_weight") + take(f"{layer}.norm_bias")

    for layer in range(hidden):
        x = normed(f"hidden.{layer}", x)
        x = x * torch.tanh(torch.log(1 + torch.exp(x)))
    if "output.norm_weight" in weights:
        return normed("output", x)
    return x @ take("output.weight") + take("output.bias")


def _simnorm(x: Tensor, group_size: int) -> Tensor:
    out = torch.empty_like(x)
    num_groups = x.shape[-1] // group_size
    for g in range(num_groups):
        e = torch.exp(x[..., g::num_groups])
        out[..., g::num_groups] = e / e.sum(-1, keepdim=True)
    return out


def _expected(logits: Tensor, bins: Tensor) -> Tensor:
    e = torch.exp(logits)
    x = (e / e.sum(-1, keepdim=True) * bins).sum(-1)
    return torch.where(x < 0, 1 - torch.exp(-x), torch.exp(x) - 1)


def _cross_entropy(logits: Tensor, target: Tensor, bins: Tensor) -> Tensor:
    log_probabilities = logits - torch.log(torch.exp(logits).sum(-1, keepdim=True))
    out = []
    for row, scalar in zip(log_probabilities, target.tolist(), strict=True):
        squashed = math.copysign(math.log(1 + abs(scalar)), scalar)
        position = (squashed - bins[0].item()) / (bins[1] - bins[0]).item()
        position = min(max(position, 0.0), len(bins) - 1.0)
        lower = min(int(position), len(bins) - 2)
        share = position - lower
        out.append(-(1 - share) * row[lower] - share * row[lower + 1])
    return torch.stack(out)
