"""The report's section on the source's own gaps, and the page of each diagnosis below it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from calib.batch.pool import Pool
from calib.gap.files import write_diagnosis
from calib.he2019.figures.gaps import gap_plate
from calib.he2019.gaps.find import Check, FoundGap, checks, probability_of
from calib.models import get_model
from calib.report.figures.gap import gap_plates
from calib.report.figures.plate import Plate
from calib.report.figures.style import pdf_bytes, png_size
from calib.report.gap_evidence import gap_verdict
from calib.report.gap_rows import short_name
from calib.report.gap_verdict import odds_text
from calib.report.labels import percent, short
from calib.report.numbers import format_value
from calib.report.page.diagnosis import TONE_MARKS, render_diagnosis
from calib.report.page.template import data_uri, template

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


type Progress = Callable[[str, int, int], None]
type ToPng = Callable[[Plate], bytes]


def begin_gaps_section(
    results: Sequence[FoundGap],
    folder: Path,
    to_png: ToPng,
    *,
    versions: Mapping[str, str],
    pdf: bool,
    pool: Pool,
) -> Callable[[Progress], str]:
    """Ask for figures and pages of the gaps in a report folder; return what waits for the section.

    The folder has ``figures/``; it gets ``figures/gap_NAME.png``, as PDF too if asked, and
    ``gaps/NAME/``, each what `calib diagnose` writes, its figures inside the page only.
    """
    pieces = [pool.submit(_write_gap, r, folder, to_png, versions, pdf) for r in results]

    def finish(tell: Progress) -> str:
        blocks = []
        for i, piece in enumerate(pieces):
            tell("the paper's own gaps: drawing", i, len(pieces))
            blocks.append(piece.result())
        tell("the paper's own gaps: drawing", len(pieces), len(pieces))
        return template("gaps.html.j2", "calib.he2019.page").render(gaps=blocks)

    return finish


def _write_gap(
    result: FoundGap, folder: Path, to_png: ToPng, versions: Mapping[str, str], pdf: bool
) -> dict[str, Any]:
    plate = gap_plate(result)
    image = to_png(plate)
    (folder / "figures" / f"gap_{plate.name}.png").write_bytes(image)
    if pdf and plate.figure is not None:
        file = folder / "figures" / f"gap_{plate.name}.pdf"
        file.write_bytes(pdf_bytes(plate.figure))
    inner = folder / "gaps" / result.gap.name
    inner.mkdir(parents=True)
    write_diagnosis(result.found, inner)
    drawn = gap_plates(result.found)
    images = {f"{p.name}.png": to_png(p) for p in drawn if p.figure is not None}
    page = render_diagnosis(result.found, drawn, images, manifest={"versions": versions})
    (inner / "index.html").write_text(page, encoding="utf-8")
    return _block(result, plate, image)


def _block(result: FoundGap, plate: Plate, image: bytes) -> dict[str, Any]:
    gap, found = result.gap, result.found
    verdict = gap_verdict(found)
    ranking = found.ranking
    case = found.data.case
    return {
        "name": gap.name,
        "title": gap.title,
        "question": gap.question,
        "rows": [
            ("Model", get_model(case.models[result.output]).title),
            ("Calibration", f"{_upper(gap.lab_rows)}: {len(case.lab)} rows"),
            ("Field", f"{_upper(gap.field_rows)}: {len(case.field)} rows"),
        ],
        "tone": verdict.tone.value,
        "mark": TONE_MARKS[verdict.tone],
        "state": verdict.state,
        "headline": verdict.headline,
        "facts": [fact for fact in verdict.facts if fact[0] != "Next"],
        "withheld": _withheld(result),
        "best": f"{short_name(ranking.order[0])} ({odds_text(_best(result))})",
        "shrink": _shrink(result),
        "checks": [check_text(check) for check in checks(result)],
        "limits": gap.limits,
        "page": f"gaps/{gap.name}/index.html",
        "caption": plate.caption,
        "uri": data_uri(image),
        "size": png_size(image),
    }


def _upper(text: str) -> str:
    return text[0].upper() + text[1:]


def _best(result: FoundGap) -> float:
    ranking = result.found.ranking
    return float(ranking.probability[ranking.order[0]])


def _withheld(result: FoundGap) -> str:
    """Say whether the effect that was withheld is the one that was found."""
    effect = result.gap.withheld
    if effect is None:
        return ""
    ranking = result.found.ranking
    words = short_name(effect)
    if ranking.order[0] == effect and result.found.verdict == "effect":
        return f"The effect that was withheld, {words}, is the one that is named."
    p = odds_text(probability_of(result.found, effect))
    return (
        f"The effect that was withheld, {words}, is not the one that is named: its probability, "
        f"alone or with another, is {p}."
    )


def _shrink(result: FoundGap) -> str:
    s = result.found.shrink.get(result.output)
    if s is None:
        return "no gap that could shrink"
    low, high = (f"{100.0 * v:.0f}".replace("-", "\N{MINUS SIGN}") for v in s.interval)
    return f"{short(100.0 * s.fraction)} % ({low} to {high} %)"
