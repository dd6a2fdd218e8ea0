"""New weights for any network."""

from __future__ import annotations

from typing import Any

from torch import nn


def draw_new_weights(network: nn.Module) -> None:
    """Draws new weights in every layer of a network, also of one that was made elsewhere.

    Args:
        network (nn.Module): one with ``reset_parameters_recursive`` does it itself; of any other every layer with
            parameters has ``reset_parameters``, as PyTorch's have (its attention: ``_reset_parameters``).

    Raises:
        TypeError: if a layer with parameters of its own has neither.

    >>> draw_new_weights(nn.Sequential(nn.Linear(3, 2), nn.ReLU()))
    """
    own: Any = getattr(network, "reset_parameters_recursive", None)
    if own is not None:
        own()
        return
    layers = list(network.modules())
    for layer in layers:
        if next(layer.parameters(recurse=False), None) is not None and _reset_of(layer) is None:
            raise TypeError(
                f"new weights need reset_parameters() in every layer with parameters, got {type(layer).__name__} "
                "without; add the method, or give the network reset_parameters_recursive()."
            )
    for layer in reversed(layers):  # as they were made: a layer after those that it holds
        reset = _reset_of(layer)
        if reset is not None:
            reset()


def _reset_of(layer: nn.Module) -> Any:
    """How a layer draws its weights."""
    return getattr(layer, "reset_parameters", None) or getattr(layer, "_reset_parameters", None)
