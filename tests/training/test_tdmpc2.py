"""Runs with a critic of actions: built, trained, saved, gone on with and compiled as any other."""

from __future__ import annotations

import shutil
from typing import Any

import pytest
import torch

pytest.importorskip("dm_control")

from torchrl_etdmpc.modules import ActionValueWorldModel  # noqa: E402
from torchrl_etdmpc.objectives import TDMPC2Loss  # noqa: E402
from torchrl_etdmpc.testing import random_slices  # noqa: E402
from torchrl_etdmpc.training import (  # noqa: E402
    RunInterrupted,
    TrainConfig,
    build_agent,
    load_agent,
    save_agent,
)

needs_compiler = pytest.mark.skipif(
    not any(map(shutil.which, ("g++", "clang++", "c++"))), reason="compilation needs a C++ compiler"
)


@pytest.fixture
def tdmpc2_config(tiny_config):
    """Runs of 30 random decisions and 50 learned ones, in episodes of 20."""

    def make(**changes: Any) -> TrainConfig:
        settings = {
            "preset": "tdmpc2-cpu",
            "model": {"action_values": True, "num_dynamics": 1, "num_values": 5},
            "planner": {"score": "final", "eval_first_action": "elite"},
            "reanalyze": {"every": 0},
            "replay": {"insertion": "episode", "pretrain_policy": True},
            "episode_length": 40,
        }
        return tiny_config(**settings | changes)

    return make


def test_plans_that_no_term_reads_are_not_made_anew(tdmpc2_config):
    message = r"^reanalyze\.every must be 0 where no term of the loss reads a plan, as with model\.action_values, got"
    with pytest.raises(ValueError, match=message):
        build_agent(tdmpc2_config(reanalyze={"every": 10}), 5, 1)


def test_a_run_that_was_stopped_goes_on_as_if_nothing_had_happened(
    tmp_path, tdmpc2_config, make_run, straight, results, stop_at
):
    config = tdmpc2_config()
    run = make_run(config, tmp_path)
    for part, method, call in (("updater", "step", 4), ("updater", "step", 9), ("collector", "act", 12)):
        stop_at(run, run.learner.collector if part == "collector" else run.learner.agent.updater, method, call)
        with pytest.raises(RunInterrupted):
            run.run()
        run.log.directory.close()
        run = make_run(config, tmp_path, resume=True)
    run.run()
    assert results(run, tmp_path) == straight(config)
    assert run.learner.agent.updater.updates == 7 + 2 * 50


def test_the_preset_builds_the_critic_and_its_loss(tdmpc2_config):
    agent = build_agent(tdmpc2_config(), 5, 1)
    assert isinstance(agent.world_model, ActionValueWorldModel)
    assert isinstance(agent.loss, TDMPC2Loss)
    assert agent.planner.draw_noise(1).heads.shape == (1, 1, 5)
    published = build_agent(tdmpc2_config(loss={"squashed_entropy": False}), 5, 1)
    batch = random_slices(5, 1)
    entropies = []
    published.world_model.load_state_dict(agent.world_model.state_dict())
    for each in (agent, published):
        torch.manual_seed(0)
        entropies.append(each.loss(batch)["policy_entropy"])
    assert entropies[0] < entropies[1]


def test_pretraining_trains_the_policy_as_tdmpc2_does_and_only_then(tdmpc2_config, make_run, tmp_path):
    for number, trained in enumerate((True, False)):
        run = make_run(tdmpc2_config(replay={"pretrain_policy": trained}), tmp_path / str(number))
        for _ in range(30):
            run.learner.step()
        before = run.learner.agent.world_model.policy.output.weight.clone()
        list(run.learner.pretrain())
        assert torch.equal(before, run.learner.agent.world_model.policy.output.weight) != trained
        assert "loss_policy" not in run.learner.pop_row()  # the table begins with learning
        run.learner.collector.shutdown()
        run.evaluator.close()
        run.log.directory.close()


def test_an_agent_file_holds_the_critic(tmp_path, tdmpc2_config):
    config = tdmpc2_config()
    agent = build_agent(config, 5, 1)
    for _ in range(3):
        agent.updater.step(random_slices(5, 1))
    loaded, read, counters = load_agent(save_agent(tmp_path / "agent.pt", agent, config, {"updates": 3}))
    assert (read, counters) == (config, {"updates": 3})
    for name, value in agent.loss.state_dict().items():
        assert torch.equal(value, loaded.loss.state_dict()[name]), name
    steps = []
    for each in (agent, loaded):
        torch.manual_seed(5)
        steps.append(each.updater.step(random_slices(5, 1)).to_dict())
    assert steps[0] == steps[1]


@pytest.mark.slow  # compiles for a minute
@needs_compiler
def test_compiled_plans_and_updates_equal_eager_ones(tdmpc2_config):
    compiled, eager = (build_agent(tdmpc2_config(compile=setting), 5, 1) for setting in ("default", "off"))
    for _ in range(3):
        eager.updater.step(random_slices(5, 1, num_slices=4))
    compiled.loss.load_state_dict(eager.loss.state_dict())
    compiled.updater.load_state_dict(eager.updater.state_dict())
    batch = random_slices(5, 1, num_slices=4).contiguous()
    state = torch.get_rng_state()
    weights = {name: value.clone() for name, value in compiled.loss.state_dict().items()}
    compiled.updater.warm_up(batch)
    assert all(torch.equal(value, weights[name]) for name, value in compiled.loss.state_dict().items())
    torch.set_rng_state(state)
    metrics, plans = [], []
    for agent in (eager, compiled):
        torch.manual_seed(1)
        metrics.append(agent.updater.step(batch).to_dict())
    with torch.no_grad():  # scores that differ by more than rounding, the same for both
        for head in (eager.world_model.reward_head, eager.world_model.value_head):
            head.output.weight.normal_(0.0, 0.5)
        compiled.world_model.load_state_dict(eager.world_model.state_dict())
    observation = torch.randn(2, 5)
    for plan in (eager.planner.plan, compiled.planner.compiled_plan):
        torch.manual_seed(2)
        plans.append(plan(observation))
    torch.testing.assert_close(metrics[1], metrics[0], rtol=1e-4, atol=1e-5)
    for name in ("action", "loc", "scale", "value", "mean"):
        torch.testing.assert_close(getattr(plans[1], name), getattr(plans[0], name), rtol=1e-3, atol=1e-4)
