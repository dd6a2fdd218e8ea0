from __future__ import annotations

from typing import Any

import pytest
import torch
from torchrl.checkpoint import GlobalRNGState

pytest.importorskip("dm_control")

from torchrl_etdmpc.collectors import StepCollector  # noqa: E402
from torchrl_etdmpc.runs import RunDirectory  # noqa: E402
from torchrl_etdmpc.training import RunInterrupted, read_run_config, resumed_config  # noqa: E402
from torchrl_etdmpc.training.run_checkpoints import RandomState  # noqa: E402
from torchrl_etdmpc.training.signals import WorkLeftError  # noqa: E402

PLACES = {
    "in the first evaluation": (lambda run: (run.evaluator.env, "step_and_maybe_reset"), 5),
    "in the seed phase": (lambda run: (run.learner.collector, "act"), 13),
    "in pretraining": (lambda run: (run.learner.agent.updater, "step"), 4),
    "in an update": (lambda run: (run.learner.agent.updater, "step"), 20),
    "in a decision in mid-episode": (lambda run: (run.learner.collector, "act"), 33),
    "at the end of an episode": (lambda run: (run.learner.collector, "act"), 40),
    "in a later evaluation": (lambda run: (run.evaluator.env, "step_and_maybe_reset"), 30),
    "while it is saved": (lambda run: (run.checkpoints.store, "save"), 1),
}


@pytest.mark.parametrize("place", PLACES)
def test_a_run_that_was_stopped_anywhere_ends_as_if_it_had_not_been(
    tmp_path, straight, place, small_config, make_run, results, stop_at
):
    config = small_config()
    run = make_run(config, tmp_path)
    find, call = PLACES[place]
    stop_at(run, *find(run), call)
    with pytest.raises(RunInterrupted, match=r"^stopped (before the first step|at \d+ env steps and saved in )"):
        run.run()
    run.log.directory.close()
    resumed = make_run(config, tmp_path, resume=True)
    resumed.run()
    assert results(resumed, tmp_path) == straight(config)


def test_a_run_that_is_asked_to_stop_does_not_wait_for_the_end_of_an_evaluation(
    tmp_path, small_config, make_run, stop_at
):
    run = make_run(small_config(), tmp_path)
    run.learner.step()
    steps, play = [], run.evaluator.env.step_and_maybe_reset
    run.evaluator.env.step_and_maybe_reset = lambda tensordict: steps.append(1) or play(tensordict)
    stop_at(run, run.evaluator.env, "step_and_maybe_reset", 3)
    with pytest.raises(RunInterrupted, match="^stopped at 2 env steps and saved in "):
        run.evaluate()
    assert len(steps) == 3
    assert not (tmp_path / "eval.csv").exists()


@pytest.mark.parametrize(
    "changes",
    [
        {
            "num_envs": 3,
            "total_env_steps": 170,
            "optim": {"updates_per_decision": 1},
            "loss": {"value_replayed": 0.5, "value_expectile": 0.7},
            "model": {"normalize_observations": True},
        },
        {
            "replay": {"insertion": "episode"},
            "episode_length": 40,
            "optim": {"average_decay": 0.9, "lr_halved_after": 7},
        },
        {"replay": {"capacity": 30}, "overlap": True},
        pytest.param({"reanalyze": {"every": 0}}, marks=pytest.mark.slow),
        pytest.param({"planner": {"first_action": "mean"}, "eval_policy": True}, marks=pytest.mark.slow),
    ],
)
def test_every_kind_of_run_can_be_stopped_many_times(
    tmp_path, straight, changes, small_config, make_run, results, stop_at
):
    config = small_config(**changes)
    run = make_run(config, tmp_path)
    for call in (5, 20, 3):  # in the random phase, and twice while it learns
        stop_at(run, run.learner.collector, "act", call)
        with pytest.raises(RunInterrupted):
            run.run()
        run.log.directory.close()
        run = make_run(config, tmp_path, resume=True)
    run.run()
    assert results(run, tmp_path) == straight(config)


