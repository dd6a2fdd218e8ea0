"""Runs of other libraries on our tasks: the same physics, the same evaluations, and their place beside runs of ours."""

from __future__ import annotations

import importlib
import sys
import types
from pathlib import Path

import numpy as np
import pytest
import torch

pytest.importorskip("matplotlib")
pytest.importorskip("pandas")
pytest.importorskip("dm_control")

from torchrl_etdmpc.analysis import read_runs
from torchrl_etdmpc.envs import make_env
from torchrl_etdmpc.runs import RunDirectory

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"


class Agent:
    """The part of Stable-Baselines3's interface that the script calls, around actions that stay 0.3."""

    def __init__(self, policy, env, *, seed, device, **settings):
        self.env, self.settings = env, settings
        self.num_timesteps = self._n_updates = 0
        self.env.reset(seed=seed)

    def learn(self, steps, *, reset_num_timesteps):
        assert not reset_num_timesteps
        self.num_timesteps += steps
        self._n_updates += steps

    def predict(self, observation, *, deterministic):
        assert deterministic
        return np.full((len(observation), *self.env.action_space.shape), 0.3, np.float32), None


@pytest.fixture
def script(monkeypatch, tmp_path):
    monkeypatch.syspath_prepend(BENCHMARKS)
    module = importlib.import_module("race")
    monkeypatch.setattr(module, "FOLDER", tmp_path / "race")
    for library, name in (("stable_baselines3", "SAC"), ("sb3_contrib", "TQC")):
        monkeypatch.setitem(sys.modules, library, types.SimpleNamespace(**{name: Agent}))
    monkeypatch.setattr(module.importlib.metadata, "version", lambda name: "0")
    return module


@pytest.mark.parametrize("task", ["walker-walk", "finger-spin"])
def test_the_other_library_gets_the_observations_and_rewards_that_ours_gets(script, task):
    theirs, ours = script.DMCGym(task, seed=3), make_env(task, seed=3)
    observation, _ = theirs.reset()
    here = ours.reset()
    generator = torch.Generator().manual_seed(0)
    truncated, steps = False, 0
    assert observation.shape == here["observation"].shape
    assert observation.dtype == np.float32
    # Each turns the seed into an initial state in its own way: from here on it is the same state.
    theirs.env.physics.set_state(ours.physics.get_state())
    theirs.env.physics.forward()
    while not truncated:
        action = torch.rand(theirs.action_space.shape, generator=generator) * 2 - 1
        observation, reward, terminated, truncated, _ = theirs.step(action.numpy())
        here = ours.step(here.set("action", action))["next"]
        np.testing.assert_allclose(observation, here["observation"], rtol=1e-4, atol=1e-4)
        assert reward == pytest.approx(here["reward"].item(), abs=1e-4)
        assert not terminated
        assert truncated == here["truncated"].item()
        steps += 1
    assert steps == 1000 // theirs.repeat


