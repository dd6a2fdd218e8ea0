"""MPPI over the return estimates of a dynamics ensemble."""

from __future__ import annotations

import warnings
from typing import Literal

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from torch import Tensor, nn
from torch.func import functional_call
from torchrl.data import Unbounded
from torchrl.envs import ExplorationType, TensorDictPrimer
from torchrl.envs.utils import exploration_type
from torchrl.modules import MPCPlannerBase

from torchrl_etdmpc.envs.latent import LatentEnv
from torchrl_etdmpc.functional import (
    Gaussian,
    clipped_sample,
    elite_weights,
    fit_gaussian,
    sample_elite,
    sample_sequences,
    select_elites,
    shift_plan,
)
from torchrl_etdmpc.planners.imagination import imagined_returns, propose_sequences
from torchrl_etdmpc.planners.plan import Plan, PlanNoise, PlanTrace
from torchrl_etdmpc.planners.scores import Score, make_score

FirstAction = Literal["elite", "mean", "best"]


class EnsembleMPPIPlanner(MPCPlannerBase):
    """Model predictive path integral control with an ensemble of dynamics and value heads (thesis 3.4).

    Each candidate action sequence is rolled through every dynamics head; the table of return estimates over depths,
    dynamics heads and value heads (thesis Eq. 3.1) is reduced to a score by ``score``. The planner acts on a real
    environment (it reads ``observation``) as well as on the :class:`LatentEnv` it holds (it reads ``latent``).

    It obeys :func:`torchrl.envs.utils.exploration_type`: with ``RANDOM`` (a collector's default) the action is a sample
    and the target's mean comes from ``first_action``; otherwise the action is the mean from ``eval_first_action``.

    The warm start travels in the tensordict: append :meth:`make_tensordict_primer` to the environment, which zeroes it
    at every reset and without which rollouts and collectors drop it. Where the input holds an ``InitTracker``'s
    ``is_init``, a plan is zeroed at the start of its episode in any case. With no plan in the input the planner starts
    cold, and warns once unless all episodes have just begun.

    Args:
        env (LatentEnv): the world model as an environment.

    Keyword Args:
        horizon (int): H, actions per sequence. Default: 6.
        num_samples (int): N, candidates per iteration, proposals included. Default: 512.
        num_elites (int): K. Default: 64.
        num_proposals (int): P, sequences proposed by the policy, spread over the dynamics heads round-robin. They are
            scored once per call. Default: 24.
        iterations (int): Default: 6.
        extra_iterations (int): added if the action has more than ``large_action_dim`` dimensions. Default: 2.
        large_action_dim (int): Default: 20.
        score (str or callable): ``"final"``, ``"mean"``, ``"adaptive"`` or a callable from the return table
            ``[..., D, F, V]`` to ``[...]``. Default: ``"mean"``.
        beta (float): penalty on the ensemble's standard deviation, for a named score. Default: 0.
        discount (float): gamma, in (0, 1]. Default: 0.99.
        inverse_temperature (float): of the elites' weights (the lineage calls it "temperature"). Default: 0.5.
        std_min (float): Default: 0.05.
        std_max (float): initial and largest standard deviation. Default: 2.
        first_action (str): ``"elite"`` (one elite drawn by its weight; BMPC), ``"mean"`` (the fitted mean; the thesis'
            formula) or ``"best"`` (highest-scoring candidate of the last iteration). Default: ``"elite"``.
        eval_first_action (str): the same, when not exploring. Default: ``"best"``.
        warm_start (bool): whether to carry the plan from step to step. Default: ``True``.
        scoring_dtype (torch.dtype, optional): in which candidates are rolled and scored, e.g. ``torch.bfloat16``; the
            weights are cast once per call, and returns are summed in the weights' own dtype. Default: ``None``, that of
            the weights.
        proposal_log_std_bounds (tuple of float, optional): bounds of the policy's log std while it proposes; BMPC
            widens them to (-2, 1) for reanalyze. Default: the policy's own.
        observation_key, action_key, is_init_key, plan_mean_key (NestedKey): tensordict keys.
        latent_key (NestedKey, optional): where a :class:`LatentEnv` holds its state. ``None``: plan from observations
            only. Default: ``"latent"``.
        plan_key (NestedKey): root of the target: ``loc``, ``scale``, ``value``, ``version`` and ``fallback`` below it.

    Raises:
        ValueError: if an argument is out of range.

    >>> from tensordict import TensorDict
    >>> from torchrl_etdmpc.modules import WorldModel
    >>> env = LatentEnv(WorldModel(3, 2, latent_dim=16, mlp_dim=32))
    >>> planner = EnsembleMPPIPlanner(env, horizon=3, num_samples=32, num_elites=8, num_proposals=4, warm_start=False)
    >>> planner(TensorDict({"observation": torch.zeros(5, 3)}, batch_size=[5]))["plan", "loc"].shape
    torch.Size([5, 2])
    """

    def __init__(
        self,
        env: LatentEnv,
        *,
        horizon: int = 6,
        num_samples: int = 512,
        num_elites: int = 64,
        num_proposals: int = 24,
        iterations: int = 6,
        extra_iterations: int = 2,
        large_action_dim: int = 20,
        score: str | Score = "mean",
        beta: float = 0.0,
        discount: float = 0.99,
        inverse_temperature: float = 0.5,
        std_min: float = 0.05,
        std_max: float = 2.0,
        first_action: FirstAction = "elite",
        eval_first_action: FirstAction = "best",
        warm_start: bool = True,
        scoring_dtype: torch.dtype | None = None,
        proposal_log_std_bounds: tuple[float, float] | None = None,
        observation_key: NestedKey = "observation",
        latent_key: NestedKey | None = "latent",
        action_key: NestedKey = "action",
        is_init_key: NestedKey = "is_init",
        plan_mean_key: NestedKey = "plan_mean",
        plan_key: NestedKey = "plan",
    ) -> None:
        if not isinstance(env, LatentEnv):
            raise TypeError(
                f"EnsembleMPPIPlanner needs a LatentEnv, got {type(env).__name__}; wrap the networks: "
                "LatentEnv(world_model)."
            )
        for name, number in {"horizon": horizon, "iterations": iterations, "num_elites": num_elites}.items():
            if number < 1:
                raise ValueError(f"{name} must be at least 1, got {number}.")
        if num_elites > num_samples:
            raise ValueError(f"num_elites must be at most num_samples={num_samples}, got {num_elites}.")
        if not 0 <= num_proposals < num_samples:
            raise ValueError(f"num_proposals must be in [0, num_samples={num_samples}), got {num_proposals}.")
        if extra_iterations < 0 or inverse_temperature < 0:
            raise ValueError(
                f"extra_iterations and inverse_temperature must not be negative, got {extra_iterations} and "
                f"{inverse_temperature}."
            )
        if not 0 < std_min <= std_max:
            raise ValueError(f"std_min and std_max must satisfy 0 < std_min <= std_max, got {std_min} and {std_max}.")
        if not 0 < discount <= 1:
            raise ValueError(f"discount must be in (0, 1], got {discount}.")
        if scoring_dtype is not None and not scoring_dtype.is_floating_point:
            raise ValueError(f"scoring_dtype must be a floating point dtype, got {scoring_dtype}.")
        for name, choice in {"first_action": first_action, "eval_first_action": eval_first_action}.items():
            if choice not in ("elite", "mean", "best"):
                raise ValueError(f"{name} must be 'elite', 'mean' or 'best', got {choice!r}.")
        super().__init__(env, action_key=action_key)
        del self._modules["env"]  # the base class registers it twice; the state dict should list the weights once
        self.__dict__["env"] = env
        self.horizon = horizon
        self.num_samples = num_samples
        self.num_elites = num_elites
        self.num_proposals = num_proposals
        self.iterations = iterations + (extra_iterations if self.world_model.action_dim > large_action_dim else 0)
        self.score = make_score(score, beta)
        self.discount = discount
        self.inverse_temperature = inverse_temperature
        self.std_min = std_min
        self.std_max = std_max
        self.first_action = first_action
        self.eval_first_action = eval_first_action
        self.warm_start = warm_start
        self.scoring_dtype = scoring_dtype
        self.__dict__["_imagination"] = _Imagination(env.world_model)
        self.proposal_log_std_bounds = proposal_log_std_bounds
        self.observation_key = unravel_key(observation_key)
        self.latent_key = None if latent_key is None else unravel_key(latent_key)
        self.is_init_key = unravel_key(is_init_key)
        self.plan_mean_key = unravel_key(plan_mean_key)
        self.next_plan_mean_key = unravel_key(("next", plan_mean_key))
        self.plan_keys = {
            name: unravel_key((plan_key, name)) for name in ("loc", "scale", "value", "version", "fallback")
        }
        self._warned_cold = False
        carried = [self.is_init_key, self.plan_mean_key] if warm_start else []
        self.in_keys = [self.observation_key, *carried]
        self.out_keys = [
            unravel_key(action_key),
            *self.plan_keys.values(),
            *([self.next_plan_mean_key] if warm_start else []),
        ]

    @property
    def world_model(self):
        """The networks that the planner reads."""
        return self.env.world_model

    def make_tensordict_primer(self) -> TensorDictPrimer:
        """Transform that adds the warm start to an environment's reset and zeroes it there.

        Collectors find it by themselves (``auto_register_policy_transforms=True``).
        """
        spec = Unbounded((self.horizon, self.world_model.action_dim))
        return TensorDictPrimer({self.plan_mean_key: spec}, default_value=0.0, expand_specs=True)

    def planning(self, td: TensorDictBase) -> Tensor:
        """Plans and returns the action alone (the interface of TorchRL's planners)."""
        return self(td.copy()).get(self.out_keys[0])

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase, tensordict_out: TensorDictBase | None = None) -> TensorDictBase:
        """Plans for every state of the batch and writes action, target and warm start.

        Args:
            tensordict (TensorDictBase): ``observation [..., O]`` or ``latent [..., L]``, and for the warm start
                ``plan_mean [..., H, A]`` and ``is_init [..., 1]``, each optional.
            tensordict_out (TensorDictBase, optional): where to write. Default: ``tensordict``.

        Raises:
            KeyError: if neither an observation nor a latent is present.
            ValueError: if both are present.
        """
        observation = tensordict.get(self.observation_key, None)
        latent = None if self.latent_key is None else tensordict.get(self.latent_key, None)
        if observation is None and latent is None:
            either = "" if self.latent_key is None else f" (or {self.latent_key!r})"
            raise KeyError(
                f"the planner needs {self.observation_key!r}{either} in its input; pass observation_key=... if your "
                "environment names it otherwise."
            )
        if observation is not None and latent is not None:
            raise ValueError(
                f"the planner found both {self.observation_key!r} and {self.latent_key!r} in its input and cannot tell "
                "which one is current; exclude one of them, or pass latent_key=None to plan from observations only."
            )
        explore = exploration_type() is ExplorationType.RANDOM
        carried, carry = self._read_warm_start(tensordict)
        plan = self.plan(observation, carried, latent=latent, explore=explore)
        outputs = {
            self.out_keys[0]: plan.action,
            self.plan_keys["loc"]: plan.loc,
            self.plan_keys["scale"]: plan.scale,
            self.plan_keys["value"]: plan.value.unsqueeze(-1),
            self.plan_keys["version"]: self.world_model.version.expand(*plan.value.shape, 1).clone(),
            self.plan_keys["fallback"]: plan.fallback.unsqueeze(-1),
        }
        if carry:
            outputs[self.next_plan_mean_key] = plan.mean
        out = tensordict if tensordict_out is None else tensordict_out
        for key, value in outputs.items():
            out.set(key, value)
        return out

    def _read_warm_start(self, tensordict: TensorDictBase) -> tuple[Tensor | None, bool]:
        """The carried plan (zeroed where an episode starts), and whether to carry this one on."""
        if not self.warm_start:
            return None, False
        carried = tensordict.get(self.plan_mean_key, None)
        is_init = tensordict.get(self.is_init_key, None)
        if carried is None:
            if not self._warned_cold and (is_init is None or not is_init.all()):
                self._warned_cold = True
                warnings.warn(
                    f"{self.plan_mean_key!r} is not in the planner's input, so every plan starts cold; append "
                    "planner.make_tensordict_primer() to the environment or pass warm_start=False.",
                    stacklevel=3,
                )
            return None, is_init is not None
        if is_init is not None:
            carried = torch.where(is_init.unsqueeze(-1), torch.zeros_like(carried), carried)
        return carried, True

    def draw_noise(self, *batch_size: int, generator: torch.Generator | None = None) -> PlanNoise:
        """Draws the random numbers of one :meth:`plan` call for a leading batch, on the world model's device."""
        actions = (self.horizon, self.world_model.action_dim)
        free = self.num_samples - self.num_proposals
        options = {"generator": generator, "device": self.world_model.bins.device, "dtype": self.world_model.bins.dtype}
        return PlanNoise(
            proposals=torch.randn(*batch_size, self.num_proposals, *actions, **options),
            candidates=torch.randn(*batch_size, self.iterations, free, *actions, **options),
            elite=torch.rand(*batch_size, self.num_elites, **options),
            action=torch.randn(*batch_size, actions[-1], **options),
        )

    @torch.no_grad()
    def plan(
        self,
        observation: Tensor | None = None,
        plan_mean: Tensor | None = None,
        *,
        latent: Tensor | None = None,
        explore: bool = True,
        noise: PlanNoise | None = None,
        trace: bool = False,
    ) -> Plan:
        """Plans for every state independently: a pure function of tensors, weights and noise (thesis 3.2).

        Args:
            observation (Tensor, optional): ``[..., O]``.
            plan_mean (Tensor, optional): the previous call's ``Plan.mean``, ``[..., H, A]``; it is shifted here.
                Default: zeros.
            latent (Tensor, optional): ``[..., L]``, instead of the observation.
            explore (bool): a training action (sampled, ``first_action``) or an evaluation action.
            noise (PlanNoise, optional): from :meth:`draw_noise`. Default: drawn here.
            trace (bool): whether to return every iteration.

        Returns:
            Plan: see its fields.
        """
        if latent is None:
            latent = self.world_model.encode(observation)
        batch = latent.shape[:-1]
        latent = latent.reshape(-1, latent.shape[-1])
        states = latent.shape[0]
        if noise is None:
            noise = self.draw_noise(states)
        elif len(batch) != 1:
            noise = PlanNoise(*(draw.reshape(states, *draw.shape[len(batch) :]) for draw in noise))
        shape = (states, self.horizon, self.world_model.action_dim)
        start = latent.new_zeros(shape) if plan_mean is None else shift_plan(plan_mean.reshape(shape))
        gaussian = Gaussian(start, torch.full_like(start, self.std_max))

        weights_cast = self._cast_weights()
        if self.num_proposals:
            bounds = self.proposal_log_std_bounds
            proposals = propose_sequences(self.world_model, latent, noise.proposals, bounds)
        steps = []
        for iteration in range(self.iterations):
            actions = sample_sequences(gaussian, noise.candidates[:, iteration])
            if not self.num_proposals:
                scores, returns = self._evaluate(latent, actions, weights_cast)
            elif iteration == 0:
                actions = torch.cat([proposals, actions], dim=1)
                scores, returns = self._evaluate(latent, actions, weights_cast)
                proposal_scores, proposal_returns = (x[:, : self.num_proposals] for x in (scores, returns))
            else:  # the proposals keep the scores of the first iteration
                scores, returns = self._evaluate(latent, actions, weights_cast)
                actions = torch.cat([proposals, actions], dim=1)
                scores = torch.cat([proposal_scores, scores], dim=1)
                returns = torch.cat([proposal_returns, returns], dim=1)
            elites = select_elites(actions, scores, self.num_elites)
            weights = elite_weights(elites.scores, self.inverse_temperature)
            fitted = fit_gaussian(elites.actions, weights, std_min=self.std_min, std_max=self.std_max)
            fallback = elites.scores[:, 0].isinf()
            keep = fallback[:, None, None]
            gaussian = Gaussian(*(torch.where(keep, old, new) for old, new in zip(gaussian, fitted, strict=True)))
            if trace:
                steps.append(PlanTrace(actions, scores, returns, *gaussian))

        loc, value = self._choose(
            elites.actions[:, :, 0], elites.scores, weights, gaussian.mean[:, 0], noise.elite, explore
        )
        policy_mean, policy_log_std = self.world_model.policy(latent)
        policy_std = policy_log_std.exp().clamp(self.std_min, self.std_max)
        loc = torch.where(fallback.unsqueeze(-1), policy_mean, loc)
        scale = torch.where(fallback.unsqueeze(-1), policy_std, gaussian.std[:, 0])
        value = torch.where(fallback, torch.nan, value)
        action = clipped_sample(loc, scale, noise.action) if explore else loc
        outputs = [
            field.reshape(batch + field.shape[1:]) for field in (action, loc, scale, value, gaussian.mean, fallback)
        ]
        if not trace:
            return Plan(*outputs, None)
        stacked = (torch.stack(field, dim=1) for field in zip(*steps, strict=True))
        return Plan(*outputs, PlanTrace(*(field.reshape(batch + field.shape[1:]) for field in stacked)))

    def _choose(
        self, first: Tensor, scores: Tensor, weights: Tensor, mean: Tensor, uniform: Tensor, explore: bool
    ) -> tuple[Tensor, Tensor]:
        """First action ``[B, A]`` and value ``[B]`` of the chosen sequence, from the elites' ``[B, K, A]``."""
        choice = self.first_action if explore else self.eval_first_action
        if choice == "mean":
            return mean, (weights * torch.where(scores.isfinite(), scores, 0)).sum(-1)
        if choice == "best":
            return first[:, 0], scores[:, 0]
        index = sample_elite(weights, uniform).unsqueeze(-1)
        action = first.gather(1, index.unsqueeze(-1).expand(-1, -1, first.shape[-1]))
        return action.squeeze(1), scores.gather(1, index).squeeze(1)

    def _cast_weights(self) -> dict[str, Tensor] | None:
        if self.scoring_dtype is None:
            return None
        return {name: weight.to(self.scoring_dtype) for name, weight in self._imagination.named_parameters()}

    def _evaluate(
        self, latent: Tensor, actions: Tensor, weights_cast: dict[str, Tensor] | None
    ) -> tuple[Tensor, Tensor]:
        """Scores ``[B, N]`` and return table ``[B, N, D, F, V]`` of sequences ``[B, N, H, A]`` from ``[B, L]``."""
        options = {"discount": self.discount, "all_depths": getattr(self.score, "depths", "all") != "last"}
        if weights_cast is None:
            returns = self._imagination(latent, actions, **options)
        else:
            inputs = latent.to(self.scoring_dtype), actions.to(self.scoring_dtype)
            returns = functional_call(self._imagination, weights_cast, inputs, options)
        scores = self.score(returns)
        if scores.shape != actions.shape[:2]:
            raise ValueError(
                f"score must reduce the return table {list(returns.shape)} to {list(actions.shape[:2])}, got "
                f"{list(scores.shape)}."
            )
        return scores, returns


class _Imagination(nn.Module):
    """The return table as a module, so that it can be called with other weights."""

    def __init__(self, world_model: nn.Module) -> None:
        super().__init__()
        self.world_model = world_model

    def forward(self, latent: Tensor, actions: Tensor, *, discount: float, all_depths: bool) -> Tensor:
        return imagined_returns(self.world_model, latent, actions, discount=discount, all_depths=all_depths)
