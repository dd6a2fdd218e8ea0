"""Which function computes which equation, and which tests hold it; ``tests/test_site.py`` checks the names."""

from __future__ import annotations

from typing import NamedTuple


class Equation(NamedTuple):
    """One row of the table."""

    source: str
    what: str
    formula: str
    function: str
    tests: tuple[str, ...]


_FUNCTIONAL, _OBJECTIVES, _PLANNERS = (f"torchrl_etdmpc.{room}" for room in ("functional", "objectives", "planners"))

EQUATIONS = (
    Equation(
        "thesis Eq. 2.11",
        "consistency of a head's rollout with the encodings",
        r"\frac{\rho^k}{L} \lVert \hat z_{k+1,i} - \mathrm{sg}(z_{k+1}) \rVert^2",
        f"{_OBJECTIVES}.consistency_error",
        ("tests/objectives/test_world_model_loss.py",),
    ),
    Equation(
        "thesis Eq. 2.12",
        "reward, read on every head's own rollout",
        r"\rho^k \, \mathrm{CE}(R(\hat z_{k,i}, a_k), r_k)",
        f"{_OBJECTIVES}.reward_error",
        ("tests/objectives/test_world_model_loss.py",),
    ),
    Equation(
        "thesis Eq. 2.13",
        "target of TD-MPC2's action values",
        r"y = r + \gamma \min_{j \in \mathcal I} \bar Q_j(z', a'), \; a' \sim \pi(z')",
        f"{_OBJECTIVES}.action_value_target",
        ("tests/objectives/test_tdmpc2_loss.py::test_the_target_takes_the_least_of_the_drawn_heads",),
    ),
    Equation(
        "thesis Eq. 2.14",
        "error of TD-MPC2's action values",
        r"\rho^k \, \mathrm{CE}(Q_j(\hat z_k, a_k), y_k)",
        f"{_OBJECTIVES}.action_value_error",
        ("tests/objectives/test_tdmpc2_loss.py::test_the_loss_equals_a_plain_reference",),
    ),
    Equation(
        "thesis Eq. 2.15",
        "what TD-MPC2's policy maximises",
        r"\bar Q(z, a) + \alpha \mathcal{H}(\pi(z))",
        f"{_OBJECTIVES}.policy_value",
        ("tests/objectives/test_tdmpc2_loss.py::test_the_gradient_of_every_network_is_that_of_the_plain_reference",),
    ),
    Equation(
        "thesis Eq. 2.16",
        "imagined value target at an encoded latent",
        r"y = R(z, a) + \gamma \, \mathrm{mean}_{i,j} \, \bar V_j(f_i(z, a)), \; a \sim \pi(z)",
        f"{_OBJECTIVES}.imagined_value_target",
        ("tests/objectives/test_value_loss.py",),
    ),
    Equation(
        "thesis Eq. 2.17",
        "distillation of the plan into the policy",
        r"\mathrm{KL}(\pi(\hat z) \,\Vert\, \mathcal{N}(\mu, \sigma^2))",
        f"{_OBJECTIVES}.distillation",
        (
            "tests/objectives/test_policy_loss.py",
            "tests/functional/test_gaussian.py::test_kl_equals_torchs_in_both_directions_and_they_differ",
        ),
    ),
    Equation(
        "thesis Eq. 3.1",
        "return estimates of every depth and pair of heads",
        r"Q_h(i, j) = \sum_{u<h} \gamma^u R(\hat z_{u,i}, a_u) + \gamma^h V_j(\hat z_{h,i})",
        f"{_FUNCTIONAL}.return_table",
        ("tests/functional/test_returns.py::test_the_table_equals_eq_3_1_term_by_term",),
    ),
    Equation(
        "thesis Eq. 3.2",
        "mean over the heads",
        r"\bar Q_h = \frac{1}{F V} \sum_{i,j} Q_h(i, j)",
        f"{_FUNCTIONAL}.ensemble_mean",
        ("tests/functional/test_horizon.py::test_ensemble_mean_and_variance_are_those_of_all_pairs_of_heads",),
    ),
    Equation(
        "thesis Eq. 3.3",
        "variance of that mean",
        r"\sigma_h^2 = \frac{\sum_{i,j} (Q_h(i, j) - \bar Q_h)^2}{F V (F V - 1)}",
        f"{_FUNCTIONAL}.ensemble_variance",
        ("tests/functional/test_horizon.py::test_ensemble_mean_and_variance_are_those_of_all_pairs_of_heads",),
    ),
    Equation(
        "thesis 3.4.3",
        "the last depth, with a penalty: the score of reanalyze",
        r"\bar Q_H - \beta \sigma_H",
        f"{_PLANNERS}.FinalScore",
        ("tests/planners/test_scores.py::test_final_is_the_penalised_mean_at_the_last_depth",),
    ),
    Equation(
        "thesis Eq. 3.4",
        "mean over the depths: the score of acting",
        r"\frac{1}{H} \sum_h \bar Q_h",
        f"{_PLANNERS}.MeanScore",
        ("tests/planners/test_scores.py::test_mean_averages_over_depths_before_it_measures_disagreement",),
    ),
    Equation(
        "thesis Eq. 4.14",
        "best mixture of depths, in closed form",
        r"\max_{w \in \Delta} \; w^\top q - \beta \sqrt{\textstyle\sum_h w_h^2 \sigma_h^2}",
        f"{_FUNCTIONAL}.adaptive_mixture",
        (
            "tests/functional/test_horizon.py"
            "::test_the_adaptive_mixture_attains_what_a_generic_constrained_optimiser_finds",
            "tests/functional/test_horizon.py::test_the_adaptive_mixture_satisfies_the_optimality_conditions",
        ),
    ),
    Equation(
        "thesis 3.2, TD-MPC2",
        "the fit of MPPI to its elites; $\\lambda$ is the inverse temperature",
        r"\mu = \sum_k w_k a_k, \; w = \mathrm{softmax}(\lambda s)",
        f"{_FUNCTIONAL}.fit_gaussian",
        (
            "tests/functional/test_mppi.py::test_fit_gaussian_is_the_weighted_mean_and_standard_deviation",
            "tests/planners/test_iterations.py::test_every_iteration_refits_the_elites",
        ),
    ),
    Equation(
        "thesis 2.4",
        "the policy's action",
        r"a = \mathrm{clip}(\mu + \sigma \epsilon, -1, 1)",
        f"{_FUNCTIONAL}.clipped_sample",
        ("tests/functional/test_gaussian.py::test_a_sample_is_clipped_at_both_ends",),
    ),
    Equation(
        "TD-MPC2, SimNorm",
        "the range of a latent",
        r"\mathrm{softmax}(z_g), \; g = 1..L/8",
        f"{_FUNCTIONAL}.simnorm",
        ("tests/functional/test_simnorm.py::test_simnorm_is_td_mpc2s_adjacent_groups_up_to_a_fixed_permutation",),
    ),
    Equation(
        "DreamerV3, symlog",
        "the scale of rewards and values",
        r"\mathrm{sign}(x) \ln(1 + |x|)",
        f"{_FUNCTIONAL}.symlog",
        ("tests/functional/test_two_hot.py::test_symexp_inverts_symlog",),
    ),
    Equation(
        "DreamerV3, two-hot",
        "the error of rewards and values",
        r"-\sum_m \mathrm{twohot}(y)_m \ln p_m",
        f"{_FUNCTIONAL}.two_hot_cross_entropy",
        ("tests/functional/test_two_hot.py::test_the_gradient_of_the_cross_entropy_is_softmax_minus_target",),
    ),
    Equation(
        "TD-MPC2, thesis Table A.1",
        "the discount that episodes of $E$ decisions suggest",
        r"\mathrm{clip}\left(\frac{E/5 - 1}{E/5}, 0.95, 0.995\right)",
        f"{_FUNCTIONAL}.discount_from_episode_length",
        ("tests/functional/test_returns.py::test_the_discount_heuristic_gives_the_published_discounts",),
    ),
)
