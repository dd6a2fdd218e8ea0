"""The adaptive mixture in closed form against a gradient inner loop, as the thesis proposes it (thesis 4.7)."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchrl_etdmpc.functional import adaptive_mixture, ensemble_mean, ensemble_std
from torchrl_etdmpc.functional.horizon import SIGMA_FLOOR
from torchrl_etdmpc.inspector.settings import with_settings
from torchrl_etdmpc.inspector.studies.gradient_mixture import objective, projected_ascent, softmax_ascent
from torchrl_etdmpc.inspector.studies.replan import generator_of, replan
from torchrl_etdmpc.inspector.studies.states import States
from torchrl_etdmpc.planners import EnsembleMPPIPlanner

METHODS = ("softmax", "projected")
RATES = (0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0)
REPEATS, LEAST_SECONDS = 5, 0.2


class Solved(NamedTuple):
    """How far gradients come in i numbers of iterations, for b weights of the deviation."""

    gap: Tensor
    """Mean over candidates of the optimum minus what was reached, in units of the standard deviation of the optimum
    over a state's candidates, ``[b, 2, i]``; by ``METHODS``, with the step size that is best there."""
    same_best: Tensor
    """Share of states in which the same candidate comes out best, ``[b, 2, i]``."""
    seconds: Tensor
    """Of all candidates at once, ``[b, 2, i]``."""
    closed_seconds: Tensor
    """Of the closed form, ``[b]``."""
    rate: Tensor
    """The step size, ``[b, 2, i]``."""
    betas: tuple[float, ...]
    iterations: tuple[int, ...]
    candidates: int


def solver(
    planner: EnsembleMPPIPlanner,
    states: States,
    *,
    betas: Sequence[float] = (1.0, 3.0, 10.0),
    iterations: Sequence[int] = (1, 3, 10, 30, 100, 300),
    horizon: int = 6,
    seed: int = 0,
) -> Solved:
    """Solves the mixtures of a plan's last candidates in every state, in float64.

    Args:
        planner (EnsembleMPPIPlanner): its networks and settings.
        states (States): where to plan.

    Keyword Args:
        betas (sequence of float): above 0. Default: 1, 3, 10.
        iterations (sequence of int): of the gradient loops.
        horizon (int): H. Default: 6.
        seed (int): of the plans.
    """
    rows = []
    for beta in map(float, betas):
        searcher = with_settings(planner, horizon=horizon, score="adaptive", beta=beta)
        plan = replan(searcher, states.observation, generator=generator_of(planner, seed), trace=True)
        assert plan.trace is not None
        returns = plan.trace.returns[:, -1].double()
        rows.append(compare(ensemble_mean(returns), ensemble_std(returns), beta, iterations))
    stacked = (torch.stack(field) for field in zip(*rows, strict=True))
    candidates = len(states.observation) * planner.num_samples
    return Solved(*stacked, betas=tuple(map(float, betas)), iterations=tuple(iterations), candidates=candidates)


def compare(mean: Tensor, std: Tensor, beta: float, iterations: Sequence[int]) -> tuple[Tensor, ...]:
    """The fields of :class:`Solved` for one ``beta``, of candidates ``[S, N, H]``."""
    std = std.clamp_min(SIGMA_FLOOR)
    best, _ = adaptive_mixture(mean, std, beta)
    unit = best.std(-1).mean().clamp_min(1e-12)
    results = []
    for ascend in (softmax_ascent, projected_ascent):
        for count in iterations:
            tried = [(objective(ascend(mean, std, beta, count, rate), mean, std, beta), rate) for rate in RATES]
            reached, rate = max(tried, key=lambda pair: pair[0].mean().item())
            same = (best.argmax(-1) == reached.argmax(-1)).double().mean().item()
            seconds = _seconds(partial(ascend, mean, std, beta, count, rate))
            results.append(((best - reached).mean().item() / unit.item(), same, seconds, rate))
    closed = torch.tensor(_seconds(partial(adaptive_mixture, mean, std, beta)))
    gap, same, seconds, rate = torch.tensor(results).T.reshape(4, 2, len(iterations))
    return gap, same, seconds, closed, rate


def _seconds(call: Callable[[], object]) -> float:
    """The median of some calls, of more where one is quick."""
    taken: list[float] = []
    while len(taken) < REPEATS or (sum(taken) < LEAST_SECONDS and len(taken) < 100):
        start = time.perf_counter()
        call()
        taken.append(time.perf_counter() - start)
    return statistics.median(taken)


def table(result: Solved) -> list[dict[str, Any]]:
    """Gap, agreement and time by ``beta``, method and number of iterations."""
    return [
        {
            "beta": beta,
            "method": method,
            "iterations": count,
            "gap_in_std": result.gap[row, column, number].item(),
            "same_best": result.same_best[row, column, number].item(),
            "milliseconds": 1000 * result.seconds[row, column, number].item(),
            "closed_form_milliseconds": 1000 * result.closed_seconds[row].item(),
            "times_the_closed_form": (result.seconds[row, column, number] / result.closed_seconds[row]).item(),
            "step_size": result.rate[row, column, number].item(),
            "candidates": result.candidates,
        }
        for row, beta in enumerate(result.betas)
        for column, method in enumerate(METHODS)
        for number, count in enumerate(result.iterations)
    ]


def lines(result: Solved) -> list[str]:
    """What came out, of the most iterations."""
    return [
        f"beta {row['beta']:g}, {row['method']}, {row['iterations']} iterations: {row['gap_in_std']:.1e} std short of "
        f"the optimum, the same best candidate in {row['same_best']:.0%}, {row['times_the_closed_form']:.0f} times the "
        f"{row['closed_form_milliseconds']:.2f} ms of the closed form"
        for row in table(result)
        if row["iterations"] == max(result.iterations)
    ]


def figure(result: Solved) -> Any:
    """Gap against time; the closed form is the dotted line, at its time, without a gap."""
    from matplotlib.figure import Figure

    count = len(result.betas)
    picture = Figure(figsize=(2.6 * count + 0.8, 3.1), layout="constrained")
    axes = picture.subplots(1, count, squeeze=False, sharey=True)[0]
    for row, (axis, beta) in enumerate(zip(axes, result.betas, strict=True)):
        for column, (name, colour, marker) in enumerate(zip(METHODS, ("#0072B2", "#D55E00"), "ox", strict=True)):
            gap = result.gap[row, column].clamp_min(1e-12)
            axis.loglog(1000 * result.seconds[row, column], gap, color=colour, marker=marker, label=name)
        axis.axvline(
            1000 * result.closed_seconds[row].item(), color="black", linestyle=":", label="closed form: no gap"
        )
        axis.set_title(f"beta {beta:g}", fontsize=10)
        axis.set_xlabel("milliseconds")
    axes[0].set_ylabel("short of the optimum, in std")
    axes[-1].legend(frameon=False, fontsize=8)
    return picture
