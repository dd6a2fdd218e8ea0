"""The terms of a loss: what one names, and whether those of a loss fit together."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

from tensordict import NestedKey
from torch import Tensor, nn

from torchrl_etdmpc.modules import WorldModel
from torchrl_etdmpc.objectives.latent_rollout import LatentRollout
from torchrl_etdmpc.objectives.slices import Slices

KLDirection = Literal["backward", "forward"]
"""``"backward"`` is ``KL(pi || plan)``, ``"forward"`` is ``KL(plan || pi)``."""
TermFunction = Callable[[WorldModel, Slices, LatentRollout], Tensor | tuple[Tensor, dict[str, Tensor]]]
"""A term of one's own: errors ``[T, B]``, or errors and metrics."""

PRIORITY = "priority"
"""Name, among a term's metrics, of the errors ``[T, B]`` that priorities are made of where the batch has weights."""


@dataclass(frozen=True, eq=False)
class Term:
    """One term of a loss: an error of every step of every slice, and what it needs.

    A function that is an ``nn.Module`` brings networks of its own: the loss owns, saves, moves and trains them. The
    gradient goes wherever the function lets it; it detaches what it must not train.

    Attributes:
        name (str): gives the names of the entry ``loss_<name>`` and of the coefficient ``<name>_coef``.
        function (callable): world model, :class:`Slices` and :class:`LatentRollout` to an error ``[T, B]``, or to the
            error and a dictionary of metrics (``[T, B]``, of which the loss takes the mean, or scalars).
        coef (float): weight of the term.
        networks (tuple of str): networks of the world model that the loss trains because of it.
        targets (tuple of str): networks whose target network it reads, ``rollout.targets[name]``; some term trains
            them.
        keys (tuple of NestedKey): what it reads beside observations and actions: names of fields of :class:`Slices`
            (``"reward"``, ``"terminated"``, ``"plan_loc"``, ``"plan_scale"``), or keys of the batch, which it finds in
            ``slices.extra``.
        metrics (tuple of str, optional): the metrics that it reports; ``<name>_error``, the mean error, is the loss's
            to fill in. Default: that one alone.
        scalars (mapping): further numbers, which become buffers of the loss.
        decayed (bool): whether step k is weighted by ``rho^k``.

    >>> from torchrl.objectives import SoftUpdate
    >>> from torchrl_etdmpc.objectives import EfficientTDMPCLoss
    >>> from torchrl_etdmpc.testing import random_slices
    >>> def small_actions(world_model, slices, rollout):
    ...     mean, _ = world_model.policy(rollout.predicted[:-1].detach())  # [T, F, B, A]
    ...     return mean.square().mean((1, -1))
    >>> model = WorldModel(3, 2, latent_dim=16, mlp_dim=32)
    >>> loss = EfficientTDMPCLoss(model, discount=0.99, extra_terms=[Term("small_actions", small_actions, coef=0.1)])
    >>> updater = SoftUpdate(loss, tau=0.01)
    >>> "loss_small_actions" in loss(random_slices(3, 2))
    True
    """

    name: str
    function: TermFunction
    coef: float = 1.0
    networks: tuple[str, ...] = ()
    targets: tuple[str, ...] = ()
    keys: tuple[NestedKey, ...] = ()
    metrics: tuple[str, ...] | None = None
    scalars: Mapping[str, float] = field(default_factory=dict)
    decayed: bool = True

    @property
    def metric_names(self) -> tuple[str, ...]:
        """Names of the metrics that the loss returns for this term."""
        return (f"{self.name}_error",) if self.metrics is None else self.metrics

    def evaluate(
        self, world_model: WorldModel, slices: Slices, rollout: LatentRollout
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Error ``[T, B]`` and metrics.

        Raises:
            ValueError: if the shapes of error or metrics, or the metrics' names or kinds are others than stated.
        """
        result = self.function(world_model, slices, rollout)
        error, metrics = result if isinstance(result, tuple) else (result, {})
        for name, metric in metrics.items():
            if not isinstance(metric, Tensor) or not metric.is_floating_point():
                kind = metric.dtype if isinstance(metric, Tensor) else type(metric).__name__
                raise ValueError(
                    f"the metric {name!r} of the term {self.name!r} must be a floating point tensor, got {kind}; "
                    "convert it, e.g. with .float()."
                )
            if metric.ndim and metric.shape != slices.action.shape[:2]:
                raise ValueError(
                    f"the metric {name!r} of the term {self.name!r} must be of shape [T, B]="
                    f"{list(slices.action.shape[:2])} or a scalar, got {list(metric.shape)}; average over what is more."
                )
        if error.shape != slices.action.shape[:2]:
            raise ValueError(
                f"the term {self.name!r} must return an error of shape [T, B]={list(slices.action.shape[:2])}, got "
                f"{list(error.shape)}."
            )
        if f"{self.name}_error" in self.metric_names:
            metrics = {f"{self.name}_error": error, **metrics}
        if metrics.keys() - {PRIORITY} != set(self.metric_names):
            raise ValueError(
                f"the term {self.name!r} must return the metrics {sorted(self.metric_names)}, got {sorted(metrics)}; "
                "name them in Term(metrics=...)."
            )
        return error, metrics


def require_not_negative(**coefs: float) -> None:
    """Raises a ``ValueError`` where a coefficient of the method's own terms is below 0: it would train away from it."""
    for name, coef in coefs.items():
        if coef < 0:
            raise ValueError(f"{name} must not be negative, got {coef}; 0 leaves the term out of the sum.")


def require_discount(discount: float) -> None:
    """Raises a ``ValueError`` where the discount is not in (0, 1]."""
    if not 0 < discount <= 1:
        raise ValueError(f"discount must be in (0, 1], got {discount}; see discount_from_episode_length.")


def check_terms(
    terms: Sequence[Term], extra_terms: Sequence[Term], *, networks: Collection[str], reserved: Collection[str]
) -> None:
    """Whether a loss can be made of these terms.

    Args:
        terms (sequence of Term): the loss's own; one may have the name of the network that it trains.
        extra_terms (sequence of Term): the user's.

    Keyword Args:
        networks (collection of str): names of the networks that there may be.
        reserved (collection of str): what the loss has of other names.

    Raises:
        TypeError: if something in the lists is not a :class:`Term`.
        ValueError: if a name is there twice or means something else, or a term asks for what no loss has.
    """
    named = [("terms", term) for term in terms] + [("extra_terms", term) for term in extra_terms]
    for argument, term in named:
        if not isinstance(term, Term):
            raise TypeError(f"{argument} must be a list of Term(name, function, coef), got {term!r} in it.")
        _check_names(term, networks)
    trained = {name for _, term in named for name in term.networks}
    taken = set(reserved)
    for argument, term in named:
        named_after_network = argument == "terms" and not isinstance(term.function, nn.Module)
        others = taken if named_after_network else taken.union(networks)
        if not term.name.isidentifier() or _is_taken(term.name, others) or _is_taken(f"{term.name}_coef", others):
            raise ValueError(f"{argument} must have names of their own, got {term.name!r}; choose another one.")
        taken |= {term.name, f"{term.name}_coef"}
        for name in (*term.scalars, *term.metric_names):
            if _is_taken(name, taken.union(networks)) or name.startswith("loss_") or name == PRIORITY:
                raise ValueError(
                    f"metrics and scalars must have names of their own, got {name!r} of the term {term.name!r}; "
                    "choose another one."
                )
            taken.add(name)
        idle = [name for name in term.targets if name not in trained]
        if idle:
            raise ValueError(f"the target {idle[0]!r} of the term {term.name!r} is of a network that no term trains.")


def _check_names(term: Term, networks: Collection[str]) -> None:
    for argument in ("networks", "targets", "keys", "metrics"):
        names = getattr(term, argument)
        if isinstance(names, str):
            raise ValueError(
                f"{argument} of the term {term.name!r} must be a tuple of names, got {names!r}; write ({names!r},)."
            )
        unknown = [] if argument in ("keys", "metrics") else [name for name in names if name not in networks]
        if unknown:
            raise ValueError(
                f"{argument} of the term {term.name!r} must be some of {', '.join(networks)}, got {unknown[0]!r}."
            )


def _is_taken(name: str, taken: Collection[str]) -> bool:
    return name in taken or name.startswith("target_") or name.endswith("_params")
