"""Where does the planner beat the policy? Some planned steps against none, in the simulator."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchrl_etdmpc.inspector.studies.components import components
from torchrl_etdmpc.inspector.studies.replan import encode, generator_of, policy_sequences, replan
from torchrl_etdmpc.inspector.studies.states import States, TrueWorld, episode_interval
from torchrl_etdmpc.planners import EnsembleMPPIPlanner


class Advantage(NamedTuple):
    """True rewards after S states, with and without planned steps in the beginning."""

    planned: Tensor
    """Sum of rewards when the planner acts for ``steps`` decisions and the policy from then on, ``[S]``."""
    policy: Tensor
    """Sum of rewards when the policy acts, ``[S]``."""
    latent: Tensor
    """``[S, L]``"""
    steps: int
    horizon: int
    episode: Tensor
    """``[S]``"""

    @property
    def difference(self) -> Tensor:
        """``[S]``"""
        return self.planned - self.policy


def advantage(
    planner: EnsembleMPPIPlanner,
    states: States,
    simulator: TrueWorld,
    *,
    steps: int = 10,
    horizon: int = 50,
    seed: int = 0,
) -> Advantage:
    """Acts from every state twice for a fixed number of decisions.

    Args:
        planner (EnsembleMPPIPlanner): of a model with a policy.
        states (States): with ``horizon`` decisions after them.
        simulator (TrueWorld): of their task.

    Keyword Args:
        steps (int): decisions of the planner. Default: 10.
        horizon (int): decisions whose rewards count. Default: 50.
        seed (int): of the plans.

    Raises:
        ValueError: if ``steps`` is not in 1..horizon.
    """
    if not 1 <= steps <= horizon:
        raise ValueError(f"steps must be in 1..horizon={horizon}, got {steps}.")
    generator, sums = generator_of(planner, seed), {}
    for planned_steps in (steps, 0):
        earned = []
        for index, state in enumerate(states.simulator):
            simulator.restore(state)
            carried = None if states.plan_mean is None else states.plan_mean[index : index + 1]
            total = torch.zeros(())
            for step in range(horizon):
                observation = simulator.observation.unsqueeze(0)
                if step < planned_steps:
                    plan = replan(planner, observation, carried, generator=generator)
                    action, carried = plan.action, plan.mean
                else:
                    action = policy_sequences(planner, observation, 1)[:, 0]
                reward = simulator.roll(action).reward
                if not len(reward):  # the task has ended
                    break
                total = total + reward[0]
            earned.append(total)
        sums[planned_steps] = torch.stack(earned)
    latent = encode(planner, states.observation)
    return Advantage(sums[steps], sums[0], latent, steps, horizon, states.episode)


def table(result: Advantage) -> list[dict[str, Any]]:
    """The mean difference with its interval, and in how many states it is positive."""
    interval = episode_interval(result.difference, result.episode)
    return [
        {
            "planned_steps": result.steps,
            "horizon": result.horizon,
            "difference": interval.value.item(),
            "low": interval.low.item(),
            "high": interval.high.item(),
            "median": result.difference.quantile(0.5).item(),
            "planner_better": (result.difference > 0).double().mean().item(),
            "policy_better": (result.difference < 0).double().mean().item(),
            "mean_policy": result.policy.mean().item(),
            "states": len(result.episode),
        }
    ]


def lines(result: Advantage) -> list[str]:
    """What came out."""
    row = table(result)[0]
    return [
        f"{result.steps} planned decisions change the reward of the next {result.horizon} by {row['difference']:+.2f} "
        f"[{row['low']:+.2f}, {row['high']:+.2f}] from the policy's {row['mean_policy']:.1f}, median "
        f"{row['median']:+.2f}",
        f"the planner earned more in {row['planner_better']:.0%} of {row['states']} states, the policy in "
        f"{row['policy_better']:.0%}",
    ]


def figure(result: Advantage) -> Any:
    """The difference over the first two principal components of the latents, and its distribution.

    The right axis is linear up to the power of ten that three quarters of the differences stay within, and logarithmic
    beyond.
    """
    from matplotlib.figure import Figure

    picture = Figure(figsize=(7.2, 3.1), layout="constrained")
    left, right = picture.subplots(1, 2, width_ratios=(1.3, 1))
    places, shares = components(result.latent)
    limit = float(result.difference.abs().quantile(0.95)) or 1.0
    points = left.scatter(*places.unbind(-1), c=result.difference, cmap="PuOr", vmin=-limit, vmax=limit, s=16)
    points.set_edgecolor("#666666")
    points.set_linewidth(0.3)
    left.set_xlabel(f"component 1 ({float(shares[0]):.0%} of the variance)")
    left.set_ylabel(f"component 2 ({float(shares[1]):.0%})")
    picture.colorbar(points, ax=left, label="planner minus policy", extend="both")
    row = table(result)[0]
    shares = torch.arange(1, len(result.episode) + 1) / len(result.episode)
    right.plot(shares, result.difference.sort().values, color="#0072B2")
    right.axhline(0, color="black", linewidth=0.8)
    right.axhline(row["difference"], color="#D55E00", label="mean, interval")
    right.axhspan(row["low"], row["high"], color="#D55E00", alpha=0.25, linewidth=0)
    usual = max(float(result.difference.abs().quantile(0.75)), 1e-3)
    right.set_yscale("symlog", linthresh=10.0 ** math.ceil(math.log10(usual)))  # no tick lies closer to 0
    right.set_xlabel("share of the states")
    right.legend(frameon=False)
    return picture
