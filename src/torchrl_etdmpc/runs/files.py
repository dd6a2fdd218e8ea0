"""Files that are there whole or not at all, checked when they are read: the only place that writes such files."""

from __future__ import annotations

import errno
import hashlib
import io
import os
import re
import secrets
import shutil
import stat
import tempfile
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import torch

from torchrl_etdmpc.runs.machine import machine_memory


class DamagedFileError(RuntimeError):
    """A file that is missing or is not what was written."""


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Gives a temporary path beside ``path`` and moves it into place, on disk, if the block succeeds.

    The temporary name is nobody else's, also of those that share the folder from other threads or machines. It keeps
    the suffix (programs that write films choose their format by it).

    Raises:
        OSError: if it cannot be written; it names ``path``.

    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp()) / "notes.txt"
    >>> with replacing(path) as partial:
    ...     _ = partial.write_text("whole")
    >>> path.read_text()
    'whole'
    """
    partial = path.with_name(f".{path.stem}.{secrets.token_hex(4)}.partial{path.suffix}")
    try:
        yield partial
        sync(partial)
        os.replace(partial, path)
        sync(path.parent)
    except OSError as error:
        if error.errno is not None and str(error.filename) in ("None", str(partial)):  # a write's error names no file
            error.filename = str(path)
        raise
    finally:
        partial.unlink(missing_ok=True)


def write_whole(path: Path, content: bytes | bytearray | memoryview | str) -> None:
    """Writes a file that survives a power cut or is not there."""
    with replacing(path) as partial:
        partial.write_bytes(content.encode() if isinstance(content, str) else content)


@contextmanager
def file_lock(lock: Path) -> Iterator[None]:
    """Locks a file for a block that reads, changes and writes another one; processes that want the same lock wait.

    The locked file stays there, empty. Nobody waits where there are no system locks.

    >>> with file_lock(Path(tempfile.mkdtemp()) / ".lock"):
    ...     pass
    """
    try:
        import fcntl
    except ImportError:  # Windows
        yield
        return
    with open(lock, "ab") as file:
        with suppress(OSError):  # a file system without locks
            fcntl.lockf(file, fcntl.LOCK_EX)
        yield


def make_folder(folder: Path) -> None:
    """Makes a folder, or says before any work is done that nothing can be written there.

    Raises:
        ValueError: if it cannot.
    """
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"{folder} is a file; name a folder.")
    _require_writable(folder, folder)


def make_folder_of(file: Path) -> None:
    """Makes the folder of a file to be written, or says before any work is done that it cannot be.

    Raises:
        ValueError: if it cannot.
    """
    if file.is_dir():
        raise ValueError(f"{file} is a folder; name a file.")
    _require_writable(file.parent, file)


def _require_writable(folder: Path, target: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):  # the one way to know, for every user and file system
            pass
    except OSError as error:
        raise ValueError(f"{target} cannot be written ({error.strerror}); choose another path.") from error


def read_whole(path: Path, limit: int | None = None) -> bytes:
    """Reads a regular file.

    Args:
        path (Path): a link is followed; a pipe or a device, which might never end, is refused.
        limit (int, optional): bytes that it may have, at most a quarter of this machine's memory. Default: that.

    Raises:
        DamagedFileError: if it is missing, is something else than a file or is larger.
    """
    most = (machine_memory() or 2**34) // 4
    limit = most if limit is None else min(limit, most)
    try:
        descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0))  # a pipe without a writer would wait
        try:
            status = os.fstat(descriptor)
            if not stat.S_ISREG(status.st_mode):
                raise DamagedFileError(f"{path} is not a regular file.")
            if status.st_size > limit:
                raise DamagedFileError(f"{path} has {status.st_size:,} bytes; at most {limit:,} are read.")
            with open(descriptor, "rb", closefd=False) as file:
                return file.read()
        finally:
            os.close(descriptor)
    except OSError as error:
        raise DamagedFileError(f"{path} cannot be read ({error.strerror}).") from error


def pack_tensors(content: Any) -> bytes:
    """Tensors and plain containers as the content of a file."""
    memory = io.BytesIO()  # torch.save itself answers a full disk with an error that does not say so
    torch.save(content, memory)
    return memory.getvalue()


def write_tensors(path: Path, content: Any) -> dict[str, Any]:
    """Writes tensors and plain containers with :func:`write_whole`.

    Returns:
        dict: its ``size`` in bytes and its ``sha256``, without which :func:`read_tensors` reads nothing.
    """
    data = pack_tensors(content)
    write_whole(path, data)
    return {"size": len(data), "sha256": hashlib.sha256(data).hexdigest()}


def require_readable(content: Any, name: str) -> None:
    """Raises a TypeError that names the entry which :func:`load_tensors` would refuse: of NumPy, or of a class.

    >>> require_readable({"steps": 3, "weights": torch.zeros(2)}, "the state")
    """
    try:
        load_tensors(pack_tensors(content), Path(name))
    except DamagedFileError:
        inner = content.items() if isinstance(content, dict) else ()
        inner = enumerate(content) if isinstance(content, list | tuple) else inner
        for key, value in inner:
            require_readable(value, f"{name}[{key!r}]")
        raise TypeError(
            f"{name} is of type {type(content).__module__}.{type(content).__qualname__}; a checkpoint holds tensors, "
            "numbers, texts and plain containers only, so convert it."
        ) from None


def read_tensors(path: Path, stamp: Mapping[str, Any]) -> Any:
    """Reads a file of :func:`write_tensors` without running any code in it.

    Args:
        path (Path): the file.
        stamp (mapping): what :func:`write_tensors` returned.

    Raises:
        DamagedFileError: if it is missing, has changed or holds something else.
    """
    data = read_whole(path, stamp["size"])
    if hashlib.sha256(data).hexdigest() != stamp["sha256"]:
        raise DamagedFileError(f"{path} is not the file that was written: it is cut off or damaged.")
    return load_tensors(data, path)


def load_tensors(data: bytes, path: Path) -> Any:
    """The tensors and plain containers in the content of a file of ``torch.save``; no code in it is run.

    Raises:
        DamagedFileError: if it is not such a file, is damaged or holds something else.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            compressed = sum(entry.file_size for entry in archive.infolist()) > len(data)
            damaged = None if compressed else archive.testzip()  # which unpacks everything
    except (zipfile.BadZipFile, NotImplementedError, RuntimeError, ValueError, EOFError) as error:
        raise DamagedFileError(f"{path} is not a file of torch.save: cut off, damaged or another kind.") from error
    if compressed:
        raise DamagedFileError(f"{path} is compressed, which no file of torch.save is; it was not loaded.")
    if damaged is not None:
        raise DamagedFileError(f"{path} is damaged: the checksum of {damaged} in it is wrong.")
    try:
        return torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
    except Exception as error:  # the errors of hostile files advise to run their code
        raise DamagedFileError(f"{path} holds more than tensors and plain containers; it was not loaded.") from error


