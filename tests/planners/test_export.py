from __future__ import annotations

import copy
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
    budget = {"horizon": 2, "num_samples": 24, "num_elites": 6, "num_proposals": 4, "iterations": 1}
    return EnsembleMPPIPlanner(LatentEnv(model), **(budget | options))


def assert_plans_like(planner: EnsembleMPPIPlanner, program: torch.nn.Module, states: int) -> None:
    dtype, action_dim = planner.draw_noise(1).action.dtype, planner.world_model.action_dim
    observation = torch.randn(states, 5, dtype=dtype)
    plan_mean = torch.rand(states, 2, action_dim, dtype=dtype) * 2 - 1
    torch.manual_seed(1)
    found = program(observation, plan_mean)
    torch.manual_seed(1)
    plan = planner.plan(observation, plan_mean if planner.warm_start else None, explore=False)
    torch.testing.assert_close(found, (plan.action, plan.mean))
    assert not torch.equal(program(observation, plan_mean)[1], found[1])  # new noise


def not_to_be_called(*args, **kwargs):
    raise AssertionError("the compiled plan was called")


@pytest.fixture(scope="module")
def exported() -> tuple[EnsembleMPPIPlanner, torch.nn.Module, torch.nn.Module]:
    """A planner, and the programs that are made of its policy and of itself."""
    planner = make_planner(make_model(), iterations=2)
    planner.compiled_plan = not_to_be_called
    return planner, export_policy(planner.world_model).module(), export_planner(planner).module()


def test_the_exported_policy_acts_like_the_live_one_for_any_number_of_states(exported):
    planner, policy, _ = exported
    for states in (1, 2, 7):
        observation = torch.randn(states, 5)
        with torch.no_grad():
            expected, _ = planner.world_model.policy(planner.world_model.encode(observation))
            torch.testing.assert_close(policy(observation), expected)


def test_the_exported_planner_plans_like_the_live_one_and_a_compiled_plan_is_left_aside(exported):
    planner, _, program = exported
    assert planner.compiled_plan is not_to_be_called
    assert_plans_like(planner, program, 1)


def test_statistics_and_weights_in_double_precision_are_exported():
    model = make_model(normalize_observations=True)
    model.encoder.observe(5 + 3 * torch.randn(64, 5))
    planner = make_planner(model.double())
    assert_plans_like(planner, export_planner(planner, batch_size=3).module(), 3)


@pytest.mark.parametrize(
    ("make", "warm_start"), [(lambda: make_model(termination=True), True), (lambda: LineWorld(action_dim=5), False)]
)
def test_one_exported_planner_plans_for_any_number_of_states(make, warm_start):
    planner = make_planner(make(), warm_start=warm_start)
    program = export_planner(planner, batch_size=None).module()
    for states in (1, 2, 7):
        assert_plans_like(planner, program, states)


def test_an_exported_program_does_not_follow_the_live_weights(exported):
    live, policy, planner = exported
    model, observation = live.world_model, torch.randn(1, 5)
    weights = copy.deepcopy(model.state_dict())

    def act() -> list[torch.Tensor]:
        torch.manual_seed(0)
        return [policy(observation), planner(observation, torch.zeros(1, 2, 2))[0]]

    before = act()
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.5)
    try:
        torch.testing.assert_close(act(), before, rtol=0, atol=0)
    finally:
        model.load_state_dict(weights)


def an_agents_planner() -> EnsembleMPPIPlanner:
    """Its weights are views of a few pieces of memory."""
    model = {"latent_dim": 16, "mlp_dim": 16, "encoder_dim": 16}
    planner = {"horizon": 2, "num_samples": 8, "num_elites": 4, "num_proposals": 2, "iterations": 1}
    config = TrainConfig.from_dict({"compile": "off", "model": model, "planner": planner})
    return build_agent(config, 5, 2).eval_planner


# A warning is an error here: PyTorch warns of tensors that are parts of others when it saves them.
def test_a_file_holds_the_weights_that_its_program_needs_and_nothing_else(tmp_path):
    planner = an_agents_planner()
    model, files = planner.world_model, [tmp_path / "policy.pt2", tmp_path / "planner.pt2"]
    for program, file in zip([export_policy(model), export_planner(planner)], files, strict=True):
        torch.export.save(program, file)
    networks = [parameters_to_vector(part.parameters()).nbytes for part in (model.encoder, model.policy, model)]
    buffers = sum(buffer.nbytes for buffer in model.buffers())
    assert [stored_bytes(file) for file in files] == [sum(networks[:2]) + buffers, networks[2] + buffers]


def stored_bytes(path: Path) -> int:
    with zipfile.ZipFile(path) as file:
        return sum(entry.file_size for entry in file.infolist() if "/data/weights/weight_" in entry.filename)


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
