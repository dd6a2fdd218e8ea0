"""A policy and a planner as programs that need nothing but PyTorch to run."""

from __future__ import annotations

import copy
from typing import Any

import torch
from torch import Tensor, nn
from torch.export import Dim, ExportedProgram

from torchrl_etdmpc.modules.prediction import PolicyModel, PredictionModel, device_and_dtype, require_policy
from torchrl_etdmpc.planners.ensemble_mppi import EnsembleMPPIPlanner


class _Policy(nn.Module):
    def __init__(self, world_model: PolicyModel) -> None:
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
        carried = plan_mean if self.planner.warm_start else None
        plan = self.planner.plan(observation, carried, explore=False)  # never the compiled one
        return plan.action, plan.mean


def export_policy(world_model: PolicyModel, *, observation: Tensor | None = None) -> ExportedProgram:
    """The policy without the planner: ``observation [B, O] -> action [B, A]``, any B.

    The action is the policy's mean, in [-1, 1]. The program holds copies of the weights that it needs and no others.

    Args:
        world_model (PolicyModel): encoder and policy, an ``nn.Module``.

    Keyword Args:
        observation (Tensor, optional): an example ``[...]`` of one observation, for a model whose observations are no
            vectors. Default: zeros ``[O]``.

    Returns:
        ExportedProgram: for ``torch.export.save``; to run it, ``torch.export.load(file).module()(observation)``.

    Raises:
        TypeError: if the model has no policy, or the example is no tensor.
        ValueError: if an example is needed.

    >>> from torchrl_etdmpc.modules import WorldModel
    >>> program = export_policy(WorldModel(3, 2, latent_dim=16, mlp_dim=32))
    >>> program.module()(torch.zeros(5, 3)).shape
    torch.Size([5, 2])
    """
    policy = _Policy(require_policy(world_model, "export_policy"))
    example = _observations(world_model, observation, 2, *device_and_dtype(world_model))
    return _export(policy, example, dynamic_shapes={"observation": {0: Dim("batch")}})


def export_planner(
    planner: EnsembleMPPIPlanner, *, batch_size: int | None = 1, observation: Tensor | None = None
) -> ExportedProgram:
    """The planner as it evaluates: ``observation [B, O], plan_mean [B, H, A] -> action [B, A], plan_mean [B, H, A]``.

    ``plan_mean`` is the warm start: zeros at the beginning of an episode, then what the call before returned. The
    candidates' noise is drawn inside, from PyTorch's global generator. A compiled plan is left aside. The program holds
    copies of the weights.

    Args:
        planner (EnsembleMPPIPlanner): with its world model.

    Keyword Args:
        batch_size (int, optional): B, which is fixed; ``None`` for a program that takes any number of states.
            Default: 1.
        observation (Tensor, optional): as of :func:`export_policy`.

    Returns:
        ExportedProgram: for ``torch.export.save``.

    Raises:
        TypeError: if the example is no tensor.
        ValueError: if ``batch_size`` is below 1, or an example is needed.

    >>> from torchrl_etdmpc import LatentEnv, WorldModel
    >>> budget = {"horizon": 2, "num_samples": 8, "num_elites": 4, "num_proposals": 2, "iterations": 1}
    >>> planner = EnsembleMPPIPlanner(LatentEnv(WorldModel(3, 1, latent_dim=16, mlp_dim=32)), **budget)
    >>> action, plan_mean = export_planner(planner).module()(torch.zeros(1, 3), torch.zeros(1, 2, 1))
    >>> action.shape, plan_mean.shape
    (torch.Size([1, 1]), torch.Size([1, 2, 1]))
    """
    if batch_size is not None and batch_size < 1:
        raise ValueError(f"batch_size must be at least 1, got {batch_size}.")
    model = planner.world_model
    device, dtype = planner.env.device_and_dtype()
    states = 2 if batch_size is None else batch_size
    inputs = (
        _observations(model, observation, states, device, dtype),
        torch.zeros(states, planner.horizon, model.action_dim, device=device, dtype=dtype),
    )
    if batch_size is not None:
        return _export(_Planner(planner), *inputs)
    batch = Dim("batch")
    return _export(_Planner(planner), *inputs, dynamic_shapes={"observation": {0: batch}, "plan_mean": {0: batch}})


def _observations(
    model: PredictionModel, example: Tensor | None, states: int, device: torch.device, dtype: torch.dtype
) -> Tensor:
    if example is not None:
        if not isinstance(example, Tensor):
            raise TypeError(
                f"observation must be a tensor, got {type(example).__name__}; a model that encodes dictionaries cannot "
                "be exported."
            )
        return example.to(device).expand(states, *example.shape).contiguous()
    if model.observation_dim is None:
        raise ValueError(
            f"observation must be given for {type(model).__name__}, whose observations are no vectors; pass "
            "observation=env.reset()['observation']."
        )
    return torch.zeros(states, model.observation_dim, device=device, dtype=dtype)


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
