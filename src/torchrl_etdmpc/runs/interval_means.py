"""Means of metrics over the updates between two rows of a table."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor


class IntervalMeans:
    """Adds up scalars, several at a time, and waits for the device only when the means are asked for.

    >>> means = IntervalMeans()
    >>> for loss in (1.0, 2.0):
    ...     means.add({"loss": torch.tensor(loss)})
    >>> means.means()
    {'loss': 1.5}
    """

    def __init__(self) -> None:
        self._sums: dict[tuple[str, ...], Tensor] = {}  # values that came together are one vector
        self._counts: dict[tuple[str, ...], int] = {}

    def add(self, values: Mapping[str, Tensor]) -> None:
        """Adds one value of each metric.

        Args:
            values (mapping): name to tensor of one element.
        """
        names = tuple(values)
        row = torch.stack([value.detach().reshape(()) for value in values.values()]).double()
        total = self._sums.get(names)
        self._sums[names] = row if total is None else total.to(row.device) + row  # restored sums are on the CPU
        self._counts[names] = self._counts.get(names, 0) + 1

    def means(self) -> dict[str, float]:
        """The mean of each metric since :meth:`clear`."""
        sums: dict[str, tuple[float, int]] = {}
        for names, total in self._sums.items():
            for name, added in zip(names, total.tolist(), strict=True):
                so_far, count = sums.get(name, (0.0, 0))  # it may have come in other company before
                sums[name] = so_far + added, count + self._counts[names]
        return {name: total / count for name, (total, count) in sums.items()}

    def clear(self) -> None:
        """Begins a new interval."""
        self._sums, self._counts = {}, {}

    def state_dict(self) -> dict[str, Any]:
        """Sums and counts."""
        return {"sums": [(list(names), total.cpu(), self._counts[names]) for names, total in self._sums.items()]}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Restores :meth:`state_dict`."""
        entries = [(tuple(names), total, count) for names, total, count in state_dict["sums"]]
        self._sums = {names: total for names, total, _ in entries}
        self._counts = {names: count for names, _, count in entries}
