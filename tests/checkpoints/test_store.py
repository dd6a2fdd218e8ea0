from __future__ import annotations

import hashlib
import json
import os
from collections import defaultdict
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer, TensorDictRoundRobinWriter

from torchrl_etdmpc.checkpoints import CheckpointError, CheckpointStore, DamagedBufferError


class Counter:
    """A part that is not a module."""

    def __init__(self) -> None:
        self.number, self.history = 0, []

    def state_dict(self) -> dict[str, Any]:
        return {"number": self.number, "history": list(self.history)}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.number, self.history = state_dict["number"], list(state_dict["history"])


@pytest.mark.parametrize("key", ["plan", ("target", "mine")])
def test_targets_that_were_made_anew_come_back_wherever_they_are(tmp_path, key):
    def make() -> TensorDictReplayBuffer:
        writer = TensorDictRoundRobinWriter(track_generations=True)
        return TensorDictReplayBuffer(storage=LazyTensorStorage(30), writer=writer, batch_size=4)

    def target(value: float) -> TensorDict:
        fields = {name: torch.full((5, 1), value) for name in ("loc", "scale", "value")}
        return TensorDict(fields | {"version": torch.full((5, 1), int(value))}, [5])

    buffer, store = make(), CheckpointStore(tmp_path, plan_key=key)
    buffer.extend(TensorDict({"x": torch.randn(5, 3)}, [5]).set(key, target(0)))
    store.save(1, {}, buffer)
    rows = buffer.storage[:].clone().set(key, target(3))
    buffer.storage.set(torch.arange(5), rows, set_cursor=False)
    store.save(2, {}, buffer)
    other = make()
    CheckpointStore(tmp_path, plan_key=key).load({}, other)
    assert (other.storage[:] == buffer.storage[:]).all()


class Work:
    """Two parts and a buffer that change, as a run does."""

    def __init__(self) -> None:
        self.layer, self.counter = nn.Linear(8, 8), Counter()
        writer = TensorDictRoundRobinWriter(track_generations=True)
        self.buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(30), writer=writer, batch_size=4)

    @property
    def parts(self) -> dict[str, Any]:
        return {"layer": self.layer, "counter": self.counter}

    def do(self) -> Work:
        self.counter.number += 1
        self.counter.history.append(f"step {self.counter.number}")
        nn.init.constant_(self.layer.weight, self.counter.number)
        plan = {"loc": torch.randn(5, 2), "scale": torch.rand(5, 2), "value": torch.randn(5, 1)}
        plan["version"] = torch.full((5, 1), self.counter.number)
        self.buffer.extend(TensorDict({"x": torch.randn(5, 3), "plan": plan}, [5]))
        return self

    def state(self) -> str:
        """All of it, as a comparable value."""
        stored = self.buffer.storage[:].to_dict() if len(self.buffer) else {}
        writer = {name: torch.as_tensor(value).tolist() for name, value in self.buffer.writer.state_dict().items()}
        torch.set_printoptions(profile="full", precision=9)
        try:
            return repr((self.layer.state_dict(), self.counter.state_dict(), stored, writer))
        finally:
            torch.set_printoptions(profile="default")


@pytest.fixture
def store(tmp_path: Path) -> CheckpointStore:
    return CheckpointStore(tmp_path / "checkpoints")


def save(store: CheckpointStore, step: int, work: Work, **options: Any) -> str:
    """Returns the state that was saved."""
    links = {store.folder / "last.pt": "layer"}
    folder = store.save(step, work.parts, work.buffer, **{"links": links} | options)
    assert folder == store.folder / "resume" / f"{step:012d}"
    return work.state()


def load(folder: Path, **options: Any) -> tuple[str, str]:
    """As another process would: the name of the checkpoint and the state."""
    work = Work()
    return CheckpointStore(folder, **options).load(work.parts, work.buffer).name, work.state()


