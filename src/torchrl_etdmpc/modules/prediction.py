"""What planning needs to know of a world: the Protocol between world models and everything that imagines with them."""

from __future__ import annotations

from typing import Any, Protocol, TypeGuard

import torch
from torch import Tensor, nn


class PredictionModel(Protocol):
    """A world model as the planner, the imagined environment and the exporters see it.

    Any ``torch.nn.Module`` with these members can be planned over: ``EnsembleMPPIPlanner(LatentEnv(model))``. A model
    without an ensemble has ``num_dynamics = 1`` and a last dimension of size 1 in ``values``. Every method takes any
    leading batch ``...``, on the device and in the dtype of its input, and none of them draws random numbers.
    :class:`~torchrl_etdmpc.modules.WorldModel` is the learned one; :mod:`torchrl_etdmpc.testing` has exact ones, which
    are short to read. The losses train the networks of a ``WorldModel`` and need more than this. A model has these
    members and does not derive from this class, whose own do nothing.

    A model with a policy has ``policy`` and ``act`` as well (:class:`PolicyModel`), from which the planner takes its
    proposals; without one it is driven with ``num_proposals=0``.

    Ask :func:`require_prediction_model`, :func:`has_policy` and :func:`has_action_values`, not ``isinstance``: from
    Python 3.12 on it does not see the parameters, buffers and submodules of a module.

    >>> from torchrl_etdmpc.testing import LineWorld
    >>> require_prediction_model(LineWorld())
    """

    # Properties, since nobody but the model sets them: to a type checker an int is then an int | None.
    @property
    def observation_dim(self) -> int | None:
        """O, size of the flat observation. ``None``: the model encodes what it likes, e.g. images or a dictionary."""
        ...

    @property
    def action_dim(self) -> int:
        """A; every action lies in [-1, 1]."""
        ...

    @property
    def latent_dim(self) -> int:
        """L, size of the state in which everything is predicted."""
        ...

    @property
    def num_dynamics(self) -> int:
        """F, dynamics heads."""
        ...

    @property
    def version(self) -> Tensor:
        """How many updates made these weights: a scalar, int64, stamped on every target; zero without training."""
        ...

    def encode(self, observation: Any) -> Tensor:
        """Observation ``[..., O]`` to latent ``[..., L]``.

        What an observation is beyond its leading batch is the model's business: a tensor of any shape and dtype, or a
        ``TensorDict`` of them with the batch size ``[...]``.
        """
        ...

    def next(self, latent: Tensor, action: Tensor) -> Tensor:
        """Steps every dynamics head on its own latent.

        Args:
            latent (Tensor): ``[F, ..., L]``, or ``[1, ..., L]`` where all heads start from the same latent; a further
                dimension of size 1 stands for many actions in one latent.
            action (Tensor): broadcastable to ``[F, ..., A]``.

        Returns:
            Tensor: ``[F, ..., L]``.
        """
        ...

    def reward(self, latent: Tensor, action: Tensor) -> Tensor:
        """Expected reward of ``action [..., A]`` in ``latent [..., L]``, shape ``[...]``."""
        ...

    def values(self, latent: Tensor) -> Tensor:
        """Expected discounted return from ``latent [..., L]`` on, by each of V value heads, shape ``[..., V]``."""
        ...

    def termination(self, latent: Tensor) -> Tensor | None:
        """Probability that the episode terminated on reaching ``latent [..., L]``, shape ``[...]``.

        ``None``, for every latent, where nothing ever terminates.
        """
        ...


class PolicyModel(PredictionModel, Protocol):
    """A :class:`PredictionModel` with a policy, which proposes to the planner and can act alone.

    >>> from torchrl_etdmpc.modules import WorldModel
    >>> has_policy(WorldModel(3, 2, latent_dim=16, mlp_dim=32))
    True
    """

    def policy(self, latent: Tensor, log_std_bounds: tuple[float, float] | None = None) -> tuple[Tensor, Tensor]:
        """Mean and log standard deviation of the policy in ``latent [..., L]``, both of shape ``[..., A]``.

        The planner takes its proposals from here, and its action where no candidate has a finite score.

        Args:
            latent (Tensor): ``[..., L]``.
            log_std_bounds (tuple of float, optional): other bounds of the log std for this call; a policy that has no
                bounds may ignore them.
        """
        ...

    def act(self, latent: Tensor, noise: Tensor, log_std_bounds: tuple[float, float] | None = None) -> Tensor:
        """An action ``[..., A]`` of the policy, from standard normal ``noise [..., A]``; ``[-1, 1]``."""
        ...


