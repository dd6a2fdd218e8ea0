from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn

from torchrl_etdmpc import EnsembleMPPIPlanner, LatentEnv
from torchrl_etdmpc.modules import device_and_dtype, require_prediction_model
from torchrl_etdmpc.testing import LineWorld, LQRWorld


class Pendulum(nn.Module):
    """A user's own model, with nothing but what the Protocol asks for: no bins, no heads, no parameters."""

    observation_dim = latent_dim = 2
    action_dim = num_dynamics = 1
    version = torch.zeros((), dtype=torch.int64)

    def encode(self, observation: Tensor) -> Tensor:
        return observation

    def next(self, latent: Tensor, action: Tensor) -> Tensor:
        shape = torch.broadcast_shapes(latent.shape[:-1], action.shape[:-1])
        angle, speed = latent.expand(*shape, 2).unbind(-1)
        speed = speed + 0.5 * action[..., 0]
        return torch.stack([angle + 0.5 * speed, speed], dim=-1)

    def reward(self, latent: Tensor, action: Tensor) -> Tensor:
        return -latent.square().sum(-1) - 0.01 * action.square().sum(-1)

    def values(self, latent: Tensor) -> Tensor:
        return -2 * latent.square().sum(-1, keepdim=True)

    def termination(self, latent: Tensor) -> Tensor | None:
        return None

    def policy(self, latent: Tensor, log_std_bounds: tuple[float, float] | None = None) -> tuple[Tensor, Tensor]:
        return torch.zeros_like(latent[..., :1]), torch.zeros_like(latent[..., :1])

    def act(self, latent: Tensor, noise: Tensor, log_std_bounds: tuple[float, float] | None = None) -> Tensor:
        return noise.clamp(-1, 1)


def test_the_models_of_the_package_are_prediction_models(build):
    for model in (build(), build(termination=True), LineWorld(), LQRWorld(), Pendulum()):
        require_prediction_model(model)
    with pytest.raises(TypeError, match="^world_model must have the members of Pred.*, got Linear without obs"):
        require_prediction_model(nn.Linear(3, 2))
    assert not hasattr(LineWorld(), "bins")


def test_a_model_of_action_values_needs_their_number():
    model = Pendulum()
    model.action_values = lambda latent, action: latent
    with pytest.raises(TypeError, match="^world_model must have .*, got Pendulum without num_values; see "):
        require_prediction_model(model)
    model.num_values = 2
    require_prediction_model(model)


def test_a_model_of_action_values_needs_a_policy(monkeypatch):
    for name in ("policy", "act"):
        monkeypatch.delattr(Pendulum, name)
    model = Pendulum()
    require_prediction_model(model)
    model.action_values, model.num_values = (lambda latent, action: latent), 2
    with pytest.raises(TypeError, match="^world_model must have .*, got Pendulum without policy, act; see "):
        require_prediction_model(model)


def test_a_member_that_is_none_is_missing_but_for_the_size_of_an_observation():
    model = Pendulum()
    model.observation_dim = None
    require_prediction_model(model)
    model.act = None  # half a policy
    with pytest.raises(TypeError, match="^world_model must have .*, got Pendulum without act; see "):
        require_prediction_model(model)
    model.policy = None
    require_prediction_model(model)
    model.action_values, model.num_values = (lambda latent, action: latent), 2
    with pytest.raises(TypeError, match="^world_model must have .*, got Pendulum without policy, act; see "):
        require_prediction_model(model)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_model_of_ones_own_is_planned_over_in_the_dtype_of_its_input(dtype):
    planner = EnsembleMPPIPlanner(LatentEnv(Pendulum(), dtype=dtype), score="final", warm_start=False)
    torch.manual_seed(0)
    observation = torch.tensor([[0.5, 0.5], [-0.2, -0.6]], dtype=dtype)
    plan = planner.plan(observation, explore=False)
    assert plan.action.dtype == planner.draw_noise(2).action.dtype == dtype
    assert (plan.action * observation[:, 1:] < 0).all()  # it brakes
    start = planner.env.reset()
    assert start["latent"].dtype == planner.env.observation_spec["latent"].dtype == dtype
    assert planner.env.rollout(3, planner)["next", "reward"].dtype == dtype


def test_device_and_dtype_are_those_of_the_first_floating_point_tensor():
    class Counter(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.register_buffer("count", torch.zeros((), dtype=torch.int64))
            self.register_buffer("scale", torch.zeros((), dtype=torch.float16))

    assert device_and_dtype(nn.Linear(3, 2).double()) == (torch.device("cpu"), torch.float64)
    assert device_and_dtype(nn.Linear(3, 2, device="meta"), "cpu") == (torch.device("meta"), torch.float32)
    assert device_and_dtype(Counter(), dtype=torch.float64)[1] == torch.float16
    assert device_and_dtype(nn.Module()) == (torch.device("cpu"), torch.float32)
    assert device_and_dtype(nn.Module(), "meta", torch.float64) == (torch.device("meta"), torch.float64)
    torch.set_default_device("meta")
    try:
        assert device_and_dtype(nn.Module())[0].type == "meta"
    finally:
        torch.set_default_device(None)
