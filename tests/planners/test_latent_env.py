from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs

from torchrl_etdmpc import LatentEnv, WorldModel


def make_model(**options) -> WorldModel:
    """A small world model with three dynamics heads whose rewards are not zero."""
    model = WorldModel(3, 2, latent_dim=16, mlp_dim=32, encoder_dim=16, num_dynamics=3, **options)
    torch.nn.init.normal_(model.reward_head.output.weight)
    return model


@pytest.mark.parametrize("termination", [False, True])
@pytest.mark.parametrize("head", [None, 2])
def test_the_specs_are_those_of_what_it_returns(head, termination):
    check_env_specs(LatentEnv(make_model(termination=termination), head=head))


@pytest.mark.parametrize("batch_size", [(), (5,), (2, 3)])
@pytest.mark.parametrize("head", [None, 0, 2])
def test_a_step_is_one_step_of_the_world_model(head, batch_size):
    model = make_model()
    env = LatentEnv(model, head=head)
    start = env.reset(TensorDict({"observation": torch.randn(*batch_size, 3)}, batch_size=batch_size))
    action = torch.rand(*batch_size, 2) * 2 - 1
    after = env.step(start.set("action", action))["next"]
    following = [model.next(start["latent"].unsqueeze(0), action)[i] for i in range(3)]
    assert not torch.allclose(following[0], following[2], atol=1e-3)
    expected = sum(following) / 3 if head is None else following[head]
    torch.testing.assert_close(after["latent"], expected)
    torch.testing.assert_close(after["reward"], model.reward(start["latent"], action).unsqueeze(-1))
    assert after["reward"].abs().min() > 0
    assert after["reward"].shape == after["done"].shape == after["terminated"].shape == (*batch_size, 1)
    assert not after["done"].any()


def test_a_reset_encodes_the_observation():
    model = make_model()
    observation = torch.randn(5, 3)
    start = LatentEnv(model).reset(TensorDict({"observation": observation}, batch_size=[5]))
    torch.testing.assert_close(start["latent"], model.encode(observation))
    assert not start["done"].any()


def test_a_reset_encodes_what_stands_under_another_key():
    model, observation = make_model(), torch.randn(5, 3)
    start = LatentEnv(model, observation_key=("sensors", "all")).reset(
        TensorDict({"sensors": {"all": observation}}, batch_size=[5])
    )
    torch.testing.assert_close(start["latent"], model.encode(observation))


def test_a_reset_from_states_that_it_does_not_know_is_refused():
    states = TensorDict({"state": torch.randn(5, 3), "done": torch.zeros(5, 1, dtype=torch.bool)}, batch_size=[5])
    with pytest.raises(KeyError, match="LatentEnv starts from 'latent' or 'observation', got 'state'; pass LatentEnv"):
        LatentEnv(make_model()).reset(states)
    assert LatentEnv(make_model()).reset(states.exclude("state"))["latent"].shape == (5, 16)


def test_a_reset_takes_a_latent_as_it_is():
    latent = torch.rand(2, 4, 16)
    start = LatentEnv(make_model()).reset(TensorDict({"latent": latent}, batch_size=[2, 4]))
    assert torch.equal(start["latent"], latent)


def test_a_latent_comes_before_an_observation_beside_it():
    start = TensorDict({"latent": torch.rand(4, 16), "observation": torch.rand(4, 3)}, batch_size=[4])
    assert torch.equal(LatentEnv(make_model()).reset(start.clone())["latent"], start["latent"])


def test_a_reset_from_nothing_encodes_zeros_in_the_batch_that_is_asked_for():
    model = make_model()
    env = LatentEnv(model)
    zero = model.encode(torch.zeros(3))
    torch.testing.assert_close(env.reset()["latent"], zero)
    torch.testing.assert_close(env.reset(TensorDict(batch_size=[4]))["latent"], zero.expand(4, 16))


def test_a_rollout_imagines_the_plan_step_by_step():
    model = make_model()
    env = LatentEnv(model, head=1)
    actions = torch.rand(6, 4, 2) * 2 - 1
    steps = iter(actions)
    start = env.reset(TensorDict({"observation": torch.randn(4, 3)}, batch_size=[4]))
    imagined = env.rollout(6, lambda td: td.set("action", next(steps)), tensordict=start, auto_reset=False)
    latent = start["latent"]
    for step, action in enumerate(actions):
        torch.testing.assert_close(imagined["latent"][:, step], latent)
        torch.testing.assert_close(imagined["next", "reward"][:, step, 0], model.reward(latent, action))
        latent = model.next(latent.unsqueeze(0), action)[1]
    torch.testing.assert_close(imagined["next", "latent"][:, -1], latent)


