"""The whole loss of EfficientTDMPC on one shared latent rollout."""

from __future__ import annotations

from collections.abc import Sequence

from torchrl_etdmpc.modules import WorldModel
from torchrl_etdmpc.objectives.latent_rollout_loss import LatentRolloutLoss, Reduction
from torchrl_etdmpc.objectives.policy import policy_term
from torchrl_etdmpc.objectives.running_scale import register_scale
from torchrl_etdmpc.objectives.terms import KLDirection, Term
from torchrl_etdmpc.objectives.value import value_term
from torchrl_etdmpc.objectives.world_model import model_terms


class EfficientTDMPCLoss(LatentRolloutLoss):
    """Model, value and policy loss of EfficientTDMPC (thesis 2.3, 2.4, 3.2 and appendix B).

    The sum of :class:`EfficientTDMPCModelLoss`, :class:`EfficientTDMPCValueLoss` and :class:`EfficientTDMPCPolicyLoss`,
    computed on one latent rollout. The policy term sends no gradient into the world model and the other terms send none
    into the policy, so one backward pass serves both optimisers.

    Reads slices ``[B, T]`` with ``observation``, ``action``, ``("next", "observation")``, ``("next", "reward")``,
    ``("next", "terminated")``, ``("plan", "loc")`` and ``("plan", "scale")`` (``torchrl_etdmpc.keys``). Returns
    weighted ``loss_*``, to be summed, and detached metrics.

    Use :class:`torchrl.objectives.SoftUpdate` (``tau=0.01``) on this loss for the target value heads.

    Args:
        world_model (WorldModel): the networks, shared with the caller (the planner sees every update).

    Keyword Args:
        discount (float): gamma, in (0, 1], the planners' too.
        consistency_coef (float): weight of predicting the next latent, not negative. Default: 20.
        reward_coef (float): weight of predicting the reward, not negative. Default: 0.1.
        value_coef (float): weight of the value targets, not negative. Default: 0.1.
        value_beta (float): pessimism of the value targets, the weight of the ensemble's standard deviation, not
            negative. Default: 0, the mean.
        value_replayed (float): weight of the n-step returns of replayed rewards in the value targets
            (:func:`~torchrl_etdmpc.objectives.replayed_value_target`), in [0, 1]; imagined targets have the rest. Not
            in the thesis. Default: 0.
        value_expectile (float): which expectile of the value targets the values learn, in (0, 1); above 0.5, targets
            above the value count more (:func:`~torchrl_etdmpc.objectives.value_error`). Not in the thesis. Default:
            0.5, the mean.
        termination_coef (float): used with a termination head. Default: 1.
        policy_coef (float): weight of the distillation, not negative. Default: 1.
        entropy_coef (float): weight of the policy's entropy, not negative. Default: 1e-4.
        scale_tau (float): rate of the running scale of the KL. Default: 0.01.
        kl_direction (str): ``"backward"`` (default, KL(pi || plan)) or ``"forward"``.
        rho (float): weight decay per step of the rollout, in (0, 1]. Default: 0.5.
        distill (bool): whether to compute the policy term. The attribute can be changed later: pretraining on random
            data turns it off. The policy then has no gradient; where ``torch.distributed`` is initialised, and
            ``DistributedDataParallel`` waits for one, it has a gradient of zero. Default: ``True``.
        extra_terms (sequence of Term): terms of one's own, see :class:`Term`. Default: none.
        ignore_termination (bool): whether to accept rows that terminate although the world model has no termination
            head: values are then bootstrapped through the end of an episode. Otherwise such a row on the CPU is an
            error; on CUDA, where looking would wait for the device, nothing is checked. Default: ``False``.
        reduction (str): ``"mean"`` (default), ``"sum"`` or ``"none"`` (``[B, T]``).

    Raises:
        ValueError: if an argument is out of range, or a name of a term is taken.
        TypeError: if an extra term is not a :class:`Term`.

    >>> from torchrl.objectives import SoftUpdate
    >>> from torchrl_etdmpc.testing import random_slices
    >>> loss = EfficientTDMPCLoss(WorldModel(3, 2, latent_dim=16, mlp_dim=32), discount=0.99)
    >>> updater = SoftUpdate(loss, tau=0.01)
    >>> out = loss(random_slices(3, 2))
    >>> sorted(key for key in out.keys() if key.startswith("loss_"))
    ['loss_consistency', 'loss_policy', 'loss_reward', 'loss_value']
    """

    def __init__(
        self,
        world_model: WorldModel,
        *,
        discount: float,
        consistency_coef: float = 20.0,
        reward_coef: float = 0.1,
        value_coef: float = 0.1,
        value_beta: float = 0.0,
        value_replayed: float = 0.0,
        value_expectile: float = 0.5,
        termination_coef: float = 1.0,
        policy_coef: float = 1.0,
        entropy_coef: float = 1e-4,
        scale_tau: float = 0.01,
        kl_direction: KLDirection = "backward",
        rho: float = 0.5,
        distill: bool = True,
        extra_terms: Sequence[Term] = (),
        ignore_termination: bool = False,
        reduction: Reduction | None = None,
    ) -> None:
        super().__init__(
            world_model,
            [
                *model_terms(
                    world_model,
                    consistency_coef=consistency_coef,
                    reward_coef=reward_coef,
                    termination_coef=termination_coef,
                ),
                value_term(
                    self,
                    world_model,
                    value_coef=value_coef,
                    value_beta=value_beta,
                    value_replayed=value_replayed,
                    value_expectile=value_expectile,
                    discount=discount,
                ),
                policy_term(self, policy_coef=policy_coef, entropy_coef=entropy_coef, kl_direction=kl_direction),
            ],
            extra_terms=extra_terms,
            rho=rho,
            ignore_termination=ignore_termination,
            reduction=reduction,
        )
        register_scale(self, "kl_scale", scale_tau)
        self.distill = distill

    def reset_parameters_recursive(self) -> None:
        """Draws new weights for every network, made by no update yet; the targets become copies of the new ones."""
        super().reset_parameters_recursive()
        self.world_model.version.zero_()
