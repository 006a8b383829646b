"""The data set reconstructed from He, Sandu & Osorio (2019), and what is done with it.

No raw data of the source are available. Conditions follow its description, with assumptions
where it is silent; outputs are the published models plus noise, drawn with fixed seeds and moved
as little as makes a fit return the published figures. It says what the source says and nothing
more: never take it for a measurement, and show `LABEL` wherever it is shown.

The report calibrates it; designs of simulations take its conditions only, and simulate every
output. Drawbar pull and rut depth are calibrated at 18 and 42 psi and held out at 30 psi; the other
models are held out between the conditions that they are calibrated at.

References
----------
doi:10.1016/j.jterra.2019.07.003; the published figures are in `calib.he2019.published`.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from functools import cache, partial
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.special import bdtrc

from calib.batch.folders import write_whole
from calib.data import Table, hold_out, table_from_arrays
from calib.errors import CalibError
from calib.he2019.published import LABEL
from calib.he2019.reconstruction import Array, bulk_density, drawbar_pull, rut_depth
from calib.models import get_model
from calib.validation.replicate import Design, ModelDesign

if TYPE_CHECKING:
    from calib.report.study import Task

# Decimals of every column, with which the printed digits return: C2 is printed to 0.001 and has a
# standard error of 20, E at 42 psi to 0.0001 and has one of 6.
_DECIMALS = {
    "cone_index_kpa": 1, "gravimetric_water_content": 4, "bulk_density_g_cm3": 8,
    "inflation_pressure_psi": 0, "nominal_slip_ratio": 3, "slip_ratio": 3, "drawbar_pull_kn": 8,
    "average_ground_pressure_kpa": 2, "rut_depth_mm": 5,
}  # fmt: skip


@cache
def tables() -> Mapping[str, Mapping[str, Array]]:
    """Return all three outputs by name, each with its conditions, as read-only arrays."""
    found = {}
    for make in (bulk_density, drawbar_pull, rut_depth):
        rounded = {name: np.round(values, _DECIMALS[name]) for name, values in make().items()}
        for column in rounded.values():
            column.flags.writeable = False
        found[make.__name__] = MappingProxyType(rounded)
    return MappingProxyType(found)


def load_he2019(output: str) -> Table:
    """Return the table of bulk_density, drawbar_pull or rut_depth, labelled reconstructed.

    Examples
    --------
    >>> import calib
    >>> calib.load_he2019("drawbar_pull").label
    'reconstructed'
    """
    if output not in tables():
        wrong, hint = f"there is no output {output!r}", "name one of these"
        raise CalibError(wrong, expected=", ".join(tables()), hint=hint)
    return table_from_arrays(tables()[output], source=f"he2019 {output}", label=LABEL)


def _csv(table: Mapping[str, Array]) -> str:
    texts = [[f"{x:.{_DECIMALS[name]}f}" for x in column] for name, column in table.items()]
    rows = [list(table), *zip(*texts, strict=True)]
    return "".join(",".join(row) + "\n" for row in rows)


def holds(table: Table) -> bool:
    """Whether all readings of an output are those of the embedded data.

    To all digits a reading tells by itself, whatever was done with the conditions; to four digits
    as many must agree, beside their own conditions, as chance does not give.
    """
    return any(exact.all() or (rounded.all() and p < 1e-6) for exact, rounded, _, p in _same(table))


def holds_some(table: Table) -> bool:
    """Whether readings of an output, two at least, are those of the embedded data."""
    return any(telling >= 2 or p < 1e-6 for *_, telling, p in _same(table))


def _same(table: Table) -> Iterator[tuple[NDArray[np.bool_], NDArray[np.bool_], int, float]]:
    """Return which readings are embedded ones, for every output that a table has.

    That is to all digits and to four, both (n,); how many embedded readings of more than four
    decimals there are to all digits; and the probability of so many to four, of which as many are
    expected as agree with the embedded readings moved a little.
    """
    to_all, to_four = 1e-9, 5e-4  # relative differences of what was written with so many digits
    for known in tables().values():
        output = list(known)[-1]
        there = np.isfinite(table[output]) if output in table else np.zeros(0, dtype=np.bool_)
        if not there.any():
            continue
        beside = np.ones((int(there.sum()), known[output].size), dtype=np.bool_)
        for name in set(known) & set(table) - {output, "slip_ratio", "nominal_slip_ratio"}:
            beside &= np.isclose(table[name][there, None], known[name], rtol=to_four, atol=0.0)
        readings = table[output][there]
        off = readings[:, None] / known[output] - 1.0
        # Of those alike one counts.
        agree = [
            min(int(same.any(axis=0).sum()), np.unique(readings[same.any(axis=1)]).size)
            for k in range(-20, 21)
            for same in [(np.abs(off - 2.0 * k * to_four) <= to_four) & beside]
        ]
        n, here = known[output].size, agree.pop(20)
        p = bdtrc(here - 1.0, n, (sum(agree) + 1) / (len(agree) * n + 1)) if here else 1.0
        exact, rounded = np.abs(off) <= to_all, (np.abs(off) <= to_four) & beside
        long = np.abs(np.round(known[output], 4) / known[output] - 1.0) > to_all
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


# Designs and tasks


def _held_30_psi(name: str, key: str) -> Design:
    fitted, held = hold_out(load_he2019(key), "inflation_pressure_psi", 30.0)
    text = f"{len(fitted)} embedded conditions of 18 and 42 psi; held out: {len(held)} of 30 psi"
    return Design(name, fitted, get_model(name).select(held.columns), text)


def _density(name: str) -> Design:
    table = load_he2019("bulk_density")
    # Between the embedded samples: cone index (kPa) and water content (g/g).
    held_index, held_water = (130.0, 400.0, 1300.0), (0.02, 0.05, 0.08)
    index, water = (a.ravel() for a in np.meshgrid(held_index, held_water, indexing="ij"))
    held = {"cone_index_kpa": index, "gravimetric_water_content": water}
    text = "36 embedded conditions; held out: 9 between them"
    if name == "ayers_perumpral_volumetric":
        # theta_v = theta_g gamma_d, with water at 1 g/cm^3.
        columns = dict(table.columns)
        density = columns["bulk_density_g_cm3"]
        columns["volumetric_water_content"] = columns.pop("gravimetric_water_content") * density
        held["volumetric_water_content"] = held.pop("gravimetric_water_content") * density.mean()
        table = table_from_arrays(columns, source=table.source)
        text += "; volumetric water content is gravimetric times the embedded density"
    return Design(name, table, held, text)


def _one_pressure() -> Design:
    table = load_he2019("drawbar_pull")
    rows = table.take(table["inflation_pressure_psi"] == 18.0)
    slip = rows["slip_ratio"]
    held = {"slip_ratio": 0.5 * (slip[1:] + slip[:-1])}
    text = f"{len(rows)} embedded slips of 18 psi; held out: {slip.size - 1} midway between them"
    return Design("magic_formula", rows, held, text)


DESIGNS = (
    *(ModelDesign(n, partial(_density, n)) for n in ("ayers_perumpral",
                                                     "ayers_perumpral_volumetric")),
    ModelDesign("magic_formula", _one_pressure),
    ModelDesign("magic_formula_pressure",
                partial(_held_30_psi, "magic_formula_pressure", "drawbar_pull")),
    ModelDesign("bekker", partial(_held_30_psi, "bekker", "rut_depth")),
    ModelDesign("modified_bekker", partial(_held_30_psi, "modified_bekker", "rut_depth")),
)  # fmt: skip


def he2019_tasks(only: Collection[str] = ()) -> tuple[Task, ...]:
    """Return the paper's three calibrations on the embedded, reconstructed data.

    The 30 psi rows of drawbar pull and rut depth are held out. `only` names outputs to work out.
    """
    # Late: every command registers the designs, and few work a report out.
    from calib.report.study import HoldOut, Task

    held = HoldOut("inflation_pressure_psi", 30.0)
    models = {
        "bulk_density": ("ayers_perumpral", None),
        "drawbar_pull": ("magic_formula_pressure", held),
        "rut_depth": ("modified_bekker", held),
    }
    data = {key: load_he2019(key) for key in only or models}
    return tuple(
        Task(key, model, data[key], rows) for key, (model, rows) in models.items() if key in data
    )
