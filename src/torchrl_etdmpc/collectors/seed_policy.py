"""The policy of the random phase: uniform actions, with the planner's whole schema."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec

from torchrl_etdmpc.envs.check import action_faults
from torchrl_etdmpc.keys import ACTION, FALLBACK, LOC, PLAN, PLAN_FIELDS, SCALE, VALUE, VERSION


class SeedPolicy(TensorDictModuleBase):
    """Uniform random actions, stored with the target N(0, 1) (BMPC), under the keys that the planner writes.

    Writing the whole schema from the first row on matters: a storage leaves missing entries uninitialised.

    Args:
        action_spec (TensorSpec): spec of the action, of the whole batch of environments, bounded by exactly -1 and 1 as
            the planner's actions are; a ``Composite`` (an environment's ``action_spec`` if its action is nested) is
            read at ``action_key``.

    Keyword Args:
        action_key (NestedKey): Default: ``"action"``.
        plan_key (NestedKey): root of the target. Default: ``"plan"``.
        hold (float): for how many decisions an action is held in the mean, at least 1; every dimension by itself is
            drawn anew with probability ``1 / hold``. Actions that change with every decision cancel out before they
            move anything far; held ones see more states and find more rewards (as noise that is correlated in time
            does, Eberhard et al., Pink noise is all you need, ICLR 2023). Not in the thesis. What is held is in the
            module's ``state_dict``. Default: 1, a new action every time.

    Raises:
        ValueError: if the action is not continuous and bounded by exactly -1 and 1, or ``hold`` is below 1.

    >>> from tensordict import TensorDict
    >>> from torchrl.data import Bounded
    >>> policy = SeedPolicy(Bounded(-1, 1, shape=(2,)))
    >>> policy(TensorDict())["plan", "scale"].tolist()
    [1.0, 1.0]
    """

    def __init__(
        self,
        action_spec: TensorSpec,
        *,
        action_key: NestedKey = ACTION,
        plan_key: NestedKey = PLAN,
        hold: float = 1.0,
    ) -> None:
        super().__init__()
        if isinstance(action_spec, Composite):
            action_spec = action_spec[action_key]
        faults = [*action_faults(action_spec, action_spec.dtype, action_key)]
        if faults:
            raise ValueError(f"SeedPolicy acts in [-1, 1], as the planner does, but {'; '.join(faults)}.")
        if not hold >= 1:
            raise ValueError(f"hold must be at least 1, got {hold}.")
        self.action_spec = action_spec
        self.hold = hold
        self._held: Tensor | None = None  # no buffer: what a worker holds must not be sent with the weights
        self.action_key = unravel_key(action_key)
        self.plan_keys = {name: unravel_key((plan_key, name)) for name in PLAN_FIELDS}
        self.in_keys = []
        self.out_keys = [self.action_key, *self.plan_keys.values()]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes an action and its target."""
        action = self.action_spec.rand()
        if self.hold > 1:
            if self._held is not None:
                action = torch.where(torch.rand_like(action) * self.hold < 1, action, self._held)
            self._held = action.clone()
        flag = torch.zeros_like(action[..., :1])
        values = {
            LOC: torch.zeros_like(action),
            SCALE: torch.ones_like(action),
            VALUE: flag,
            VERSION: flag.to(torch.int64),
            FALLBACK: flag.bool(),
        }
        tensordict.set(self.action_key, action)
        for name, value in values.items():
            tensordict.set(self.plan_keys[name], value)
        return tensordict

    def get_extra_state(self) -> dict[str, Any]:
        """The action that is held."""
        return {"held": self._held}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Holds the action of :meth:`get_extra_state`."""
        held = state["held"]
        self._held = None if held is None else held.to(self.action_spec.device)
