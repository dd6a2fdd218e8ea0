from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Callable
from typing import Any

import pytest
import torch
from tensordict import TensorDict

from torchrl_etdmpc.planners import FinalScore, MeanScore
from torchrl_etdmpc.testing import random_slices
from torchrl_etdmpc.training import Agent, build_agent, build_planner, build_world_model, preset
from torchrl_etdmpc.training.config import PlannerConfig

OBSERVATION_DIM, ACTION_DIM = 5, 2
COMPILE_OPTIONS = {
    "options": dict.fromkeys(("fallback_random", "cpp_wrapper", "cpp_wrapper_build_separate"), True),
    "dynamic": False,
    "fullgraph": True,
}
PLANNERS = ("planner", "eval_planner", "reanalyze_planner")


@pytest.fixture
def tiny_agent(tiny_config) -> Callable[..., Agent]:
    """Makes an agent; a group of the configuration is changed by a dictionary."""

    def make(action_dim: int = ACTION_DIM, **changes: Any) -> Agent:
        torch.manual_seed(0)
        return build_agent(tiny_config(**changes), OBSERVATION_DIM, action_dim)

    return make


@pytest.fixture
def compiled(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Any, dict]]:
    """Records what would be compiled, and with which options, without compiling it."""
    calls: list[tuple[Any, dict]] = []

    def compile(function: Any, **options: Any) -> Any:
        calls.append((function, options))
        return function

    monkeypatch.setattr(torch, "compile", compile)
    return calls


@pytest.mark.parametrize("name", ["efficient-tdmpc-utd4", "bmpc", "cpu"])
def test_the_networks_have_the_sizes_of_the_preset(name):
    config = preset(name).model
    model = build_world_model(config, OBSERVATION_DIM, ACTION_DIM)
    weights = {name: parameter.shape for name, parameter in model.named_parameters()}
    assert weights["encoder.hidden.0.weight"][-2:] == (OBSERVATION_DIM, config.encoder_dim)
    assert "encoder.hidden.1.weight" not in weights
    assert weights["dynamics.hidden.1.weight"] == (config.num_dynamics, config.mlp_dim, config.mlp_dim)
    assert weights["value_head.output.weight"] == (config.num_values, config.mlp_dim, config.num_bins)
    assert weights["policy.output.weight"][-1] == 2 * ACTION_DIM
    assert model.encode(torch.zeros(OBSERVATION_DIM)).shape == (config.latent_dim,)
    assert (model.bins[0].item(), model.bins[-1].item(), len(model.bins)) == (-10, 10, 21 if name == "cpu" else 101)
    assert model.policy.log_std_bounds == (-3, 1)
    assert [layer.dropout for layer in model.value_head.hidden] == [0.01, 0]
    assert model.termination_head is None


def test_the_networks_that_no_preset_changes_can_be_changed(tiny_config):
    options = {"encoder_layers": 2, "dropout": 0.25, "activation": "relu", "termination": True, "simnorm_dim": 4}
    options |= {"bin_min": -2.0, "bin_max": 3.0, "num_bins": 11, "log_std_min": -1.0, "log_std_max": 2.0}
    model = build_world_model(tiny_config(model=options).model, OBSERVATION_DIM, ACTION_DIM)
    assert len(model.encoder.hidden) == 2
    assert model.value_head.hidden[0].dropout == 0.25
    assert model.encoder.hidden[0].activation is torch.nn.functional.relu
    assert model.termination_head is not None
    latent = model.encode(torch.randn(OBSERVATION_DIM))
    assert latent.sum().item() == pytest.approx(16 / 4)  # every group of SimNorm sums to one
    torch.testing.assert_close(model.bins, torch.linspace(-2, 3, 11))
    assert model.policy.log_std_bounds == (-1, 2)


def test_every_setting_of_the_planner_arrives(tiny_config):
    values = {"horizon": 4, "num_samples": 20, "num_elites": 5, "num_proposals": 3, "iterations": 7}
    values |= {"inverse_temperature": 0.7, "std_min": 0.1, "std_max": 1.5, "initial": "policy"}
    values |= {"first_action": "mean", "eval_first_action": "elite"}
    config = PlannerConfig(**values, score="final", beta=2.0)
    world_model = build_world_model(tiny_config().model, OBSERVATION_DIM, ACTION_DIM)
    planner = build_planner(world_model, config, discount=0.9, warm_start=True)
    assert {name: getattr(planner, name) for name in values} == values
    assert planner.score == FinalScore(beta=2.0)
    assert planner.discount == 0.9


def test_reanalyze_refuses_what_it_never_does(tiny_config):
    with pytest.raises(
        ValueError, match=r"^reanalyze\.eval_first_action has no effect, .*, got 'mean'; leave it out, or"
    ):
        build_agent(tiny_config(reanalyze={"eval_first_action": "mean"}), OBSERVATION_DIM, ACTION_DIM)


