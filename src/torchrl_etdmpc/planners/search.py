"""The iterations of MPPI, whatever scores the candidates, and the sequence that a plan follows."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from torchrl_etdmpc.functional import (
    Elites,
    Gaussian,
    elite_weights,
    fit_gaussian,
    sample_elite,
    sample_sequences,
    select_elites,
)
from torchrl_etdmpc.planners.arguments import FirstAction
from torchrl_etdmpc.planners.plan import PlanTrace

Evaluate = Callable[[Tensor, int], tuple[Tensor, Tensor]]
"""Sequences ``[B, N, H, A]`` and the iteration to scores ``[B, N]`` and return table ``[B, N, D, F, V]``."""


class Search(NamedTuple):
    """Where the iterations ended."""

    gaussian: Gaussian
    """The last fit, ``[B, H, A]``."""
    elites: Elites
    """Of the last iteration."""
    weights: Tensor
    """Of the elites, ``[B, K]``."""
    fallback: Tensor
    """Whether no candidate had a finite score, ``[B]``."""
    steps: list[PlanTrace]
    """Every iteration, if asked for."""


def search(
    gaussian: Gaussian,
    proposals: Tensor,
    noise: Tensor,
    evaluate: Evaluate,
    *,
    iterations: int,
    num_elites: int,
    inverse_temperature: float,
    std_min: float,
    std_max: float,
    trace: bool,
) -> Search:
    """Draws candidates, scores them and refits the Gaussian, once per iteration, for B states.

    Args:
        gaussian (Gaussian): of the first candidates, ``[B, H, A]``.
        proposals (Tensor): candidates of every iteration, ``[B, P, H, A]``; scored in the first one.
        noise (Tensor): standard normal draws, ``[B, I, N - P, H, A]``.
        evaluate (callable): scores and return table of sequences.

    Keyword Args:
        iterations (int): I.
        num_elites (int): K.
        inverse_temperature (float): of the elites' weights.
        std_min (float): of a fitted Gaussian.
        std_max (float): likewise.
        trace (bool): whether to keep every iteration.
    """
    steps, proposed = [], None
    for iteration in range(iterations):
        actions = sample_sequences(gaussian, noise[:, iteration])
        if proposed is None:
            actions = torch.cat([proposals, actions], dim=1)
            scores, returns = evaluate(actions, iteration)
            number = proposals.shape[1]
            proposed = proposals, scores[:, :number], returns[:, :number]
        else:
            # Departure from TD-MPC2, which scores the proposals anew in every iteration: they keep the scores of the
            # first one, which differ from the later ones by other draws alone.
            drawn = actions, *evaluate(actions, iteration)
            actions, scores, returns = (torch.cat(pair, dim=1) for pair in zip(proposed, drawn, strict=True))
        elites = select_elites(actions, scores, num_elites)
        weights = elite_weights(elites.scores, inverse_temperature)
        fitted = fit_gaussian(elites.actions, weights, std_min=std_min, std_max=std_max)
        fallback = elites.scores[:, 0].isinf()
        keep = fallback[:, None, None]
        gaussian = Gaussian(*(torch.where(keep, old, new) for old, new in zip(gaussian, fitted, strict=True)))
        if trace:
            steps.append(PlanTrace(actions, scores, returns, *gaussian))
    # There is at least one iteration.
    return Search(gaussian, elites, weights, fallback, steps)  # pyright: ignore[reportPossiblyUnboundVariable]


def chosen_sequence(found: Search, choice: FirstAction, uniform: Tensor) -> tuple[Tensor, Tensor]:
    """First action ``[B, A]`` and score ``[B]`` of the chosen sequence; ``uniform [B, K]`` draws the elite."""
    # Departure from the thesis, whose formula has the fitted mean, and from BMPC, which draws an elite in every mode:
    # the texts disagree, so it is a choice; the best candidate acts in evaluation.
    first, scores = found.elites.actions[:, :, 0], found.elites.scores
    if choice == "mean":
        return found.gaussian.mean[:, 0], (found.weights * torch.where(scores.isfinite(), scores, 0)).sum(-1)
    if choice == "best":
        return first[:, 0], scores[:, 0]
    index = sample_elite(found.weights, uniform).unsqueeze(-1)
    action = first.gather(1, index.unsqueeze(-1).expand(-1, -1, first.shape[-1]))
    return action.squeeze(1), scores.gather(1, index).squeeze(1)
