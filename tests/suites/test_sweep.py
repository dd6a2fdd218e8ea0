"""Searches: what is proposed, what it is worth, and that a kill loses nothing."""

from __future__ import annotations

import math
import os
import signal
from pathlib import Path

import pytest

from torchrl_etdmpc.suites import RunQueue, Search, Sweep, read_progress, run_locally
from torchrl_etdmpc.suites import sweep as module
from torchrl_etdmpc.suites.attempt import last_verdict

pytest.importorskip("optuna")
SPACE = {"optim.lr": {"low": 1e-4, "high": 1e-1, "log": True}, "model.mlp_dim": [16, 32]}


@pytest.fixture
def search(small):
    """An experiment with one search."""

    def make(trials: int = 6, prune: bool = True, space=SPACE, **changes):
        searches = {"tuned": Search(space, trials, {"loss.rho": 0.4}, prune)}
        return small.experiment(variants={}, searches=searches, **changes)

    return make


def worth(config) -> float:
    """A peak at a learning rate of 1e-2 and 32 units."""
    return 900 - 200 * abs(math.log10(config.optim.lr) + 2) + config.model.mlp_dim


def train(small, sweep: Sweep, most: int = 1000) -> list[str]:
    """Finishes the runs of the open trials and of all that are proposed, in no time; names of what was trained."""
    done = []
    while len(done) < most and (runs := sweep.runs() or sweep.propose()):
        for run in runs:
            small.write_finished(run, returns=worth(run.config) + run.seed)
            done.append(run.name)
        sweep.look()
    return done


def study_of(folder):
    import optuna

    return optuna.load_study(study_name="tuned", storage=f"sqlite:///{folder / 'sweeps.sqlite'}")


def test_a_trial_is_a_variant_on_every_task_and_seed_with_proposed_settings(search, tmp_path):
    kept = {}
    sweep = Sweep(search(tasks=("cup-catch", "walker-walk"), seeds=(1, 2)), "tuned", tmp_path, kept.__setitem__)
    runs = sweep.propose()
    assert [run.name for run in runs] == [
        f"tuned trial 0/{task}/seed{seed}" for task in ("cup-catch", "walker-walk") for seed in (1, 2)
    ]
    (config,) = {(run.config.optim.lr, run.config.model.mlp_dim, run.config.loss.rho) for run in runs}
    assert 1e-4 <= config[0] <= 1e-1
    assert config[1] in (16, 32)
    assert config[2] == 0.4
    assert kept == {"tuned trial 0": {"loss.rho": 0.4, "optim.lr": config[0], "model.mlp_dim": config[1]}}
    assert runs[0].path == tmp_path / "tuned trial 0" / "cup-catch" / "seed1"
    assert study_of(tmp_path).trials[0].distributions["optim.lr"].log


@pytest.mark.parametrize("name", ["what?", "a%20b", "#ü @:"])
def test_a_study_lies_in_its_folder_whatever_that_is_called(search, tmp_path, name):
    for most in (1, 2):
        (tmp_path / name).mkdir(exist_ok=True)
        sweep = Sweep(search(trials=most), "tuned", tmp_path / name)
        assert len(sweep.runs() or sweep.propose()) == 1
        assert [file.relative_to(tmp_path) for file in tmp_path.rglob("*")] == [Path(name), Path(name, "sweeps.sqlite")]


@pytest.mark.parametrize("found_by", ["the settings", "the parts"])
def test_a_proposal_that_cannot_be_trained_is_a_failed_trial_and_leaves_no_variant(search, small, tmp_path, found_by):
    import optuna

    def check(run) -> None:
        if found_by == "the parts" and (run.config.optim.batch_size, run.config.model.mlp_dim) == (8, 32):
            raise ValueError("too much for them")

    fits = {"optim.batch_size": [4, 8], "model.mlp_dim": [16, 32]}
    conflicts = {"num_envs": [1, 8], "replay.insertion": ["step", "episode"]}
    kept, said = {}, []
    settings = small.settings | {"replay.seed_decisions": 200}  # which are two episodes
    asked = search(12, False, fits if found_by == "the parts" else conflicts, settings=settings, budget=900)
    parts = kept.__setitem__, check, said.append
    train(small, Sweep(asked, "tuned", tmp_path, *parts))
    trials = study_of(tmp_path).trials
    failed = [trial.number for trial in trials if trial.state == optuna.trial.TrialState.FAIL]
    assert len(trials) == 12 and 0 < len(failed) < 12
    assert {tuple(trials[number].params.values()) for number in failed} in ({(8, "episode")}, {(8, 32)})
    assert list(kept) == [f"tuned trial {number}" for number in range(12) if number not in failed]
    assert [line.partition(": cannot be trained: ")[0] for line in said] == [f"tuned trial {one}" for one in failed]
    again = Sweep(asked, "tuned", tmp_path, *parts)
    assert again.done and again.propose() == []


