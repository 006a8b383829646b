"""Measurements as rows of one table: what, how much, how far it spread, what was asked."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import stats
from shared.measure import spread

from calib.inference.diagnostics import Gate
from report.emulated import emulator_lines

__all__ = ["NAMES", "RHAT_MAX", "Row", "largest_z", "rows_of", "sound"]

NAMES = {
    "drawbar_pull": "joint drawbar pull",
    "rut_depth": "rut depth",
    "bulk_density": "bulk density",
}
SAMPLERS = {
    "calib default": "calib, default settings",
    "calib long": "calib, 1,024 walkers and 640 steps",
    "nutpie default": "PyMC + nutpie, 4,000 draws",
    "nutpie long": "PyMC + nutpie, 40,000 draws",
    "stretch": "emcee's stretch move",
}

# Above it chains of nutpie's have not joined: the run is left out, as any user would.
RHAT_MAX = Gate().rhat_max

type Measured = Mapping[str, Any]


@dataclass(frozen=True)
class Row:
    """A line of the table; `low` and `high` are the least and the most of the repeats."""

    part: str
    subject: str
    quantity: str
    value: float
    low: float | None = None
    high: float | None = None
    asked: str = ""
    met: bool | None = None

    @property
    def line(self) -> str:
        """Return it as a line of a Markdown table."""
        span = "" if self.low is None else f"{_short(self.low)} to {_short(self.high)}"
        met = {None: "", True: "met", False: "**missed**"}[self.met]
        cells = (self.subject, self.quantity, _short(self.value), span, self.asked, met)
        return f"| {' | '.join(cells)} |"


def _short(value: float | None) -> str:
    if value is None:
        return ""
    if abs(value) >= 1000.0:
        return f"{float(f'{value:.3g}'):,.0f}"
    # Zeros at the end are figures too, but not those of a count.
    return f"{value:.0f}" if float(value).is_integer() else f"{value:#.3g}".rstrip(".")


def rows_of(measured: Mapping[str, Measured]) -> list[Row]:
    """Return the rows of all parts that were measured."""
    makers = {
        "posterior": _posterior, "likelihood": _likelihood, "genetic": _genetic,
        "million": _million, "campaign": _campaign, "survival": _survival,
        "everyday": _everyday, "emulator": _emulator,
    }  # fmt: skip
    return [
        row for part, make in makers.items() if part in measured for row in make(measured[part])
    ]


def _emulator(m: Measured) -> Iterator[Row]:
    for subject, quantity, s, most in emulator_lines(m):
        yield _asked("emulator", subject, quantity, s, most=most)


def largest_z(scores: Mapping[str, list[float]]) -> tuple[float, int, float]:
    """Largest of the z-scores, their number, and what only one set in a hundred exceeds."""
    z = np.abs(np.concatenate([np.asarray(v) for v in scores.values()]))
    limit = float(stats.norm.ppf(0.5 + 0.5 * 0.99 ** (1.0 / z.size)))
    return float(z.max()), z.size, limit


def _asked(
    part: str, subject: str, quantity: str, s: Mapping[str, float], most: float | None = None,
    least: float | None = None,
) -> Row:  # fmt: skip
    value = s["median"]
    if most is not None:
        asked, met = f"≤ {most:g}", value <= most
    elif least is not None:
        asked, met = f"≥ {least:g}", value >= least
    else:
        asked, met = "", None
    return Row(part, subject, quantity, value, s.get("low"), s.get("high"), asked, met)


def sound(run: Mapping[str, float]) -> bool:
    """Whether the chains of a run of nutpie's have joined."""
    return run["rhat"] <= RHAT_MAX


def _ratios(runs: Mapping[str, Any], length: str, kind: str) -> dict[str, float]:
    """Rates over nutpie's, each run's over that of the run beside it."""
    name = f"{kind}_per_second"
    pairs = zip(runs[f"calib {length}"], runs[f"nutpie {length}"], strict=True)
    ratios = [ours[name] / theirs[name] for ours, theirs in pairs if sound(theirs)]
    if not ratios:
        return {"median": float("nan")}
    return {"median": float(np.median(ratios)), "low": min(ratios), "high": max(ratios)}


