from __future__ import annotations

import importlib.metadata
import platform

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
