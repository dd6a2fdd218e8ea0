from __future__ import annotations

import io
import sys
import time

import pytest

pytest.importorskip("tqdm")

from torchrl import torchrl_logger  # noqa: E402

from torchrl_etdmpc.runs import console, progress_bar  # noqa: E402


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def one_terminal(monkeypatch):
    """Standard output and error on one terminal; not a fixture, because pytest sets both anew before the test."""
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setattr(sys, "stdout", terminal)
    return terminal


def test_a_terminal_shows_phase_steps_time_left_and_the_last_note(monkeypatch):
    terminal = one_terminal(monkeypatch)
    with progress_bar("learning", 1000, "env steps", initial=200) as bar:
        for env_steps, note in ((400, "return 31.2"), (600, None), (800, None)):
            time.sleep(0.12)  # a bar is drawn at most every 0.1 s
            bar.update(env_steps, note)
    last = terminal.getvalue().splitlines()[-1].split("\r")[-1]
    assert last.startswith("learning ")
    assert " 80%|" in last
    assert "| 800/1000 env steps, 00:00 left, return 31.2" in last


def test_a_bar_of_a_part_that_passes_leaves_nothing(monkeypatch):
    terminal = one_terminal(monkeypatch)
    with progress_bar("evaluation", 10, "decisions", passing=True) as bar:
        time.sleep(0.12)
        bar.advance()
    assert "evaluation" in terminal.getvalue()
    assert terminal.getvalue().split("\r")[-1].strip() == ""


def test_a_line_of_the_log_stands_above_the_bar_and_not_beside_it(monkeypatch):
    terminal = one_terminal(monkeypatch)
    with console(), progress_bar("learning", 1000, "env steps") as bar:
        time.sleep(0.12)
        bar.update(500)
        torchrl_logger.warning("half of it")
    line = next(line for line in terminal.getvalue().split("\n") if "half of it" in line)
    shown = line.split("\r")[-1]
    assert "learning" not in shown
    assert shown.endswith(" half of it")


def test_a_file_gets_plain_lines_in_the_log_with_the_time_left(monkeypatch, capsys):
    monkeypatch.setattr(sys, "stderr", io.StringIO())
    with console(), progress_bar("learning", 1000, "env steps", log_every_s=0.5) as bar:
        time.sleep(0.6)
        bar.update(990, "return 31.2")
        bar.update(991)
    (line,) = capsys.readouterr().out.splitlines()
    assert line[8:] == " learning: 990 of 1000 env steps, 0 s left, return 31.2"
    assert sys.stderr.getvalue() == ""


def test_a_phase_that_passes_has_its_lines_in_the_log_too(monkeypatch, capsys):
    now = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    monkeypatch.setattr(sys, "stderr", io.StringIO())
    with console(), progress_bar("evaluation", 500, "decisions", passing=True) as bar:
        for now[0] in (30.0, 60.0, 90.0):
            bar.advance()
    (line,) = capsys.readouterr().out.splitlines()
    assert line[8:].startswith(" evaluation: 2 of 500 decisions, ")


@pytest.mark.parametrize(
    ("done", "total", "left"),
    [
        (998, 1000, "2 min"),  # nothing is done yet
        (1000, 1001, "30 s"),
        (999, 1000, "1 min"),
        (999, 1058, "59 min"),
        (999, 1059, "1.0 h"),
        (999, 1149, "2.5 h"),
    ],
)
def test_a_phase_that_goes_on_counts_from_where_it_was_and_so_does_its_time_left(
    monkeypatch, capsys, done, total, left
):
    now = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    monkeypatch.setattr(sys, "stderr", io.StringIO())
    with console(), progress_bar("learning", total, "env steps", initial=998) as bar:
        now[0] = 60.0
        bar.advance() if done == 999 else bar.update(done)
    (line,) = capsys.readouterr().out.splitlines()
    assert line[8:] == f" learning: {done} of {total} env steps, {left} left"


def test_a_note_stays_in_the_lines_until_there_is_another(monkeypatch, capsys):
    now = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    monkeypatch.setattr(sys, "stderr", io.StringIO())
    with console(), progress_bar("learning", 1000, "env steps") as bar:
        for now[0], note in ((60.0, "return 31.2"), (120.0, None), (180.0, "return 40.0")):
            bar.update(500, note)
    lines = capsys.readouterr().out.splitlines()
    assert [line.rpartition(", ")[2] for line in lines] == ["return 31.2", "return 31.2", "return 40.0"]


def test_where_steps_differ_in_length_nothing_says_how_long_the_rest_takes(monkeypatch, capsys):
    terminal = one_terminal(monkeypatch)
    with progress_bar("compilation", 4, "parts", time_left=False) as bar:
        time.sleep(0.12)
        bar.advance()
    assert terminal.getvalue().splitlines()[-1].split("\r")[-1].endswith("| 1/4 parts")
    monkeypatch.undo()
    now = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    monkeypatch.setattr(sys, "stderr", io.StringIO())
    with console(), progress_bar("compilation", 4, "parts", time_left=False) as bar:
        now[0] = 60.0
        bar.advance()
    (line,) = capsys.readouterr().out.splitlines()
    assert line[8:] == " compilation: 1 of 4 parts"


def test_a_missing_tqdm_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "tqdm", None)
    with pytest.raises(ImportError, match=r"^progress_bar needs tqdm, .*; run `pip install tqdm`\.$"):
        progress_bar("learning", 10, "env steps")
