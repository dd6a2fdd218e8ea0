"""What the planner says about itself, also after it was moved, cast, or asked for less."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.envs.utils import check_env_specs

from torchrl_etdmpc import ActionValueWorldModel, EfficientTDMPCLoss, EnsembleMPPIPlanner, LatentEnv, WorldModel
from torchrl_etdmpc.envs import make_env
from torchrl_etdmpc.testing import LineWorld

BUDGET = {"horizon": 2, "num_samples": 8, "num_elites": 2, "num_proposals": 1, "iterations": 2}


def make_planner(**options) -> EnsembleMPPIPlanner:
    model = WorldModel(3, 1, latent_dim=16, mlp_dim=16, num_dynamics=2)
    return EnsembleMPPIPlanner(LatentEnv(model), **(BUDGET | options))


def states(count: int = 5, **like) -> TensorDict:
    data = {"observation": torch.randn(count, 3, **like), "plan_mean": torch.zeros(count, 2, 1, **like)}
    return TensorDict(data, batch_size=[count])


def leaves(spec):
    return dict(spec.items(True, True))


def test_the_spec_has_every_out_key_as_it_is_written():
    planner = make_planner()
    out = planner(states())
    assert set(leaves(planner.spec)) == set(planner.out_keys)
    for key, spec in leaves(planner.spec).items():
        assert (out[key].shape[1:], out[key].dtype, out[key].device) == (spec.shape, spec.dtype, spec.device), key


@pytest.mark.parametrize("warm_start", [True, False])
def test_a_collector_s_constructor_spends_no_plan_and_moves_no_random_numbers(warm_start, monkeypatch):
    planner, calls = make_planner(warm_start=warm_start), []
    plan = planner.plan
    monkeypatch.setattr(planner, "plan", lambda *args, **kwargs: calls.append(1) or plan(*args, **kwargs))
    env = make_env("gym/Pendulum-v1", seed=0)
    if warm_start:
        env = env.append_transform(planner.make_tensordict_primer())
    before = torch.get_rng_state()
    collector = Collector(env, planner, frames_per_batch=4, total_frames=4, auto_register_policy_transforms=False)
    assert not calls
    assert torch.equal(torch.get_rng_state(), before)
    batch = next(iter(collector))
    collector.shutdown()
    assert len(calls) == 4
    assert batch["plan", "loc"].any()


def test_a_cast_takes_specs_and_primer_along():
    planner = make_planner().double()
    env = planner.env
    specs = [*leaves(env.observation_spec).values(), *leaves(env.state_spec).values(), env.action_spec, env.reward_spec]
    specs += [planner.action_spec, *leaves(planner.make_tensordict_primer().primers).values()]
    assert {spec.dtype for spec in specs} == {torch.float64}
    assert {spec.dtype for spec in leaves(planner.spec).values()} == {torch.float64, torch.int64, torch.bool}
    assert planner(states(dtype=torch.float64))["action"].dtype == torch.float64
    rollout = env.rollout(2, tensordict=env.reset(states(dtype=torch.float64).select("observation")), auto_reset=False)
    assert rollout["latent"].dtype == torch.float64


def test_a_move_takes_specs_and_device_along():
    planner = make_planner().to("meta")
    env = planner.env
    specs = [*leaves(env.observation_spec).values(), env.action_spec, env.reward_spec, planner.action_spec]
    specs += [*leaves(planner.spec).values(), *leaves(planner.make_tensordict_primer().primers).values()]
    assert {spec.device.type for spec in specs} == {env.device.type} == {"meta"}


def test_a_world_without_parameters_is_cast_too():
    env = LatentEnv(LineWorld())
    assert env.double().reward_spec.dtype == torch.float64
    check_env_specs(LatentEnv(LineWorld()), seed=0)


@pytest.mark.parametrize("keys", [["action"], ["action", ("plan", "loc")]])
@pytest.mark.parametrize("warm", [True, False])
def test_out_keys_can_be_selected(keys, warm):
    planner = make_planner()
    everything = planner.out_keys
    with pytest.warns(
        UserWarning, match=r"^without \('next', 'plan_mean'\) every plan starts cold; leave it among the"
    ):
        planner.select_out_keys(*keys)
    data = states() if warm else states().select("observation").set("is_init", torch.ones(5, 1, dtype=torch.bool))
    given = set(data.keys())
    out = planner(data)
    assert {key for key in out.keys(True, True) if key not in given and key != "plan_mean"} == set(keys)
    planner.reset_out_keys()
    assert planner.out_keys == everything


def test_a_cold_planner_without_flags_lets_its_keys_be_selected():
    planner = make_planner()
    planner.select_out_keys("action", ("next", "plan_mean"))
    with pytest.warns(UserWarning, match="every plan starts cold"):
        out = planner(states().select("observation"))
    assert set(out.keys(True, True)) == {"observation", "action"}


def test_the_keys_of_a_planner_that_starts_cold_are_selected_in_silence():
    assert make_planner(warm_start=False).select_out_keys("action").out_keys == ["action"]


def test_only_what_is_written_can_be_selected():
    planner = make_planner(warm_start=False)
    with pytest.raises(ValueError, match=r"^out_keys must be some of \['action', .*\], got \['torque'\]\.$"):
        planner.select_out_keys("action", "torque")
    assert planner.out_keys == make_planner(warm_start=False).out_keys


def test_forward_takes_a_generator():
    planner, data = make_planner(), states()
    before = torch.get_rng_state()
    first, second = (planner(data.clone(), generator=torch.Generator().manual_seed(4))["action"] for _ in range(2))
    assert torch.equal(torch.get_rng_state(), before)
    assert torch.equal(first, second)
    assert not torch.equal(planner(data.clone(), generator=torch.Generator().manual_seed(5))["action"], first)


# tensordict reads a switch that torch deprecates
@pytest.mark.filterwarnings("ignore:torch._dynamo.config.inline_inbuilt_nn_modules:FutureWarning")
def test_a_compiled_planner_takes_batches_of_several_sizes():
    planner = EnsembleMPPIPlanner(LatentEnv(LineWorld()), **(BUDGET | {"iterations": 1}))
    torch.compiler.reset()
    compiled = torch.compile(planner.plan, backend="eager")
    for count in (2, 5, 7):
        observation = torch.randn(count, 1)
        torch.manual_seed(0)
        expected = planner.plan(observation).action
        torch.manual_seed(0)
        assert torch.equal(compiled(observation).action, expected)
    module = torch.compile(planner, backend="eager")
    for count in (2, 5):
        data = TensorDict({"observation": torch.randn(count, 1), "plan_mean": torch.zeros(count, 2, 1)}, [count])
        assert module(data)["action"].shape == (count, 1)


def test_the_repr_says_how_the_planner_plans():
    assert "horizon=2, num_samples=8, num_elites=2" in repr(make_planner())
    assert "score=" in repr(make_planner())


def test_a_generator_draws_for_the_entries_whatever_the_batch_size_says():
    planner, data = make_planner(), states()
    latents = data.exclude("observation").set("latent", planner.world_model.encode(data["observation"]))
    for entries in (data, latents):
        drawn = [
            planner(TensorDict(entries.to_dict(), size), generator=torch.Generator().manual_seed(4))["action"]
            for size in ([], data.batch_size)
        ]
        assert torch.equal(*drawn)


def test_specs_follow_a_world_model_that_its_loss_casts_or_moves():
    model = WorldModel(3, 2, latent_dim=16, mlp_dim=16)
    planner = EnsembleMPPIPlanner(LatentEnv(model), horizon=2, num_samples=8, num_elites=4, num_proposals=2)
    EfficientTDMPCLoss(model, discount=0.99).to(torch.float64)
    assert planner.action_spec.dtype == torch.float64
    assert planner.spec["action"].dtype == planner.spec["plan", "loc"].dtype == torch.float64
    latent = LatentEnv(model)
    model.float()
    reset = latent.reset(TensorDict(observation=torch.zeros(3)))
    assert reset["latent"].dtype == latent.observation_spec["latent"].dtype == torch.float32
    model.to("meta")  # in the place of a GPU
    assert planner.spec["action"].device.type == planner.spec["plan", "loc"].device.type == "meta"


@pytest.mark.parametrize("scoring_dtype", [None, "float64"])
def test_a_planner_whose_environment_gets_another_model_plans_with_that_one(scoring_dtype):
    torch.manual_seed(0)
    planner, other = (make_planner(scoring_dtype=scoring_dtype) for _ in range(2))
    observation = torch.randn(4, 3)
    noise = planner.draw_noise(4)
    planner.plan(observation, noise=noise)
    planner.env = other.env
    assert [*map(id, planner.parameters())] == [*map(id, other.parameters())]
    assert planner.state_dict().keys() == other.state_dict().keys()
    for mine, theirs in zip(planner.plan(observation, noise=noise), other.plan(observation, noise=noise), strict=True):
        if isinstance(mine, torch.Tensor):
            torch.testing.assert_close(mine, theirs, rtol=0, atol=0)


def test_what_is_drawn_fits_the_model_that_the_environment_has_now():
    planner = make_planner()
    for num_values in (3, 2):
        planner.env = LatentEnv(ActionValueWorldModel(3, 1, latent_dim=16, mlp_dim=16, num_values=num_values))
        assert planner.draw_noise(4).heads.shape[-1] == num_values
        assert planner.plan(torch.randn(4, 3)).value.isfinite().all()
