"""Default tensordict keys, and the fields of a planner's target.

Every part takes its keys as arguments; these are the defaults, so that parts which were never told of each other meet.
Entries of a step's outcome (reward, terminated, done, the following observation) stand below :data:`NEXT`.
"""

from __future__ import annotations

NEXT = "next"

OBSERVATION = "observation"
"""``[O]``: written by the environment, read by the encoder."""
ACTION = "action"
"""``[A]`` in [-1, 1]: written by the planner, read by the environment and the losses."""
REWARD = "reward"
"""``[1]``"""
TERMINATED = "terminated"
"""``[1]`` bool: the task ended here."""
DONE = "done"
"""``[1]`` bool: the episode ended here, for whatever reason."""
IS_INIT = "is_init"
"""``[1]`` bool: the episode begins here (``torchrl.envs.InitTracker``)."""
LATENT = "latent"
"""``[L]``: the observation of the imagined environment."""
TRAJECTORY = ("collector", "traj_ids")
"""``[...]`` int64: which episode a row belongs to, as TorchRL's collectors number them."""
ENV_INDEX = "env_index"
"""``[...]`` int64: which environment a row is of, as TorchRL's ``AsyncBatchedCollector`` writes it."""
WORKER = "worker"
"""``[...]`` int64: which worker a row is of, where workers number their episodes each from 0."""
MASK = ("collector", "mask")
"""``[...]`` bool: false where a row is padding, as TorchRL's collectors write it with ``split_trajs=True``."""

PLAN = "plan"
"""Root of the planner's target, whose fields are :data:`PLAN_FIELDS`."""
PLAN_MEAN = "plan_mean"
"""``[H, A]``: the warm start, carried from step to step by the environment and not stored."""

LOC = "loc"
"""``[A]``: mean of the target."""
SCALE = "scale"
"""``[A]``: standard deviation of the target."""
VALUE = "value"
"""``[1]``: score of the chosen sequence."""
VERSION = "version"
"""``[1]`` int64: update count of the weights that made the target."""
TARGETS = (LOC, SCALE, VALUE, VERSION)
"""What replay stores and reanalyze renews."""
FALLBACK = "fallback"
"""``[1]`` bool: no candidate had a finite score, so the policy acted. A flag of the decision, not a target."""
PLAN_FIELDS = (*TARGETS, FALLBACK)
"""What a planner writes below :data:`PLAN`."""
