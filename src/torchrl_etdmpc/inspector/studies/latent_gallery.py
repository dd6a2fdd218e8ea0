"""Does pessimism keep the heads together? Plans in latent space beside what really happens (thesis A.3.2)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchrl_etdmpc.functional import ensemble_std
from torchrl_etdmpc.inspector.settings import with_settings
from torchrl_etdmpc.inspector.studies.components import components
from torchrl_etdmpc.inspector.studies.replan import (
    best_sequences,
    encode,
    generator_of,
    imagine,
    replan,
    return_estimates,
    true_returns,
)
from torchrl_etdmpc.inspector.studies.states import States, TrueWorld, episode_interval, roll_all
from torchrl_etdmpc.inspector.trace import head_spread
from torchrl_etdmpc.planners import EnsembleMPPIPlanner

SHOWN = 4  # states of the figure


class LatentGallery(NamedTuple):
    """Trajectories of the best plan of S states under each of b weights of the ensemble's deviation."""

    imagined: Tensor
    """Latents of each head, ``[S, b, F, H + 1, L]``."""
    true: Tensor
    """The encoded observations of the simulator, ``[S, b, H + 1, L]``; NaN after the end of the task."""
    returns: Tensor
    """Return table, ``[S, b, H, F, V]``."""
    true_returns: Tensor
    """``[S, b, H]``"""
    betas: tuple[float, ...]
    episode: Tensor
    """``[S]``"""

    @property
    def spread(self) -> Tensor:
        """Root mean squared distance of the heads from their mean, in latent space, ``[S, b, H]``."""
        return head_spread(self.imagined[:, :, :, 1:])

    @property
    def deviation(self) -> Tensor:
        """Standard deviation of the mean return estimate (thesis Eq. 3.3), which ``beta`` weighs, ``[S, b, H]``."""
        return ensemble_std(self.returns)

    @property
    def error(self) -> Tensor:
        """Distance of the heads' mean from the truth, ``[S, b, H]``; NaN after the end of the task."""
        return (self.imagined[:, :, :, 1:].mean(2) - self.true[:, :, 1:]).norm(dim=-1)


def latent_gallery(
    planner: EnsembleMPPIPlanner,
    states: States,
    simulator: TrueWorld,
    *,
    betas: Sequence[float] = (0.0, 10.0),
    horizon: int | None = None,
    seed: int = 0,
) -> LatentGallery:
    """Plans with each ``beta`` and follows the best sequence through every head and through the simulator.

    Args:
        planner (EnsembleMPPIPlanner): with a score that has a ``beta``.
        states (States): with H decisions after them.
        simulator (TrueWorld): of their task.

    Keyword Args:
        betas (sequence of float): Default: 0 and 10.
        horizon (int, optional): H. Default: the planner's.
        seed (int): of the plans; the same random numbers for every ``beta``.
    """
    fields = []
    for beta in betas:
        searcher = with_settings(planner, horizon=horizon or planner.horizon, beta=beta)
        plan = replan(searcher, states.observation, generator=generator_of(planner, seed), trace=True)
        actions = best_sequences(plan)
        rolled = roll_all(simulator, states, actions)
        fields.append(
            (
                imagine(planner, states.observation, actions),
                encode(planner, rolled[0]),
                return_estimates(planner, states.observation, actions.unsqueeze(1)).squeeze(1),
                true_returns(planner, *rolled),
            )
        )
    joined = (torch.stack(field, dim=1) for field in zip(*fields, strict=True))
    return LatentGallery(*joined, betas=tuple(map(float, betas)), episode=states.episode)


def table(result: LatentGallery) -> list[dict[str, Any]]:
    """Spread of the heads, error of their mean, deviation and mean of the estimates, true return; by beta and depth."""
    rows = []
    columns = {
        "spread": result.spread,
        "error": result.error,
        "deviation": result.deviation,
        "estimated_return": result.returns.mean((-2, -1)),
        "true_return": result.true_returns,
    }
    intervals = {
        name: episode_interval(values, result.episode, lambda rows: rows.nanmean(0)) for name, values in columns.items()
    }
    for number, beta in enumerate(result.betas):
        for depth in range(result.true_returns.shape[-1]):
            row: dict[str, Any] = {"beta": beta, "depth": depth + 1, "states": len(result.episode)}
            for name, interval in intervals.items():
                row[name], row[f"{name}_low"], row[f"{name}_high"] = (bound[number, depth].item() for bound in interval)
            rows.append(row)
    return rows


