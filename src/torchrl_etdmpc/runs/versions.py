"""Versions of what a run was made with."""

from __future__ import annotations

import importlib.metadata
import json
import platform
import subprocess
from pathlib import Path

_PACKAGE = Path(__file__).parents[1]
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


def source_commit() -> str | None:
    """The commit of the package's own source, where git knows it.

    Returns:
        str: the hash, with ``"-dirty"`` behind it where files of the package differ from that commit. ``None`` for a
        release, and where git is missing or refuses.

    >>> commit = source_commit()
    >>> commit is None or len(commit.removesuffix("-dirty")) >= 40
    True
    """
    try:
        _git("ls-files", "--error-unmatch", Path(__file__).name)  # else the repository is another, which holds a copy
        commit, changes = _git("rev-parse", "HEAD"), _git("status", "--porcelain", "--", str(_PACKAGE))
    except (OSError, subprocess.SubprocessError):
        return _installed_commit()
    return f"{commit}-dirty" if changes else commit


def _installed_commit() -> str | None:
    """The commit that pip noted when it installed the package from a repository."""
    try:
        distribution = importlib.metadata.distribution(_PACKAGES[0])
    except importlib.metadata.PackageNotFoundError:
        return None
    noted = distribution.read_text("direct_url.json")
    if noted is None or Path(str(distribution.locate_file(_PACKAGE.name))) != _PACKAGE:
        return None
    return json.loads(noted).get("vcs_info", {}).get("commit_id")


def _git(*arguments: str) -> str:
    # Without its optional locks: many runs ask at once, and somebody may commit meanwhile.
    line = ["git", "--no-optional-locks", "-C", str(Path(__file__).parent), *arguments]
    return subprocess.run(line, capture_output=True, check=True, text=True, timeout=10).stdout.strip()