class ActionValueModel(PolicyModel, Protocol):
    """A world model whose critic also reads the action; the planner knows it by the members below.

    Its :meth:`~PredictionModel.values` are those of an action of its own choice, without noise, for whoever asks for
    the value of a latent. The planner asks for :meth:`action_values` of actions that it samples from the policy.

    >>> from torchrl_etdmpc.modules import ActionValueWorldModel, WorldModel
    >>> has_action_values(ActionValueWorldModel(3, 2)), has_action_values(WorldModel(3, 2))
    (True, False)
    """

    @property
    def num_values(self) -> int:
        """V, action-value heads."""
        ...

    def action_values(self, latent: Tensor, action: Tensor) -> Tensor:
        """Expected discounted return of ``action [..., A]`` in ``latent [..., L]`` by each head, ``[..., V]``."""
        ...


def has_policy(model: object) -> TypeGuard[PolicyModel]:
    """Whether a model has a policy, which is more than planning needs.

    >>> has_policy(torch.nn.Linear(2, 2))
    False
    """
    return getattr(model, "policy", None) is not None  # an activation is often called act


def has_action_values(model: object) -> TypeGuard[ActionValueModel]:
    """Whether a model's critic also reads the action.

    >>> has_action_values(torch.nn.Linear(2, 2))
    False
    """
    return getattr(model, "action_values", None) is not None


def require_policy(model: PredictionModel, what: str) -> PolicyModel:
    """The model, if it has a policy.

    Args:
        model (PredictionModel): any.
        what (str): who needs one, for the message.

    Raises:
        TypeError: if it has none.
    """
    if not has_policy(model):
        raise TypeError(f"{what} needs a model with a policy, got {type(model).__name__} without policy and act.")
    return model


_POLICY = ("policy", "act")


def require_prediction_model(model: object) -> None:
    """Checks that an object is a module with every member of :class:`PredictionModel`; with a policy or action values,
    of theirs too.

    Raises:
        TypeError: naming what is missing.

    >>> from torchrl_etdmpc.modules import WorldModel
    >>> require_prediction_model(WorldModel(3, 2, latent_dim=16, mlp_dim=32))
    """
    members = [name for name in vars(PredictionModel) if not name.startswith("_")]
    members += _POLICY if has_policy(model) else ()
    members += (*_POLICY, "num_values") if has_action_values(model) else ()
    # None says something as observation_dim alone.
    absent = [name for name in dict.fromkeys(members) if getattr(model, name, None) is None]
    missing = [name for name in absent if name != "observation_dim" or not hasattr(model, name)]
    if missing:
        raise TypeError(
            f"world_model must have the members of PredictionModel, got {type(model).__name__} without "
            f"{', '.join(missing)}; see torchrl_etdmpc.modules.PredictionModel."
        )
    if not isinstance(model, nn.Module):
        raise TypeError(f"world_model must be a torch.nn.Module, got {type(model).__name__}; derive it from nn.Module.")


def device_and_dtype(
    model: nn.Module | PredictionModel, device: torch.device | str | None = None, dtype: torch.dtype | None = None
) -> tuple[torch.device, torch.dtype]:
    """Where a model's inputs go: device and dtype of its first floating-point parameter or buffer.

    Args:
        model (nn.Module): of one device and one dtype, e.g. a :class:`PredictionModel`.
        device (torch.device or str, optional): for a model without parameters and buffers. Default: PyTorch's own.
        dtype (torch.dtype, optional): for such a model. Default: PyTorch's own.

    >>> device_and_dtype(nn.Linear(3, 2).double())
    (device(type='cpu'), torch.float64)
    """
    assert isinstance(model, nn.Module)
    for tensors in (model.parameters(), model.buffers()):
        for tensor in tensors:
            if tensor.is_floating_point():
                return tensor.device, tensor.dtype
    device = torch.get_default_device() if device is None else torch.device(device)
    return device, torch.get_default_dtype() if dtype is None else dtype