def lines(result: LatentGallery) -> list[str]:
    """What came out: the last ``beta`` against the first, state by state."""
    first, last = result.betas[0], result.betas[-1]
    texts = []
    for name, values in (("spread of the heads", result.spread), ("deviation of the returns", result.deviation)):
        change = (values[:, -1, -1] / values[:, 0, -1]).log()
        change = change.where(change.isfinite(), torch.nan)  # heads that agree exactly, as new ones may
        if change.isnan().all():  # of one head, or of one estimate
            continue
        ratio = episode_interval(change, result.episode, lambda rows: rows.nanmean(0))
        low, middle, high = (bound.exp().item() for bound in (ratio.low, ratio.value, ratio.high))
        texts.append(
            f"{name} at the last depth, beta {last:g} over beta {first:g}, geometric mean: {middle:.2f} "
            f"[{low:.2f}, {high:.2f}]"
        )
    lost = result.true_returns[:, -1, -1] - result.true_returns[:, 0, -1]
    change = episode_interval(lost, result.episode)
    texts.append(
        f"true return of the whole plan, beta {last:g} minus beta {first:g}: {change.value:+.3f} "
        f"[{change.low:+.3f}, {change.high:+.3f}]"
    )
    return texts


def figure(result: LatentGallery) -> Any:
    """The first states: trajectories in the first two principal components above, returns by depth below."""
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    count = min(SHOWN, len(result.episode))
    picture = Figure(figsize=(1.9 * count + 0.6, 4.0), layout="constrained")
    axes = picture.subplots(2, count, squeeze=False)
    colours = ("#0072B2", "#E69F00", "#009E73", "#CC79A7")
    depths = range(1, result.true_returns.shape[-1] + 1)
    # Evenly over the drawn states, which stand in the order of their episodes.
    for column, state in enumerate(torch.linspace(0, len(result.episode) - 1, count).round().int().tolist()):
        heads = result.imagined.shape[2]
        every = torch.cat([result.imagined[state], result.true[state].unsqueeze(1)], dim=1)
        places, shares = components(every)
        top, bottom = axes[0, column], axes[1, column]
        for number, colour in zip(range(len(result.betas)), colours, strict=False):
            for head in range(heads):
                top.plot(*places[number, head].unbind(-1), color=colour, linewidth=0.8, alpha=0.6)
            top.plot(*places[number, :heads].mean(0).unbind(-1), color=colour, marker="o", markersize=3)
            top.plot(*places[number, heads].unbind(-1), color=colour, linestyle="--", marker="x", markersize=5)
            estimates = result.returns[state, number].flatten(-2)
            spread = estimates.std(-1) if estimates.shape[-1] > 1 else None
            bottom.errorbar(depths, estimates.mean(-1), spread, color=colour, marker="o", capsize=3)
            bottom.plot(depths, result.true_returns[state, number], color=colour, linestyle="--", marker="x")
        top.plot(*places[0, 0, 0], color="black", marker="s", markersize=5)
        top.set_title(f"{float(shares.sum()):.0%} of the variance", fontsize=8)
        top.set_xticks([])
        top.set_yticks([])
        bottom.set_xticks(list(depths))
        bottom.set_xlabel("depth")
    axes[0, 0].set_ylabel("two components")
    axes[1, 0].set_ylabel("return estimate")
    named = zip(colours, result.betas, strict=False)
    legend = [Line2D([], [], color=colour, label=f"beta {beta:g}") for colour, beta in named]
    legend.append(Line2D([], [], color="black", marker="o", markersize=3, label="mean of the heads"))
    legend.append(Line2D([], [], color="black", linestyle="--", marker="x", label="simulator"))
    picture.legend(handles=legend, loc="outside lower center", ncols=len(legend), frameon=False)
    return picture
