"""The tuned numbers of the diagnosis, in one table.

Each line has the value, its unit, why it is so, and the test of `tests/gap` that would notice
another value. Numbers of one method that nobody tunes stand where they are used.
"""

from __future__ import annotations

import numpy as np

# Campaigns that are refused, and rows that are set aside.
MIN_FIELD_ROWS = 5  # rows; fewer cannot tell a gap from noise; test_campaigns
MAX_RATIO = 100.0  # 1; a larger ratio of campaigns is a wrong unit; test_campaigns
ASSUMED_LOAD_KN = 5.0  # kN; scale of forces where no load is recorded; test_campaigns
FIELD_OUTLIER = 5.0  # noise sds from every explanation; test_screening
LAB_OUTLIER = 8.0  # robust sds; higher, because the row itself widens the noise; test_screening
LEFT_OVER = 3.5  # noise sds; one noisy reading in 2000 is named; test_screening
MOST_ROUNDS = 3  # times that outliers are sought again; test_screening
IMPOSSIBLE_READING = 20.0  # spreads of the lab's readings; no gap is a tenth of it; test_screening
FAR_CONDITION = 1.5  # ranges beyond all other values, as a typing error is; test_screening
FAR_FACTOR = 8.0  # 1; and at least this factor beyond them; test_screening
FAR_PART = 0.05  # of the rows; more far values are the campaigns' own way; test_screening

# Pairs of campaigns that look odd.
ODD_RATIO = 4.0  # 1; outputs of two campaigns differ by less; test_screening
FAR_RATIO = 10.0  # 1; conditions with overlapping ranges differ by less; test_screening
PERCENT_RATIO = 50.0  # 1; a fraction and a percentage differ by 100, within 2; test_screening
NEAR_UNIT, ROUGHLY_UNIT = 0.15, 0.4  # sds of a log ratio from a factor of units; test_screening
HELD = 0.05  # relative scatter of a condition that was held constant; test_screening
NOISIER = 2.0  # 1; scatter of the field over the lab's that is said; test_screening
UNUSUAL_SIZE = 4.0  # sds from its prior at which a known size is questioned; test_case

# How noise grows: with slip by 1 + rho s, with softness by (p_lab / p)^kappa; test_fit.
RHO = np.array([0.0, 1.0, 2.5, 5.0])  # 1
LN_RHO_PRIOR = np.log(np.array([0.5, 0.2, 0.15, 0.15]))  # most noise is even
KAPPA = np.array([0.0, 0.8, -0.8])  # 1; He et al.'s pull is twice as noisy at 18 as at 42 psi
LN_KAPPA_PRIOR = np.log(np.array([0.7, 0.2, 0.1]))
CORRELATIONS = 9  # correlations of neighbours, equally probable; if asked for; test_correlated

# Prior probabilities of hypotheses; test_hypotheses, test_ranking.
PRIOR = {"none": 0.40, "unknown": 0.12, "parameter_shift": 0.12, "single": 0.36}  # of the kinds
PAIR_TO_SINGLE = 0.04  # each cause more: effects act independently, each in 1 of 25 campaigns
RESIDUAL_DISCREPANCY = 0.15  # something unlisted acts beside listed causes
UNDERINFLATED = 0.06  # part of `unknown` that a tyre which creeps on its rim has
COVERED = 0.02  # beside a listed effect: dependence on a condition that another effect covers
SELDOM = 0.2  # beside a listed effect: a reading that is wrong and has no listed effect
SHIFTS = (0.1, 0.25, 0.6)  # prior sds; sizes of parameter shifts
SAME_SOIL_SHIFTS = SHIFTS[:2]  # prior sds; one soil from place to place; test_hypotheses
OTHER_SOIL_SHIFTS = (0.25, 0.6, 1.4)  # prior sds; two soils of a prior differ by 1.4 of its sds
SHIFT_PRIOR = {True: 0.06, False: 0.5}  # of a shift, with the same soil or another; test_case
SOIL = 2.0 / 3.0  # part of the shifts in which parameters move together, as soils move them
SHIFT_DIFFERENCE = 0.2  # prior sds; how pressures, slips or water differ in a shift
RADIUS_ERROR = 0.03  # 1; rolling radius behind a shifted zero of slip
SMOOTHS = (1.5, 5.0)  # noise sds; sizes of a smooth discrepancy
ONSET = 4.0  # noise sds; size of a discrepancy beyond a threshold
ONSET_WIDTH = 0.06  # of the scaled covariate; how sharply such a discrepancy sets in
RIPPLES = 12  # waves over the slips that a ripple may have
WIDE, WIDER, WIDER_LOG = 0.1, 4.0, 2.0  # one effect in ten is 4 (log: 2) times as wide

