"""Tables of point estimates by method, beside the published values and the posterior."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from calib.inference.calibration import ParameterSummary
from calib.inference.estimators import METHODS, method_name
from calib.models import get_model
from calib.report.numbers import NOTHING, ascii_text, format_as_printed, format_like, format_number
from calib.report.posterior_text import centre_text, interval_text, skewed
from calib.report.publish.grid import CsvTable, LatexTable
from calib.report.publish.markup import in_brackets
from calib.report.publish.records import Output
from calib.report.reference import Figure, FittedTable, reference_of

_HEAD = (
    "output", "model", "rows", "n_rows", "quantity", "unit", "method", "value", "published",
    "published_in", "same_printed_digits",
)  # fmt: skip
_ALONE = {"B": "1/%", "C": "1", "D": "kN", "E": "1", "cost": "kN^2"}
_QUALITY = {"cost": "Sum of squares", "rmse": "RMSE", "r_squared": "R²"}


def _short(method: str) -> str:
    return METHODS[method].short if method in METHODS else method


def _printed(o: Output) -> FittedTable | None:
    return reference_of(o.label).table(o.model)


def _varying(o: Output) -> dict[str, str]:
    """Published parameters that were not held fixed, with their units."""
    return {k: u for k, u in get_model(o.model).reported.items() if k in o.found["posterior"]}


def _n_rows(o: Output) -> int:
    return int(o.found["data"]["n_all" if o.estimates_use_all_rows else "n"])


def _digits(value: float | None, printed: Figure | None) -> str:
    if value is None:
        return NOTHING
    return format_number(value, 4) if printed is None else format_as_printed(value, printed.text)


def _rows_of(o: Output) -> Iterator[tuple[str, str, str, float | None, Figure | None, str]]:
    """Yield (quantity, unit, method, value, printed figure, its table) of all rows together."""
    table = _printed(o)
    source, quality = (table.source, reference_of(o.label).quality(o.model)) if table else ("", {})
    for method, values in o.found["estimates"].items():
        fit = o.found["fit"][method]
        units = {"cost": fit["cost_unit"], "rmse": fit["rmse_unit"], "r_squared": "1"}
        for name, unit in _varying(o).items():
            printed = table.estimates.get(name) if table else None
            yield name, unit, method, values[name], printed, source
        for name in _QUALITY:
            yield name, units[name], method, fit[name], quality.get(name), source


def estimates_csv(outputs: Sequence[Output]) -> CsvTable:
    """Return every estimate of every output: all rows together, then each pressure alone."""
    rows = []
    for o in outputs:
        for found in _rows_of(o):
            rows.append((o.key, o.model, "together", str(_n_rows(o)), *_csv_cells(*found)))
        for psi, by_method in o.found["by_pressure"].items():
            for method, values in by_method.items():
                beside = _beside(o, psi, method)
                shown = {**beside.estimates, **beside.quality} if beside else {}
                source = beside.source.partition(",")[0] if beside else ""
                for name, unit in _ALONE.items():
                    cells = _csv_cells(name, unit, method, values[name], shown.get(name), source)
                    rows.append((o.key, "magic_formula", psi, "", *cells))
    return CsvTable(_HEAD, tuple(rows))


def _csv_cells(
    name: str, unit: str, method: str, value: float | None, printed: Figure | None, source: str
) -> tuple[str, ...]:
    beside = ("", "", "")
    if printed is not None and value is not None:
        beside = (printed.text, source, "yes" if printed.agrees(value) else "no")
    return (name, unit, method, ascii_text(_digits(value, printed)), *beside)


def estimates_latex(o: Output) -> LatexTable | None:
    """Return the estimates of an output; None where no method gave one."""
    methods = list(o.found["estimates"])
    if not methods:
        return None
    table = _printed(o)
    posterior = {s.name: s for s in o.posterior}
    cells: dict[str, list[str]] = {}
    for name, unit, _, value, printed, _ in _rows_of(o):
        known = [format_like(printed.value, printed.text) if printed else NOTHING] if table else []
        row = cells.setdefault(name, [_name_cell(name, unit), *known])
        row.append(_ticked(value, printed))
    for name, row in cells.items():
        row.append(_posterior(posterior[name]) if name in posterior else NOTHING)
    data = o.found["data"]
    rows = f"all {_n_rows(o)}" if o.estimates_use_all_rows else str(_n_rows(o))
    beside = f", beside its {table.source}" if table else ""
    star = " An asterisk: equal to the source in every printed digit." if table else ""
    return LatexTable(
        label=f"estimates_{o.key}",
        caption=(
            f"Point estimates of the parameters of {o.model_words} from {rows} rows of "
            f"{o.data_words}{beside}, and the posterior from {data['n']} rows (mean ± standard "
            f"deviation, or median and 95 % highest-density interval). {_explained(methods)}{star}"
        ),
        columns=f"l{'r' * (len(methods) + 1 + bool(table))}",
        head=(
            "Parameter", *([table.source] if table else []),
            *(_short(m) for m in methods), "Posterior",
        ),
        groups=(
            tuple(tuple(row) for name, row in cells.items() if name not in _QUALITY),
            tuple(tuple(row) for name, row in cells.items() if name in _QUALITY),
        ),
        small=True,
    )  # fmt: skip


def _explained(methods: Sequence[str]) -> str:
    words = [f"{METHODS[m].short}: {METHODS[m].title}" for m in methods if m in METHODS]
    return f"{'; '.join(words)}." if words else ""


def _posterior(s: ParameterSummary) -> str:
    return f"{centre_text(s)} ({interval_text(s)})" if skewed(s) else centre_text(s)


def _name_cell(name: str, unit: str) -> str:
    return f"{_QUALITY.get(name) or f'[${name}]'}{in_brackets(unit)}"


def _ticked(value: float | None, printed: Figure | None) -> str:
    mark = "\N{CHECK MARK}" if printed and value is not None and printed.agrees(value) else ""
    return _digits(value, printed) + mark


def _beside(o: Output, pressure: str, method: str) -> FittedTable | None:
    return reference_of(o.label).beside(method, float(pressure.partition(" ")[0]))


def pressure_latex(o: Output) -> LatexTable | None:
    """Return the Magic Formula at each pressure alone; None for other models."""
    groups = []
    for pressure, by_method in o.found["by_pressure"].items():
        group = []
        for method, values in by_method.items():
            beside = _beside(o, pressure, method)
            shown = {**beside.estimates, **beside.quality} if beside else {}
            group.append((pressure, method_name(method),
                          *(_ticked(values[k], shown.get(k)) for k in _ALONE)))  # fmt: skip
        for tables in reference_of(o.label).alone.values():
            table = tables.get(round(float(pressure.partition(" ")[0])))
            if table is not None:
                figures = {**table.estimates, **table.quality}
                group.append((pressure, f"published ({table.source.partition(',')[0]})",
                              *(format_like(figures[k].value, figures[k].text)
                                for k in _ALONE)))  # fmt: skip
        groups.append(tuple(group))
    if not groups:
        return None
    head = (f"{_QUALITY.get(k) or f'[${k}]'}{in_brackets(u)}" for k, u in _ALONE.items())
    return LatexTable(
        label=f"estimates_by_pressure_{o.key}",
        caption=(
            f"The Magic Formula (Eqs 3\N{EN DASH}5 of the source [@He_2019]) at each inflation "
            f"pressure alone, {o.data_words}."
            + (" An asterisk: equal to the source's table of that method (least squares and "
               "differential evolution: of the genetic algorithm) in every printed digit."
               if o.label else "")
        ),
        columns="llrrrrr",
        head=("Pressure", "Method", *head),
        groups=tuple(groups),
        small=True,
    )  # fmt: skip
