from __future__ import annotations

import pytest
import torch

from torchrl_etdmpc.inspector import planner_settings, settings_of_class, with_settings
from torchrl_etdmpc.inspector.settings import plain_settings
from torchrl_etdmpc.planners import AdaptiveScore, EnsembleMPPIPlanner, LatentEnv
from torchrl_etdmpc.testing import LineWorld


def make(**settings) -> EnsembleMPPIPlanner:
    budget = {"horizon": 3, "num_samples": 16, "num_elites": 4, "num_proposals": 2, "iterations": 2}
    return EnsembleMPPIPlanner(LatentEnv(LineWorld(num_dynamics=2)), **budget | settings)


class Greedy(EnsembleMPPIPlanner):
    def __init__(self, env: LatentEnv, *, greed: float = 0.5, **kwargs) -> None:
        super().__init__(env, **kwargs)
        self.greed = greed


def test_every_argument_but_the_keys_is_a_setting():
    settings = settings_of_class(EnsembleMPPIPlanner)
    assert settings["horizon"][:4] == ("horizon", "whole", (), False)
    assert settings["beta"].kind == "number"
    assert settings["warm_start"].kind == "switch"
    assert settings["first_action"].choices == ("elite", "mean", "best")
    assert settings["scoring_dtype"].optional
    assert "env" not in settings
    assert not [name for name in settings if name.endswith("_key")]


def test_a_new_argument_of_a_subclass_appears_by_itself_and_can_be_changed():
    planner = Greedy(LatentEnv(LineWorld()), greed=0.25, horizon=2)
    assert list(settings_of_class(Greedy))[0] == "greed"
    changed = with_settings(planner, greed=0.75)
    assert (changed.greed, changed.horizon, planner.greed) == (0.75, 2, 0.25)


def test_a_subclass_s_own_default_counts():
    class Far(EnsembleMPPIPlanner):
        def __init__(self, env: LatentEnv, *, horizon: int = 9, **kwargs) -> None:
            super().__init__(env, horizon=horizon, **kwargs)

    assert settings_of_class(Far)["horizon"].default == 9


def test_an_argument_that_is_not_keyword_only_is_kept_too():
    class Positional(EnsembleMPPIPlanner):
        def __init__(self, env: LatentEnv, greed: float = 0.5, **kwargs) -> None:
            super().__init__(env, **kwargs)
            self.greed = greed

    changed = with_settings(Positional(LatentEnv(LineWorld()), 0.9), beta=1.0)
    assert (changed.greed, changed.score.beta) == (0.9, 1.0)
    assert "env" not in settings_of_class(Positional)


@pytest.mark.parametrize(
    "settings",
    [
        {"score": "adaptive", "beta": 2.0, "discount": 0.9, "warm_start": False},
        {"extra_iterations": 3, "large_action_dim": 0},
        {"scoring_dtype": "float64", "proposal_log_std_min": -2.0, "proposal_log_std_max": 1.0},
        {"observation_key": "state", "action_key": ("agent", "action"), "plan_key": ("agent", "plan")},
        {"is_init_key": "begins", "plan_mean_key": ("agent", "carried"), "latent_key": "state"},
    ],
)
def test_the_same_settings_make_the_same_planner(settings):
    planner = make(**settings)
    again = with_settings(planner)
    assert again is not planner
    assert plain_settings(again) == plain_settings(planner)
    assert (again.iterations, repr(again.score)) == (planner.iterations, repr(planner.score))
    for keys in ("in_keys", "out_keys", "plan_keys", "is_init_key", "plan_mean_key", "latent_key"):
        assert getattr(again, keys) == getattr(planner, keys), keys
    noise = planner.draw_noise(1, generator=torch.Generator().manual_seed(0))
    plans = [each.plan(torch.tensor([[0.5]]), noise=noise) for each in (planner, again)]
    assert torch.equal(plans[0].action, plans[1].action)


def test_a_score_of_one_s_own_is_kept_and_can_be_left():
    own = make(score=lambda returns: returns.amin((-3, -2, -1)))
    assert planner_settings(with_settings(own))["score"] is own.score
    assert isinstance(with_settings(own, score="adaptive", beta=1.0).score, AdaptiveScore)
    assert plain_settings(own)["score"] == "<lambda>"


def test_the_planner_s_constructor_checks_what_is_changed():
    with pytest.raises(ValueError, match="num_elites must be at most num_samples=16, got 99"):
        with_settings(make(), num_elites=99)
    with pytest.raises(ValueError, match="planner has no setting 'depth'; it has horizon, "):
        with_settings(make(), depth=3)


def test_an_argument_that_is_not_kept_is_named():
    class Forgetful(EnsembleMPPIPlanner):
        def __init__(self, env: LatentEnv, *, memory: int = 1, **kwargs) -> None:
            super().__init__(env, **kwargs)

    with pytest.raises(TypeError, match="Forgetful takes memory and has no attribute of that name; keep it as"):
        with_settings(Forgetful(LatentEnv(LineWorld())))
