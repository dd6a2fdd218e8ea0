"""Which depths does the adaptive mixture trust, and when? (thesis 4.8, Fig. 4.1)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchrl_etdmpc.functional import adaptive_mixture, ensemble_mean, ensemble_std
from torchrl_etdmpc.inspector.settings import with_settings
from torchrl_etdmpc.inspector.studies.replan import generator_of, replan
from torchrl_etdmpc.inspector.studies.states import States, episode_interval
from torchrl_etdmpc.planners import EnsembleMPPIPlanner


class HorizonWeights(NamedTuple):
    """The elites' mixtures of H depths in S states, for b weights of the deviation and I iterations."""

    weights: Tensor
    """Mean over the elites, ``[S, b, I, H]``."""
    mean: Tensor
    """Mean return estimate of each depth, of the elites of the last iteration, ``[S, b, H]``."""
    sigma: Tensor
    """Its standard deviation over the ensemble (thesis Eq. 3.3), ``[S, b, H]``."""
    betas: tuple[float, ...]
    episode: Tensor
    """``[S]``"""


def horizon_weights(
    planner: EnsembleMPPIPlanner,
    states: States,
    *,
    betas: Sequence[float] = (0.0, 1.0, 3.0, 10.0),
    horizon: int = 6,
    seed: int = 0,
) -> HorizonWeights:
    """Plans with the adaptive score and looks at the mixture of every iteration's elites.

    Args:
        planner (EnsembleMPPIPlanner): its networks and settings; cold starts.
        states (States): where to plan.

    Keyword Args:
        betas (sequence of float): Default: 0, 1, 3, 10.
        horizon (int): H. Default: 6, the thesis'.
        seed (int): of the plans; the same random numbers for every ``beta``.
    """
    fields = []
    for beta in betas:
        searcher = with_settings(planner, horizon=horizon, score="adaptive", beta=float(beta))
        plan = replan(searcher, states.observation, generator=generator_of(planner, seed), trace=True)
        assert plan.trace is not None
        ranked = plan.trace.scores.where(plan.trace.scores.isfinite(), -torch.inf)
        best, elites = ranked.topk(searcher.num_elites, dim=-1)
        finite, elites = best.isfinite()[..., None], elites[..., None]  # the planner gives the others no weight
        mean, sigma = ensemble_mean(plan.trace.returns), ensemble_std(plan.trace.returns)
        mean, sigma = (part.gather(2, elites.expand(-1, -1, -1, horizon)) for part in (mean, sigma))  # [S, I, K, H]
        _, weights = adaptive_mixture(mean, sigma, float(beta))
        weights, mean, sigma = (part.where(finite, torch.nan).nanmean(2) for part in (weights, mean, sigma))
        fields.append((weights, mean[:, -1], sigma[:, -1]))
    joined = (torch.stack(field, dim=1) for field in zip(*fields, strict=True))
    return HorizonWeights(*joined, betas=tuple(map(float, betas)), episode=states.episode)


def _mean_depth(result: HorizonWeights) -> Tensor:
    depths = torch.arange(1.0, result.weights.shape[-1] + 1, dtype=result.weights.dtype)
    return (result.weights * depths).sum(-1)


def table(result: HorizonWeights) -> list[dict[str, Any]]:
    """Weights, mean and sigma by ``beta``, iteration and depth; the last two of the last iteration."""
    interval = episode_interval(result.weights, result.episode)
    _, betas, iterations, depths = result.weights.shape
    rows = []
    for number in range(betas):
        for iteration in range(iterations):
            for depth in range(depths):
                last = iteration == iterations - 1
                rows.append(
                    {
                        "beta": result.betas[number],
                        "iteration": iteration + 1,
                        "depth": depth + 1,
                        "weight": interval.value[number, iteration, depth].item(),
                        "low": interval.low[number, iteration, depth].item(),
                        "high": interval.high[number, iteration, depth].item(),
                        "mean": result.mean[:, number, depth].mean().item() if last else "",
                        "sigma": result.sigma[:, number, depth].mean().item() if last else "",
                        "states": len(result.episode),
                    }
                )
    return rows


def lines(result: HorizonWeights) -> list[str]:
    """What came out: the mean depth in the first and in the last iteration."""
    interval = episode_interval(_mean_depth(result), result.episode)
    change = episode_interval(_mean_depth(result)[:, :, -1] - _mean_depth(result)[:, :, 0], result.episode)
    return [
        f"beta {beta:g}: mean depth {interval.value[number, 0]:.2f} in the first iteration, "
        f"{interval.value[number, -1]:.2f} in the last, change {change.value[number]:+.2f} "
        f"[{change.low[number]:+.2f}, {change.high[number]:+.2f}]"
        for number, beta in enumerate(result.betas)
    ]


def figure(result: HorizonWeights) -> Any:
    """Weights by iteration and depth above, mean over the states; mean and sigma of the last elites below."""
    from matplotlib.figure import Figure

    count, depths = len(result.betas), result.weights.shape[-1]
    picture = Figure(figsize=(2.1 * count + 0.9, 4.4), layout="constrained")
    axes = picture.subplots(2, count, squeeze=False, height_ratios=(1, 1.2), sharex="col", sharey="row")
    heats = []
    for column, beta in enumerate(result.betas):
        shown = result.weights[:, column].mean(0).numpy()
        extent = (0.5, depths + 0.5, len(shown) + 0.5, 0.5)
        heats.append(axes[0, column].imshow(shown, aspect="auto", vmin=0, vmax=1, cmap="viridis", extent=extent))
        axes[0, column].set_title(f"beta {beta:g}", fontsize=10)
        axes[0, column].set_yticks(range(1, len(shown) + 1))
        mean, sigma = result.mean[:, column].mean(0), result.sigma[:, column].mean(0)
        axes[1, column].errorbar(range(1, depths + 1), mean, sigma, color="#0072B2", marker="o", capsize=3)
        axes[1, column].set_xticks(range(1, depths + 1))
        axes[1, column].set_xlabel("depth")
    axes[0, 0].set_ylabel("iteration")
    axes[1, 0].set_ylabel("return estimate and sigma")
    picture.colorbar(heats[0], ax=axes[0, :].tolist(), label="weight")
    return picture
