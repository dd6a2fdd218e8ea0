from __future__ import annotations

import dataclasses
import fnmatch
import itertools
import json
import math
import re
import shutil
import time
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import torch
import yaml
from tensordict import TensorDict, TensorDictBase
from torchrl import torchrl_logger
from torchrl.envs import Transform

pytest.importorskip("dm_control")

from torchrl_etdmpc.collectors import NonFiniteError, SimulatorError  # noqa: E402
from torchrl_etdmpc.envs import make_env  # noqa: E402
from torchrl_etdmpc.runs import processor, source_commit
from torchrl_etdmpc.training import (  # noqa: E402
    EvaluationResult,
    Evaluator,
    TrainConfig,
    TrainingRun,
    build_agent,
    build_collector,
    build_reanalyze,
    build_replay,
    load_agent,
    preset,
)
from torchrl_etdmpc.training.train import _draw_curve  # noqa: E402

EPISODE = 20  # decisions, of every run here
DOCS = Path(__file__).parents[2] / "docs" / "running.md"


class Finished(NamedTuple):
    config: TrainConfig
    run: TrainingRun
    summary: dict[str, Any]
    path: Path


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory, tiny_config, make_run) -> Finished:
    """A whole run: 30 seed decisions, 7 updates before and 2 per decision afterwards, 80 decisions in all."""
    config = tiny_config(eval_policy=True)
    path = tmp_path_factory.mktemp("runs") / "cartpole"
    run = make_run(config, path)
    summary = run.run()
    run.log.directory.close()
    return Finished(config, run, summary, path)


def test_a_run_directory_holds_what_it_should_and_nothing_else(finished):
    files = {str(path.relative_to(finished.path)) for path in finished.path.rglob("*") if path.is_file()}
    expected = {"config.yaml", "train.csv", "eval.csv", "summary.json", "curve.png"}
    expected |= {"checkpoints/last.pt", "checkpoints/best.pt"}
    expected |= {
        f"checkpoints/resume/{steps:012d}/{name}"
        for steps in (80, 160)
        for name in (*(f"{part}.pt" for part in finished.run.parts), "manifest.json")
    }
    assert {file for file in files if not file.startswith("checkpoints/replay/")} == expected
    assert any(file.startswith("checkpoints/replay/rows-") for file in files)


def test_a_curve_that_cannot_be_drawn_is_a_line_in_the_log(monkeypatch, finished):
    matplotlib = pytest.importorskip("matplotlib")
    told = []
    monkeypatch.setattr(torchrl_logger, "warning", told.append)
    monkeypatch.setenv("PATH", "")
    with matplotlib.rc_context({"text.usetex": True}):
        _draw_curve(finished.run.log.directory)
    assert told == ["curve.png was not drawn: Failed to process string with tex because latex could not be found"]


def test_the_configuration_can_be_read_back(finished):
    values = yaml.safe_load((finished.path / "config.yaml").read_text())
    assert TrainConfig.from_dict(values) == finished.config


def test_evaluations_are_at_the_start_at_every_interval_and_at_the_end(finished, read_table):
    rows = read_table(finished.path / "eval.csv")
    header = "env_steps,decision_steps,updates,wall_time_s,return_mean,return_std,episodes,policy_return"
    assert (finished.path / "eval.csv").read_text().splitlines()[0] == header
    assert [row["env_steps"] for row in rows] == [0, 80, 160]
    assert all(row["episodes"] == 1 and row["return_std"] == 0 for row in rows)
    assert all(0 < row["return_mean"] <= 2 * EPISODE for row in rows)


def test_an_evaluation_due_at_the_end_of_the_seed_phase_is_of_the_pretrained_agent(
    tmp_path, tiny_config, make_run, read_table
):
    make_run(tiny_config(eval_every=60, total_env_steps=70), tmp_path).run()
    rows = read_table(tmp_path / "eval.csv")
    assert [(row["env_steps"], row["updates"]) for row in rows] == [(0, 0), (60, 7), (70, 7 + 2 * 5)]


