"""HumanoidBench. What needs the package is skipped without it: `make humanoidbench`, and pytest of that environment."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import sys
from types import ModuleType

import numpy as np
import pytest
import torch
from tensordict import TensorDict

pytest.importorskip("gymnasium")

from torchrl_etdmpc.envs import (  # noqa: E402
    HUMANOIDBENCH_HARD,
    check_env,
    get_task,
    load_simulator_state,
    make_env,
    simulator_state,
)
from torchrl_etdmpc.envs.humanoid_bench import MUJOCO, gymnasium_id, humanoid_bench_maker  # noqa: E402

INSTALLED = importlib.util.find_spec("humanoid_bench") is not None
needs_package = pytest.mark.skipif(not INSTALLED, reason="needs the environment of make humanoidbench")


@pytest.mark.parametrize("name", HUMANOIDBENCH_HARD)
def test_the_tasks_of_the_thesis_are_known_without_the_package(name):
    task = get_task(name)
    assert (task.suite, task.action_repeat, task.episode_length, task.terminates) == ("humanoid_bench", 1, 1000, True)


def test_other_robots_goals_and_lengths():
    assert get_task("h1-walk").episode_length == get_task("g1-bookshelf-hard").episode_length == 1000
    assert get_task("h1hand-push").episode_length == 500
    assert get_task("h1hand-push", episode_length=60).episode_length == 60
    with pytest.raises(ValueError, match=r"^unknown task 'h1hand-wlak'; did you mean h1hand-walk"):
        get_task("h1hand-wlak")


@pytest.mark.parametrize("goal", ["kitchen", "cube", "push", "basketball", "insert-normal", "insert-small"])
def test_an_episode_of_these_goals_has_500_steps(goal):
    assert get_task(f"h1-{goal}").episode_length == 500


@pytest.mark.skipif(INSTALLED, reason="needs an environment without the package")
def test_a_missing_package_is_one_line_with_the_recipe():
    with pytest.raises(ImportError) as caught:
        make_env("h1hand-walk")
    assert str(caught.value) == (
        "task 'h1hand-walk' needs humanoid_bench, which is missing; "
        "make humanoidbench makes an environment that has it."
    )


def test_another_mujoco_is_refused_because_it_simulates_something_else(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: name)
    monkeypatch.setattr(importlib.metadata, "version", lambda name: "3.17.0")
    with pytest.raises(ImportError, match=r"are those of mujoco 3\.1\.6, got mujoco 3\.17\.0, which simulates others"):
        humanoid_bench_maker(get_task("h1hand-walk"))


def test_a_task_that_the_package_does_not_register_is_refused(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: name)
    monkeypatch.setattr(importlib.metadata, "version", lambda name: MUJOCO)
    monkeypatch.setitem(sys.modules, "humanoid_bench", ModuleType("humanoid_bench"))
    monkeypatch.setattr("gymnasium.registry", {})
    with pytest.raises(ValueError, match=r"^HumanoidBench has no task 'h1hand-walk'; it has "):
        humanoid_bench_maker(get_task("h1hand-walk"))


@needs_package
@pytest.mark.parametrize("name", [*HUMANOIDBENCH_HARD, "h1-walk", "g1-stand"])
def test_a_task_keeps_the_contract_and_comes_back_exactly(name):
    env = make_env(name, seed=3)
    check_env(env)
    torch.manual_seed(0)
    rows = env.rollout(40, break_when_any_done=False)
    assert rows["next", "observation"].isfinite().all()
    assert rows["action"].shape[-1] == env.action_spec.shape[-1]
    other = make_env(name, seed=9)
    assert load_simulator_state(other, simulator_state(env))
    action = TensorDict({"action": torch.rand(env.action_spec.shape) * 2 - 1})
    ahead, again = (e.step(action.clone())["next"] for e in (env, other))
    assert torch.equal(ahead["observation"], again["observation"])
    assert torch.equal(ahead["reward"], again["reward"])


@needs_package
@pytest.mark.parametrize("name", ["h1hand-walk", "h1hand-reach", "h1hand-balance-simple"])
def test_the_physics_is_that_of_the_package_to_the_last_bit(name):
    import gymnasium

    env, reference = make_env(name, seed=5), gymnasium.make(gymnasium_id(name), render_mode=None)
    np.random.seed(5)  # the package's tasks draw from it as well
    reference.reset(seed=5)
    expected, _ = reference.reset()
    assert (env.reset()["observation"].numpy() == expected.astype(np.float32)).all()
    actions = torch.rand(100, *env.action_spec.shape, generator=torch.Generator().manual_seed(1)) * 2 - 1
    for action in actions:
        expected, reward, terminated, truncated, _ = reference.step(action.numpy())
        found = env.step(TensorDict({"action": action}))["next"]
        assert (found["observation"].numpy() == expected.astype(np.float32)).all()
        assert (found["reward"].item(), found["terminated"].item()) == (np.float32(reward), terminated)
        if terminated or truncated:
            expected, _ = reference.reset()
            assert (env.reset()["observation"].numpy() == expected.astype(np.float32)).all()


@needs_package
def test_an_environment_has_its_random_numbers_to_itself():
    np.random.seed(0)
    before = np.random.get_state()[1].copy()
    one = make_env("h1hand-reach", seed=4).rollout(5)
    assert (np.random.get_state()[1] == before).all()
    np.random.seed(77)
    other = make_env("h1hand-reach", seed=4).rollout(5)
    assert torch.equal(one["observation"][0], other["observation"][0])
    assert not torch.equal(one["observation"][0], make_env("h1hand-reach", seed=6).rollout(5)["observation"][0])


@needs_package
def test_a_fall_terminates():
    env = make_env("h1hand-run", seed=0)
    torch.manual_seed(0)
    rows = env.rollout(1000)
    assert rows["next", "terminated"][-1] and not rows["next", "truncated"][-1]
    assert len(rows) < 200


@needs_package
def test_a_model_that_cannot_be_loaded_is_one_line(monkeypatch):
    import mujoco

    def fail(path):
        raise ValueError("resource not found:\n  wood.png")

    monkeypatch.setattr(mujoco.MjModel, "from_xml_path", fail)
    with pytest.raises(ValueError, match=r"^h1hand-walk cannot be made: resource not found: wood\.png\.$"):
        make_env("h1hand-walk")
