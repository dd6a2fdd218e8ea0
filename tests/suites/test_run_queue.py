"""What begins next, and what the end of a process means."""

from __future__ import annotations

import signal

import pytest

from torchrl_etdmpc.suites import RunQueue, read_progress, run_queue
from torchrl_etdmpc.suites.attempt import log_file, note
from torchrl_etdmpc.suites.run_queue import Retries, work


@pytest.fixture
def said():
    return []


@pytest.fixture
def queue_of(small, tmp_path, said):
    def make(retries: int = 2, trials=(), **changes) -> RunQueue:
        return RunQueue(small.experiment(**changes).runs(tmp_path), retries=retries, say=said.append, trials=trials)

    return make


def test_the_longest_begin_first(queue_of):
    variants = {"small": {}, "big": {"model.mlp_dim": 64}, "long": {"total_env_steps": 900}}
    queue = queue_of(variants=variants)
    order = [queue.next() for _ in range(3)]
    assert [work(run) for run in order] == sorted((work(run) for run in order), reverse=True)
    assert order[-1].variant == "small"
    assert queue.next() is None
    assert not queue.left


def test_a_run_that_is_named_twice_is_handed_out_once(small, tmp_path):
    runs = small.experiment(seeds=(1, 2)).runs(tmp_path)
    queue = RunQueue([*runs, *small.experiment(seeds=(2,)).runs(tmp_path), runs[0]])
    assert [queue.next().seed for _ in range(2)] == [1, 2]
    assert queue.next() is None
    assert queue.runs == runs


def test_finished_and_pruned_runs_are_not_handed_out(queue_of, small, tmp_path):
    finished, pruned, _ = small.experiment(seeds=(1, 2, 3)).runs(tmp_path)
    small.write_finished(finished)
    note(pruned, "pruned", "below")
    queue = queue_of(seeds=(1, 2, 3))
    assert queue.next().seed == 3
    assert queue.next() is None
    assert len(queue.runs) == 3


def test_a_run_that_is_tried_again_comes_before_those_that_wait(queue_of):
    queue = queue_of(seeds=(1, 2))
    run = queue.next()
    queue.ended(run, -signal.SIGKILL)
    assert queue.next() == run


def test_a_run_that_was_given_up_is_tried_again_by_the_next_suite(queue_of, small, tmp_path):
    (run,) = small.experiment().runs(tmp_path)
    note(run, "failed", "the simulator is gone")
    assert queue_of().next() == run


def test_a_run_that_fails_is_tried_so_often_and_given_up_with_its_reason(queue_of, said):
    queue = queue_of(retries=2)
    for _ in range(3):
        run = queue.next()
        log_file(run).parent.mkdir(parents=True, exist_ok=True)
        log_file(run).write_text("error: the simulator is gone\n")
        queue.ended(run, 1)
    assert queue.next() is None
    assert not queue.left
    assert [line.rpartition("; ")[2] for line in said] == ["it is tried again", "it is tried again", "given up"]
    assert read_progress(run).error == "the simulator is gone"


def test_a_run_that_gets_on_is_tried_without_limit(queue_of, small):
    queue = queue_of(retries=0)
    for steps in (100, 152, 200, 248):
        run = queue.next()
        small.write_tables(run, steps)
        queue.ended(run, -signal.SIGKILL)
    run = queue.next()
    queue.ended(run, -signal.SIGKILL)  # at 248 again
    assert queue.next() is None
    assert read_progress(run).error == "was stopped at 248 env steps (exit code -9), 1 times without getting further"


def test_getting_as_far_as_ever_is_not_getting_on(small, tmp_path):
    (run,) = small.experiment().runs(tmp_path)
    tries = Retries(2)
    answers = []
    for steps in (200, 160, 200, 160):  # each time from the checkpoint at 150
        small.write_tables(run, steps)
        answers.append(tries.again(run))
    assert answers == [True, True, True, False]


def test_a_finished_run_that_cannot_be_read_is_named(queue_of, small):
    queue = queue_of(retries=0)
    run = queue.next()
    run.path.mkdir(parents=True)
    (run.path / "summary.json").write_text("{")
    queue.ended(run, 0)
    assert read_progress(run).error == "it is finished, but its tables cannot be read"
    assert queue.next() is None