@pytest.mark.parametrize("during", ["evaluation", "row", "checkpoint"])
def test_a_run_whose_directory_is_removed_ends_and_writes_nothing_there(
    tmp_path, monkeypatch, tiny_config, make_run, during
):
    run = make_run(tiny_config(total_env_steps=80, replay={"pretrain_updates": 0}), tmp_path / "run")
    owner: Any = {"evaluation": Evaluator, "row": run, "checkpoint": run.checkpoints}[during]
    method = {"evaluation": "__call__", "row": "write_row", "checkpoint": "save"}[during]
    original = getattr(owner, method)

    def removed(*args: Any, **kwargs: Any) -> Any:
        shutil.rmtree(tmp_path / "run")
        return original(*args, **kwargs)

    monkeypatch.setattr(owner, method, removed)
    with pytest.raises(OSError, match=r"^run_dir=.*run was moved or removed while a run trained in it"):
        run.run()
    assert list(tmp_path.iterdir()) == []


def test_training_does_not_depend_on_how_often_it_is_evaluated(tmp_path, tiny_config, make_run):
    often = make_run(tiny_config(eval_every=10, total_env_steps=90), tmp_path / "often")
    often.run()
    seldom = make_run(tiny_config(eval_every=1000, total_env_steps=90), tmp_path / "seldom")
    seldom.run()
    assert torch.equal(often.learner.replay[:]["action"], seldom.learner.replay[:]["action"])
    weights, others = (run.learner.agent.loss.state_dict() for run in (often, seldom))
    assert all(torch.equal(value, others[name]) for name, value in weights.items())


def test_a_training_row_is_written_at_every_interval_after_the_seed_phase(finished, read_table):
    rows = read_table(finished.path / "train.csv")
    assert [row["env_steps"] for row in rows] == [80, 120, 160]


@pytest.mark.parametrize("name", ["train.csv", "eval.csv"])
def test_the_counters_agree_with_each_other_in_every_row(finished, name, read_table):
    rows = read_table(finished.path / name)
    assert list(rows[0])[:4] == ["env_steps", "decision_steps", "updates", "wall_time_s"]
    for row in rows:
        assert row["decision_steps"] == row["env_steps"] / 2
        learning = row["decision_steps"] - 30
        assert row["updates"] == (7 + 2 * learning if learning > 0 else 0)
    times = [row["wall_time_s"] for row in rows]
    assert times == sorted(times)


def test_every_training_metric_is_there_and_finite(finished, read_table):
    rows = read_table(finished.path / "train.csv")
    names = {f"loss_{name}" for name in ("consistency", "reward", "value", "policy")}
    names |= {"grad_norm_model", "grad_norm_policy", "policy_kl", "kl_scale", "value_target"}
    names |= {"episode_return", "targets_refreshed", "targets_stale", "target_age"}
    names |= {"plan_fallbacks", "simulator_faults", "updates_skipped"}
    assert names <= set(rows[0])
    (table,) = re.findall(r"^\| columns \| meaning \|\n(.*?)\n\n", DOCS.read_text(encoding="utf-8"), re.M | re.S)
    told = [name for line in table.splitlines() for name in re.findall(r"`([\w*]+)`", line.split("|")[1])]
    assert {name for name in told if not fnmatch.filter(rows[0], name)} == {"policy_value", "q_scale"}  # of TD-MPC2
    assert [name for name in rows[0] if not any(fnmatch.fnmatch(name, one) for one in told)] == list(rows[0])[:4]
    for row in rows:
        assert [name for name, value in row.items() if not math.isfinite(value)] == []
    assert rows[-1]["targets_refreshed"] > rows[0]["targets_refreshed"] > 0
    assert rows[-1]["targets_stale"] == 0


def test_the_training_return_is_that_of_the_episodes_since_the_last_row(finished, read_table):
    # A row is written where an episode ends. The first one follows two episodes.
    rewards = finished.run.learner.replay[:]["next", "reward"].reshape(-1, EPISODE).sum(-1)
    assert len(rewards) == 4
    expected = [rewards[:2].mean().item(), rewards[2].item(), rewards[3].item()]
    assert [row["episode_return"] for row in read_table(finished.path / "train.csv")] == pytest.approx(expected)


