"""Random numbers that everything in a process draws from."""

from __future__ import annotations

import random

import numpy as np
import torch


def seed_everything(seed: int) -> None:
    """Seeds PyTorch's generators and those that Python and NumPy share with simulators, which may draw from them.

    Args:
        seed (int): in [0, 2**32 - 1].

    >>> seed_everything(1)
    >>> first = torch.rand(1), np.random.rand(), random.random()
    >>> seed_everything(1)
    >>> first == (torch.rand(1), np.random.rand(), random.random())
    True
    """
    torch.manual_seed(seed)
    np.random.seed(seed)
    random.seed(seed)
