"""Questions to `calib predict`: options, and what they add to its columns."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from calib.cli.options import column_value
from calib.errors import CalibError

if TYPE_CHECKING:
    from calib.data import Table
    from calib.data.table import Column
    from calib.validation.prediction import Prediction
    from calib.validation.questions import Drawn

    type Found = Mapping[str, Prediction | Drawn]

Exceeds = Annotated[
    list[str] | None,
    typer.Option(
        help="Add the probability that an output exceeds a value, e.g. drawbar_pull_kn=1.2: its "
        "mean, and a new reading; repeatable."
    ),
]
Below = Annotated[
    list[str] | None, typer.Option(help="The same of lying below a value; repeatable.")
]
Quantiles = Annotated[
    str | None, typer.Option(help="Add quantiles of mean and new reading, e.g. 0.05,0.5,0.95.")
]
DrawsBeside = Annotated[
    int, typer.Option(help="Draws to write beside --out, in OUT_draws.csv.", min=0)
]
PeakOver = Annotated[
    str | None,
    typer.Option(
        help="In place of bands say where the output peaks along a condition, e.g. slip_percent, "
        "over the range it has in the file, at each setting of the others."
    ),
]
_OTHER_UNIT = 100.0  # times any reading: a bound that large is probably in another unit
_POINTS = 101  # of a curve whose peak is sought, a parabola between them


@dataclass(frozen=True)
class Asked:
    """What a prediction is asked beside its bands."""

    limits: Sequence[tuple[str, float, str]]
    quantiles: Sequence[float]
    draws: int
    over: str

    @classmethod
    def read(
        cls, exceeds: Sequence[str] | None, below: Sequence[str] | None, quantiles: str | None,
        draws: int, over: str | None, out: Path | None,
    ) -> Asked:  # fmt: skip
        """Read the options."""
        limits = [(*column_value("--exceeds", text), ">") for text in exceeds or ()]
        limits += [(*column_value("--below", text), "<") for text in below or ()]
        try:
            levels = [float(level) for level in quantiles.split(",")] if quantiles else []
        except ValueError:
            hint = "separate numbers by commas, as in 0.05,0.5,0.95"
            raise CalibError(f"cannot read --quantiles {quantiles!r}", hint=hint) from None
        if draws and out is None:
            raise CalibError("draws are written beside a file", hint="add --out FILE.csv")
        if over and (limits or levels or draws):
            found = "--peak-over cannot be combined with other questions"
            raise CalibError(found, hint="run calib predict once for each")
        return cls(limits, levels, draws, over or "")

    @property
    def anything(self) -> bool:
        """Whether there are questions at all."""
        return bool(self.limits or self.quantiles or self.draws or self.over)

    def rows(self, table: Table, conditions: Sequence[str]) -> tuple[Table, Table]:
        """Return the rows to answer for, and those to predict at: curves, if a peak is sought."""
        import numpy as np

        if not self.over:
            return table, table
        along = _named(self.over, conditions).quantity.canonical
        x = table[along]
        others = np.stack([np.zeros(x.size), *(table[n] for n in conditions if n != along)])
        given = table.take(np.sort(np.unique(others, axis=1, return_index=True)[1]))
        points = np.tile(np.linspace(x.min(), x.max(), _POINTS), len(given))
        curves = given.take(np.repeat(np.arange(len(given)), _POINTS))
        return given, replace(curves, columns={**curves.columns, along: points})

    def columns(
        self, columns: dict[str, Any], found: Found, given: Table, out: Path | None
    ) -> tuple[dict[str, Any], list[dict[str, Any]], list[str]]:
        """Return columns with what was asked, what holds in all rows, and what to say of both.

        Draws are written.
        """
        import numpy as np

        from calib.data import write_table
        from calib.data.quantities import OUTPUTS
        from calib.validation.prediction import echoed

        if self.over:
            along = _named(self.over, [*given]).quantity.canonical
            each = np.reshape(columns["outside_calibrated_range"], (len(given), _POINTS))
            flags = ["+".join(dict.fromkeys(filter(None, row))) for row in each.tolist()]
            peaks, said = _peaks(self.over, found)
            columns = echoed(given, *OUTPUTS.values(), along) | peaks
            return columns | {"outside_calibrated_range": flags}, [], said
        more, everywhere, doubts = dict[str, Any](), list[dict[str, Any]](), list[str]()
        for header, limit, sign in self.limits:
            cells, whole, doubt = _chances(found, header, limit, sign)
            more |= cells
            everywhere.append(whole)
            doubts += doubt
        for name, one in found.items() if self.quantiles else ():
            for kind, values in one.quantile(self.quantiles)._asdict().items():
                levels = zip(self.quantiles, values, strict=True)
                more |= {f"{name}_{kind}_q{level:g}": row for level, row in levels}
        if self.draws and out is not None:
            drawn = {name: one.draws(self.draws) for name, one in found.items()}
            write_table(draws_beside(out), long := _long(drawn))
            print(f"{long['draw'][-1]} draws of each row written to {draws_beside(out)}")
        return before_last(columns, more), everywhere, doubts + [_in_words(e) for e in everywhere]


def _in_words(whole: Mapping[str, Any]) -> str:
    """Say what holds in all rows."""
    kinds = (
        f"{kind} {whole[kind]:.4g} (Monte Carlo error {whole[f'{kind}_error']:.1g})"
        if math.isfinite(whole[kind])
        else f"{kind} not known for all rows at once, as readings of a run are correlated (each "
        "row's own probability is in the table)"
        for kind in ("mean", "reading")
    )
    return f"probability of {whole['asked']} in all rows: {', '.join(kinds)}"


def _named(header: str, names: Sequence[str]) -> Column:
    """Read the name of a column among canonical ones."""
    from calib.data.table import parse_header

    column = parse_header(header)
    if column is None or column.quantity.canonical not in names:
        raise CalibError(
            f"there is no column {header} here", expected=", ".join(names),
            hint="name one of these, in any unit",
        )  # fmt: skip
    return column


def _chances(
    found: Found, header: str, limit: float, sign: str
) -> tuple[dict[str, Any], dict[str, Any], list[str]]:
    """Return the columns of a probability, what it is in all rows at once, and a doubt."""
    import numpy as np

    from calib.data.table import normal

    column = _named(header, [*found])
    one, bound = found[column.quantity.canonical], float(column.to_canonical(limit))
    p = one.probability(sign, bound)
    largest = float(np.nanmax(np.abs(one.quantile([0.005, 0.995]).reading), initial=0.0))
    what = f"{'above' if sign == '>' else 'below'}_{limit:g}"
    columns, whole = dict[str, Any](), dict[str, Any](asked=f"{header} {sign} {limit:g}")
    for kind, row, every in (
        ("mean", p.mean, p.mean_everywhere), ("reading", p.reading, p.reading_everywhere),
    ):  # fmt: skip
        columns[f"{normal(header)}_{kind}_{what}"] = row.value
        columns[f"{normal(header)}_{kind}_{what}_error"] = row.error
        whole |= {kind: float(every.value), f"{kind}_error": float(every.error)}
    far = abs(bound) / largest if largest else 0.0
    doubt = f"{header} = {limit:g} is {far:.3g} times as large as any reading predicted here: check"
    return columns, whole, [f"{doubt} its unit"] if far >= _OTHER_UNIT else []


def _peaks(over: str, found: Found) -> tuple[dict[str, Any], list[str]]:
    """Return columns that say where each output peaks, and how high, with 90 % bands."""
    from calib.data.table import normal

    columns, said = dict[str, Any](), []
    for name, one in found.items():
        peak = one.peak(over)
        for what, sample in ((f"_at_{normal(over)}", peak.at), ("", peak.output)):
            bands = sample.quantile([0.5, 0.05, 0.95])
            for end, values in zip(("median", "90_lower", "90_upper"), bands, strict=True):
                columns[f"{name}_peak{what}_{end}"] = values
        columns[f"{name}_peak_inside"] = peak.inside.value
        columns[f"{name}_peak_inside_error"] = peak.inside.error
        if beyond := int((peak.inside.value < 0.95).sum()):
            said.append(
                f"at {beyond} of {peak.inside.value.size} settings the peak may lie beyond the "
                f"range of {over}; {name}_peak_inside is the probability that it does not"
            )
    return columns, said


def _long(drawn: Mapping[str, Drawn]) -> dict[str, Any]:
    """Lay out draws in rows of one draw and one row of the conditions."""
    import numpy as np

    size, n = next(iter(drawn.values())).mean.values.shape
    columns = dict[str, Any](draw=np.arange(size).repeat(n) + 1, row=np.arange(size * n) % n + 1)
    for name, one in drawn.items():
        columns[f"{name}_mean"] = one.mean.values.ravel()
        columns[f"{name}_reading"] = one.reading.values.ravel()
    return columns


def draws_beside(out: Path) -> Path:
    """Return where the draws go."""
    return out.with_name(f"{out.stem}_draws.csv")


def before_last(columns: dict[str, Any], more: Mapping[str, Any]) -> dict[str, Any]:
    """Add columns; the last stays last: it tells that the file is a prediction."""
    *_, last = columns
    return {**{n: v for n, v in columns.items() if n != last}, **more, last: columns[last]}
