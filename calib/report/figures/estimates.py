"""Point estimates of every method beside the posterior and the published figures."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from calib.inference.diagnostics import distances
from calib.inference.estimators import PointEstimate, method_name
from calib.models.base import Array
from calib.models.magic_formula import coefficients_at
from calib.report.figures.plate import Plate
from calib.report.figures.style import (
    BLACK,
    CYCLE,
    GREY,
    MARKERS,
    MIDDLE_MM,
    ORANGE,
    SMALLEST_PT,
    SYMBOL_PT,
    legend_below,
    panels,
)
from calib.report.labels import NO_UNIT, joined, parameter_label, plain, short, symbol
from calib.report.reference import NOTHING, Reference
from calib.report.study import OutputResult
from calib.validation.assumptions import FAR_SDS

_KNOWN = (
    "geometric", "genetic", "differential_evolution", "least_squares", "published_regression",
)  # fmt: skip
_LOOKS = {name: (MARKERS[i], CYCLE[i]) for i, name in enumerate(_KNOWN)}
# Estimates farther off than this many posterior sds are drawn at the edge.
_EDGE = 5.0
# Calibrated pressures that a legend lists one by one, at most.
_LISTED = 5


def estimates_plate(result: OutputResult, *, reference: Reference = NOTHING) -> Plate:
    """Draw every method's estimate of every published parameter, in posterior sds."""
    calibration = result.calibration
    reported = [k for k, v in calibration.reported.items() if np.ptp(v) > 0.0]
    model = calibration.problem.bound.model
    printed = reference.parameters(model.name)
    fig, axes = panels(
        1, 1, height=max(34.0, 8.0 * len(reported)), width=MIDDLE_MM, left=18.0, bottom=22.0,
        top=3.0,
    )  # fmt: skip
    ax: Axes = axes[0, 0]
    handles: dict[str, Any] = {}
    names, reach = [], 2.5
    for i, name in enumerate(reported):
        values = [e.reported[name] for e in result.estimates]
        values.append(printed[name].value if name in printed else np.nan)
        distance, interval, log = _distances(result, name, values)
        reach = max(reach, *np.abs(interval), np.nanmax(np.abs(distance), initial=0.0))
        (handles["posterior, 95 % HDI"],) = ax.plot(
            interval, [i, i], color="#c4c4c4", lw=4.0, solid_capstyle="butt"
        )
        (handles["posterior mean"],) = ax.plot(0.0, i, "|", color=BLACK, ms=9.0, mew=1.3, zorder=3)
        handles |= _row(ax, i, distance, result.estimates, reference.source(model.name))
        names.append(f"ln {symbol(name)}" if log else symbol(name))
    reach = 1.08 * min(_EDGE, reach)
    ax.set_xlim(-reach, reach)
    ax.set_yticks(range(len(names)), names, fontsize=SYMBOL_PT)
    ax.set_ylim(len(names) - 0.4, -0.6)
    ax.axvline(0.0, color=GREY, lw=0.5, zorder=0)
    ax.set_xlabel("Distance from the posterior mean (posterior sds)")
    ax.set_ylabel(f"Parameter ({NO_UNIT})")
    legend_below(fig, list(handles.values()), list(handles), 3)
    return Plate(fig, "estimates", _caption(result, reported, reference), "Point estimates")


def _distances(
    result: OutputResult, name: str, values: Sequence[float]
) -> tuple[Array, Array, bool]:
    s = result.calibration.summary[name]
    draws = result.calibration.reported[name].ravel()
    return distances(draws, np.array(values), (s.hdi_lower, s.hdi_upper))


def _row(
    ax: Axes, i: int, distance: Array, estimates: tuple[PointEstimate, ...], source: str
) -> dict[str, Any]:
    handles: dict[str, Any] = {}
    spread = np.linspace(-0.33, 0.33, max(2, len(estimates)))
    for k, (estimate, d) in enumerate(zip(estimates, distance[:-1], strict=True)):
        if np.isfinite(d):
            name = method_name(estimate.method)
            marker, colour = _LOOKS.get(estimate.method, ("P", GREY))
            handles[name] = _dot(ax, float(d), i + float(spread[k]), marker, colour)
    if np.isfinite(distance[-1]):
        handles[f"published ({source})"] = _dot(ax, float(distance[-1]), i, "D", ORANGE, ring=True)
    return handles


def _dot(ax: Axes, d: float, y: float, marker: str, colour: str, *, ring: bool = False) -> Any:
    """A dot; at the edge, with its distance written, where it is far off."""
    x = float(np.clip(d, -_EDGE, _EDGE))
    face = "none" if ring else colour
    edge, width, size = (colour, 1.3, 7.0) if ring else ("white", 0.4, 4.6)
    (dot,) = ax.plot(x, y, marker, mfc=face, mec=edge, mew=width, ms=size, zorder=4 + ring)
    if abs(d) > _EDGE:
        ax.annotate(
            f"{short(d)} ►" if d > 0 else f"◄ {short(d)}", (x, y),
            (-6.0 if d > 0 else 6.0, 0.0), textcoords="offset points", fontsize=SMALLEST_PT,
            va="center", ha="right" if d > 0 else "left",
        )  # fmt: skip
    return dot


