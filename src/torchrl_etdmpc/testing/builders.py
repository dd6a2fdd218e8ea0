"""Small random inputs."""

from __future__ import annotations

import torch
from tensordict import TensorDict

from torchrl_etdmpc.keys import ACTION, DONE, NEXT, OBSERVATION, PLAN, REWARD, TARGETS, TERMINATED


def random_slices(
    observation_dim: int, action_dim: int, *, num_slices: int = 4, slice_len: int = 3, terminated: bool = False
) -> TensorDict:
    """Random slices with the default keys of the losses; successive observations agree as in real data.

    Args:
        observation_dim (int): O.
        action_dim (int): A.
        num_slices (int): B.
        slice_len (int): T.
        terminated (bool): whether half of the slices terminate at their last step.

    Returns:
        TensorDict: batch size [B, T].

    >>> random_slices(3, 2).batch_size
    torch.Size([4, 3])
    """
    observations = torch.randn(num_slices, slice_len + 1, observation_dim)
    flags = torch.zeros(num_slices, slice_len, 1, dtype=torch.bool)
    if terminated:
        flags[::2, -1] = True
    action = torch.rand(num_slices, slice_len, action_dim) * 2 - 1
    fields = (  # in the order of TARGETS
        torch.rand(num_slices, slice_len, action_dim) * 2 - 1,
        torch.rand(num_slices, slice_len, action_dim) + 0.1,
        torch.randn(num_slices, slice_len, 1),
        torch.zeros(num_slices, slice_len, 1, dtype=torch.int64),
    )
    return TensorDict(
        {
            OBSERVATION: observations[:, :-1],
            ACTION: action,
            PLAN: dict(zip(TARGETS, fields, strict=True)),
            NEXT: {
                OBSERVATION: observations[:, 1:].clone(),  # not the memory of the others
                REWARD: torch.rand(num_slices, slice_len, 1),
                TERMINATED: flags,
                DONE: flags.clone(),
            },
        },
        batch_size=[num_slices, slice_len],
    )
