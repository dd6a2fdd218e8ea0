"""A signal to stop is noted; a second one ends the process."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator

import pytest

from torchrl_etdmpc.training.signals import EXIT_CODE, StopSignals


def test_a_second_signal_ends_a_process_whose_messages_nobody_reads(in_copy):
    def stopped_twice() -> None:
        reader, writer = os.pipe()
        os.close(reader)  # as Ctrl-C ends the tee of `train 2>&1 | tee log`, too
        os.dup2(writer, 2)
        with StopSignals() as stop:
            stop.nothing_to_save = False
            signal.raise_signal(signal.SIGINT)
            signal.raise_signal(signal.SIGINT)

    assert os.waitstatus_to_exitcode(in_copy(stopped_twice)) == 128 + signal.SIGINT


@pytest.fixture
def in_a_terminal() -> Iterator[None]:
    """Also where the tests themselves were started by ``nohup``."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


@pytest.mark.parametrize("others", [("SIGHUP",), ("SIGHUP", "SIGHUP", "SIGTERM"), ("SIGTERM", "SIGHUP")])
def test_a_terminal_that_is_closed_stops_a_run_and_never_ends_it_at_once(in_a_terminal, others):
    with StopSignals() as stop:
        stop.nothing_to_save = False
        for name in others:
            signal.raise_signal(getattr(signal, name))
        assert stop.requested
    assert signal.getsignal(signal.SIGHUP) == signal.SIG_DFL


def test_a_terminal_that_is_closed_leaves_a_run_with_nothing_to_save(in_a_terminal):
    with pytest.raises(SystemExit, match=f"^{EXIT_CODE}$"), StopSignals():
        signal.raise_signal(signal.SIGHUP)


def test_nohup_outlives_its_terminal(in_a_terminal):
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    with StopSignals() as stop:
        signal.raise_signal(signal.SIGHUP)
        assert not stop.requested
