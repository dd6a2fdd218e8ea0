"""What an environment is made of: a simulator, and the transforms around it."""

from __future__ import annotations

from typing import Any

from torchrl.envs import Compose, EnvBase, Transform, TransformedEnv


def simulator_of(env: EnvBase) -> EnvBase:
    """The environment below all transforms."""
    while isinstance(env, TransformedEnv):
        env = env.base_env
    return env


def transforms_by_layer(env: EnvBase) -> list[list[Transform]]:
    """The transforms of every environment above the simulator, the outermost first; in each the innermost first."""
    layers: list[list[Transform]] = []
    while isinstance(env, TransformedEnv):
        parts = env.transform.modules()
        layers.append([part for part in parts if isinstance(part, Transform) and not isinstance(part, Compose)])
        env = env.base_env
    return layers


def transforms_of(env: EnvBase) -> list[Transform]:
    """Every transform above the simulator, those of the outermost environment first."""
    return [transform for layer in transforms_by_layer(env) for transform in layer]


def wrappers_of(env: EnvBase) -> list[Any]:
    """What TorchRL's wrapper of a library holds: Gymnasium's wrappers, the outermost first, and the environment itself.

    Empty for a simulator that is TorchRL's own.
    """
    found: list[Any] = []
    layer = vars(simulator_of(env)).get("_env")
    while layer is not None:
        found.append(layer)
        layer = getattr(layer, "env", None)
    return found
