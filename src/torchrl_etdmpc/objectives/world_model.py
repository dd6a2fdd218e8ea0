"""Consistency, reward and termination: the terms that teach the world model to predict."""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor

from torchrl_etdmpc.functional import two_hot_cross_entropy
from torchrl_etdmpc.modules import WorldModel
from torchrl_etdmpc.objectives.latent_rollout import LatentRollout, head_rows, mean_of_head_rows
from torchrl_etdmpc.objectives.latent_rollout_loss import LatentRolloutLoss, Reduction
from torchrl_etdmpc.objectives.slices import Slices
from torchrl_etdmpc.objectives.terms import Term, require_not_negative


def consistency_error(rollout: LatentRollout) -> Tensor:
    """Squared distance between each head's prediction and the encoding, ``(zhat_{k+1,i} - sg(z_{k+1}))^2``.

    Thesis Eq. 2.11 and appendix B.

    Args:
        rollout (LatentRollout): T steps of F heads.

    Returns:
        Tensor: mean over latent dimensions and heads, shape ``[T, B]``.

    >>> import torch
    >>> consistency_error(LatentRollout(torch.zeros(3, 4, 16), torch.ones(3, 2, 4, 16))).tolist()
    [[1.0, 1.0, 1.0, 1.0], [1.0, 1.0, 1.0, 1.0]]
    """
    # Departure from the thesis, whose Eq. 2.11 has the squared norm: the mean over the latent, as in TD-MPC2's code,
    # for which the coefficient of 20 is meant.
    return (rollout.predicted[1:] - rollout.encoded[1:].unsqueeze(1)).square().mean(-1).mean(1)


def reward_error(world_model: WorldModel, rollout: LatentRollout, slices: Slices) -> Tensor:
    """Cross-entropy of the reward read on every head's own rollout, ``CE(R(zhat_{k,i}, a_k), r_k)``.

    Thesis Eq. 2.12 and appendix B.

    Args:
        world_model (WorldModel): the reward head.
        rollout (LatentRollout): T steps of F heads.
        slices (Slices): the replayed actions and rewards.

    Returns:
        Tensor: mean over heads, shape ``[T, B]``.

    >>> from torchrl_etdmpc.objectives import EfficientTDMPCLoss
    >>> from torchrl_etdmpc.objectives.latent_rollout import latent_rollout
    >>> from torchrl_etdmpc.testing import random_slices
    >>> world_model = WorldModel(3, 2, latent_dim=16, mlp_dim=32)
    >>> slices = EfficientTDMPCLoss(world_model, discount=0.99).slices(random_slices(3, 2))
    >>> reward_error(world_model, latent_rollout(world_model, slices), slices).shape
    torch.Size([3, 4])
    """
    assert slices.reward is not None
    heads = world_model.num_dynamics
    logits = world_model.reward_head(head_rows(rollout.predicted[:-1]), head_rows(slices.action, heads))
    error = two_hot_cross_entropy(logits, head_rows(slices.reward, heads), world_model.bins)
    return mean_of_head_rows(error, heads)


def termination_error(world_model: WorldModel, rollout: LatentRollout, slices: Slices) -> Tensor:
    """Binary cross-entropy of the termination that step k reached, read at ``zhat_{k+1,i}``.

    Args:
        world_model (WorldModel): the termination head.
        rollout (LatentRollout): T steps of F heads.
        slices (Slices): the replayed flags.

    Returns:
        Tensor: mean over heads, shape ``[T, B]``.

    >>> from torchrl_etdmpc.objectives import EfficientTDMPCLoss
    >>> from torchrl_etdmpc.objectives.latent_rollout import latent_rollout
    >>> from torchrl_etdmpc.testing import random_slices
    >>> world_model = WorldModel(3, 2, latent_dim=16, mlp_dim=32, termination=True)
    >>> slices = EfficientTDMPCLoss(world_model, discount=0.99).slices(random_slices(3, 2, terminated=True))
    >>> termination_error(world_model, latent_rollout(world_model, slices), slices).shape
    torch.Size([3, 4])
    """
    assert world_model.termination_head is not None and slices.terminated is not None
    logits = world_model.termination_head(rollout.predicted[1:])
    flags = slices.terminated.unsqueeze(1).expand_as(logits).to(logits.dtype)
    return F.binary_cross_entropy_with_logits(logits, flags, reduction="none").mean(1)


