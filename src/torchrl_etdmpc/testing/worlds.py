"""Analytic worlds: exact functions in the place of the learned networks, so that the best plan is known.

Each is a :class:`~torchrl_etdmpc.modules.PredictionModel`, so ``LatentEnv(LineWorld())`` drives a planner, and a
score of one's own can be held against the optimum.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from torchrl_etdmpc.functional import bounded_log_std, clipped_sample

if TYPE_CHECKING:
    from torchrl_etdmpc.modules import PredictionModel


class AnalyticWorld(nn.Module):
    """A ``PredictionModel`` of exact functions; a subclass says what happens and what is best.

    The observation is the state. Head i of the dynamics adds ``drift[i]`` to the true next state and value head j adds
    ``value_offset[j]`` to the true value, so that the disagreement of the ensemble is known.

    Args:
        observation_dim (int): O.
        action_dim (int): A.
        latent_dim (int): L.
        num_dynamics (int): F, dynamics heads.
        num_values (int): V, value heads.
        drift (Tensor, optional): error of each dynamics head, in units of the state, shape ``[F, O]``. Default: 0.
        value_offset (Tensor, optional): error of each value head, in units of return, shape ``[V]``. Default: 0.
        policy_gain (float): the policy's mean is the best action times this. Default: 0, a policy that knows nothing.
        log_std_bounds (tuple of float): of the policy, whose log std is the middle of the bounds. Default: (-3, 1).

    Raises:
        ValueError: if the errors of the heads have another shape.

    >>> world = LineWorld(num_dynamics=2, drift=torch.tensor([[0.1], [-0.1]]))
    >>> isinstance(world, AnalyticWorld), world.encode(torch.zeros(1)).shape
    (True, torch.Size([2]))
    """

    drift: Tensor
    value_offset: Tensor
    version: Tensor

    def __init__(
        self,
        observation_dim: int,
        action_dim: int,
        *,
        latent_dim: int | None = None,
        num_dynamics: int = 1,
        num_values: int = 1,
        drift: Tensor | None = None,
        value_offset: Tensor | None = None,
        policy_gain: float = 0.0,
        log_std_bounds: tuple[float, float] = (-3.0, 1.0),
    ) -> None:
        super().__init__()
        self.observation_dim = observation_dim
        self.action_dim = action_dim
        self.latent_dim = observation_dim if latent_dim is None else latent_dim
        self.num_dynamics = num_dynamics
        self.num_values = num_values
        self.policy_gain = policy_gain
        self.log_std_bounds = log_std_bounds
        errors = {"drift": (drift, (num_dynamics, observation_dim)), "value_offset": (value_offset, (num_values,))}
        for name, (error, shape) in errors.items():
            error = torch.zeros(shape) if error is None else torch.as_tensor(error, dtype=torch.get_default_dtype())
            if error.shape != shape:
                raise ValueError(f"{name} must have one row per head, shape {shape}, got {tuple(error.shape)}.")
            self.register_buffer(name, error)
        self.register_buffer("version", torch.zeros((), dtype=torch.int64))

    def transition(self, latent: Tensor, action: Tensor) -> Tensor:
        """True next latent ``[..., L]`` of ``action [..., A]`` in ``latent [..., L]``."""
        raise NotImplementedError

    def reward(self, latent: Tensor, action: Tensor) -> Tensor:
        """Reward of ``action [..., A]`` in ``latent [..., L]``, shape ``[...]``."""
        raise NotImplementedError

    def value(self, latent: Tensor) -> Tensor:
        """True value of ``latent [..., L]``, shape ``[...]``."""
        raise NotImplementedError

    def optimal_action(self, state: Tensor) -> Tensor:
        """Best action ``[..., A]`` in ``state [..., O]`` (a latent will do)."""
        raise NotImplementedError

    def optimal_actions(self, observation: Tensor, horizon: int) -> Tensor:
        """Best plan.

        Args:
            observation (Tensor): state, shape ``[..., O]``.
            horizon (int): H.

        Returns:
            Tensor: actions, shape ``[..., H, A]``.
        """
        latent, actions = self.encode(observation), []
        for _ in range(horizon):
            actions.append(self.optimal_action(latent))
            latent = self.transition(latent, actions[-1])
        return torch.stack(actions, dim=-2)

    def encode(self, observation: Tensor) -> Tensor:
        """Observation ``[..., O]`` to latent ``[..., L]``: the state, then zeros."""
        return nn.functional.pad(observation, (0, self.latent_dim - self.observation_dim))

    def next(self, latent: Tensor, action: Tensor) -> Tensor:
        """Steps every head: ``[F, ..., L]`` (or ``[1, ..., L]``) and an action to ``[F, ..., L]``."""
        shape = torch.broadcast_shapes(latent.shape[:-1], action.shape[:-1])
        latent, action = latent.expand(*shape, self.latent_dim), action.expand(*shape, self.action_dim)
        drift = nn.functional.pad(self.drift, (0, self.latent_dim - self.observation_dim)).to(latent.dtype)
        return self.transition(latent, action) + drift.view(-1, *(1,) * (latent.ndim - 2), self.latent_dim)

    def values(self, latent: Tensor) -> Tensor:
        """Value of ``latent [..., L]`` by each value head, shape ``[..., V]``."""
        return self.value(latent).unsqueeze(-1) + self.value_offset.to(latent.dtype)

    def termination(self, latent: Tensor) -> Tensor | None:
        """Probability that the episode terminated on reaching ``latent [..., L]``; ``None``: it never does."""
        return None

    def policy(self, latent: Tensor, log_std_bounds: tuple[float, float] | None = None) -> tuple[Tensor, Tensor]:
        """Mean and log std of the policy in ``latent [..., L]``, both of shape ``[..., A]``."""
        mean = self.policy_gain * self.optimal_action(latent)
        return mean, bounded_log_std(torch.zeros_like(mean), *(log_std_bounds or self.log_std_bounds))

    def act(self, latent: Tensor, noise: Tensor, log_std_bounds: tuple[float, float] | None = None) -> Tensor:
        """Samples the policy: ``clip(mean + std * noise, -1, 1)``, shape ``[..., A]``."""
        mean, log_std = self.policy(latent, log_std_bounds)
        return clipped_sample(mean, log_std.exp(), noise)


if TYPE_CHECKING:  # what is written as these worlds are is a PredictionModel to a type checker as well
    _TYPED: type[PredictionModel] = AnalyticWorld


class LineWorld(AnalyticWorld):
    """Points on lines, one per action dimension, that actions push towards a goal.

    ``x' = x + step_size * a`` with reward ``-|x' - goal|^2`` and value ``-|x - goal|^2``. Whatever the horizon, the
    discount, or the average over depths, it is best to go to the goal as fast as possible and to stay there:
    ``a = clip((goal - x) / step_size, -1, 1)``. Drifts that sum to zero over the heads leave that optimum where it is.

    The trap: dynamics head ``trap_head`` believes that an action whose first component lies within ``trap`` earns
    ``trap_bonus`` one step later. One of F heads raises the mean of the estimates by its share of the bonus, and their
    standard deviation with it, so a penalty (``beta > 1`` with one value head) sees through it. The latent is the
    position and, last, the bonus about to be earned: L = O + 1.

    Args:
        goal (float): on every line. Default: 1.
        step_size (float): how far an action of 1 moves, positive. Default: 0.5.
        action_dim (int): A, number of lines; also O.
        trap (tuple of float, optional): smallest and largest action of the trap. Default: no trap.
        trap_bonus (float): in units of reward. Default: 100.
        trap_head (int): the head that believes in it. Default: 0.
        **heads: see :class:`AnalyticWorld`.

    Raises:
        ValueError: if ``step_size`` is not positive or ``trap_head`` does not exist.

    >>> LineWorld(goal=0.75).optimal_actions(torch.tensor([0.0]), horizon=3).flatten().tolist()
    [1.0, 0.5, 0.0]
    """

    def __init__(
        self,
        *,
        goal: float = 1.0,
        step_size: float = 0.5,
        action_dim: int = 1,
        trap: tuple[float, float] | None = None,
        trap_bonus: float = 100.0,
        trap_head: int = 0,
        **heads,
    ) -> None:
        super().__init__(action_dim, action_dim, latent_dim=action_dim + 1, **heads)
        if step_size <= 0:
            raise ValueError(f"step_size must be positive, got {step_size}.")
        if not 0 <= trap_head < self.num_dynamics:
            raise ValueError(f"trap_head must be in 0..{self.num_dynamics - 1}, got {trap_head}.")
        self.goal = goal
        self.step_size = step_size
        self.trap = trap
        self.trap_bonus = trap_bonus
        self.trap_head = trap_head

    def transition(self, latent: Tensor, action: Tensor) -> Tensor:
        """True next latent: the new position, and no bonus."""
        position = latent[..., : self.action_dim] + self.step_size * action
        return torch.cat([position, torch.zeros_like(latent[..., -1:])], dim=-1)

    def next(self, latent: Tensor, action: Tensor) -> Tensor:
        """As :meth:`AnalyticWorld.next`, with the trap."""
        following = super().next(latent, action)
        if self.trap is None:
            return following
        first = action[..., 0].expand(following.shape[:-1])
        bonus = self.trap_bonus * ((first >= self.trap[0]) & (first <= self.trap[1]))
        believer = torch.arange(self.num_dynamics, device=latent.device) == self.trap_head
        bonus = bonus * believer.view(-1, *(1,) * (bonus.ndim - 1))
        return torch.cat([following[..., :-1], bonus.unsqueeze(-1).to(following.dtype)], dim=-1)

    def reward(self, latent: Tensor, action: Tensor) -> Tensor:
        """Minus the squared distance to the goal after the step, and the bonus."""
        following = self.transition(latent, action.expand(*latent.shape[:-1], self.action_dim))
        return self.value(following) + latent[..., -1]

    def value(self, latent: Tensor) -> Tensor:
        """Minus the squared distance to the goal, and the bonus."""
        return latent[..., -1] - (latent[..., : self.action_dim] - self.goal).square().sum(-1)

    def optimal_action(self, state: Tensor) -> Tensor:
        """Straight to the goal."""
        return ((self.goal - state[..., : self.action_dim]) / self.step_size).clamp(-1, 1)


class LQRWorld(AnalyticWorld):
    """Linear dynamics with a quadratic cost, whose value is exact (the discounted linear-quadratic regulator).

    ``x' = A x + B a``, reward ``-(x'Qx + a'Ra)`` and value ``-x'Px``, where P solves the Riccati equation
    ``P = Q + g A'PA - g^2 A'PB (R + g B'PB)^-1 B'PA`` for the discount g. Since the value is exact, the best plan of
    every depth is ``a = -Kx`` with ``K = g (R + g B'PB)^-1 B'PA``, as long as it stays within [-1, 1]. Plan with the
    same discount. Drifts that sum to zero over the heads leave that optimum where it is.

    Args:
        transition_matrix (Tensor, optional): A, shape ``[O, O]``. Default: a double integrator with a time step of 1/2.
        control_matrix (Tensor, optional): B, shape ``[O, A]``.
        state_cost (Tensor, optional): Q, positive semidefinite, shape ``[O, O]``. Default: the identity.
        action_cost (Tensor, optional): R, positive definite, shape ``[A, A]``. Default: the identity.
        discount (float): g, in (0, 1]. Default: 0.99.
        **heads: see :class:`AnalyticWorld`.

    Raises:
        ValueError: if the Riccati iteration does not converge.

    >>> world = LQRWorld()
    >>> state = torch.tensor([0.2, -0.1])
    >>> best = world.optimal_action(state)
    >>> one_step = world.reward(state, best) + 0.99 * world.value(world.transition(state, best))
    >>> torch.allclose(one_step, world.value(state))
    True
    """

    transition_matrix: Tensor
    control_matrix: Tensor
    state_cost: Tensor
    action_cost: Tensor
    value_matrix: Tensor
    gain: Tensor

    def __init__(
        self,
        transition_matrix: Tensor | None = None,
        control_matrix: Tensor | None = None,
        *,
        state_cost: Tensor | None = None,
        action_cost: Tensor | None = None,
        discount: float = 0.99,
        **heads,
    ) -> None:
        a = _matrix(transition_matrix, [[1.0, 0.5], [0.0, 1.0]])
        b = _matrix(control_matrix, [[0.125], [0.5]])
        q, r = _matrix(state_cost, torch.eye(a.shape[-1])), _matrix(action_cost, torch.eye(b.shape[-1]))
        q, r = (q + q.mT) / 2, (r + r.mT) / 2  # the rewards are the same, and the equation is that of such costs
        super().__init__(*b.shape, **heads)
        self.discount = discount
        value, gain = _solve_riccati(a, b, q, r, discount)
        matrices = {
            "transition_matrix": a,
            "control_matrix": b,
            "state_cost": q,
            "action_cost": r,
            "value_matrix": value,
            "gain": gain,
        }
        for name, matrix in matrices.items():
            self.register_buffer(name, matrix.to(torch.get_default_dtype()))

    def transition(self, latent: Tensor, action: Tensor) -> Tensor:
        """``A x + B a``."""
        a, b = self.transition_matrix.to(latent.dtype), self.control_matrix.to(latent.dtype)
        return latent @ a.mT + action @ b.mT

    def reward(self, latent: Tensor, action: Tensor) -> Tensor:
        """``-(x'Qx + a'Ra)``."""
        return -_quadratic(latent, self.state_cost) - _quadratic(action, self.action_cost)

    def value(self, latent: Tensor) -> Tensor:
        """``-x'Px``."""
        return -_quadratic(latent, self.value_matrix)

    def optimal_action(self, state: Tensor) -> Tensor:
        """``-Kx``, clipped to [-1, 1]; the optimum where the clipping does nothing."""
        return -(state @ self.gain.to(state.dtype).mT).clamp(-1, 1)


def _matrix(given: Tensor | None, default: Tensor | list) -> Tensor:
    return torch.as_tensor(default if given is None else given, dtype=torch.float64)


def _quadratic(x: Tensor, matrix: Tensor) -> Tensor:
    return ((x @ matrix.to(x.dtype)) * x).sum(-1)


def _solve_riccati(a: Tensor, b: Tensor, q: Tensor, r: Tensor, discount: float) -> tuple[Tensor, Tensor]:
    """P ``[O, O]`` and K ``[A, O]`` by value iteration."""
    value = q
    for _ in range(10_000):
        gain = discount * torch.linalg.solve(r + discount * b.mT @ value @ b, b.mT @ value @ a)
        following = q + discount * a.mT @ value @ (a - b @ gain)
        if torch.allclose(following, value, rtol=1e-12, atol=1e-12):
            return following, gain
        value = following
    raise ValueError(
        "the Riccati equation has no solution after 10,000 iterations: the controls cannot keep the cost "
        f"finite; choose a smaller discount than {discount} or other matrices."
    )
