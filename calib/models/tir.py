"""Tyre property files (``.tir``): read, written, and the pure longitudinal force that they give.

The force is that of the Magic Formula 6.1: Pacejka (2012), Tire and Vehicle Dynamics, Eqs
4.E9-4.E18, with the inflation pressure of Besselink, Schmeitz & Pacejka (2010),
doi:10.1080/00423111003748088. MF 5.2 and PAC2002 have the same equations.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from math import isfinite
from os import PathLike
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from calib.arguments import takes
from calib.data.files import decoded
from calib.data.quantities import convert
from calib.errors import CalibError
from calib.models.base import Array
from calib.models.magic_formula import sine_of

type Sections = Mapping[str, Mapping[str, float | str]]

FORCE, SCALES, SLIPS = "LONGITUDINAL_COEFFICIENTS", "SCALING_COEFFICIENTS", "LONG_SLIP_RANGE"
_NEEDED = (("VERTICAL", "FNOMIN"), (FORCE, "PCX1"), (FORCE, "PDX1"), (FORCE, "PKX1"))
# What programs call units, in pint's spelling; the first is that of a file that does not say.
_UNITS = {
    "FORCE": {"newton": "N", "n": "N", "knewton": "kN", "kn": "kN", "pound_force": "lbf"},
    "LENGTH": {"meter": "m", "m": "m", "cm": "cm", "mm": "mm"},
    "PRESSURE": {"pascal": "Pa", "pa": "Pa", "kpa": "kPa", "bar": "bar", "psi": "psi"},
}
_ENTRY = re.compile(
    r"(?P<key>[A-Za-z]\w*)\s*=\s*(?:'(?P<text>[^']*)'|(?P<plain>[^'$!]*))\s*([$!].*)?"
)
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eEdD][-+]?\d+)?", re.ASCII)


class Curve(NamedTuple):
    """Coefficients of the force (N) over the slip kappa, at a load, a pressure and a camber."""

    B: Array
    C: float
    D: Array
    E: Array
    E_by_sign: float
    Sh: Array
    Sv: Array

    def __call__(self, kappa: ArrayLike) -> Array:
        """Return the force (N), as it broadcasts."""
        x = np.asarray(kappa, dtype=np.float64) - self.Sh
        E = np.minimum(self.E * (1.0 - self.E_by_sign * np.sign(x)), 1.0)
        with np.errstate(invalid="ignore"):  # without friction B is infinite
            sine = sine_of(self.B * x, np.asarray(self.C), 1.0 - E)
        return self.Sv + np.where(self.D == 0.0, 0.0, self.D * sine)


@dataclass(frozen=True, repr=False)
class TyreFile:
    """A tyre property file.

    Parameters
    ----------
    sections : mapping of str to mapping
        Of each section its entries, numbers and texts as they stand in the file, in its units;
        names in capitals. Tables within a section are left out.
    source : str
        Where it was read, for messages.
    comments : tuple of str
        Lines to write above the sections.
    """

    sections: Sections
    source: str = ""
    comments: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        frozen = {name: MappingProxyType(dict(entries)) for name, entries in self.sections.items()}
        object.__setattr__(self, "sections", MappingProxyType(frozen))
        missing = [f"{k} in [{s}]" for s, k in _NEEDED if k not in self.sections.get(s, {})]
        if missing:
            raise CalibError(
                f"there is no {', no '.join(missing)}",
                where=self.source,
                expected="a property file of the Magic Formula: PAC2002, MF 5.2, 6.1 or 6.2",
                hint="add the entry; files of other tyre models give no such force",
            )
        for section, key in _NEEDED:
            if not self.number(section, key) > 0.0:
                raise self._refused(section, key, "a number above zero")
        self.curve(self.nominal_load_n)  # refuses what is no number, or in no known unit

    def __reduce__(self) -> tuple[object, ...]:
        # A mapping proxy does not pickle.
        sections = {name: dict(entries) for name, entries in self.sections.items()}
        return TyreFile, (sections, self.source, self.comments)

    def __repr__(self) -> str:
        return f"<TyreFile {self.source or 'of a calibration'}: {', '.join(self.sections)}>"

    def _refused(self, section: str, key: str, expected: str) -> CalibError:
        found = f"{key} in [{section}] is {self.sections[section][key]!r}"
        return CalibError(found, where=self.source, expected=expected, hint="correct the entry")

    def number(self, section: str, key: str, default: float = 0.0) -> float:
        """Return a number of a section, in the unit of the file; a default where it lacks it."""
        found = self.sections.get(section, {}).get(key, default)
        if isinstance(found, str):
            raise self._refused(section, key, "a number")
        return found

    @property
    def units(self) -> Mapping[str, str]:
        """Units of forces, lengths and pressures in the file, in pint's spelling."""
        said, found = self.sections.get("UNITS", {}), {}
        for kind, names in _UNITS.items():
            name = str(said.get(kind, next(iter(names)))).lower()
            if name not in names:
                raise self._refused("UNITS", kind, ", ".join(names))
            found[kind] = names[name]
        if "PRESSURE" not in said:
            found["PRESSURE"] = f"{found['FORCE']}/{found['LENGTH']}**2"
        return found

    @property
    def nominal_load_n(self) -> float:
        """The load (N) at which the coefficients are given."""
        return float(convert(self.number("VERTICAL", "FNOMIN"), self.units["FORCE"], "N"))

    def curve(
        self, fz_n: ArrayLike, pressure_pa: float | None = None, camber_rad: ArrayLike = 0.0
    ) -> Curve:
        """Return the coefficients of the force; see `longitudinal_force`."""
        p, scale = partial(self.number, FORCE), partial(self.number, SCALES, default=1.0)
        load = np.asarray(fz_n, dtype=np.float64)
        if (load < 0.0).any():
            found, expected = f"a load of {load.min():g} N", "a load of at least zero, upwards"
            raise CalibError(found, where="fz_n", expected=expected, hint="give it positive")
        df = load / (self.nominal_load_n * scale("LFZO")) - 1.0
        dp = self._pressure_change(pressure_pa)
        friction = scale("LMUX")
        upward = friction  # of the vertical shift: Eq 4.E8 in MF 6.1 and later
        if self.number("MODEL", "FITTYP") >= 60.0:
            upward = 10.0 * friction / (1.0 + 9.0 * friction)
        stiffness = (p("PKX1") + p("PKX2") * df) * np.exp(p("PKX3") * df) * scale("LKX")
        stiffness = stiffness * (1.0 + p("PPX1") * dp + p("PPX2") * dp**2)
        camber = np.asarray(camber_rad, dtype=np.float64) * scale("LGAX")
        mu = (p("PDX1") + p("PDX2") * df) * (1.0 - p("PDX3") * camber**2) * friction
        mu = mu * (1.0 + p("PPX3") * dp + p("PPX4") * dp**2)
        C = p("PCX1") * scale("LCX")
        with np.errstate(divide="ignore", invalid="ignore"):
            B = stiffness / (C * mu)
        return Curve(
            B=B,
            C=C,
            D=mu * load,
            E=(p("PEX1") + p("PEX2") * df + p("PEX3") * df**2) * scale("LEX"),
            E_by_sign=p("PEX4"),
            Sh=-(p("PHX1") + p("PHX2") * df) * scale("LHX"),
            Sv=load * (p("PVX1") + p("PVX2") * df) * scale("LVX") * upward,
        )

    def _pressure_change(self, pressure_pa: float | None) -> float:
        """Return (p - p0)/p0; zero where nothing in the file depends on it."""
        names = ("OPERATING_CONDITIONS", "INFLPRES", "NOMPRES")
        if names[0] not in self.sections:
            names = ("TIRE_CONDITIONS", "IP", "IP_NOM")
        section, own, nominal = names
        usual = self.number(section, nominal) * self.number(SCALES, "LIP", 1.0)
        acts = any(self.number(FORCE, f"PPX{i}") for i in (1, 2, 3, 4))
        if not acts or (pressure_pa is None and usual == 0.0):
            return 0.0
        if usual <= 0.0:
            raise CalibError(
                "the file says how the force changes with pressure, but not from which",
                where=self.source,
                expected=f"{nominal} in [{section}]",
                hint="add the nominal inflation pressure, or leave the pressure out",
            )
        pressure = self.number(section, own, usual)
        if pressure_pa is not None:
            pressure = float(convert(pressure_pa, "Pa", self.units["PRESSURE"]))
        return pressure / usual - 1.0

    def longitudinal_force(
        self,
        kappa: ArrayLike,
        fz_n: ArrayLike,
        pressure_pa: float | None = None,
        camber_rad: ArrayLike = 0.0,
    ) -> Array:
        """Return the pure longitudinal force (N) of a rolling tyre, as arguments broadcast.

        The slip is kappa = ωr/v - 1: positive when driving, -1 when locked; it is not held within
        the file's range. Turn slip and the decay of friction with speed are left out.

        Parameters
        ----------
        fz_n : array_like
            Load (N), at least zero.
        pressure_pa : float, optional
            Inflation pressure (Pa); by default what the file says.
        camber_rad : array_like
            Inclination angle (rad).

        Raises
        ------
        CalibError
            If a load is negative, or an entry is of no use.
        """
        return self.curve(fz_n, pressure_pa, camber_rad)(kappa)

    @property
    def text(self) -> str:
        """The file as it is written; numbers are read back as they are."""
        lines = [f"$ {line}".rstrip() for line in self.comments]
        for name, entries in self.sections.items():
            lines.append(f"[{name}]")
            cells = (f"'{v}'" if isinstance(v, str) else repr(v) for v in entries.values())
            lines += [f"{k:<14} = {cell}" for k, cell in zip(entries, cells, strict=True)]
        return "\n".join([*lines, ""])