@pytest.mark.parametrize(("name", "beta"), [("efficient-tdmpc-utd4", 0.0), ("humanoidbench", 10.0)])
def test_the_paper_s_planners_are_built_from_its_presets_and_reanalyze_alone_is_pessimistic(tiny_config, name, beta):
    config = dataclasses.replace(preset(name), compile="off", model=tiny_config().model)
    agent = build_agent(config, OBSERVATION_DIM, ACTION_DIM)
    for planner in (agent.planner, agent.eval_planner):
        assert (planner.horizon, planner.num_samples, planner.num_elites, planner.num_proposals) == (6, 512, 64, 24)
        assert planner.score == MeanScore(beta=0.0)
    planner = agent.reanalyze_planner
    assert (planner.horizon, planner.num_samples, planner.num_elites, planner.num_proposals) == (3, 64, 8, 3)
    assert planner.score == FinalScore(beta=beta)


def test_the_discount_follows_from_the_episode_s_length_unless_it_is_given(tiny_agent):
    agents = tiny_agent(episode_length=None), tiny_agent(episode_length=400), tiny_agent(loss={"discount": 0.9})
    for agent, expected in zip(agents, (0.99, 0.975, 0.9), strict=True):
        assert agent.loss.discount.item() == pytest.approx(expected)
        assert [getattr(agent, name).discount for name in PLANNERS] == pytest.approx([expected] * 3)


def test_the_loss_and_the_updater_take_their_settings(tiny_agent):
    loss = {"consistency_coef": 1.0, "reward_coef": 2.0, "value_coef": 3.0, "entropy_coef": 4.0, "rho": 0.25}
    loss |= {"termination_coef": 5.0}
    agent = tiny_agent(
        model={"termination": True},
        loss={**loss, "kl_direction": "forward", "tau": 0.125},
        optim={"lr": 0.5, "encoder_lr_scale": 0.25, "grad_clip_norm": 7.0},
    )
    assert {name: getattr(agent.loss, name).item() for name in loss} == loss
    assert (agent.loss.kl_direction, agent.loss.scale_tau) == ("forward", 0.125)
    batch, targets = random_slices(OBSERVATION_DIM, ACTION_DIM), []
    for pessimistic in (tiny_agent(), tiny_agent(loss={"value_beta": 100.0})):
        with torch.no_grad():  # two heads that say -1 and 1 in symlog space
            pessimistic.loss.target_value_params.data["output", "bias"].zero_()[..., [0, 1], [0, -1]] = 1e3
        targets.append(pessimistic.loss(batch)["value_target"])
    assert targets[1] < targets[0] - 100
    assert agent.updater.tau == 0.125
    assert agent.updater.grad_clip_norm == 7
    assert [group["lr"] for group in agent.updater.optimizer.param_groups] == [0.125, 0.5, 0.5]


def test_loss_and_planners_share_one_world_model(tiny_agent):
    agent = tiny_agent(optim={"lr": 0.1})
    assert all(getattr(agent, name).world_model is agent.world_model for name in PLANNERS)
    assert agent.loss.world_model is agent.world_model
    observation = torch.randn(4, OBSERVATION_DIM)
    noise = {name: getattr(agent, name).draw_noise(4) for name in PLANNERS}
    plan = {name: getattr(agent, name).plan(observation, noise=noise[name]) for name in PLANNERS}
    again = {name: getattr(agent, name).plan(observation, noise=noise[name]) for name in PLANNERS}
    agent.updater.step(random_slices(OBSERVATION_DIM, ACTION_DIM))
    for name in PLANNERS:
        after = getattr(agent, name).plan(observation, noise=noise[name])
        assert torch.equal(plan[name].mean, again[name].mean)
        assert not torch.equal(plan[name].mean, after.mean), f"the {name} did not see the update"


def test_acting_planners_start_warm_and_reanalyze_starts_cold_with_widened_bounds(tiny_agent):
    agent = tiny_agent()
    for planner in (agent.planner, agent.eval_planner):
        assert planner.warm_start
        assert "plan_mean" in planner.in_keys
        assert planner.proposal_log_std_bounds is None
    assert not agent.reanalyze_planner.warm_start
    assert agent.reanalyze_planner.in_keys == ["observation"]
    assert agent.reanalyze_planner.proposal_log_std_bounds == (-2, 1)
    other = tiny_agent(reanalyze={"proposal_log_std_min": -1.5, "proposal_log_std_max": 0.5})
    assert other.reanalyze_planner.proposal_log_std_bounds == (-1.5, 0.5)


def test_the_two_acting_planners_are_apart_so_that_an_evaluation_disturbs_nothing(tiny_agent):
    agent = tiny_agent()
    assert agent.planner is not agent.eval_planner


@pytest.mark.parametrize(("action_dim", "extra"), [(20, 0), (21, 2)])
def test_more_than_20_action_dimensions_add_iterations_to_acting_and_to_reanalyze(action_dim, extra, tiny_agent):
    agent = tiny_agent(action_dim, planner={"iterations": 3}, reanalyze={"iterations": 4})
    assert agent.planner.iterations == agent.eval_planner.iterations == 3 + extra
    assert agent.reanalyze_planner.iterations == 4 + extra


