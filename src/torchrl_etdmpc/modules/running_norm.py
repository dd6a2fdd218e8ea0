"""Standardised observations."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from torchrl_etdmpc.functional import updated_moments

EPSILON = 1e-6
"""Added to the variance, so that an entry which never moved counts in thousandths."""
LARGEST = 10.0
"""Standardised entries are clipped to this many standard deviations."""


class RunningNorm(nn.Module):
    """Standardises vectors by the mean and variance of all that were seen before: ``clip((x - mean) / std, -10, 10)``.

    An encoder whose first layer is followed by LayerNorm hardly sees a small entry beside a large one. In DMC's
    reacher, an arm that spins turns by tens of radians, and the way to the target is a tenth of a metre. (SimBa,
    arXiv:2410.09754, standardises so; not in the thesis.)

    Statistics stay in single precision where the module is cast to half, in which they would stop moving.
    Moved by :meth:`observe` alone. The losses call it in training mode with every batch, as they move their running
    scales, so that planner, targets and policy see one and the same statistic: that of the replayed observations.

    Args:
        size (int): O.

    >>> norm = RunningNorm(2)  # as long as nothing was seen it clips vectors and leaves them as they are
    >>> norm.observe(torch.tensor([[0.0, 30.0], [2.0, 50.0]]))
    >>> [round(value, 3) for value in norm(torch.tensor([1.0, 60.0])).tolist()]
    [0.0, 2.0]
    """

    mean: Tensor
    variance: Tensor
    batches: Tensor

    def __init__(self, size: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(size))
        self.register_buffer("variance", torch.ones(size))
        self.register_buffer("batches", torch.zeros((), dtype=torch.int64))
        """How many batches the statistics are of."""

    @torch.no_grad()
    def observe(self, rows: Tensor, counts: Tensor | None = None) -> None:
        """Counts a batch ``[..., O]`` in, with the same weight as each one before.

        Args:
            rows (Tensor): ``[..., O]``.
            counts (Tensor, optional): which rows count, bool, ``[...]``. The batch is left out if none counts, or if
                one that counts is not finite. Default: all of them.
        """
        rate = 1 / (self.batches + 1).to(self.mean.dtype)
        mean, variance, moved = updated_moments(self.mean, self.variance, rows, rate, counts)
        self.batches.add_(moved)
        self.mean.copy_(mean)
        self.variance.copy_(variance)

    def _apply(self, fn, recurse: bool = True):
        exact = {name: self.get_buffer(name) for name in ("mean", "variance")}
        super()._apply(fn, recurse)
        for name, before in exact.items():
            now = self.get_buffer(name)
            if now.element_size() < 4:
                self.register_buffer(name, before.to(now.device))
        return self

    def reset_parameters(self) -> None:
        """Forgets what was seen."""
        self.mean.zero_()
        self.variance.fill_(1)
        self.batches.zero_()

    def forward(self, x: Tensor) -> Tensor:
        """``[..., O] -> [..., O]``, in the dtype of ``x``, or of the statistics where that has no fractions."""
        standardised = ((x - self.mean) * (self.variance + EPSILON).rsqrt()).clamp(-LARGEST, LARGEST)
        return standardised.to(x.dtype) if x.is_floating_point() else standardised
