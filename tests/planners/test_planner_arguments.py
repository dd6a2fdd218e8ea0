from __future__ import annotations

import math

import pytest
import torch

from torchrl_etdmpc import EnsembleMPPIPlanner, FinalScore
from torchrl_etdmpc.testing import LineWorld


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"horizon": 0}, r"horizon must be at least 1, got 0\."),
        ({"iterations": 0}, r"iterations must be at least 1, got 0\."),
        ({"num_elites": 0}, r"num_elites must be at least 1, got 0\."),
        ({"num_elites": 25}, r"num_elites must be at most num_samples=24, got 25\."),
        ({"num_proposals": 24}, r"num_proposals must be in \[0, num_samples=24\), got 24\."),
        ({"num_proposals": -1}, r"num_proposals must be in \[0, num_samples=24\), got -1\."),
        ({"extra_iterations": -1}, r"extra_iterations must not be negative, got -1\."),
        ({"inverse_temperature": -0.5}, r"inverse_temperature must be finite and not negative, got -0\.5\."),
        ({"inverse_temperature": math.nan}, r"inverse_temperature must be finite and not negative, got nan\."),
        ({"inverse_temperature": math.inf}, r"inverse_temperature must be finite and not negative, got inf\."),
        ({"beta": math.nan}, r"beta must be finite, got nan\."),
        ({"score": "adaptive", "beta": math.inf}, r"beta must be finite, got inf\."),
        ({"score": FinalScore}, r"score must be an object, got the class FinalScore; pass FinalScore\(\.\.\.\)\."),
        ({"std_max": math.inf}, r"std_max must be finite and positive, got inf\."),
        ({"std_min": 0.0}, r"std_min must be in \[1e-06, std_max=2\.0\], got 0\.0\."),
        ({"std_min": 1e-46}, r"std_min must be in \[1e-06, std_max=2\.0\], got 1e-46\."),
        ({"std_min": 3.0}, r"std_min must be in \[1e-06, std_max=2\.0\], got 3\.0\."),
        ({"discount": 0.0}, r"discount must be in \(0, 1\], got 0\.0\."),
        ({"discount": 1.1}, r"discount must be in \(0, 1\], got 1\.1\."),
        ({"first_action": "last"}, r"first_action must be one of elite, mean, best, got 'last'\."),
        ({"eval_first_action": "last"}, r"eval_first_action must be one of elite, mean, best, got 'last'\."),
        ({"initial": "zeros"}, r"initial must be one of wide, policy, got 'zeros'\."),
        ({"score": "best"}, r"score must be one of final, mean, adaptive or a callable, got 'best'\."),
        (
            {"score": FinalScore(), "beta": 1.0},
            r"beta=1\.0 has no effect on a score of your own; put the penalty into the callable\.",
        ),
        (
            {"score": "adaptive", "beta": -1.0},
            r"beta must not be negative with the adaptive score, got -1\.0; score='final' and score='mean' take a "
            r"negative one, for optimism\.",
        ),
        (
            {"scoring_dtype": "int8"},
            r"scoring_dtype must be one of float16, bfloat16, float32, float64, got 'int8'\.",
        ),
        ({"scoring_dtype": torch.int8}, r"scoring_dtype must be a floating point dtype, got torch\.int8\."),
        (
            {"proposal_log_std_min": -2.0},
            r"proposal_log_std_min and proposal_log_std_max must be given together, got -2\.0 and None; leave both out "
            r"for the policy's own bounds\.",
        ),
        (
            {"proposal_log_std_max": 1.0},
            r"proposal_log_std_min and proposal_log_std_max must be given together, got None and 1\.0; leave both out "
            r"for the policy's own bounds\.",
        ),
        (
            {"proposal_log_std_min": 1.0, "proposal_log_std_max": 1.0},
            r"proposal_log_std_min must be below proposal_log_std_max=1\.0 and both finite, got 1\.0\.",
        ),
        (
            {"proposal_log_std_min": math.nan, "proposal_log_std_max": 1.0},
            r"proposal_log_std_min must be below proposal_log_std_max=1\.0 and both finite, got nan\.",
        ),
    ],
)
def test_an_impossible_argument_is_refused(options, message, make_planner):
    with pytest.raises(ValueError, match=f"^{message}$"):
        make_planner(LineWorld(), **options)


def test_a_plan_from_nothing_is_refused(make_planner):
    with pytest.raises(ValueError, match=r"^plan needs an observation or a latent, got neither\.$"):
        make_planner(LineWorld()).plan()


@pytest.mark.parametrize("env", [None, LineWorld()])
def test_an_environment_that_is_not_a_latent_env_is_refused(env):
    with pytest.raises(
        TypeError,
        match=rf"^EnsembleMPPIPlanner needs a LatentEnv, got {type(env).__name__}; wrap the networks: "
        r"LatentEnv\(world_model\)\.$",
    ):
        EnsembleMPPIPlanner(env)
