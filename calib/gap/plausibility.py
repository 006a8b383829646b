"""Warnings about a pair of campaigns, and about what the best explanation leaves."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping

import numpy as np
import scipy

from calib.data import Table
from calib.data.checks import (
    column_notes,
    lines_of,
    source_of,
    spelling_notes,
    unit_notes,
    usual_in,
)
from calib.data.files import plain_number
from calib.data.quantities import OUTPUTS, QUANTITIES, Quantity, columns_of, role_of
from calib.gap.campaigns import Campaigns, OutputData, identical_rows
from calib.gap.constants import (
    FAR_RATIO,
    FEWEST_DRAWS,
    HELD,
    NEAR_UNIT,
    NOISIER,
    ODD_RATIO,
    PERCENT_RATIO,
    ROUGHLY_UNIT,
    WORTH_SAYING,
)
from calib.gap.fit import Fit
from calib.gap.ranking import Ranking
from calib.models import get_model
from calib.models.base import Array
from calib.validation.residuals import (
    Check,
    Remark,
    autocorrelated,
    failed,
    unexplained,
    unused,
)

# Factors between units that are taken for one another, with one that a quantity has to have, and
# how near a ratio has to come (sd of a logarithm); conditions are other ones in every campaign, so
# roughly will do.
_UNITS = {
    6.895: ("psi and kPa", "psi"),
    10.0: ("mm and cm", "cm"),
    25.4: ("inches and mm", "inch"),
    4.448: ("lbf and N", "lbf"),
    9.807: ("kgf and N", "kgf"),
    100.0: ("a fraction and percent", "percent"),
    1000.0: ("thousandths and wholes", None),
}


def oddities(lab: Table, field: Table, models: Mapping[str, str]) -> tuple[str, ...]:
    """Say what looks odd about a pair of campaigns, without refusing it.

    Parameters
    ----------
    lab, field : Table
        The calibration and the field campaign.
    models : mapping of str to str
        Output to model.

    Returns
    -------
    tuple of str
        A sentence each.
    """
    said = []
    same = identical_rows(lab, field)
    if same:
        said.append(
            f"{same} of {len(field)} field rows are rows of the calibration, value for value; the "
            "field must be other measurements, or every gap looks smaller than it is"
        )
    copies = len(field) - len(set(zip(*(field[name].tolist() for name in field), strict=True)))
    if copies:
        said.append(
            f"{copies} of {len(field)} field rows are copies of another, value for value; a copy "
            "counts as a measurement of its own and makes every probability too sure: leave it out"
        )
    said += _same_place(field)
    used = {name for model in models.values() for name in get_model(model).conditions}
    for table in (lab, field):
        said += [*column_notes(table), *spelling_notes(table)]
        for name in sorted(used & set(table)):
            said += unit_notes(table, QUANTITIES[name], table[name])
    held = [n for n in used if n in lab and n in field and not np.ptp(lab[n]) and np.ptp(field[n])]
    if held:
        said.append(
            f"{', '.join(sorted(held))}: held constant in the calibration and varied in the field; "
            "what it does to the simulator rests on the priors alone"
        )
    states = [c for role in ("speed", "passes", "water") for c in columns_of(role)]
    both = [n for n in states if n in lab and n in field]
    # A speed that scatters by a few per cent was held.
    scatter = {n: 2.0 * HELD * float(np.median(np.abs(lab[n]))) for n in both}
    varied = [n for n in both if np.ptp(lab[n]) > scatter[n] and np.ptp(field[n]) == 0.0]
    if varied:
        said.append(
            f"{', '.join(varied)}: it varies in the calibration and not in the field; were the two "
            "swapped?"
        )
    extra = [n for n in field if n not in lab and n not in OUTPUTS.values()]
    passes = [n for n in extra if n in columns_of("passes")]
    if passes:
        said.append(
            f"the calibration has no {passes[0]}: fresh soil, pass 1, is assumed for it; if it was "
            "another, another cause may be named for the difference: add the column"
        )
    if others := [n for n in extra if n not in passes]:
        said.append(
            f"the calibration has no {', '.join(others)}: what depends on it shows in how field "
            "rows differ from one another alone; what it does to all of them alike is put down to "
            "other causes"
        )
    for output in models:
        for table, rows in ((lab, "calibration"), (field, "field")):
            readings = table[OUTPUTS[output]] if OUTPUTS[output] in table else np.empty(0)
            if missing := int(np.isnan(readings).sum()):
                said.append(f"no reading of {output} in {missing} of {len(table)} {rows} rows")
    return (*said, *_other_units(lab, field, models))


def _same_place(field: Table) -> Iterator[str]:
    """Name rows with the same place in the order of the runs as another, unless they are copies."""
    for name in columns_of("order"):
        if name not in field:
            continue
        whole = np.column_stack([field[column] for column in field])
        first = np.unique(whole, axis=0, return_index=True)[1]
        # In each run by itself, where runs are labelled.
        order = np.column_stack([field[c] for c in (name, "run") if c in field])[first]
        _, place, count = np.unique(order, axis=0, return_inverse=True, return_counts=True)
        shared = np.zeros(len(field), dtype=np.bool_)
        shared[first] = count[place] > 1
        if shared.any():
            yield (
                f"{source_of(field)}, {lines_of(field, shared)}: the same {field.header_of(name)} "
                "as another row; a drift or a step of a sensor is sought in this order: number the "
                "rows as they were measured, or leave the column out"
            )


def _other_units(lab: Table, field: Table, models: Mapping[str, str]) -> list[str]:
    """Say which columns may be in another unit than their name says, or under another's name."""
    said = []
    conditions = {name for model in models.values() for name in get_model(model).conditions}
    for name in sorted(conditions & set(lab) & set(field)):
        apart = field[name].min() > lab[name].max() or field[name].max() < lab[name].min()
        if apart and np.ptp(lab[name]) > 0.0:
            read = usual_in(field, name, field[name], lab[name].min(), lab[name].max())
            within = f", and all would if the readings are in {read}" if read else ""
            said.append(
                f"{field.header_of(name)}: no field value lies within the calibration's range"
                f"{within}, {_typically(lab, field, name)}; the simulator is used where it was not "
                "fitted"
            )
    said += _covariates(lab, field, conditions)
    outputs = [OUTPUTS[output] for output in models]
    pull = next((name for name in outputs if role_of(name) == "pull"), None)
    for table in (lab, field):
        load = next((c for c in columns_of("load") if c in table), None)
        if pull is not None and load is not None and pull in table:
            pulls = np.abs(table[pull]) / table[load]
            if np.nanmedian(pulls) > 1.0:
                times = plain_number(np.nanmedian(pulls), 2)
                said.append(
                    f"{table.source}: the drawbar pull is typically {times} times "
                    "the normal load, more than a tyre on soil can pull; check the columns"
                )
    return said