def link(source: Path, target: Path) -> None:
    """Makes ``target`` the same file as ``source``, or a copy where the file system has no links."""
    with replacing(target) as partial:
        try:
            os.link(source, partial)
        except OSError:
            shutil.copyfile(source, partial)


def sync(path: Path) -> None:
    """Waits until a file, or the names in a folder, are on disk; for folders some systems know no such thing."""
    try:
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.EACCES) or not path.is_dir():
            raise


def remove_partial_files(folder: Path) -> None:
    """Removes what killed processes left of :func:`replacing`."""
    for file in folder.glob(".*.partial*"):
        if file.is_file():
            file.unlink(missing_ok=True)


def load_yaml(text: str) -> Any:
    """What a file of settings says: numbers, texts, lists and mappings.

    Raises:
        yaml.YAMLError: if it is not YAML.
        ValueError: if it refers to itself: few bytes can mean gigabytes.

    >>> load_yaml("{seed: 1, optim: {lr: 0.001}}")
    {'seed': 1, 'optim': {'lr': 0.001}}
    """
    import yaml

    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # ten times as fast, where it is there
    if re.search(r"\\uDC[89A-F]", text):  # a folder whose name is not UTF-8, which libyaml does not read
        loader = yaml.SafeLoader
    if any(isinstance(event, yaml.AliasEvent) for event in yaml.parse(text, loader)):
        raise ValueError("it refers to itself")
    return yaml.load(text, loader)
