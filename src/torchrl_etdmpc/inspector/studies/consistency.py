"""How much of a plan survives to the next step? The plan before, shifted by one, against the new one."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchrl_etdmpc.functional import shift_plan
from torchrl_etdmpc.inspector.studies.replan import generator_of, replan
from torchrl_etdmpc.inspector.studies.states import States, episode_interval
from torchrl_etdmpc.planners import EnsembleMPPIPlanner

COMPARED = ("warm start", "cold start", "other samples")


class Consistency(NamedTuple):
    """Distance of two plans of the same step, in standard deviations of the plan from the warm start, from S states."""

    change: Tensor
    """``[S, 3, H]``, root mean squared over action dimensions; by ``COMPARED``. The first two are from the plan
    before, which has nothing to say of the last depth: NaN there."""
    std: Tensor
    """Of the plan from the warm start, mean over action dimensions, ``[S, H]``."""
    episode: Tensor
    """``[S]``"""


def consistency(planner: EnsembleMPPIPlanner, states: States, *, seed: int = 0) -> Consistency:
    """Plans anew in every state, from the warm start and without it, and compares with the plan before.

    What other random numbers change about a plan of the same state is measured as well: a plan cannot be more
    consistent than it is determined.

    Args:
        planner (EnsembleMPPIPlanner): that played the episodes of the states, with its warm start.
        states (States): where to plan; those without a plan before are left out.

    Keyword Args:
        seed (int): of the plans.

    Raises:
        ValueError: if the states have no plans before them, or the planner does not read them (``initial="policy"``).
    """
    if planner.initial == "policy":
        raise ValueError("the planner begins with its policy's plan (initial=policy) and reads no plan before.")
    if states.plan_mean is None or not (states.step > 0).any():
        raise ValueError(
            "states must have plans before them, got none; play the episodes with a planner that has warm_start=True."
        )
    kept = states.step > 0
    observation, carried = states.observation[kept], states.plan_mean[kept]
    generator = generator_of(planner, seed)
    warm = replan(planner, observation, carried, generator=generator, trace=True)
    again = replan(planner, observation, carried, generator=generator)
    cold = replan(planner, observation, generator=generator)
    assert warm.trace is not None
    std = warm.trace.std[:, -1]
    before = shift_plan(carried)
    before[:, -1] = torch.nan
    pairs = ((warm.mean, before), (cold.mean, before), (warm.mean, again.mean))
    change = torch.stack([((one - other) / std).square().mean(-1).sqrt() for one, other in pairs], dim=1)
    return Consistency(change, std.mean(-1), states.episode[kept])


def table(result: Consistency) -> list[dict[str, Any]]:
    """Mean change with its interval, by what is compared and depth."""
    interval = episode_interval(result.change, result.episode)
    return [
        {
            "compared": name,
            "depth": depth + 1,
            "change_in_std": interval.value[row, depth].item(),
            "low": interval.low[row, depth].item(),
            "high": interval.high[row, depth].item(),
            "within_one_std": (result.change[:, row, depth] < 1).double().mean().item(),
            "std": result.std[:, depth].mean().item(),
            "states": len(result.episode),
        }
        for row, name in enumerate(COMPARED)
        for depth in range(result.change.shape[-1])
        if not result.change[:, row, depth].isnan().any()
    ]


def lines(result: Consistency) -> list[str]:
    """What came out, of the action that is taken next."""
    return [
        f"{row['compared']}, the first action: moved by {row['change_in_std']:.2f} std "
        f"[{row['low']:.2f}, {row['high']:.2f}], in {row['within_one_std']:.0%} of the states by less than one"
        for row in table(result)
        if row["depth"] == 1
    ]


def figure(result: Consistency) -> Any:
    """Mean change by depth with 95% intervals."""
    from matplotlib.figure import Figure

    rows = table(result)
    picture = Figure(figsize=(4.8, 3.1), layout="constrained")
    axis = picture.subplots()
    labels = ("new plan, warm start", "new plan, cold start", "same state, other samples")
    styles = zip(COMPARED, labels, ("#0072B2", "#D55E00", "#009E73"), ("o", "x", "s"), strict=True)
    for number, (name, label, colour, marker) in enumerate(styles):
        part = [row for row in rows if row["compared"] == name]
        middle = [row["change_in_std"] for row in part]
        reach = [
            [row["change_in_std"] - row["low"] for row in part],
            [row["high"] - row["change_in_std"] for row in part],
        ]
        places = [row["depth"] + 0.06 * (number - 1) for row in part]
        axis.errorbar(places, middle, reach, color=colour, marker=marker, capsize=3, label=label)
    axis.set_xticks(range(1, result.change.shape[-1] + 1))
    axis.set_ylim(bottom=0)
    axis.set_xlabel("depth")
    axis.set_ylabel("change of the mean, in std")
    axis.legend(frameon=False)
    return picture
