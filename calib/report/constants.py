"""Tuned numbers of reports: what each is, why, and the test that notices a change."""

from __future__ import annotations

MAX_ROWS = 5000  # rows; figures and leave-one-out hold a number for every draw and row; test_study
WEAK_SKILL = (
    0.5  # of the variance of unseen rows; below it the median explains little; test_verdict
)
EXPECTED = 0.5  # of the rows in the priors' 95 % band; fewer are a surprise; test_verdict
LOPSIDED = 2.0  # reaches of the HDI from the median; beyond it mean and sd mislead; test_words
DECADES = 30.0  # of the HDI's ends; beyond it mean and sd mislead; test_words
WIDE = 2.5  # of the 98 and 2 % points; beyond it a parameter is drawn by its logarithm; test_plates
DPI = 150  # of a PNG; sharp on screens, and small in a page of thirty; test_writer
EDGE = 5.0  # posterior sds; estimates farther off are drawn at the edge; test_plates
SURE = 0.9  # probability; from here on a cause, or no gap, is certain; test_gap_words
TIE = 0.2  # of the best explanation's probability; those above tie with it; test_gap_words
SHOWN = 0.045  # probability; what is less is not spoken of, as it is below 5 %; test_gap_words
