"""A policy and a planner as programs that need nothing but PyTorch to run."""

from __future__ import annotations

import copy
from typing import Any

import torch
from torch import Tensor, nn
from torch.export import Dim, ExportedProgram

from torchrl_etdmpc.modules.prediction import PredictionModel, device_and_dtype
from torchrl_etdmpc.planners.ensemble_mppi import EnsembleMPPIPlanner


class _Policy(nn.Module):
    def __init__(self, world_model: PredictionModel) -> None:
        super().__init__()
        self.world_model = world_model

    def forward(self, observation: Tensor) -> Tensor:
        mean, _ = self.world_model.policy(self.world_model.encode(observation))
        return mean


class _Planner(nn.Module):
    def __init__(self, planner: EnsembleMPPIPlanner) -> None:
        super().__init__()
        self.planner = planner

    def forward(self, observation: Tensor, plan_mean: Tensor) -> tuple[Tensor, Tensor]:
        plan = self.planner.plan(observation, plan_mean, explore=False)  # never the compiled one
        return plan.action, plan.mean


def export_policy(world_model: PredictionModel) -> ExportedProgram:
    """The policy without the planner: ``observation [B, O] -> action [B, A]``, any B.

    The action is the policy's mean, in [-1, 1]. The program holds copies of the weights that it needs and no others.

    Args:
        world_model (PredictionModel): encoder and policy, an ``nn.Module``.

    Returns:
        ExportedProgram: for ``torch.export.save``; to run it, ``torch.export.load(file).module()(observation)``.

    >>> from torchrl_etdmpc.modules import WorldModel
    >>> program = export_policy(WorldModel(3, 2, latent_dim=16, mlp_dim=32))
    >>> program.module()(torch.zeros(5, 3)).shape
    torch.Size([5, 2])
    """
    device, dtype = device_and_dtype(world_model)
    example = torch.zeros(2, world_model.observation_dim, device=device, dtype=dtype)
    return _export(_Policy(world_model), example, dynamic_shapes={"observation": {0: Dim("batch")}})


def export_planner(planner: EnsembleMPPIPlanner, *, batch_size: int = 1) -> ExportedProgram:
    """The planner as it evaluates: ``observation [B, O], plan_mean [B, H, A] -> action [B, A], plan_mean [B, H, A]``.

    ``plan_mean`` is the warm start: zeros at the beginning of an episode, then what the call before returned. The
    candidates' noise is drawn inside, from PyTorch's global generator. A compiled plan is left aside. The program holds
    copies of the weights.

    Args:
        planner (EnsembleMPPIPlanner): with its world model.

    Keyword Args:
        batch_size (int): B, which is fixed. Default: 1.

    Returns:
        ExportedProgram: for ``torch.export.save``.

    Raises:
        ValueError: if ``batch_size`` is below 1.
    """
    if batch_size < 1:
        raise ValueError(f"batch_size must be at least 1, got {batch_size}.")
    model = planner.world_model
    device, dtype = planner.env.device_and_dtype()
    observation = torch.zeros(batch_size, model.observation_dim, device=device, dtype=dtype)
    plan_mean = torch.zeros(batch_size, planner.horizon, model.action_dim, device=device, dtype=dtype)
    return _export(_Planner(planner), observation, plan_mean)


@torch.no_grad()
def _export(module: nn.Module, *inputs: Tensor, **options: Any) -> ExportedProgram:
    # A copy has memory of its own. The live weights go on changing, and may be views of one piece of memory (an updater
    # makes them so), of which a file would hold all.
    module = copy.deepcopy(module)
    program = torch.export.export(module, inputs, **options)
    # PyTorch stores every parameter of the module, whether the program reads it or not.
    read = {node.name for node in program.graph.find_nodes(op="placeholder") if node.users}
    needed = {spec.target for spec in program.graph_signature.input_specs if spec.arg.name in read}
    needless = [name for name, _ in module.named_parameters() if name not in needed]
    for name in needless:
        owner, _, attribute = name.rpartition(".")
        delattr(module.get_submodule(owner), attribute)
    return torch.export.export(module, inputs, **options) if needless else program
