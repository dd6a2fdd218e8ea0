"""A planner's arguments: the choices that there are, and what is out of range."""

from __future__ import annotations

import math
from typing import Literal, get_args

import torch

FirstAction = Literal["elite", "mean", "best"]
"""Whose first action is the mean of the target: an elite drawn by its weight, the fitted mean, or the best
candidate."""
InitialPlan = Literal["wide", "policy"]
"""Where a search begins: around the carried plan or zeros with the largest deviation, or where the policy is."""
ScoringDtype = Literal["float16", "bfloat16", "float32", "float64"]
"""Names of the dtypes in which candidates can be scored."""
_SMALLEST_STD = 1e-6
"""Far below it single precision has no finite loss, and 0 is what a state without a plan has."""


def check_budget(
    horizon: int, num_samples: int, num_elites: int, num_proposals: int, iterations: int, extra_iterations: int
) -> None:
    """Refuses numbers that leave nothing to search with."""
    for name, number in {"horizon": horizon, "iterations": iterations, "num_elites": num_elites}.items():
        if number < 1:
            raise ValueError(f"{name} must be at least 1, got {number}.")
    if num_elites > num_samples:
        raise ValueError(f"num_elites must be at most num_samples={num_samples}, got {num_elites}.")
    if not 0 <= num_proposals < num_samples:
        raise ValueError(f"num_proposals must be in [0, num_samples={num_samples}), got {num_proposals}.")
    if extra_iterations < 0:
        raise ValueError(f"extra_iterations must not be negative, got {extra_iterations}.")


def check_fit(discount: float, inverse_temperature: float, std_min: float, std_max: float) -> None:
    """Refuses numbers that candidates cannot be weighed or spread by."""
    if not 0 < discount <= 1:
        raise ValueError(f"discount must be in (0, 1], got {discount}.")
    if not 0 <= inverse_temperature < math.inf:
        raise ValueError(f"inverse_temperature must be finite and not negative, got {inverse_temperature}.")
    if not 0 < std_max < math.inf:
        raise ValueError(f"std_max must be finite and positive, got {std_max}.")
    if not _SMALLEST_STD <= std_min <= std_max:
        raise ValueError(f"std_min must be in [{_SMALLEST_STD:g}, std_max={std_max}], got {std_min}.")


def check_choices(first_action: str, eval_first_action: str, initial: str) -> None:
    """Refuses names that are none of the choices."""
    for name, choice in {"first_action": first_action, "eval_first_action": eval_first_action}.items():
        if choice not in get_args(FirstAction):
            raise ValueError(f"{name} must be one of {', '.join(get_args(FirstAction))}, got {choice!r}.")
    if initial not in get_args(InitialPlan):
        raise ValueError(f"initial must be one of {', '.join(get_args(InitialPlan))}, got {initial!r}.")


def floating_dtype(dtype: torch.dtype | str | None) -> torch.dtype | None:
    """A dtype by its name, or as it is; refuses what has no fractions."""
    if dtype is None:
        return None
    if isinstance(dtype, str):
        if dtype not in get_args(ScoringDtype):
            raise ValueError(f"scoring_dtype must be one of {', '.join(get_args(ScoringDtype))}, got {dtype!r}.")
        return getattr(torch, dtype)
    if not dtype.is_floating_point:
        raise ValueError(f"scoring_dtype must be a floating point dtype, got {dtype}.")
    return dtype


def proposal_bounds(low: float | None, high: float | None) -> tuple[float, float] | None:
    """The bounds of the policy's log std while it proposes; refuses one without the other."""
    if low is None and high is None:
        return None
    if low is None or high is None:
        raise ValueError(
            f"proposal_log_std_min and proposal_log_std_max must be given together, got {low} and {high}; leave both "
            "out for the policy's own bounds."
        )
    if not -math.inf < low < high < math.inf:
        raise ValueError(f"proposal_log_std_min must be below proposal_log_std_max={high} and both finite, got {low}.")
    return low, high