def test_ranges_of_whole_numbers_propose_whole_numbers(search, tmp_path):
    sweep = Sweep(search(space={"planner.horizon": {"low": 2, "high": 5}}), "tuned", tmp_path)
    horizons = [sweep.propose()[0].config.planner.horizon for _ in range(6)]
    assert {type(horizon) for horizon in horizons} == {int}
    assert set(horizons) <= {2, 3, 4, 5}


def test_a_range_of_a_setting_that_is_whole_holds_whole_numbers_however_its_ends_are_written(search, tmp_path):
    space = {"optim.batch_size": {"low": 64, "high": 1e3}, "optim.grad_clip_norm": {"low": 1.0, "high": 20.0}}
    sweep = Sweep(search(space=space), "tuned", tmp_path)
    settings = [sweep.propose()[0].config.optim for _ in range(4)]
    assert {type(one.batch_size) for one in settings} == {int}
    assert any(not one.grad_clip_norm.is_integer() for one in settings)


@pytest.mark.parametrize("name", ["replay.seed_decisions", "task.episode_length", "replay.pretrain_updates"])
def test_a_setting_that_may_be_null_is_whole_as_well(name):
    assert Search({name: {"low": 1e3, "high": 5e3}}, trials=4).is_whole(name)
    assert not Search({name: {"low": 1e3, "high": 5000.5}}, trials=4).is_whole(name)
    assert not Search({"checkpoint_minutes": {"low": 1e3, "high": 5e3}}, trials=4).is_whole("checkpoint_minutes")


def test_the_value_of_a_trial_is_the_mean_over_tasks_and_seeds_of_the_last_return(search, small, tmp_path):
    sweep = Sweep(search(trials=2, seeds=(1, 2, 6)), "tuned", tmp_path)
    train(small, sweep)
    assert sweep.done
    assert sweep.propose() == []
    for trial in study_of(tmp_path).trials:
        (run, *_) = sweep._runs(trial.number, trial.params)
        assert trial.value == pytest.approx(worth(run.config) + 3)
    assert sweep.best().startswith("tuned: the best of 2 finished trials is trial ")


def test_the_best_trial_is_the_one_of_the_highest_value_also_below_zero(search, small, tmp_path):
    sweep = Sweep(search(trials=3), "tuned", tmp_path)
    for returns in (-300.0, -100.0, -200.0):
        (run,) = sweep.propose()
        small.write_finished(run, returns=returns)
        sweep.look()
    assert sweep.best().startswith("tuned: the best of 3 finished trials is trial 1, -100.0: ")


@pytest.mark.slow
def test_the_search_finds_the_peak(search, small, tmp_path):
    sweep = Sweep(search(trials=40), "tuned", tmp_path)
    train(small, sweep)
    best = study_of(tmp_path).best_trial
    assert best.params["model.mlp_dim"] == 32
    assert 3e-3 < best.params["optim.lr"] < 3e-2


def test_a_search_goes_on_with_what_was_running_and_repeats_nothing(search, small, tmp_path):
    done = train(small, Sweep(search(trials=6), "tuned", tmp_path), most=3)
    first = Sweep(search(trials=6), "tuned", tmp_path)
    running = first.propose()
    second = Sweep(search(trials=6), "tuned", tmp_path)
    assert [run.name for run in second.runs()] == [run.name for run in running]
    assert [run.config for run in second.runs()] == [run.config for run in running]
    done += train(small, second)
    assert len(done) == len(set(done)) == 6
    points = [tuple(trial.params.values()) for trial in study_of(tmp_path).trials]
    assert len(set(points)) == 6  # not the same first proposals again


