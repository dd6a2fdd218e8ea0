"""New weights for any network."""

from __future__ import annotations

from typing import Any

from torch import nn


def draw_new_weights(network: nn.Module) -> None:
    """Draws new weights in every layer of a network, also of one that was made elsewhere.

    Args:
        network (nn.Module): one with ``reset_parameters_recursive`` does it itself; of any other every layer with
            parameters has ``reset_parameters``, as PyTorch's have.

    Raises:
        TypeError: if a layer with parameters of its own has no ``reset_parameters``.

    >>> draw_new_weights(nn.Sequential(nn.Linear(3, 2), nn.ReLU()))
    """
    own: Any = getattr(network, "reset_parameters_recursive", None)
    if own is not None:
        own()
        return
    layers: list[Any] = list(network.modules())
    for layer in layers:
        if next(layer.parameters(recurse=False), None) is not None and not hasattr(layer, "reset_parameters"):
            raise TypeError(
                f"new weights need reset_parameters() in every layer with parameters, got {type(layer).__name__} "
                "without; add the method."
            )
    for layer in layers:
        if hasattr(layer, "reset_parameters"):
            layer.reset_parameters()
