"""Tyre property files: what is read, the force that they give, what is refused."""

from __future__ import annotations

import math
import pickle
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import calib
from calib import CalibError, TyreFile
from calib.models.tir import FORCE, SCALES

# Of no tyre: the numbers are invented, the layout is that of such files.
TYRE = """\
$ an invented tyre
[mdi_header]
FILE_TYPE                ='tir'
FILE_VERSION             =3.0
(COMMENTS)
{comment_string}
'a wheel of our own, 5 $'
! : COMMENT :  dry
[UNITS]
LENGTH  = 'meter'   $ unit
FORCE   = 'NEWTON'
[MODEL]
FITTYP  = 61        ! Magic Formula 6.1
[SHAPE]
{radial width}
 1.0  0.0
 0.9  1.0
[OPERATING_CONDITIONS]
INFLPRES =
NOMPRES = 2.0D5
[VERTICAL]
FNOMIN = 4000       $ nominal load
[LONG_SLIP_RANGE]
KPUMIN = -1.5
KPUMAX = 1.5
[SCALING_COEFFICIENTS]
LFZO = 1.1
LMUX = 0.8
LKX = 0.95
LVX = 0.5
[LONGITUDINAL_COEFFICIENTS]
PCX1 = 1.6
PDX1 = 1.15
PDX2 = -.08
PDX3 = 0.7
PEX1 = 0.2
PEX2 = 0.1
PEX3 = -0.05
PEX4 = 0.15
PKX1 = 21.5e0
PKX2 = -0.4
PKX3 = 0.23
PHX1 = 0.0012
PHX2 = 0.0008
PVX1 = 0.003
PVX2 = -0.001
PPX1 = -0.35
PPX2 = 0.25
PPX3 = -0.1
PPX4 = 0.06
"""


@pytest.fixture
def read(tmp_path: Path) -> Callable[[str], TyreFile]:
    def write_and_read(text: str) -> TyreFile:
        path = tmp_path / "tyre.tir"
        path.write_text(text, encoding="utf-8")
        return calib.read_tir(path)

    return write_and_read


def published(kappa: float, fz: float, pressure: float, camber: float, version: int = 61) -> float:
    """Pacejka (2012), Eqs 4.E1-4.E18 one by one, for the tyre above."""
    fz0 = 1.1 * 4000.0
    dfz, dpi = (fz - fz0) / fz0, (pressure - 2e5) / 2e5
    shift = 0.0012 + 0.0008 * dfz
    slip = kappa + shift
    c = 1.6
    mu = (1.15 - 0.08 * dfz) * (1 - 0.1 * dpi + 0.06 * dpi**2) * (1 - 0.7 * camber**2) * 0.8
    d = mu * fz
    e = min((0.2 + 0.1 * dfz - 0.05 * dfz**2) * (1 - 0.15 * math.copysign(1.0, slip)), 1.0)
    k = fz * (21.5 - 0.4 * dfz) * math.exp(0.23 * dfz) * (1 - 0.35 * dpi + 0.25 * dpi**2) * 0.95
    b = k / (c * d)
    degressive = 10 * 0.8 / (1 + 9 * 0.8) if version == 61 else 0.8
    vertical = fz * (0.003 - 0.001 * dfz) * 0.5 * degressive
    bx = b * slip
    return d * math.sin(c * math.atan(bx - e * (bx - math.atan(bx)))) + vertical


@given(
    st.floats(-2.0, 2.0), st.floats(100.0, 12_000.0), st.floats(5e4, 4e5), st.floats(-0.3, 0.3),
    st.sampled_from([52, 61]),
)  # fmt: skip
def test_the_force_is_the_published_one(kappa, fz, pressure, camber, version) -> None:
    tyre = TyreFile(sections(FITTYP=version))
    force = tyre.longitudinal_force(kappa, fz, pressure, camber)
    assert force == pytest.approx(published(kappa, fz, pressure, camber, version), rel=1e-9)


def sections(**model: float) -> dict[str, dict[str, float | str]]:
    """Return the entries above, parsed otherwise."""
    found: dict[str, dict[str, float | str]] = {}
    for line in TYRE.splitlines():
        if line.startswith("["):
            name = line.strip("[]").upper()
        elif "=" in line and not line.startswith(("$", "!")):
            key, _, value = line.split("$")[0].split("!")[0].partition("=")
            cell = value.strip().strip("'").replace("D", "e")
            if cell:
                number = cell[-1].isdigit() or cell.endswith(".")
                found.setdefault(name, {})[key.strip()] = float(cell) if number else cell
    found["UNITS"]["FORCE"] = "NEWTON"
    return {**found, "MODEL": {**found["MODEL"], **model}}


def test_a_file_is_read_as_it_stands(read: Callable[[str], TyreFile]) -> None:
    tyre = read(TYRE)
    assert {k: dict(v) for k, v in tyre.sections.items()} == {**sections(), "SHAPE": {}}
    assert tyre.nominal_load_n == 4000.0
    assert tyre.units == {"FORCE": "N", "LENGTH": "m", "PRESSURE": "N/m**2"}
    assert pickle.loads(pickle.dumps(tyre)) == tyre
    with pytest.raises(TypeError):
        tyre.sections[FORCE]["PDX1"] = 2.0  # type: ignore[index]


