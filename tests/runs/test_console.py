from __future__ import annotations

import errno
import io
import re
import sys
import warnings

import pytest
from torchrl import torchrl_logger

from torchrl_etdmpc.runs import console


def test_the_log_is_plain_lines_with_the_time(capsys):
    with console():
        torchrl_logger.warning("a word of warning")
    out, err = capsys.readouterr()
    assert re.fullmatch(r"\d\d:\d\d:\d\d a word of warning\n", out)
    assert err == ""


def test_notices_of_other_libraries_are_left_out_and_their_warnings_are_not(capsys):
    notice = torchrl_logger.makeRecord("torchrl", 20, "/site-packages/torchrl/storages.py", 1, "made one", (), None)
    warning = torchrl_logger.makeRecord("torchrl", 30, "/site-packages/torchrl/storages.py", 1, "look out", (), None)
    with console():
        torchrl_logger.handle(notice)
        torchrl_logger.handle(warning)
    assert capsys.readouterr().out.endswith("look out\n")


def test_a_warning_has_no_source_line():
    with console():  # pytest keeps warnings from being shown, so it is asked for the text
        text = warnings.formatwarning(
            UserWarning("no checkpoint\nat 40 env steps"), UserWarning, "train.py", 7, "x = 1"
        )
    assert re.fullmatch(r"\d\d:\d\d:\d\d warning: no checkpoint at 40 env steps\n", text)


def test_what_was_there_before_comes_back(capsys):
    handlers, form = torchrl_logger.handlers, warnings.formatwarning
    with console():
        pass
    assert torchrl_logger.handlers is handlers
    assert warnings.formatwarning is form


def test_without_tqdm_there_are_lines_too(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "tqdm", None)
    with console():
        torchrl_logger.warning("a word")
    assert capsys.readouterr().out.endswith(" a word\n")


@pytest.mark.parametrize("columns", ["1", "9"])
def test_a_narrow_terminal_loses_no_line(monkeypatch, columns):
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    monkeypatch.setenv("COLUMNS", columns)
    terminal = Terminal()
    monkeypatch.setattr(sys, "stdout", terminal)
    with console():
        torchrl_logger.warning("a word of warning")
    assert " ".join(terminal.getvalue().split()).endswith("a word of warning")


@pytest.mark.parametrize(
    "error",
    [
        OSError(errno.ENOSPC, "No space left on device"),
        BrokenPipeError(),
        ValueError("I/O operation on closed file"),
        RuntimeError("reentrant call inside <_io.BufferedWriter name='<stdout>'>"),  # of a signal's handler
    ],
)
def test_what_cannot_be_shown_ends_nothing(monkeypatch, error):
    class Full(io.StringIO):
        def write(self, text: str) -> int:
            raise error

    monkeypatch.setattr(sys, "stdout", Full())
    with console():
        torchrl_logger.warning("a word")
