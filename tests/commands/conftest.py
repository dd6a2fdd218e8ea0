"""The command of the wheel, in the process of the tests."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable

import pytest

from torchrl_etdmpc import commands


@pytest.fixture
def run_main(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture) -> Callable[..., tuple[object, str, str]]:
    """Runs ``torchrl-etdmpc`` in this process; returns its exit message, stdout and stderr."""
    monkeypatch.setenv("MUJOCO_GL", os.environ.get("MUJOCO_GL", "disable"))
    monkeypatch.setenv("HYDRA_FULL_ERROR", "0")  # set by the command; this restores it
    monkeypatch.delenv("TORCHRL_ETDMPC_TRACEBACK", raising=False)

    def run(*arguments: str) -> tuple[object, str, str]:
        monkeypatch.setattr(sys, "argv", ["/bin/torchrl-etdmpc", *arguments])
        message = None
        try:
            commands.main()
        except SystemExit as stop:
            message = stop.code
        return message, *capfd.readouterr()

    return run
