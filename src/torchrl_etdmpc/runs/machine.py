"""The machine that a run is on."""

from __future__ import annotations

import os
import platform
import re
from pathlib import Path


def processor() -> str:
    """The CPU's architecture, and its name where the system tells it.

    >>> processor().startswith(platform.machine())
    True
    """
    file = Path("/proc/cpuinfo")
    names = re.findall(r"^model name\s*: (.+)$", file.read_text(), re.M) if file.exists() else []
    return f"{platform.machine()} ({names[0]})" if names else platform.machine()


def usable_cores() -> int:
    """The cores that this process may use.

    >>> usable_cores() >= 1
    True
    """
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def machine_memory() -> int | None:
    """Bytes of memory, ``None`` where the system does not tell.

    >>> (machine_memory() or 2**34) > 2**28
    True
    """
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):  # Windows
        return None
