"""What an environment is made of: a simulator, and the transforms around it."""

from __future__ import annotations

from torchrl.envs import Compose, EnvBase, Transform, TransformedEnv


def simulator_of(env: EnvBase) -> EnvBase:
    """The environment below all transforms."""
    while isinstance(env, TransformedEnv):
        env = env.base_env
    return env


def transforms_of(env: EnvBase) -> list[Transform]:
    """Every transform above the simulator, those of the outermost environment first."""
    found: list[Transform] = []
    while isinstance(env, TransformedEnv):
        parts = env.transform.modules()
        found += (part for part in parts if isinstance(part, Transform) and not isinstance(part, Compose))
        env = env.base_env
    return found