def tree(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def replay_files(folder: Path) -> set[str]:
    """Those that the kept checkpoints name."""
    manifests = [json.loads(path.read_text())["replay"] for path in folder.glob("resume/[0-9]*/manifest.json")]
    return {entry["file"] for files in manifests for part in ("rows", "targets") for entry in files[part]}


def replay_of(store: CheckpointStore, step: int) -> dict[str, Any]:
    """What the manifest of a checkpoint says of the buffer."""
    return json.loads((store.folder / "resume" / f"{step:012d}" / "manifest.json").read_text())["replay"]


def test_what_is_loaded_is_what_was_saved_last(store):
    work = Work()
    for step in (100, 200, 350):
        state = save(store, step, work.do())
        assert load(store.folder) == (f"{step:012d}", state)
    assert load(store.folder) == (f"{350:012d}", state)  # loading changes nothing


def test_a_run_that_goes_on_saves_what_is_new(store):
    save(store, 100, Work().do())
    work = Work()
    again = CheckpointStore(store.folder)
    again.load(work.parts, work.buffer)
    state = save(again, 200, work.do())
    assert load(store.folder) == (f"{200:012d}", state)


def test_a_checkpoint_holds_one_file_for_each_part_and_a_manifest(store):
    work = Work().do()
    save(store, 100, work)
    assert {path.name for path in (store.folder / "resume" / f"{100:012d}").iterdir()} == {
        "layer.pt",
        "counter.pt",
        "manifest.json",
    }
    assert {path.name for path in store.folder.iterdir()} == {"resume", "replay", "last.pt"}
    assert {path.name for path in (store.folder / "replay").iterdir()} == replay_files(store.folder)


@pytest.mark.parametrize(
    ("foreign", "named"),
    [
        (np.float64(3), r"\['history'\]\[1\]\['x'\] is of type numpy\.float64"),
        (np.random.get_state(), r"\['history'\]\[1\]\['x'\]\[1\] is of type numpy\.ndarray"),
        (Path("here"), rf"\['history'\]\[1\]\['x'\] is of type {type(Path()).__module__}\.PosixPath"),
        (defaultdict(list), r"\['history'\]\[1\]\['x'\] is of type collections\.defaultdict"),
    ],
)
def test_a_state_that_no_load_would_read_is_not_saved(store, foreign, named):
    work = Work().do()
    state = save(store, 100, work)
    work.counter.history = ["step 1", {"x": foreign}]
    with pytest.raises(TypeError, match=f"^the state of the part 'counter'{named}; a checkpoint holds tensors"):
        CheckpointStore(store.folder).save(200, work.parts, work.buffer)
    assert load(store.folder) == (f"{100:012d}", state)


def test_the_buffer_is_restored_first_and_then_the_parts_in_the_order_of_the_mapping(store):
    work = Work().do()
    save(store, 100, work)

    class Watched:
        def __init__(self, name: str) -> None:
            self.name = name

        def load_state_dict(self, state_dict: Any) -> None:
            events.append((self.name, len(buffer)))

    for order in (["layer", "counter"], ["counter", "layer"]):
        events, buffer = [], Work().buffer
        store.load({name: Watched(name) for name in order}, buffer)
        assert events == [(name, 5) for name in order]


def test_a_part_that_is_stored_and_not_asked_for_stays_in_the_file(store):
    work = Work().do()
    save(store, 100, work)
    other = Work()
    store.load({"counter": other.counter}, other.buffer)
    assert other.counter.number == 1


def test_a_part_that_is_asked_for_and_not_stored_is_named_and_changes_nothing(store):
    save(store, 100, Work().do())
    work = Work()
    before = work.state()
    with pytest.raises(CheckpointError) as caught:
        store.load({**work.parts, "random": Counter()}, work.buffer)
    assert str(caught.value) == f"cannot resume: {store.folder}/resume/{100:012d} lacks random."
    assert work.state() == before


def test_there_must_be_a_checkpoint(store):
    assert not store.exists()
    with pytest.raises(CheckpointError) as caught:
        store.load(Work().parts, Work().buffer)
    assert str(caught.value) == f"cannot resume: there is no checkpoint under {store.folder}."
    assert not store.folder.exists()
    save(store, 100, Work().do())
    assert store.exists()


@pytest.mark.parametrize("keep", [1, 2, 3])
def test_so_many_checkpoints_are_kept_with_the_replay_files_that_they_need(tmp_path, keep):
    store, work, states = CheckpointStore(tmp_path, keep=keep), Work(), {}
    for step in (1, 5, 20, 100):
        states[f"{step:012d}"] = save(store, step, work.do())
    names = sorted(path.name for path in (tmp_path / "resume").iterdir())
    assert names == sorted(states)[-keep:]
    assert {path.name for path in (tmp_path / "replay").iterdir()} == replay_files(tmp_path)
    for name in reversed(names):
        assert load(tmp_path) == (name, states[name])
        if name != names[0]:
            os.rename(tmp_path / "resume" / name, tmp_path / name)


def test_of_a_checkpoint_whose_manifest_cannot_be_read_the_buffer_s_files_stay(store):
    work = Work()
    state = save(store, 100, work.do())
    manifest = store.folder / "resume" / f"{100:012d}" / "manifest.json"
    content = manifest.read_text()
    manifest.write_text(content[:-1])
    work.buffer.empty()  # so that no file of its rows is shared with what comes
    save(store, 200, work.do())
    manifest.write_text(content)
    (store.folder / "resume" / f"{200:012d}").rename(store.folder / "200")
    assert load(store.folder) == (f"{100:012d}", state)


def test_fewer_than_one_cannot_be_kept(tmp_path):
    with pytest.raises(ValueError, match=r"^keep must be at least 1, got 0\.$"):
        CheckpointStore(tmp_path, keep=0)


def test_links_are_the_part_s_file_and_stay_when_the_checkpoint_goes(tmp_path):
    store, work = CheckpointStore(tmp_path, keep=1), Work()
    best = tmp_path / "best.pt"
    save(store, 100, work.do(), links={tmp_path / "last.pt": "layer", best: "layer"})
    assert os.path.samefile(best, tmp_path / "resume" / f"{100:012d}" / "layer.pt")
    save(store, 200, work.do())
    assert os.path.samefile(tmp_path / "last.pt", tmp_path / "resume" / f"{200:012d}" / "layer.pt")
    assert not (tmp_path / "resume" / f"{100:012d}").exists()
    assert (torch.load(best, weights_only=True)["weight"] == 1).all()


def test_links_are_there_before_the_checkpoint_is(store, monkeypatch):
    replaced, replace = [], os.replace

    def watched(source: Path, target: Path) -> None:
        replaced.append(Path(target).name)
        replace(source, target)

    monkeypatch.setattr(os, "replace", watched)
    save(store, 100, Work().do())
    assert replaced[-2:] == ["last.pt", f"{100:012d}"]


def test_the_name_of_a_checkpoint_is_on_disk_before_those_it_replaces_go(tmp_path, monkeypatch):
    store, work, synced = CheckpointStore(tmp_path, keep=1), Work(), []
    save(store, 100, work.do())
    monkeypatch.setattr("torchrl_etdmpc.checkpoints.store.sync", lambda folder: synced.append(set(os.listdir(folder))))
    save(store, 200, work.do())
    assert synced == [{f"{100:012d}", f"{200:012d}"}]


def test_the_same_step_again_replaces_its_checkpoint(store):
    work = Work()
    save(store, 100, work.do())
    states = [save(store, 200, work.do()) for _ in range(3)]
    assert load(store.folder) == (f"{200:012d}", states[-1])
    assert sorted(path.name for path in (store.folder / "resume").iterdir()) == [f"{100:012d}", f"{200:012d}"]
    assert {path.name for path in (store.folder / "replay").iterdir()} == replay_files(store.folder)


def damage(path: Path, how: str) -> None:
    data = bytearray(path.read_bytes())
    if how == "missing":
        path.unlink()
    elif how == "cut off":
        path.write_bytes(data[: len(data) // 2])
    elif how == "empty":
        path.write_bytes(b"")
    else:
        data[len(data) // 2] ^= 1
        path.write_bytes(data)


@pytest.mark.parametrize("how", ["missing", "cut off", "empty", "a flipped bit"])
@pytest.mark.parametrize("kind", ["layer.pt", "counter.pt", "manifest.json", "rows", "targets"])
def test_a_damaged_checkpoint_is_passed_over_for_the_one_before(store, kind, how):
    work = Work()
    first = save(store, 100, work.do())
    before = replay_files(store.folder)
    save(store, 200, work.do())
    if kind in ("rows", "targets"):
        (name,) = (name for name in replay_files(store.folder) - before if name.startswith(kind))
        file = store.folder / "replay" / name
    else:
        file = store.folder / "resume" / f"{200:012d}" / kind
    damage(file, how)
    with pytest.warns(UserWarning, match=rf"^going on from .*/{100:012d}, because .*{file.name}"):
        assert load(store.folder) == (f"{100:012d}", first)


def test_every_checkpoint_that_is_passed_over_is_told(tmp_path):
    store, work = CheckpointStore(tmp_path, keep=3), Work()
    for step in (100, 200, 300):
        save(store, step, work.do())
    damaged = [tmp_path / "resume" / f"{step:012d}" / "manifest.json" for step in (300, 200)]
    for file in damaged:
        file.unlink()
    with pytest.warns(UserWarning) as told:
        assert load(tmp_path)[0] == f"{100:012d}"
    assert [str(warning.message).partition(", because ")[2] for warning in told] == [
        f"{file} is missing or damaged." for file in damaged
    ]


def test_any_flipped_bit_of_a_manifest_is_noticed(store):
    work = Work()
    first = save(store, 100, work.do())
    save(store, 200, work.do())
    file = store.folder / "resume" / f"{200:012d}" / "manifest.json"
    whole = file.read_bytes()
    for place in range(0, len(whole), 11):
        data = bytearray(whole)
        data[place] ^= 1 << place % 8
        file.write_bytes(data)
        with pytest.warns(UserWarning, match=rf"^going on from .*/{100:012d}, because .*/{200:012d}"):
            assert load(store.folder) == (f"{100:012d}", first)
    file.write_bytes(whole)
    assert load(store.folder)[0] == f"{200:012d}"


def test_when_all_are_damaged_the_error_names_every_fault_and_nothing_is_changed(store):
    work = Work()
    save(store, 100, work.do())
    save(store, 200, work.do())
    for step, file in ((100, "layer.pt"), (200, "counter.pt")):
        damage(store.folder / "resume" / f"{step:012d}" / file, "missing")
    before, other = tree(store.folder), Work()
    state = other.state()
    with pytest.raises(CheckpointError, match=r"^cannot resume: .*counter\.pt cannot be read .*; .*layer\.pt cannot"):
        CheckpointStore(store.folder).load(other.parts, other.buffer)
    assert (tree(store.folder), other.state()) == (before, state)


@pytest.mark.parametrize("keep", [1, 2])
def test_a_run_that_went_on_from_an_older_checkpoint_keeps_what_it_saves_then(tmp_path, keep):
    """The damaged ones have higher steps, and would be taken for the newest."""
    store, work = CheckpointStore(tmp_path, keep=3), Work()
    for step in (100, 200, 300):
        save(store, step, work.do())
    for step in (200, 300):
        damage(tmp_path / "resume" / f"{step:012d}" / "layer.pt", "cut off")
    again, other = CheckpointStore(tmp_path, keep=keep), Work()
    with pytest.warns(UserWarning, match="because "):
        again.load(other.parts, other.buffer)
    state = save(again, 150, other.do())
    assert load(tmp_path) == (f"{150:012d}", state)
    assert {path.name for path in (tmp_path / "replay").iterdir()} == replay_files(tmp_path)


@pytest.mark.parametrize("number", [1, 3, 5])
def test_another_format_is_refused_in_one_line(store, number):
    save(store, 100, Work().do())
    file = store.folder / "resume" / f"{100:012d}" / "manifest.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"format": number}))
    with pytest.raises(CheckpointError) as caught:
        load(store.folder)
    expected = f"cannot resume: {file.parent} has checkpoint format {number}; this version resumes from 4."
    assert str(caught.value) == expected


def test_a_buffer_of_another_size_is_refused(store):
    work = Work()
    for _ in range(8):
        work.do()
    save(store, 100, work)
    smaller = TensorDictReplayBuffer(storage=LazyTensorStorage(20))
    with pytest.raises(ValueError, match="the saved buffer has capacity 30 and 40 rows were written to it"):
        store.load(work.parts, smaller)


class BrokenError(Exception):
    pass


@pytest.mark.parametrize("failing", ["state_dict", "os.fsync", "os.replace"])
def test_a_save_that_fails_leaves_nothing_and_the_next_one_writes_everything(store, monkeypatch, failing):
    """The journal must forget the rows of the failed save: their files are gone with it."""
    work = Work()
    first = save(store, 100, work.do())
    before = tree(store.folder)
    work.do()

    def fail(*_: Any) -> None:
        raise BrokenError

    with monkeypatch.context() as patch:
        if failing == "state_dict":
            patch.setattr(work.counter, "state_dict", fail)
        else:
            function, left = getattr(os, failing.removeprefix("os.")), [4]

            def fourth(*arguments: Any) -> Any:
                left[0] -= 1
                return function(*arguments) if left[0] else fail()

            patch.setattr(os, failing.removeprefix("os."), fourth)
        with pytest.raises(BrokenError):
            save(store, 200, work)
    assert tree(store.folder) == before
    assert load(store.folder) == (f"{100:012d}", first)
    state = save(store, 200, work.do())
    assert load(store.folder) == (f"{200:012d}", state)


def test_a_full_disk_leaves_the_checkpoint_before_it_whatever_space_is_left(small_disk, leave_free):
    store, work = CheckpointStore(small_disk / "checkpoints"), Work()
    first = save(store, 100, work.do())
    before = tree(store.folder)
    work.do()
    for free in count(0, 4096):
        leave_free(small_disk, free)
        try:
            state = save(store, 200, work)
            break
        except OSError as error:
            assert error.strerror == "No space left on device"
        assert tree(store.folder) == before
        assert load(store.folder) == (f"{100:012d}", first)
    assert free >= 5 * 4096  # rows, targets, two parts and the manifest take a page each
    assert load(store.folder) == (f"{200:012d}", state)


def test_a_process_that_is_killed_at_any_moment_of_a_save_leaves_a_checkpoint_that_works(tmp_path, killed_at):
    store, work = CheckpointStore(tmp_path, keep=1), Work()
    save(store, 100, work.do())
    states = {f"{200:012d}": save(store, 200, work.do()), f"{300:012d}": work.do().state()}
    weights, found = [], []
    for moment in count(1):
        killed = killed_at(lambda: save(store, 300, work), moment)
        name, state = load(tmp_path)
        assert state == states[name]
        found.append(name)
        weights.append(int(torch.load(tmp_path / "last.pt", weights_only=True)["weight"][0, 0]))
        if not killed:
            break
    assert len(found) > 40
    assert found[0] == f"{200:012d}" and found[-1] == f"{300:012d}" and found == sorted(found)
    assert weights[0] == 2 and weights[-1] == 3 and weights == sorted(weights)
    save(store, 300, work)  # and what the killed ones left behind goes
    assert [path.name for path in (tmp_path / "resume").iterdir()] == [f"{300:012d}"]
    assert {path.name for path in (tmp_path / "replay").iterdir()} == replay_files(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"resume", "replay", "last.pt"}


def test_saving_the_same_step_again_never_leaves_it_without_a_checkpoint(store, killed_at):
    work = Work()
    old = save(store, 100, work.do())
    new = work.do().state()
    for moment in count(1):
        killed = killed_at(lambda: save(store, 100, work), moment)
        assert CheckpointStore(store.folder).exists()
        name, state = load(store.folder)
        assert name == f"{100:012d}" and state in (old, new)
        if not killed:
            break
    assert state == new


def test_looking_for_a_checkpoint_changes_nothing(store):
    """Another process may be saving here."""
    save(store, 100, Work().do())
    (resume,) = (store.folder / "resume").iterdir()
    resume.rename(resume.with_name(f".{resume.name}.old"))
    before = tree(store.folder)
    assert CheckpointStore(store.folder).exists()
    assert tree(store.folder) == before
    assert load(store.folder)[0] == f"{100:012d}"  # it was moved aside for one that never came


def test_weights_and_what_is_left_of_the_buffer_are_restored_on_request(store):
    work = Work()
    for step in range(1, 6):  # five rows each
        save(store, step, work.do())
    damage(store.folder / "replay" / replay_of(store, 5)["rows"][1]["file"], "a flipped bit")
    with pytest.raises(DamagedBufferError, match="is not the file that was written"):
        load(store.folder)
    again = Work()
    other = CheckpointStore(store.folder)
    with pytest.warns(
        UserWarning, match=r"/000000000005 with its weights and 15 of 25 rows of its buf.*; .*damaged\.$"
    ):
        other.salvage(again.parts, again.buffer)
    assert (again.counter.number, again.layer.weight[0, 0].item()) == (5, 5)
    wanted = work.buffer[10:25]
    for key in ("x", ("plan", "loc"), ("plan", "scale"), ("plan", "value"), ("plan", "version")):
        assert torch.equal(again.buffer[:][key], wanted[key])
    expected = save(other, 6, again.do())  # and goes on from there
    assert load(store.folder) == (f"{6:012d}", expected)
    assert len(again.buffer) == 20


def test_of_a_ring_that_has_wrapped_the_longest_stretch_is_left(store):
    work = Work()
    for step in range(1, 10):  # 45 rows into 30 places
        save(store, step, work.do())
    assert [entry["begin"] for entry in replay_of(store, 9)["rows"]] == [15, 20, 25, 30, 35, 40]
    file = next(entry["file"] for entry in replay_of(store, 9)["rows"] if entry["begin"] == 35)
    damage(store.folder / "replay" / file, "a flipped bit")
    again = Work()
    with pytest.warns(UserWarning, match="20 of 30 rows"):
        CheckpointStore(store.folder).salvage(again.parts, again.buffer)
    wanted = work.buffer.storage[:][torch.arange(15, 35) % 30]
    assert torch.equal(again.buffer[:]["x"], wanted["x"])
    assert torch.equal(again.buffer[:]["plan", "value"], wanted["plan", "value"])


def test_rows_whose_targets_are_lost_are_left_out(store):
    work = Work()
    for step in range(1, 4):
        save(store, step, work.do())
    file = next(entry["file"] for entry in replay_of(store, 3)["targets"] if entry["part"] == 0)
    damage(store.folder / "replay" / file, "a flipped bit")
    again = Work()
    with pytest.warns(UserWarning, match="5 of 15 rows"):
        CheckpointStore(store.folder).salvage(again.parts, again.buffer)
    assert torch.equal(again.buffer[:]["x"], work.buffer[10:15]["x"])


def test_where_the_newest_weights_are_damaged_those_before_are_salvaged(store):
    work = Work()
    for step in (1, 2):
        save(store, step, work.do())
    damage(store.folder / "resume" / f"{2:012d}" / "layer.pt", "a flipped bit")
    again = Work()
    with pytest.warns(UserWarning, match=r"/000000000001 with its weights and 5 of 5 rows .*2/layer\.pt"):
        CheckpointStore(store.folder).salvage(again.parts, again.buffer)
    assert (again.counter.number, again.layer.weight[0, 0].item()) == (1, 1)
    assert torch.equal(again.buffer[:]["x"], work.buffer[:5]["x"])


def test_parts_that_are_damaged_everywhere_cannot_be_salvaged(store):
    save(store, 1, Work().do())
    damage(store.folder / "resume" / f"{1:012d}" / "layer.pt", "a flipped bit")
    again = Work()
    with pytest.raises(CheckpointError, match="^cannot resume: .*layer.pt is not the file that was written"):
        CheckpointStore(store.folder).salvage(again.parts, again.buffer)
    assert len(again.buffer) == 0


def test_a_file_name_that_leads_outside_is_not_followed(store, tmp_path):
    save(store, 1, Work().do())
    file = store.folder / "resume" / f"{1:012d}" / "manifest.json"
    manifest = json.loads(file.read_text())
    entry = manifest["replay"]["rows"][0]
    victim = tmp_path / "victim.pt"
    victim.write_bytes((store.folder / "replay" / entry["file"]).read_bytes())
    entry["file"] = "../../victim.pt"
    manifest.pop("sha256")
    text = json.dumps(manifest, sort_keys=True)
    file.write_text(json.dumps(manifest | {"sha256": hashlib.sha256(text.encode()).hexdigest()}))
    with pytest.raises(CheckpointError, match=r"replay has no file '../../victim\.pt': that is not a name\.$"):
        load(store.folder)
    save(store, 2, Work().do())
    assert victim.exists()


def test_a_part_that_does_not_fit_is_named(store):
    save(store, 1, Work().do())
    other = Work()
    with pytest.raises(CheckpointError, match=r"/000000000001/layer\.pt does not fit this run: Error\(s\) in loading"):
        store.load({"layer": nn.Linear(3, 3)}, other.buffer)


@pytest.mark.parametrize("error", [RuntimeError, ValueError, KeyError, TypeError, AttributeError])
def test_whatever_a_part_makes_of_a_state_of_another_kind_is_one_line(store, error):
    work = Work().do()
    save(store, 1, work)

    class Other(Counter):
        def load_state_dict(self, state_dict: dict[str, Any]) -> None:
            raise error("another kind")

    with pytest.raises(CheckpointError, match=r"/000000000001/counter\.pt does not fit this run: .*another kind'?$"):
        store.load({"counter": Other()}, work.buffer)


@pytest.mark.parametrize("content", ["[]", "3", "{}", '{"format": 4}', "[" * 100_000, "not JSON", ""])
def test_a_manifest_that_is_none_is_passed_over_for_the_one_before(store, content):
    work = Work()
    first = save(store, 100, work.do())
    save(store, 200, work.do())
    (store.folder / "resume" / f"{200:012d}" / "manifest.json").write_text(content)
    with pytest.warns(UserWarning, match=rf"/{200:012d}/manifest.json is missing or damaged\.$"):
        assert load(store.folder) == (f"{100:012d}", first)


def test_a_folder_that_is_no_checkpoint_is_of_no_step(store):
    save(store, 100, Work().do())
    (store.folder / "resume" / "2 notes").mkdir()
    assert store.newest_step() == 100


def test_single_rows_are_read_from_the_file_that_holds_them(tmp_path, monkeypatch):
    work, store = Work(), CheckpointStore(tmp_path)
    assert store.buffer_rows() == 0
    with pytest.raises(CheckpointError, match="there is no checkpoint under"):
        store.read_row(0)
    for step in range(1, 10):  # 45 rows into a buffer of 30: the oldest 15 are lost
        store.save(step, work.do().parts, work.buffer)
    assert store.buffer_rows() == 30
    stored = work.buffer[:]["x"]
    opened = []
    read = store.journal._read
    monkeypatch.setattr(store.journal, "_read", lambda entry: opened.append(entry["file"]) or read(entry))
    for row in (0, 5, 13, 29):  # 5: the first of a file
        position = (15 + row) % 30
        assert torch.equal(store.read_row(row)["x"], stored[position])
    assert len(opened) == 4
    with pytest.raises(IndexError, match=r"row must be in \[0, 30\), the rows of the saved buffer, got 30"):
        store.read_row(30)
    for file in (tmp_path / "replay").glob("rows-*"):
        file.write_bytes(b"")
    with pytest.raises(CheckpointError, match="is not the file that was written"):
        store.read_row(3)