def units_in_doubt(lab: Table, field: Table, models: Mapping[str, str]) -> Iterator[Remark]:
    """Name columns of the models that, if the field's are in another unit, make all else wrong."""
    conditions = {name for model in models.values() for name in get_model(model).conditions}
    outputs = [OUTPUTS[output] for output in models]
    for name in (*sorted(conditions), *outputs):
        if name not in lab or name not in field:
            continue
        apart = field[name].min() > lab[name].max() or field[name].max() < lab[name].min()
        most, like = (ODD_RATIO, ()) if name in outputs else (FAR_RATIO, (ROUGHLY_UNIT,))
        ratio = _typical(field[name]) / max(_typical(lab[name]), 1e-300)
        if 1.0 / most < ratio < most or (apart and name not in outputs):
            continue
        or_other = ", or is another column's," if name in outputs else ","
        yield Remark(
            f"{_compared(lab, field, name, *like)}; if the field's is in another unit{or_other} "
            "the diagnosis means nothing",
            f"the field's {QUANTITIES[name].word} may be in another unit",
            True,
        )


def _covariates(lab: Table, field: Table, used: Collection[str]) -> Iterator[str]:
    """Name columns that only effects need, and that may be in another unit than they say.

    Campaigns may differ in them: in speed by any factor. In fractions they do not by hundreds, as
    fractions and percent do, and what was held in the calibration is recognised. Where every value
    is ten times off all others', a unit in which the ranges would meet is named.
    """
    for name in sorted((set(lab) & set(field)) - set(used)):
        quantity = QUANTITIES.get(name)
        if quantity is None or quantity.role != "condition" or quantity.kind == "speed":
            continue
        low, high = (float(f(lab[name])) for f in (np.nanmin, np.nanmax))
        ratio = _typical(field[name]) / max(_typical(lab[name]), 1e-300)
        bottom, top = (1.0 - HELD) * low, (1.0 + HELD) * high
        as_before = bool(((bottom <= field[name]) & (field[name] <= top)).all())
        held = low > 0.0 and high <= (1.0 + HELD) * low and not as_before
        read = usual_in(field, name, field[name], bottom, top) if held else ""
        if read:
            yield (
                f"{_compared(lab, field, name, 0.0)}, and as in the calibration if "
                f"the readings are in {read}; check the unit in the column name"
            )
        elif quantity.unit == "dimensionless" and not 1.0 / PERCENT_RATIO < ratio < PERCENT_RATIO:
            yield f"{_compared(lab, field, name, ROUGHLY_UNIT)}; check the unit in the column name"
        elif met := _would_meet(field, name, bottom, top):
            yield (
                f"{_compared(lab, field, name, 0.0)}: every value is more than {FAR_RATIO:g} "
                f"times off the calibration's, and would not be if the readings are in {met}; "
                "check the unit in the column name"
            )


