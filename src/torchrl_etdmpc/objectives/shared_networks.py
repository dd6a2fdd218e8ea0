"""A loss that shares the networks of a world model with whoever plans with them."""

from __future__ import annotations

import copy
import math
import warnings
from collections.abc import Collection, Mapping
from typing import Any, ClassVar

import torch
from tensordict import TensorDict, TensorDictParams
from torch import Tensor, nn
from torchrl.objectives import LossModule

from torchrl_etdmpc.modules import WorldModel
from torchrl_etdmpc.modules.new_weights import draw_new_weights
from torchrl_etdmpc.objectives.update_count import count_updates, restart_count


class SharedNetworksLoss(LossModule):
    """A loss whose parameters are the very ones of a world model's networks, with targets that follow some of them.

    It moves, casts, copies, saves and restores its networks so that planner, loss and optimiser go on holding the same
    parameters, and refuses weights that are no longer those which it trains. Its own buffers of no dimension
    (coefficients, running scales) are assigned in place and never have fewer than 32 bits.

    Args:
        world_model (WorldModel): the networks, shared with the caller.
    """

    world_model: WorldModel
    # Each loss has those of the following that its terms train or follow.
    encoder: nn.Module
    encoder_params: TensorDictParams
    target_encoder_params: TensorDictParams
    dynamics: nn.Module
    dynamics_params: TensorDictParams
    target_dynamics_params: TensorDictParams
    reward: nn.Module
    reward_params: TensorDictParams
    target_reward_params: TensorDictParams
    value: nn.Module
    value_params: TensorDictParams
    target_value_params: TensorDictParams
    termination: nn.Module
    termination_params: TensorDictParams
    target_termination_params: TensorDictParams
    policy: nn.Module
    policy_params: TensorDictParams
    target_policy_params: TensorDictParams
    _target_value: Any
    _trained: dict[str, tuple[Tensor | None, set[int]]]
    """First parameter of each network, and the ids of all: by these a parameter that was replaced is noticed."""

    _attributes: ClassVar[dict[str, str]] = {
        "encoder": "encoder",
        "dynamics": "dynamics",
        "reward": "reward_head",
        "value": "value_head",
        "termination": "termination_head",
        "policy": "policy",
    }
    """Of the world model, by the loss' name for the network."""

    def __init__(self, world_model: WorldModel) -> None:
        super().__init__()
        vars(self)["world_model"] = world_model  # not a submodule: its parameters are here already
        _warn_of_untrained(world_model, self._attributes.values())
        self._trained = {}

    def _share_networks(self, trained: Collection[str], followed: Collection[str]) -> None:
        """Takes the networks of these names, and makes targets of those that are followed."""
        for name, attribute in self._attributes.items():
            network = getattr(self.world_model, attribute)
            if name in trained and network is not None:
                self.convert_to_functional(network, name, create_target_params=name in followed)
        # A module that is called with the targets' weights holds them while it runs, and a planner in another thread
        # would read them: target values are computed by a copy that has no weights.
        value_head = self.world_model.value_head
        vars(self)["_target_value"] = copy.deepcopy(value_head).to("meta") if "value" in followed else None

    def _shared(self) -> list[str]:
        """Names of the networks that this loss has."""
        return [name for name in self._attributes if f"{name}_params" in self._modules]

    def _followed(self) -> list[tuple[str, Any, Any]]:
        """Of each network with a target: its name, the entries of the target and its own."""
        names = [name.removeprefix("target_") for name in self._modules if name.startswith("target_")]
        return [(name.removesuffix("_params"), self._modules[f"target_{name}"], self._modules[name]) for name in names]

    def _scalars(self) -> dict[str, Tensor]:
        """The loss' own buffers of no dimension."""
        own = vars(self).get("_buffers", {})  # which are not there yet while the base class is constructed
        return {name: buffer for name, buffer in own.items() if buffer is not None and buffer.ndim == 0}

    def __setattr__(self, name: str, value: Any) -> None:
        # TorchRL has a list of such buffers for a class; here each loss has those of its terms.
        number = isinstance(value, int | float) or (isinstance(value, Tensor) and value.ndim == 0)
        buffer = self._scalars().get(name) if number else None
        if buffer is None:
            super().__setattr__(name, value)  # pyright: ignore[reportArgumentType]  # TorchRL's annotation is too narrow
        else:
            buffer.fill_(value)  # a tensor's value as well: the buffer stays where it is

    def _apply(self, fn, *args, **kwargs):
        scalars = self._scalars()
        super()._apply(fn, *args, **kwargs)
        for name, exact in scalars.items():
            now = self.get_buffer(name)
            # In bfloat16 a discount of 0.99 is 0.988, and a scale of 10 that moves by a hundredth stays 10.
            if now.element_size() < 4:
                self.register_buffer(name, exact.to(now.device))
        self.world_model._apply(fn)  # its buffers must follow a cast
        self._read_networks()  # a cast keeps parameters and replaces buffers
        return self

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        self._trained = {}
        # A copy or an unpickled loss gets the networks as one object graph (they stand in __dict__, where
        # convert_to_functional put them), but tensordict clones its entries: the loss would train weights that nobody
        # reads. The targets are nobody else's and stay as copied.
        self._read_networks()
        count_updates(self.world_model, self.parameters())

    def _read_networks(self) -> None:
        """Makes the entries of <name>_params the very parameters and buffers of the world model's networks again.

        Planner, loss and updater rely on it.
        """
        for name in self._shared():
            self._modules[f"{name}_params"] = TensorDict.from_module(self.__dict__[name], as_module=True)

    def _holds_other_buffers(self, name: str) -> bool:
        """Whether a network has got other buffers since they were read, as by a cast of the world model alone."""
        held: Any = self._modules[f"{name}_params"]
        known = {value.data_ptr() for value in held.values(True, True) if not isinstance(value, nn.Parameter)}
        return known != {buffer.data_ptr() for buffer in self.__dict__[name].buffers()}

    def _save_to_state_dict(self, destination: dict[str, Any], prefix: str, keep_vars: bool) -> None:
        self._refuse_other_weights()
        if any(map(self._holds_other_buffers, self._shared())):
            self._read_networks()
        super()._save_to_state_dict(destination, prefix, keep_vars)
        # The world model is not a submodule, but who restores the weights restores the number of updates in them.
        destination[f"{prefix}version"] = self.world_model.version.detach()
        if not {"reward", "value"}.isdisjoint(self._shared()):  # whose weights mean nothing without them
            destination[f"{prefix}bins"] = self.world_model.bins.detach()

    def _load_from_state_dict(self, state_dict, prefix, *args) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        self._refuse_other_networks({k.removeprefix(prefix): v for k, v in state_dict.items() if k.startswith(prefix)})
        others = (f"{prefix}version", f"{prefix}bins")  # files of before lack them
        super()._load_from_state_dict({k: v for k, v in state_dict.items() if k not in others}, prefix, *args)
        version = state_dict.get(others[0])
        if version is not None:
            self.world_model.version.copy_(version)
            restart_count(self.world_model)

    def _refuse_other_networks(self, state: Mapping[str, Any]) -> None:
        """Raises before anything is overwritten; a tensordict that does not fit says nothing of where."""
        networks = {name for name in self._modules if name.endswith("_params")}
        networks &= {name.partition(".")[0] for name in state}
        own, given = (
            {name: value for name, value in entries.items() if name.partition(".")[0] in networks}
            for entries in (self.state_dict(), state)
        )
        faults = [
            f"{name} is {list(given[name].shape)} there and {list(value.shape)} here"
            if name in given
            else f"it lacks {name}"
            for name, value in own.items()
            if name not in given or given[name].shape != value.shape
        ]
        faults += [f"it has {name}" for name in given if name not in own]
        bins = self.world_model.bins
        if "bins" in state and not bins.is_meta:  # files of before lack them
            there, here = state["bins"][[0, -1]].tolist(), bins[[0, -1]].tolist()
            # Those of a state in half precision are rounded to within 2^-8.
            if not all(math.isclose(*ends, rel_tol=2**-8) for ends in zip(there, here, strict=True)):
                faults.append(f"its bins reach from {there[0]:g} to {there[1]:g}, here from {here[0]:g} to {here[1]:g}")
        if faults:
            more = f", and {len(faults) - 1} more" if faults[1:] else ""
            raise RuntimeError(f"the state is of another world model: {faults[0]}{more}; build this one like that one.")

    def _refuse_other_weights(self) -> None:
        if torch.compiler.is_compiling():
            return
        for name in self._shared():
            attribute = self._attributes[name]
            held: Any = self._modules[f"{name}_params"]
            # An encoder may begin with buffers, and have nothing else.
            own = (value for value in held.values(True, True) if isinstance(value, nn.Parameter))
            network, first = getattr(self.world_model, attribute), next(own, None)
            now = next(network.parameters(), None)
            if name not in self._trained or self._trained[name][0] is not first:
                parameters = () if first is None else (first, *own)
                self._trained[name] = first, {id(parameter) for parameter in parameters}
            if now is not first or {id(parameter) for parameter in network.parameters()} != self._trained[name][1]:
                raise RuntimeError(
                    f"the weights of world_model.{attribute} are others than this loss trains: load_state_dict("
                    "assign=True), a new module or layer and to_module() put other parameters there; load without "
                    "assign, build the loss and its optimizer afterwards, and end a swap before the loss is called."
                )
            target: Any = self._modules.get(f"target_{name}_params")
            if target is None or now is None:
                continue
            entry = next(iter(target.values(True, True)))
            if (entry.dtype, entry.device) != (now.dtype, now.device):
                raise RuntimeError(
                    f"world_model.{attribute} is {now.dtype} on {now.device}, its targets are {entry.dtype} on "
                    f"{entry.device}; move or cast the loss, which takes the world model along: loss.to(...)."
                )

    def reset_parameters_recursive(self) -> None:
        """Draws new weights for the networks that this loss trains; target parameters become copies of the new ones."""
        for name in self._shared():
            draw_new_weights(self.__dict__[name])
        for _, target, own in self._followed():
            target.data.update_(own.data)

    def network_parameters(self) -> dict[str, list[nn.Parameter]]:
        """Every parameter of this loss, once, by its network: of the world model, or of a term that brings its own."""
        found: dict[str, list[nn.Parameter]] = {}
        for name, parameter in self.named_parameters():  # lists a parameter that is shared once
            found.setdefault(name.partition(".")[0].removesuffix("_params"), []).append(parameter)
        return found

    def target_parameters(self) -> dict[str, list[tuple[Tensor, nn.Parameter]]]:
        """Each parameter of a target network and the trained one that it follows, by network."""
        found: dict[str, list[tuple[Tensor, nn.Parameter]]] = {}
        for name, target, own in self._followed():
            pairs = [(target.get(key), own.get(key)) for key in target.keys(True, True)]
            found[name] = [pair for pair in pairs if isinstance(pair[1], nn.Parameter) and pair[1].requires_grad]
        return found

    def targets(self) -> dict[str, dict[str, Tensor]]:
        """What the target networks are made of, by network and name: their parameters, and the network's own buffers.

        ``SoftUpdate`` moves parameters alone, and a target whose statistics stay where they began is another network.
        """
        found: dict[str, dict[str, Tensor]] = {}
        for name, target, own in self._followed():
            entries = found[name] = {}
            for key in target.keys(True, True):
                value = own.get(key)
                trained = isinstance(value, nn.Parameter)
                entry = target.get(key).data if trained else value.detach().clone()  # it moves before it is read
                entries[key if isinstance(key, str) else ".".join(key)] = entry
        return found


def _warn_of_untrained(world_model: WorldModel, trained: Collection[str]) -> None:
    networks = [network for name in trained if (network := getattr(world_model, name)) is not None]
    known = {id(parameter) for network in networks for parameter in network.parameters()}
    left = [name for name, p in world_model.named_parameters() if p.requires_grad and id(p) not in known]
    if others := sorted({name.removeprefix("_orig_mod.").partition(".")[0] for name in left}):
        warnings.warn(
            f"no loss trains or saves {', '.join(others)} of {type(world_model).__name__}; put it into one of its "
            "networks, such as the encoder, or into a Term that is a module, or freeze it with requires_grad_(False).",
            stacklevel=5,
        )