def test_the_summary_states_the_run_and_its_result(finished, read_table, monkeypatch):
    summary = json.loads((finished.path / "summary.json").read_text())
    (told,) = re.findall(r"`summary\.json` holds (.*?)\.\n", DOCS.read_text(encoding="utf-8"), re.S)
    assert set(re.findall(r"`(\w+)`", told)) == set(summary)
    evaluations = [row["return_mean"] for row in read_table(finished.path / "eval.csv")]
    assert (summary["task"], summary["preset"], summary["seed"]) == ("cartpole-balance", "cpu", 1)
    assert summary["env_steps"] == 160
    assert summary["final_return"] == evaluations[-1]
    assert summary["best_return"] == max(evaluations)
    assert summary["wall_time_s"] > 0
    learned = 160 / 2 - finished.config.seed_decisions  # the task repeats actions twice
    assert summary["decisions_per_second"] == pytest.approx(learned / finished.run.state.learning_s)
    assert summary["parameters"] == sum(p.numel() for p in finished.run.learner.agent.world_model.parameters())
    assert (summary["device"], summary["processor"], summary["commit"]) == ("cpu", processor(), source_commit())
    assert {"python", "torch", "torchrl", "tensordict"} <= set(summary["versions"])
    assert {name: summary[name] for name in finished.summary} == finished.summary
    assert summary["threads"] == torch.get_num_threads()
    monkeypatch.setattr(torch, "get_num_threads", lambda: 99)  # closing batched environments may change it
    monkeypatch.setattr("torchrl_etdmpc.training.train.source_commit", lambda: "of later files")
    again = finished.run.summary()
    assert [again[name] for name in ("threads", "commit")] == [summary[name] for name in ("threads", "commit")]


def test_evaluations_play_other_episodes_than_training(finished):
    seeds = finished.run.evaluator.seed, finished.config.seed
    ours, theirs = (make_env(finished.config.task_spec, seed=seed).reset()["observation"] for seed in seeds)
    assert not torch.equal(ours, theirs)


def test_the_checkpoint_is_the_agent_at_the_end(finished):
    agent, config, counters = load_agent(finished.path / "checkpoints" / "last.pt", observation_dim=5, action_dim=1)
    assert config == finished.config
    assert (counters["env_steps"], counters["decision_steps"], counters["updates"]) == (160, 80, 107)
    final = finished.run.learner.agent.loss.state_dict()
    assert all(torch.equal(value, final[name]) for name, value in agent.loss.state_dict().items())


def test_the_environments_are_closed_at_the_end(finished):
    assert finished.run.learner.collector.env.is_closed
    assert finished.run.evaluator.env.is_closed


def test_no_evaluation_and_no_checkpoint_is_jumped_over_by_several_environments(
    tmp_path, tiny_config, make_run, read_table
):
    config = tiny_config(num_envs=3, total_env_steps=160, eval_every=40, checkpoint_every=50, checkpoint_keep=9)
    make_run(config, tmp_path).run()
    # Steps of 6; the 40 is in the random phase, which ends at 60.
    assert [row["env_steps"] for row in read_table(tmp_path / "eval.csv")] == [0, 84, 120, 162]
    checkpoints = sorted(int(folder.name) for folder in (tmp_path / "checkpoints" / "resume").iterdir())
    assert checkpoints == [0, 102, 150, 162]
    assert [row["env_steps"] for row in read_table(tmp_path / "train.csv")] == [84, 120, 162]


def test_the_best_agent_is_written_when_it_was_evaluated(tmp_path, monkeypatch, tiny_config, make_run):
    run = make_run(tiny_config(checkpoint_every=10_000), tmp_path)
    results, kept = iter((3.0, 2.0, 5.0)), []
    monkeypatch.setattr(run, "evaluator", lambda **_: EvaluationResult(next(results), 0.0, 1, 0.0))
    for _ in range(3):
        run.learner.step()
        run.evaluate()
        kept.append(load_agent(tmp_path / "checkpoints" / "best.pt")[2]["decision_steps"])
    assert kept == [1, 1, 3]
    assert not (tmp_path / "checkpoints" / "last.pt").exists()  # no checkpoint was due