def test_an_episode_ends_where_its_termination_is_more_likely_than_not(monkeypatch):
    model = make_model(termination=True)
    probability = torch.tensor([0.4, 0.6, 0.5])
    monkeypatch.setattr(model, "termination", lambda latent: probability)
    env = LatentEnv(model)
    start = env.reset(TensorDict({"observation": torch.randn(3, 3)}, batch_size=[3]))
    after = env.rand_step(start)["next"]
    assert after["terminated"].flatten().tolist() == [False, True, False]
    assert torch.equal(after["done"], after["terminated"])


def test_the_termination_head_reads_the_latent_that_was_reached(monkeypatch):
    model, read = make_model(termination=True), []
    monkeypatch.setattr(model, "termination", lambda latent: read.append(latent) or torch.zeros(latent.shape[:-1]))
    env = LatentEnv(model, head=0)
    after = env.rand_step(env.reset())["next"]
    assert len(read) == 1
    assert torch.equal(read[0], after["latent"])


def test_a_rollout_stops_where_the_episode_ends(monkeypatch):
    model = make_model(termination=True)
    monkeypatch.setattr(model, "termination", lambda latent: torch.ones(latent.shape[:-1]))
    assert LatentEnv(model).rollout(10).batch_size == (1,)


def test_the_world_model_is_shared_not_copied():
    model = make_model()
    env = LatentEnv(model)
    assert env.world_model is model
    before = env.reset()["latent"]
    with torch.no_grad():
        for weight in model.encoder.parameters():
            weight.add_(torch.randn_like(weight))
    assert not torch.allclose(env.reset()["latent"], before)


def test_the_world_model_stays_on_its_device():
    # The meta device stands for any device that is not the default one.
    model = make_model().to("meta")
    env = LatentEnv(model)
    assert {tensor.device.type for tensor in (*model.parameters(), *model.buffers())} == {"meta"}
    assert env.device.type == env.action_spec.device.type == env.observation_spec["latent"].device.type == "meta"


def test_the_latents_have_the_dtype_of_the_world_model():
    env = LatentEnv(make_model().double())
    check_env_specs(env)
    assert env.rollout(2)["next", "latent"].dtype == torch.float64


def test_a_step_changes_nothing_that_was_passed():
    env = LatentEnv(make_model())
    start = env.rand_action(env.reset(TensorDict({"observation": torch.randn(5, 3)}, batch_size=[5])))
    before = start.clone()
    env.step(start)
    assert (start.select(*before.keys(True, True)) == before).all()


def test_imagined_rewards_can_be_differentiated():
    env = LatentEnv(make_model())
    action = torch.zeros(2, requires_grad=True)
    env.step(env.reset().set("action", action))["next", "reward"].sum().backward()
    assert action.grad.abs().sum() > 0


def test_a_seed_makes_no_difference():
    env = LatentEnv(make_model())
    starts = []
    for seed in (0, 1):
        env.set_seed(seed)
        starts.append(env.reset()["latent"])
    assert torch.equal(*starts)


@pytest.mark.parametrize("head", [-1, 3])
def test_a_head_that_does_not_exist_is_refused(head):
    with pytest.raises(ValueError, match=rf"^head must be in 0\.\.2 or None, got {head}\.$"):
        LatentEnv(make_model(), head=head)


def test_a_model_that_lacks_a_member_is_told_which():
    class Half(torch.nn.Module):
        observation_dim, action_dim, latent_dim, num_dynamics = 3, 2, 3, 1
        encode = next = reward = values = policy = staticmethod(torch.zeros_like)

    with pytest.raises(
        TypeError,
        match=r"^world_model must have the members of PredictionModel, got Half without version, termination, act; see "
        r"torchrl_etdmpc\.modules\.PredictionModel\.$",
    ):
        LatentEnv(Half())


def test_a_model_that_is_no_module_is_refused():
    class Plain:
        observation_dim, action_dim, latent_dim, num_dynamics, version = 3, 2, 3, 1, torch.zeros((), dtype=torch.int64)
        encode = next = reward = values = policy = termination = act = staticmethod(torch.zeros_like)

    with pytest.raises(
        TypeError, match=r"^world_model must be a torch\.nn\.Module, got Plain; derive it from nn\.Module\.$"
    ):
        LatentEnv(Plain())
