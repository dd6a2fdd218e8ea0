"""Does the ensemble keep the planner from exploiting the errors of one head? (thesis A.3.1, Fig. A.7)."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchrl_etdmpc.inspector.settings import with_settings
from torchrl_etdmpc.inspector.studies.replan import (
    best_sequences,
    generator_of,
    policy_sequences,
    replan,
    return_estimates,
    true_returns,
)
from torchrl_etdmpc.inspector.studies.states import States, TrueWorld, episode_interval, roll_all
from torchrl_etdmpc.modules.prediction import has_action_values
from torchrl_etdmpc.planners import EnsembleMPPIPlanner

FOUND_BY = ("single head", "ensemble", "policy")
SCORED_BY = ("single head", "ensemble", "simulator")


class CrossScores(NamedTuple):
    """Returns of three sequences from S states under three estimates."""

    returns: Tensor
    """``[S, 3, 3]``: found by ``FOUND_BY``, scored by ``SCORED_BY``."""
    scale: float
    """Decisions of an episode over H, which turns a difference of returns into one of a whole episode."""
    episode: Tensor
    """``[S]``"""

    @property
    def gain(self) -> Tensor:
        """What the planned sequences earn more than the policy's, per episode, ``[S, 2, 3]``."""
        return self.scale * (self.returns[:, :2] - self.returns[:, 2:])


def cross_scoring(
    planner: EnsembleMPPIPlanner,
    states: States,
    simulator: TrueWorld,
    *,
    horizon: int = 3,
    num_samples: int = 64,
    num_elites: int = 8,
    num_proposals: int = 3,
    iterations: int = 6,
    decisions: int = 500,
    seed: int = 0,
) -> CrossScores:
    """Plans under the return estimate of one head and of all of them, and scores both under both and in the simulator.

    The single head is dynamics head 0 with value head 0. The simulator's score is that of H real rewards and the mean
    value where they led. The policy's sequence are its mean actions along the average of the heads' predictions.

    Args:
        planner (EnsembleMPPIPlanner): whose networks are asked, with its discount and temperature.
        states (States): with H decisions after them.
        simulator (TrueWorld): of their task.

    Keyword Args:
        horizon (int): H; estimates are those of the last depth. Default: 3.
        num_samples (int): of the plans, as the rest of the budget the thesis' of this study. Default: 64.
        num_elites (int): Default: 8.
        num_proposals (int): Default: 3; none for a planner that has none.
        iterations (int): Default: 6.
        decisions (int): of an episode. Default: 500.
        seed (int): of the plans.

    Raises:
        ValueError: if the critic also reads the action, as TD-MPC2's: there is no single head to plan by; or if there
            is a single head only.
    """
    if has_action_values(planner.world_model):
        raise ValueError(
            f"critic must be of states, got {type(planner.world_model).__name__}, with which plans are made by two "
            "heads that are drawn anew in every iteration; take an agent whose critic reads the state alone."
        )
    model = planner.world_model
    if model.num_dynamics == model.values(model.encode(states.observation[:1])).shape[-1] == 1:
        raise ValueError("the agent has one dynamics head and one value head, so that a single head is the ensemble.")
    budget = {"num_samples": num_samples, "num_elites": num_elites, "iterations": iterations, "extra_iterations": 0}
    proposals = num_proposals if planner.num_proposals else 0
    found = []
    for score in (_single_head, _all_heads):
        searcher = with_settings(planner, horizon=horizon, score=score, beta=0.0, num_proposals=proposals, **budget)
        plan = replan(searcher, states.observation, generator=generator_of(planner, seed), trace=True)
        found.append(best_sequences(plan))
    found.append(policy_sequences(planner, states.observation, horizon))
    sequences = torch.stack(found, dim=1)
    table = return_estimates(planner, states.observation, sequences)
    truth = [true_returns(planner, *roll_all(simulator, states, actions))[:, -1] for actions in found]
    scores = [_single_head(table), _all_heads(table), torch.stack(truth, dim=1)]
    return CrossScores(torch.stack(scores, dim=-1), decisions / horizon, states.episode)


def _single_head(returns: Tensor) -> Tensor:
    return returns[..., -1, 0, 0]


def _all_heads(returns: Tensor) -> Tensor:
    return returns[..., -1, :, :].mean((-2, -1))


def table(result: CrossScores) -> list[dict[str, Any]]:
    """Mean gains with their intervals; the median beside them, as a few states can make the mean."""
    interval = episode_interval(result.gain, result.episode)
    error = result.gain.std(0) / len(result.gain) ** 0.5
    return [
        {
            "found_by": FOUND_BY[row],
            "scored_by": SCORED_BY[column],
            "gain": interval.value[row, column].item(),
            "low": interval.low[row, column].item(),
            "high": interval.high[row, column].item(),
            "median": result.gain[:, row, column].quantile(0.5).item(),
            "standard_error_over_states": error[row, column].item(),
            "states": len(result.gain),
        }
        for row in range(2)
        for column in range(3)
    ]


def lines(result: CrossScores) -> list[str]:
    """What came out."""
    said = {(row["found_by"], row["scored_by"]): row for row in table(result)}
    texts = []
    for name in FOUND_BY[:2]:
        own, true = said[name, name], said[name, "simulator"]
        texts.append(
            f"planned with {name}: believes in {own['gain']:+.1f} per episode over the policy, the simulator gives "
            f"{true['gain']:+.1f} [{true['low']:+.1f}, {true['high']:+.1f}]"
        )
    return texts


def figure(result: CrossScores) -> Any:
    """Bars of the mean gains with 95% intervals, as Fig. A.7 of the thesis."""
    from matplotlib.figure import Figure

    rows = table(result)
    picture = Figure(figsize=(5.2, 3.4), layout="constrained")
    axis = picture.subplots()
    for column, (estimate, colour) in enumerate(zip(SCORED_BY, ("#0072B2", "#56B4E9", "#D55E00"), strict=True)):
        part = rows[column::3]
        gains = [row["gain"] for row in part]
        reach = [[row["gain"] - row["low"] for row in part], [row["high"] - row["gain"] for row in part]]
        places = [place + 0.26 * (column - 1) for place in range(2)]
        axis.bar(places, gains, 0.24, color=colour, label=f"scored by {estimate}")
        axis.errorbar(places, gains, reach, fmt="none", ecolor="black", capsize=3)
    axis.set_xticks(range(2), [f"planned with {name}" for name in FOUND_BY[:2]])
    axis.axhline(0, color="black", linewidth=0.8)
    axis.set_ylabel("gain over the policy, per episode")
    picture.legend(loc="outside lower center", ncols=3, frameon=False, fontsize=8)
    return picture
