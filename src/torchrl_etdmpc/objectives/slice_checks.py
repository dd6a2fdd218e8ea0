"""What is no slice of consecutive steps of one episode, and is refused or warned of.

``counts`` says which steps count, bool ``[B, T]``; ``None``: all of them. What depends on values is looked at on a CPU
alone, where it does not wait for the device, and not under ``torch.compile``.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase, is_tensor_collection
from torch import Tensor

from torchrl_etdmpc.keys import NEXT


def refuse_termination(
    tensordict: TensorDictBase, key: NestedKey, counts: Tensor | None, shape: torch.Size, owner: str
) -> None:
    """Raises where a step terminates and no termination head learns it."""
    if torch.compiler.is_compiling():
        return
    terminated = _flags(tensordict, key, "terminated", shape)
    if terminated is None:
        return
    if (terminated if counts is None else terminated & counts).any():
        raise ValueError(
            f"{key!r} holds True, but the world model has no termination head, so values would "
            "be bootstrapped through the end of an episode; build WorldModel(..., termination=True), or pass "
            f"{owner}(..., ignore_termination=True) if that is what you want."
        )


def refuse_gaps(tensordict: TensorDictBase, done_key: NestedKey, counts: Tensor | None, shape: torch.Size) -> None:
    """Steps must follow each other, one at a time: what n-step returns and episodes side by side do not."""
    if torch.compiler.is_compiling():
        return
    steps = tensordict.get("steps_to_next_obs", None)
    if steps is not None and steps.device.type == "cpu" and (steps != 1).any():
        raise ValueError(
            "'steps_to_next_obs' is not 1 everywhere: these losses learn single steps, and n-step rewards and "
            "observations would be taken for those of one; leave MultiStep out, value_replayed=... has n-step "
            "targets."
        )
    done = _flags(tensordict, done_key, "done", shape)
    if done is None:
        return
    inside = done[:, :-1]
    if (inside if counts is None else inside & counts[:, 1:]).any():
        raise ValueError(
            f"{done_key!r} is True before the last step of a slice, so that another episode follows in it; "
            "sample slices of one episode each (StepSliceSampler), or mask what follows (loss_mask_key)."
        )


def refuse_unknown_ends(
    tensordict: TensorDictBase,
    done_key: NestedKey,
    counts: Tensor | None,
    entries: Mapping[NestedKey, Any],
    key: NestedKey,
) -> None:
    """An episode's last observation, and a slice's, is learned like all others, so it must be there."""
    if torch.compiler.is_compiling() or entries["action"].device.type != "cpu":
        return
    shape = entries["action"].shape[:2]
    ends = _flags(tensordict, done_key, "done", shape)
    if ends is None:
        ends = torch.zeros(shape, dtype=torch.bool, device="cpu")  # whatever the default device is
    last = ends.clone()
    last[:, -1] = True
    if counts is not None:  # the last one that counts; those behind it repeat another
        last[:, :-1] |= ~counts[:, 1:]
    for what, rows in ((f"where {done_key!r} is True", ends), ("at the last step of a slice", last)):
        if rows.any() and not _all_finite(entries["next_observation"], rows):
            raise ValueError(
                f"{key!r} is not finite {what}: an environment with auto_reset=True has lost the last observations "
                "of its episodes, and compact_obs=True with NextStateReconstructor those of slices; collect "
                "without it, or mask these steps (loss_mask_key)."
            )


def warn_of_range(action: Tensor, key: NestedKey) -> None:
    """Actions of another range would be learned by a policy that cannot take them."""
    if not torch.compiler.is_compiling() and action.device.type == "cpu" and action.abs().max() > 1.001:
        warnings.warn(
            f"{key!r} leaves [-1, 1], where planner and policy look for actions; scale the data as ActionScaling "
            "scales an environment's actions.",
            stacklevel=4,
        )


def warn_of_holes(entries: Mapping[NestedKey, Any], counts: Tensor | None, keys: Mapping[NestedKey, NestedKey]) -> None:
    """What a step leads to is what the next one begins with, unless rows of other episodes or moments follow."""
    action = entries["action"]
    if torch.compiler.is_compiling() or action.device.type != "cpu" or action.shape[1] == 1:
        return
    apart = _differ(entries["observation"][:, 1:], entries["next_observation"][:, :-1])
    if (apart if counts is None else apart & counts[:, 1:]).any():
        warnings.warn(
            f"{keys['next_observation']!r} of a step is not {keys['observation']!r} of the next: the slices join "
            "rows of several episodes (sample with StepSliceSampler and unique ids), or rows are missing between "
            "them. Where an augmentation makes the two differ, ignore this.",
            stacklevel=4,
        )


def _flags(tensordict: TensorDictBase, key: NestedKey, name: str, shape: torch.Size) -> Tensor | None:
    """One flag for each step, bool ``[B, T]``; ``None`` where they are missing or not on a CPU."""
    flags = tensordict.get(key, None)
    if flags is None:
        _refuse_elsewhere(tensordict, key, name)
        return None
    if flags.numel() != shape.numel() or flags.shape[:2] != shape:
        raise ValueError(
            f"{key!r} must hold one flag for each step, here of shape {[*shape, 1]}, got {list(flags.shape)}; reduce "
            f"it, e.g. with .any(-1, keepdim=True), or name another key: loss.set_keys({name}=...)."
        )
    return flags.reshape(shape).bool() if flags.device.type == "cpu" else None


def _refuse_elsewhere(tensordict: TensorDictBase, key: NestedKey, name: str) -> None:
    """What is looked for under one key may stand under another, below ``"next"``, and would be taken to be missing."""
    following = tensordict.get(NEXT, None)
    if following is None:
        return
    others = [other for other in following.keys(True, True) if isinstance(other, tuple) and other[-1] == name]
    if others:
        raise ValueError(
            f"{key!r} is not in the batch, but {(NEXT, *others[0])!r} is; name it: loss.set_keys({name}={others[0]!r})."
        )


def _all_finite(entry: Any, rows: Tensor) -> bool:
    """Whether an entry ``[B, T, ...]``, or each of a dictionary, is finite in some rows ``[B, T]``."""
    if is_tensor_collection(entry):
        return all(_all_finite(value, rows) for value in entry.contiguous().values(True, True))
    return not entry.is_floating_point() or bool(entry[rows].isfinite().all())


def _differ(entry: Any, other: Any) -> Tensor:
    """Where two entries ``[B, T, ...]``, or any of two dictionaries, are not the same, bool ``[B, T]``."""
    if is_tensor_collection(entry):
        keys = entry.keys(True, True)
        return torch.stack([_differ(entry.get(key), other.get(key)) for key in keys]).any(0)
    differ = (entry != other) & (entry == entry)  # what is not a number is another fault
    return differ.reshape(*entry.shape[:2], -1).any(-1)
