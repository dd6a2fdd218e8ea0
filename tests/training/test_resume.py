from __future__ import annotations

import csv
import json
import os
import re
import shutil
import signal
import subprocess
import warnings
from collections.abc import Callable
from itertools import count
from pathlib import Path
from typing import Any

import pytest
import torch
from torch.utils._pytree import tree_map_only
from torchrl.checkpoint import GlobalRNGState

pytest.importorskip("dm_control")

from torchrl_etdmpc.checkpoints import CheckpointError, CheckpointStore  # noqa: E402
from torchrl_etdmpc.collectors import StepCollector  # noqa: E402
from torchrl_etdmpc.runs import RunDirectory  # noqa: E402
from torchrl_etdmpc.training import (  # noqa: E402
    RunInterrupted,
    TrainConfig,
    TrainingRun,
    build_replay,
    load_agent,
    read_agent_file,
    read_run_config,
    resumed_config,
)

SETTINGS: dict[str, Any] = {
    "task": "cartpole-swingup",
    "total_env_steps": 140,
    "eval_every": 60,
    "eval_episodes": 2,
    "checkpoint_every": 50,
    "log_every": 20,
    "replay": {"seed_decisions": 24, "seed_hold": 3.0},
}


@pytest.fixture
def small_config(tiny_config) -> Callable[..., TrainConfig]:
    """Three episodes and a half; checkpoints, rows and evaluations at different steps."""

    def make(**changes: Any) -> TrainConfig:
        return tiny_config(**SETTINGS | changes | {"replay": SETTINGS["replay"] | changes.get("replay", {})})

    return make


def results(run: TrainingRun, run_dir: Path) -> dict[str, Any]:
    """Everything that must not depend on interruptions, as comparable values."""

    def rows(name: str) -> list[dict[str, str]]:
        with (run_dir / name).open(newline="") as file:
            return [{key: value for key, value in row.items() if key != "wall_time_s"} for row in csv.DictReader(file)]

    stored = run.learner.replay.storage[:]
    summary = json.loads((run_dir / "summary.json").read_text())
    return {
        "train.csv": rows("train.csv"),
        "eval.csv": rows("eval.csv"),
        "summary": {key: summary[key] for key in ("env_steps", "final_return", "best_return")},
        "weights": {name: value.tolist() for name, value in run.learner.agent.loss.state_dict().items()},
        "updater": tree_map_only(torch.Tensor, torch.Tensor.tolist, run.learner.agent.updater.state_dict()),
        "replay": {str(key): stored.get(key).tolist() for key in stored.keys(True, True)},
        "generations": run.learner.replay.writer.generations_of(torch.arange(len(run.learner.replay))).tolist(),
        "random": torch.rand(3).tolist(),
    }


def stop_at(run: TrainingRun, owner: Any, method: str, call: int) -> None:
    """As if the signal came during the given call of a method."""
    original, calls = getattr(owner, method), [0]

    def watched(*args: Any, **kwargs: Any) -> Any:
        calls[0] += 1
        if calls[0] == call:
            run.stop.requested = True
        return original(*args, **kwargs)

    setattr(owner, method, watched)


@pytest.fixture(scope="module")
def straight(tmp_path_factory, make_run) -> Callable[[TrainConfig], dict[str, Any]]:
    """The results of a run without interruptions, one per configuration."""
    known: dict[str, dict[str, Any]] = {}

    def run(config: TrainConfig) -> dict[str, Any]:
        key = str(config)
        if key not in known:
            run_dir = tmp_path_factory.mktemp("straight")
            run = make_run(config, run_dir)
            run.run()
            known[key] = results(run, run_dir)
        return known[key]

    return run


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
def test_a_run_that_was_stopped_anywhere_ends_as_if_it_had_not_been(tmp_path, straight, place, small_config, make_run):
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


@pytest.mark.parametrize(
    "changes",
    [
        {"num_envs": 3, "total_env_steps": 200},
        {"replay": {"insertion": "episode"}, "episode_length": 40},
        {"replay": {"capacity": 30}},
        pytest.param({"reanalyze": {"every": 0}}, marks=pytest.mark.slow),
        {"overlap": True},
        {"optim": {"average_decay": 0.9, "lr_halved_after": 7}, "model": {"normalize_observations": True}},
        {"loss": {"value_replayed": 0.5, "value_expectile": 0.7}, "model": {"normalize_observations": True}},
        pytest.param({"planner": {"first_action": "mean"}, "eval_policy": True}, marks=pytest.mark.slow),
    ],
)
def test_every_kind_of_run_can_be_stopped_many_times(tmp_path, straight, changes, small_config, make_run):
    config = small_config(**changes)
    run = make_run(config, tmp_path)
    for call in (9, 4, 3, 7, 1):
        stop_at(run, run.learner.collector, "act", call)
        with pytest.raises(RunInterrupted):
            run.run()
        run.log.directory.close()
        run = make_run(config, tmp_path, resume=True)
    run.run()
    assert results(run, tmp_path) == straight(config)


