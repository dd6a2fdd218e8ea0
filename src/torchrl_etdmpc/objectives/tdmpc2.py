"""The whole loss of TD-MPC2 on one shared latent rollout."""

from __future__ import annotations

from collections.abc import Sequence

from torchrl_etdmpc.modules import ActionValueWorldModel
from torchrl_etdmpc.objectives.action_value import action_value_term
from torchrl_etdmpc.objectives.latent_rollout_loss import LatentRolloutLoss, Reduction
from torchrl_etdmpc.objectives.max_q import max_q_term
from torchrl_etdmpc.objectives.running_scale import register_scale
from torchrl_etdmpc.objectives.terms import Term
from torchrl_etdmpc.objectives.world_model import model_terms


class TDMPC2Loss(LatentRolloutLoss):
    """Model, action-value and policy loss of TD-MPC2 (arXiv:2310.16828, section 3).

    The terms of the model are those of :class:`EfficientTDMPCModelLoss`. The action values learn from replayed rewards
    and the least of two random target heads; the policy maximises the mean of two random heads, divided by a running
    scale of it (5th to 95th percentile at k = 0, at least 1; moved only in training mode), and its entropy. The policy
    term sends no gradient into world model and action values and the other terms send none into the policy, so one
    backward pass serves both optimisers.

    Use :class:`torchrl.objectives.SoftUpdate` (``tau=0.01``) on this loss for the target heads.

    Args:
        world_model (ActionValueWorldModel): the networks, shared with the caller (the planner sees every update).

    Keyword Args:
        discount (float): gamma, in (0, 1], the planners' too.
        consistency_coef (float): Default: 20.
        reward_coef (float): Default: 0.1.
        value_coef (float): Default: 0.1.
        termination_coef (float): used with a termination head. Default: 1.
        policy_coef (float): Default: 1.
        entropy_coef (float): Default: 1e-4.
        squashed_entropy (bool): whether the entropy is that of the squashed actions; ``False`` is that of the Gaussian
            before the tanh, as in the published code. Default: ``True``.
        scale_tau (float): rate of the running scale. Default: 0.01.
        rho (float): weight decay per step of the rollout, in (0, 1]. Default: 0.5.
        extra_terms (sequence of Term): terms of one's own, see :class:`Term`. Default: none.
        ignore_termination (bool): whether to accept rows that terminate although the world model has no termination
            head: values are then bootstrapped through the end of an episode. Otherwise such a row on the CPU is an
            error; on CUDA, where looking would wait for the device, nothing is checked. Default: ``False``.
        reduction (str): ``"mean"`` (default), ``"sum"`` or ``"none"`` (``[B, T]``).

    Raises:
        ValueError: if an argument is out of range, or a name of a term is taken.
        TypeError: if the world model has no action values, or an extra term is not a :class:`Term`.

    >>> from torchrl.objectives import SoftUpdate
    >>> from torchrl_etdmpc.testing import random_slices
    >>> loss = TDMPC2Loss(ActionValueWorldModel(3, 2, latent_dim=16, mlp_dim=32), discount=0.99)
    >>> updater = SoftUpdate(loss, tau=0.01)
    >>> sorted(key for key in loss(random_slices(3, 2)).keys() if not key.startswith("loss_"))
    ['consistency_error', 'policy_entropy', 'policy_value', 'q_scale', 'reward_error', 'value_error', 'value_target']
    """

    def __init__(
        self,
        world_model: ActionValueWorldModel,
        *,
        discount: float,
        consistency_coef: float = 20.0,
        reward_coef: float = 0.1,
        value_coef: float = 0.1,
        termination_coef: float = 1.0,
        policy_coef: float = 1.0,
        entropy_coef: float = 1e-4,
        squashed_entropy: bool = True,
        scale_tau: float = 0.01,
        rho: float = 0.5,
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
                action_value_term(self, world_model, value_coef=value_coef, discount=discount),
                max_q_term(self, policy_coef=policy_coef, entropy_coef=entropy_coef, squashed_entropy=squashed_entropy),
            ],
            extra_terms=extra_terms,
            rho=rho,
            ignore_termination=ignore_termination,
            reduction=reduction,
        )
        register_scale(self, "q_scale", scale_tau)

    def reset_parameters_recursive(self) -> None:
        """Draws new weights for every network, made by no update yet; the targets become copies of the new ones."""
        super().reset_parameters_recursive()
        self.world_model.version.zero_()