def _posterior(m: Measured) -> Iterator[Row]:
    part = "posterior"
    for key in NAMES:
        p = m["problems"][key]
        subject, spread = NAMES[key], p["spread"]
        for length in ("default", "long"):
            what = {"default": "both at default settings", "long": "both long"}[length]
            bulk, tail = (_ratios(p["runs"], length, kind) for kind in ("bulk", "tail"))
            yield _asked(part, subject, f"bulk ESS/s over nutpie's, {what}", bulk, least=50.0)
            if length == "default":
                # What the scatter of means says that the sizes of short chains are worth.
                worth = 1.0 / float(np.mean(p["replicates"]["variance_over_claimed"]))
                scattered = {end: value * worth for end, value in bulk.items()}
                how = f"{what}, ours by the scatter of {p['replicates']['runs']} runs"
                yield _asked(
                    part, subject, f"bulk ESS/s over nutpie's, {how}", scattered, least=50.0
                )
            yield _asked(part, subject, f"tail ESS/s over nutpie's, {what}", tail)
        for length in ("default", "long"):
            ratios = [
                a["bulk_per_second"] / spread["stretch"]["bulk_per_second"]["median"]
                for a in p["runs"][f"calib {length}"]
            ]
            s = {"median": float(np.median(ratios)), "low": min(ratios), "high": max(ratios)}
            what = SAMPLERS[f"calib {length}"].removeprefix("calib, ")
            yield _asked(
                part, subject, f"bulk ESS/s over the stretch move's, {what}", s, least=80.0
            )
        yield _asked(
            part, subject, "likelihood evaluations per bulk ESS, default settings",
            spread["calib default"]["evaluations_per_bulk"], most=6.0,
        )  # fmt: skip
        for peer, title in (("nutpie", "PyMC + nutpie"), ("stretch", "the stretch move")):
            if not p["z_scores"][peer]:
                continue
            z, n, limit = largest_z(p["z_scores"][peer])
            yield Row(
                part, subject, f"largest of {n} z-scores against {title}", z,
                asked=f"≤ {limit:.2f}", met=z <= limit,
            )  # fmt: skip
        r = p["replicates"]
        for key, what in (
            ("variance_over_claimed", "means"),
            ("low_tail_variance_over_claimed", "shares below the 5 % quantiles"),
            ("high_tail_variance_over_claimed", "shares above the 95 % quantiles"),
        ):
            yield Row(
                part, subject, f"variance of {what} of {r['runs']} runs over what their ESS claim",
                float(np.mean(r[key])), min(r[key]), max(r[key]),
            )  # fmt: skip
        for name, title in SAMPLERS.items():
            for quantity, label in (
                ("bulk_per_second", "bulk ESS/s"), ("tail_per_second", "tail ESS/s"),
                ("ess_bulk", "bulk ESS"), ("seconds", "seconds"),
                ("evaluations_per_bulk", "evaluations per bulk ESS"),
            ):  # fmt: skip
                yield _asked(part, subject, f"{title}: {label}", spread[name][quantity])
        for length in ("default", "long"):
            found = p["runs"][f"nutpie {length}"]
            title = SAMPLERS[f"nutpie {length}"]
            yield Row(
                part, subject, f"{title}: runs of {len(found)} with R-hat > {RHAT_MAX:g}, left out",
                float(sum(not sound(r) for r in found)),
            )  # fmt: skip
            diverged = [r["divergences"] for r in found if sound(r)]
            if diverged:
                yield Row(
                    part, subject, f"{title}: divergent transitions in the others",
                    float(np.median(diverged)), min(diverged), max(diverged),
                )  # fmt: skip


def _likelihood(m: Measured) -> Iterator[Row]:
    part = "likelihood"
    for r in [*m["rows"], m["repeated_conditions"]]:
        subject, what = f"{r['rows']:,} rows", "time over the floor's"
        if r["distinct"] != r["rows"]:
            subject += f" at {r['distinct']} conditions"
            what += " of every row"
        yield _asked(part, subject, what, r["time_over_floor"], most=1.5)
        yield _asked(part, subject, "vectors times rows per second", r["cells_per_second"])
        yield Row(
            part, subject, f"memory of a call, MiB (all at once: {r['mib_if_all_at_once']:.0f})",
            r["peak_mib_of_a_call"],
        )  # fmt: skip
    for r in m["peers"]:
        for name, s in r["speed_over_calib"].items():
            if name != "calib":
                yield _asked(part, f"{r['rows']:,} rows", f"{name}: speed over calib's", s)


