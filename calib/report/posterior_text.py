"""How the posterior of a parameter is written: the same digits on the page and everywhere else."""

from __future__ import annotations

from calib.inference.calibration import ParameterSummary
from calib.report.numbers import (
    format_at,
    format_interval,
    format_value,
    interval_places,
    last_place,
)

# An interval that is this much longer on one side, or spans this factor, has no telling mean.
_LOPSIDED = 2.0
_DECADES = 30.0


def skewed(s: ParameterSummary) -> bool:
    """Whether mean and sd would mislead.

    They do where the HDI reaches more than twice as far on one side of the median as on the
    other, or spans more than a factor of 30.
    """
    near, far = sorted((s.median - s.hdi_lower, s.hdi_upper - s.median))
    low, high = sorted((abs(s.hdi_lower), abs(s.hdi_upper)))
    one_sign = s.hdi_lower * s.hdi_upper > 0.0
    return far > _LOPSIDED * near or (one_sign and high > _DECADES * low)


def end_scales(s: ParameterSummary) -> tuple[float, float]:
    """Distances that set the digits of the HDI's ends: sd or distance to the median, the smaller.

    The sd of a skewed parameter is that of its long tail, which would round the other end away; of
    a tail of many decades it says nothing at all, not even how near an end may be to the median.
    """
    floor = 1e-3 * min(s.sd, s.hdi_upper - s.hdi_lower)
    return (
        min(s.sd, max(s.median - s.hdi_lower, floor)),
        min(s.sd, max(s.hdi_upper - s.median, floor)),
    )


def centre_place(s: ParameterSummary) -> int:
    """Return the power of ten of the median's last digit."""
    return last_place(min(end_scales(s)), s.mcse_median)


def centre_text(s: ParameterSummary) -> str:
    """Write mean and sd, or the median where these would mislead."""
    if not skewed(s):
        return format_value(s.mean, s.sd, s.mcse_mean)
    return f"median {format_at(s.median, centre_place(s))}"


def end_places(s: ParameterSummary) -> tuple[int, int]:
    """Return the powers of ten of the last digits of the HDI's ends."""
    return interval_places(end_scales(s), (s.mcse_hdi_lower, s.mcse_hdi_upper))


def interval_text(s: ParameterSummary) -> str:
    """Write the HDI."""
    return format_interval(
        s.hdi_lower, s.hdi_upper, end_scales(s), (s.mcse_hdi_lower, s.mcse_hdi_upper)
    )
