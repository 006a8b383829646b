"""Table of the posterior: every parameter with its uncertainty."""

from __future__ import annotations

from collections.abc import Sequence

from calib.inference.calibration import ParameterSummary
from calib.report.numbers import NOTHING, ascii_number, ascii_text, format_number, last_place
from calib.report.posterior_text import centre_place, centre_text, end_places, interval_text
from calib.report.publish.grid import CsvTable, LatexTable
from calib.report.publish.markup import in_brackets
from calib.report.publish.records import Output

_HEAD = (
    "output", "model", "parameter", "unit", "mean", "sd", "mcse_mean", "median", "hdi95_lower",
    "hdi95_upper", "ess_bulk", "ess_tail", "rhat", "posterior_sd_over_prior_sd", "converged",
)  # fmt: skip


def posterior_csv(outputs: Sequence[Output]) -> CsvTable:
    """Return the posterior summaries of all outputs, one row for every parameter."""
    return CsvTable(
        _HEAD, tuple((o.key, o.model, *_csv_row(s, o)) for o in outputs for s in o.posterior)
    )


def _csv_row(s: ParameterSummary, o: Output) -> tuple[str, ...]:
    last = last_place(s.sd, s.mcse_mean)
    low, high = end_places(s)
    return (
        s.name,
        s.unit,
        ascii_number(s.mean, last),
        ascii_number(s.sd, last),
        ascii_text(format_number(s.mcse_mean, 2)),
        ascii_number(s.median, centre_place(s)),
        ascii_number(s.hdi_lower, low),
        ascii_number(s.hdi_upper, high),
        f"{s.ess_bulk:.0f}",
        f"{s.ess_tail:.0f}",
        f"{s.rhat:.4f}",
        ascii_text(format_number(s.sd_ratio, 2)),
        "yes" if o.converged else "no",
    )


def posterior_latex(o: Output) -> LatexTable:
    """Return the posterior summary of an output."""
    found = o.posterior
    sampled = [s for s in found if s.sd_ratio == s.sd_ratio]
    derived = [s for s in found if s.sd_ratio != s.sd_ratio]
    below = ""
    if derived:
        below = " The parameters above the rule follow from the sampled ones below it."
    warning = "" if o.converged else "NOT CONVERGED, not to be used. "
    return LatexTable(
        label=f"posterior_{o.key}",
        caption=(
            f"{warning}Posterior of the parameters of {o.model_words} from {o.found['data']['n']} "
            f"rows of {o.data_words}: mean ± standard deviation (sd), or the median where the "
            "interval is lopsided or spans decades; 95 % highest-density interval (HDI); effective "
            "sample sizes (ESS), R-hat [@Vehtari_2021], and the sd over that of the "
            f"prior.{below}"
        ),
        columns="lrrrrrr",
        head=("Parameter", "Posterior", "95 % HDI", "ESS bulk", "ESS tail", "R-hat",
              "sd/prior sd"),
        groups=(tuple(map(_latex_row, derived)), tuple(map(_latex_row, sampled))),
        small=True,
    )  # fmt: skip


def _latex_row(s: ParameterSummary) -> tuple[str, ...]:
    ratio = format_number(s.sd_ratio, 2) if s.sd_ratio == s.sd_ratio else NOTHING
    return (
        f"[${s.name}]{in_brackets(s.unit)}", centre_text(s), interval_text(s), f"{s.ess_bulk:.0f}",
        f"{s.ess_tail:.0f}", f"{s.rhat:.3f}", ratio,
    )  # fmt: skip
