"""World models of TorchRL's own under the planner: a point on a line, whose best actions are known."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase, ModelBasedEnvBase
from torchrl.envs.model_based import WorldModelEnv
from torchrl.envs.utils import ExplorationType, exploration_type, set_exploration_type
from torchrl.modules import RSSMPrior, WorldModel, WorldModelWrapper

from torchrl_etdmpc import EnsembleMPPIPlanner, LatentEnv
from torchrl_etdmpc.modules import require_prediction_model
from torchrl_etdmpc.planners import TorchRLModel

GOAL = 1.0


class Move(nn.Module):
    """``x' = x + a / 2``; the second number of the state is left as it is."""

    def __init__(self) -> None:
        super().__init__()
        self.gain = nn.Parameter(torch.tensor(0.5))

    def forward(self, place: Tensor, mark: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        return place + self.gain * action, mark


def rewarded(place: Tensor) -> Tensor:
    return -(place - GOAL).square()


def wrapper() -> WorldModelWrapper:
    states = ["place", ("hidden", "mark")]
    return WorldModelWrapper(
        TensorDictModule(Move(), in_keys=[*states, "action"], out_keys=states),
        TensorDictModule(rewarded, in_keys=["place"], out_keys=["reward"]),
    )


class Imagined(ModelBasedEnvBase):
    def __init__(self) -> None:
        super().__init__(wrapper())
        self.observation_spec = Composite(place=Unbounded((1,)), hidden=Composite(mark=Unbounded((1,))))
        self.state_spec = self.observation_spec.clone()
        self.action_spec = Bounded(-1, 1, (1,))
        self.reward_spec = Unbounded((1,))

    def _reset(self, tensordict: TensorDictBase, **kwargs) -> TensorDict:
        return TensorDict({"place": torch.zeros(1), "hidden": {"mark": torch.zeros(1)}})


class Real(EnvBase):
    """Never stepped: it has the specs."""

    def __init__(self) -> None:
        super().__init__()
        self.observation_spec = Composite(place=Unbounded((1,)), hidden=Composite(mark=Unbounded((1,))))
        self.action_spec, self.reward_spec = Bounded(-1, 1, (1,)), Unbounded((1,))

    def _reset(self, tensordict=None):
        raise NotImplementedError

    _step = _set_seed = _reset


def full_model() -> WorldModel:
    """Writes below "next" and has an encoder: the observation is the place times ten."""
    states = ["place", ("hidden", "mark")]
    after = [("next", "place"), ("next", "hidden", "mark")]
    return WorldModel(
        TensorDictModule(lambda seen: (seen / 10, torch.zeros_like(seen)), in_keys=["observation"], out_keys=states),
        TensorDictModule(Move(), in_keys=[*states, "action"], out_keys=after),
        TensorDictModule(rewarded, in_keys=[after[0]], out_keys=[("next", "reward")]),
    )


def make(model: nn.Module, **options) -> TorchRLModel:
    return TorchRLModel(model, action_dim=1, state_sizes={"place": 1, ("hidden", "mark"): 1}, **options)


MODELS = {
    "WorldModelWrapper": wrapper,
    "ModelBasedEnvBase": Imagined,
    "WorldModel": full_model,
    "WorldModelEnv": lambda: WorldModelEnv(full_model(), Real()),
}


@pytest.fixture(params=MODELS)
def adapted(request) -> TorchRLModel:
    torch.manual_seed(0)
    return make(MODELS[request.param]())


def observations(model: TorchRLModel, place: Tensor) -> Tensor:
    """As the model takes them: states, or what its encoder reads."""
    return torch.stack([place, torch.zeros_like(place)], -1) if model.encoder is None else 10 * place.unsqueeze(-1)


def test_the_ensemble_planner_finds_the_known_optimum(adapted):
    require_prediction_model(adapted)
    budget = {"horizon": 2, "num_samples": 64, "num_elites": 8, "num_proposals": 0, "iterations": 4}
    planner = EnsembleMPPIPlanner(LatentEnv(adapted), warm_start=False, **budget)
    place = torch.tensor([-1.0, 0.8, 1.0, 1.25, 3.0])
    plan = planner.plan(observations(adapted, place), explore=False)
    best = ((GOAL - place) / 0.5).clamp(-1, 1)
    torch.testing.assert_close(plan.action.squeeze(-1), best, atol=0.15, rtol=0)
    batch = TensorDict({"observation": observations(adapted, place)}, [5])
    assert planner(batch)["plan", "fallback"].any().logical_not()
    assert any(weight is parameter for weight in planner.parameters() for parameter in adapted.model.parameters())


def test_predictions_are_those_of_the_model_in_any_leading_batch(adapted):
    latent, action = torch.randn(1, 4, 1, 2), torch.rand(4, 3, 1) * 2 - 1
    following = adapted.next(latent, action)
    assert following.shape == (1, 4, 3, 2)
    torch.testing.assert_close(following[0, ..., :1], latent[0, ..., :1] + 0.5 * action)
    torch.testing.assert_close(following[0, ..., 1], latent[0, ..., 1].expand(4, 3))
    torch.testing.assert_close(
        adapted.reward(latent.expand(1, 4, 3, 2)[0], action), -(following[0, ..., 0] - GOAL).square()
    )
    assert adapted.values(latent).shape == (1, 4, 1, 1) and adapted.termination(latent) is None


def test_a_model_may_write_its_reward_at_the_root_and_its_states_below_next():
    states = ["place", ("hidden", "mark")]
    written = [("next", "place"), ("next", "hidden", "mark"), "reward"]
    step = TensorDictModule(lambda x, m, a: (x + a, m, 3 * x), in_keys=[*states, "action"], out_keys=written)
    model, latent, action = make(step), torch.tensor([[2.0, 5.0]]), torch.tensor([[0.5]])
    assert model.reward(latent, action).tolist() == [6.0]
    assert model.next(latent, action).tolist() == [[2.5, 5.0]]


def test_an_imagined_rollout_follows_the_plan(adapted):
    env = LatentEnv(adapted)
    planner = EnsembleMPPIPlanner(env, horizon=2, num_samples=64, num_elites=8, num_proposals=0, warm_start=False)
    with torch.no_grad():
        rollout = env.rollout(4, planner)
    assert rollout["next", "latent"][-1, 0] == pytest.approx(GOAL, abs=0.1)


def test_a_prediction_is_no_sample_however_the_agent_explores():
    seen = []

    class Watched(Move):
        def forward(self, place: Tensor, mark: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
            seen.append(exploration_type())
            return super().forward(place, mark, action)

    states = ["place", ("hidden", "mark")]
    move = TensorDictModule(Watched(), in_keys=[*states, "action"], out_keys=states)
    model = make(WorldModelWrapper(move, TensorDictModule(rewarded, in_keys=["place"], out_keys=["reward"])))
    with set_exploration_type(ExplorationType.RANDOM):
        model.next(torch.zeros(1, 2), torch.zeros(1))
    assert set(seen) == {ExplorationType.DETERMINISTIC}


def test_values_and_ends_are_those_that_are_given():
    value = TensorDictModule(lambda place: 3 * place, in_keys=["place"], out_keys=["state_value"])
    latent = torch.tensor([[2.0, 0.0], [1.0, 5.0]])
    assert make(wrapper(), values=value).values(latent).tolist() == [[6.0], [3.0]]
    hidden = TensorDictModule(lambda place: 2 * place, in_keys=["place"], out_keys=["within"])
    value = TensorDictModule(lambda within: within + 1, in_keys=["within"], out_keys=["state_value"])
    assert make(wrapper(), values=TensorDictSequential(hidden, value)).values(latent).tolist() == [[5.0], [3.0]]
    model = make(wrapper(), values=lambda z: z, termination=lambda z: (z[..., 1] > 1).float())
    assert model.values(latent).shape == (2, 2)
    assert model.termination(latent).tolist() == [0.0, 1.0]


@pytest.mark.parametrize("make_imagined", [wrapper, Imagined])
def test_a_state_that_the_model_only_reads_is_refused(make_imagined):
    with pytest.raises(
        ValueError, match=r"^the model does not write 'speed', at the root or below 'next'; it writes \["
    ):
        TorchRLModel(make_imagined(), action_dim=1, state_sizes={"place": 1, "speed": 1})
    with pytest.raises(ValueError, match=r"^the model does not write 'gain', "):
        make(wrapper(), reward_key="gain")


class Stepped(Imagined):
    """Steps by itself, and writes less or more than its specs say."""

    def __init__(self, *left_out: str) -> None:
        super().__init__()
        self.left_out = left_out

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        place = tensordict["place"] + 0.5 * tensordict["action"]
        written = {"place": place, ("hidden", "mark"): place * 0, "reward": rewarded(place), "speed": place}
        done = torch.zeros_like(place, dtype=torch.bool)
        return TensorDict(written | {"done": done, "terminated": done}, tensordict.batch_size).exclude(*self.left_out)


def test_what_an_environment_with_a_step_of_its_own_writes_is_seen_at_its_first():
    sizes = {"place": 1, ("hidden", "mark"): 1}
    TorchRLModel(Stepped(), action_dim=1, state_sizes=sizes | {"speed": 1})
    message = r"^the model does not write '{}', at the root or below 'next'; it writes \[.*'hidden', 'mark'"
    with pytest.raises(ValueError, match=message.format("cost")):
        TorchRLModel(Stepped(), action_dim=1, state_sizes=sizes, reward_key="cost")
    with pytest.raises(ValueError, match=message.format("place")):  # that of before would stay
        TorchRLModel(Stepped("place"), action_dim=1, state_sizes=sizes)


def prior(*out_keys: str) -> WorldModelWrapper:
    move = RSSMPrior(Bounded(-1, 1, (1,)), hidden_dim=8, rnn_hidden_dim=8, state_dim=2)
    move(torch.zeros(1, 2), torch.zeros(1, 8), torch.zeros(1, 1))
    return WorldModelWrapper(
        TensorDictModule(move, in_keys=["state", "belief", "action"], out_keys=list(out_keys)),
        TensorDictModule(lambda state: state.sum(-1, keepdim=True), in_keys=["state"], out_keys=["reward"]),
    )


def test_a_model_that_draws_is_refused_and_its_mean_is_not():
    sizes: dict[str, int] = {"state": 2, "belief": 8}
    before = torch.get_rng_state()
    with pytest.raises(ValueError, match=r"^two steps of the model from one state differ in 'state': plans would be "):
        TorchRLModel(prior("_mean", "_std", "state", "belief"), action_dim=1, state_sizes=sizes)
    model = TorchRLModel(prior("state", "_std", "_sample", "belief"), action_dim=1, state_sizes=sizes)
    latent, action = torch.randn(1, 5, 10), torch.rand(5, 1)
    following = model.next(latent, action)
    assert torch.equal(following, model.next(latent, action))
    torch.testing.assert_close(model.reward(latent[0], action), following[0, :, :2].sum(-1))
    dropout = nn.Sequential(nn.Linear(2, 1), nn.Dropout(0.5))
    move = TensorDictModule(lambda x, action: dropout(torch.cat([x, action], -1)), ["x", "action"], ["x"])
    inside = WorldModelWrapper(move, TensorDictModule(rewarded, in_keys=["x"], out_keys=["reward"]))
    with pytest.raises(ValueError, match=r"differ in 'x': plans .* or call eval\(\) on dropout"):
        TorchRLModel(inside, action_dim=1, state_sizes={"x": 1})
    dropout.eval()
    TorchRLModel(inside, action_dim=1, state_sizes={"x": 1})
    torch.set_rng_state(before)
    TorchRLModel(inside, action_dim=1, state_sizes={"x": 1})
    assert torch.equal(before, torch.get_rng_state())


def test_a_model_whose_reward_alone_is_drawn_is_refused():
    move = TensorDictModule(lambda x, action: x + action, in_keys=["x", "action"], out_keys=["x"])
    drawn = TensorDictModule(lambda x: x + torch.randn_like(x), in_keys=["x"], out_keys=["reward"])
    with pytest.raises(ValueError, match=r"^two steps of the model from one state differ in 'reward': plans would be "):
        TorchRLModel(WorldModelWrapper(move, drawn), action_dim=1, state_sizes={"x": 1})


def test_what_is_no_model_of_torchrl_is_refused():
    with pytest.raises(TypeError, match=r"^model must be a ModelBasedEnvBase or a TensorDict module, got Linear; wrap"):
        make(nn.Linear(2, 2))


BUDGET = {"horizon": 2, "num_samples": 16, "num_elites": 4, "num_proposals": 0, "warm_start": False}


def placed(encoder: TensorDictModule, **keys) -> EnsembleMPPIPlanner:
    move = TensorDictModule(lambda place, action: place + action / 2, in_keys=["place", "action"], out_keys=["place"])
    world = WorldModelWrapper(move, TensorDictModule(rewarded, in_keys=["place"], out_keys=["reward"]))
    model = TorchRLModel(world, action_dim=1, state_sizes={"place": 1}, encoder=encoder, **keys)
    return EnsembleMPPIPlanner(LatentEnv(model), **BUDGET, **keys)


def test_an_encoder_of_images_says_itself_what_the_batch_is():
    encoder = TensorDictModule(lambda image: image.float().mean((-3, -2, -1))[..., None], ["pixels"], ["place"])
    planner = placed(encoder, observation_key="pixels")
    images = torch.full((5, 3, 8, 8), 2, dtype=torch.uint8)
    assert (planner.world_model.encode(images) == 2).all()
    assert planner(TensorDict({"pixels": images}, [5]))["action"].shape == (5, 1)


def test_an_encoder_of_two_entries_reads_them_from_a_nested_observation():
    encoder = TensorDictModule(lambda one, other: one + other, in_keys=["one", "other"], out_keys=["place"])
    planner = placed(encoder, observation_key="seen")
    seen = TensorDict({"one": torch.ones(5, 1), "other": torch.ones(5, 1)}, [5])
    assert (planner.world_model.encode(seen) == 2).all()
    assert planner(TensorDict({"seen": seen}, [5]))["action"].shape == (5, 1)
    with pytest.raises(
        ValueError, match=r"the encoder reads \['one', 'other'\], so an observation must be a TensorDict"
    ):
        planner.world_model.encode(torch.ones(5, 2))


def test_the_next_state_may_stand_below_next_and_the_reward_at_the_root():
    state = ("next", "place")
    move = TensorDictModule(lambda place, action: place + action / 2, in_keys=["place", "action"], out_keys=[state])
    world = WorldModelWrapper(move, TensorDictModule(rewarded, in_keys=[state], out_keys=["reward"]))
    model = TorchRLModel(world, action_dim=1, state_sizes={"place": 1})
    place, action = torch.zeros(1, 1), torch.ones(1, 1)
    assert model.next(place, action).item() == 0.5
    assert model.reward(place, action).item() == -((0.5 - GOAL) ** 2)
