"""Checkpoints that are damaged or lost, and disks that take no more: what a run says, and how it goes on."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import time
from collections.abc import Callable
from itertools import count
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

pytest.importorskip("dm_control")

from torchrl_etdmpc.checkpoints import CheckpointError, DamagedBufferError  # noqa: E402
from torchrl_etdmpc.runs import RunDirectory  # noqa: E402
from torchrl_etdmpc.training import (  # noqa: E402
    RunInterrupted,
    TrainingRun,
    load_agent,
    read_agent_file,
)
from torchrl_etdmpc.training.run_checkpoints import RunCheckpoints  # noqa: E402


def rows_of_the_newest(checkpoints: Path) -> Path:
    """A file of the buffer that only the newest checkpoint needs."""
    before, after = (
        json.loads((checkpoints / "resume" / f"{steps:012d}" / "manifest.json").read_text())["replay"]["rows"]
        for steps in (100, 110)
    )
    return checkpoints / "replay" / next(entry["file"] for entry in after if entry not in before)


@pytest.mark.parametrize("damaged", ["state.pt", "replay"])  # of every kind: tests/checkpoints/test_store.py
def test_a_damaged_checkpoint_is_passed_over_for_the_one_before(
    tmp_path, finished, straight, damaged, small_config, make_run, results
):
    run_dir = shutil.copytree(finished, tmp_path / "run")
    checkpoints = run_dir / "checkpoints"
    newest = checkpoints / "resume" / f"{110:012d}"
    file = rows_of_the_newest(checkpoints) if damaged == "replay" else newest / damaged
    file.write_bytes(file.read_bytes()[:-1])
    with pytest.warns(UserWarning, match=r"^going on from .*/000000000100, because "):
        resumed = make_run(small_config(), run_dir, resume=True)
    assert (resumed.env_steps, len(resumed.learner.replay)) == (100, 50)
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
    assert re.match(r"cannot resume: .*/000000000110 has checkpoint format 2; this version r", str(caught.value))
    left = f" Start a new run; the agents of this one can still be evaluated: {agents[0]}, {agents[1]}."
    assert str(caught.value).endswith(left)
    _, _, counters = load_agent(agents[0])
    assert counters["env_steps"] == 110
    agents[0].write_bytes(agents[0].read_bytes()[:-100])
    with pytest.raises(CheckpointError, match=rf"can still be evaluated: {agents[1]}\.$"):
        make_run(small_config(), run_dir, resume=True)


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


def test_a_checkpoint_that_failed_is_tried_again_in_its_time(tmp_path, monkeypatch, small_config, make_run):
    clock = [0.0]
    monkeypatch.setattr(time, "perf_counter", lambda: clock[0])
    run = make_run(small_config(checkpoint_minutes=2.0), tmp_path)
    run.learner.step()
    run.parts["late"] = part = Refusing()
    part.refuses = True
    clock[0] = 121.0
    assert run.checkpoints.overdue
    with pytest.warns(UserWarning, match="^no checkpoint at 2 env steps"):
        assert not run.checkpoints.save()
    assert not run.checkpoints.overdue  # or every step would write it in vain
    clock[0] = 242.0
    assert run.checkpoints.overdue


def test_a_best_agent_that_the_disk_did_not_take_is_written_with_the_next_checkpoint(
    tmp_path, monkeypatch, small_config, make_run
):
    def fail(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    run = make_run(small_config(), tmp_path)
    with monkeypatch.context() as patched:
        patched.setattr("torchrl_etdmpc.training.agent_file.write_whole", fail)
        with pytest.warns(UserWarning, match=r"best\.pt cannot be written \(No space left on device\)"):
            run.best.note(5.0)
    run.learner.step()
    assert run.checkpoints.save()
    assert read_agent_file(run.best.path)["counters"]["env_steps"] == 0


def test_a_run_that_cannot_be_saved_at_all_ends_before_anything_is_lost(tmp_path, small_config, make_run):
    run = make_run(small_config(), tmp_path)
    part = run.parts["late"] = Refusing()
    part.refuses = True
    expected = f"no checkpoint can be written into {run.checkpoints.store.folder} (No space left on device); make "
    with pytest.raises(OSError, match=f"^{re.escape(expected)}room, or choose another run_dir.$"):
        run.run()
    assert run.env_steps == 0


def fill(disk: Path) -> None:
    with (disk / "ballast").open("wb", buffering=0) as file:
        for size in (2**20, 2**12, 1):
            try:
                while True:
                    file.write(os.urandom(size))
            except OSError:
                continue


class Killed(BaseException):
    pass


def kill() -> None:
    raise Killed


def at_decisions(run: TrainingRun, happens: dict[int, Callable[[], None]]) -> None:
    """Calls a function before the decision of that number."""
    act, calls = run.learner.collector.act, count(1)

    def watched(*args: Any) -> Any:
        happens.get(next(calls), lambda: None)()
        return act(*args)

    run.learner.collector.act = watched


def test_a_full_disk_costs_checkpoints_and_nothing_else(small_disk, straight, small_config, make_run, results):
    config = small_config(checkpoint_every=30)
    run_dir = small_disk / "run"
    run = make_run(config, run_dir)
    at_decisions(run, {25: lambda: fill(small_disk), 50: (small_disk / "ballast").unlink})
    with pytest.warns(UserWarning) as warned:
        run.run()
    texts = [str(warning.message) for warning in warned]
    for steps in (60, 90):
        assert f"no checkpoint at {steps} env steps (No space left on device); training goes on." in texts
    assert results(run, run_dir) == straight(config)
    (run_dir / "summary.json").unlink()
    assert make_run(config, run_dir, resume=True).env_steps == 110


def test_a_run_that_dies_on_a_full_disk_goes_on_from_its_last_checkpoint(
    small_disk, straight, small_config, make_run, results
):
    config = small_config(checkpoint_every=30)
    run_dir = small_disk / "run"
    run = make_run(config, run_dir)
    at_decisions(run, {40: lambda: fill(small_disk), 53: kill})
    with pytest.warns(UserWarning, match="no checkpoint at 90 env steps"), pytest.raises(Killed):
        run.run()
    run.log.directory.close()
    (small_disk / "ballast").unlink()
    resumed = make_run(config, run_dir, resume=True)
    assert resumed.env_steps == 60
    resumed.run()
    assert results(resumed, run_dir) == straight(config)


def test_a_run_whose_end_cannot_be_saved_is_not_finished(small_disk, straight, small_config, make_run, results):
    config = small_config(checkpoint_every=30)
    run_dir = small_disk / "run"
    run = make_run(config, run_dir)
    at_decisions(run, {50: lambda: fill(small_disk)})
    expected = r"^run_dir=.* made its 110 env steps, but the end could not be saved \(No space left on device\), so "
    with pytest.warns(UserWarning), pytest.raises(OSError, match=expected):
        run.run()
    assert not run.log.directory.finished
    run.log.directory.close()
    (small_disk / "ballast").unlink()
    resumed = make_run(config, run_dir, resume=True)
    assert resumed.env_steps == 90
    resumed.run()
    assert results(resumed, run_dir) == straight(config)


def test_a_run_whose_last_checkpoint_cannot_be_written_is_not_finished(tmp_path, small_config, make_run):
    run = make_run(small_config(total_env_steps=52), tmp_path)
    part = run.parts["late"] = Refusing()
    at_decisions(run, {26: lambda: setattr(part, "refuses", True)})  # there is room for the tables and the summary
    with (
        pytest.warns(UserWarning, match="^no checkpoint at 52 env steps"),
        pytest.raises(OSError, match="made its 52 env steps, but the end could not be saved"),
    ):
        run.run()
    assert not run.log.directory.finished


def test_a_damaged_buffer_can_be_gone_on_with_on_request(tmp_path, finished, small_config, make_run):
    run_dir = shutil.copytree(finished, tmp_path / "run")
    (run_dir / "summary.json").unlink()
    manifest = json.loads((run_dir / "checkpoints" / "resume" / f"{110:012d}" / "manifest.json").read_text())["replay"]
    oldest = run_dir / "checkpoints" / "replay" / manifest["rows"][0]["file"]
    data = bytearray(oldest.read_bytes())
    data[len(data) // 2] ^= 1
    oldest.write_bytes(data)
    advice = r" is not the file that was written: .*\. resume=weights goes on with the weights and what "
    with pytest.raises(CheckpointError, match=advice):
        make_run(small_config(), run_dir, resume=True)
    config = small_config(resume="weights", total_env_steps=130)
    with pytest.warns(UserWarning, match=r"110 with its weights and 30 of 55 rows of its buffer; .*damaged\.$"):
        run = make_run(config, run_dir, resume=True)
    content = read_agent_file(run_dir / "checkpoints" / "last.pt")
    assert all(torch.equal(value, content["loss"][name]) for name, value in run.learner.agent.loss.state_dict().items())
    assert (run.env_steps, len(run.learner.replay)) == (110, 30)
    run.run()
    assert (run.env_steps, len(run.learner.replay)) == (130, 40)
    stored = run.learner.replay[:]
    assert stored["collector", "traj_ids"][29] < stored["collector", "traj_ids"][30]  # a fresh episode
    run.log.directory.close()
    resumed = make_run(config, run_dir, resume=True)  # and whole again
    assert (stored == resumed.learner.replay[:]).all()


def test_too_little_of_a_buffer_is_refused(tmp_path, finished, small_config, make_run):
    run_dir = shutil.copytree(finished, tmp_path / "run")
    for file in (run_dir / "checkpoints" / "replay").glob("rows*"):
        file.write_bytes(b"")
    with (
        pytest.warns(UserWarning, match="and 0 of 55 rows"),
        pytest.raises(CheckpointError, match=r"^cannot resume: 0 rows of the buffer are left, fewer than the 24 "),
    ):
        make_run(small_config(resume="weights"), run_dir, resume=True)


def restored(tmp_path: Path, config: Any, rows: int, frames: int) -> list[int]:
    """The seeds that a collector which begins fresh gets where a run goes on with so many rows and decisions."""

    class Store:
        def load(self, parts: Any, replay: Any) -> Path:
            if config.resume == "weights":
                raise DamagedBufferError("the buffer is damaged.")
            return tmp_path

        def salvage(self, parts: Any, replay: Any) -> Path:
            assert list(parts) == ["agent"]  # the sampler follows the rows that are left
            return tmp_path

    seeds: list[int] = []
    collector = SimpleNamespace(begins_fresh=config.resume != "weights", frames=frames, set_seed=seeds.append)
    learner = SimpleNamespace(replay=range(rows), env_steps=2 * frames, collector=collector)
    parts = dict.fromkeys(("agent", "sampler"))
    checkpoints = RunCheckpoints(config, RunDirectory(tmp_path), learner, None, parts)
    checkpoints.store = Store()
    checkpoints.restore()
    return seeds


@pytest.mark.parametrize("resume", ["on", "weights"])
@pytest.mark.parametrize("seed", [3, 2**32 - 1])
def test_an_environment_that_begins_fresh_gets_a_seed_of_its_own_at_every_resume(tmp_path, small_config, resume, seed):
    config = small_config(resume=resume, seed=seed)
    (first,), (second,) = (restored(tmp_path, config, 70, frames) for frames in (50, 70))
    assert first != second
    assert not {first, second} & {seed, (seed + 10_000) % 2**32}  # the run's, and that of its evaluations
    assert all(0 <= one < 2**32 for one in (first, second))


@pytest.mark.parametrize(("rows", "frames", "fits"), [(24, 70, True), (23, 70, False), (10, 10, True), (9, 10, False)])
def test_a_run_goes_on_with_as_many_rows_as_learning_begins_with_or_all_that_it_had(
    tmp_path, small_config, rows, frames, fits
):
    config = small_config(resume="weights")
    if fits:
        assert restored(tmp_path, config, rows, frames)
        return
    with pytest.raises(CheckpointError, match=f"{rows} rows of the buffer are left, fewer than the {min(24, frames)} "):
        restored(tmp_path, config, rows, frames)


def test_a_run_that_is_asked_to_stop_on_a_full_disk_says_that_it_is_not_saved(
    small_disk, small_config, make_run, stop_at
):
    run = make_run(small_config(), small_disk / "run")
    stop_at(run, run.learner.collector, "act", 30)
    at_decisions(run, {20: lambda: fill(small_disk)})
    expected = r"^stopped at \d+ env steps and not saved: the checkpoint before it stays in "
    with pytest.warns(UserWarning) as warned, pytest.raises(RunInterrupted, match=expected):
        run.run()
    assert "no checkpoint at 60 env steps (No space left on device)" in str(warned[-1].message)


def test_a_read_only_run_directory_is_refused_and_goes_on_when_it_can_be_written(
    small_disk, straight, small_config, make_run, results, stop_at
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