def test_a_process_that_is_killed_while_it_proposes_leaves_a_search_that_goes_on(search, small, tmp_path, in_copy):
    Sweep(search(trials=2), "tuned", tmp_path).propose()

    def die() -> None:
        import optuna

        sweep = Sweep(search(trials=2), "tuned", tmp_path)
        suggest = optuna.trial.Trial._suggest

        def after_one(trial, name, distribution):
            if name == "model.mlp_dim":
                os.kill(os.getpid(), signal.SIGKILL)
            return suggest(trial, name, distribution)

        optuna.trial.Trial._suggest = after_one
        sweep.propose()

    assert os.WIFSIGNALED(in_copy(die))
    sweep = Sweep(search(trials=2), "tuned", tmp_path)
    assert len(sweep.runs()) == 1
    train(small, sweep)
    values = [trial.value for trial in study_of(tmp_path).trials]
    assert len([value for value in values if value is not None]) == 2


def test_two_processes_that_share_a_search_close_each_trial_once(search, small, tmp_path):
    first = Sweep(search(trials=2), "tuned", tmp_path)
    (done,), (bad,) = first.propose(), first.propose()
    second = Sweep(search(trials=2), "tuned", tmp_path)
    assert second.runs() == [done, bad]
    assert not first.done and not second.done
    small.write_finished(done)
    first._tell(1, None)
    assert first.look() == []
    assert second.look() == [bad]  # its process is to be stopped here as well
    assert first.done and second.done
    assert [trial.value for trial in study_of(tmp_path).trials] == [500.0, None]


def test_a_process_that_begins_while_another_one_proposes_leaves_the_proposal_alone(search, tmp_path, monkeypatch):
    import optuna

    suggest, others = optuna.trial.Trial._suggest, []

    def suggest_late(trial, name, distribution):
        if name == "model.mlp_dim" and not others:
            others.append(Sweep(search(), "tuned", tmp_path))
        return suggest(trial, name, distribution)

    monkeypatch.setattr(optuna.trial.Trial, "_suggest", suggest_late)
    (run,) = Sweep(search(), "tuned", tmp_path).propose()
    assert run.variant == "tuned trial 0"
    assert others[0].runs() == []


def test_two_processes_that_share_a_search_propose_no_more_trials_than_asked(search, tmp_path):
    sweeps = [Sweep(search(trials=3), "tuned", tmp_path) for _ in range(2)]
    for _ in range(4):
        for sweep in sweeps:
            sweep.propose()
    assert len(study_of(tmp_path).trials) == 3


def test_a_trial_below_the_median_of_five_ends_early(search, small, tmp_path):
    sweep = Sweep(search(trials=8, seeds=(1, 2)), "tuned", tmp_path)
    for _ in range(5):
        runs = sweep.propose()
        for run in runs:
            small.write_tables(run, 100, returns=500.0)
        assert sweep.look() == []
        for run in runs:
            small.write_finished(run, returns=500.0)
        assert sweep.look() == []
    good, bad = sweep.propose(), sweep.propose()
    for run in (*good, bad[0]):
        small.write_tables(run, 100, returns=600.0 if run in good else 100.0)
    assert sweep.look() == []  # until all runs of the trial have been evaluated
    small.write_tables(bad[1], 100, returns=120.0)
    assert sweep.look() == bad
    assert study_of(tmp_path).trials[6].intermediate_values == dict.fromkeys((25, 50, 75, 100), 110.0)
    assert [run.name for run in sweep.runs()] == [run.name for run in good]


def test_a_step_at_which_fewer_than_five_trials_were_evaluated_ends_none_early(search, small, tmp_path):
    sweep = Sweep(search(trials=6), "tuned", tmp_path)
    for number in range(5):
        (run,) = sweep.propose()
        small.write_finished(run)
        if number == 0:  # its evaluation at step 100 has failed
            table = run.path / "eval.csv"
            table.write_text(table.read_text().replace("\n100,50,0,2.5,500.0", "\n100,50,0,2.5,nan"))
        assert sweep.look() == []
    assert [100 in trial.intermediate_values for trial in study_of(tmp_path).trials] == [False, *[True] * 4]
    (run,) = sweep.propose()
    small.write_tables(run, 100, returns=1.0)
    assert sweep.look() == []


def test_trials_that_ended_unseen_count_in_the_median(search, small, tmp_path):
    sweep = Sweep(search(trials=7), "tuned", tmp_path)
    for returns in (900.0, 100.0, 100.0, 100.0, 100.0):
        (run,) = sweep.propose()
        if returns == 900:
            small.write_tables(run, 100, returns=returns)
            assert sweep.look() == []
        small.write_finished(run, returns=returns)  # in no process's sight, as after a kill
        assert sweep.look() == []
    assert study_of(tmp_path).trials[4].intermediate_values == dict.fromkeys((100, 200, 300), 100.0)
    (run,) = sweep.propose()
    small.write_tables(run, 400, returns=500.0)
    assert sweep.look() == []  # far above the median, though not above the only one that was seen


