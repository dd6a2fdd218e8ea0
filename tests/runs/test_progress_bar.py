from __future__ import annotations

import io
import sys
import time

import pytest

pytest.importorskip("tqdm")

from torchrl_etdmpc.runs import progress_bar  # noqa: E402


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_a_terminal_shows_steps_the_last_return_and_decisions_per_second(monkeypatch):
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    with progress_bar(1000, initial=200) as bar:
        for env_steps, last_return in ((400, 31.25), (600, None), (800, None)):
            time.sleep(0.12)  # a bar is drawn at most every 0.1 s
            bar.update(env_steps=env_steps, decision_steps=env_steps // 2, last_return=last_return)
    text = terminal.getvalue()
    assert "800/1000 env steps" in text
    assert "return 31.2" in text.splitlines()[-1]  # the last one stays
    assert "decisions/s" in text


def test_a_file_gets_nothing(monkeypatch):
    file = io.StringIO()
    monkeypatch.setattr(sys, "stderr", file)
    with progress_bar(1000) as bar:
        bar.update(env_steps=400, decision_steps=200, last_return=31.25)
    assert file.getvalue() == ""


def test_a_missing_tqdm_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "tqdm", None)
    with pytest.raises(ImportError, match=r"^progress_bar needs tqdm, .*; run `pip install tqdm`\.$"):
        progress_bar(10)
