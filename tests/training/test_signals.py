"""A signal to stop is noted; a second one ends the process."""

from __future__ import annotations

import os
import signal

from torchrl_etdmpc.training.signals import StopSignals


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
