"""Versions of what a run was made with."""

from __future__ import annotations

import importlib.metadata
import platform

_PACKAGES = ("torchrl-etdmpc", "torch", "torchrl", "tensordict", "dm-control", "mujoco")


def library_versions() -> dict[str, str]:
    """Versions of Python and of those of our libraries that are installed, by distribution name.

    >>> list(library_versions())[0]
    'python'
    """
    versions = {"python": platform.python_version()}
    for name in _PACKAGES:
        try:
            versions[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return versions
