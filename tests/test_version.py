"""The version is written once."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest

import torchrl_etdmpc

ROOT = Path(__file__).resolve().parent.parent


def test_the_metadata_s_version_is_the_package_s():
    pyprojecttoml = pytest.importorskip("setuptools.config.pyprojecttoml")
    built = pyprojecttoml.read_configuration(ROOT / "pyproject.toml")  # as the build reads it
    assert built["project"]["version"] == torchrl_etdmpc.__version__


def test_no_other_place_states_the_version():
    assert "version" not in tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def test_the_changelog_s_newest_release_is_the_version_or_the_one_before_it():
    releases = re.findall(r"^## (\d+\.\d+\.\d+) - \d{4}-\d\d-\d\d$", (ROOT / "CHANGELOG.md").read_text("utf-8"), re.M)
    version = tuple(map(int, re.findall(r"\d+", torchrl_etdmpc.__version__)[:3]))
    newest = tuple(map(int, releases[0].split(".")))
    assert newest < version if "dev" in torchrl_etdmpc.__version__ else newest == version
