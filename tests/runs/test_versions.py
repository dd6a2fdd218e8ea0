from __future__ import annotations

import importlib.metadata
import platform

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