def _genetic(m: Measured) -> Iterator[Row]:
    part = "genetic"
    for key, p in m["problems"].items():
        subject = NAMES.get(key, key.replace("drawbar_pull", "drawbar pull"))
        ga, *others = p["methods"].items()
        for name, found in others:
            equal = found["at_the_optimum"] == found["seeds"]
            ratio = found["seconds"]["median"] / ga[1]["seconds"]["median"]
            yield Row(
                part, subject, f"{name}: time over the genetic algorithm's", ratio,
                asked="> 1" if equal else "", met=ratio > 1.0 if equal else None,
            )  # fmt: skip
        for name, found in (ga, *others):
            yield Row(
                part, subject, f"{name}: seeds of {found['seeds']} at the optimum",
                float(found["at_the_optimum"]),
            )  # fmt: skip
            yield _asked(part, subject, f"{name}: seconds", found["seconds"])


def _million(m: Measured) -> Iterator[Row]:
    part, subject = "million", f"{m['rows']:,} rows, {m['threads']} cores"
    s = m["seconds"]
    yield Row(part, subject, "seconds of a calibration", float(np.median(s)), min(s), max(s))
    yield Row(part, subject, "bulk ESS of the stored draws", m["ess_bulk"])
    yield Row(part, subject, "likelihood evaluations", float(m["evaluations"]))
    yield Row(part, subject, "peak memory, MiB", m["peak_mib"])
    z, n, limit = largest_z(m["check"]["z_scores"])
    yield Row(
        part, subject, f"largest of {n} z-scores against every row, written out", z,
        asked=f"≤ {limit:.2f}", met=z <= limit,
    )  # fmt: skip
    ratios = m["check"]["sd_ratio"]
    yield Row(
        part, subject, "posterior sd over that of every row, written out",
        float(np.median(ratios)), min(ratios), max(ratios),
    )  # fmt: skip


def _campaign(m: Measured) -> Iterator[Row]:
    part, o = "campaign", m["overhead"]
    pairs = zip(*(o["ms_per_task_wall_and_cpu"][n] for n in ("calib", "dask")), strict=True)
    beyond = [a[0] - b[0] for a, b in pairs]
    s = {"median": o["beyond_dask_ms_median_wall"]}
    if len(beyond) > 1:
        s |= {"low": min(beyond), "high": max(beyond)}
    subject = f"{o['tasks']:,} tiny tasks"
    yield _asked(part, subject, "ms per task beyond Dask's own, on the clock", s, most=2.0)
    cpu = {"median": o["beyond_dask_ms_median_cpu"]}
    yield _asked(part, subject, "ms per task beyond Dask's own, of processors", cpu, most=2.0)
    if "gain" in m:
        g = m["gain"]
        for way, what, least in (
            ("two", "two workers over one", 1.8),
            ("alone", "two plain processes without Dask over one", None),
        ):
            ratios = g["over_one"][way]
            s = {"median": float(np.median(ratios)), "low": min(ratios), "high": max(ratios)}
            yield _asked(part, f"{g['diagnoses']} diagnoses", what, s, least=least)


def _survival(m: Measured) -> Iterator[Row]:
    part, subject = "survival", f"{m['cases']} diagnoses, two workers and the client killed"
    yield Row(part, subject, "results", float(m["results"]), asked=f"= {m['cases']}",
              met=m["results"] == m["cases"])  # fmt: skip
    yield Row(part, subject, "results done again after the client was killed",
              float(m["done_again"]), asked="= 0", met=m["done_again"] == 0)  # fmt: skip
    yield Row(part, subject, f"files of {m['files_compared']} that differ from an undisturbed run",
              float(m["files_that_differ"]), asked="= 0",
              met=m["files_that_differ"] == 0)  # fmt: skip


def _everyday(m: Measured) -> Iterator[Row]:
    part = "everyday"
    for name, c in m["commands"].items():
        for by, what in (("clock", "seconds on the clock"), ("processor", "seconds of processors")):
            most = c["asked"] if by == c["by"] else None
            yield _asked(part, name, what, spread(c["now"][by]), most=most)
            if "before" in c:
                yield _asked(part, name, f"{what}, before", spread(c["before"][by]))
                pairs = zip(c["now"][by], c["before"][by], strict=True)
                yield _asked(
                    part, name, f"{what} over those before", spread([a / b for a, b in pairs])
                )
        ends = sorted({*c["now"]["exit_codes"]})
        if any(ends):
            yield Row(part, name, "exit code", float(ends[-1]), asked="= 0", met=False)
