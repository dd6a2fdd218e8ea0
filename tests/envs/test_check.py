from __future__ import annotations

import re

import pytest
import torch
import torchrl.envs
from torchrl.data import Binary, Bounded, Categorical, Composite, NonTensor, OneHot, Unbounded
from torchrl.envs import (
    ActionScaling,
    Compose,
    DoubleToFloat,
    EnvBase,
    FrameSkipTransform,
    InitTracker,
    RewardSum,
    SerialEnv,
    StepCounter,
    TransformedEnv,
)
from torchrl.envs.utils import check_env_specs

from torchrl_etdmpc import WorldModel
from torchrl_etdmpc.envs import check_env, check_spaces

_VECTOR = Unbounded(3)
_ACTION = Bounded(-1, 1, shape=(2,), dtype=torch.float32)
_FLAGS = ("done", "terminated", "truncated")


class SpecEnv(EnvBase):
    """An environment that writes what its specs say."""

    def __init__(self, *, observations=None, action=_ACTION, action_key="action", reward=None, flags=_FLAGS):
        super().__init__()
        self.observation_spec = Composite(observations if observations is not None else {"observation": _VECTOR})
        self.action_spec = Composite({action_key: action})
        self.reward_spec = reward if reward is not None else Unbounded(1)
        self.done_spec = Composite({key: Binary(1, dtype=torch.bool) for key in flags})

    def _reset(self, tensordict=None, **kwargs):
        return self.observation_spec.rand().update(self.full_done_spec.zero())

    def _step(self, tensordict):
        return self.observation_spec.rand().update(self.full_reward_spec.rand()).update(self.full_done_spec.zero())

    def _set_seed(self, seed):
        return seed


def complete(env: EnvBase) -> TransformedEnv:
    return TransformedEnv(env, Compose(InitTracker(), RewardSum()))


def faults(env: EnvBase) -> str:
    with pytest.raises(ValueError) as error:
        check_env(env)
    text = str(error.value)
    assert "\n" not in text
    assert text.startswith("this environment cannot be used as it is: ")
    return text


def test_an_environment_that_keeps_the_contract_passes_batched_or_not():
    check_env(complete(SpecEnv()))
    check_env(SerialEnv(2, lambda: complete(SpecEnv())))
    check_env(complete(SerialEnv(2, SpecEnv)))