def test_a_checkpoint_is_written_when_the_last_one_is_some_minutes_old(tmp_path, monkeypatch, tiny_config, make_run):
    clock = [0.0]
    monkeypatch.setattr(time, "perf_counter", lambda: clock[0])
    often = {"checkpoint_minutes": 2.0, "checkpoint_every": 10_000, "checkpoint_keep": 99}
    run = make_run(tiny_config(**often, total_env_steps=90), tmp_path)
    act = run.learner.collector.act

    def slow(*args: Any) -> TensorDictBase:
        clock[0] += 13.0  # ten steps are more than two minutes
        return act(*args)

    run.learner.collector.act = slow
    run.run()
    checkpoints = sorted(int(folder.name) for folder in (tmp_path / "checkpoints" / "resume").iterdir())
    assert checkpoints == [0, 20, 40, 60, 80, 90]


def test_without_minutes_only_the_interval_asks_for_a_checkpoint(tmp_path, monkeypatch, tiny_config, make_run):
    clock = itertools.count(step=1e6)
    monkeypatch.setattr(time, "perf_counter", lambda: float(next(clock)))
    make_run(tiny_config(checkpoint_minutes=None, checkpoint_keep=99, total_env_steps=90), tmp_path).run()
    assert sorted(int(folder.name) for folder in (tmp_path / "checkpoints" / "resume").iterdir()) == [0, 80, 90]


def test_every_decision_after_the_seed_phase_is_stored_with_a_planner_s_target(finished):
    rows = finished.run.learner.replay[:]
    assert len(rows) == 80
    assert (rows["plan", "scale"][30:] != 1).all()
    assert set(rows["collector", "traj_ids"].tolist()) == {0, 1, 2, 3}
    assert not {"plan_mean", "is_init", "episode_reward", "done"} & set(rows.keys())


def test_two_environments_keep_the_ratio_of_updates_to_decisions(tmp_path, tiny_config, make_run, read_table):
    # 31 seed decisions need 16 steps of two environments.
    config = tiny_config(num_envs=2, replay={"seed_decisions": 31}, total_env_steps=82, eval_every=1000)
    run = make_run(config, tmp_path)
    summary = run.run()
    decisions = run.learner.collector.frames
    assert summary["env_steps"] == 2 * decisions == 84  # the first multiple of a step of both that reaches the budget
    assert run.learner.agent.updater.updates == 7 + 2 * (decisions - 32)
    assert [row["env_steps"] for row in read_table(tmp_path / "eval.csv")] == [0, 84]
    trajectories = run.learner.replay[:]["collector", "traj_ids"]
    assert (trajectories[0::2] % 2 == 0).all()
    assert (trajectories[:40:2] == 0).all()
    assert (trajectories[1:40:2] == 1).all()


@pytest.mark.parametrize("num_envs", [1, 3])
def test_every_decision_of_every_environment_brings_its_share_of_reanalyze(tmp_path, num_envs, tiny_config, make_run):
    run = make_run(tiny_config(num_envs=num_envs, reanalyze={"every": 4}, total_env_steps=120), tmp_path)
    refreshed = []
    run.learner.reanalyze.refresh = lambda batch: refreshed.append(run.learner.collector.frames) or batch
    run.run()
    learned = run.learner.collector.frames - math.ceil(30 / num_envs) * num_envs
    assert len(refreshed) == learned // 4


@pytest.mark.parametrize("overlap", [False, True])
def test_with_overlap_an_update_sees_the_data_of_the_decision_before(tmp_path, overlap, tiny_config, make_run):
    run = make_run(tiny_config(overlap=overlap, num_envs=2, total_env_steps=82), tmp_path)
    sizes = []
    update = run.learner.agent.updater.step

    def watched(batch, *, distill):
        if distill:
            sizes.append(len(run.learner.replay))
        return update(batch, distill=distill)

    run.learner.agent.updater.step = watched
    run.run()
    before = range(30, run.learner.collector.frames, 2)  # rows in the buffer when a step of two environments begins
    assert sizes == [rows + (0 if overlap else 2) for rows in before for _ in range(4)]


def test_with_insertion_by_episode_only_whole_episodes_are_in_the_buffer(tmp_path, tiny_config, make_run):
    config = tiny_config(
        total_env_steps=1100, replay={"insertion": "episode", "seed_decisions": 500, "pretrain_updates": 1}
    )
    run = make_run(config, tmp_path)
    for number in range(1, 3 * EPISODE):
        run.learner.step()
        assert len(run.learner.replay) == number // EPISODE * EPISODE
    list(run.learner.pretrain())
    run.learner.update()
    assert run.learner.agent.updater.updates == 2


