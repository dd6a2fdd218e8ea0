"""Counts the updates of a world model, whatever pipeline makes them."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterable
from typing import Any, cast
from weakref import ReferenceType, WeakKeyDictionary, ref

from torch import Tensor, nn
from torch.optim import Optimizer
from torch.optim.optimizer import register_optimizer_step_post_hook

from torchrl_etdmpc.modules import WorldModel


@dataclasses.dataclass(eq=False)
class _Count:
    trained: tuple[nn.Parameter, ...]
    """In the model's order."""
    after: Tensor
    """The version that the last counted step left behind."""
    counts: ReferenceType[Optimizer] | None = None
    """The optimiser whose steps are the updates: of those that have stepped and are still there, the one that holds the
    first parameter. It need not hold those that are frozen."""

    def place(self, optimizer: Optimizer | None) -> int:
        """Of the first trainable parameter that the optimiser holds; behind all of them if there is none."""
        groups = [] if optimizer is None else optimizer.param_groups
        held = {id(parameter) for group in groups for parameter in group["params"]}
        places = (place for place, p in enumerate(self.trained) if p.requires_grad and id(p) in held)
        return next(places, len(self.trained))


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
    _counts[world_model] = _Count(ordered, world_model.version.clone())


def restart_count(world_model: nn.Module) -> None:
    """Takes a version that was loaded, not counted, as the one to go on from."""
    if world_model in _counts:
        count, version = _counts[world_model], _version(world_model)
        if count.after.device == version.device:
            count.after.copy_(version)  # in place: a captured CUDA graph goes on reading this memory
        else:
            count.after = version.clone()


def _version(world_model: nn.Module) -> Tensor:
    return cast(Tensor, world_model.version)  # get_buffer does not find it in one that torch.compile has wrapped


@functools.cache
def _listen() -> None:
    register_optimizer_step_post_hook(_count)


def _count(optimizer: Optimizer, args: tuple[Any, ...], kwargs: dict[str, Any]) -> None:
    for world_model, count in list(_counts.items()):
        place = count.place(optimizer)
        counting = None if count.counts is None else count.counts()
        if place < len(count.trained) and (optimizer is counting or place <= count.place(counting)):
            count.counts = ref(optimizer)
            version = _version(world_model)
            version += version != count.after.to(version.device) + 1
            restart_count(world_model)