def test_a_run_is_evaluated_as_ours_are_and_stands_beside_them(script, tmp_path, monkeypatch):
    ours = tmp_path / "cpu" / "cartpole-swingup" / "seed1"
    ours.mkdir(parents=True)
    (ours / "summary.json").write_text('{"task": "cartpole-swingup", "preset": "cpu", "seed": 1}')
    rows = [f"{step},{step // 2},{step},{0.012 * step},{step // 100},1.0,10" for step in (0, 50_000, 90_000)]
    header = "env_steps,decision_steps,updates,wall_time_s,return_mean,return_std,episodes"
    (ours / "eval.csv").write_text("\n".join([header, *rows, ""]))
    common = ["race.py", "--tasks", "cartpole-swingup", "--seeds", "1", "--env-steps", "10000", "--settings", "zoo"]
    monkeypatch.setattr(script, "EPISODES", 2)
    monkeypatch.setattr(sys, "argv", [*common, "--out", str(script.FOLDER)])
    script.main()
    runs = read_runs([script.FOLDER])
    assert set(runs["method"]) == {"SAC (zoo)", "TQC (zoo)"}
    returns = runs.groupby("env_steps")["return_mean"].unique()
    assert list(returns.index) == [0, 10_000]
    assert len(np.unique(np.concatenate(returns.to_numpy()))) == 1  # the same actions on the same starts, every time
    assert RunDirectory(script.FOLDER / "tqc-zoo" / "cartpole-swingup" / "seed1").finished
    monkeypatch.setattr(sys, "argv", ["race.py", "--report-only", str(tmp_path / "cpu")])
    script.main()
    page = (script.FOLDER / "README.md").read_text()
    assert "| 50,000 env steps | 100,000 env steps | 200,000 env steps | 10 minutes | 15 minutes | 25 minutes |" in page
    assert "| cartpole-swingup | cpu | 1 | 500 (10.0) | – | – | 500 | 500 | 900 |" in page  # 90,000 after 18 minutes
    assert "| cartpole-swingup | TQC (zoo) | 1 |" in page
    slower = ours.with_name("seed2")
    slower.mkdir()
    (slower / "summary.json").write_text('{"task": "cartpole-swingup", "preset": "cpu", "seed": 2}')
    rows = [f"{step},{step // 2},{step},{0.018 * step},{step // 100},1.0,10" for step in (0, 50_000, 90_000)]
    (slower / "eval.csv").write_text("\n".join([header, *rows, ""]))
    script.main()
    page = (script.FOLDER / "README.md").read_text()
    # 50,000 env steps take 10 and 15 minutes, 90,000 take 18 and 27: in the mean 12.5 and 22.5.
    assert "| cartpole-swingup | cpu | 2 | 500 (12.5) | – | – | 0 | 500 | 900 | 900 |" in page
    monkeypatch.setattr(sys, "argv", ["race.py", "--clock", "2", "--report-only", str(tmp_path / "cpu")])
    script.main()
    page = (script.FOLDER / "README.md").read_text()
    # The minutes of the second run alone, the returns of both; those who have no run with that seed have no minutes.
    assert "| cartpole-swingup | cpu | 2 | 500 (15.0) | – | – | 0 | 500 | 500 | 900 |" in page
    assert "| cartpole-swingup | TQC (zoo) | 1 | – | – | – | – | – | – | – |" in page
    assert "Minutes are those of seed 2." in page
    monkeypatch.setattr(sys, "argv", ["race.py", "--clock", "3", "--report-only", str(tmp_path / "cpu")])
    with pytest.raises(SystemExit, match="name other seeds by --clock"):
        script.main()
    assert (script.FOLDER / "race.png").read_bytes().startswith(b"\x89PNG")


def test_a_clock_without_a_report_is_refused_before_anything_is_trained(script, monkeypatch, capsys):
    monkeypatch.setattr(script, "train", lambda *arguments: pytest.fail("trains"))
    monkeypatch.setattr(sys, "argv", ["race.py", "--clock", "2"])
    with pytest.raises(SystemExit):
        script.main()
    assert "give it together with --report-only." in capsys.readouterr().err


def test_the_page_of_results_has_the_returns_of_the_committed_table():
    table: dict[str, dict[str, list[float]]] = {}
    for line in (BENCHMARKS / "results" / "cpu" / "race" / "README.md").read_text().splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if len(cells) == 10 and cells[2].isdecimal():
            returns = [float(cell.partition(" ")[0].replace("–", "nan")) for cell in cells[3:6]]
            table.setdefault(cells[0], {})[cells[1].replace("zoo", "tuned")] = returns
    page = (BENCHMARKS.parent / "docs" / "results.md").read_text()
    assert len(table) == 4
    for task, methods in table.items():
        ours = methods.pop("cpu")
        best = [max(methods, key=lambda name, column=column: methods[name][column]) for column in range(3)]
        others = [f"{name.replace('(', '').replace(')', '')} {methods[name][i]:.0f}" for i, name in enumerate(best)]
        assert f"| {task} | {ours[0]:.0f} | {ours[1]:.0f} | {' | '.join(others)} |" in page
