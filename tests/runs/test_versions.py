from __future__ import annotations

import importlib.metadata
import importlib.util
import json
import os
import platform
import shutil
import subprocess

import pytest
import torch

from torchrl_etdmpc.runs import library_versions, versions


def test_python_and_the_installed_core_are_named():
    found = library_versions()
    assert found["python"] == platform.python_version()
    assert found["torch"].split("+")[0] == torch.__version__.split("+")[0]
    assert {"torchrl", "tensordict"} <= set(found)


def test_a_package_that_is_not_installed_is_left_out(monkeypatch):
    monkeypatch.setattr(versions, "_PACKAGES", ("torch", "no-such-package"))
    assert library_versions() == {"python": platform.python_version(), "torch": importlib.metadata.version("torch")}


@pytest.mark.parametrize("name", ["torchrl-etdmpc", "torch", "torchrl", "tensordict", "dm-control", "mujoco"])
def test_the_version_of_everything_that_changes_numbers_is_there(name):
    try:
        installed = importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        pytest.skip(f"needs {name}")
    assert library_versions()[name] == installed


def git(folder, *arguments):
    line = ["git", "-C", str(folder), "-c", "user.name=A", "-c", "user.email=a@b", *arguments]
    return subprocess.run(line, check=True, capture_output=True, text=True).stdout.strip()


def copied_to(folder):
    """A copy of the module in a package's place below a folder."""
    path = folder / "torchrl_etdmpc" / "runs" / "versions.py"
    path.parent.mkdir(parents=True)
    shutil.copy(versions.__file__, path)
    spec = importlib.util.spec_from_file_location("copied_versions", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def repository(tmp_path, monkeypatch):
    for name in [name for name in os.environ if name.startswith("GIT_")]:
        monkeypatch.delenv(name)  # a hook that runs the tests names a repository of its own
    git(tmp_path, "init")
    module = copied_to(tmp_path / "src")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "-m", "first")
    return module


def test_the_commit_of_a_checkout_is_named(repository, tmp_path):
    assert repository.source_commit() == git(tmp_path, "rev-parse", "HEAD")
    (tmp_path / "results.csv").write_text("not of the package")
    assert repository.source_commit() == git(tmp_path, "rev-parse", "HEAD")


@pytest.mark.parametrize("name", ["runs/versions.py", "added.py"])
def test_a_checkout_whose_package_was_changed_is_dirty(repository, tmp_path, name):
    file = tmp_path / "src" / "torchrl_etdmpc" / name
    file.write_text(file.read_text() + "\n" if file.exists() else "")
    assert repository.source_commit() == git(tmp_path, "rev-parse", "HEAD") + "-dirty"


def test_the_repository_that_holds_an_installation_is_not_the_package_s(repository, tmp_path):
    assert copied_to(tmp_path / ".venv").source_commit() is None


def test_without_git_there_is_no_commit(repository, monkeypatch):
    monkeypatch.setenv("PATH", "")
    assert repository.source_commit() is None


def note_of_pip(folder, **note):
    metadata = folder / "torchrl_etdmpc-9.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: torchrl-etdmpc\nVersion: 9\n")
    (metadata / "direct_url.json").write_text(json.dumps({"url": "file:///somewhere", **note}))


@pytest.mark.parametrize(
    ("note", "expected"), [({"vcs_info": {"commit_id": "12ab"}}, "12ab"), ({"dir_info": {}}, None)]
)
def test_an_installation_from_a_repository_has_pip_s_commit(tmp_path, monkeypatch, note, expected):
    module = copied_to(tmp_path)
    note_of_pip(tmp_path, **note)
    monkeypatch.syspath_prepend(tmp_path)
    assert module.source_commit() == expected


def test_the_note_of_another_installation_is_not_taken(tmp_path, monkeypatch):
    module = copied_to(tmp_path / "here")
    note_of_pip(tmp_path, vcs_info={"commit_id": "12ab"})
    monkeypatch.syspath_prepend(tmp_path)
    assert module.source_commit() is None
