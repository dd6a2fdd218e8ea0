from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import pickle
import stat
import sys
import zipfile
from concurrent.futures import ThreadPoolExecutor
from itertools import count
from pathlib import Path

import pytest
import torch

from torchrl_etdmpc.runs import DamagedFileError
from torchrl_etdmpc.runs.files import (
    file_lock,
    link,
    load_tensors,
    make_folder,
    pack_tensors,
    read_tensors,
    read_whole,
    remove_partial_files,
    replacing,
    require_readable,
    write_tensors,
    write_whole,
)

OLD, NEW = b"old " * 1000, b"new " * 3000


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def test_a_file_is_replaced_by_what_was_written(tmp_path):
    path = tmp_path / "notes.txt"
    for content in ("first", b"\x00second", "dritte Zeile \N{LATIN SMALL LETTER A WITH DIAERESIS}\n"):
        data = content.encode() if isinstance(content, str) else content
        write_whole(path, content)
        assert path.read_bytes() == data
        assert names(tmp_path) == {"notes.txt"}


def test_a_block_that_fails_leaves_the_file_as_it_was(tmp_path):
    path = tmp_path / "notes.txt"
    path.write_bytes(OLD)
    with pytest.raises(ZeroDivisionError), replacing(path) as partial:
        partial.write_bytes(NEW)
        _ = 1 / 0
    assert path.read_bytes() == OLD
    assert names(tmp_path) == {"notes.txt"}


def test_the_temporary_name_lies_beside_the_file_keeps_its_suffix_and_is_hidden(tmp_path):
    with replacing(tmp_path / "film.mp4") as partial:
        assert (partial.parent, partial.suffix, partial.name[0]) == (tmp_path, ".mp4", ".")
        partial.write_bytes(NEW)
    assert names(tmp_path) == {"film.mp4"}


def test_the_content_is_on_disk_before_the_name_is_and_then_the_name(tmp_path, monkeypatch):
    path, events = tmp_path / "notes.txt", []
    fsync, replace = os.fsync, os.replace

    def synced(descriptor: int) -> None:
        events.append(("sync", os.fstat(descriptor).st_ino))
        fsync(descriptor)

    def replaced(source: Path, target: Path) -> None:
        events.append(("replace", Path(source).stat().st_ino))
        replace(source, target)

    monkeypatch.setattr(os, "fsync", synced)
    monkeypatch.setattr(os, "replace", replaced)
    write_whole(path, NEW)
    file, folder = path.stat().st_ino, tmp_path.stat().st_ino
    assert events == [("sync", file), ("replace", file), ("sync", folder)]


@pytest.mark.parametrize("number", [errno.EINVAL, errno.EACCES, errno.EIO])
def test_a_file_system_that_cannot_sync_folders_does_without(tmp_path, monkeypatch, number):
    fsync = os.fsync

    def refused(descriptor: int) -> None:
        if stat.S_ISDIR(os.fstat(descriptor).st_mode):
            raise OSError(number, os.strerror(number))
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", refused)
    if number != errno.EIO:
        write_whole(tmp_path / "notes.txt", NEW)
    else:  # a disk that fails
        with pytest.raises(OSError, match="Input/output error"):
            write_whole(tmp_path / "notes.txt", NEW)
    assert names(tmp_path) == {"notes.txt"}


def test_a_file_that_cannot_be_synced_is_not_taken_for_written(tmp_path, monkeypatch):
    def refused(descriptor: int) -> None:
        raise OSError(errno.EINVAL, os.strerror(errno.EINVAL))

    monkeypatch.setattr(os, "fsync", refused)
    with pytest.raises(OSError, match="Invalid argument"):
        write_whole(tmp_path / "notes.txt", NEW)
    assert names(tmp_path) == set()


WRITERS = {
    "write_whole": lambda path: write_whole(path, NEW),
    "write_tensors": lambda path: write_tensors(path, {"x": torch.arange(5000)}),
    "link": lambda path: link(path.with_name("source"), path),
}


