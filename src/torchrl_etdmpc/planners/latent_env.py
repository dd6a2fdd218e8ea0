"""The world model as a TorchRL environment, so that any TorchRL planner can drive it."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, unravel_key
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import ModelBasedEnvBase

from torchrl_etdmpc.keys import ACTION, DONE, LATENT, NEXT, OBSERVATION, REWARD, TERMINATED
from torchrl_etdmpc.modules.prediction import PredictionModel, device_and_dtype, require_prediction_model


class LatentEnv(ModelBasedEnvBase):
    """Imagined environment whose observation is the latent, for any batch of states (it is not batch-locked).

    A step rolls the chosen dynamics head; the reward is the expected one and the episode terminates where the model, if
    it predicts termination, says so with a probability above one half.

    The world model is shared, not copied, and stays on its device.

    Args:
        world_model (PredictionModel): the networks, an ``nn.Module``, e.g. a
            :class:`~torchrl_etdmpc.modules.WorldModel`.

    Keyword Args:
        head (int, optional): dynamics head to roll. Default: ``None``, the average of all heads' predictions.
        observation_key (NestedKey): what a reset encodes. Default: ``"observation"``.
        device (torch.device or str, optional): for a model without parameters and buffers; of any other the device is
            known. Default: PyTorch's own.
        dtype (torch.dtype, optional): the same. Default: PyTorch's own.

    Raises:
        TypeError: if the model lacks a member of :class:`~torchrl_etdmpc.modules.PredictionModel`.
        ValueError: if ``head`` does not exist.
        KeyError: at a reset from a tensordict that has neither a latent nor an observation, but something else.

    >>> from torchrl_etdmpc.modules import WorldModel
    >>> env = LatentEnv(WorldModel(3, 2, latent_dim=16, mlp_dim=32))
    >>> start = TensorDict({"observation": torch.zeros(5, 3)}, batch_size=[5])
    >>> env.rollout(4, tensordict=env.reset(start), auto_reset=False)["latent"].shape
    torch.Size([5, 4, 16])
    """

    world_model: PredictionModel

    def __init__(
        self,
        world_model: PredictionModel,
        *,
        head: int | None = None,
        observation_key: NestedKey = OBSERVATION,
        device: torch.device | str | None = None,
        dtype: torch.dtype | None = None,
    ) -> None:
        require_prediction_model(world_model)
        if head is not None and not 0 <= head < world_model.num_dynamics:
            raise ValueError(f"head must be in 0..{world_model.num_dynamics - 1} or None, got {head}.")
        device, dtype = device_and_dtype(world_model, device, dtype)
        super().__init__(world_model, device=device)  # pyright: ignore[reportArgumentType]  # any module will do
        self.head = head
        self.observation_key = unravel_key(observation_key)
        self._set_specs(device, dtype)

    def _apply(self, fn: Any, *args: Any, **kwargs: Any) -> Any:
        super()._apply(fn, *args, **kwargs)
        device, dtype = self.device_and_dtype()
        like = fn(torch.empty(0, device=device, dtype=dtype))  # where a model without parameters goes
        self._set_specs(*device_and_dtype(self.world_model, like.device, like.dtype))
        return self

    def follow(self) -> None:
        """Brings the specs to where the world model is now, which may have been moved or cast by who shares it."""
        device, dtype = self.device_and_dtype()
        spec = self.observation_spec[LATENT]
        if (spec.device, spec.dtype) != (device, dtype):
            self._set_specs(device, dtype)

    def _set_specs(self, device: torch.device, dtype: torch.dtype) -> None:
        """Specs of a world model that is here, in this dtype."""
        for specs in ("_input_spec", "_output_spec"):  # those of the flags too
            if specs in vars(self):
                vars(self)[specs] = vars(self)[specs].to(device)
        model, like = self.world_model, {"device": device, "dtype": dtype}
        self._device = device
        self.empty_cache()
        size = torch.Size([model.latent_dim])
        self.observation_spec = Composite({LATENT: Unbounded(size, **like)}, device=device)
        self.state_spec = Composite({LATENT: Unbounded(size, **like)}, device=device)
        self.action_spec = Bounded(-1.0, 1.0, shape=torch.Size([model.action_dim]), **like)
        self.reward_spec = Unbounded(torch.Size([1]), **like)

    def __getstate__(self) -> dict[str, Any]:
        # A collector leaves a weak reference to itself, which cannot be pickled and is not the copy's collector.
        return {**super().__getstate__(), "_collector": None}  # pyright: ignore[reportGeneralTypeIssues]

    def device_and_dtype(self) -> tuple[torch.device, torch.dtype]:
        """Where observations and latents go now: those of the world model, which may have been moved or cast."""
        spec = self.observation_spec[LATENT]
        return device_and_dtype(self.world_model, spec.device, spec.dtype)  # pyright: ignore[reportArgumentType]

    def _reset(self, tensordict: TensorDictBase | None, **kwargs: Any) -> TensorDictBase:
        """Starts from ``latent`` or encodes ``observation`` if given; from an all-zero observation otherwise.

        A model that encodes what it likes starts from an all-zero latent then.
        """
        if not torch.compiler.is_compiling():
            self.follow()
        model = self.world_model
        given = TensorDict(batch_size=self.batch_size) if tensordict is None else tensordict
        batch_size = given.batch_size
        latent, observation = given.get(LATENT, None), given.get(self.observation_key, None)
        if latent is None and observation is None:
            self._refuse_other_states(given)
            device, dtype = self.device_and_dtype()
            if model.observation_dim is None:
                latent = torch.zeros(*batch_size, model.latent_dim, device=device, dtype=dtype)
            else:
                observation = torch.zeros(*batch_size, model.observation_dim, device=device, dtype=dtype)
        if latent is None:
            latent = model.encode(observation)
        done = torch.zeros(*batch_size, 1, dtype=torch.bool, device=latent.device)
        return TensorDict({LATENT: latent, DONE: done, TERMINATED: done.clone()}, batch_size=batch_size)

    def _refuse_other_states(self, tensordict: TensorDictBase) -> None:
        """A tensordict of states under names that this environment does not know would start it from zeros."""
        own = {key for spec in (self.full_done_spec, self.full_reward_spec, self.full_action_spec) for key in spec}
        found = [key for key in tensordict.keys() if key not in own | {"_reset", NEXT}]
        if found:
            raise KeyError(
                f"LatentEnv starts from {LATENT!r} or {self.observation_key!r}, got {', '.join(map(repr, found))}; "
                "pass LatentEnv(..., observation_key=...)."
            )

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        model = self.world_model
        latent, action = tensordict.get(LATENT), tensordict.get(ACTION)
        heads = model.next(latent.unsqueeze(0), action)
        following = heads.mean(0) if self.head is None else heads[self.head]
        ended = model.termination(following)
        done = torch.zeros_like(action[..., :1], dtype=torch.bool) if ended is None else (ended > 0.5).unsqueeze(-1)
        return TensorDict(
            {
                LATENT: following,
                REWARD: model.reward(latent, action).unsqueeze(-1),
                DONE: done,
                TERMINATED: done.clone(),
            },
            batch_size=tensordict.batch_size,
        )

    def _set_seed(self, seed: int | None) -> None:
        pass  # deterministic
