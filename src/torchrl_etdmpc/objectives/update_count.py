"""Counts the updates of a world model, whatever pipeline makes them."""

from __future__ import annotations

import functools
from collections.abc import Iterable
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

from torch import Tensor, nn
from torch.optim import Optimizer
from torch.optim.optimizer import register_optimizer_step_post_hook

from torchrl_etdmpc.modules import WorldModel


class _Count(NamedTuple):
    trained: tuple[nn.Parameter, ...]
    """In the model's order."""
    first: int
    """The first of them that an optimiser which has stepped holds: that optimiser makes the updates. An optimiser need
    not hold those that are frozen."""
    after: Tensor
    """The version that the last counted step left behind."""


_counts: WeakKeyDictionary[nn.Module, _Count] = WeakKeyDictionary()


def count_updates(world_model: WorldModel, trained: Iterable[nn.Parameter]) -> None:
    """Lets every step of a PyTorch optimiser that trains the world model count as one in ``world_model.version``.

    A step is what every pipeline has: a target average is not there in a loss without values, and a backward pass need
    not be followed by a step. Where several optimisers share the networks out, that of the first one counts, from
    its first step on.

    A line that counts by hand is harmless: after a step that somebody else has counted, the next one is not counted
    again, so that such a pipeline is one ahead and stays so.

    Args:
        world_model (WorldModel): the networks.
        trained (iterable of nn.Parameter): those of its parameters that a loss trains.
    """
    _listen()
    known = {id(parameter) for parameter in trained}
    if world_model in _counts:
        known |= {id(parameter) for parameter in _counts[world_model].trained}
    ordered = tuple(parameter for parameter in world_model.parameters() if id(parameter) in known)
    _counts[world_model] = _Count(ordered, len(ordered), world_model.version.clone())


def restart_count(world_model: nn.Module) -> None:
    """Takes a version that was loaded, not counted, as the one to go on from."""
    if world_model in _counts:
        _counts[world_model] = _counts[world_model]._replace(after=world_model.get_buffer("version").clone())


@functools.cache
def _listen() -> None:
    register_optimizer_step_post_hook(_count)


def _count(optimizer: Optimizer, args: tuple[Any, ...], kwargs: dict[str, Any]) -> None:
    held = {id(parameter) for group in optimizer.param_groups for parameter in group["params"]}
    for world_model, count in list(_counts.items()):
        first = next((place for place, parameter in enumerate(count.trained) if id(parameter) in held), None)
        if first is not None and first <= count.first:
            _counts[world_model] = count._replace(first=first)
            version = world_model.get_buffer("version")
            version += version != count.after.to(version.device) + 1
            restart_count(world_model)