def test_the_evaluation_at_the_end_ends_no_trial_early(search, small, tmp_path):
    sweep = Sweep(search(trials=1), "tuned", tmp_path)
    (run,) = sweep.propose()
    small.write_tables(run, 400)  # its summary is still to be written
    assert sweep.look() == []
    assert sorted(study_of(tmp_path).trials[0].intermediate_values) == [100, 200, 300]


def test_without_pruning_no_trial_ends_early(search, small, tmp_path):
    sweep = Sweep(search(trials=7, prune=False), "tuned", tmp_path)
    for returns in (500.0, 500.0, 500.0, 500.0, 500.0, 1.0):
        (run,) = sweep.propose()
        small.write_tables(run, 200, returns=returns)
        assert sweep.look() == []
        small.write_finished(run, returns=returns)
        sweep.look()


def test_a_trial_that_another_suite_ends_meanwhile_ends_nothing_here(search, small, tmp_path, monkeypatch):
    sweep, other = (Sweep(search(trials=2), "tuned", tmp_path) for _ in range(2))
    (run,) = sweep.propose()
    small.write_tables(run, 100)
    evaluations = module._evaluations

    def meanwhile(run):
        other._tell(0, None)
        return evaluations(run)

    monkeypatch.setattr(module, "_evaluations", meanwhile)
    assert sweep.look() == []
    assert study_of(tmp_path).trials[0].state.name == "PRUNED"
    monkeypatch.undo()
    sweep.look()
    assert sweep.runs() == []


def test_what_was_pruned_is_marked_also_after_a_kill(search, small, tmp_path):
    sweep = Sweep(search(trials=2), "tuned", tmp_path)
    (run,) = sweep.propose()
    small.write_tables(run, 100)
    sweep._tell(0, None)
    assert last_verdict(run) is None
    again = Sweep(search(trials=2), "tuned", tmp_path)
    assert read_progress(run).state == "pruned"
    assert again.runs() == []
    assert len(again.propose()) == 1
    assert again.propose() == []


def test_a_run_that_is_given_up_leaves_its_trial_to_the_next_process(search, small, tmp_path):
    sweep = Sweep(search(trials=1, seeds=(1, 2)), "tuned", tmp_path)
    first, second = sweep.propose()
    small.write_finished(first)
    sweep.give_up(second)
    assert sweep.done
    assert sweep.best() == "tuned: no trial is finished"
    again = Sweep(search(trials=1, seeds=(1, 2)), "tuned", tmp_path)
    assert [run.name for run in again.runs()] == [first.name, second.name]
    small.write_finished(second)
    again.look()
    assert study_of(tmp_path).trials[0].value == 500.0


def test_more_trials_may_be_asked_for(search, small, tmp_path):
    train(small, Sweep(search(trials=2), "tuned", tmp_path))
    assert len(train(small, Sweep(search(trials=5), "tuned", tmp_path))) == 3


def test_a_damaged_study_is_refused_in_a_line(search, tmp_path):
    (tmp_path / "sweeps.sqlite").write_bytes(b"not a database at all" * 100)
    with pytest.raises(
        ValueError, match="sweeps.sqlite cannot be used as a study .*; remove it to search anew."
    ) as error:
        Sweep(search(), "tuned", tmp_path)
    assert "\n" not in str(error.value)


def test_a_pool_trains_a_search_to_its_end(search, small, tmp_path, stand_in, monkeypatch):
    from torchrl_etdmpc.suites import local, run_queue

    monkeypatch.setattr(local, "_POLL_S", 0.01)
    monkeypatch.setattr(run_queue, "_LOOK_AGAIN_S", 0.02)
    stand_in({"trial 2": [("fail", 0)], "trial 1": [("kill", 10), ("finish", 400)]})
    sweep = Sweep(search(trials=4, seeds=(1, 2)), "tuned", tmp_path)
    assert run_locally(RunQueue(sweep.runs(), trials=[sweep]), workers=3)
    values = [trial.value for trial in study_of(tmp_path).trials]
    assert [value is None for value in values] == [False, False, True, False]
