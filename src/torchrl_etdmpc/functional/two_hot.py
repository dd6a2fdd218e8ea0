"""Distributional scalars: symlog two-hot encoding, decoding and cross-entropy.

Scalars are classified over ``M`` bins that are evenly spaced in symlog space (DreamerV3, arXiv:2301.04104;
TD-MPC2, arXiv:2310.16828). The interpolation happens in symlog space, as TD-MPC2 and BMPC do it.
"""

from __future__ import annotations

import torch
from torch import Tensor


def symlog(x: Tensor) -> Tensor:
    """Symmetric logarithm ``sign(x) ln(1 + |x|)`` (DreamerV3), elementwise over any shape.

    >>> symlog(torch.tensor([0.0, -1.0])).tolist()
    [0.0, -0.6931471824645996]
    """
    return x.sign() * x.abs().log1p()


def symexp(x: Tensor) -> Tensor:
    """Inverse of :func:`symlog`, ``sign(x) (exp(|x|) - 1)``, elementwise over any shape.

    >>> round(symexp(symlog(torch.tensor(3.0))).item(), 4)
    3.0
    """
    return x.sign() * x.abs().expm1()


def two_hot_encode(x: Tensor, bins: Tensor) -> Tensor:
    """Splits each scalar's mass linearly between the two neighbouring bins, in symlog space.

    The weight of bin m is ``max(0, 1 - |position - m|)``, where position is the scalar's fractional bin index. A
    value outside the bins puts all its mass in the end bin; a NaN stays NaN.

    Args:
        x (Tensor): scalars in the units of the environment (reward or return), shape ``[...]``.
        bins (Tensor): bin centres in symlog space, evenly spaced and ascending, shape ``[M]`` with M >= 2.

    Returns:
        Tensor: weights that sum to one, shape ``[..., M]``, in single precision at least.

    >>> bins = torch.linspace(-10, 10, 101)
    >>> two_hot_encode(torch.tensor(0.0), bins)[50].item()
    1.0
    """
    num_bins = bins.shape[-1]
    # Half precision places a scalar in steps of half a bin, and has another width than the bins.
    dtype = torch.promote_types(torch.promote_types(x.dtype, bins.dtype), torch.float32)
    low, high = bins[0].to(dtype), bins[-1].to(dtype)
    width = (high - low) / (num_bins - 1)
    position = ((symlog(x.to(dtype)) - low) / width).clamp(0, num_bins - 1)
    index = torch.arange(num_bins, device=bins.device, dtype=dtype)
    return (1 - (position.unsqueeze(-1) - index).abs()).clamp_min(0)


def two_hot_decode(logits: Tensor, bins: Tensor) -> Tensor:
    """Expected scalar of a categorical distribution over symlog bins: ``symexp(sum(softmax(logits) * bins))``.

    Args:
        logits (Tensor): unnormalised log-probabilities, shape ``[..., M]``.
        bins (Tensor): bin centres in symlog space, shape ``[M]``.

    Returns:
        Tensor: scalars in the units of the environment, shape ``[...]``; under autocast in single precision.

    >>> bins = torch.linspace(-10, 10, 101)
    >>> weights = two_hot_encode(torch.tensor(7.0), bins)
    >>> round(two_hot_decode(weights.clamp_min(1e-30).log(), bins).item(), 3)
    7.0
    """
    halved, autocast = bins.dtype in (torch.float16, torch.bfloat16), torch.is_autocast_enabled(logits.device.type)
    if not (halved or autocast):
        return symexp(logits.softmax(-1) @ bins)
    if halved:  # rounded bins are not evenly spaced, as those are that two_hot_encode places a scalar between
        places = torch.linspace(0, 1, len(bins), device=bins.device)
        bins = torch.lerp(bins[0].float(), bins[-1].float(), places)
    decoded = symexp((logits.float().softmax(-1) * bins).sum(-1))  # no product in half precision: values learn of it
    return decoded if autocast else decoded.to(logits.dtype)


def two_hot_cross_entropy(logits: Tensor, target: Tensor, bins: Tensor) -> Tensor:
    """Cross-entropy between the two-hot target and the log-softmax of the logits (DreamerV3).

    Args:
        logits (Tensor): unnormalised log-probabilities, shape ``[..., M]``.
        target (Tensor): scalars in the units of the environment, broadcastable to ``[...]``.
        bins (Tensor): bin centres in symlog space, shape ``[M]``.

    Returns:
        Tensor: cross-entropy in nats, shape ``[...]``.

    >>> bins = torch.linspace(-10, 10, 101)
    >>> two_hot_cross_entropy(torch.zeros(101), torch.tensor(1.5), bins).exp().round().item()
    101.0
    """
    if torch.is_autocast_enabled(logits.device.type):
        logits = logits.float()
    return -(two_hot_encode(target, bins) * logits.log_softmax(-1)).sum(-1)