# What is wrong, and which part of the message says so. What the message appends must mend it.
_MENDED = {
    "two vectors": (
        {"observations": {"position": Unbounded(2), "velocity": Unbounded(3)}},
        "observation is missing (append CatTensors(in_keys=['position', 'velocity'], out_key='observation'))",
    ),
    "a sum of rewards beside a vector": (
        {"observations": {"position": Unbounded(2), "episode_reward": Unbounded(1)}},
        "observation is missing (append CatTensors(in_keys=['position'], out_key='observation'))",
    ),
    "a text beside a vector": (
        {"observations": {"instruction": NonTensor(shape=()), "position": Unbounded(2)}},
        "observation is missing (append CatTensors(in_keys=['position'], out_key='observation'))",
    ),
    "a number and a vector": (
        {"observations": {"height": Unbounded(()), "position": Unbounded(2)}},
        "height is a single number (append UnsqueezeTransform(-1, in_keys=['height'])); "
        "observation is missing (append CatTensors(in_keys=['height', 'position'], out_key='observation'))",
    ),
    "vectors of two precisions": (
        {"observations": {"position": Unbounded(2), "velocity": Unbounded(3, dtype=torch.float64)}},
        "velocity is float64 instead of float32 (append DoubleToFloat(in_keys=['velocity'])); "
        "observation is missing (append CatTensors(in_keys=['position', 'velocity'], out_key='observation'))",
    ),
    "float64 observation": (
        {"observations": {"observation": Unbounded(3, dtype=torch.float64)}},
        "observation is float64 instead of float32 (append DoubleToFloat(in_keys=['observation']))",
    ),
    "whole numbers": (
        {"observations": {"observation": Unbounded(3, dtype=torch.int64)}},
        "observation is int64 instead of float32 "
        "(append DTypeCastTransform(torch.int64, torch.float32, in_keys=['observation']))",
    ),
    "a matrix": (
        {"observations": {"observation": Unbounded((4, 3))}},
        "observation has 2 dimensions instead of 1 (append FlattenObservation(-2, -1, in_keys=['observation']))",
    ),
    "a single number": (
        {"observations": {"observation": Unbounded(())}},
        "observation is a single number (append UnsqueezeTransform(-1, in_keys=['observation']))",
    ),
    "other bounds": (
        {"action": Bounded(low=torch.tensor([-1.0, -2]), high=torch.tensor([1.0, 3.0]), dtype=torch.float32)},
        "action has bounds of -2 and 3 instead of -1 and 1 (append ActionScaling())",
    ),
    "one other bound": (
        {"action": Bounded(low=torch.tensor([-1.0, -1]), high=torch.tensor([1.0, 0.8]), dtype=torch.float32)},
        "action has bounds of -1 and 0.8 instead of -1 and 1 (append ActionScaling())",
    ),
    "float64 action": (
        {"action": Bounded(-1, 1, shape=(2,), dtype=torch.float64)},
        "action is float64 instead of float32 (append DoubleToFloat(in_keys_inv=['action']))",
    ),
    "a matrix of actions": (
        {"action": Bounded(-1, 1, shape=(2, 3), dtype=torch.float32)},
        "action has the shape [2, 3] instead of [A] (append FlattenAction(-2, -1, in_keys_inv=['action']))",
    ),
    "another action's name": (
        {"action_key": "torque"},
        "the actions are ['torque'] instead of one 'action' "
        "(append RenameTransform(in_keys=[], out_keys=[], in_keys_inv=['torque'], out_keys_inv=['action']))",
    ),
    "another reward's name": (
        {"reward": Composite(score=Unbounded(1))},
        "the rewards are ['score'] instead of one 'reward' "
        "(append RenameTransform(in_keys=['score'], out_keys=['reward']))",
    ),
    "float64 reward": (
        {"reward": Unbounded(1, dtype=torch.float64)},
        "reward is float64 instead of float32 (append DoubleToFloat(in_keys=['reward']))",
    ),
    "no time limit": (
        {"flags": ("done", "terminated")},
        "truncated is missing (append StepCounter(max_steps=...), the time limit)",
    ),
}


@pytest.mark.parametrize("fault", _MENDED)
def test_each_fault_names_the_transform_that_mends_it(fault):
    options, expected = _MENDED[fault]
    # The transforms that write `is_init` and `episode_reward` read what the others write, so they come last.
    text = faults(SpecEnv(**options))
    assert f"{expected}; " in text
    assert "is_init is missing (append InitTracker())" in text
    env = TransformedEnv(SpecEnv(**options))
    for transform in re.findall(r"\(append (.*?\))\)?(?:, the time limit)?(?=[;.)])", text):
        code = transform.replace("max_steps=...", "max_steps=5")
        env.append_transform(eval(code, vars(torchrl.envs) | {"torch": torch}))
    check_env(env)
    check_env_specs(env)


