"""The world model as a TorchRL environment, so that any TorchRL planner can drive it."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import ModelBasedEnvBase

from torchrl_etdmpc.modules import WorldModel


class LatentEnv(ModelBasedEnvBase):
    """Imagined environment whose observation is the latent, for any batch of states (it is not batch-locked).

    A step rolls the chosen dynamics head; the reward is the decoded expectation of the reward head and the episode
    terminates where the termination head, if there is one, says so with a probability above one half.

    The world model is shared, not copied, and stays on its device.

    Args:
        world_model (WorldModel): the networks.
        head (int, optional): dynamics head to roll. Default: ``None``, the average of all heads' predictions.

    Raises:
        ValueError: if ``head`` does not exist.

    >>> env = LatentEnv(WorldModel(3, 2, latent_dim=16, mlp_dim=32))
    >>> start = TensorDict({"observation": torch.zeros(5, 3)}, batch_size=[5])
    >>> env.rollout(4, tensordict=env.reset(start), auto_reset=False)["latent"].shape
    torch.Size([5, 4, 16])
    """

    def __init__(self, world_model: WorldModel, *, head: int | None = None) -> None:
        if head is not None and not 0 <= head < world_model.num_dynamics:
            raise ValueError(f"head must be in 0..{world_model.num_dynamics - 1} or None, got {head}.")
        like = {"device": world_model.bins.device, "dtype": world_model.bins.dtype}
        super().__init__(world_model, device=like["device"])
        self.head = head
        size = (world_model.latent_dim,)
        self.observation_spec = Composite(latent=Unbounded(size, **like))
        self.state_spec = Composite(latent=Unbounded(size, **like))
        self.action_spec = Bounded(-1.0, 1.0, shape=(world_model.action_dim,), **like)
        self.reward_spec = Unbounded((1,), **like)

    def _reset(self, tensordict: TensorDictBase | None, **kwargs) -> TensorDictBase:
        """Starts from ``latent`` or encodes ``observation`` if given; from an all-zero observation otherwise."""
        model = self.world_model
        if tensordict is None or ("latent" not in tensordict.keys() and "observation" not in tensordict.keys()):
            batch_size = self.batch_size if tensordict is None else tensordict.batch_size
            latent = model.encode(model.bins.new_zeros(*batch_size, model.observation_dim))
        elif "latent" in tensordict.keys():
            batch_size, latent = tensordict.batch_size, tensordict.get("latent")
        else:
            batch_size, latent = tensordict.batch_size, model.encode(tensordict.get("observation"))
        done = torch.zeros(*batch_size, 1, dtype=torch.bool, device=latent.device)
        return TensorDict({"latent": latent, "done": done, "terminated": done.clone()}, batch_size=batch_size)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        model = self.world_model
        latent, action = tensordict.get("latent"), tensordict.get("action")
        heads = model.next(latent.unsqueeze(0), action)
        following = heads.mean(0) if self.head is None else heads[self.head]
        ended = model.termination(following)
        done = torch.zeros_like(action[..., :1], dtype=torch.bool) if ended is None else (ended > 0.5).unsqueeze(-1)
        return TensorDict(
            {
                "latent": following,
                "reward": model.reward(latent, action).unsqueeze(-1),
                "done": done,
                "terminated": done.clone(),
            },
            batch_size=tensordict.batch_size,
        )

    def _set_seed(self, seed: int | None) -> None:
        pass  # deterministic
