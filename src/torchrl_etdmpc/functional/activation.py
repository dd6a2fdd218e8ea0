"""Activations in the form that compiles best."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor


def mish(x: Tensor) -> Tensor:
    """Mish, ``x tanh(softplus(x))`` (Misra, arXiv:1908.08681), elementwise over any shape.

    While compiling it is written with one exponential, ``x u / (u + 2)`` where ``u = e^x (e^x + 2)``: the same function
    up to rounding, and about ten times faster than what the compiler makes of the definition on a CPU.

    >>> mish(torch.tensor([0.0, 20.0])).tolist()
    [0.0, 20.0]
    """
    if not torch.compiler.is_compiling() or x.dtype == torch.float16:  # which e^11 squared would overflow
        return F.mish(x)
    return _mish_with_one_exponential(x)


def _mish_with_one_exponential(x: Tensor) -> Tensor:
    exponential = x.clamp(max=20.0).exp()  # beyond 20 the factor is 1 in single precision
    product = exponential * (exponential + 2)
    return x * (product / (product + 2))
