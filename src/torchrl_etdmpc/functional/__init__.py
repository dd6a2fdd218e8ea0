"""Pure maths on tensors: no state, no modules, any leading batch."""

from torchrl_etdmpc.functional.activation import mish
from torchrl_etdmpc.functional.gaussian import (
    bounded_log_std,
    clipped_sample,
    gaussian_entropy,
    gaussian_kl,
    tanh_log_slope,
)
from torchrl_etdmpc.functional.horizon import (
    adaptive_mixture,
    ensemble_mean,
    ensemble_std,
    ensemble_variance,
    lower_confidence_bound,
)
from torchrl_etdmpc.functional.mppi import (
    Elites,
    Gaussian,
    elite_weights,
    fit_gaussian,
    sample_elite,
    sample_sequences,
    select_elites,
    shift_plan,
)
from torchrl_etdmpc.functional.returns import bootstrapped_returns, discount_from_episode_length, return_table
from torchrl_etdmpc.functional.running_moments import updated_moments
from torchrl_etdmpc.functional.running_scale import updated_scale
from torchrl_etdmpc.functional.simnorm import simnorm
from torchrl_etdmpc.functional.two_hot import symexp, symlog, two_hot_cross_entropy, two_hot_decode, two_hot_encode

__all__ = [
    "mish",
    "Elites",
    "Gaussian",
    "adaptive_mixture",
    "bootstrapped_returns",
    "bounded_log_std",
    "clipped_sample",
    "discount_from_episode_length",
    "elite_weights",
    "ensemble_mean",
    "ensemble_std",
    "ensemble_variance",
    "fit_gaussian",
    "gaussian_entropy",
    "gaussian_kl",
    "lower_confidence_bound",
    "return_table",
    "sample_elite",
    "sample_sequences",
    "select_elites",
    "shift_plan",
    "simnorm",
    "symexp",
    "symlog",
    "tanh_log_slope",
    "two_hot_cross_entropy",
    "two_hot_decode",
    "two_hot_encode",
    "updated_moments",
    "updated_scale",
]