def test_a_run_that_was_killed_forgets_what_came_after_its_checkpoint(
    tmp_path, straight, small_config, make_run, results
):
    config = small_config()

    class Killed(BaseException):
        pass

    def die() -> None:
        raise Killed

    run = make_run(config, tmp_path)
    original = run.learner.collector.act
    calls = iter([original] * 54 + [lambda *_: die()])
    run.learner.collector.act = lambda *args: next(calls)(*args)
    with pytest.raises(Killed):
        run.run()
    assert len((tmp_path / "eval.csv").read_text().splitlines()) == 4  # a row that the checkpoint has not seen
    run.log.directory.close()
    with (tmp_path / "train.csv").open("a") as file:
        file.write("12,3,half a ro")
    resumed = make_run(config, tmp_path, resume=True)
    assert resumed.env_steps == 100
    resumed.run()
    assert results(resumed, tmp_path) == straight(config)


def test_a_simulator_that_cannot_be_restored_does_not_begin_as_the_run_did(
    tmp_path, small_config, make_run, monkeypatch
):
    monkeypatch.setattr("torchrl_etdmpc.collectors.step.simulator_state", lambda _: None)
    run = make_run(small_config(), tmp_path)
    begun = run.learner.collector.step()["observation"]
    for _ in range(4):
        run.learner.collector.step()
    run.checkpoints.save()
    starts, seeds, set_seed = [], [], StepCollector.set_seed
    monkeypatch.setattr(StepCollector, "set_seed", lambda self, seed: seeds.append(seed) or set_seed(self, seed))
    for _ in range(2):
        run.log.directory.close()
        with pytest.warns(UserWarning, match="the environment cannot be restored, so fresh episodes begin"):
            run = make_run(small_config(), tmp_path, resume=True)
        rows = run.learner.replay.storage[:]
        assert rows["next", "truncated"][-1]  # the episode that was running has an end
        starts.append(run.learner.collector.step()["observation"])
        run.checkpoints.save()
    assert len({tuple(start.reshape(-1).tolist()) for start in (begun, *starts)}) == 3
    assert min(seeds) > run.config.seed + 10_000  # the evaluations' seed, which a long run must not come to


def test_a_longer_budget_goes_on_with_a_finished_run(tmp_path, small_config, make_run):
    short = small_config(total_env_steps=80)
    run = make_run(short, tmp_path)
    run.run()
    stored = read_run_config(RunDirectory(tmp_path))
    longer = resumed_config(stored, small_config(total_env_steps=120), ["total_env_steps"])
    resumed = make_run(longer, tmp_path, resume=True)
    assert resumed.run()["env_steps"] == 120
    assert read_run_config(RunDirectory(tmp_path)).total_env_steps == 120
    assert len(resumed.learner.replay) == 60
    again = make_run(longer, tmp_path, resume=True)
    assert (again.learner.replay[:] == resumed.learner.replay[:]).all()  # targets too


def test_other_settings_must_stay(tmp_path, small_config):
    saved = small_config()
    asked = small_config(planner={"horizon": 3}, threads=2)
    assert resumed_config(saved, asked, ["threads"]).threads == 2
    assert resumed_config(saved, asked, []).planner.horizon == 2
    with pytest.raises(ValueError, match=r"^planner.horizon=3 was asked for, but this run was started with "):
        resumed_config(saved, asked, ["planner.horizon"])


def test_a_run_does_what_its_saved_state_says_is_due(tmp_path, small_config, make_run, read_table, stop_at):
    # The words are stored, so they outlive the code: no renaming may change what they mean.
    config = small_config(checkpoint_every=1000)
    run = make_run(config, tmp_path)
    for _ in range(24):
        run.learner.step()
    list(run.learner.pretrain())
    state = {
        "stage": "learn",
        "due": ["evaluation", "train_row", "checkpoint"],
        "eval_returns": [1e6],
        "learning_s": 2.0,
        "wall_s": 3.0,
    }
    run.state.load_state_dict(state)
    assert run.checkpoints.save()
    run.log.directory.close()
    resumed = make_run(config, tmp_path, resume=True)
    restored = resumed.state.state_dict()
    assert restored.pop("wall_s") >= state.pop("wall_s")
    assert restored == state
    done, save = [], resumed.checkpoints.store.save
    resumed.checkpoints.store.save = lambda step, *args, **options: done.append(step) or save(step, *args, **options)
    stop_at(resumed, resumed.learner.collector, "act", 1)
    with pytest.raises(RunInterrupted):
        resumed.run()
    assert done == [48, 50]  # because it was due, and because it was asked to stop
    assert [row["env_steps"] for row in read_table(tmp_path / "eval.csv")] == [48]
    assert [row["env_steps"] for row in read_table(tmp_path / "train.csv")] == [48]
    assert resumed.state.stage == "learn"
    assert resumed.state.due == []