def test_a_run_that_cannot_be_started_is_tried_again_later(queue_of, monkeypatch, said):
    monkeypatch.setattr(run_queue, "_LOOK_AGAIN_S", 0.0)
    queue = queue_of(retries=1)
    for _ in range(2):
        queue.failed_to_begin(queue.next(), "No space left on device")
    assert queue.next() is None
    assert said[-1].endswith("cannot be started: No space left on device; given up")


def test_a_run_that_cannot_be_started_is_not_tried_again_at_once(queue_of, monkeypatch):
    monkeypatch.setattr(run_queue, "_LOOK_AGAIN_S", 60.0)
    queue = queue_of(seeds=(1, 2))
    queue.failed_to_begin(queue.next(), "No space left on device")
    assert queue.next().seed == 2
    assert queue.next() is None
    assert queue.left


def test_a_run_that_another_process_has_is_waited_for_however_long(queue_of, small, said, monkeypatch):
    monkeypatch.setattr(run_queue, "_LOOK_AGAIN_S", 0.0)
    in_use = [True]
    monkeypatch.setattr("torchrl_etdmpc.runs.RunDirectory.in_use", property(lambda self: in_use[0]))
    queue = queue_of(retries=0)
    for _ in range(5):
        assert queue.next() is None
        assert queue.left
    assert said == ["plain/cartpole-balance/seed1: another process trains it"]
    in_use[0] = False
    run = queue.next()
    in_use[0] = True
    queue.ended(run, 1)  # another process was quicker
    in_use[0] = False
    small.write_finished(run)
    assert queue.next() is None
    assert not queue.left
    assert said[-1] == f"{run.name}: finished"


class TwoTrials:
    """Proposes two runs one after the other, and ends one early."""

    def __init__(self, runs):
        self.waiting, self.early, self.given_up = list(runs), [], []

    @property
    def done(self):
        return not self.waiting

    def propose(self):
        return [self.waiting.pop(0)] if self.waiting else []

    def look(self):
        early, self.early = self.early, []
        return early

    def give_up(self, run):
        self.given_up.append(run)


def test_trials_are_proposed_when_nothing_else_can_begin(queue_of, small, tmp_path, said, monkeypatch):
    monkeypatch.setattr(run_queue, "_LOOK_AGAIN_S", 0.0)
    trials = TwoTrials(small.experiment(variants={"a": {}, "b": {}}).runs(tmp_path))
    queue = queue_of(retries=0, trials=[trials])
    assert queue.next().variant == "plain"
    assert len(trials.waiting) == 2
    first, second = queue.next(), queue.next()
    assert (first.variant, second.variant) == ("a", "b")
    assert queue.next() is None
    trials.early = [first]
    assert queue.to_be_stopped() == {first.name}
    queue.ended(first, 75)
    assert read_progress(first).state == "pruned"
    queue.ended(second, -9)
    assert trials.given_up == [second]
    assert not queue.left
    assert len(queue.runs) == 3
    assert said[0].endswith("ended early, its trial is below the median of the trials before it")


def test_a_waiting_run_of_a_trial_that_ended_early_never_begins(queue_of, small, tmp_path):
    trials = TwoTrials([])
    queue = queue_of(trials=[trials], seeds=(1, 2))
    trials.early = queue.runs[:1]
    queue.to_be_stopped()
    assert queue.next().seed == 2
    assert queue.next() is None


def test_the_trials_are_not_looked_at_all_the_time(queue_of, monkeypatch):
    monkeypatch.setattr(run_queue, "_LOOK_AGAIN_S", 60.0)
    trials, looks = TwoTrials([]), []
    monkeypatch.setattr(trials, "look", lambda: looks.append(1) or [])
    queue = queue_of(trials=[trials])
    for _ in range(3):
        queue.to_be_stopped()
    assert len(looks) == 1


def test_a_run_whose_trial_ended_early_is_not_waited_for(queue_of):
    trials = TwoTrials([])
    queue = queue_of(trials=[trials])
    run = queue.next()
    trials.early = [run]
    queue.to_be_stopped()
    run.path.mkdir(parents=True)
    log_file(run).write_text("error: run_dir=here is in use by another process; wait for it.\n")
    queue.ended(run, 1)
    assert read_progress(run).state == "pruned"
