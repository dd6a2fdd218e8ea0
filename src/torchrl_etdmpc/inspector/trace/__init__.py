"""Traces: everything that one planning call looked at, made, kept in a file and read again."""

from __future__ import annotations

from torchrl_etdmpc.inspector.trace.latents import head_spread, principal_components, rolled_out
from torchrl_etdmpc.inspector.trace.planning import trace_plan
from torchrl_etdmpc.inspector.trace.progress import Cancelled, watched
from torchrl_etdmpc.inspector.trace.simulation import add_simulation
from torchrl_etdmpc.inspector.trace.trace import Trace, TraceError, checksum, load_trace

__all__ = [
    "Cancelled",
    "Trace",
    "TraceError",
    "add_simulation",
    "checksum",
    "head_spread",
    "load_trace",
    "principal_components",
    "rolled_out",
    "trace_plan",
    "watched",
]