def test_units_are_those_of_the_file(read: Callable[[str], TyreFile]) -> None:
    other = TYRE.replace("'NEWTON'", "'kN'\nPRESSURE = 'bar'").replace("= 4000", "= 4.0")
    other = other.replace("2.0D5", "2.0")
    wanted = read(TYRE).longitudinal_force(0.1, 4000.0, 2.4e5)
    assert read(other).longitudinal_force(0.1, 4000.0, 2.4e5) == pytest.approx(wanted, rel=1e-12)


def test_pac2002_names_pressures_and_scales_of_its_own(read: Callable[[str], TyreFile]) -> None:
    own = TYRE.replace("[OPERATING_CONDITIONS]\nINFLPRES =\nNOMPRES = 2.0D5", "[TIRE_CONDITIONS]\n"
                       "IP = 2.4e5\nIP_NOM = 4e5")  # fmt: skip
    own = own.replace("LKX = 0.95", "LKX = 0.95\nLIP = 0.5\nLGAX = 2")
    wanted = read(TYRE).longitudinal_force(0.1, 4000.0, 2.4e5, 0.2)
    assert read(own).longitudinal_force(0.1, 4000.0, camber_rad=0.1) == pytest.approx(wanted)


def test_arguments_broadcast_and_a_wheel_in_the_air_gives_nothing(
    read: Callable[[str], TyreFile],
) -> None:
    tyre = read(TYRE)
    force = tyre.longitudinal_force([[0.1], [0.2]], [0.0, 2000.0, 4000.0])
    assert force.shape == (2, 3)
    np.testing.assert_array_equal(force[:, 0], 0.0)
    # Without a pressure it is that of the file, here the nominal one.
    assert force[0, 2] == tyre.longitudinal_force(0.1, 4000.0, 2e5)
    ice = read(TYRE.replace("LMUX = 0.8", "LMUX = 0"))
    np.testing.assert_array_equal(ice.longitudinal_force([0.0, 0.1], 4000.0), 0.0)
    with pytest.raises(CalibError, match="a load of -1 N"):
        tyre.longitudinal_force(0.1, [5.0, -1.0])


@given(
    st.dictionaries(
        st.sampled_from(["PDX2", "PEX1", "PEX4", "PKX3", "PHX1", "PVX1", "PPX2"]),
        st.floats(-1e3, 1e3),
    ),
    st.lists(st.text(st.characters(codec="ascii", exclude_categories=["C"])), max_size=3),
)
def test_what_is_written_is_read_back(tmp_path_factory, values, comments) -> None:
    entries = sections()
    tyre = TyreFile({**entries, FORCE: {**entries[FORCE], **values}}, comments=tuple(comments))
    path = tmp_path_factory.mktemp("tir") / "again.tir"
    path.write_text(tyre.text, encoding="utf-8")
    assert calib.read_tir(path).sections == tyre.sections


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("PCX1 = 1.6", "PCX1 : 1.6", ["tyre.tir, line 32", "'PCX1 : 1.6' is no entry"]),
        ("PCX1 = 1.6", "PCX1 = 1.6.2", ["line 32", "PCX1 = 1.6.2 is no number"]),
        ("PCX1 = 1.6", "PCX1 = nan", ["line 32", "PCX1 = nan is no number"]),
        ("PCX1 = 1.6", "PCX1 = 1e999", ["line 32", "too large"]),
        ("PCX1 = 1.6", "PCX1 = 1.6\nPCX1 = 1.7", ["line 33", "PCX1 has two values"]),
        ("PCX1 = 1.6", "PCX1 = 'steep'", ["PCX1 in [LONGITUDINAL_COEFFICIENTS] is 'steep'"]),
        ("PEX1 = 0.2", "PEX1 = blunt", ["PEX1 in [LONGITUDINAL_COEFFICIENTS] is 'blunt'"]),
        ("PCX1 = 1.6", "", ["there is no PCX1 in [LONGITUDINAL_COEFFICIENTS]"]),
        ("PDX1 = 1.15", "PDX1 = 0", ["PDX1", "is 0.0", "above zero"]),
        ("'NEWTON'", "'stone'", ["FORCE in [UNITS] is 'stone'", "newton"]),
        ("[mdi_header]", "x = 1", ["line 2", "is no entry of a section"]),
    ],
)
def test_a_malformed_file_is_refused_with_its_line(
    read: Callable[[str], TyreFile], old: str, new: str, words: list[str]
) -> None:
    with pytest.raises(CalibError) as refused:
        read(TYRE.replace(old, new))
    for word in (*words, "expected:", "hint:"):
        assert word in str(refused.value)


def test_a_missing_file_and_a_missing_pressure_are_refused(
    read: Callable[[str], TyreFile], tmp_path: Path
) -> None:
    with pytest.raises(CalibError, match="cannot be read"):
        calib.read_tir(tmp_path / "none.tir")
    tyre = read(TYRE.replace("NOMPRES = 2.0D5", ""))
    assert tyre.longitudinal_force(0.1, 4000.0) > 0.0
    with pytest.raises(CalibError, match="but not from which"):
        tyre.longitudinal_force(0.1, 4000.0, 2e5)


def test_a_missing_scale_is_one() -> None:
    bare = {k: v for k, v in sections().items() if k != SCALES}
    ones = {**bare, SCALES: dict.fromkeys(("LFZO", "LCX", "LMUX", "LEX", "LKX", "LHX", "LVX"), 1.0)}
    forces = [TyreFile(s).longitudinal_force(0.3, 3000.0, 1e5, 0.1) for s in (bare, ones)]
    assert forces[0] == forces[1]
