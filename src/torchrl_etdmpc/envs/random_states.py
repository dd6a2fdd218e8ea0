"""States of NumPy's random generators as tensors, which a checkpoint can hold."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor


def pack_mt19937(state: tuple) -> Tensor:
    """The state of a ``RandomState`` as 627 integers; the cached normal number by its bits."""
    _, keys, position, has_gauss, cached = state
    tail = np.array([position, has_gauss, np.float64(cached).view(np.int64)], dtype=np.int64)
    return torch.from_numpy(np.concatenate([keys.astype(np.int64), tail]))


def unpack_mt19937(packed: Tensor) -> tuple:
    """Inverse of :func:`pack_mt19937`."""
    values = packed.numpy()
    keys, (position, has_gauss, cached) = values[:-3].astype(np.uint32), values[-3:]
    return "MT19937", keys, int(position), int(has_gauss), float(cached.view(np.float64))


def pack_pcg64(state: dict[str, Any]) -> Tensor:
    """The state of a PCG64, two numbers of 128 bits and two small ones, as six integers."""
    numbers = state["state"]["state"].to_bytes(16, "little") + state["state"]["inc"].to_bytes(16, "little")
    return torch.tensor([*np.frombuffer(numbers, np.int64).tolist(), state["has_uint32"], state["uinteger"]])


def unpack_pcg64(packed: Tensor) -> dict[str, Any]:
    """Inverse of :func:`pack_pcg64`."""
    *numbers, has_uint32, uinteger = packed.tolist()
    raw = np.array(numbers, np.int64).tobytes()
    state = {"state": int.from_bytes(raw[:16], "little"), "inc": int.from_bytes(raw[16:], "little")}
    return {"bit_generator": "PCG64", "state": state, "has_uint32": has_uint32, "uinteger": uinteger}
