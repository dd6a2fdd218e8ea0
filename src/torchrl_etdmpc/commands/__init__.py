"""The commands of ``torchrl-etdmpc``, e.g. ``torchrl-etdmpc train``; the scripts in ``examples/`` run the same ones."""

from __future__ import annotations

import contextlib
import importlib
import io
import os
import signal
import sys
import threading
from ctypes.util import find_library
from types import FrameType
from typing import NoReturn

__all__ = ["main"]

_COMMANDS = {
    "train": "trains an agent on any task",
    "distributed": "trains with workers that plan and step, on one machine or a cluster",
    "evaluate": "plays episodes with a trained agent, and films them",
    "export": "writes an agent as programs that need PyTorch only",
    "report": "compares runs with each other and with published baselines",
    "suite": "trains every run of an experiment: tasks x seeds x variants",
    "study": "measures what a trained planner believes, and what is true of it",
    "inspect_planner": "shows what an agent's planner sees, in the browser or saved as a page",
}
_renderer_is_a_guess = False


def main(command: str | None = None) -> None:
    """Runs one command with the arguments of this process.

    It is here before PyTorch, whose import takes seconds: Ctrl-C in the meantime ends in one line, and MuJoCo, which
    looks for a renderer when it is imported, is told whether there will be anything to render.

    Args:
        command (str, optional): ``"train"``, ``"train_dmc"``, ``"distributed"``, ``"evaluate"``, ``"export"``,
            ``"report"``, ``"suite"``, ``"study"`` or ``"inspect_planner"``. Default: the first argument.

    >>> import contextlib
    >>> from unittest.mock import patch
    >>> with patch("sys.argv", ["torchrl-etdmpc", "--version"]), contextlib.suppress(SystemExit):
    ...     main()
    torchrl-etdmpc ...
    """
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:  # closed by who began this process: a file of the run would take its place
            setattr(sys, name, open(os.devnull, "w"))
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # the last line of a run may name a folder in any alphabet
    if command is None:
        command = _first_argument()
    try:
        os.getcwd()
    except FileNotFoundError:
        sys.exit("error: the current directory was removed; change to another one.")
    _choose_renderer(command, sys.argv[1:])
    handler = signal.getsignal(signal.SIGINT)
    quiet = handler is signal.default_int_handler and threading.current_thread() is threading.main_thread()
    if quiet:
        signal.signal(signal.SIGINT, _leave)
    try:
        module = importlib.import_module(f"{__name__}.{command}")
    except Exception as error:  # MuJoCo's import fails in a dozen ways where a renderer is missing
        if _renderer_is_a_guess:
            begin_without_renderer()
        backend = os.environ["MUJOCO_GL"]
        if backend == "disable" or os.environ.get("TORCHRL_ETDMPC_TRACEBACK") == "1":
            raise
        reason, other = " ".join(str(error).split()), "osmesa" if backend == "egl" else "egl"
        without = "leave the film out" if command == "evaluate" else "MUJOCO_GL=disable to do without"
        sys.exit(f"error: cannot render with MUJOCO_GL={backend} ({reason}); try MUJOCO_GL={other}, or {without}.")
    finally:
        if quiet:
            signal.signal(signal.SIGINT, handler)
    module.main()


def _first_argument() -> str:
    lines = "".join(f"  {name:15} {meaning}\n" for name, meaning in _COMMANDS.items())
    usage = (
        f"usage: torchrl-etdmpc COMMAND ...\n\n{lines}\n"
        "torchrl-etdmpc COMMAND --help says what a command takes, torchrl-etdmpc --version which version this is."
    )
    given = sys.argv[1] if len(sys.argv) > 1 else ""
    if given in ("--help", "-h", "help", ""):
        print(usage)
        sys.exit(0 if given else 2)
    if given == "--version":
        from torchrl_etdmpc import __version__

        print(f"torchrl-etdmpc {__version__}")
        sys.exit(0)
    if given not in _COMMANDS:
        sys.exit(f"error: unknown command {given!r}; choose one of {', '.join(_COMMANDS)}.")
    sys.argv[:2] = [f"torchrl-etdmpc {given}"]
    return given


def begin_without_renderer() -> NoReturn:
    """Begins this process anew without a renderer: MuJoCo cannot be imported a second time."""
    os.environ["MUJOCO_GL"] = "disable"
    os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])


def renderer_is_a_guess() -> bool:
    """Whether this process looked for a renderer by itself, so that it may do without one."""
    return _renderer_is_a_guess


def _choose_renderer(command: str, arguments: list[str]) -> None:
    global _renderer_is_a_guess
    given = dict(argument.split("=", 1) for argument in arguments if "=" in argument)
    _renderer_is_a_guess = False
    if command == "inspect_planner":
        _renderer_is_a_guess = "MUJOCO_GL" not in os.environ and find_library("EGL") is not None
        os.environ.setdefault("MUJOCO_GL", "egl" if _renderer_is_a_guess else "disable")
    elif command == "evaluate" and given.get("video", "null") != "null":
        os.environ.setdefault("MUJOCO_GL", "egl")
    elif not any(":" in given.get(name, "") for name in ("task", "tasks", "code")):  # one's own task may render inside
        os.environ["MUJOCO_GL"] = "disable"  # whatever it was: without a film, a missing renderer need not hurt
    else:
        os.environ.setdefault("MUJOCO_GL", "disable")


def _leave(number: int, frame: FrameType | None) -> None:
    with contextlib.suppress(OSError):  # Ctrl-C has ended a `tee` that read it
        os.write(2, b"\nstopped before anything was begun\n")
    os._exit(128 + number)
