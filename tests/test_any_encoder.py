"""Encoders that own their input: images, a dictionary of entries, a plain ``nn.Sequential``, through every part."""

from __future__ import annotations

import copy
import inspect

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.data import (
    Binary,
    Bounded,
    Composite,
    LazyTensorStorage,
    TensorDictReplayBuffer,
    TensorDictRoundRobinWriter,
    TensorSpec,
    Unbounded,
)
from torchrl.envs import EnvBase, InitTracker, SerialEnv, TransformedEnv
from torchrl.objectives import SoftUpdate

from torchrl_etdmpc import (
    EfficientTDMPCLoss,
    EnsembleMPPIPlanner,
    LatentEnv,
    ReanalyzeTransform,
    SeedPolicy,
    StepCollector,
    StepSliceSampler,
    WorldModel,
    export_planner,
)
from torchrl_etdmpc.functional import simnorm
from torchrl_etdmpc.modules.new_weights import draw_new_weights
from torchrl_etdmpc.objectives import EfficientTDMPCModelLoss
from torchrl_etdmpc.testing import random_slices
from torchrl_etdmpc.training import Updater


class PixelEncoder(nn.Module):
    """Images ``[..., 3, 16, 16]`` of bytes to latents."""

    def __init__(self, latent_dim: int) -> None:
        super().__init__()
        layers = [nn.Conv2d(3, 8, 4, stride=2), nn.ReLU(), nn.Conv2d(8, 8, 3, stride=2), nn.ReLU(), nn.Flatten()]
        self.network = nn.Sequential(*layers, nn.Linear(72, latent_dim))

    def forward(self, pixels: Tensor) -> Tensor:
        images = pixels.reshape(-1, *pixels.shape[-3:]) / 255 - 0.5
        return simnorm(self.network(images), 8).reshape(*pixels.shape[:-3], -1)


class DictionaryEncoder(nn.Module):
    """An image and a vector to latents."""

    def __init__(self, latent_dim: int) -> None:
        super().__init__()
        self.pixels, self.state = PixelEncoder(latent_dim), nn.Linear(2, latent_dim)

    def forward(self, observation: TensorDictBase) -> Tensor:
        return (self.pixels(observation["pixels"]) + simnorm(self.state(observation["state"]), 8)) / 2


def plain_encoder(latent_dim: int) -> nn.Module:
    return nn.Sequential(nn.Linear(2, 32), nn.ELU(), nn.Linear(32, latent_dim), nn.Softmax(-1))


PIXELS, STATE = Bounded(0, 255, (3, 16, 16), dtype=torch.uint8), Unbounded((2,))
KINDS = {
    "pixels": (PixelEncoder, PIXELS),
    "dictionary": (DictionaryEncoder, Composite(pixels=PIXELS, state=STATE)),
    "sequential": (plain_encoder, STATE),
}


class Dot(EnvBase):
    """A point on a line that actions push, seen as an image, as numbers, or both; episodes of 7 steps."""

    def __init__(self, spec: TensorSpec) -> None:
        super().__init__()
        self.observation_spec = Composite(observation=spec.clone())
        self.action_spec = Bounded(-1, 1, (1,))
        self.reward_spec = Unbounded((1,))
        flags = ("done", "terminated", "truncated")
        self.full_done_spec = Composite({name: Binary(1, dtype=torch.bool) for name in flags})

    def _set_seed(self, seed: int | None) -> None:
        pass

    def _seen(self) -> Tensor | TensorDict:
        pixels = torch.zeros(3, 16, 16, dtype=torch.uint8)
        pixels[:, :, int(8 + 7 * self.position.item())] = 255
        both = TensorDict({"pixels": pixels, "state": torch.cat([self.position, self.position.square()])})
        spec = self.observation_spec["observation"]
        return both if isinstance(spec, Composite) else both["pixels" if spec.dtype == torch.uint8 else "state"]

    def _reset(self, tensordict: TensorDictBase | None = None) -> TensorDict:
        self.position, self.steps = torch.zeros(1), 0
        return TensorDict({"observation": self._seen(), **self._flags()})

    def _flags(self) -> dict[str, Tensor]:
        over = torch.tensor([self.steps == 7])
        return {"done": over, "truncated": over.clone(), "terminated": torch.zeros(1, dtype=torch.bool)}

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        self.position, self.steps = (self.position + 0.3 * tensordict["action"]).clamp(-1, 1), self.steps + 1
        return TensorDict({"observation": self._seen(), "reward": self.position.clone(), **self._flags()})


@pytest.fixture(params=KINDS)
def kind(request) -> str:
    torch.manual_seed(0)
    return request.param


def make_model(kind: str) -> WorldModel:
    encoder = KINDS[kind][0](16)
    return WorldModel(None, 1, encoder=encoder, latent_dim=16, mlp_dim=16, num_dynamics=2)


