"""The benchmarks that look at a run, on runs that were just made."""

from __future__ import annotations

import csv
import importlib
import runpy
import shutil
from pathlib import Path
from types import ModuleType

import numpy as np
import pandas as pd
import pytest
import torch
from scipy import stats

from torchrl_etdmpc.checkpoints import CheckpointStore
from torchrl_etdmpc.inspector import play_episode
from torchrl_etdmpc.runs import RunDirectory
from torchrl_etdmpc.training import TrainConfig, build_replay, launch, load_agent, preset, read_run_config
from torchrl_etdmpc.training.learner import Learner

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"
SMALL = {
    "task": "cartpole-balance",
    "device": "cpu",
    "threads": 1,
    "compile": "off",
    "total_env_steps": 300,
    "episode_length": 100,
    "eval_every": 100,
    "eval_episodes": 2,
    "model": {"latent_dim": 16, "mlp_dim": 16, "encoder_dim": 16},
    "planner": {"horizon": 2, "num_samples": 8, "num_elites": 4, "num_proposals": 2, "iterations": 1},
    "reanalyze": {"num_samples": 6, "num_elites": 3, "iterations": 1},
    "optim": {"batch_size": 4},
    "replay": {"seed_decisions": 40, "pretrain_updates": 4},
}


def small_config(run_dir: Path, **changes: object) -> TrainConfig:
    values = preset("cpu").to_dict()
    for name, value in (SMALL | {"run_dir": str(run_dir)} | changes).items():
        values[name] = values[name] | value if isinstance(value, dict) else value
    return TrainConfig.from_dict(values)


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The directory of a run, which its reader leaves as it is; who changes it takes a copy."""
    run_dir = tmp_path_factory.mktemp("trained") / "run"
    launch(small_config(run_dir))
    return run_dir


def test_a_run_is_evaluated_from_moment_to_moment_and_stays_as_it_is(tmp_path, trained, monkeypatch):
    files = {path: path.read_bytes() for path in trained.rglob("*") if path.is_file()}
    script = runpy.run_path(str(BENCHMARKS / "moments.py"))
    monkeypatch.setattr("sys.argv", [
        "moments.py", str(trained), "--every", "50", "--times", "2", "--out", str(tmp_path / "moments.csv"),
    ])  # fmt: skip
    script["main"]()
    with open(tmp_path / "moments.csv", newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [row["env_steps"] for row in rows] == ["300", "350", "400"]
    with open(RunDirectory(trained).eval, newline="", encoding="utf-8") as file:
        last = list(csv.DictReader(file))[-1]
    # The weights of the checkpoint, in the episodes that the run played; the averages begin with them.
    assert {rows[0][name] for name in ("latest", *script["COMPARED"]["averages"])} == {
        f"{float(last['return_mean']):.0f}"
    }
    assert any(row["in training"] for row in rows)
    assert all(row["policy"] for row in rows)
    assert len({row["average 0.98"] for row in rows}) > 1
    assert {path: path.read_bytes() for path in trained.rglob("*") if path.is_file()} == files


def test_a_moment_is_played_as_an_evaluation_and_as_in_training(tmp_path, trained, monkeypatch):
    script = runpy.run_path(str(BENCHMARKS / "moments.py"))
    monkeypatch.setattr("sys.argv", [
        "moments.py", str(trained), "--every", "50", "--times", "1", "--compare", "acting",
        "--out", str(tmp_path / "moments.csv"),
    ])  # fmt: skip
    script["main"]()
    with open(tmp_path / "moments.csv", newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    with open(RunDirectory(trained).eval, newline="", encoding="utf-8") as file:
        last = list(csv.DictReader(file))[-1]
    assert rows[0]["latest"] == f"{float(last['return_mean']):.0f}"
    ways = ("latest", *script["COMPARED"]["acting"])
    assert all(len({row[way] for way in ways}) == len(ways) for row in rows)  # each acts in another way


def test_what_moments_cannot_go_on_with_is_one_line(tmp_path, monkeypatch):
    script = runpy.run_path(str(BENCHMARKS / "moments.py"))
    monkeypatch.setattr("sys.argv", ["moments.py", str(tmp_path)])
    with pytest.raises(SystemExit, match="is not the directory of a run"):
        script["main"]()
    monkeypatch.setattr("sys.argv", ["moments.py", str(tmp_path), "--times", "0"])
    with pytest.raises(SystemExit, match="--every and --times must be at least 1"):
        script["main"]()
    averaged = RunDirectory(tmp_path / "averaged")
    averaged.begin(small_config(averaged.path, optim={"average_decay": 0.9}).to_dict())
    averaged.close()
    monkeypatch.setattr("sys.argv", ["moments.py", str(tmp_path / "averaged")])
    with pytest.raises(SystemExit, match="plans with averaged weights already"):
        script["main"]()


def test_agents_play_with_other_settings_of_the_planner(tmp_path, monkeypatch, capsys):
    for seed in (1, 2):
        launch(small_config(tmp_path / f"seed{seed}", seed=seed, total_env_steps=100))
    runs, out = [str(tmp_path / f"seed{seed}") for seed in (1, 2)], tmp_path / "table.csv"
    command = ["frozen_agents.py", *runs, "--episodes", "3", "--out", str(out), "--changes", "elite"]
    script = runpy.run_path(str(BENCHMARKS / "frozen_agents.py"))
    monkeypatch.setattr("sys.argv", command)
    script["main"]()
    first = pd.read_csv(out)
    assert list(first["run"]) == ["seed1", "seed2"] * 2  # wherever the machine has them
    assert list(first["setting"]) == ["as trained"] * 2 + ["elite"] * 2
    assert set(first["seed"]) == {1, 2}
    assert (first["episodes"] == 3).all()

    # What is written is not played again; what each change does is said for the agents that have it.
    monkeypatch.setattr("sys.argv", [*command, "policy alone", "beta 3"])
    capsys.readouterr()
    script["main"]()
    both = pd.read_csv(out)
    pd.testing.assert_frame_equal(both[:4], first)
    assert list(both["setting"][4:]) == ["policy alone"] * 2 + ["beta 3"] * 2
    means = both.groupby("setting")["return_mean"].mean()
    printed = next(line for line in reversed(capsys.readouterr().out.splitlines()) if "policy alone" in line).split()
    assert printed[-4] == f"{means['policy alone'] - means['as trained']:.0f}"
    effects = script["effects"](both).set_index("setting")
    assert effects.loc["elite", "difference"] == pytest.approx(means["elite"] - means["as trained"])

    monkeypatch.setattr("sys.argv", [*command[:3], "--episodes", "2", *command[5:]])
    with pytest.raises(SystemExit, match="has other numbers of episodes than 2"):
        script["main"]()
    monkeypatch.setattr("sys.argv", [command[0], runs[0], *command[1:]])
    with pytest.raises(SystemExit, match="several runs have the same task and seed"):
        script["main"]()


def test_frozen_agents_compares_task_by_task():
    effects = runpy.run_path(str(BENCHMARKS / "frozen_agents.py"))["effects"]
    changes = {"a": (10.0, 12.0, 14.0), "b": (-4.0, 0.0), "c": (1.0, float("nan"))}
    rows = [
        (task, seed, setting, 50.0 if setting == "as trained" else 150.0 + by)
        for task, differences in changes.items()
        for seed, by in enumerate(differences)
        for setting in ("as trained", "elite")
    ]
    table = pd.DataFrame(rows, columns=["task", "seed", "setting", "return_mean"]).dropna()
    elite = effects(table).set_index("setting").loc["elite"]
    means = np.array([112.0, 98.0, 101.0])  # of the tasks, whatever their number of agents
    low, high = stats.t.interval(0.95, 2, means.mean(), stats.sem(means))
    assert elite["agents"] == 6
    assert elite[["return", "difference"]].tolist() == pytest.approx([50 + means.mean(), means.mean()])
    assert elite[["low", "high"]].tolist() == pytest.approx([low, high])
    assert elite["higher"] == 6

    one = effects(table[table["task"] == "a"]).set_index("setting").loc["elite"]
    assert one["difference"] == 112
    assert np.isnan(one["low"])


def test_frozen_agents_goes_on_with_a_table_of_the_same_runs_alone(tmp_path):
    script, out, run = runpy.run_path(str(BENCHMARKS / "frozen_agents.py")), tmp_path / "out.csv", tmp_path / "run"
    run.mkdir()
    RunDirectory(run).write_config(preset("cpu").to_dict() | {"task": "walker-walk", "seed": 1})
    columns = ["task", "seed", "setting", "return_mean", "return_std", "episodes"]
    table = pd.DataFrame([("walker-walk", 1, "as trained", 100.0, 1.0, 3)], columns=columns)
    for rows, message in (
        (table.assign(run="other"), "has rows of another run, other; name that run too, or choose another --out"),
        (table, "does not say which runs its rows are of; choose another --out"),
    ):
        rows.to_csv(out, index=False)
        with pytest.raises(ValueError, match=message):
            script["measure"]([RunDirectory(run)], ["as trained"], 3, out)


def test_frozen_agents_refuses_what_it_cannot_play(tmp_path, monkeypatch):
    script = runpy.run_path(str(BENCHMARKS / "frozen_agents.py"))
    monkeypatch.setattr("sys.argv", ["frozen_agents.py", str(tmp_path), "--out", str(tmp_path / "table.csv")])
    with pytest.raises(SystemExit, match=r"has no checkpoints/last\.pt; name directories of runs"):
        script["main"]()
    monkeypatch.setattr("sys.argv", ["frozen_agents.py", "x", "--episodes", "0", "--out", str(tmp_path / "table.csv")])
    with pytest.raises(SystemExit, match="--episodes must be at least 1"):
        script["main"]()


def test_values_stand_beside_what_the_next_step_makes_of_them(tmp_path, trained, monkeypatch, capsys):
    script = runpy.run_path(str(BENCHMARKS / "kept_values.py"))
    command = ["kept_values.py", str(trained), "--every", "10", "--out", str(tmp_path / "values.csv")]
    monkeypatch.setattr("sys.argv", command)
    script["main"]()
    table = pd.read_csv(tmp_path / "values.csv")
    assert list(table.columns) == script["COLUMNS"]
    assert table.groupby("who").size().to_dict() == {"planner": 50, "policy alone": 50}
    assert capsys.readouterr().out.count("in the mean: ") == 2
    agent, config, _ = load_agent(RunDirectory(trained).last_agent, compile_setting="off")
    episode = play_episode(agent.eval_planner, config.task_spec, seed=100)
    rows = table[table["who"] == "planner"]
    with torch.no_grad():
        values = agent.world_model.values(agent.world_model.encode(episode.observation)).mean(-1).numpy()
    rewards, discount = episode.reward.numpy(), agent.eval_planner.discount
    assert rows["value"].to_numpy() == pytest.approx(values[:-1], abs=1e-3)
    assert rows["real step"].to_numpy() == pytest.approx(rewards + discount * values[1:], abs=2e-3)
    powers = discount ** np.arange(51)
    assert rows["followed"].iloc[0] == pytest.approx(powers[:-1] @ rewards + powers[-1] * values[-1], abs=0.01)


def test_what_has_no_values_to_look_at_is_one_line(tmp_path, monkeypatch):
    script = runpy.run_path(str(BENCHMARKS / "kept_values.py"))
    monkeypatch.setattr("sys.argv", ["kept_values.py", str(tmp_path)])
    with pytest.raises(SystemExit, match="is not a file; pass a checkpoint such as"):
        script["main"]()
    monkeypatch.setattr("sys.argv", ["kept_values.py", str(tmp_path), "--every", "0"])
    with pytest.raises(SystemExit, match="--every must be at least 1"):
        script["main"]()


def test_plans_of_one_state_stand_beside_each_other(tmp_path, trained, monkeypatch, capsys):
    script = runpy.run_path(str(BENCHMARKS / "repeated_plans.py"))
    options = ["--states", "10", "--repeats", "4", "--out", str(tmp_path / "plans.csv")]
    monkeypatch.setattr("sys.argv", ["repeated_plans.py", str(trained), *options])
    script["main"]()
    assert "10 states, 4 plans each" in capsys.readouterr().out
    table = pd.read_csv(tmp_path / "plans.csv").set_index("setting")
    assert list(table.index) == list(script["CHANGES"])
    assert (table > 0).all(axis=None)
    assert table.loc["wide, BMPC's budget", "spread"] < table.loc["wide", "spread"]  # a search of many repeats itself


def test_the_divergence_of_two_plans_is_that_of_their_gaussians(trained):
    script = runpy.run_path(str(BENCHMARKS / "repeated_plans.py"))
    agent, config, _ = load_agent(RunDirectory(trained).last_agent, compile_setting="off")
    latent = torch.softmax(torch.randn(3, config.model.latent_dim), -1)
    planner = agent.reanalyze_planner
    torch.manual_seed(0)
    row = script["repeated_plans"](agent.acting_model, config.reanalyze, latent, 2, planner.discount)
    torch.manual_seed(0)
    with torch.no_grad():
        first, second = (planner.plan(latent=latent) for _ in range(2))
    gaussians = [torch.distributions.Normal(plan.loc, plan.scale) for plan in (first, second)]
    there, back = (torch.distributions.kl_divergence(*pair).mean() for pair in (gaussians, gaussians[::-1]))
    assert row["kl"] == pytest.approx(((there + back) / 2).item(), rel=1e-4)
    assert row["spread"] == pytest.approx(((first.loc - second.loc).abs() / 2**0.5).mean().item(), rel=1e-4)


def test_what_cannot_be_planned_twice_is_one_line(tmp_path, monkeypatch):
    script = runpy.run_path(str(BENCHMARKS / "repeated_plans.py"))
    monkeypatch.setattr("sys.argv", ["repeated_plans.py", str(tmp_path)])
    with pytest.raises(SystemExit, match="is not a file; pass a checkpoint such as"):
        script["main"]()
    monkeypatch.setattr("sys.argv", ["repeated_plans.py", str(tmp_path), "--repeats", "1"])
    with pytest.raises(SystemExit, match="--repeats at least 2"):
        script["main"]()


def test_what_random_actions_find_is_counted_from_the_same_starts_behind_their_beginning(tmp_path, monkeypatch):
    script = runpy.run_path(str(BENCHMARKS / "random_phase.py"))
    options = ["--tasks", "reacher-easy", "--holds", "1", "1e9", "--episodes", "2", "--out", str(tmp_path / "out.csv")]
    monkeypatch.setattr("sys.argv", ["random_phase.py", *options])
    script["main"]()
    table = pd.read_csv(tmp_path / "out.csv")
    rewards = [script["random_episodes"]("reacher-easy", hold, 2) for hold in (1.0, 1e9)]
    assert all(paid.shape == (2, 500) for paid in rewards)
    assert torch.equal(rewards[0][:, 0], rewards[1][:, 0])  # nothing has moved far by then
    assert table["return"].tolist() == pytest.approx([paid.sum(-1).mean().item() for paid in rewards], abs=0.01)
    assert table["found"].tolist() == [sum(bool((row[25:] > 0).any()) for row in paid) for paid in rewards]
    for wrong in (["--episodes", "0"], ["--holds", "4", "0.5"]):
        monkeypatch.setattr("sys.argv", ["random_phase.py", *wrong])
        with pytest.raises(SystemExit, match="--episodes and --holds must be at least 1"):
            script["main"]()


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("all_tasks", ["--tasks", "walker-walk"]),
        ("all_tasks", ["--preset", "bmpc"]),
        ("random_phase", ["--tasks", "reacher-easy"]),
        ("random_phase", ["--holds", "1"]),
        ("random_phase", ["--episodes", "2"]),
    ],
    ids=lambda value: value if isinstance(value, str) else value[0],
)
def test_a_part_of_a_committed_table_needs_a_file_of_its_own(monkeypatch, name, options):
    main = runpy.run_path(str(BENCHMARKS / f"{name}.py"))["main"]
    monkeypatch.setattr("sys.argv", [f"{name}.py", *options])
    with pytest.raises(SystemExit, match="another table than the committed one; name .* by --out"):
        main()


def test_a_task_that_fails_has_no_row_and_is_the_exit_code(tmp_path, monkeypatch, capsys):
    main = runpy.run_path(str(BENCHMARKS / "all_tasks.py"))["main"]

    def exercise(task: str, *_: object) -> dict[str, str]:
        if task == "dog-run":
            raise RuntimeError("not finite: loss_value")
        return dict.fromkeys(main.__globals__["COLUMNS"], "7") | {"task": task}

    monkeypatch.setitem(main.__globals__, "exercise", exercise)
    for tasks, code in ((["walker-walk", "dog-run"], 1), (["walker-walk"], 0)):
        monkeypatch.setattr("sys.argv", ["all_tasks.py", "--tasks", *tasks, "--out", str(tmp_path / "out.csv")])
        with pytest.raises(SystemExit) as left:
            main()
        assert left.value.code == code
        assert pd.read_csv(tmp_path / "out.csv")["task"].tolist() == ["walker-walk"]
    assert "dog-run: RuntimeError: not finite: loss_value" in capsys.readouterr().out


@pytest.fixture
def faults(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(BENCHMARKS)
    return importlib.import_module("faults")


def test_what_a_killed_run_came_to_includes_the_rows_of_its_buffer(tmp_path, trained, faults):
    run = shutil.copytree(trained, tmp_path / "run")
    directory = RunDirectory(run)
    expected = faults.results(run)
    assert faults.results(run) == expected
    buffer = build_replay(read_run_config(directory))
    CheckpointStore(directory.checkpoints).load({}, buffer)
    buffer.storage[:]["next", "reward"][7] += 1
    CheckpointStore(directory.checkpoints).save(1000, {}, buffer)
    found = faults.results(run)
    assert [name for name in expected if found[name] != expected[name]] == ["buffer"]


def test_flipped_bits_are_judged_on_a_run_that_does_not_hold_the_answer(tmp_path, faults, monkeypatch):
    monkeypatch.setattr(Learner, "load_state_dict", lambda self, state_dict: None)
    complaints = faults.flips(3, 1, tmp_path)["complaints"]
    assert complaints and all("restored something else" in text for text in complaints)
