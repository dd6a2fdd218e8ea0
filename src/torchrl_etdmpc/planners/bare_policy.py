"""The policy without the planner."""

from __future__ import annotations

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase

from torchrl_etdmpc.keys import ACTION, OBSERVATION
from torchrl_etdmpc.modules import PolicyModel
from torchrl_etdmpc.modules.prediction import require_policy


class BarePolicy(TensorDictModuleBase):
    """The policy network without the planner: acts with its mean.

    Args:
        world_model (PolicyModel): encoder and policy.

    Keyword Args:
        observation_key, action_key (NestedKey): tensordict keys.

    Raises:
        TypeError: if the model has no policy.

    >>> from tensordict import TensorDict
    >>> from torchrl_etdmpc.modules import WorldModel
    >>> policy = BarePolicy(WorldModel(3, 2, latent_dim=16, mlp_dim=32))
    >>> policy(TensorDict({"observation": torch.zeros(5, 3)}, batch_size=[5]))["action"].shape
    torch.Size([5, 2])
    """

    def __init__(
        self,
        world_model: PolicyModel,
        *,
        observation_key: NestedKey = OBSERVATION,
        action_key: NestedKey = ACTION,
    ) -> None:
        super().__init__()
        self.world_model = require_policy(world_model, "BarePolicy")
        self.in_keys = [observation_key]  # pyright: ignore[reportAttributeAccessIssue]
        self.out_keys = [action_key]  # pyright: ignore[reportAttributeAccessIssue]

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the mean action."""
        mean, _ = self.world_model.policy(self.world_model.encode(tensordict.get(self.in_keys[0])))
        return tensordict.set(self.out_keys[0], mean)
