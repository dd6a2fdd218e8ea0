"""A world model of TorchRL's own, as the planner sees one."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.envs import ExplorationType, ModelBasedEnvBase
from torchrl.envs.model_based import WorldModelEnv
from torchrl.envs.utils import set_exploration_type
from torchrl.modules import WorldModel

from torchrl_etdmpc.keys import ACTION, NEXT, OBSERVATION, REWARD
from torchrl_etdmpc.modules.prediction import device_and_dtype


class TorchRLModel(nn.Module):
    """A TorchRL world model as a :class:`~torchrl_etdmpc.modules.PredictionModel`, without a policy.

    The latent is what the model carries from step to step: its ``state_keys``, joined into one vector. Distributions
    that are TensorDict modules (``ProbabilisticTensorDictModule``) are rolled with their means; a model that draws by
    itself is refused, because its candidates would be compared by luck. A reward costs a step of the model, so that a
    plan costs about two steps for each of the candidates' actions.

    Args:
        model (nn.Module): an imagined environment (:class:`torchrl.envs.ModelBasedEnvBase`), or what steps in one: a
            :class:`torchrl.modules.WorldModel`, a :class:`torchrl.modules.WorldModelWrapper`, or any TensorDict module
            that reads states and ``action`` and writes reward and next states, at the root or below ``"next"``.

    Keyword Args:
        action_dim (int): A. The model takes actions in [-1, 1].
        state_sizes (mapping of NestedKey to int): the size of each state, e.g. ``{"belief": 32, "state": 8}``.
        encoder (nn.Module, optional): from observations to states: a TensorDict module that reads ``observation_key``
            and writes them, or a function from the observation to the latent. Default: that of a
            :class:`torchrl.modules.WorldModel`; otherwise the observation is the state.
        values (callable, optional): expected discounted return from a latent ``[..., L]`` on, ``[..., V]`` for V heads;
            or a TensorDict module that reads states and writes it, ``[..., 1]``. Default: zeros.
        termination (callable, optional): from a latent ``[..., L]`` to the probability ``[...]`` that the episode
            ended there. Default: nothing ends, whatever the model says of ``done``.
        observation_key, action_key, reward_key (NestedKey): the model's own names.

    Raises:
        TypeError: if the model is none of these.
        ValueError: if it does not write a state or the reward, or two steps from one state differ.

    >>> from tensordict.nn import TensorDictModule
    >>> from torchrl.modules import WorldModelWrapper
    >>> from torchrl_etdmpc import EnsembleMPPIPlanner, LatentEnv
    >>> move = TensorDictModule(lambda x, action: x + action, in_keys=["x", "action"], out_keys=["x"])
    >>> reward = TensorDictModule(lambda x: -x.abs(), in_keys=["x"], out_keys=["reward"])
    >>> model = TorchRLModel(WorldModelWrapper(move, reward), action_dim=1, state_sizes={"x": 1})
    >>> planner = EnsembleMPPIPlanner(LatentEnv(model), horizon=2, num_proposals=0, warm_start=False)
    >>> torch.manual_seed(0)
    <torch._C.Generator object at ...>
    >>> (planner.plan(torch.tensor([0.5]), explore=False).action + 0.5).abs().item() < 0.1
    True
    """

    version: Tensor
    num_dynamics = 1
    observation_dim = None

    def __init__(
        self,
        model: nn.Module,
        *,
        action_dim: int,
        state_sizes: dict[NestedKey, int] | dict[str, int],
        encoder: nn.Module | Callable[[Any], Tensor] | None = None,
        values: nn.Module | Callable[[Tensor], Tensor] | None = None,
        termination: Callable[[Tensor], Tensor] | None = None,
        observation_key: NestedKey = OBSERVATION,
        action_key: NestedKey = ACTION,
        reward_key: NestedKey = REWARD,
    ) -> None:
        super().__init__()
        if isinstance(model, WorldModelEnv):  # locked to one batch size, unlike what it wraps
            encoder = model._world_model.encoder if encoder is None else encoder
            model = model.world_model
        elif isinstance(model, WorldModel):
            encoder = model.encoder if encoder is None else encoder
            model = model.step_module
        if not isinstance(model, ModelBasedEnvBase | TensorDictModuleBase):
            raise TypeError(
                f"model must be a ModelBasedEnvBase or a TensorDict module, got {type(model).__name__}; wrap it: "
                "TensorDictModule(model, in_keys=[..., 'action'], out_keys=[..., 'reward'])."
            )
        self.model = model
        self.encoder, self.value, self.ended = encoder, values, termination
        self.action_dim = action_dim
        self.state_sizes: dict[NestedKey, int] = {unravel_key(key): size for key, size in state_sizes.items()}
        self.latent_dim = sum(self.state_sizes.values())
        self.observation_key, self.action_key = unravel_key(observation_key), unravel_key(action_key)
        self.reward_key = unravel_key(reward_key)
        self.register_buffer("version", torch.zeros((), dtype=torch.int64))
        self._require_written()
        self._refuse_draws()

    def _require_written(self) -> None:
        """A state that the model only reads would stay as it is in every imagined step."""
        steps = self.model
        if isinstance(steps, ModelBasedEnvBase):
            if type(steps)._step is not ModelBasedEnvBase._step:
                return  # its first step tells
            steps = steps.world_model
        written = [unravel_key(key) for key in steps.out_keys]
        for key in (*self.state_sizes, self.reward_key):
            if key not in written and unravel_key((NEXT, key)) not in written:
                raise _not_written(key, written)

    def _refuse_draws(self) -> None:
        device, dtype = device_and_dtype(self)
        if device.type == "meta":
            return
        with torch.random.fork_rng([device] if device.type == "cuda" else []), torch.no_grad():
            latent = torch.randn(1, 8, self.latent_dim, device=device, dtype=dtype)
            action = torch.rand(8, self.action_dim, device=device, dtype=dtype) * 2 - 1
            first, second = (self._step(latent, action) for _ in range(2))
        for key in (*self.state_sizes, self.reward_key):
            if not torch.allclose(first.get(key), second.get(key), rtol=1e-3, atol=1e-5, equal_nan=True):
                raise ValueError(
                    f"two steps of the model from one state differ in {key!r}: plans would be compared by luck. "
                    "Take the mean of what it draws as the state (of RSSMPrior: out_keys=[the state, '_std', "
                    "'_sample', the belief]), let a ProbabilisticTensorDictModule draw it, or call eval() on dropout."
                )

    def encode(self, observation: Any) -> Tensor:
        """What the encoder takes, or the states themselves, to latent ``[..., L]``."""
        if isinstance(self.encoder, TensorDictModuleBase):
            keys = list(map(unravel_key, self.encoder.in_keys)) or [self.observation_key]
            held = isinstance(observation, TensorDictBase) and all(key in observation.keys(True) for key in keys)
            if not held and len(keys) > 1:
                raise ValueError(
                    f"the encoder reads {keys}, so an observation must be a TensorDict that holds them, got "
                    f"{type(observation).__name__}; nest them below one key and name it with observation_key=."
                )
            read = {key: observation.get(key) for key in keys} if held else {keys[0]: observation}
            first = next(iter(self.encoder.parameters()), observation)
            # Which of the dimensions are the batch is the encoder's business.
            batch = [] if isinstance(observation, Tensor) else observation.shape
            return self._joined(self.encoder(TensorDict(read, batch, device=first.device)))
        if self.encoder is not None:
            return self.encoder(observation)
        return observation if isinstance(observation, Tensor) else self._joined(observation)

    def next(self, latent: Tensor, action: Tensor) -> Tensor:
        """Latent ``[1, ..., L]`` and an action that broadcasts to ``[1, ..., A]``, to ``[1, ..., L]``."""
        return self._joined(self._step(latent, action))

    def reward(self, latent: Tensor, action: Tensor) -> Tensor:
        """Reward of ``action [..., A]`` in ``latent [..., L]``, shape ``[...]``."""
        return self._step(latent, action).get(self.reward_key).squeeze(-1)

    def values(self, latent: Tensor) -> Tensor:
        """Value of ``latent [..., L]`` by each head, shape ``[..., V]``."""
        if self.value is None:
            return torch.zeros_like(latent[..., :1])
        if isinstance(self.value, TensorDictModuleBase):
            return self.value(self._states(latent)).get(self.value.out_keys[-1])
        return self.value(latent)

    def termination(self, latent: Tensor) -> Tensor | None:
        """Probability that the episode ended on reaching ``latent [..., L]``; ``None``: it never does."""
        return None if self.ended is None else self.ended(latent)

    def _states(self, latent: Tensor) -> TensorDict:
        parts = latent.split(list(self.state_sizes.values()), dim=-1)
        return TensorDict(dict(zip(self.state_sizes, parts, strict=True)), latent.shape[:-1], device=latent.device)

    def _joined(self, states: TensorDictBase) -> Tensor:
        return torch.cat([states.get(key) for key in self.state_sizes], dim=-1)

    def _step(self, latent: Tensor, action: Tensor) -> TensorDictBase:
        """States and reward after an action."""
        batch = torch.broadcast_shapes(latent.shape[:-1], action.shape[:-1])
        before = self._states(latent.expand(*batch, self.latent_dim).reshape(-1, self.latent_dim))
        before.set(self.action_key, action.expand(*batch, self.action_dim).reshape(-1, self.action_dim))
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            if isinstance(self.model, ModelBasedEnvBase):
                after: TensorDictBase = self.model.step(before).get(NEXT)  # at the root are the states before
            else:
                after = self.model(before)
        below: TensorDictBase = after.get(NEXT, after)
        found = {}
        for key in (*self.state_sizes, self.reward_key):
            value = below.get(key, None)
            value = after.get(key, None) if value is None else value
            if value is None:
                raise _not_written(key, list(below.keys(True, True)))
            found[key] = value
        return TensorDict(found, after.batch_size, device=after.device).reshape(batch)


def _not_written(key: NestedKey, written: list[NestedKey]) -> ValueError:
    return ValueError(
        f"the model does not write {key!r}, at the root or below 'next'; it writes {written}. Name what it writes in "
        "state_sizes and reward_key, or let it write a state that never changes as well."
    )