def test_an_agent_without_a_compiler_is_eager_and_warns_once(monkeypatch, compiled, tiny_agent):
    monkeypatch.setattr(shutil, "which", lambda name: None)
    with pytest.warns(UserWarning) as caught:
        tiny_agent(compile="auto", total_env_steps=40_000)
    assert [str(warning.message) for warning in caught] == [
        "no C++ compiler found, so nothing is compiled and training is slower; install g++."
    ]
    assert compiled == []


def test_decisions_of_the_random_phase_do_not_pay_for_a_compilation(monkeypatch, compiled, tiny_agent):
    monkeypatch.setattr(shutil, "which", lambda name: "g++")
    for decisions, pays in ((6_999, False), (7_000, True)):  # 6,000 of them with updates
        compiled.clear()
        tiny_agent(compile="auto", total_env_steps=2 * decisions, replay={"seed_decisions": 1_000})
        assert bool(compiled) == pays


def test_the_update_and_every_planner_are_compiled_and_nothing_else(compiled, tiny_agent):
    agent = tiny_agent(compile="default")
    owners = [function.__wrapped__.__self__ for function, _ in compiled]
    assert owners == [agent.updater, agent.planner, agent.eval_planner, agent.reanalyze_planner]
    assert all(options == COMPILE_OPTIONS for _, options in compiled)


@pytest.mark.slow
@pytest.mark.skipif(not any(map(shutil.which, ("g++", "clang++", "c++"))), reason="needs a C++ compiler")
def test_a_compiled_agent_plans_like_an_eager_one(tiny_agent):
    eager, fast = tiny_agent(compile="off"), tiny_agent(compile="default")
    # Reward and value heads begin at zero: all candidates would tie, and which of them are the elites would be chance.
    for parameter in eager.world_model.parameters():
        torch.nn.init.normal_(parameter, std=0.3)
    fast.world_model.load_state_dict(eager.world_model.state_dict())
    for name, states in (("planner", 1), ("reanalyze_planner", 12)):
        reference, planner = getattr(eager, name), getattr(fast, name)
        observation, noise = torch.randn(states, OBSERVATION_DIM), reference.draw_noise(states)
        assert reference.compiled_plan is None
        expected, actual = (plan(observation, noise=noise) for plan in (reference.plan, planner.compiled_plan))
        scores = reference.plan(observation, noise=noise, trace=True).trace.scores
        assert scores.std(-1).min() > 0.01
        for field in ("action", "loc", "scale", "value", "mean"):
            torch.testing.assert_close(getattr(actual, field), getattr(expected, field), rtol=1e-3, atol=1e-4)
        written = planner(TensorDict({"observation": observation, "is_init": torch.ones(states, 1).bool()}, [states]))
        assert written["action"].isfinite().all()


@pytest.mark.parametrize(
    ("setting", "terminates", "head", "ignored"),
    [
        (None, False, False, False),
        (None, True, True, False),
        (True, False, True, False),
        (False, True, False, True),  # bootstraps through the ends of episodes, because it was said so
    ],
)
def test_the_termination_head_follows_the_task_unless_it_is_said(setting, terminates, head, ignored, tiny_agent):
    agent = tiny_agent(terminates=terminates, model={"termination": setting})
    assert (agent.world_model.termination_head is not None) is head
    assert agent.loss.ignore_termination is ignored


def test_an_agent_can_give_up_compilation(monkeypatch, tiny_agent):
    def broken(*args: Any) -> None:
        raise RuntimeError("what was compiled is called")

    monkeypatch.setattr(torch, "compile", lambda function, **options: broken)
    agent = tiny_agent(compile="default")
    assert all(getattr(agent, name).compiled_plan is not None for name in PLANNERS)
    agent.make_eager()
    assert all(getattr(agent, name).compiled_plan is None for name in PLANNERS)
    agent.updater.step(random_slices(OBSERVATION_DIM, ACTION_DIM))


def test_every_planner_plans_with_the_averaged_weights_if_asked(tiny_agent):
    agent = tiny_agent(optim={"average_decay": 0.9})
    planners = agent.planner, agent.eval_planner, agent.reanalyze_planner
    assert all(planner.world_model is agent.acting_model for planner in planners)
    assert agent.acting_model is not agent.world_model
    plain = tiny_agent()
    assert plain.planner.world_model is plain.acting_model is plain.world_model


@pytest.mark.parametrize(
    ("action_values", "loss"),
    [
        (True, {"value_beta": 1.0}),
        (True, {"value_replayed": 1.0}),
        (True, {"value_expectile": 0.7}),
        (True, {"kl_direction": "forward"}),
        (False, {"squashed_entropy": False}),
    ],
)
def test_a_setting_that_the_kind_of_values_has_no_use_for_is_refused(tiny_agent, action_values, loss):
    (name,) = loss
    message = rf"loss\.{name} has no effect with model.action_values={str(action_values).lower()}, got .*; leave it at"
    with pytest.raises(ValueError, match=message):
        tiny_agent(model={"action_values": action_values}, loss=loss)
