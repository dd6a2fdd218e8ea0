from __future__ import annotations

import contextlib
import errno
import io
import re
import sys
import warnings
from pathlib import Path

import pytest
from torchrl import torchrl_logger

from torchrl_etdmpc import runs
from torchrl_etdmpc.runs import console


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


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


def test_notices_of_the_package_are_shown_also_where_a_link_leads_to_it(tmp_path, capsys):
    (tmp_path / "link").symlink_to(Path(runs.__file__).parents[1])
    file = str(tmp_path / "link" / "training" / "train.py")
    with console():
        torchrl_logger.handle(torchrl_logger.makeRecord("torchrl", 20, file, 1, "compiled", (), None))
    assert capsys.readouterr().out.endswith(" compiled\n")


def test_a_line_is_in_a_file_at_once(tmp_path, monkeypatch):
    log = tmp_path / "log.txt"
    with log.open("w") as file, monkeypatch.context() as patch, console():
        patch.setattr(sys, "stdout", file)
        torchrl_logger.warning("a word")
        assert log.read_text().endswith(" a word\n")


def test_a_warning_on_a_terminal_covers_the_bar(monkeypatch):
    monkeypatch.setenv("COLUMNS", "40")
    monkeypatch.setattr(sys, "stderr", Terminal())
    with console():
        text = warnings.formatwarning(UserWarning("look out"), UserWarning, "train.py", 7)
    assert re.fullmatch(r"\r\d\d:\d\d:\d\d warning: look out {13}\n", text)


def test_a_warning_has_no_source_line():
    with console():  # pytest keeps warnings from being shown, so it is asked for the text
        text = warnings.formatwarning(
            UserWarning("no checkpoint\nat 40 env steps"), UserWarning, "train.py", 7, "x = 1"
        )
    assert re.fullmatch(r"\d\d:\d\d:\d\d warning: no checkpoint at 40 env steps\n", text)


@pytest.mark.parametrize("stopped", [False, True])
def test_what_was_there_before_comes_back(stopped):
    handlers, form = torchrl_logger.handlers, warnings.formatwarning
    with contextlib.suppress(KeyboardInterrupt), console():
        if stopped:
            raise KeyboardInterrupt
    assert torchrl_logger.handlers is handlers
    assert warnings.formatwarning is form


def test_without_tqdm_there_are_lines_too(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "tqdm", None)
    with console():
        torchrl_logger.warning("a word")
    assert capsys.readouterr().out.endswith(" a word\n")


@pytest.mark.parametrize("columns", ["1", "9"])
def test_a_narrow_terminal_loses_no_line_and_breaks_no_path(monkeypatch, columns):
    monkeypatch.setenv("COLUMNS", columns)
    terminal = Terminal()
    monkeypatch.setattr(sys, "stdout", terminal)
    with console():
        torchrl_logger.warning("a word of warning on runs/walker-walk/cpu/seed1")
    assert " ".join(terminal.getvalue().split()).endswith("a word of warning on runs/walker-walk/cpu/seed1")


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
