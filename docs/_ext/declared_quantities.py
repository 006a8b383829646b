"""A page for each quantity, from its `Quantity`."""

from __future__ import annotations

from declared_text import code, table, unit, words

from calib.data.quantities import QUANTITIES, Quantity
from calib.report.labels import ROLES, users

TITLE = "Quantities and units"
LEAD = (
    "Everything that a column may hold. A column name is a quantity and a unit; upper and lower "
    "case, spaces and brackets make no difference (`Rut depth [mm]` is `rut_depth_mm`). Each page "
    "is made from the quantity's declaration, as is what `calib quantities NAME` says; [one of "
    "your own](../../extend.md) is one declaration more."
)


def overview() -> list[str]:
    """Return a table of all quantities."""
    rows = (
        (f"[{code(c)}]({c}.md)", words(q.description), unit(q.unit), q.role)
        for c, q in QUANTITIES.items()
    )
    return [table(("column", "what", "unit inside", "role"), rows)]


def pages() -> dict[str, str]:
    """Return the page of every quantity by its column."""
    return {column: _page(quantity) for column, quantity in QUANTITIES.items()}


def _page(q: Quantity) -> str:
    facts = [
        ("unit inside the program", unit(q.unit)),
        ("allowed", words(q.range.describe())),
        ("drawn in", words(q.shown[0]) if q.shown else unit(q.unit)),
        ("known to effects as", code(q.physical)),
    ]
    if q.synonyms:
        facts.insert(0, ("also called", ", ".join(map(code, q.synonyms))))
    scale = ["Models compare its logarithm, so it must be positive.\n"] if q.log_scale else []
    return "\n".join(
        [
            f"# {words(q.canonical)}\n",
            f"{words(q.title)}: {words(q.description)}. {ROLES[q.role]}\n",
            table(("what", "is"), facts),
            *scale,
            "## Column names\n",
            *_headers(q),
            *_users(q),
        ]
    )


def _headers(q: Quantity) -> list[str]:
    if not q.units:
        return [f"{code(q.stem)}, without a unit.\n"]
    rows = [(code(f"{q.stem}_{suffix}"), unit(u)) for suffix, u in q.units.items()]
    if q.bare_unit:
        rows.insert(0, (code(q.stem), unit(q.bare_unit)))
    else:
        rows.append((f"{code(q.stem)} alone", "refused: the unit must be said"))
    return [table(("name", "unit"), rows)]


def _users(q: Quantity) -> list[str]:
    rows = [
        (how, ", ".join(f"[{code(n)}](../{how.split()[-1]}/{n}.md)" for n in names))
        for how, names in users(q).items()
    ]
    return ["## Who uses it\n", table(("how", "by name"), rows)] if rows else []