def test_a_step_that_a_signal_broke_off_calls_for_nothing(tmp_path, small_config, make_run):
    run = make_run(small_config(), tmp_path)
    for _ in range(20):
        run.learner.step()
    assert run.learner.passed(run.config.log_every)  # the step before did, and its row is written
    run.state.load_state_dict(run.state.state_dict() | {"stage": "learn", "due": []})

    def leave(**_: Any) -> None:
        run.stop.requested = True
        raise WorkLeftError

    run.learner.step = leave
    with pytest.raises(RunInterrupted):
        run.run()
    assert run.state.due == []


@pytest.mark.parametrize("stage", ["random", "pretrain", "learn"])
def test_a_run_goes_on_in_the_stage_that_was_saved(tmp_path, stage, small_config, make_run):
    config = small_config(total_env_steps=70, eval_every=1000)
    run = make_run(config, tmp_path)
    for _ in range(30 if stage == "learn" else 24):
        run.learner.step()
    run.state.load_state_dict(run.state.state_dict() | {"stage": stage, "due": []})
    assert run.checkpoints.save()
    run.log.directory.close()
    resumed = make_run(config, tmp_path, resume=True)
    resumed.run()
    learned = resumed.learner.collector.frames - (30 if stage == "learn" else 24)
    assert resumed.learner.agent.updater.updates == (0 if stage == "learn" else 7) + 2 * learned


def test_an_evaluation_after_a_resume_plays_the_same_episodes(tmp_path, small_config, make_run):
    run = make_run(small_config(), tmp_path)
    for _ in range(5):
        run.learner.step()
    assert run.checkpoints.save()
    before = run.evaluator()
    run.log.directory.close()
    resumed = make_run(small_config(), tmp_path, resume=True)
    for _ in range(3):
        resumed.learner.step()
    assert resumed.evaluator() == run.evaluator() == before


def test_a_run_goes_on_where_there_are_fewer_gpus(tmp_path, monkeypatch, small_config, make_run):
    plain = GlobalRNGState.state_dict
    device = torch.cuda.get_rng_state() if torch.cuda.is_available() else torch.zeros(16, dtype=torch.uint8)
    monkeypatch.setattr(GlobalRNGState, "state_dict", lambda self: plain(self) | {"torch_cuda": 99 * [device]})
    run = make_run(small_config(), tmp_path / "run")
    run.learner.step()
    assert run.checkpoints.save()
    run.log.directory.close()
    with pytest.warns(UserWarning, match=r"saved on a machine with 99 GPUs, here are \d+: it goes on with "):
        resumed = make_run(small_config(), tmp_path / "run", resume=True)
    assert resumed.learner.step()
    assert resumed.env_steps == 4


def test_the_gpus_that_are_here_get_their_random_numbers_back(monkeypatch):
    state, expected, restored = RandomState().state_dict(), torch.rand(3), []
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    monkeypatch.setattr(torch.cuda, "set_rng_state_all", lambda states: restored.append([int(it) for it in states]))
    first, second = torch.tensor(1), torch.tensor(2)
    RandomState().load_state_dict(state | {"torch_cuda": [first]})
    with pytest.warns(UserWarning, match="saved on a machine with 2 GPUs, here are 1: "):
        RandomState().load_state_dict(state | {"torch_cuda": [first, second]})
    assert restored == [[1], [1]]
    assert torch.equal(torch.rand(3), expected)