@pytest.mark.parametrize("writer", WRITERS)
def test_a_process_that_is_killed_at_any_moment_leaves_the_old_file_or_the_new_one(tmp_path, killed_at, writer):
    path, seen = tmp_path / "file", []
    (tmp_path / "source").write_bytes(NEW)
    write = WRITERS[writer]
    write(path)
    new = path.read_bytes()
    for moment in count(1):
        path.unlink()
        path.write_bytes(OLD)
        killed = killed_at(lambda: write(path), moment)
        assert path.read_bytes() in (OLD, new)
        seen.append(path.read_bytes() == new)
        if not killed:
            break
    assert len(seen) >= 4  # making, writing, syncing and moving it
    assert seen == sorted(seen) and seen[-1] and not seen[0]
    assert len(names(tmp_path)) > 2  # those that were killed had no time to clean up
    remove_partial_files(tmp_path)
    assert names(tmp_path) == {"file", "source"}


def test_partial_files_go_and_other_hidden_files_and_folders_stay(tmp_path):
    for name in (".a.7.partial.pt", ".film.12.partial.mp4", ".notes.3.partial", ".lock", "partial.pt"):
        (tmp_path / name).write_bytes(OLD)
    (tmp_path / ".0001.partial").mkdir()
    remove_partial_files(tmp_path)
    assert names(tmp_path) == {".lock", "partial.pt", ".0001.partial"}


def test_threads_that_write_one_file_leave_what_one_of_them_wrote(tmp_path):
    path, contents = tmp_path / "file", [letter * 100_000 for letter in ("a", "b", "c")]

    def write(content: str) -> None:
        for _ in range(20):
            write_whole(path, content)

    with ThreadPoolExecutor() as pool:
        assert list(pool.map(write, contents)) == [None, None, None]  # and no error
    assert path.read_text() in contents
    assert names(tmp_path) == {"file"}


def test_processes_change_a_file_one_after_the_other(tmp_path, in_copy):
    file, lock = tmp_path / "count", tmp_path / ".lock"
    file.write_text("0")

    def count_on() -> None:
        for _ in range(50):
            with file_lock(lock):
                write_whole(file, str(int(file.read_text()) + 1))

    def beside_a_copy() -> None:
        child = os.fork()
        count_on()
        if child == 0:
            os._exit(0)
        os.waitpid(child, 0)

    assert in_copy(beside_a_copy) == 0
    assert file.read_text() == "100"


@pytest.mark.parametrize("system", ["without locks of files", "without locks"])
def test_where_there_are_no_locks_nobody_waits(tmp_path, monkeypatch, system):
    def no_locks(*_):
        raise OSError(errno.ENOLCK, "No locks available")

    if system == "without locks":
        monkeypatch.setitem(sys.modules, "fcntl", None)
    else:
        monkeypatch.setattr(pytest.importorskip("fcntl"), "lockf", no_locks)
    entered = []
    with file_lock(tmp_path / ".lock"):
        entered.append(True)
    assert entered == [True]


def open_below(folder: Path) -> list[str]:
    """The files of this process that are open, in the folder or the folder itself."""
    found = []
    for opened in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(OSError):  # of the listing itself
            found.append(os.readlink(opened))
    return [path for path in found if Path(path).is_relative_to(folder)]


@pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="asks which files are open")
def test_no_file_stays_open(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    write_whole(tmp_path / "file", NEW)
    with (tmp_path / "file").open():
        assert open_below(tmp_path) == [str(tmp_path / "file")]
    assert read_whole(tmp_path / "file") == NEW
    for path in (tmp_path / "pipe", tmp_path):
        with pytest.raises(DamagedFileError, match="is not a regular file"):
            read_whole(path)
    assert open_below(tmp_path) == []


def test_a_folder_in_the_place_of_which_a_file_lies_is_refused(tmp_path):
    (tmp_path / "notes").write_bytes(OLD)
    with pytest.raises(ValueError, match=r"notes is a file; name a folder\.$"):
        make_folder(tmp_path / "notes")


def test_tensors_come_back_and_the_checksum_is_the_file_s(tmp_path):
    content = {"x": torch.randn(3, 4), "n": 3, "list": [torch.arange(2), "text", None], "nested": {"y": 1.5}}
    stamp, data = write_tensors(tmp_path / "a.pt", content), (tmp_path / "a.pt").read_bytes()
    assert stamp == {"size": len(data), "sha256": hashlib.sha256(data).hexdigest()}
    read = read_tensors(tmp_path / "a.pt", stamp)
    assert torch.equal(read.pop("x"), content.pop("x"))
    assert torch.equal(read["list"].pop(0), content["list"].pop(0))
    assert read == content


def test_a_file_that_is_missing_or_not_what_was_written_is_named(tmp_path):
    path = tmp_path / "a.pt"
    stamp = write_tensors(path, {"x": torch.arange(100)})
    data = path.read_bytes()
    flipped = bytearray(data)
    flipped[len(data) // 2] ^= 1
    for damaged in (data[:-1], data[: len(data) // 2], b"", bytes(flipped), data + b"x"):
        path.write_bytes(damaged)
        with pytest.raises(DamagedFileError, match=r"a\.pt (is not the file that was written|has 2,\d+ bytes)"):
            read_tensors(path, stamp)
    path.unlink()
    with pytest.raises(DamagedFileError, match=r"a\.pt cannot be read \(No such file or directory\)\.$"):
        read_tensors(path, stamp)


class Hostile:
    def __reduce__(self):
        return os.system, ("touch hostile_code_ran",)


@pytest.mark.parametrize("kind", ["torch.save", "pickle", "noise"])
def test_a_file_that_holds_anything_else_is_refused_even_if_its_checksum_is_right(tmp_path, monkeypatch, kind):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "a.pt"
    if kind == "torch.save":
        stamp = write_tensors(path, {"rows": Hostile()})
    else:
        data = pickle.dumps(Hostile()) if kind == "pickle" else b"noise"
        write_whole(path, data)
        stamp = {"size": len(data), "sha256": hashlib.sha256(data).hexdigest()}
    what = "holds more than tensors and plain containers; it was" if kind == "torch.save" else "is not a file of torch"
    with pytest.raises(DamagedFileError, match=what):
        read_tensors(path, stamp)
    assert names(tmp_path) == {"a.pt"}


def test_a_file_that_unpacks_to_more_than_it_has_is_not_unpacked(tmp_path):
    path = tmp_path / "a.pt"
    torch.save({"x": torch.zeros(100_000)}, tmp_path / "plain.pt")
    with zipfile.ZipFile(tmp_path / "plain.pt") as plain, zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as packed:
        for entry in plain.infolist():
            packed.writestr(entry.filename, plain.read(entry))
    data = path.read_bytes()
    assert len(data) < 10_000
    with pytest.raises(
        DamagedFileError, match=r"a\.pt is compressed, which no file of torch\.save is; it was not loaded"
    ):
        load_tensors(data, path)


def test_a_damaged_tensor_in_a_file_without_a_stamp_is_found_by_its_own_checksum(tmp_path):
    content = torch.arange(1000)
    data = bytearray(pack_tensors({"x": content}))
    data[data.index(content.numpy().tobytes()) + 80] ^= 1
    with pytest.raises(DamagedFileError, match=r"a\.pt is damaged: the checksum of .*data/0 in it is wrong\.$"):
        load_tensors(bytes(data), tmp_path / "a.pt")


def test_what_is_not_a_file_or_too_large_is_refused_before_it_is_read(tmp_path):
    pipe, large = tmp_path / "pipe", tmp_path / "large"
    os.mkfifo(pipe)
    with large.open("wb") as file:
        file.truncate(2**43)  # takes no space
    for path, what in (
        (pipe, "is not a regular file"),
        (Path("/dev/zero"), "is not a regular file"),
        (tmp_path, "is not a regular file"),
        (large, r"has 8,796,093,022,208 bytes; at most [\d,]+ are read"),
        (tmp_path / "none", "cannot be read \\(No such file or directory\\)"),
    ):
        with pytest.raises(DamagedFileError, match=f"^{path} {what}\\.$"):
            read_whole(path)
    large.write_bytes(OLD)
    assert read_whole(large, len(OLD)) == OLD
    with pytest.raises(DamagedFileError, match="has 4,000 bytes; at most 3,999 are read"):
        read_whole(large, len(OLD) - 1)


def test_no_more_is_read_than_a_quarter_of_the_memory_whatever_a_file_says_of_itself(tmp_path, monkeypatch):
    file = tmp_path / "large"
    file.write_bytes(bytes(20))
    monkeypatch.setattr(os, "sysconf", lambda name: 8)  # 8 pages of 8 bytes
    for limit in (None, 100):
        with pytest.raises(DamagedFileError, match="has 20 bytes; at most 16 are read"):
            read_whole(file, limit)


@pytest.mark.parametrize("kind", [list, tuple])
def test_the_entry_that_no_file_may_hold_is_named_also_within_a_list(kind):
    with pytest.raises(TypeError, match=r"^the state\['parts'\]\[1\] is of type builtins.object"):
        require_readable({"parts": kind([1, object()])}, "the state")


def test_a_link_is_the_same_file_and_replaces_an_old_one(tmp_path):
    source, target = tmp_path / "source", tmp_path / "target"
    source.write_bytes(NEW)
    target.write_bytes(OLD)
    link(source, target)
    assert os.path.samefile(source, target)
    write_whole(source, OLD)  # which makes a new file, so the link keeps the content that it was made for
    assert target.read_bytes() == NEW


def test_a_link_is_a_copy_where_the_file_system_has_none(tmp_path, monkeypatch):
    def no_links(*_):
        raise OSError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(os, "link", no_links)
    source, target = tmp_path / "source", tmp_path / "target"
    source.write_bytes(NEW)
    target.write_bytes(OLD)
    link(source, target)
    assert target.read_bytes() == NEW
    assert not os.path.samefile(source, target)
    assert names(tmp_path) == {"source", "target"}


def test_a_full_disk_leaves_the_old_file_whole_whatever_space_is_left(small_disk, leave_free):
    content = {"x": torch.arange(15_000)}  # 120 KB
    path, taken = small_disk / "file.pt", []
    before = {"x": torch.arange(10)}
    for free in range(0, 200 * 1024, 4096):
        leave_free(small_disk, None)
        stamp = write_tensors(path, before)
        leave_free(small_disk, free)
        try:
            new = write_tensors(path, content)
        except OSError as error:
            assert error.errno == errno.ENOSPC
            torch.testing.assert_close(read_tensors(path, stamp), before)
        else:
            torch.testing.assert_close(read_tensors(path, new), content)
            taken.append(free)
        assert names(small_disk) == {"file.pt", "ballast"}
    assert taken and taken[0] > 120_000  # less would not hold the new one
    assert taken == list(range(taken[0], 200 * 1024, 4096))


def test_a_file_that_cannot_be_written_is_named(small_disk, leave_free):
    leave_free(small_disk, 0)
    for path, reason in (
        (small_disk / "notes.txt", "No space left on device"),
        (small_disk / "missing" / "notes.txt", "No such file or directory"),
    ):
        with pytest.raises(OSError, match=rf"{reason}: '{path}'$"):
            write_whole(path, "notes")


def test_a_file_system_without_room_for_a_copy_of_a_link_says_so(small_disk, leave_free, monkeypatch):
    def no_links(*_):
        raise OSError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(os, "link", no_links)
    source, target = small_disk / "source", small_disk / "target"
    source.write_bytes(bytes(100_000))
    target.write_bytes(OLD)
    leave_free(small_disk, 8192)
    with pytest.raises(OSError, match="No space left on device"):
        link(source, target)
    assert target.read_bytes() == OLD
    assert names(small_disk) == {"source", "target", "ballast"}