class EfficientTDMPCModelLoss(LatentRolloutLoss):
    """Latent consistency, reward and (with a termination head) termination loss.

    Thesis Eq. 2.11 and 2.12, on every dynamics head's own rollout (appendix B). Trains encoder, dynamics, reward and
    termination heads.

    Args:
        world_model (WorldModel): the networks, shared with the caller.

    Keyword Args:
        consistency_coef (float): weight of the consistency term. Default: 20.
        reward_coef (float): weight of the reward term. Default: 0.1.
        termination_coef (float): weight of the termination term. Default: 1.
        rho (float): weight decay per step of the rollout, in (0, 1]. Default: 0.5. The termination term is not
            decayed: a terminal state is always the last of its slice, so a decay would bias the predicted probability.
        ignore_termination (bool): whether to accept rows that terminate although the world model has no termination
            head: nothing then learns that an episode can end, and who plans with the model imagines on. Otherwise
            such a row on the CPU is an error; on CUDA, where looking would wait for the device, nothing is checked.
            Default: ``False``.
        reduction (str): ``"mean"`` (default), ``"sum"`` or ``"none"`` (``[B, T]``).

    Raises:
        ValueError: if an argument is out of range.

    >>> from torchrl_etdmpc.testing import random_slices
    >>> world_model = WorldModel(3, 2, latent_dim=16, mlp_dim=32)
    >>> sorted(EfficientTDMPCModelLoss(world_model)(random_slices(3, 2)).keys())
    ['consistency_error', 'loss_consistency', 'loss_reward', 'reward_error']
    """

    def __init__(
        self,
        world_model: WorldModel,
        *,
        consistency_coef: float = 20.0,
        reward_coef: float = 0.1,
        termination_coef: float = 1.0,
        rho: float = 0.5,
        ignore_termination: bool = False,
        reduction: Reduction | None = None,
    ) -> None:
        super().__init__(
            world_model,
            model_terms(
                world_model,
                consistency_coef=consistency_coef,
                reward_coef=reward_coef,
                termination_coef=termination_coef,
            ),
            rho=rho,
            reduction=reduction,
            ignore_termination=ignore_termination,
        )


def model_terms(
    world_model: WorldModel, *, consistency_coef: float, reward_coef: float, termination_coef: float
) -> list[Term]:
    """The terms of the world model; that of the termination only where it has a head for it.

    Raises:
        ValueError: if a coefficient is negative.
    """
    require_not_negative(consistency_coef=consistency_coef, reward_coef=reward_coef, termination_coef=termination_coef)
    rolled = ("encoder", "dynamics")
    terms = [
        Term("consistency", _consistency, consistency_coef, networks=rolled),
        Term("reward", _reward, reward_coef, networks=(*rolled, "reward"), keys=("reward",)),
    ]
    if world_model.termination_head is not None:
        # Departure from the thesis, which states no weight: not decayed with rho, because a terminal state is always
        # the last of its slice and a decay would bias the probability.
        terms.append(
            Term(
                "termination",
                _termination,
                termination_coef,
                networks=(*rolled, "termination"),
                keys=("terminated",),
                decayed=False,
            )
        )
    return terms


def _consistency(world_model: WorldModel, slices: Slices, rollout: LatentRollout) -> Tensor:
    return consistency_error(rollout)


def _reward(world_model: WorldModel, slices: Slices, rollout: LatentRollout) -> Tensor:
    return reward_error(world_model, rollout, slices)


def _termination(world_model: WorldModel, slices: Slices, rollout: LatentRollout) -> Tensor:
    return termination_error(world_model, rollout, slices)
