"""Do the heads disagree where the model is wrong? Disagreement against realised error, by depth."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchrl_etdmpc.inspector.settings import with_settings
from torchrl_etdmpc.inspector.studies.replan import (
    best_sequences,
    encode,
    generator_of,
    imagine,
    replan,
)
from torchrl_etdmpc.inspector.studies.states import States, TrueWorld, episode_interval, roll_all
from torchrl_etdmpc.inspector.trace import head_spread
from torchrl_etdmpc.planners import EnsembleMPPIPlanner

ACTIONS = ("planned", "random")


class Calibration(NamedTuple):
    """What the heads said of their own error, and the error, from S states."""

    disagreement: Tensor
    """Root mean squared distance of the heads from their mean, in latent space, ``[S, 2, H]``; by ``ACTIONS``."""
    error: Tensor
    """Distance of their mean from the encoded truth, ``[S, 2, H]``; after the end of the task both are NaN."""
    episode: Tensor
    """``[S]``"""


def calibration(
    planner: EnsembleMPPIPlanner,
    states: States,
    simulator: TrueWorld,
    *,
    horizon: int = 6,
    seed: int = 0,
) -> Calibration:
    """Follows planned and uniformly random sequences through every head and through the simulator.

    Args:
        planner (EnsembleMPPIPlanner): with at least two dynamics heads.
        states (States): with H decisions after them.
        simulator (TrueWorld): of their task.

    Keyword Args:
        horizon (int): H. Default: 6.
        seed (int): of the plans and the random actions.

    Raises:
        ValueError: if there is one head, which agrees with itself.
    """
    if planner.world_model.num_dynamics < 2:
        raise ValueError(
            f"num_dynamics must be at least 2 for heads to disagree, got {planner.world_model.num_dynamics}."
        )
    searcher = with_settings(planner, horizon=horizon)
    planned = best_sequences(replan(searcher, states.observation, generator=generator_of(planner, seed), trace=True))
    random = torch.rand(planned.shape, generator=torch.Generator().manual_seed(seed)) * 2 - 1
    said, was = [], []
    for actions in (planned, random):
        heads = imagine(planner, states.observation, actions)[:, :, 1:]
        true = encode(planner, roll_all(simulator, states, actions)[0][:, 1:])
        was.append((heads.mean(1) - true).norm(dim=-1))
        said.append(head_spread(heads).where(~was[-1].isnan(), torch.nan))
    return Calibration(torch.stack(said, dim=1), torch.stack(was, dim=1), states.episode)


def rank_correlation(pairs: Tensor) -> Tensor:
    """Spearman's rank correlation of pairs ``[S, ..., 2]``, ``[...]``; 0 where one of them does not vary.

    Pairs of NaN are left out; NaN where fewer than two others are left.

    >>> rank_correlation(torch.tensor([[1.0, 10.0], [2.0, 30.0], [3.0, 20.0]])).item()
    0.5
    """
    rows = pairs.movedim(0, -1).contiguous()
    missing = rows.isnan().any(-2, keepdim=True)
    rows = rows.where(~missing, torch.inf)  # behind all others, whose ranks stay what they are
    ordered = rows.sort(-1).values
    ranks = torch.searchsorted(ordered, rows) + torch.searchsorted(ordered, rows, right=True)  # ties share their middle
    ranks = ranks.double().where(~missing, torch.nan)
    ranks = (ranks - ranks.nanmean(-1, keepdim=True)).nan_to_num(0)
    one, other = ranks.unbind(-2)
    norm = (one.square().sum(-1) * other.square().sum(-1)).sqrt()
    correlation = torch.where(norm > 0, (one * other).sum(-1) / norm.clamp_min(1e-12), torch.zeros_like(norm))
    return correlation.where((~missing).sum(-1).squeeze(-1) > 1, torch.nan)


def table(result: Calibration) -> list[dict[str, Any]]:
    """Rank correlation with its interval, and the ratio of error and disagreement, by kind of action and depth."""
    pairs = torch.stack([result.disagreement, result.error], dim=-1)
    correlation = episode_interval(pairs, result.episode, rank_correlation, resamples=400)
    ratio = episode_interval(pairs, result.episode, lambda rows: rows[..., 1].nanmean(0) / rows[..., 0].nanmean(0))
    return [
        {
            "actions": kind,
            "depth": depth + 1,
            "rank_correlation": correlation.value[row, depth].item(),
            "low": correlation.low[row, depth].item(),
            "high": correlation.high[row, depth].item(),
            "disagreement": result.disagreement[:, row, depth].nanmean().item(),
            "error": result.error[:, row, depth].nanmean().item(),
            "error_over_disagreement": ratio.value[row, depth].item(),
            "ratio_low": ratio.low[row, depth].item(),
            "ratio_high": ratio.high[row, depth].item(),
            "states": int((~result.error[:, row, depth].isnan()).sum()),
        }
        for row, kind in enumerate(ACTIONS)
        for depth in range(result.error.shape[-1])
    ]


def lines(result: Calibration) -> list[str]:
    """What came out, at the first and at the last depth."""
    rows, last = table(result), result.error.shape[-1]
    return [
        f"{row['actions']} actions, depth {row['depth']}: rank correlation of disagreement and error "
        f"{row['rank_correlation']:.2f} [{row['low']:.2f}, {row['high']:.2f}]; the error is "
        f"{row['error_over_disagreement']:.1f} times the disagreement"
        for row in rows
        if row["depth"] in (1, last)
    ]


def figure(result: Calibration) -> Any:
    """Error against disagreement at the first and the last depth, and the rank correlation by depth."""
    from matplotlib.figure import Figure

    rows, last = table(result), result.error.shape[-1]
    picture = Figure(figsize=(8.4, 2.9), layout="constrained")
    near, far, right = picture.subplots(1, 3)
    for row, (kind, colour, marker) in enumerate(zip(ACTIONS, ("#0072B2", "#D55E00"), ("o", "x"), strict=True)):
        for axis, depth in ((near, 0), (far, last - 1)):
            pairs = result.disagreement[:, row, depth], result.error[:, row, depth]
            axis.scatter(*pairs, s=9, color=colour, marker=marker, alpha=0.6, label=kind, linewidths=0.8)
            axis.set_title(f"depth {depth + 1}", fontsize=10)
            axis.set_xlabel("disagreement of the heads")
        part = [entry for entry in rows if entry["actions"] == kind]
        middle = [entry["rank_correlation"] for entry in part]
        reach = [[e["rank_correlation"] - e["low"] for e in part], [e["high"] - e["rank_correlation"] for e in part]]
        places = [entry["depth"] + 0.1 * row for entry in part]
        right.errorbar(places, middle, reach, color=colour, marker=marker, capsize=3, label=kind)
    near.set_ylabel("error of their mean")
    right.set_xlabel("depth")
    right.set_ylabel("rank correlation")
    right.axhline(0, color="black", linewidth=0.8)
    right.set_ylim(-1, 1)
    right.legend(frameon=False, title="actions")
    return picture
