from __future__ import annotations

import zipfile
from pathlib import Path

import pytest
import torch
from torch.nn.utils import parameters_to_vector

from torchrl_etdmpc import EnsembleMPPIPlanner, LatentEnv, WorldModel, export_planner, export_policy
from torchrl_etdmpc.testing import LineWorld
from torchrl_etdmpc.training import TrainConfig, build_agent


def make_model(**options) -> WorldModel:
    torch.manual_seed(0)
    model = WorldModel(5, 2, latent_dim=16, mlp_dim=16, encoder_dim=16, **options)
    for parameter in model.parameters():
        if parameter.ndim > 1:
            torch.nn.init.normal_(parameter, std=parameter.shape[-2] ** -0.5)
    return model


def make_planner(model: torch.nn.Module, **options) -> EnsembleMPPIPlanner:
    budget = {"horizon": 2, "num_samples": 24, "num_elites": 6, "num_proposals": 4, "iterations": 2}
    return EnsembleMPPIPlanner(LatentEnv(model), **budget, **options)


@pytest.mark.parametrize("states", [1, 2, 7])
def test_the_exported_policy_acts_like_the_live_one_for_any_number_of_states(states):
    model, observation = make_model(), torch.randn(states, 5)
    with torch.no_grad():
        expected, _ = model.policy(model.encode(observation))
        torch.testing.assert_close(export_policy(model).module()(observation), expected)


def make_standardising_model() -> WorldModel:
    model = make_model(normalize_observations=True)
    model.encoder.observe(5 + 3 * torch.randn(64, 5))
    return model


@pytest.mark.parametrize(
    ("make", "states"),
    [
        (make_model, 1),
        (make_standardising_model, 3),
        (lambda: make_model().double(), 3),
        (lambda: LineWorld(action_dim=5), 1),
    ],
)
def test_the_exported_planner_plans_like_the_live_one_and_draws_new_noise(make, states):
    planner = make_planner(make())
    dtype = planner.draw_noise(1).action.dtype
    observation = torch.randn(states, 5, dtype=dtype)
    plan_mean = torch.rand(states, 2, planner.world_model.action_dim, dtype=dtype) * 2 - 1
    program = export_planner(planner, batch_size=states).module()
    torch.manual_seed(1)
    action, mean = program(observation, plan_mean)
    torch.manual_seed(1)
    plan = planner.plan(observation, plan_mean, explore=False)
    torch.testing.assert_close(action, plan.action)
    torch.testing.assert_close(mean, plan.mean)
    assert not torch.equal(program(observation, plan_mean)[1], mean)


@pytest.mark.parametrize("make", [lambda: make_model(termination=True), lambda: LineWorld(action_dim=5)])
def test_one_exported_planner_plans_for_any_number_of_states(make):
    planner = make_planner(make())
    program = export_planner(planner, batch_size=None).module()
    for states in (1, 2, 7):
        observation, plan_mean = torch.randn(states, 5), torch.rand(states, 2, planner.world_model.action_dim) * 2 - 1
        torch.manual_seed(1)
        action, mean = program(observation, plan_mean)
        torch.manual_seed(1)
        plan = planner.plan(observation, plan_mean, explore=False)
        torch.testing.assert_close(action, plan.action)
        torch.testing.assert_close(mean, plan.mean)


def test_a_compiled_plan_is_not_what_is_exported():
    planner = make_planner(make_model())

    def fail(*args, **kwargs):
        raise AssertionError("the compiled plan was called")

    planner.compiled_plan = fail
    export_planner(planner)
    assert planner.compiled_plan is fail


def an_agents_planner() -> EnsembleMPPIPlanner:
    """Its weights are views of a few pieces of memory."""
    model = {"latent_dim": 16, "mlp_dim": 16, "encoder_dim": 16}
    planner = {"horizon": 2, "num_samples": 8, "num_elites": 4, "num_proposals": 2, "iterations": 1}
    config = TrainConfig.from_dict({"compile": "off", "model": model, "planner": planner})
    return build_agent(config, 5, 2).eval_planner


# A warning is an error here: PyTorch warns of tensors that are parts of others when it saves them.
@pytest.mark.parametrize("make", [lambda: make_planner(make_model()), an_agents_planner])
def test_a_file_holds_the_weights_that_its_program_needs_and_nothing_else(make, tmp_path):
    planner = make()
    model, files = planner.world_model, [tmp_path / "policy.pt2", tmp_path / "planner.pt2"]
    for program, file in zip([export_policy(model), export_planner(planner)], files, strict=True):
        torch.export.save(program, file)
    networks = [parameters_to_vector(part.parameters()).nbytes for part in (model.encoder, model.policy, model)]
    buffers = sum(buffer.nbytes for buffer in model.buffers())
    assert [stored_bytes(file) for file in files] == [sum(networks[:2]) + buffers, networks[2] + buffers]


def stored_bytes(path: Path) -> int:
    with zipfile.ZipFile(path) as file:
        return sum(entry.file_size for entry in file.infolist() if "/data/weights/weight_" in entry.filename)


def test_an_exported_program_does_not_follow_the_live_weights():
    model, observation = make_model(), torch.randn(1, 5)
    policy, planner = export_policy(model).module(), export_planner(make_planner(model)).module()

    def act() -> list[torch.Tensor]:
        torch.manual_seed(0)
        return [policy(observation), planner(observation, torch.zeros(1, 2, 2))[0]]

    before = act()
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.5)
    torch.testing.assert_close(act(), before, rtol=0, atol=0)


def test_no_batch_is_refused():
    with pytest.raises(ValueError, match=r"^batch_size must be at least 1, got 0\.$"):
        export_planner(make_planner(make_model()), batch_size=0)


@pytest.mark.parametrize(
    "export", [lambda model, **o: export_policy(model, **o), lambda m, **o: export_planner(make_planner(m), **o)]
)
def test_an_example_that_is_no_tensor_is_refused(export):
    with pytest.raises(
        TypeError, match="observation must be a tensor, got dict; a model that encodes dictionaries cannot"
    ):
        export(make_model(), observation={"pixels": torch.zeros(3)})


def test_a_planner_without_a_warm_start_leaves_the_carried_plan_aside():
    planner = make_planner(make_model(), warm_start=False)
    observation, carried = torch.randn(1, 5), torch.full((1, 2, 2), 0.9)
    program = export_planner(planner).module()
    found = []
    for plan in (carried, torch.zeros(1, 2, 2)):
        torch.manual_seed(1)
        found.append(program(observation, plan)[0])
    assert torch.equal(*found)