def test_pretraining_neither_distils_nor_reanalyzes(tmp_path, tiny_config, make_run):
    run = make_run(tiny_config(reanalyze={"every": 1}), tmp_path)
    for _ in range(30):
        run.learner.step()
    policy = {name: value.clone() for name, value in run.learner.agent.world_model.policy.state_dict().items()}
    encoder = run.learner.agent.world_model.encoder.output.weight.clone()
    list(run.learner.pretrain())
    assert run.learner.agent.updater.updates == 7
    assert (run.learner.reanalyze.samples, run.learner.reanalyze.refreshed) == (0, 0)
    assert not torch.equal(run.learner.agent.world_model.encoder.output.weight, encoder)
    after = run.learner.agent.world_model.policy.state_dict()
    assert all(torch.equal(value, policy[name]) for name, value in after.items())
    run.learner.update()
    assert run.learner.reanalyze.refreshed == 0  # every decision is every second update
    run.learner.update()
    assert run.learner.reanalyze.refreshed > 0
    assert not torch.equal(run.learner.agent.world_model.policy.output.weight, policy["output.weight"])


class BreakingReward(Transform):
    """The reward is not a number any more after so many steps."""

    def __init__(self, steps: int) -> None:
        super().__init__(in_keys=[], out_keys=[])
        self.steps = steps

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        self.steps -= 1
        if self.steps < 0:
            next_tensordict["reward"] = torch.full_like(next_tensordict["reward"], torch.nan)
        return next_tensordict

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return tensordict_reset


@pytest.mark.parametrize(("steps", "updates"), [(10, 0), (33, 7 + 2 * 3)], ids=["while seeding", "while learning"])
def test_an_environment_that_keeps_failing_stops_the_run_after_it_was_saved(
    tmp_path, steps, updates, tiny_config, make_run, user_warnings
):
    run = make_run(tiny_config(max_faults=3), tmp_path, BreakingReward(steps))
    message = rf"reward.* at decision step {steps} .*; training goes on with a fresh episode \(failure \d\)\.$"
    with (
        pytest.warns(UserWarning, match=message) as warned,
        pytest.raises(NonFiniteError, match=rf"reward.* at decision step {steps} ") as caught,
    ):
        run.run()
    assert len(user_warnings(warned)) == 2
    assert "\n" not in str(caught.value)
    agent, _, counters = load_agent(tmp_path / "checkpoints" / "last.pt")
    assert (counters["decision_steps"], counters["updates"]) == (steps, updates)
    assert agent.updater.updates == updates
    assert len(run.learner.replay) == steps
    assert not (tmp_path / "summary.json").exists()
    assert run.learner.collector.env.is_closed
    assert run.evaluator.env.is_closed


class Crash(Transform):
    """Raises at some of the environment's steps, as MuJoCo does when its physics diverges."""

    def __init__(self, *steps: int) -> None:
        super().__init__(in_keys=[], out_keys=[])
        self.steps, self.calls = steps, 0

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        self.calls += 1
        if self.calls in self.steps:
            raise RuntimeError("the physics is invalid: warning 'BADQACC'\nand more")
        return next_tensordict

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return tensordict_reset


def test_a_simulator_that_fails_now_and_then_costs_its_episodes_only(
    tmp_path, tiny_config, make_run, read_table, user_warnings
):
    run = make_run(tiny_config(max_faults=2), tmp_path, Crash(5, 42, 75))
    with pytest.warns(UserWarning, match=r"^the environment failed at decision step \d+: the physics is inv") as warned:
        summary = run.run()
    assert len(user_warnings(warned)) == 3
    assert summary["env_steps"] == 160
    assert [row["env_steps"] for row in read_table(tmp_path / "eval.csv")] == [0, 80, 160]
    assert len(run.learner.replay) == 80
    assert run.learner.agent.updater.updates == 7 + 2 * 50
    rows = run.learner.replay[:]
    ends = rows["collector", "traj_ids"].diff() != 0
    assert rows["next", "done"].squeeze(-1)[:-1][ends].all()
    assert rows["next", "truncated"].sum() == rows["next", "done"].sum()
    assert read_table(tmp_path / "train.csv")[-1]["simulator_faults"] == 3