def _caption(result: OutputResult, names: Sequence[str], reference: Reference) -> str:
    lowest = min((e.cost for e in result.estimates), default=0.0)
    # Of costs that are equal but for their rounding, that of the most exact method: it comes last.
    best = next((e for e in reversed(result.estimates) if e.cost <= lowest * (1.0 + 1e-9)), None)
    if best is None:
        return "No method gave an estimate."
    off = {n: float(_distances(result, n, [best.reported[n]])[0][0]) for n in names}
    far = max(names, key=lambda n: abs(off[n]))
    distance = abs(off[far])
    how = f"{short(distance)}" if distance < 100.0 else "more than 100"
    text = (
        f"The lowest cost, {short(best.cost, 3)}, was found by {method_name(best.method)}; of its "
        f"estimates {plain(far)} is farthest from the posterior mean, by {how} posterior sds"
        + (": the prior sets it, or is contradicted." if distance > FAR_SDS else ".")
    )
    name = result.calibration.problem.bound.model.name
    printed = reference.parameters(name)
    if printed:
        outside = [
            plain(n) for n in names if n in printed and _outside(result, n, printed[n].value)
        ]
        source = reference.source(name)
        text += (
            f" Of the published figures ({source}), {joined(outside)} "
            f"{'lies' if len(outside) == 1 else 'lie'} outside the posterior's 95 % HDI."
            if outside
            else f" All published figures ({source}) lie inside the posterior's 95 % HDI."
        )
    return text


def _outside(result: OutputResult, name: str, value: float) -> bool:
    s = result.calibration.summary[name]
    return not s.hdi_lower <= value <= s.hdi_upper


def by_pressure_plate(result: OutputResult, *, reference: Reference = NOTHING) -> Plate | None:
    """Draw B, C, D and E of each pressure by method; None where pressures were not fitted alone."""
    pressures = list(result.by_pressure)
    if not pressures:
        return None
    calibration = result.calibration
    joint = coefficients_at(
        calibration.problem.of_model(calibration.problem.theta(calibration.subset(1000))),
        np.array(pressures),
        calibration.problem.bound.references,
    )  # fmt: skip
    fig, axes = panels(1, 4, height=46.0, left=14.0, bottom=24.0, gap_x=15.0, top=4.0)
    handles: dict[str, Any] = {}
    units = {"B": "1/%", "C": "1", "D": "kN", "E": "1"}
    for ax, name in zip(axes[0], "BCDE", strict=True):
        handles |= _coefficient(ax, result, name, joint[name], reference)
        ax.set_xticks(range(len(pressures)), [f"{p:g}" for p in pressures])
        ax.tick_params(axis="x", labelsize=SMALLEST_PT)
        ax.set_xlim(-0.65, len(pressures) - 0.35)
        ax.set_xlabel("Pressure (psi)")
        ax.set_ylabel(parameter_label(name, units[name]))
    legend_below(fig, list(handles.values()), list(handles), 3)
    return Plate(
        fig, "by_pressure", _pressure_caption(result, reference), "Each pressure on its own"
    )


def _coefficient(
    ax: Axes, result: OutputResult, name: str, joint: Array, reference: Reference
) -> dict[str, Any]:
    handles: dict[str, Any] = {}
    low, middle, high = np.nanquantile(joint, [0.05, 0.5, 0.95], axis=0)
    fitted = np.unique(result.calibration.problem.table["inflation_pressure_psi"])
    jointly = f"{joined([f'{p:g}' for p in fitted])} psi"
    if set(result.by_pressure) <= set(fitted.tolist()):
        jointly = "all pressures"
    elif fitted.size > _LISTED:
        jointly = f"{fitted.size} pressures"
    for i, (psi, estimates) in enumerate(result.by_pressure.items()):
        handles[f"{jointly} calibrated jointly, 90 %"] = ax.errorbar(
            i - 0.4, middle[i], yerr=[[middle[i] - low[i]], [high[i] - middle[i]]], fmt="_",
            color=BLACK, ms=6.0, elinewidth=1.0,
        )  # fmt: skip
        for k, e in enumerate(estimates):
            marker, colour = _LOOKS.get(e.method, ("P", GREY))
            (handles[method_name(e.method)],) = ax.plot(
                i - 0.2 + 0.2 * k, e.reported[name], marker, color=colour, ms=4.6,
                mec="white", mew=0.4,
            )  # fmt: skip
        printed = zip(reference.alone.values(), (-0.2, 0.0), "os", strict=False)
        for table, at, shape in printed:
            if psi in table:
                label = f"published ({table[round(psi)].place})"
                (handles[label],) = ax.plot(
                    i + at, table[round(psi)].values[name], shape, mfc="none", mec=ORANGE,
                    mew=1.2, ms=8.0,
                )  # fmt: skip
    spread = [e.reported[name] for group in result.by_pressure.values() for e in group]
    pad = 0.25 * max(float(np.ptp(spread)), 1e-9)
    everything = np.concatenate([low, high, spread])
    bottom, top = (
        max(everything.min(), min(spread) - 4 * pad),
        min(everything.max(), max(spread) + 4 * pad),
    )
    ax.set_ylim(bottom - 0.4 * pad, top + 0.4 * pad)
    return handles


def _pressure_caption(result: OutputResult, reference: Reference) -> str:
    parts = []
    for psi, estimates in result.by_pressure.items():
        best = min(estimates, key=lambda e: e.cost)
        cost = f"{psi:g} psi {short(best.cost, 3)} kN²"
        beside = reference.beside("genetic", psi)
        if beside is not None:
            cost += f" ({beside.place}: {beside.quality['cost'].text})"
        parts.append(cost)
    return f"Lowest cost of a pressure fitted alone: {'; '.join(parts)}."
