"""Tuned numbers of validation: value, unit, reason, and the test that would notice a change."""

from __future__ import annotations

# Levels of the bands and of their coverage; README and the formats name them; golden numbers.
LEVELS = (0.5, 0.9, 0.95)
# Predictive draws; an error of 0.3 % in a 95 % level; test_prediction.
N_DRAWS = 4000
# Blocks of draws whose means give Monte Carlo errors, known themselves to a fifth; test_questions.
BLOCKS = 16
# Part of the posterior that must have a value for a band to be given; test_prediction.
MIN_DEFINED = 0.95
# Pareto k above which importance sampling cannot leave a row out (Vehtari et al. 2024);
# test_validate.
PARETO_K_MAX = 0.7
# Relative error from which a row is counted as far off; the formats name 6 %; test_scores.
RELATIVE_ERROR_FAR = 0.06
# 1 - var_posterior/var_prior below which the prior sets a parameter: an sd above nine tenths of the
# prior's; test_sensitivity.
CONTRACTION_MIN = 0.19
# Reaction to power scaling above which a marginal is sensitive (Kallioinen et al. 2024);
# test_sensitivity.
SENSITIVITY_MIN = 0.05
# Difference of elpd that is small whatever its standard error, which few rows underestimate, and
# the standard errors that make one clear (Sivula et al. 2020); test_noise_preference.
SMALL, CLEAR = 4.0, 2.0
# Chance that any test of a family fails where all is as assumed: of one calibration's rows and
# priors, or of a run of simulation-based calibration; test_assumptions.
LEVEL = 0.05
# Probability of naming any row of data that are as the likelihood says; test_outliers.
OUTLYING_LEVEL = 1e-3
# Posterior sds from which an estimate contradicts the prior, if the likelihood finds it better too;
# test_structure.
FAR_SDS = 3.0
# Rows that are judged at all, and rows of a group whose scatter or mean is compared, at least;
# test_assumptions.
FEWEST, FEWEST_IN_GROUP = 8, 5
# Half of a normal's central 90 % in sds; tests of a plan, or until a band halves: nobody plans
# more; test_plan.
HALF_BAND, MOST_TESTS = 1.6448536269514722, 50