class CrashAtResets(Transform):
    """Raises at every other reset but the first."""

    def __init__(self) -> None:
        super().__init__(in_keys=[], out_keys=[])
        self.calls = 0

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        self.calls += 1
        if self.calls % 2 == 0:
            raise RuntimeError("no room for another simulator")
        return tensordict_reset


def test_a_run_of_many_failed_resets_keeps_all_of_its_rows_and_can_be_made_longer(tmp_path, tiny_config, make_run):
    config = tiny_config()
    run = make_run(config, tmp_path, CrashAtResets())
    with pytest.warns(UserWarning, match=r"no room for another simulator; training goes on"):
        run.run()
    assert run.learner.faults == 4
    first = run.learner.replay[:]
    assert len(first) == 80 + 4  # the step before a reset that fails is not counted
    assert first["collector", "traj_ids"][0] == 0
    run.log.directory.close()
    longer = make_run(dataclasses.replace(config, total_env_steps=180), tmp_path, resume=True)
    assert longer.run()["env_steps"] == 180
    assert torch.equal(longer.learner.replay[:84]["observation"], first["observation"])


def test_resets_that_fail_behind_finished_episodes_are_no_failures_in_a_row(tmp_path, tiny_config, make_run):
    run = make_run(tiny_config(max_faults=2), tmp_path, CrashAtResets())
    with pytest.warns(UserWarning, match=r"no room for another simulator; training goes on"):
        assert run.run()["env_steps"] == 160
    assert run.learner.faults == 4


def test_a_run_that_went_on_after_too_many_failures_has_as_many_new_ones(tmp_path, tiny_config, make_run):
    config = tiny_config(max_faults=3, total_env_steps=90)
    run = make_run(config, tmp_path, Crash(33, 34, 35))
    with pytest.warns(UserWarning, match=r"fresh episode \(failure \d\)"), pytest.raises(SimulatorError):
        run.run()
    run.log.directory.close()
    with pytest.warns(UserWarning, match="fresh episode"):
        resumed = make_run(config, tmp_path, Crash(3), resume=True)
        assert resumed.run()["env_steps"] == 90
    assert resumed.learner.faults == 4


def test_an_evaluation_that_fails_does_not_end_the_training(tmp_path, tiny_config, make_run, read_table):
    run = make_run(tiny_config(total_env_steps=90), tmp_path)
    step = run.evaluator.env.step
    calls = []

    def break_once(tensordict: TensorDictBase):
        calls.append(1)
        if len(calls) == EPISODE + 5:
            raise RuntimeError("no more of it")
        return step(tensordict)

    run.evaluator.env.step = break_once
    message = r"^the evaluation at 80 env steps failed \(no more of it\); training goes on\.$"
    with pytest.warns(UserWarning, match=message):
        run.run()
    assert [row["env_steps"] for row in read_table(tmp_path / "eval.csv")] == [0, 90]


def test_a_run_whose_last_evaluation_fails_has_a_best_return_and_no_final_one(
    tmp_path, tiny_config, make_run, monkeypatch
):
    def tell(evaluator: Evaluator, on_step: object = None) -> EvaluationResult:
        if not told:
            raise RuntimeError("no more of it")
        return EvaluationResult(return_mean=told.pop(), return_std=1.0, episodes=1)

    told = [20.0, 90.0]  # the untrained agent is the best
    monkeypatch.setattr(Evaluator, "__call__", tell)
    run = make_run(tiny_config(total_env_steps=90), tmp_path)
    with pytest.warns(UserWarning, match=r"^the evaluation at 90 env steps failed \(no more of it\)"):
        summary = run.run()
    assert summary["best_return"] == 90
    assert math.isnan(summary["final_return"])
    assert json.loads((tmp_path / "summary.json").read_text())["final_return"] is None


def test_an_evaluation_that_fails_before_anything_was_learned_is_an_error(tmp_path, tiny_config, make_run):
    run = make_run(tiny_config(), tmp_path)

    def fail(tensordict: TensorDictBase):
        raise RuntimeError("wrong sizes")

    run.evaluator.env.step = fail
    with pytest.raises(RuntimeError, match="wrong sizes"):
        run.run()


