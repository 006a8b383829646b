"""The data set reconstructed from He, Sandu & Osorio (2019): three outputs, one folder of CSVs.

No raw data of the source are available. Conditions follow its description, with assumptions
where it is silent; outputs are the published models plus noise, drawn with fixed seeds and moved
as little as makes a fit return the published figures. It says what the source says and nothing
more: never take it for a measurement, and show `LABEL` wherever it is shown.

References
----------
doi:10.1016/j.jterra.2019.07.003; the published figures are in `calib.he2019.published`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import cache
from pathlib import Path
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray
from scipy.special import bdtrc

from calib.batch.folders import write_whole
from calib.data import Table, table_from_arrays
from calib.errors import CalibError
from calib.he2019 import reconstruction
from calib.he2019.published import LABEL
from calib.he2019.reconstruction import Array

# Relative differences of what was written with all digits, and with four of them.
_EXACT, _ROUNDED = 1e-9, 5e-4
# Probability below which no agreement is taken for chance.
_CHANCE = 1e-6

# Decimals of every column; they carry the printed digits through the files.
_DECIMALS: Mapping[str, int] = MappingProxyType({
    "cone_index_kpa": 1, "gravimetric_water_content": 4,
    "bulk_density_g_cm3": reconstruction.DENSITY_DECIMALS,
    "inflation_pressure_psi": 0, "nominal_slip_ratio": 3, "slip_ratio": 3,
    "drawbar_pull_kn": reconstruction.PULL_DECIMALS,
    "average_ground_pressure_kpa": 2, "rut_depth_mm": reconstruction.RUT_DECIMALS,
})  # fmt: skip

_MAKERS: Mapping[str, Callable[[], Mapping[str, Array]]] = MappingProxyType({
    "bulk_density": reconstruction.bulk_density, "drawbar_pull": reconstruction.drawbar_pull,
    "rut_depth": reconstruction.rut_depth,
})  # fmt: skip


@cache
def columns(output: str) -> Mapping[str, Array]:
    """Return one output with its conditions, as read-only arrays."""
    return MappingProxyType(_MAKERS[output]())


def tables() -> dict[str, Mapping[str, Array]]:
    """Return all three outputs by name."""
    return {name: columns(name) for name in _MAKERS}


def load_he2019(output: str) -> Table:
    """Return the table of bulk_density, drawbar_pull or rut_depth, labelled reconstructed."""
    if output not in _MAKERS:
        raise CalibError(f"there is no output {output!r}", expected=", ".join(_MAKERS))
    return table_from_arrays(columns(output), source=f"he2019 {output}", label=LABEL)


def _csv(table: Mapping[str, Array]) -> str:
    texts = [[f"{x:.{_DECIMALS[name]}f}" for x in column] for name, column in table.items()]
    rows = [list(table), *zip(*texts, strict=True)]
    return "".join(",".join(row) + "\n" for row in rows)


def holds(table: Table) -> bool:
    """Whether all readings of an output are those of the embedded data.

    To all digits a reading tells by itself, whatever was done with the conditions; to four digits
    as many must agree, beside their own conditions, as chance does not give.
    """
    return any(
        exact.all() or (rounded.all() and p < _CHANCE) for exact, rounded, _, p in _same(table)
    )


def holds_some(table: Table) -> bool:
    """Whether readings of an output, two at least, are those of the embedded data."""
    return any(telling >= 2 or p < _CHANCE for *_, telling, p in _same(table))


def _same(table: Table) -> Iterator[tuple[NDArray[np.bool_], NDArray[np.bool_], int, float]]:
    """Return which readings are embedded ones, for every output that a table has.

    That is to all digits and to four, both (n,); how many embedded readings of more than four
    decimals there are to all digits; and the probability of so many to four, of which as many are
    expected as agree with the embedded readings moved a little.
    """
    for known in tables().values():
        output = list(known)[-1]
        there = np.isfinite(table[output]) if output in table else np.zeros(0, dtype=np.bool_)
        if not there.any():
            continue
        beside = np.ones((int(there.sum()), known[output].size), dtype=np.bool_)
        for name in set(known) & set(table) - {output, "slip_ratio", "nominal_slip_ratio"}:
            beside &= np.isclose(table[name][there, None], known[name], rtol=_ROUNDED, atol=0.0)
        readings = table[output][there]
        off = readings[:, None] / known[output] - 1.0
        # Of those alike one counts.
        agree = [
            min(int(same.any(axis=0).sum()), np.unique(readings[same.any(axis=1)]).size)
            for k in range(-20, 21)
            for same in [(np.abs(off - 2.0 * k * _ROUNDED) <= _ROUNDED) & beside]
        ]
        n, here = known[output].size, agree.pop(20)
        p = bdtrc(here - 1.0, n, (sum(agree) + 1) / (len(agree) * n + 1)) if here else 1.0
        exact, rounded = np.abs(off) <= _EXACT, (np.abs(off) <= _ROUNDED) & beside
        long = np.abs(np.round(known[output], 4) / known[output] - 1.0) > _EXACT
        telling = int(exact.any(axis=0)[long].sum())
        yield exact.any(axis=1), rounded.any(axis=1), telling, float(p)


def write(out_dir: Path) -> list[Path]:
    """Write one CSV per output over files of the same names, and return their paths."""
    # All text is worked out first: a failure there leaves no files behind.
    texts = {out_dir / f"{name}.csv": _csv(table) for name, table in tables().items()}
    out_dir.mkdir(parents=True, exist_ok=True)
    for path, text in texts.items():
        write_whole(path, text)
    return list(texts)