def test_a_run_that_was_killed_forgets_what_came_after_its_checkpoint(tmp_path, straight, small_config, make_run):
    config = small_config()

    class Killed(BaseException):
        pass

    def die() -> None:
        raise Killed

    run = make_run(config, tmp_path)
    original = run.learner.collector.act
    calls = iter([original] * 62 + [lambda *_: die()])
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
    short = small_config(total_env_steps=100)
    run = make_run(short, tmp_path)
    run.run()
    stored = read_run_config(RunDirectory(tmp_path))
    longer = resumed_config(stored, small_config(total_env_steps=140), ["total_env_steps"])
    resumed = make_run(longer, tmp_path, resume=True)
    assert resumed.run()["env_steps"] == 140
    assert read_run_config(RunDirectory(tmp_path)).total_env_steps == 140
    assert len(resumed.learner.replay) == 70
    again = make_run(longer, tmp_path, resume=True)
    assert (again.learner.replay[:] == resumed.learner.replay[:]).all()  # targets too


def test_other_settings_must_stay(tmp_path, small_config):
    saved = small_config()
    asked = small_config(planner={"horizon": 3}, threads=2)
    assert resumed_config(saved, asked, ["threads"]).threads == 2
    assert resumed_config(saved, asked, []).planner.horizon == 2
    with pytest.raises(ValueError, match=r"^planner.horizon=3 was asked for, but this run was started with "):
        resumed_config(saved, asked, ["planner.horizon"])


@pytest.fixture(scope="module")
def finished(tmp_path_factory, tiny_config, make_run) -> Path:
    """The directory of a run that came to its end; tests damage a copy."""
    run_dir = tmp_path_factory.mktemp("finished")
    run = make_run(tiny_config(**SETTINGS), run_dir)
    run.run()
    run.log.directory.close()
    return run_dir


def rows_of_the_newest(checkpoints: Path) -> Path:
    """A file of the buffer that only the newest checkpoint needs."""
    before, after = (
        json.loads((checkpoints / "resume" / f"{steps:012d}" / "manifest.json").read_text())["replay"]["rows"]
        for steps in (100, 140)
    )
    return checkpoints / "replay" / next(entry["file"] for entry in after if entry not in before)