def test_updates_that_stay_without_a_finite_gradient_stop_the_run_and_name_the_term(tmp_path, tiny_config, make_run):
    config = tiny_config(max_skipped=20, optim={"updates_per_decision": 1}, total_env_steps=130)
    run = make_run(config, tmp_path)
    step, calls = run.learner.agent.updater.step, []

    def poisoned(batch: TensorDictBase, *, distill: bool = True):
        calls.append(1)
        if len(calls) > 12:
            batch["next", "reward"][0] = torch.nan
        return step(batch, distill=distill)

    run.learner.agent.updater.step = poisoned
    with pytest.raises(NonFiniteError, match=r"^the last \d+ updates had no finite gradient .* loss_reward, "):
        run.run()
    agent, _, _ = load_agent(tmp_path / "checkpoints" / "last.pt")
    assert all(value.isfinite().all() for value in agent.loss.state_dict().values())
    skipped = int(run.learner.agent.updater.skipped)
    assert 20 <= skipped < 60
    resumed = make_run(config, tmp_path, resume=True)
    assert resumed.run() is not None  # with nothing wrong any more it has as many tries as at first
    assert int(resumed.learner.agent.updater.skipped) == skipped


def test_any_other_error_closes_the_environments_too(tmp_path, monkeypatch, tiny_config, make_run):
    run = make_run(tiny_config(), tmp_path)

    def fail(*_: Any) -> None:
        raise RuntimeError("out of memory")

    monkeypatch.setattr(run.learner, "pretrain", fail)
    with pytest.raises(RuntimeError, match="out of memory"):
        run.run()
    assert run.learner.collector.env.is_closed
    assert run.evaluator.env.is_closed
    assert not (tmp_path / "summary.json").exists()


@pytest.mark.parametrize(
    ("task", "sizes", "iterations"),
    [("walker-walk", (24, 6), 2), ("quadruped-run", (78, 12), 2), ("humanoid-run", (67, 21), 4)],
)
def test_the_paper_s_method_runs_on_a_real_task(task, sizes, iterations):
    base = preset("efficient-tdmpc-utd4")
    small = {"num_samples": 16, "num_elites": 4, "num_proposals": 4, "iterations": 2}
    config = dataclasses.replace(
        base,
        task=task,
        compile="off",
        total_env_steps=100,
        model=dataclasses.replace(base.model, latent_dim=32, mlp_dim=32, encoder_dim=32),
        planner=dataclasses.replace(base.planner, **small),
        reanalyze=dataclasses.replace(base.reanalyze, **small, num_slices=4),
        optim=dataclasses.replace(base.optim, batch_size=8),
        replay=dataclasses.replace(base.replay, seed_decisions=12),
    )
    torch.manual_seed(0)
    env = make_env(task, seed=0)
    assert (env.observation_spec["observation"].shape[-1], env.action_spec.shape[-1]) == sizes
    agent, replay = build_agent(config, *sizes), build_replay(config)
    assert agent.planner.iterations == agent.reanalyze_planner.iterations == iterations
    reanalyze = build_reanalyze(config, agent, replay)
    collector = build_collector(config, agent, env, replay)

    def update(*, distill: bool = True) -> TensorDict:
        return agent.updater.step(replay.sample(), distill=distill)

    for _ in range(12):
        collector.step()
    reanalyze.enabled = False
    update(distill=False)
    reanalyze.enabled = True
    for _ in range(4):
        row = collector.step()
        assert (row["action"].abs() <= 1).all()
        assert not row["plan", "fallback"].any()
        for _ in range(4):
            metrics = update()
            assert all(value.isfinite() for value in metrics.values()), metrics
    collector.shutdown()
    assert agent.updater.updates == 17
    assert reanalyze.refreshed > 0  # 16 samples, every 8th
    assert reanalyze.stale == 0
    rows = replay[:]
    assert len(rows) == 16
    assert (rows["plan", "version"][12:] > 0).all()
    assert (rows["plan", "scale"][12:] != 1).all()
    assert all(parameter.isfinite().all() for parameter in agent.world_model.parameters())
