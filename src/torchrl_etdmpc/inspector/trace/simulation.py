"""What became of a plan in the simulator."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from torchrl_etdmpc.inspector.trace.trace import Trace, as_array
from torchrl_etdmpc.modules.prediction import PredictionModel, device_and_dtype


def add_simulation(
    trace: Trace, rewards: Tensor, observations: Tensor, frames: Tensor | None, model: PredictionModel
) -> Trace:
    """The trace with what became of its chosen sequence in the simulator.

    Args:
        trace (Trace): of the state in which the simulator began.
        rewards (Tensor): ``[R]``, of the chosen sequence's first R actions.
        observations (Tensor): ``[R + 1, O]``.
        frames (Tensor, optional): uint8 ``[R + 1, height, width, 3]``.
        model (PredictionModel): the planner's, which encodes the observations.

    >>> from torchrl_etdmpc import EnsembleMPPIPlanner, LatentEnv, WorldModel
    >>> from torchrl_etdmpc.inspector import Simulator, trace_plan
    >>> model = WorldModel(3, 1, latent_dim=16, mlp_dim=16, encoder_dim=16)
    >>> planner = EnsembleMPPIPlanner(LatentEnv(model), horizon=3, num_samples=16, num_elites=4, num_proposals=2)
    >>> simulator = Simulator("gym/Pendulum-v1")
    >>> trace = trace_plan(planner, simulator.observation)
    >>> rolled = simulator.roll(torch.from_numpy(trace["chosen_actions"]))
    >>> both = add_simulation(trace, rolled.reward, rolled.observation, None, model)
    >>> both["chosen_rewards"].shape, both["real_rewards"].shape  # [H, F] imagined, [R] real
    ((3, 4), (3,))
    """
    arrays = {**trace.arrays, "real_rewards": as_array(rewards)}
    if trace.get("basis") is not None:
        with torch.no_grad():
            device, dtype = device_and_dtype(model)
            floating = observations.is_floating_point()  # others an encoder is given as they are
            latents = as_array(model.encode(observations.to(device, dtype if floating else None)))
        arrays["real_points"] = ((latents - trace["centre"]) @ trace["basis"].T).astype(np.float32)
    if frames is not None:
        arrays["frames"] = as_array(frames)
    return replace(trace, arrays=arrays)
