"""The unit of pressure in Table 5: the nomenclature says kPa."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from calib.he2019.audit.finding import Basis, Finding, Quantity, Verdict
from calib.he2019.audit.quadratics import NAMES, nearest_by_signs
from calib.he2019.audit.signs import FAR
from calib.he2019.audit.words import percent
from calib.he2019.datasets.published import Published

PSI_PER_UNIT: Mapping[str, float] = MappingProxyType(
    {"psi": 1.0, "kPa": 1.0 / 6.894757, "bar": 100.0 / 6.894757}
)
_DECLARED = "kPa"


def pressure_unit(published: Published) -> Finding:
    """Test in which unit of pressure Table 5 can reproduce D and BCD of Table 4."""
    # The worse of D and BCD under the best of the eight readings of the signs.
    least = {
        unit: max(
            min(n.deviation for n in nearest_by_signs(published, what, psi_per_unit=scale).values())
            for what in ("D", "BCD")
        )
        for unit, scale in PSI_PER_UNIT.items()
    }
    possible = [unit for unit, deviation in least.items() if deviation <= FAR]
    if _DECLARED in possible:
        verdict = Verdict.CONFIRMED if possible == [_DECLARED] else Verdict.CONSISTENT
    else:
        verdict = Verdict.CORRECTED if possible else Verdict.CONTRADICTED
    best = min(least, key=lambda unit: least[unit])
    return Finding(
        "table5_pressure_unit", "Unit of pressure", "Table 5, Eqs 12-15, nomenclature",
        tuple(f"Table 5: {name}" for what in ("D", "BCD") for name in NAMES[what]),
        f"inflation pressure enters Eqs 12-15 in {_DECLARED}",
        "linear programme: the least that D and BCD can deviate from Table 4, over all "
        "coefficients that print alike and all readings of their signs, in each unit",
        tuple(
            Quantity(f"least deviation in {unit}", 100.0 * deviation, "%")
            for unit, deviation in least.items()
        ),
        verdict,
        f"In {best} Table 5 can come within {percent(least[best], 2)} of Table 4; in {_DECLARED} "
        f"no coefficients that print alike come nearer than {percent(least[_DECLARED])}, "
        "whatever their signs.",
        "", Basis.PRINTED,
    )  # fmt: skip