def make_planner(model: WorldModel, **options) -> EnsembleMPPIPlanner:
    small = {"horizon": 2, "num_samples": 8, "num_elites": 3, "num_proposals": 2, "iterations": 2}
    return EnsembleMPPIPlanner(LatentEnv(model), **small, **options)


def make_loss(model: WorldModel) -> EfficientTDMPCLoss:
    loss = EfficientTDMPCLoss(model, discount=0.9)
    SoftUpdate(loss, tau=0.01)
    return loss


def make_env(kind: str) -> TransformedEnv:
    return TransformedEnv(Dot(KINDS[kind][1]), InitTracker())


def filled(kind: str, model: WorldModel, *, num_envs: int = 1, frames: int = 40) -> TensorDictReplayBuffer:
    """A buffer with the rows of a seed phase and of the planner."""
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(100),
        sampler=StepSliceSampler(3, partial=True),
        writer=TensorDictRoundRobinWriter(track_generations=True),
        batch_size=24,
    )
    env = make_env(kind) if num_envs == 1 else SerialEnv(num_envs, lambda: make_env(kind))
    random = {"init_random_frames": frames // 2, "seed_policy": SeedPolicy(env.action_spec)}
    for _ in StepCollector(env, make_planner(model), replay_buffer=buffer, total_frames=frames, **random):
        pass
    assert len(buffer) == frames
    return buffer


@pytest.mark.parametrize("num_envs", [1, 2])
def test_every_part_takes_what_the_encoder_takes(kind, num_envs):
    model = make_model(kind)
    buffer = filled(kind, model, num_envs=num_envs)
    ReanalyzeTransform(make_planner(model, warm_start=False), slice_len=3, interval=2, num_slices=2).attach(buffer)
    updater = Updater(EfficientTDMPCLoss(model, discount=0.9), lr=1e-2)
    before = copy.deepcopy(model.encoder.state_dict())
    losses = []
    for _ in range(20):
        metrics = updater.step(buffer.sample().reshape(-1, 3))
        assert all(value.isfinite().all() for value in metrics.values())
        losses.append(metrics["reward_error"].item())
    assert sum(losses[-5:]) < sum(losses[:5])
    assert all(not torch.equal(before[name], weight) for name, weight in model.encoder.state_dict().items())
    assert buffer.storage[:]["plan", "version"].max() > 0


def test_a_rollout_carries_plans_and_resets(kind):
    planner = make_planner(make_model(kind))
    env = make_env(kind).append_transform(planner.make_tensordict_primer())
    rollout = env.rollout(16, planner, break_when_any_done=False)
    starts = rollout["is_init"].squeeze(-1)
    assert starts.nonzero().flatten().tolist() == [0, 7, 14]
    assert (rollout["plan_mean"][starts] == 0).all() and (rollout["plan_mean"][~starts] != 0).any()
    assert planner.env.rollout(3).shape == (3,)  # imagined, from a latent of zeros


def test_steps_that_do_not_follow_each_other_are_a_warning(kind):
    model = make_model(kind)
    batch, loss = filled(kind, model).sample().reshape(-1, 3), make_loss(model)
    batch = batch[~batch["next", "done"].flatten(1).any(1)]
    loss(batch)
    others = batch[torch.arange(len(batch)).roll(1)]
    with pytest.warns(UserWarning, match="the slices join rows of several episodes"):
        loss(torch.stack([batch[:, 0], others[:, 1], others[:, 2]], dim=1))
    if kind != "pixels":  # which hold no other number than finite ones
        state = ("observation", "state") if kind == "dictionary" else ("observation",)
        batch[state][0, 1] += 1  # one entry is enough
        with pytest.warns(UserWarning, match="the slices join rows of several episodes"):
            loss(batch)
        batch["next", *state][0, -1] = torch.nan
        with pytest.raises(ValueError, match="is not finite at the last step of a slice"):
            loss(batch)


def test_masked_steps_count_for_nothing_whatever_they_show(kind):
    model = make_model(kind)
    batch = filled(kind, model).sample().reshape(-1, 3)
    assert not batch["collector", "mask"].all()
    loss = make_loss(model).eval()
    torch.manual_seed(1)
    expected = loss(batch)
    other, masked = batch.clone(), ~batch["collector", "mask"]
    other["next", "observation"][masked] = torch.zeros_like(other["next", "observation"][masked])
    torch.manual_seed(1)
    assert all(torch.equal(value, expected[key]) for key, value in loss(other).items())


def test_a_flat_sample_is_refused(kind):
    model = make_model(kind)
    flat = filled(kind, model).sample()
    with pytest.raises(ValueError, match=r"reshape a flat replay sample with sample\.reshape\(-1, slice_len\)\.$"):
        make_loss(model)(flat)


def test_new_weights_are_drawn_for_the_encoder_too(kind):
    for reset in (lambda model: model, lambda model: EfficientTDMPCLoss(model, discount=0.9)):
        model = make_model(kind)
        before = copy.deepcopy(model.encoder.state_dict())
        reset(model).reset_parameters_recursive()
        assert all(not torch.equal(before[name], weight) for name, weight in model.encoder.state_dict().items())


def test_a_layer_that_cannot_draw_new_weights_is_named():
    class Scale(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.factor = nn.Parameter(torch.ones(16))

        def forward(self, observation: Tensor) -> Tensor:
            return self.factor * observation

    model = WorldModel(None, 1, encoder=Scale(), latent_dim=16, mlp_dim=16)
    with pytest.raises(TypeError, match=r"reset_parameters\(\) in every layer with parameters, got Scale without"):
        model.reset_parameters_recursive()


def test_new_weights_are_drawn_for_pytorch_s_attention():
    torch.manual_seed(0)
    layer = nn.TransformerEncoderLayer(8, 2, 16)
    draw_new_weights(layer)
    drawn = {name: value.clone() for name, value in layer.named_parameters()}
    draw_new_weights(layer)
    moved = [name for name, value in layer.named_parameters() if not torch.equal(value, drawn[name])]
    assert {"self_attn.in_proj_weight", "self_attn.out_proj.weight", "linear1.weight"} <= {*moved}
    assert not layer.self_attn.out_proj.bias.any()  # as PyTorch begins


def test_an_exported_planner_needs_an_example_of_what_is_no_vector():
    planner = make_planner(make_model("pixels"))
    with pytest.raises(ValueError, match=r"^observation must be given for WorldModel"):
        export_planner(planner)
    image = make_env("pixels").reset()["observation"]
    program = export_planner(planner, batch_size=None, observation=image).module()
    for states in (1, 3):
        torch.manual_seed(0)
        action, _ = program(image.expand(states, 3, 16, 16), torch.zeros(states, 2, 1))
        torch.manual_seed(0)
        expected = planner.plan(image.expand(states, 3, 16, 16), torch.zeros(states, 2, 1), explore=False).action
        torch.testing.assert_close(action, expected)


def test_a_world_model_without_a_size_needs_an_encoder():
    with pytest.raises(ValueError, match=r"^observation_dim must be given, got None; or pass an encoder"):
        WorldModel(None, 1)


def test_an_encoder_of_images_is_short():
    lines = [line for line in inspect.getsource(PixelEncoder).splitlines() if line.strip()]
    assert len(lines) + 1 <= 15  # and the line that passes it


def test_an_encoder_that_writes_something_else_is_named_with_what_it_should_write():
    wide = WorldModel(None, 1, encoder=nn.Linear(3, 24), latent_dim=16, mlp_dim=16)
    text = r"^the encoder must write latents \[\.\.\., L\], here L = latent_dim = 16, got \[.*24\]\.$"
    with pytest.raises(ValueError, match=text):
        EnsembleMPPIPlanner(LatentEnv(wide)).plan(torch.zeros(2, 3))
    with pytest.raises(ValueError, match=text):
        EfficientTDMPCModelLoss(wide)(random_slices(3, 1))
    layers = nn.Sequential(nn.Linear(3, 16), nn.Flatten(0, -2))  # takes all steps of all slices for one batch
    flat = WorldModel(None, 1, encoder=layers, latent_dim=16, mlp_dim=16)
    with pytest.raises(ValueError, match=r"must make \[4, 16\] and \[3, 4, 16\], got \[4, 16\] and \[12, 16\]\.$"):
        EfficientTDMPCModelLoss(flat)(random_slices(3, 1))


def test_an_encoder_with_nothing_to_learn_trains_the_rest():
    model = WorldModel(None, 2, encoder=nn.Softmax(-1), latent_dim=8, mlp_dim=16, simnorm_dim=8)
    loss = EfficientTDMPCLoss(model, discount=0.9)
    SoftUpdate(loss, tau=0.1)
    rows = random_slices(8, 2)
    terms = loss(rows)
    sum(terms[key] for key in terms.keys() if key.startswith("loss_")).backward()
    assert model.policy.output.weight.grad.isfinite().all()
    assert model.policy.output.weight.grad.any()


def test_what_an_encoder_has_frozen_stays_frozen_in_training_mode():
    torch.manual_seed(0)
    layers = nn.Sequential(nn.Linear(3, 16), nn.BatchNorm1d(16), nn.Dropout(0.5), nn.Linear(16, 16)).eval()
    world_model = WorldModel(None, 1, encoder=layers, latent_dim=16, mlp_dim=16)
    planner = EnsembleMPPIPlanner(LatentEnv(world_model), horizon=2, num_samples=8, num_elites=4, num_proposals=2)
    observation, mean = torch.randn(6, 3), layers[1].running_mean.clone()
    alone = world_model.encode(observation[:1])
    for module in (world_model, planner):
        module.eval()
        assert module.train().training
        assert world_model.policy.training
        torch.testing.assert_close(world_model.encode(observation)[:1], alone)
        assert torch.equal(layers[1].running_mean, mean)