@takes(path=PathLike)
def read_tir(path: PathLike[str] | str) -> TyreFile:
    """Read a tyre property file of the Magic Formula: PAC2002, MF 5.2, 6.1 or 6.2.

    Raises
    ------
    CalibError
        If the file cannot be read, a line of it is no entry, or a coefficient is missing without
        which it gives no longitudinal force.

    Examples
    --------
    >>> import calib
    >>> tyre = calib.read_tir("tyre.tir")  # doctest: +SKIP
    >>> tyre.longitudinal_force([0.0, 0.1], fz_n=4000.0)  # doctest: +SKIP
    """
    source = str(path)
    try:
        lines = decoded(Path(path).read_bytes(), "replace").splitlines()
    except (OSError, ValueError) as error:
        found = f"the file cannot be read ({error})"
        raise CalibError(found, where=source, hint="give the path of a .tir file") from None
    sections: dict[str, dict[str, float | str]] = {}
    entries: dict[str, float | str] | None = None
    for number, line in enumerate(map(str.strip, lines), start=1):
        where = f"{source}, line {number}"
        if not line or line[0] in "$!":
            continue
        if name := re.fullmatch(r"\[\s*(\w+)\s*\]\s*([$!].*)?", line):
            entries = sections.setdefault(name[1].upper(), {})
        elif (entry := _ENTRY.fullmatch(line)) and entries is not None:
            key, value = entry["key"].upper(), _value(entry, where)
            if value is not None and entries.setdefault(key, value) != value:
                raise _malformed(f"{key} has two values", where, "delete one of them")
        elif not _is_of_a_table(line):
            hint = "write the line so, or as a comment, after $"
            raise _malformed(f"{line[:40]!r} is no entry of a section", where, hint)
    return TyreFile(sections, source)


def _value(entry: re.Match[str], where: str) -> float | str | None:
    """Return the number or text of an entry; None where it is empty."""
    if entry["text"] is not None:
        return entry["text"].strip()
    plain = entry["plain"].strip()
    if not _NUMBER.fullmatch(plain):
        if re.match(r"[-+.\d]|nan|inf", plain, re.IGNORECASE):
            raise _malformed(f"{entry['key']} = {plain} is no number", where, "write one number")
        return plain or None
    value = float(re.sub("[dD]", "e", plain))
    if not isfinite(value):
        raise _malformed(f"{entry['key']} = {plain} is too large", where, "correct the number")
    return value


def _is_of_a_table(line: str) -> bool:
    """Whether a line is the head or a row of a table, or of a list of texts."""
    cells = re.split(r"[$!]", line)[0].split()
    return line[0] in "{('\"" or all(map(_NUMBER.fullmatch, cells))


def _malformed(found: str, where: str, hint: str) -> CalibError:
    expected = "[SECTION], or KEY = a number or a text in single quotes"
    return CalibError(found, where=where, expected=expected, hint=hint)
