"""An agent as programs that need nothing but PyTorch to run."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.export import Dim, ExportedProgram

from torchrl_etdmpc.planners import EnsembleMPPIPlanner
from torchrl_etdmpc.training.builders import Agent

__all__ = ["export_planner", "export_policy"]


class _Policy(nn.Module):
    def __init__(self, agent: Agent) -> None:
        super().__init__()
        self.world_model = agent.world_model

    def forward(self, observation: Tensor) -> Tensor:
        mean, _ = self.world_model.policy(self.world_model.encode(observation))
        return mean


class _Planner(nn.Module):
    def __init__(self, planner: EnsembleMPPIPlanner) -> None:
        super().__init__()
        self.planner = planner

    def forward(self, observation: Tensor, plan_mean: Tensor) -> tuple[Tensor, Tensor]:
        # Not the attribute, which may be compiled.
        plan = type(self.planner).plan(self.planner, observation, plan_mean, explore=False)
        return plan.action, plan.mean


def export_policy(agent: Agent) -> ExportedProgram:
    """The policy without the planner: ``observation [B, O] -> action [B, A]``, any B.

    The action is the policy's mean, in [-1, 1], as in :class:`~torchrl_etdmpc.training.BarePolicy`.

    Args:
        agent (Agent): e.g. of :func:`load_agent`.

    Returns:
        ExportedProgram: for ``torch.export.save``; to run it, ``torch.export.load(file).module()(observation)``.
    """
    model = agent.world_model
    example = torch.zeros(2, model.observation_dim, device=model.bins.device)
    with torch.no_grad():
        return torch.export.export(_Policy(agent), (example,), dynamic_shapes={"observation": {0: Dim("batch")}})


def export_planner(agent: Agent, *, batch_size: int = 1) -> ExportedProgram:
    """The planner as it evaluates: ``observation [B, O], plan_mean [B, H, A] -> action [B, A], plan_mean [B, H, A]``.

    ``plan_mean`` is the warm start: zeros at the beginning of an episode, then what the call before returned. The
    candidates' noise is drawn inside, from PyTorch's global generator.

    Args:
        agent (Agent): e.g. of :func:`load_agent`.

    Keyword Args:
        batch_size (int): B, which is fixed. Default: 1.

    Returns:
        ExportedProgram: for ``torch.export.save``.

    Raises:
        ValueError: if ``batch_size`` is below 1.
    """
    if batch_size < 1:
        raise ValueError(f"batch_size must be at least 1, got {batch_size}.")
    model, planner = agent.world_model, agent.eval_planner
    device = model.bins.device
    observation = torch.zeros(batch_size, model.observation_dim, device=device)
    plan_mean = torch.zeros(batch_size, planner.horizon, model.action_dim, device=device)
    with torch.no_grad():
        return torch.export.export(_Planner(planner), (observation, plan_mean))
