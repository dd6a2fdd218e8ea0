"""The warm start's place in an environment."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from torchrl.data import TensorSpec
from torchrl.envs import EnvBase, TensorDictPrimer

from torchrl_etdmpc.envs.check import check_spaces
from torchrl_etdmpc.keys import IS_INIT


class PlanPrimer(TensorDictPrimer):
    """Zeroes the carried plan at every reset, and compares environment and model at the first one.

    It compares then and not when it is appended, because transforms that come later may mend the environment. What the
    environment does not have, other modules of the policy may write or read, so that is not compared there.

    Args:
        *args: those of :class:`torchrl.envs.TensorDictPrimer`.

    Keyword Args:
        spaces (dict): arguments of :func:`~torchrl_etdmpc.envs.check_spaces`: what the planner's model takes.
        latent_key (NestedKey, optional): an environment with this entry needs no observation: the planner reads its
            latents.
        **kwargs: those of :class:`torchrl.envs.TensorDictPrimer`.
    """

    def __init__(self, *args: Any, spaces: dict[str, Any], latent_key: NestedKey | None = None, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.spaces = spaces
        self.latent_key = latent_key
        self._checked = False

    def check(self, env: EnvBase, *, alone: bool = True) -> None:
        """Raises a ``ValueError`` that says what to append if the environment does not fit the planner's model.

        Args:
            env (EnvBase): the environment.

        Keyword Args:
            alone (bool): whether the planner is the whole policy, so that what the environment lacks is a fault.
                Default: ``True``.
        """
        check_part(env, self.spaces, alone=alone, latent_key=self.latent_key)
        self._check_resets(env)

    def _check_resets(self, env: EnvBase) -> None:
        """At a reset TorchRL keeps new entries only below a place where episodes end."""
        places = [_path(key)[:-1] for key in env.reset_keys]
        for key, _ in self._specs():
            if not any(_path(key)[: len(place)] == place for place in places):
                inner = (*places[0], _path(key)[-1])
                raise ValueError(
                    f"the environment's episodes end at {env.done_keys[0]!r}, and TorchRL would carry {key!r} from one "
                    f"to the next; make the planner with plan_mean_key={inner!r} and is_init_key="
                    f"{(*places[0], IS_INIT)!r}."
                )

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        if not self._checked and self.container is not None:
            self.check(self.container, alone=False)
            self._checked = True
        if self.parent is None or self.parent.batch_locked:
            return super()._reset(tensordict, tensordict_reset)
        for key, spec in self._specs():  # TorchRL's zeros are of one state; where no episode begins they are dropped
            shape = (*tensordict_reset.batch_size, *spec.shape[-2:])
            tensordict_reset.set(key, torch.zeros(shape, device=spec.device, dtype=spec.dtype))
        return tensordict_reset

    def _specs(self) -> list[tuple[NestedKey, TensorSpec]]:
        primers: Any = self.primers  # its type says that there may be none
        return list(primers.items(True, True))


def check_part(
    env: EnvBase, spaces: dict[str, Any], *, alone: bool = True, latent_key: NestedKey | None = None
) -> None:
    """:func:`~torchrl_etdmpc.envs.check_spaces` of what acts, perhaps beside others that write what it reads.

    Args:
        env (EnvBase): the environment.
        spaces (dict): arguments of ``check_spaces``, the keys among them.

    Keyword Args:
        alone (bool): whether it is the whole policy. Otherwise an observation or action that the environment does not
            have is not compared. Default: ``True``.
        latent_key (NestedKey, optional): where the environment has this entry, it needs no observation.
    """
    written, absent = set(env.full_observation_spec.keys(True, True)), {}
    if unravel_key(spaces["observation_key"]) not in written and (latent_key in written or not alone):
        absent["observation_dim"] = None
    if unravel_key(spaces["action_key"]) not in env.action_keys and not alone:
        absent["action_dim"] = None
    check_spaces(env, **spaces | absent)


def _path(key: NestedKey) -> tuple[Any, ...]:
    return key if isinstance(key, tuple) else (key,)
