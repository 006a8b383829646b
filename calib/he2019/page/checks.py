"""Sentences for the checks of the source's gaps, from the numbers in `summary.json`."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from calib.he2019.gaps.checks import Check
from calib.report.gap_rows import short_name
from calib.report.gap_verdict import odds_text
from calib.report.labels import percent, short
from calib.report.numbers import format_value

type _Values = Mapping[str, float]


def check_text(check: Check) -> tuple[str, str]:
    """Return the heading of a check and what it found."""
    if check.name in _TEXTS:
        heading, text = _TEXTS[check.name]
        return heading, text(check.values)
    return check.name.replace("_", " ").capitalize(), _asked_otherwise(check.values)


def _asked_otherwise(v: _Values) -> str:
    named = {k.removeprefix("probability_"): p for k, p in v.items() if k.startswith("probab")}
    listed = ", ".join(f"{short_name(name)} {odds_text(p)}" for name, p in named.items())
    return f"{v['rows']:.0f} field rows: {listed}"


def _deepening(v: _Values) -> str:
    return (
        f"{short(v['median'], 3)} times the rut that plain Bekker gives (90 % interval "
        f"{short(v['lower_90'], 3)} to {short(v['upper_90'], 3)}); Eq 21 with Table 6 says "
        f"{short(v['eq_21_with_table_6'], 3)}"
    )


def _shift(v: _Values) -> str:
    text = (
        f"{format_value(v['mean_percent'], v['sd_percent'])} percentage points (90 % interval "
        f"{short(v['lower_90_percent'])} to {short(v['upper_90_percent'])})"
    )
    if "withheld_percent" in v:
        return f"{text}; {short(v['withheld_percent'])} were withheld"
    return f"{text}, probability {odds_text(v['probability'])}"


def _kept_out(v: _Values) -> str:
    key, unit = ("mm", "mm") if "rmse_before_mm" in v else ("kn", "kN")
    text = (
        f"error from {short(v[f'rmse_before_{key}'])} to {short(v[f'rmse_after_{key}'])} {unit} "
        f"rms; {v['in_90_band']:.0f} of {v['rows']:.0f} rows in the corrected model's 90 % band"
    )
    if "largest_relative_after" not in v:
        return text
    before, after, published = (
        percent(v[f"largest_relative_{which}"]) for which in ("before", "after", "published")
    )
    return f"{text}; largest relative error from {before} to {after} (source: {published})"


def _open(v: _Values) -> str:
    return (
        f"it misses by {short(v['miss_rms_kn'])} kN rms, where the calibration left "
        f"{short(v['simulator_sd_rms_kn'])} kN open (sd) and a reading has "
        f"{short(v['noise_sd_kn'])} kN of noise"
    )


def _refitted(v: _Values) -> str:
    return (
        f"{short(v['miss_rms_kn'])} kN rms are left at 30 psi, and no curvature in pressure moves "
        f"by more than {short(v['largest_bend_prior_sd'])} prior sd"
    )


def _could_be(v: _Values) -> str:
    return (
        f"some gap {odds_text(v['probability_some_gap'])}; an unlisted cause "
        f"{odds_text(v['probability_unknown'])}, post-peak softening "
        f"{odds_text(v['probability_post_peak_softening'])}"
    )


def _costs(v: _Values) -> str:
    return (
        f"residual sd {short(v['sd_18_psi_kn'])} kN at 18 psi, {short(v['sd_others_kn'])} kN at "
        f"the others, a variance ratio of {short(v['variance_ratio'])} (p = "
        f"{short(v['p_value'])} for equal noise): there either the formula misses or the noise "
        "is larger, and printed figures cannot say which"
    )


_TEXTS: Mapping[str, tuple[str, Callable[[_Values], str]]] = {
    "alone_or_with_another": (
        "Slip sinkage, alone or with another effect",
        lambda v: f"probability {odds_text(v['probability'])}",
    ),
    "deepening_at_20_percent_slip": ("Rut at 20 % slip", _deepening),
    "kept_out_rows": ("30 psi, in neither campaign", _kept_out),
    "shift_at_zero_slip": ("Shift at zero slip", _shift),
    "halves_swapped": ("Halves swapped", _shift),
    "slips_given_back": (
        "The same rows with redefined slips",
        lambda v: f"no gap, probability {odds_text(v['probability_none'])}",
    ),
    "miss_against_what_was_open": ("The calibrated model at 30 psi", _open),
    "no_effect_fitted_to_all": ("The same model, fitted to 30 psi too", _refitted),
    "what_it_could_be": ("What it could be", _could_be),
    "costs_in_table_4": ("Table 4 alone, nothing reconstructed", _costs),
}
