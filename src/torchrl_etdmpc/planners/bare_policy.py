"""The policy without the planner."""

from __future__ import annotations

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from torchrl_etdmpc.envs.check import model_sizes
from torchrl_etdmpc.keys import ACTION, OBSERVATION
from torchrl_etdmpc.modules import PolicyModel
from torchrl_etdmpc.modules.prediction import require_policy
from torchrl_etdmpc.planners.primer import check_part


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

    def check_env(self, env: EnvBase, *, alone: bool = True) -> None:
        """Raises a ``ValueError`` that says what to append if an environment does not fit the model.

        :func:`~torchrl_etdmpc.collectors.evaluate` and :class:`~torchrl_etdmpc.collectors.StepCollector` ask it.

        Args:
            env (EnvBase): the environment.

        Keyword Args:
            alone (bool): whether this is the whole policy, so that what the environment lacks is a fault. Default:
                ``True``.
        """
        keys = {"observation_key": self.in_keys[0], "action_key": self.out_keys[0]}
        check_part(env, model_sizes(self.world_model) | keys, alone=alone)

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the mean action.

        Raises:
            KeyError: if there is no observation.
        """
        observation = tensordict.get(self.in_keys[0], None)
        if observation is None:
            raise KeyError(
                f"the policy needs {self.in_keys[0]!r} in its input; pass observation_key=... if your environment "
                "names it otherwise."
            )
        mean, _ = self.world_model.policy(self.world_model.encode(observation))
        return tensordict.set(self.out_keys[0], mean)
