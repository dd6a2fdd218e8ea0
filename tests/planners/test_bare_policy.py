"""The policy without a search."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import ExplorationType
from torchrl.envs.utils import set_exploration_type

from torchrl_etdmpc.planners import BarePolicy


def test_the_bare_policy_acts_with_the_mean_whatever_the_exploration(make_model, states):
    model, observation = make_model(), states(5)
    mean, log_std = model.policy(model.encode(observation))
    assert (log_std > -3).all()  # or a sample would be close to the mean by chance
    for kind in (ExplorationType.RANDOM, ExplorationType.DETERMINISTIC):
        with set_exploration_type(kind):
            out = BarePolicy(model)(TensorDict({"observation": observation}, [5]))
        assert torch.equal(out["action"], mean)
        assert not out["action"].requires_grad
        assert set(out.keys()) == {"observation", "action"}


def test_the_policy_alone_says_which_observation_it_misses(make_model, states):
    with pytest.raises(KeyError, match=r"the policy needs 'seen' in its input; pass observation_key="):
        BarePolicy(make_model(), observation_key="seen")(TensorDict({"observation": states(1)}, [1]))
