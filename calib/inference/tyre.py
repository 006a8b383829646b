"""Calibrated Magic Formulas as tyre property files, and property files as priors.

The slip of a calibration is s = 1 - v/(ωr), that of property files is kappa = ωr/v - 1 = s/(1 - s).
A Magic Formula over one of them is none over the other. So the curve is fitted again over the other
slip, and what is written says how far the two differ.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping
from pathlib import Path
from textwrap import wrap
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from calib.arguments import takes
from calib.data.quantities import QUANTITIES
from calib.data.table import parse_header
from calib.errors import CalibError
from calib.inference.calibration import Calibration
from calib.inference.prior_files import default_priors
from calib.inference.problem import Problem
from calib.models import magic_formula as own
from calib.models.base import Array
from calib.models.tir import FORCE, SCALES, SLIPS, TyreFile

_SLIP, _PRESSURE, _LOAD = "slip_ratio", "inflation_pressure_psi", "normal_load_kn"
_ONE_PRESSURE = own.MODELS[0]
_POINTS = 201  # of a curve


class _Fitted(NamedTuple):
    """A Magic Formula in kN, and how far it is at most off the curve that it was fitted to."""

    K: float
    C: float
    D: float
    driving: float  # E
    braking: float
    off: float


def _fitted(x: Array, pull: Array, start: Array) -> _Fitted:
    """Fit a Magic Formula to a curve by least squares, from K, C, D and E; Sh and Sv stay.

    Shifts that were fitted would gain little, and ruin what lies beyond the curve. A curve of
    driving and braking has an E for each.
    """
    K, C, D, E, Sh, Sv = start
    both = bool(x[0] < 0.0 < x[-1])
    low, high = _ONE_PRESSURE.searched["C"]
    # G = 1 - E may be zero; its logarithm must begin somewhere.
    G = [np.log(max(1.0 - E, 1e-3))] * (1 + both)

    def formula(z: Array) -> tuple[float, ...]:
        K, D, driving, braking = np.exp(z[[0, 2, 3, 3 + both]])
        return K, z[1], D, 1.0 - driving, 1.0 - braking

    def residuals(z: Array) -> Array:
        K, C, D, driving, braking = formula(z)
        E = np.where(x > Sh, driving, braking)
        off = own.magic_formula(x, K / (C * D), C, D, E, Sh, Sv) - pull
        return np.asarray(off / np.abs(pull).max())

    begin = np.array([np.log(K), np.clip(C, low, high), np.log(D), *G])
    # A curve that does not reach its peak leaves D and E open: no factor beyond a thousand.
    lower, upper = begin - np.log(1e3), begin + np.log(1e3)
    lower[1], upper[1] = low, high
    found = least_squares(residuals, begin, bounds=(lower, upper), x_scale="jac")
    off = np.abs(found.fun).max() * np.abs(pull).max()
    return _Fitted(*map(float, (*formula(found.x), off)))


class _Curves(NamedTuple):
    """Calibrated curves over kappa, (k, n) in kN, and where to start the fit of each, (k, 6)."""

    kappa: Array
    pulls: Array
    starts: Array
    load_n: float
    conditions: str


def _curves(calibration: Calibration, size: int, at: Mapping[str, float]) -> _Curves:
    problem = calibration.problem
    if problem.bound.model not in own.MODELS:
        raise CalibError(
            f"a run of the model {problem.bound.model.name} is no tyre property file",
            expected=f"a run of {' or '.join(model.name for model in own.MODELS)}",
            hint="calibrate one of these on the same data",
        )
    given = _conditions(problem, at)
    theta = problem.of_model(problem.theta(calibration.subset(size)))
    if _PRESSURE in given:
        at_pressure = own.coefficients_at(
            theta, np.array([given[_PRESSURE]]), problem.bound.references
        )
        B, C, D, E = (at_pressure[name][:, 0] for name in "BCDE")
        Sh = Sv = np.zeros_like(B)
    else:
        B, C, D, E, Sh, Sv = problem.bound.report(theta).values()
    # A vehicle passes through zero slip, wherever the data begin; at s = 1 kappa is infinite.
    slips = problem.conditions[_SLIP]
    s = np.linspace(min(slips.min(), 0.0), max(slips.max(), 0.0), _POINTS)
    s = s[s < 1.0]
    pulls = own.magic_formula(100.0 * s, *(v[:, None] for v in (B, C, D, E, Sh, Sv)))
    zero = Sh / 100.0
    K = 100.0 * B * C * D * (1.0 - zero) ** 2  # ds/dkappa = (1 - s)^2
    starts = np.stack([K, C, D, E, zero / (1.0 - zero), Sv], axis=1)
    said = ", ".join(
        f"{QUANTITIES[c].word} {problem.table.column(c).words(v)}" for c, v in given.items()
    )
    return _Curves(s / (1.0 - s), pulls, starts, 1000.0 * given[_LOAD], said)


def _conditions(problem: Problem, at: Mapping[str, float]) -> dict[str, float]:
    """Return the load and, where the model takes it, the pressure of a property file."""
    table, found = problem.table, dict[str, float]()
    known = {c: problem.conditions[c] for c in problem.conditions if c != _SLIP}
    if _LOAD in table:
        found[_LOAD] = float(np.median(table[_LOAD]))
    wanted = [c for c in (*known, _LOAD) if c not in found]
    for header, value in at.items():
        column = parse_header(header)
        name = header if column is None else column.quantity.canonical
        if column is None or name not in wanted:
            raise CalibError(
                f"{header} is not asked for", where="at", hint="leave it out",
                expected=", ".join(wanted) or "nothing: the run has it all",
            )  # fmt: skip
        found[name] = float(column.to_canonical(value))
        low, high = (f(known.get(name, [0.0, np.inf])) for f in (np.min, np.max))
        if not low <= found[name] <= high or not found[name] > 0.0:
            raise CalibError(
                f"{header} = {value:g} is outside what the run was calibrated at", where="at",
                expected=f"{name} from {low:g} to {high:g}", hint="give a value within",
            )  # fmt: skip
    if missing := [c for c in wanted if c not in found]:
        raise CalibError(
            f"a property file is for one {QUANTITIES[missing[0]].word}, and none is given",
            expected=f"a value of {' and of '.join(missing)}, in any unit",
            hint=f"add it, as in --at {missing[0]}={30 if missing[0] == _PRESSURE else 5}",
        )
    return found


def _file(curves: _Curves, pull: Array, start: Array, what: str) -> TyreFile:
    """Return the property file of a curve."""
    fit = _fitted(curves.kappa, pull, start)
    newton, kappa = 1000.0 / curves.load_n, curves.kappa
    Sh, Sv = start[4:].tolist()
    off, part = 1000.0 * fit.off, 100.0 * fit.off / np.abs(pull).max()
    E = 0.5 * (fit.driving + fit.braking)
    said = (
        f"{what}, at {curves.conditions}. Written by calib.",
        "The slip is kappa = omega r/v - 1. The calibrated curve is a Magic Formula over s = 1 - "
        "v/(omega r), which is none over kappa: this one was fitted to it by least squares, and "
        f"is off by {off:.3g} N at most, {part:.2g} % of the largest force, from KPUMIN to KPUMAX.",
        "The force is the drawbar pull, net of motion resistance: give the program no rolling "
        "resistance, or it counts twice. It is known at one load, FNOMIN, and taken as "
        "proportional to it; and at one inflation pressure: write a file for each.",
        "Only sections that the calibration knows: copy them into the property file of the tyre.",
    )
    units = {"LENGTH": "meter", "FORCE": "newton", "ANGLE": "radians", "MASS": "kg"}
    coefficients = {
        "PCX1": fit.C, "PDX1": fit.D * newton, "PDX2": 0.0, "PDX3": 0.0, "PEX1": E, "PEX2": 0.0,
        "PEX3": 0.0, "PEX4": 0.5 * (fit.braking - fit.driving) / (E or 1.0) + 0.0,
        "PKX1": fit.K * newton, "PKX2": 0.0, "PKX3": 0.0, "PHX1": 0.0 - Sh, "PHX2": 0.0,
        "PVX1": Sv * newton, "PVX2": 0.0,
    }  # fmt: skip
    sections: dict[str, dict[str, float | str]] = {
        "MDI_HEADER": {"FILE_TYPE": "tir", "FILE_VERSION": 3.0, "FILE_FORMAT": "ASCII"},
        "UNITS": {**units, "TIME": "second"},
        "MODEL": {"PROPERTY_FILE_FORMAT": "PAC2002", "FITTYP": 52, "USE_MODE": 1},
        "VERTICAL": {"FNOMIN": curves.load_n},
        SLIPS: {"KPUMIN": float(kappa[0]), "KPUMAX": float(kappa[-1])},
        SCALES: dict.fromkeys(("LFZO", "LCX", "LMUX", "LEX", "LKX", "LHX", "LVX"), 1.0),
        FORCE: coefficients,
    }
    lines = (line for part in said for line in wrap(part, 76))
    return TyreFile(sections, comments=tuple(lines))


@takes(calibration=Calibration, at=Mapping)
def to_tir(calibration: Calibration, *, at: Mapping[str, float] | None = None) -> TyreFile:
    """Return a calibrated Magic Formula as sections of a tyre property file.

    The curve is the posterior median of the mean pull, at one load and inflation pressure, from
    zero slip to the calibrated slips; `text` of the result is the file, and says how far it is off.

    Parameters
    ----------
    at : mapping of str to float, optional
        By column name with its unit the inflation pressure, if the model takes it, and the load, if
        the data have none.

    Raises
    ------
    CalibError
        If the model is no Magic Formula, or a condition is missing or was not calibrated.

    Examples
    --------
    >>> import calib
    >>> pulls = calib.load_he2019("drawbar_pull")
    >>> problem = calib.build_problem("magic_formula_pressure", pulls)
    >>> calibration = calib.calibrate(problem, seed=1)
    >>> tyre = calib.to_tir(calibration, at={"inflation_pressure_psi": 30, "normal_load_kn": 5})
    >>> tyre.longitudinal_force(kappa=0.2, fz_n=5000.0) > 0.0
    np.True_
    """
    # As many draws as a prediction takes, so that its medians are these.
    curves = _curves(calibration, 4000, at or {})
    start, pull = np.median(curves.starts, axis=0), np.median(curves.pulls, axis=0)
    return _file(curves, pull, start, _what(calibration, "posterior median"))


def tir_draws(calibration: Calibration, size: int, *, at: Mapping[str, float]) -> list[TyreFile]:
    """Return draws of the posterior, evenly spaced, as `to_tir` returns the median."""
    curves = _curves(calibration, size, at)
    pairs = enumerate(zip(curves.pulls, curves.starts, strict=True), start=1)
    return [_file(curves, *pair, _what(calibration, f"draw {i}")) for i, pair in pairs]


def _what(calibration: Calibration, which: str) -> str:
    label, name = calibration.problem.table.label, calibration.problem.bound.model.name
    state = "" if calibration.converged else ", which DID NOT CONVERGE"
    return f"{name}, {which} of a calibration{state} on {label}{' ' * bool(label)}data"


def priors_from_tir(tyre: TyreFile) -> str:
    """Return a prior file of the model `magic_formula` about the curve of a tyre property file.

    The curve at the nominal load is fitted over our slip, in driving, or in braking if the file has
    nothing else; the shipped priors keep their families and widths.

    Raises
    ------
    CalibError
        If the curve has no Magic Formula of positive slope and peak.
    """
    least, most = (tyre.number(SLIPS, f"KPU{end}", x) for end, x in (("MIN", -1.0), ("MAX", 1.0)))
    # Below s = -1 there is no slip of ours.
    low, high = (0.0, most) if most > 0.0 else (max(least, -0.5), 0.0)
    s = np.linspace(low / (1.0 + low), high / (1.0 + high), _POINTS)
    curve, load = tyre.curve(tyre.nominal_load_n), tyre.nominal_load_n / 1000.0
    E = float(curve.E) * (1.0 - curve.E_by_sign * (1.0 if high else -1.0))
    D = float(curve.D) / 1000.0
    Sh, Sv = float(curve.Sh / (1.0 + curve.Sh)), float(curve.Sv) / 1000.0
    K = float(curve.B) * curve.C * D * (1.0 + float(curve.Sh)) ** 2  # dkappa/ds
    fit = _fitted(s, curve(s / (1.0 - s)) / 1000.0, np.array([K, curve.C, D, E, Sh, Sv]))
    found = {
        "K": fit.K / 100.0 / load, "C": fit.C, "D": fit.D / load, "G": 1.0 - fit.driving,
        "Sh": 100.0 * Sh, "Sv": Sv / load,
    }  # fmt: skip
    name = Path(tyre.source).name
    content = tomllib.loads(default_priors(_ONE_PRESSURE.name).read_text(encoding="utf-8"))
    lines = [
        f"# Priors of the Magic Formula about {name} at its nominal load, widths as shipped.",
        f"# Over s its curve is off by {1000.0 * fit.off:.3g} N at most.",
        f'model = "{content["model"]}"',
    ]
    for parameter, entry in content["parameters"].items():
        if "default_reference" in entry:
            entry["default_reference"] = load
        if parameter in found:
            entry["median" if "median" in entry else "mean"] = float(f"{found[parameter]:.6g}")
            entry["reason"] = f"The curve of {name}; the width: {entry['reason']}"
            entry["source"] = f"{name}; the width: {entry['source']}"
        lines += ["", f"[parameters.{parameter}]"]
        lines += [f"{k} = {json.dumps(v, ensure_ascii=False)}" for k, v in entry.items()]
    return "\n".join([*lines, ""])