_REFUSED = {
    "pixels": (
        {"observations": {"observation": Unbounded((3, 8, 8), dtype=torch.uint8)}},
        "observation holds pixels [3, 8, 8], which are not supported",
    ),
    "pixels under their own name": (
        {"observations": {"pixels": Unbounded((3, 8, 8), dtype=torch.uint8)}},
        "observation is missing, and pixel observations are not supported",
    ),
    "a dictionary": (
        {"observations": {"observation": Composite(position=Unbounded(2))}},
        "observation is a dictionary, which is not supported",
    ),
    "discrete observation": (
        {"observations": {"observation": OneHot(4)}},
        "observation is discrete (OneHot), which is not supported",
    ),
    "nothing to see": ({"observations": {}}, "observation is missing; "),
    "a text": ({"observations": {"instruction": NonTensor(shape=())}}, "observation is missing; "),
    "discrete actions": (
        {"action": Categorical(4, shape=())},
        "action is discrete (Categorical); only continuous actions are supported",
    ),
    "no bounds": ({"action": Unbounded(2)}, "action has no finite bounds, so it cannot be rescaled"),
    "half-open bounds": (
        {"action": Bounded(low=torch.zeros(2), high=torch.tensor([1, torch.inf]))},
        "action has no finite bounds, so it cannot be rescaled",
    ),
    "an action without a dimension": (
        {"action": Bounded(-1, 1, shape=(), dtype=torch.float32)},
        "action has the shape [] instead of [A]",
    ),
    "actions under two names": (
        {"action": Composite(left=_ACTION, right=_ACTION)},
        "the actions are [('action', 'left'), ('action', 'right')] instead of one 'action'; ",
    ),
    "rewards under two names": (
        {"reward": Composite(left=Unbounded(1), right=Unbounded(1))},
        "the rewards are ['left', 'right'] instead of one 'reward'; ",
    ),
    "two rewards": ({"reward": Unbounded(2)}, "reward has the shape [2] instead of [1]"),
}


@pytest.mark.parametrize("fault", _REFUSED)
def test_what_no_transform_can_mend_is_refused_in_one_line(fault):
    options, expected = _REFUSED[fault]
    assert expected in faults(SpecEnv(**options))


@pytest.mark.parametrize("transforms", [[ActionScaling], [DoubleToFloat, ActionScaling]])
def test_a_frame_skip_behind_what_changes_the_action_is_refused(transforms):
    def env(*kinds):
        env = complete(SpecEnv(action=Bounded(-2, 2, shape=(2,), dtype=torch.float32)))
        for kind in kinds:
            env.append_transform(kind(3) if kind is FrameSkipTransform else kind())
        return env

    check_env(env(FrameSkipTransform, *transforms))
    assert faults(env(*transforms, FrameSkipTransform)) == (
        "this environment cannot be used as it is: action is changed once more by each of its repeats (append "
        "FrameSkipTransform before ActionScaling)."
    )


def test_a_frame_skip_behind_a_cast_is_nobodys_business():
    env = complete(SpecEnv(action=Bounded(-1, 1, shape=(2,), dtype=torch.float64)))
    env.append_transform(DoubleToFloat(in_keys_inv=["action"]))
    check_env(env.append_transform(FrameSkipTransform(3)))


def test_a_frame_skip_that_repeats_nothing_is_nobodys_business():
    env = complete(SpecEnv(action=Bounded(-2, 2, shape=(2,), dtype=torch.float32))).append_transform(ActionScaling())
    check_env(env.append_transform(FrameSkipTransform(1)))


def test_one_error_lists_everything():
    env = SpecEnv(
        observations={"position": Unbounded(2)},
        action=Bounded(-2, 2, shape=(2,), dtype=torch.float64),
        reward=Unbounded(1, dtype=torch.float64),
        flags=("done",),
    )
    text = faults(env)
    for part in ("CatTensors", "ActionScaling", "in_keys_inv", "['reward']", "truncated", "InitTracker", "RewardSum"):
        assert part in text


def test_flags_and_sums_of_the_wrong_kind_are_named():
    env = SpecEnv(
        observations={"observation": _VECTOR, "is_init": Unbounded(1), "episode_reward": Unbounded(2)},
    )
    assert faults(env) == (
        "this environment cannot be used as it is: is_init is float32 instead of bool; episode_reward has the shape "
        "[2] instead of [1]."
    )


def test_a_flag_of_another_shape_is_named():
    env = SpecEnv()
    env.done_spec = Composite({key: Binary(2, dtype=torch.bool) for key in _FLAGS})
    text = faults(complete(env))
    assert all(f"{key} has the shape [2] instead of [1]" in text for key in _FLAGS)