# Relative size by which a formula may misrepresent its effect, by direction; estimated from the
# true effects of 690 single-effect cases of the challenge; test_forward.
FORM_ERROR = {
    "size": 0.2,
    "slip": 0.15,
    "bend": 0.1,
    "pressure": 0.13,
    "cone": 0.15,
    "water": 0.1,
    "shape": 0.18,
    "extrapolation": 0.2,
}
MISFIT = 1.0  # noise sds; inadequacy of a simulator at the end of the lab's range; test_forward

# Minimum effect sizes, and tempering of the likelihood; test_ranking.
MIN_EFFECT_SIZE = 1.5  # noise sds rms in some output: what counts as an effect
MIN_EFFECT_SIZE_IN_PAIR = 1.0  # noise sds; each of several causes
LEFT = 0.08  # of a gap that no formula has the shape of; large gaps are calibrated by it
MOST_LEFT = 0.6  # noise sds; the most of that

# What a diagnosis says.
NAMED = 0.5  # probability from which a hypothesis or cause is named; test_files
FALSE_REGIONS = 0.1  # expected part of regions listed that are none, as is usual; test_mixture
WORTH_SAYING = 0.05  # probability from which a caveat is given; test_files
FOLDS = 5  # parts of the field rows left out in turn; test_files
FOLD_DRAWS = 300.0  # effective draws there: they weigh predictions, not evidence; test_files
SHARE_ERROR = 0.35  # relative error of a cause's size among several; test_mixture
SMALLEST_GAP = 0.5  # of the noise (rms); a smaller gap cannot shrink; test_corrected
SURPRISE = 1.25  # 1; widens the lower end of a shrink to hold 90 % of blind cases; test_corrected
ALIKE = 0.95  # cosine from which a design cannot tell two effects apart; test_ranking


# How sets of causes are screened, and posteriors drawn; test_ranking, test_posterior.
PRIOR_DRAWS = 1024  # of each cause
PARTS = 8  # normals that stand for an effect's prior draws
RANK = 8  # directions in which the rows of a part vary
BEAM = 100  # choices of parts that are enlarged by one more cause; 300 changed nothing
MOST_CAUSES = 4
CUT = 10.0  # nats behind the best by the screen from which a hypothesis is given up; 15: no change
BESIDE = 10  # best listed hypotheses beside which something unlisted is tried
GUESSES = 3  # best choices of parts that a posterior's search begins from
STEPS = 4  # regressions by which a guess is conditioned on the rows
GUESS_SCALE = 1.5  # of a guess's sd, whose tails would be too light
FIRST, FIRST_ROUNDS = 100.0, (1000,) * 4  # effective draws that a first look asks for; its rounds
IN_PLAY = 6.0  # nats behind the best, by first looks that are up to two too low
PLENTY = 1280.0  # effective draws; evidence within 0.04 nats (one sd)
ROUNDS = (2000,) * 7 + (4000,)  # draws
FEWEST_DRAWS = 100.0  # effective; with fewer an evidence has an error of 0.1 nats: said first