def _would_meet(field: Table, name: str, low: float, high: float) -> str:
    """Name the units in which a far column of the field would meet the calibration's range."""
    least, most = (float(f(field[name])) for f in (np.nanmin, np.nanmax))
    if low <= 0.0 or least <= 0.0 or (most * FAR_RATIO > low and least < high * FAR_RATIO):
        return ""
    # A factor brings the ranges together if it brings the field's middle (of logarithms) into the
    # calibration's, widened by the field's own half width.
    half = np.sqrt(most / least)
    return usual_in(field, name, np.array([np.sqrt(least * most)]), low / half, high * half)


def _typical(values: Array) -> float:
    return float(np.nanmedian(np.abs(values)))


def _compared(lab: Table, field: Table, name: str, near: float = NEAR_UNIT) -> str:
    """Name a column of the field, and say how the campaigns compare in it."""
    return f"{field.header_of(name)}: {_typically(lab, field, name, near)}"


def _typically(lab: Table, field: Table, name: str, near: float = NEAR_UNIT) -> str:
    """Say in the field's unit how typical values of a column compare, and which units do so."""
    column = field.column(name)
    return _times(column.written(lab[name]), column.written(field[name]), column.quantity, near)


def _times(lab: Array, field: Array, quantity: Quantity, near: float = NEAR_UNIT) -> str:
    """Say how the typical values of two columns compare, and which of its units do so nearly."""
    low, high = sorted((_typical(lab), _typical(field)))
    factor = high / max(low, 1e-300)
    way = "more" if _typical(field) > _typical(lab) else "less"
    like = [
        words
        for known, (words, unit) in _UNITS.items()
        if abs(np.log(factor / known)) < near and unit in (None, *quantity.units.values())
    ]
    between = f", about the factor between {' or '.join(like)}" if like else ""
    typical = f"typically {plain_number(_typical(field))} against {plain_number(_typical(lab))}"
    return f"{typical}, {plain_number(factor)} times {way}{between}"


def doubts(data: Campaigns, ranking: Ranking) -> tuple[Remark, ...]:
    """Say what no explanation has: in a field as it says, any is said with a chance of `LEVEL`."""
    best, case = ranking.best(ranking.order[0]), data.case
    units = tuple(units_in_doubt(case.lab, case.field, case.models))
    return (
        units
        + _converged(ranking)
        + failed(
            [
                check
                for o in data.outputs
                for check in (
                    *_noisier(data, o, ranking.lab_mode[o.name], best),
                    *_patterns(data, o, ranking, best),
                    *_dependent(data, o, ranking.lab_mode[o.name], best),
                )
            ]
        )
    )