def test_further_entries_and_transforms_are_nobodys_business():
    check_env(complete(SpecEnv(observations={"observation": _VECTOR, "pixels": Unbounded((3, 8, 8))})))
    check_env(complete(SpecEnv()).append_transform(StepCounter(4)))


def _model(observation_dim=3, action_dim=2, **options) -> WorldModel:
    return WorldModel(observation_dim, action_dim, latent_dim=16, mlp_dim=16, encoder_dim=16, **options)


# What does not fit a model of three observations and two actions, and what mends it where a transform can.
_MISFITS = {
    "one action too many": (
        {"action": Bounded(-1, 1, shape=(3,), dtype=torch.float32)},
        "action has 3 entries instead of the model's 2 (build the model with action_dim=3)",
    ),
    "another observation": (
        {"observations": {"observation": Unbounded(5)}},
        "observation has 5 entries instead of the model's 3 (build the model with observation_dim=5, or append "
        "CatTensors if the environment writes more than one vector)",
    ),
    "one-hot actions": ({"action": OneHot(2)}, "action is discrete (OneHot); only continuous actions are supported"),
    "no bounds": ({"action": Unbounded(2)}, "action has no finite bounds"),
    "half-open bounds": (
        {"action": Bounded(low=torch.full((2,), -1.0), high=torch.tensor([1, torch.inf]))},
        "action has no finite bounds",
    ),
    "bounds of 0 and 10": (
        {"action": Bounded(0, 10, shape=(2,), dtype=torch.float32)},
        "action has bounds of 0 and 10 instead of -1 and 1 (append ActionScaling())",
    ),
    "float64": (
        {"observations": {"observation": Unbounded(3, dtype=torch.float64)}},
        "observation is float64 instead of float32 (append DoubleToFloat(in_keys=['observation']))",
    ),
}


@pytest.mark.parametrize("batched", [False, True], ids=["one", "two"])
@pytest.mark.parametrize("misfit", _MISFITS)
def test_an_environment_is_compared_with_the_model(misfit, batched):
    options, expected = _MISFITS[misfit]
    env = SerialEnv(2, lambda: SpecEnv(**options)) if batched else SpecEnv(**options)
    assert expected in faults_of(lambda: check_spaces(env, observation_dim=3, action_dim=2))
    with pytest.raises(ValueError, match=re.escape(expected)):
        check_env(complete(env), _model())


def faults_of(check) -> str:
    with pytest.raises(ValueError) as error:
        check()
    text = str(error.value)
    assert "\n" not in text and text.startswith("this environment does not fit the model: ")
    return text


def test_an_environment_that_fits_the_model_passes():
    check_env(complete(SpecEnv()), _model())
    check_spaces(SpecEnv(), observation_dim=3, action_dim=2)


def test_the_dtype_is_that_of_the_model_s_weights():
    expected = (
        "observation is float32 instead of float64 (append DTypeCastTransform(torch.float32, torch.float64, "
        "in_keys=['observation']))"
    )
    with pytest.raises(ValueError, match=re.escape(expected)):
        check_env(complete(SpecEnv()), _model().double())


def test_a_model_that_encodes_what_it_likes_is_not_asked_about_observations():
    pixels = SpecEnv(observations={"pixels": Unbounded((3, 8, 8), dtype=torch.uint8)})
    check_spaces(pixels, observation_dim=None, action_dim=2)
    model = _model()
    model.observation_dim = None  # pyright: ignore[reportAttributeAccessIssue]
    check_env(complete(pixels), model)


def test_spaces_are_found_under_other_keys():
    env = SpecEnv(observations={"state": Composite(x=_VECTOR)}, action_key="torque")
    keys = {"observation_key": ("state", "x"), "action_key": "torque"}
    check_spaces(env, observation_dim=3, action_dim=2, **keys)
    text = faults_of(lambda: check_spaces(env, observation_dim=4, action_dim=1, **keys))
    assert "('state', 'x') has 3 entries instead of the model's 4" in text
    assert "torque has 2 entries instead of the model's 1" in text