@pytest.mark.parametrize("damaged", ["agent.pt", "collector.pt", "state.pt", "manifest.json", "replay"])
@pytest.mark.parametrize("how", ["missing", "cut off", "a flipped bit"])
def test_a_damaged_checkpoint_is_passed_over_for_the_one_before(
    tmp_path, finished, straight, damaged, how, small_config, make_run
):
    run_dir = shutil.copytree(finished, tmp_path / "run")
    checkpoints = run_dir / "checkpoints"
    newest = checkpoints / "resume" / f"{140:012d}"
    file = rows_of_the_newest(checkpoints) if damaged == "replay" else newest / damaged
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 255
    {
        "missing": file.unlink,
        "cut off": lambda: file.write_bytes(data[: len(data) // 2]),
        "a flipped bit": lambda: file.write_bytes(data),
    }[how]()
    with pytest.warns(UserWarning, match=r"^going on from .*/000000000100, because "):
        resumed = make_run(small_config(), run_dir, resume=True)
    assert (resumed.env_steps, len(resumed.learner.replay)) == (100, 50)
    if how == "cut off":  # to the end, once for every kind of file
        (run_dir / "summary.json").unlink()
        resumed.run()
        assert results(resumed, run_dir) == straight(small_config())


def test_without_any_checkpoint_the_error_says_so(tmp_path, small_config, make_run):
    config = small_config()
    directory = RunDirectory(tmp_path)
    directory.begin(config.to_dict())
    directory.close()
    with pytest.raises(CheckpointError, match=r"^cannot resume: there is no checkpoint under .*checkpoints\.$"):
        make_run(config, tmp_path, resume=True)


def test_a_run_that_an_earlier_version_saved_is_refused_and_keeps_its_weights(
    tmp_path, finished, small_config, make_run
):
    run_dir = shutil.copytree(finished, tmp_path / "run")
    for file in run_dir.glob("checkpoints/resume/*/manifest.json"):
        file.write_text(json.dumps(json.loads(file.read_text()) | {"format": 2}))
    with pytest.raises(CheckpointError) as caught:
        make_run(small_config(), run_dir, resume=True)
    agents = [run_dir / "checkpoints" / name for name in ("last.pt", "best.pt")]
    assert re.match(r"cannot resume: .*/000000000140 has checkpoint format 2; this version r", str(caught.value))
    left = f" Start a new run; the agents of this one can still be evaluated: {agents[0]}, {agents[1]}."
    assert str(caught.value).endswith(left)
    _, _, counters = load_agent(agents[0])
    assert counters["env_steps"] == 140
    agents[0].write_bytes(agents[0].read_bytes()[:-100])
    with pytest.raises(CheckpointError, match=rf"can still be evaluated: {agents[1]}\.$"):
        make_run(small_config(), run_dir, resume=True)


def test_a_run_does_what_its_saved_state_says_is_due(tmp_path, small_config, make_run, read_table):
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


class Refusing:
    """A part that cannot be saved while it is told so."""

    refuses = False

    def state_dict(self) -> dict[str, Any]:
        if self.refuses:
            raise OSError(28, "No space left on device")
        return {}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        pass


def test_a_save_that_failed_half_way_leaves_nothing_out_of_the_next_one(tmp_path, small_config, make_run):
    # The buffer is written first: the next save must write those rows again, for their files are gone.
    run = make_run(small_config(), tmp_path)
    part = Refusing()
    run.parts["late"] = part
    for save in (True, False, True):
        for _ in range(8):
            run.learner.step()
        part.refuses = not save
        if save:
            assert run.checkpoints.save()
        else:
            with pytest.warns(UserWarning, match=r"no checkpoint at 32 env steps \(No space left on device\)"):
                assert not run.checkpoints.save()
    run.log.directory.close()
    resumed = make_run(small_config(), tmp_path, resume=True)  # in which any warning is an error
    assert resumed.env_steps == 48
    expected, actual = (one.learner.replay[:] for one in (run, resumed))
    assert (expected == actual).all()


def test_a_run_goes_on_where_there_are_fewer_gpus(tmp_path, monkeypatch, small_config, make_run):
    plain = GlobalRNGState.state_dict
    device = torch.cuda.get_rng_state() if torch.cuda.is_available() else torch.zeros(16, dtype=torch.uint8)
    monkeypatch.setattr(GlobalRNGState, "state_dict", lambda self: plain(self) | {"torch_cuda": 99 * [device]})
    make_run(small_config(), tmp_path / "run").run()
    with pytest.warns(UserWarning, match=r"saved on a machine with 99 GPUs, here are \d+: it goes on with "):
        resumed = make_run(small_config(total_env_steps=180), tmp_path / "run", resume=True)
    assert resumed.run()["env_steps"] == 180


def fill(disk: Path) -> None:
    with (disk / "ballast").open("wb", buffering=0) as file:
        for size in (2**20, 2**12, 1):
            try:
                while True:
                    file.write(os.urandom(size))
            except OSError:
                continue


def test_a_full_disk_costs_checkpoints_and_nothing_else(small_disk, straight, small_config, make_run):
    config = small_config(checkpoint_every=30)
    run_dir = small_disk / "run"
    run = make_run(config, run_dir)
    step, calls = run.learner.collector.act, [0]

    def watched(*args: Any) -> Any:
        calls[0] += 1
        if calls[0] == 40:
            fill(small_disk)
        if calls[0] == 65:
            (small_disk / "ballast").unlink()
        return step(*args)

    run.learner.collector.act = watched
    with pytest.warns(UserWarning) as warned:
        run.run()
    texts = [str(warning.message) for warning in warned]
    for steps in (90, 120):
        assert f"no checkpoint at {steps} env steps (No space left on device); training goes on." in texts
    assert results(run, run_dir) == straight(config)
    (run_dir / "summary.json").unlink()
    assert make_run(config, run_dir, resume=True).env_steps == 140


def test_a_run_that_dies_on_a_full_disk_goes_on_from_its_last_checkpoint(small_disk, straight, small_config, make_run):
    config = small_config(checkpoint_every=30)
    run_dir = small_disk / "run"
    run = make_run(config, run_dir)
    step, calls = run.learner.collector.act, [0]

    class Killed(BaseException):
        pass

    def watched(*args: Any) -> Any:
        calls[0] += 1
        if calls[0] == 40:
            fill(small_disk)
        if calls[0] == 55:
            raise Killed
        return step(*args)

    run.learner.collector.act = watched
    with pytest.warns(UserWarning, match="no checkpoint at 90 env steps"), pytest.raises(Killed):
        run.run()
    run.log.directory.close()
    (small_disk / "ballast").unlink()
    resumed = make_run(config, run_dir, resume=True)
    assert resumed.env_steps == 60
    resumed.run()
    assert results(resumed, run_dir) == straight(config)


def test_a_run_whose_end_cannot_be_saved_is_not_finished(small_disk, straight, small_config, make_run):
    config = small_config(checkpoint_every=30)
    run_dir = small_disk / "run"
    run = make_run(config, run_dir)
    step, calls = run.learner.collector.act, [0]

    def watched(*args: Any) -> Any:
        calls[0] += 1
        if calls[0] == 50:
            fill(small_disk)
        return step(*args)

    run.learner.collector.act = watched
    expected = r"^run_dir=.* made its 140 env steps, but the end could not be saved \(No space left on device\), so "
    with pytest.warns(UserWarning), pytest.raises(OSError, match=expected):
        run.run()
    assert not run.log.directory.finished
    run.log.directory.close()
    (small_disk / "ballast").unlink()
    resumed = make_run(config, run_dir, resume=True)
    assert resumed.env_steps == 90
    resumed.run()
    assert results(resumed, run_dir) == straight(config)


def test_the_best_agent_is_the_uninterrupted_run_s(tmp_path, finished, small_config, make_run):
    """Killed between the evaluation that wrote it and the next checkpoint, and its file lost."""
    config = small_config(checkpoint_every=1000)
    run = make_run(config, tmp_path)
    calls = count(1)

    def die(*_: Any) -> None:
        if next(calls) == 40:
            raise KeyboardInterrupt

    act = run.learner.collector.act
    run.learner.collector.act = lambda: (die(), act())[1]
    with pytest.raises(KeyboardInterrupt):
        run.run()
    run.log.directory.close()
    assert (tmp_path / "checkpoints" / "best.pt").exists()
    run = make_run(config, tmp_path, resume=True)
    assert run.env_steps == 0
    run.run()
    content = [read_agent_file(path / "checkpoints" / "best.pt") for path in (finished, tmp_path)]
    assert content[0]["counters"]["updates"] == content[1]["counters"]["updates"]
    for name, value in content[0]["loss"].items():
        assert torch.equal(value, content[1]["loss"][name])
    (tmp_path / "checkpoints" / "best.pt").unlink()
    make_run(config, tmp_path, resume=True)
    assert torch.equal(read_agent_file(tmp_path / "checkpoints" / "best.pt")["loss"][name], value)


def test_a_damaged_buffer_can_be_gone_on_with_on_request(tmp_path, finished, small_config, make_run):
    run_dir = shutil.copytree(finished, tmp_path / "run")
    (run_dir / "summary.json").unlink()
    manifest = json.loads((run_dir / "checkpoints" / "resume" / f"{140:012d}" / "manifest.json").read_text())["replay"]
    oldest = run_dir / "checkpoints" / "replay" / manifest["rows"][0]["file"]
    data = bytearray(oldest.read_bytes())
    data[len(data) // 2] ^= 1
    oldest.write_bytes(data)
    advice = r" is not the file that was written: .*\. resume=weights goes on with the weights and what "
    with pytest.raises(CheckpointError, match=advice):
        make_run(small_config(), run_dir, resume=True)
    config = small_config(resume="weights", total_env_steps=160)
    with pytest.warns(UserWarning, match=r"140 with its weights and 45 of 70 rows of its buffer; .*damaged\.$"):
        run = make_run(config, run_dir, resume=True)
    content = read_agent_file(run_dir / "checkpoints" / "last.pt")
    assert all(torch.equal(value, content["loss"][name]) for name, value in run.learner.agent.loss.state_dict().items())
    assert (run.env_steps, len(run.learner.replay)) == (140, 45)
    run.run()
    assert (run.env_steps, len(run.learner.replay)) == (160, 55)
    stored = run.learner.replay[:]
    assert stored["collector", "traj_ids"][44] < stored["collector", "traj_ids"][45]  # a fresh episode
    run.log.directory.close()
    resumed = make_run(config, run_dir, resume=True)  # and whole again
    assert (stored == resumed.learner.replay[:]).all()


def test_too_little_of_a_buffer_is_refused(tmp_path, finished, small_config, make_run):
    run_dir = shutil.copytree(finished, tmp_path / "run")
    for file in (run_dir / "checkpoints" / "replay").glob("rows*"):
        file.write_bytes(b"")
    with (
        pytest.warns(UserWarning, match="and 0 of 70 rows"),
        pytest.raises(CheckpointError, match=r"^cannot resume: 0 rows of the buffer are left, fewer than the 24 "),
    ):
        make_run(small_config(resume="weights"), run_dir, resume=True)


def test_a_run_that_is_asked_to_stop_on_a_full_disk_says_that_it_is_not_saved(small_disk, small_config, make_run):
    run = make_run(small_config(), small_disk / "run")
    stop_at(run, run.learner.collector, "act", 30)
    fill(small_disk)
    expected = r"^stopped at \d+ env steps and not saved: the checkpoint before it stays in "
    with pytest.warns(UserWarning) as warned, pytest.raises(RunInterrupted, match=expected):
        run.run()
    assert "no checkpoint at 60 env steps (No space left on device)" in str(warned[-1].message)


def test_a_read_only_run_directory_is_refused_and_goes_on_when_it_can_be_written(
    small_disk, straight, small_config, make_run
):
    config = small_config()
    run_dir = small_disk / "run"
    run = make_run(config, run_dir)
    stop_at(run, run.learner.collector, "act", 40)
    with pytest.raises(RunInterrupted):
        run.run()
    run.log.directory.close()
    subprocess.run(["mount", "-o", "remount,ro", str(small_disk)], check=True)
    for begin in (lambda: make_run(config, run_dir, resume=True), lambda: make_run(config, small_disk / "new")):
        with pytest.raises(
            OSError, match=r"^run_dir=.* cannot be written \(Read-only file system\); choose a directory"
        ):
            begin()
    subprocess.run(["mount", "-o", "remount,rw", str(small_disk)], check=True)
    resumed = make_run(config, run_dir, resume=True)
    resumed.run()
    assert results(resumed, run_dir) == straight(config)


def test_a_process_that_is_killed_at_any_moment_of_a_save_leaves_a_checkpoint_that_works(
    tmp_path, small_config, make_run
):
    config = small_config()
    run = make_run(config, tmp_path)
    for _ in range(30):
        run.learner.step()
    run.checkpoints.save()
    for _ in range(10):
        run.learner.step()
    outcomes, other = [], make_run(config, tmp_path / "other")  # takes every state in turn
    for moment in count(1):
        killed = killed_while_saving(run, moment)
        replay = build_replay(config)
        CheckpointStore(tmp_path / "checkpoints").load(other.parts, replay)
        outcomes.append((killed, other.env_steps))
        assert len(replay) == other.env_steps // 2
        if not killed:
            break
    assert outcomes[0] == (True, 60)
    assert outcomes[-1] == (False, 80)
    assert {steps for _, steps in outcomes} == {60, 80}
    assert sorted(steps for _, steps in outcomes) == [steps for _, steps in outcomes]
    run.checkpoints.save()  # and what the killed ones left behind goes
    checkpoints = tmp_path / "checkpoints"
    kept = [json.loads(file.read_text())["replay"] for file in checkpoints.glob("resume/*/manifest.json")]
    named = {entry["file"] for files in kept for part in ("rows", "targets") for entry in files[part]}
    assert {file.name for file in (checkpoints / "replay").iterdir()} == named
    assert sorted(path.name for path in (checkpoints / "resume").iterdir()) == [f"{steps:012d}" for steps in (60, 80)]


def test_saving_the_same_step_again_never_leaves_it_without_a_checkpoint(tmp_path, small_config, make_run):
    config = small_config()
    run = make_run(config, tmp_path)
    for _ in range(30):
        run.learner.step()
    run.checkpoints.save()
    for moment in count(1):
        killed = killed_while_saving(run, moment)
        store = CheckpointStore(tmp_path / "checkpoints")
        assert store.exists()
        assert store.load(run.parts, build_replay(config)).name == f"{60:012d}"
        if not killed:
            break
    assert moment > 10


def killed_while_saving(run: TrainingRun, moment: int) -> bool:
    """Saves in a copy of this process; whether it was killed before it was done."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of a fork beside PyTorch's threads
        child = os.fork()
    if child == 0:
        die_at(moment)
        run.checkpoints.save()
        os._exit(0)
    return os.WIFSIGNALED(os.waitpid(child, 0)[1])


def die_at(moment: int) -> None:
    """The process is killed when it is about to make its n-th change final."""
    calls = [0]

    def counted(function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any, **kwargs: Any) -> Any:
            calls[0] += 1
            if calls[0] == moment:
                os.kill(os.getpid(), signal.SIGKILL)
            return function(*args, **kwargs)

        return call

    os.fsync, os.replace, os.link = counted(os.fsync), counted(os.replace), counted(os.link)