def _converged(ranking: Ranking) -> tuple[Remark, ...]:
    """Whether the draws of every explanation in play are enough for its probability."""
    draws = {
        name: ranking.best(name).effective
        for name in ranking.order
        if ranking.probability[name] >= WORTH_SAYING
    }
    few = [f"{name} ({n:.0f})" for name, n in draws.items() if n < FEWEST_DRAWS]
    if not few:
        return ()
    said = f"the sampler did not converge: too few effective draws of {', '.join(few)}"
    return (
        Remark(
            f"{said}, where {FEWEST_DRAWS:.0f} are needed; its probability may be off by more than "
            "0.05: use tighter priors or more rows",
            said,
        ),
    )


def _noisier(data: Campaigns, o: OutputData, mode: Array, best: Fit) -> Iterable[Check]:
    """Whether the field scatters more about the explanation than the laboratory about its own fit.

    An F test of the variances, each in units of how the noise grows. What the explanation takes
    up of the field's is not allowed for, so that it is too rarely significant.
    """
    noise, left = best.noise[o.name], o.problem.response.size - len(o.priors.free)
    if left < 1:
        return
    lab = o.lab_residuals(mode)
    of_lab, of_field = data.whitenings(o, noise)
    field = of_field.decorrelated(best.field_residuals[o.name])
    variance = float(np.square(of_lab(lab)).sum()) / left
    if not variance > 0.0:
        return
    f = float(np.square(field).mean()) / variance
    p, times = float(scipy.stats.f.sf(f, field.size, left)), np.sqrt(f)
    there = float(np.sqrt(np.square(lab).sum() / left))
    sds = [_noise_text(o, sd) for sd in (times * there, there)]
    said = (
        f"the field's {o.name.replace('_', ' ')} scatters {plain_number(times, 2)} times as much "
        f"as the laboratory's (sd {sds[0]} against {sds[1]})"
    )
    yield Check(
        p if times >= NOISIER else 1.0,
        Remark(
            f"{source_of(data.case.field)}: {said} about the most probable explanation "
            f"(p = {plain_number(p, 2)}), so something that differs from row to row acts there: "
            "record what changed between rows (operator, tyre, place) as a column, declare it "
            "under [covariates] in case.toml, and diagnose again",
            said,
        ),
    )


def _patterns(data: Campaigns, o: OutputData, ranking: Ranking, best: Fit) -> Iterable[Check]:
    """Whether residuals differ with a column that no model or effect uses."""
    table = data.case.field.take(o.rows)
    fits = (fit for group in ranking.fits.values() for fit in group)
    roles = {c for fit in fits for e in fit.forward.hypothesis.effects for c in e.covariates}
    roles |= {role_of(c) for m in data.case.models.values() for c in get_model(m).conditions}
    own = {c for c in table.columns if role_of(c) in roles} | {*OUTPUTS.values()}
    columns = {h: v for h, v in unused(table, own).items() if h not in data.case.covariates}
    output = o.name.replace("_", " ")
    return unexplained(
        table,
        columns,
        data.whitenings(o, best.noise[o.name])[1].decorrelated(best.field_residuals[o.name]),
        title=f"the field's {output} differs with {{!r}}, which no model or effect uses",
        hint="declare it under [covariates] in case.toml, and diagnose again",
    )


def _dependent(data: Campaigns, o: OutputData, mode: Array, best: Fit) -> Iterator[Check]:
    """Whether neighbours along the runs of either campaign are alike.

    What the explanation takes up is not allowed for, so that it is too rarely significant.
    """
    if o.along is not None:
        return
    field = data.case.field.take(o.rows)
    both = (o.problem.table, o.lab_residuals(mode)), (field, best.field_residuals[o.name])
    for table, residual in both:
        place = next((table[c] for c in columns_of("order") if c in table), None)
        if place is None or not np.ptp(residual) > 0.0:
            continue
        run = table["run"] if "run" in table else np.zeros(place.size)
        yield from autocorrelated(
            table, residual[np.lexsort((place, run))], np.empty((residual.size, 0))
        )


def _noise_text(o: OutputData, sd: float) -> str:
    """Write a noise in the output's unit, or of a logarithm as a part of the output."""
    if o.problem.bound.model.response == "log":
        return f"{plain_number(100.0 * sd, 2)} %"
    return f"{plain_number(sd, 2)} {QUANTITIES[OUTPUTS[o.name]].unit_word}"
