from __future__ import annotations

import importlib.util

import pytest

from torchrl_etdmpc.envs import HUMANOIDBENCH_HARD, Task, get_task, register_task, success_return

needs_gymnasium = pytest.mark.skipif(importlib.util.find_spec("gymnasium") is None, reason="needs gymnasium")
INSTALLED = importlib.util.find_spec("humanoid_bench") is not None


def test_dm_control_defines_no_success():
    assert success_return(get_task("walker-walk")) is None


@needs_gymnasium
@pytest.mark.parametrize(("name", "least"), [("InvertedPendulum-v5", 950), ("Hopper-v5", 3800), ("Walker2d-v5", None)])
def test_gymnasium_s_thresholds_are_its_own(name, least):
    assert success_return(get_task(f"gym/{name}")) == least


@needs_gymnasium
def test_an_episode_of_another_length_has_none():
    for length in (100, 2000):
        assert success_return(get_task("gym/InvertedPendulum-v5", episode_length=length)) is None
    assert success_return(get_task("gym/InvertedPendulum-v5", terminates=False)) == 950


@needs_gymnasium
def test_neither_has_one_that_is_registered_with_another_length(monkeypatch):
    monkeypatch.setattr("torchrl_etdmpc.envs.tasks._tasks", {})
    register_task(Task("gym/InvertedPendulum-v5", "gymnasium", episode_length=100))
    assert success_return(get_task("gym/InvertedPendulum-v5")) is None
    register_task(Task("h1hand-walk", "humanoid_bench", episode_length=100))
    assert success_return(get_task("h1hand-walk")) is None


@needs_gymnasium
def test_an_episode_of_a_task_without_a_limit_of_its_own_has_none(monkeypatch):
    import gymnasium

    monkeypatch.setattr(gymnasium.envs.registration, "registry", dict(gymnasium.registry))
    monkeypatch.setattr(gymnasium, "registry", gymnasium.envs.registration.registry)
    gymnasium.register(id="Endless-v0", entry_point="gymnasium.envs.classic_control:PendulumEnv")
    assert success_return(get_task("gym/Endless-v0", episode_length=50)) is None


@needs_gymnasium
def test_a_task_that_somebody_else_makes_has_none(monkeypatch):
    monkeypatch.setattr("torchrl_etdmpc.envs.tasks._tasks", {})
    monkeypatch.setattr("torchrl_etdmpc.envs.tasks._makers", {})
    task = Task("gym/InvertedPendulum-v5", "gymnasium", action_repeat=1, episode_length=1000, terminates=True)
    register_task(task, make=lambda task, device: None)
    assert success_return(task) is None


@pytest.mark.skipif(INSTALLED, reason="needs an environment without the package")
def test_without_humanoid_bench_its_recipe_is_said():
    with pytest.raises(ImportError, match=r"needs humanoid_bench, which is missing; make humanoidbench makes"):
        success_return(get_task("h1hand-walk"))


@pytest.mark.skipif(not INSTALLED, reason="needs the environment of make humanoidbench")
def test_humanoid_bench_s_bars_are_the_package_s():
    bars = {name: success_return(get_task(name)) for name in HUMANOIDBENCH_HARD}
    assert bars["h1hand-walk"] == 700
    assert bars["h1hand-stand"] == 800
    assert bars["h1hand-reach"] == 12000
    assert bars["h1hand-balance-simple"] == 800
    assert all(bar > 0 for bar in bars.values())
