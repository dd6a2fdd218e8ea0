"""Whole-call compilation: one graph per planning call and one per gradient."""

from __future__ import annotations

import contextlib
import functools
import itertools
import shutil
import types
import warnings
from collections.abc import Callable
from typing import Any

import torch
from torch.utils._pytree import tree_map_only

_OPTIONS: dict[str, Any] = {
    "fallback_random": True,  # PyTorch's own random numbers: those of an eager run, and faster on a CPU than Inductor's
    "cpp_wrapper": True,  # a hundred small operations are called from C++ and not from Python
    "cpp_wrapper_build_separate": True,  # the kernels without PyTorch's headers: a third of g++'s time
}
_WORTH_IT = 6_000
"""Decisions with updates from which compiling with an empty cache pays on a CPU: two minutes of one core, for 20 ms per
decision with the preset ``cpu``, and more with larger networks."""


def resolve_compile(setting: str, device: torch.device, decisions: int) -> str | None:
    """The ``torch.compile`` mode of ``auto``, ``off``, ``default`` or ``max``; ``None`` is eager.

    ``auto`` compiles where a compiler exists, on CUDA with CUDA graphs, on a CPU if the run is long enough; it warns if
    there is no compiler. ``default`` compiles without CUDA graphs, ``max`` tunes the matrix products as well.

    Args:
        setting (str): of the run.
        device (torch.device): of the networks.
        decisions (int): with updates, in the whole run.
    """
    if setting == "off":
        return None
    if setting == "auto" and device.type == "cpu":
        if decisions < _WORTH_IT:
            return None
        if not any(map(shutil.which, ("g++", "clang++", "c++"))):
            warnings.warn(
                "no C++ compiler found, so nothing is compiled and training is slower; install g++.", stacklevel=2
            )
            return None
    if setting == "auto":
        return "reduce-overhead" if device.type == "cuda" else "default"
    return {"default": "default", "max": "max-autotune"}[setting]


def compile_call(function: Callable[..., Any], mode: str, *, keep: bool = True) -> Callable[..., Any]:
    """Compiles a function of tensors as one graph of fixed shapes.

    Args:
        function (callable): traced without a graph break, or compilation fails.
        mode (str): of ``torch.compile``.
        keep (bool): whether results must outlive the next call. CUDA graphs write them to the same memory every time,
            so they are copied. Default: ``True``.
    """
    function = _with_code_of_its_own(function)
    if mode == "default":
        return torch.compile(function, options=_OPTIONS, dynamic=False, fullgraph=True)
    compiled = torch.compile(function, mode=mode, dynamic=False, fullgraph=True)

    @functools.wraps(function)
    def replay(*args: Any, **kwargs: Any) -> Any:
        torch.compiler.cudagraph_mark_step_begin()
        result = compiled(*args, **kwargs)
        return tree_map_only(torch.Tensor, torch.clone, result) if keep else result

    return replay


@functools.cache
def tracing_gradients() -> contextlib.AbstractContextManager[None]:
    """Lets Dynamo trace ``torch.autograd.grad``.

    One object for all calls: in PyTorch 2.13 every patch of a configuration makes a context variable that stays in
    memory, 200 bytes for each update.
    """
    return torch._dynamo.config.patch(trace_autograd_ops=True)


_numbers = itertools.count()


def _with_code_of_its_own(function: Callable[..., Any]) -> Callable[..., Any]:
    """The same function to call, a new one to Dynamo, which refuses the ninth compilation of one code object.

    All planners share the code of ``plan``, and a process may make many agents.
    """

    def call(*args: Any, **kwargs: Any) -> Any:
        return function(*args, **kwargs)

    name = f"{function.__name__}_{next(_numbers)}"
    code = call.__code__.replace(co_name=name)
    return functools.update_wrapper(types.FunctionType(code, globals(), name, None, call.__closure__), function)
