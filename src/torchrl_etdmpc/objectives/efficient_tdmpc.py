"""The whole loss of EfficientTDMPC on one shared latent rollout."""

from __future__ import annotations

from collections.abc import Mapping

from torch import Tensor

from torchrl_etdmpc.modules import WorldModel
from torchrl_etdmpc.objectives.latent_rollout import (
    ExtraTerm,
    KLDirection,
    LatentRollout,
    LatentRolloutLoss,
    Reduction,
    Slices,
)
from torchrl_etdmpc.objectives.policy import policy_terms, register_running_scale
from torchrl_etdmpc.objectives.value import register_discount, value_terms
from torchrl_etdmpc.objectives.world_model import model_terms


class EfficientTDMPCLoss(LatentRolloutLoss):
    """Model, value and policy loss of EfficientTDMPC (thesis 2.3, 2.4, 3.2 and appendix B).

    The sum of :class:`EfficientTDMPCModelLoss`, :class:`EfficientTDMPCValueLoss` and :class:`EfficientTDMPCPolicyLoss`,
    computed on one latent rollout. The policy term sends no gradient into the world model and the other terms send none
    into the policy, so one backward pass serves both optimisers.

    Use :class:`torchrl.objectives.SoftUpdate` (``tau=0.01``) on this loss for the target value heads.

    Args:
        world_model (WorldModel): the networks, shared with the caller (the planner sees every update).

    Keyword Args:
        discount (float): gamma, in (0, 1].
        consistency_coef (float): Default: 20.
        reward_coef (float): Default: 0.1.
        value_coef (float): Default: 0.1.
        termination_coef (float): used with a termination head. Default: 1.
        policy_coef (float): Default: 1.
        entropy_coef (float): Default: 1e-4.
        scale_tau (float): rate of the running scale of the KL. Default: 0.01.
        kl_direction (str): ``"backward"`` (default, KL(pi || plan)) or ``"forward"``.
        rho (float): weight decay per step of the rollout, in (0, 1]. Default: 0.5.
        distill (bool): whether to compute the policy term. The attribute can be changed later: pretraining on random
            data turns it off. Default: ``True``.
        extra_terms (mapping of str to ExtraTerm, optional): terms of one's own, weighted by ``rho^k`` like the others;
            ``name`` adds ``loss_name``, the metric ``name_error`` and the buffer ``name_coef``.
        ignore_termination (bool): whether to accept rows that terminate although the world model has no termination
            head: values are then bootstrapped through the end of an episode. Otherwise such a row on the CPU is an
            error; on CUDA, where looking would wait for the device, nothing is checked. Default: ``False``.
        reduction (str): ``"mean"`` (default), ``"sum"`` or ``"none"`` (``[B, T]``).

    Raises:
        ValueError: if an argument is out of range.

    >>> from torchrl.objectives import SoftUpdate
    >>> from torchrl_etdmpc.testing import random_slices
    >>> loss = EfficientTDMPCLoss(WorldModel(3, 2, latent_dim=16, mlp_dim=32), discount=0.99)
    >>> updater = SoftUpdate(loss, tau=0.01)
    >>> out = loss(random_slices(3, 2))
    >>> sorted(key for key in out.keys() if key.startswith("loss_"))
    ['loss_consistency', 'loss_policy', 'loss_reward', 'loss_value']
    """

    _schedulable_buffers = frozenset(
        {
            "consistency_coef",
            "reward_coef",
            "value_coef",
            "termination_coef",
            "policy_coef",
            "entropy_coef",
            "discount",
        }
    )

    def __init__(
        self,
        world_model: WorldModel,
        *,
        discount: float,
        consistency_coef: float = 20.0,
        reward_coef: float = 0.1,
        value_coef: float = 0.1,
        termination_coef: float = 1.0,
        policy_coef: float = 1.0,
        entropy_coef: float = 1e-4,
        scale_tau: float = 0.01,
        kl_direction: KLDirection = "backward",
        rho: float = 0.5,
        distill: bool = True,
        extra_terms: Mapping[str, ExtraTerm] | None = None,
        ignore_termination: bool = False,
        reduction: Reduction | None = None,
    ) -> None:
        super().__init__(
            world_model,
            networks=("encoder", "dynamics", "reward", "value", "termination", "policy"),
            coefficients={
                "consistency": consistency_coef,
                "reward": reward_coef,
                "value": value_coef,
                "policy": policy_coef,
                "entropy": entropy_coef,
                **({} if world_model.termination_head is None else {"termination": termination_coef}),
            },
            rho=rho,
            reduction=reduction,
            ignore_termination=ignore_termination,
            extra_terms=extra_terms,
        )
        register_discount(self, discount)
        register_running_scale(self, scale_tau, kl_direction)
        self.distill = distill

    def reset_parameters_recursive(self) -> None:
        """Draws new weights for every network, made by no update yet; the targets become copies of the new ones."""
        super().reset_parameters_recursive()
        self.world_model.version.zero_()

    @property
    def distill(self) -> bool:
        """Whether the policy term is computed."""
        return self._distill

    @distill.setter
    def distill(self, value: bool) -> None:
        self._distill = bool(value)
        self._in_keys = None

    @property
    def _reads(self) -> tuple[str, ...]:
        flags = () if self.world_model.termination_head is None else ("terminated",)
        plan = ("plan_loc", "plan_scale") if self.distill else ()
        return ("observation", "next_observation", "action", "reward", *flags, *plan)

    @property
    def _term_names(self) -> tuple[str, ...]:
        flags = () if self.world_model.termination_head is None else ("termination",)
        return ("consistency", "reward", *flags, "value", *(("policy",) if self.distill else ()))

    @property
    def _metric_names(self) -> tuple[str, ...]:
        flags = () if self.world_model.termination_head is None else ("termination_error",)
        policy = ("policy_kl", "policy_entropy", "kl_scale") if self.distill else ()
        return ("consistency_error", "reward_error", *flags, "value_error", "value_target", *policy)

    def _terms(
        self, slices: Slices, rollout: LatentRollout, target_values: dict[str, Tensor] | None
    ) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        parts = [model_terms(self, slices, rollout), value_terms(self, slices, rollout, target_values)]
        if self.distill:
            parts.append(policy_terms(self, slices, rollout))
        terms, metrics = {}, {}
        for part_terms, part_metrics in parts:
            terms.update(part_terms)
            metrics.update(part_metrics)
        return terms, metrics
