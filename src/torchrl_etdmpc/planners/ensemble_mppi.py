"""MPPI over the return estimates of a dynamics ensemble."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from torch import Tensor
from torch.func import functional_call
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import ExplorationType
from torchrl.envs.utils import exploration_type
from torchrl.modules import MPCPlannerBase

from torchrl_etdmpc.envs.check import model_sizes
from torchrl_etdmpc.functional import Gaussian, clipped_sample, shift_plan
from torchrl_etdmpc.keys import (
    ACTION,
    FALLBACK,
    IS_INIT,
    LATENT,
    LOC,
    NEXT,
    OBSERVATION,
    PLAN,
    PLAN_FIELDS,
    PLAN_MEAN,
    SCALE,
    VALUE,
    VERSION,
)
from torchrl_etdmpc.modules.prediction import PredictionModel, has_action_values, has_policy, require_policy
from torchrl_etdmpc.planners.arguments import (
    FirstAction,
    InitialPlan,
    ScoringDtype,
    check_budget,
    check_choices,
    check_fit,
    floating_dtype,
    proposal_bounds,
)
from torchrl_etdmpc.planners.imagination import Imagination, policy_gaussian, propose_sequences
from torchrl_etdmpc.planners.latent_env import LatentEnv
from torchrl_etdmpc.planners.plan import Plan, PlanNoise, PlanTrace
from torchrl_etdmpc.planners.primer import PlanPrimer
from torchrl_etdmpc.planners.scores import Score, ScoreFunction, ScoreName, make_score
from torchrl_etdmpc.planners.search import Search, chosen_sequence, search


class EnsembleMPPIPlanner(MPCPlannerBase):
    """Model predictive path integral control with an ensemble of dynamics and value heads (thesis 3.4).

    Each candidate action sequence is rolled through every dynamics head; the table of return estimates over depths,
    dynamics heads and value heads (thesis Eq. 3.1) is reduced to a score by ``score``. The planner acts on a real
    environment (it reads ``observation``) as well as on the :class:`LatentEnv` it holds (it reads ``latent``).

    It obeys :func:`torchrl.envs.exploration_type`: with ``RANDOM`` (a collector's default) the action is a sample
    and the target's mean comes from ``first_action``; otherwise the action is the mean from ``eval_first_action``.

    The warm start travels in the tensordict: append :meth:`make_tensordict_primer` to the environment, which zeroes it
    at every reset and without which rollouts and collectors drop it. Where the input holds an ``InitTracker``'s
    ``is_init``, a plan is zeroed at the start of its episode in any case. With no plan in the input the planner starts
    cold, and warns once unless all episodes have just begun.

    With an :class:`~torchrl_etdmpc.modules.ActionValueModel`, rollouts are bootstrapped as TD-MPC2 does: by two heads,
    drawn anew in every iteration, for actions sampled from the policy.

    Args:
        env (LatentEnv): the world model as an environment. Any
            :class:`~torchrl_etdmpc.modules.PredictionModel` will do.

    Keyword Args:
        horizon (int): H, actions per sequence. Default: 6.
        num_samples (int): N, candidates per iteration, proposals included. Default: 512.
        num_elites (int): K. Default: 64.
        num_proposals (int): P, sequences proposed by the policy, spread over the dynamics heads round-robin. They are
            scored once per call. 0 for a model without a policy. Default: 24.
        iterations (int): Default: 6.
        extra_iterations (int): added if the action has more than ``large_action_dim`` dimensions. Default: 2.
        large_action_dim (int): Default: 20.
        score (str or callable): ``"final"``, ``"mean"``, ``"adaptive"`` or a callable from the return table
            ``[..., D, F, V]`` to ``[...]``, see :class:`~torchrl_etdmpc.planners.Score`. Default: ``"mean"``.
        beta (float): penalty on the standard deviation of the heads' mean, for a named score. Default: 0.
        discount (float): gamma, in (0, 1]. Default: 0.99.
        inverse_temperature (float): of the elites' weights (TD-MPC2 calls it ``temperature``). Default: 0.5.
        std_min (float): Default: 0.05.
        std_max (float): largest standard deviation, and that of the first candidates of a wide search. Default: 2.
        first_action (str): ``"elite"`` (one elite drawn by its weight; BMPC), ``"mean"`` (the fitted mean; the thesis'
            formula) or ``"best"`` (highest-scoring candidate of the last iteration). Default: ``"elite"``.
        eval_first_action (str): the same, when not exploring. Default: ``"best"``.
        warm_start (bool): whether to carry the plan from step to step. Default: ``True``.
        initial (str): the Gaussian of the first candidates. ``"wide"`` has the carried plan for its mean, or zeros, and
            ``std_max`` for its deviation (TD-MPC2). ``"policy"`` is the policy's own along its mean actions, its
            deviation within ``std_min`` and ``std_max`` and the log std within the bounds for proposals: a search of
            few candidates then improves on the policy instead of looking for it. A carried plan is not read then. Not
            in the thesis. Default: ``"wide"``.
        scoring_dtype (torch.dtype or str, optional): in which candidates are rolled and scored, e.g.
            ``torch.bfloat16`` or ``"bfloat16"``; the weights are cast once per call, and returns are summed in the
            weights' own dtype. Default: ``None``, that of the weights.
        proposal_log_std_min (float, optional): smallest log std of the policy while it proposes; BMPC widens the bounds
            to -2 and 1 for reanalyze. Default: the policy's own.
        proposal_log_std_max (float, optional): the largest one; both are given or neither.
        observation_key, action_key, is_init_key, plan_mean_key (NestedKey): tensordict keys.
        latent_key (NestedKey, optional): where a :class:`LatentEnv` holds its state. ``None``: plan from observations
            only. Default: ``"latent"``.
        plan_key (NestedKey): root of the target: ``loc``, ``scale``, ``value``, ``version`` and ``fallback`` below it.

    Attributes:
        explore (bool, optional): whether ``forward`` explores, whatever the exploration type is. To be set where other
            threads of the process call losses or evaluate: that type is one for all of them, and a loss changes it for
            as long as it is called. Default: ``None``, the exploration type decides.
        compiled_plan (callable, optional): what ``forward`` calls in the place of :meth:`plan` if it is set, e.g.
            ``torch.compile(planner.plan)``; ``plan`` itself is never replaced. It belongs to this object: a copy of the
            planner starts without one. Default: ``None``.

    Raises:
        TypeError: if ``env`` is not a :class:`LatentEnv`.
        ValueError: if an argument is out of range, or proposals are asked of a model without a policy.

    >>> from tensordict import TensorDict
    >>> from torchrl_etdmpc.modules import WorldModel
    >>> env = LatentEnv(WorldModel(3, 2, latent_dim=16, mlp_dim=32))
    >>> planner = EnsembleMPPIPlanner(env, horizon=3, num_samples=32, num_elites=8, num_proposals=4, warm_start=False)
    >>> planner(TensorDict({"observation": torch.zeros(5, 3)}, batch_size=[5]))["plan", "loc"].shape
    torch.Size([5, 2])
    """

    env: LatentEnv

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
        score: ScoreName | Score | ScoreFunction = "mean",
        beta: float = 0.0,
        discount: float = 0.99,
        inverse_temperature: float = 0.5,
        std_min: float = 0.05,
        std_max: float = 2.0,
        first_action: FirstAction = "elite",
        eval_first_action: FirstAction = "best",
        warm_start: bool = True,
        initial: InitialPlan = "wide",
        scoring_dtype: torch.dtype | ScoringDtype | None = None,
        proposal_log_std_min: float | None = None,
        proposal_log_std_max: float | None = None,
        observation_key: NestedKey = OBSERVATION,
        latent_key: NestedKey | None = LATENT,
        action_key: NestedKey = ACTION,
        is_init_key: NestedKey = IS_INIT,
        plan_mean_key: NestedKey = PLAN_MEAN,
        plan_key: NestedKey = PLAN,
    ) -> None:
        if not isinstance(env, LatentEnv):
            raise TypeError(
                f"EnsembleMPPIPlanner needs a LatentEnv, got {type(env).__name__}; wrap the networks: "
                "LatentEnv(world_model)."
            )
        check_budget(horizon, num_samples, num_elites, num_proposals, iterations, extra_iterations)
        if num_proposals and not has_policy(env.world_model):
            raise ValueError(
                f"num_proposals must be 0 for a model without a policy ({type(env.world_model).__name__}), got "
                f"{num_proposals}."
            )
        check_fit(discount, inverse_temperature, std_min, std_max)
        check_choices(first_action, eval_first_action, initial)
        if initial == "policy" and not has_policy(env.world_model):
            raise ValueError(
                f"initial must be 'wide' for a model without a policy ({type(env.world_model).__name__}), got 'policy'."
            )
        super().__init__(env, action_key=action_key)
        self.horizon = horizon
        self.num_samples = num_samples
        self.num_elites = num_elites
        self.num_proposals = num_proposals
        # Departure from BMPC, whose code adds them from large_action_dim dimensions on: above it, as the thesis says.
        self.iterations = iterations + (extra_iterations if self.world_model.action_dim > large_action_dim else 0)
        self.extra_iterations = extra_iterations
        self.large_action_dim = large_action_dim
        self.score = make_score(score, beta)
        self.discount = discount
        self.inverse_temperature = inverse_temperature
        self.std_min = std_min
        self.std_max = std_max
        self.first_action: FirstAction = first_action
        self.eval_first_action: FirstAction = eval_first_action
        self.warm_start = warm_start
        self.initial: InitialPlan = initial
        self.scoring_dtype = floating_dtype(scoring_dtype)
        self.proposal_log_std_bounds = proposal_bounds(proposal_log_std_min, proposal_log_std_max)
        self.explore: bool | None = None
        self.compiled_plan: Callable[..., Plan] | None = None
        vars(self)["_imagination"] = Imagination(env.world_model)
        self.observation_key, self.action_key = unravel_key(observation_key), unravel_key(action_key)
        self.latent_key = None if latent_key is None else unravel_key(latent_key)
        self.is_init_key = unravel_key(is_init_key)
        self.plan_mean_key = unravel_key(plan_mean_key)
        self.next_plan_mean_key = unravel_key((NEXT, plan_mean_key))
        self.plan_keys = {name: unravel_key((plan_key, name)) for name in PLAN_FIELDS}
        self._warned_cold = False
        carried = [self.is_init_key, self.plan_mean_key] if warm_start else []
        written = [*self.plan_keys.values(), *([self.next_plan_mean_key] if warm_start else [])]
        # TorchRL's types know one key only.
        self.in_keys = [self.observation_key, *carried]  # pyright: ignore[reportAttributeAccessIssue]
        self.out_keys = [self.action_key, *written]  # pyright: ignore[reportAttributeAccessIssue]
        self._written = tuple(self.out_keys)

    def __setattr__(self, name: str, value: Any) -> None:
        if name == "env":  # the base class has it as its module, too; the state dict should list the weights once
            vars(self)["env"] = value
            name = "module"
        super().__setattr__(name, value)

    @property
    def world_model(self) -> PredictionModel:
        """The networks that the planner reads."""
        return self.env.world_model

    @property
    def action_spec(self) -> Bounded:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Of the world model's actions, where the world model is now."""
        self.env.follow()
        return self.env.action_spec  # pyright: ignore[reportReturnType]

    @action_spec.setter
    def action_spec(self, spec: Bounded) -> None:
        pass  # the base class copies that of the environment, which would stay behind when the planner is moved

    @property
    def spec(self) -> Composite:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Specs of all entries that :meth:`forward` writes; who asks for them need not try a plan."""
        device, dtype = self.env.device_and_dtype()
        action, one = torch.Size([self.world_model.action_dim]), torch.Size([1])
        like = {"device": device, "dtype": dtype}
        specs = {
            self.action_key: self.action_spec,
            self.plan_keys[LOC]: Unbounded(action, **like),
            self.plan_keys[SCALE]: Unbounded(action, **like),
            self.plan_keys[VALUE]: Unbounded(one, **like),
            self.plan_keys[VERSION]: Unbounded(one, device=device, dtype=torch.int64),
            self.plan_keys[FALLBACK]: Binary(1, shape=one, device=device, dtype=torch.bool),
            self.next_plan_mean_key: Unbounded(torch.Size([self.horizon, *action]), **like),
        }
        return Composite({key: specs[key] for key in self.out_keys}, device=device)

    @spec.setter
    def spec(self, spec: Composite) -> None:
        pass  # the base class hands back what it has moved; the specs follow the world model

    def __getstate__(self) -> dict[str, Any]:
        # What was compiled is bound to this object: in a copy it would go on planning with the original's weights.
        return super().__getstate__() | {"compiled_plan": None}

    def select_out_keys(self, *out_keys: NestedKey) -> EnsembleMPPIPlanner:
        """Leaves only some of the entries that :meth:`forward` writes.

        Without the plan that is carried to the next step every plan starts cold, which is a warning.

        Raises:
            ValueError: if one of them is not written at all.
        """
        keys = [unravel_key(key) for key in out_keys]
        unknown = [key for key in keys if key not in self._written]
        if unknown:
            raise ValueError(f"out_keys must be some of {list(self._written)}, got {unknown}.")
        if self.warm_start and self.next_plan_mean_key not in keys:
            warnings.warn(
                f"without {self.next_plan_mean_key!r} every plan starts cold; leave it among the out_keys, or make the "
                "planner with warm_start=False.",
                stacklevel=2,
            )
        self.out_keys = keys  # pyright: ignore[reportAttributeAccessIssue]
        return self

    def reset_out_keys(self) -> EnsembleMPPIPlanner:
        """Takes back :meth:`select_out_keys`."""
        self.out_keys = list(self._written)  # pyright: ignore[reportAttributeAccessIssue]
        return self

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.extra_repr()}, world_model={type(self.world_model).__name__})"

    def extra_repr(self) -> str:
        """The budget and the choices, as they were given."""
        budget = ("horizon", "num_samples", "num_elites", "num_proposals", "iterations", "discount")
        choices = ("first_action", "eval_first_action", "warm_start", "initial")
        parts = [f"{name}={getattr(self, name)!r}" for name in (*budget, *choices)]
        return ", ".join([*parts, f"score={self.score!r}"])

    def make_tensordict_primer(self) -> PlanPrimer:
        """Transform that adds the warm start to an environment's reset and zeroes it there.

        TorchRL's collectors append it with ``auto_register_policy_transforms=True``. At the first reset it raises a
        ``ValueError`` where environment and model do not fit (:func:`~torchrl_etdmpc.envs.check_spaces`).
        """
        device, dtype = self.env.device_and_dtype()
        spec = Unbounded(torch.Size([self.horizon, self.world_model.action_dim]), device=device, dtype=dtype)
        keys = {"observation_key": self.observation_key, "action_key": self.action_key}
        fits = {"spaces": model_sizes(self.world_model) | {"dtype": dtype} | keys, "latent_key": self.latent_key}
        return PlanPrimer({self.plan_mean_key: spec}, default_value=0.0, expand_specs=True, **fits)

    def planning(self, td: TensorDictBase) -> Tensor:
        """Plans and returns the action alone (the interface of TorchRL's planners)."""
        return self(td.copy()).get(self.action_key)

    @torch.no_grad()
    def forward(  # pyright: ignore[reportIncompatibleMethodOverride]  # the base class takes kwargs only to refuse them
        self,
        tensordict: TensorDictBase,
        tensordict_out: TensorDictBase | None = None,
        *,
        generator: torch.Generator | None = None,
    ) -> TensorDictBase:
        """Plans for every state of the batch and writes action, target and warm start.

        Args:
            tensordict (TensorDictBase): ``observation [..., O]`` or ``latent [..., L]``, and for the warm start
                ``plan_mean [..., H, A]`` and ``is_init [..., 1]``, each optional.
            tensordict_out (TensorDictBase, optional): where to write. Default: ``tensordict``.

        Keyword Args:
            generator (torch.Generator, optional): of the plan's random numbers. Default: PyTorch's global one.

        Returns:
            TensorDictBase: with ``action [..., A]``; ``("plan", "loc")`` and ``("plan", "scale")`` ``[..., A]``, which
            the policy learns; ``("plan", "value")``, ``("plan", "version")`` (int64) and ``("plan", "fallback")``
            (bool) ``[..., 1]``; with a warm start ``("next", "plan_mean") [..., H, A]``.

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
                "environment names it otherwise, or append what check_env(env) names."
            )
        if observation is not None and latent is not None:
            raise ValueError(
                f"the planner found both {self.observation_key!r} and {self.latent_key!r} in its input and cannot tell "
                "which one is current; exclude one of them, or pass latent_key=None to plan from observations only."
            )
        explore = exploration_type() is ExplorationType.RANDOM if self.explore is None else self.explore
        carried, carry = self._read_warm_start(tensordict)
        make_plan = self.plan if self.compiled_plan is None else self.compiled_plan
        drawn: dict[str, Any] = {}
        if generator is not None:
            batch = tensordict.batch_size  # which may be shorter than that of the entries
            if latent is not None:
                batch = latent.shape[:-1]
            elif observation is not None and self.world_model.observation_dim is not None:
                batch = observation.shape[:-1]
            drawn["noise"] = self.draw_noise(*batch, generator=generator)
        plan = make_plan(observation, carried, latent=latent, explore=explore, **drawn)
        outputs = {
            self.action_key: plan.action,
            self.plan_keys[LOC]: plan.loc,
            self.plan_keys[SCALE]: plan.scale,
            self.plan_keys[VALUE]: plan.value.unsqueeze(-1),
            self.plan_keys[VERSION]: self.world_model.version.expand(*plan.value.shape, 1).clone(),
            self.plan_keys[FALLBACK]: plan.fallback.unsqueeze(-1),
        }
        if carry:
            outputs[self.next_plan_mean_key] = plan.mean
        out = tensordict if tensordict_out is None else tensordict_out
        for key, value in outputs.items():
            if key in self.out_keys:
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
                    stacklevel=6,  # who called the module
                )
            return None, is_init is not None
        if carried.shape[-2:] != (self.horizon, self.world_model.action_dim):
            raise ValueError(
                f"{self.plan_mean_key!r} holds a plan of shape {list(carried.shape[-2:])}, this planner's are "
                f"[horizon, action_dim]={[self.horizon, self.world_model.action_dim]}; give planners that share an "
                "environment a plan_mean_key of their own, and each its primer."
            )
        if is_init is not None:
            starts = is_init.bool().reshape(*carried.shape[:-2], 1, 1)  # [..., 1], or [...] as some environments do
            carried = torch.where(starts, 0, carried)
        return carried, True

    def draw_noise(
        self,
        *batch_size: int,
        generator: torch.Generator | None = None,
        device: torch.device | str | None = None,
        dtype: torch.dtype | None = None,
    ) -> PlanNoise:
        """Draws the random numbers of one :meth:`plan` call for a leading batch.

        Args:
            *batch_size (int): the leading batch.
            generator (torch.Generator, optional): Default: PyTorch's global one.
            device (torch.device or str, optional): of the latents. Default: that of the world model.
            dtype (torch.dtype, optional): of the latents. Default: that of the world model.
        """
        if device is None or dtype is None:
            own_device, own_dtype = self.env.device_and_dtype()
            device, dtype = own_device if device is None else device, own_dtype if dtype is None else dtype
        actions = (self.horizon, self.world_model.action_dim)
        free = self.num_samples - self.num_proposals
        options: dict[str, Any] = {"device": device, "dtype": dtype}
        if generator is not None:  # torch.randn(..., generator=None) takes no symbolic size
            options["generator"] = generator
        single: dict[str, Any] = options | {"dtype": torch.promote_types(dtype, torch.float32)}
        drawn = {
            "proposals": torch.randn(*batch_size, self.num_proposals, *actions, **options),
            "candidates": torch.randn(*batch_size, self.iterations, free, *actions, **options),
            # Not in half precision: of its few numbers many are the same, and of those the best elite's wins.
            "elite": torch.rand(*batch_size, self.num_elites, **single),
            "action": torch.randn(*batch_size, actions[-1], **options),
        }
        model = self.world_model
        if not has_action_values(model):
            nothing = torch.zeros(*batch_size, 0, device=device, dtype=dtype)
            return PlanNoise(**drawn, bootstrap=nothing, heads=nothing)
        depths = self.horizon if self.score.depths == "all" else 1
        scored = (self.iterations, self.num_samples, depths, model.num_dynamics, actions[-1])
        return PlanNoise(
            **drawn,
            bootstrap=torch.randn(*batch_size, *scored, **options),
            heads=torch.rand(*batch_size, self.iterations, model.num_values, **options),
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

        Raises:
            ValueError: if neither an observation nor a latent is given, or ``plan_mean`` has another shape.
        """
        if latent is None:
            if observation is None:
                raise ValueError("plan needs an observation or a latent, got neither.")
            latent = self.world_model.encode(observation)
        batch = latent.shape[:-1]
        carried = (*batch, self.horizon, self.world_model.action_dim)
        if plan_mean is not None and plan_mean.shape != carried:
            raise ValueError(f"plan_mean must be [..., H, A], here {list(carried)}, got {list(plan_mean.shape)}.")
        latent = latent.reshape(-1, latent.shape[-1])
        states = latent.shape[0]
        if noise is None:
            noise = self.draw_noise(states, device=latent.device, dtype=latent.dtype)
        elif len(batch) != 1:
            noise = PlanNoise(*(draw.reshape(states, *draw.shape[len(batch) :]) for draw in noise))
        shape = (states, self.horizon, self.world_model.action_dim)
        start = latent.new_zeros(shape) if plan_mean is None else shift_plan(plan_mean.reshape(shape))
        found = search(
            self._initial(latent, start),
            self._proposals(latent, noise.proposals),
            noise.candidates,
            partial(self._evaluate, self._return_table(latent), noise),
            iterations=self.iterations,
            num_elites=self.num_elites,
            inverse_temperature=self.inverse_temperature,
            std_min=self.std_min,
            std_max=self.std_max,
            trace=trace,
        )
        loc, scale, value = self._target(latent, found, noise.elite, explore)
        # A copy: who adds noise to the action in place does not move the target that is distilled.
        action = clipped_sample(loc, scale, noise.action) if explore else loc.clone()
        outputs = (action, loc, scale, value, found.gaussian.mean, found.fallback)
        outputs = [field.reshape(batch + field.shape[1:]) for field in outputs]
        if not trace:
            return Plan(*outputs, trace=None)
        stacked = (torch.stack(field, dim=1) for field in zip(*found.steps, strict=True))
        return Plan(*outputs, trace=PlanTrace(*(field.reshape(batch + field.shape[1:]) for field in stacked)))

    @torch.no_grad()
    def imagined_returns(self, latent: Tensor, actions: Tensor) -> Tensor:
        """The return table that sequences are scored by (thesis Eq. 3.1).

        It is imagined in the dtype of scoring and summed in that of the latents.

        With an :class:`~torchrl_etdmpc.modules.ActionValueModel` by its values of the state, without a draw.

        Args:
            latent (Tensor): states, ``[B, L]``.
            actions (Tensor): sequences in [-1, 1], ``[B, N, H, A]``.

        Returns:
            Tensor: ``[B, N, D, F, V]`` with D = H, or 1 for a score of the last depth.
        """
        return self._return_table(latent)(actions)

    def _initial(self, latent: Tensor, start: Tensor) -> Gaussian:
        """The Gaussian ``[B, H, A]`` of the first candidates; ``start`` is the warm start."""
        if self.initial == "wide":
            return Gaussian(start, torch.full_like(start, self.std_max))
        world_model = require_policy(self.world_model, "initial='policy'")
        mean, std = policy_gaussian(world_model, latent, self.horizon, self.proposal_log_std_bounds)
        return Gaussian(mean, std.clamp(self.std_min, self.std_max))

    def _proposals(self, latent: Tensor, noise: Tensor) -> Tensor:
        """The policy's sequences ``[B, P, H, A]``."""
        if not self.num_proposals:
            return noise  # of no sequence
        world_model = require_policy(self.world_model, f"num_proposals={self.num_proposals}")
        return propose_sequences(world_model, latent, noise, self.proposal_log_std_bounds)

    def _target(self, latent: Tensor, found: Search, uniform: Tensor, explore: bool) -> tuple[Tensor, Tensor, Tensor]:
        """Mean ``[B, A]``, standard deviation ``[B, A]`` and value ``[B]`` of the target.

        On fallback mean and standard deviation are the policy's; without a policy, those of the last Gaussian that was
        fitted to finite scores, which is the warm start where there was none.
        """
        choice = self.first_action if explore else self.eval_first_action
        loc, value = chosen_sequence(found, choice, uniform)
        fallback, std = found.fallback, found.gaussian.std[:, 0]
        if has_policy(self.world_model):
            policy_mean, policy_log_std = self.world_model.policy(latent)
            policy_std = policy_log_std.exp().clamp(self.std_min, self.std_max)
        else:
            policy_mean, policy_std = found.gaussian.mean[:, 0], std
        loc = torch.where(fallback.unsqueeze(-1), policy_mean, loc)
        scale = torch.where(fallback.unsqueeze(-1), policy_std, std)
        return loc, scale, torch.where(fallback, torch.nan, value)

    def _evaluate(
        self, return_table: Callable[..., Tensor], noise: PlanNoise, actions: Tensor, iteration: int
    ) -> tuple[Tensor, Tensor]:
        """Scores ``[B, N]`` and return table ``[B, N, D, F, V]`` of sequences ``[B, N, H, A]``."""
        bootstrap = None
        if noise.heads.shape[-1]:
            bootstrap = noise.bootstrap[:, iteration, -actions.shape[1] :], noise.heads[:, iteration]
        returns = return_table(actions, bootstrap=bootstrap)
        scores = self.score(returns)
        if scores.shape != actions.shape[:2]:
            raise ValueError(
                f"score must reduce the return table {list(returns.shape)} to {list(actions.shape[:2])}, got "
                f"{list(scores.shape)}."
            )
        return scores, returns

    def _return_table(self, latent: Tensor) -> Callable[..., Tensor]:
        """From sequences ``[B, N, H, A]`` to the return table from ``latent [B, L]`` on; casts the weights once."""
        imagination = self._imagination
        if imagination.world_model is not self.world_model:  # the environment has been given another one
            imagination = vars(self)["_imagination"] = Imagination(self.world_model)
        options = {"discount": self.discount, "all_depths": self.score.depths == "all"}
        dtype = self.scoring_dtype
        if dtype is None or dtype == latent.dtype:
            return partial(imagination, latent, **options)
        weights = {name: weight.to(dtype) for name, weight in imagination.named_parameters()}
        cast = latent.to(dtype)

        def return_table(actions: Tensor, bootstrap: tuple[Tensor, Tensor] | None = None) -> Tensor:
            if bootstrap is not None:
                bootstrap = bootstrap[0].to(dtype), bootstrap[1]
            further = options | {"bootstrap": bootstrap, "dtype": latent.dtype}
            return functional_call(imagination, weights, (cast, actions.to(dtype)), further)

        return return_table
