"""Counts the updates of a world model, whatever pipeline makes them."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterable
from typing import Any, cast
from weakref import ReferenceType, finalize, ref

from torch import Tensor, nn
from torch.optim import Optimizer
from torch.optim.optimizer import register_optimizer_step_post_hook

from torchrl_etdmpc.modules import WorldModel


@dataclasses.dataclass(eq=False)
class _Count:
    world_model: ReferenceType[nn.Module]
    trained: tuple[nn.Parameter, ...]
    """In the model's order."""
    after: Tensor
    """The version that the last counted step left behind."""
    optimizer: ReferenceType[Optimizer] | None = None
    """The one whose steps are the updates: of those that have stepped and are still there, the one that holds the
    first parameter. It need not hold those that are frozen."""

    @property
    def version(self) -> Tensor | None:
        """The world model's, which a cast replaces; ``None`` once nobody holds the model."""
        world_model = self.world_model()
        return None if world_model is None else _version(world_model)

    def place(self, optimizer: Optimizer | None) -> int:
        """Of the first trainable parameter that the optimiser holds; behind all of them if there is none."""
        groups = [] if optimizer is None else optimizer.param_groups
        held = {id(parameter) for group in groups for parameter in group["params"]}
        places = (place for place, p in enumerate(self.trained) if p.requires_grad and id(p) in held)
        return next(places, len(self.trained))

    def restart(self, version: Tensor) -> None:
        """Takes this version as the one to go on from."""
        if self.after.device == version.device:
            self.after.copy_(version)  # in place: a captured CUDA graph goes on reading this memory
        else:
            self.after = version.clone()


_counts_by_parameter: dict[int, tuple[_Count, ...]] = {}
"""By the id of a trained parameter, which lives as long as its entry. A compiled step looks up the parameters of its
optimiser alone: models that come and go meanwhile are nothing to it."""


def count_updates(world_model: WorldModel, trained: Iterable[nn.Parameter]) -> None:
    """Lets every step of a PyTorch optimiser that trains the world model count as one in ``world_model.version``.

    A step is what every pipeline has: a target average is not there in a loss without values, and a backward pass need
    not be followed by a step. Where several optimisers share the networks out, that of the first one counts, from
    its first step on; of several that hold the first network each does.

    A line that counts by hand is harmless: after a step that somebody else has counted, the next one is not counted
    again, so that such a pipeline is one ahead and stays so.

    Args:
        world_model (WorldModel): the networks.
        trained (iterable of nn.Parameter): those of its parameters that a loss trains.
    """
    _listen()
    known = {id(parameter) for parameter in trained}
    count = _count_for(world_model)
    if count is None:
        count = _Count(ref(world_model), (), world_model.version.clone())
        finalize(world_model, _forget, count).atexit = False
    known |= {id(parameter) for parameter in count.trained}
    _forget(count)
    count.trained = tuple(parameter for parameter in world_model.parameters() if id(parameter) in known)
    count.restart(world_model.version)
    for parameter in count.trained:
        _counts_by_parameter[id(parameter)] = (*_counts_by_parameter.get(id(parameter), ()), count)


def restart_count(world_model: nn.Module) -> None:
    """Takes a version that was loaded, not counted, as the one to go on from."""
    count = _count_for(world_model)
    if count is not None:
        count.restart(_version(world_model))


def _version(world_model: nn.Module) -> Tensor:
    return cast(Tensor, world_model.version)  # get_buffer does not find it in one that torch.compile has wrapped


def _count_for(world_model: nn.Module) -> _Count | None:
    counts = _counts_of(world_model.parameters())
    return next((count for count in counts if count.world_model() is world_model), None)


def _counts_of(parameters: Iterable[Tensor]) -> list[_Count]:
    found = [count for parameter in parameters for count in _counts_by_parameter.get(id(parameter), ())]
    return list({id(count): count for count in found}.values())


def _forget(count: _Count) -> None:
    for parameter in count.trained:
        others = tuple(other for other in _counts_by_parameter.pop(id(parameter), ()) if other is not count)
        if others:
            _counts_by_parameter[id(parameter)] = others


@functools.cache
def _listen() -> None:
    register_optimizer_step_post_hook(_after_step)


def _after_step(optimizer: Optimizer, args: tuple[Any, ...], kwargs: dict[str, Any]) -> None:
    for count in _counts_of(parameter for group in optimizer.param_groups for parameter in group["params"]):
        place = count.place(optimizer)
        counting = None if count.optimizer is None else count.optimizer()
        if place < len(count.trained) and (optimizer is counting or place <= count.place(counting)):
            count.optimizer = ref(optimizer)
            version = count.version
            if version is not None:
                version += version != count.after.to(version.device) + 1
                count.restart(version)
