"""What the paper hangs on the engine, through the registration that anyone has.

It is declared as an entry point. What it registers imports its work when it is asked for it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

from calib.data.reader import KnownData
from calib.data.registry import register
from calib.inference.estimators import Method
from calib.report.reference import REFERENCES
from calib.report.sections import Section, SectionKind
from calib.validation.replicate import DESIGNS

_LABEL = "reconstructed"


def _later(module: str, name: str) -> Callable[..., Any]:
    """Return a function that imports what it calls when it is called."""

    def call(*args: Any, **kwargs: Any) -> Any:
        return getattr(import_module(f"calib.he2019.{module}"), name)(*args, **kwargs)

    return call


def _gaps_again(record: Any) -> Section[Any]:
    from calib.he2019.gaps import paper_gaps
    from calib.he2019.sections import GapsSection

    known = {gap.name: gap for gap in paper_gaps()}
    if not isinstance(record, dict):
        raise ValueError("not a table of gaps by name")
    if strange := sorted(set(record) - set(known)):
        raise ValueError(f"{strange[0]!r} is not one of {', '.join(known)}")
    return GapsSection(tuple(gap for name, gap in known.items() if name in record))


def _audit_again(record: Any) -> Section[Any]:
    from calib.he2019.audit import Seeds
    from calib.he2019.sections import AuditSection

    seeds = record.get("seeds") if isinstance(record, dict) else None
    names = set(Seeds.__dataclass_fields__)
    if not isinstance(seeds, dict) or set(seeds) != names:
        raise ValueError(f"seeds: not {', '.join(sorted(names))}")
    wrong = [name for name, n in seeds.items() if not (isinstance(n, int) and 1 <= n <= 1000)]
    if wrong:
        raise ValueError(f"seeds: {', '.join(wrong)}: not a whole number from 1 to 1000")
    return AuditSection(Seeds(**seeds))


def _audit_csv(folder: Path, files: Mapping[str, str]) -> dict[str, str]:
    import json

    from calib.he2019.audit import audit_csv, read_findings

    if "audit.json" not in files or not (folder / "audit.json").is_file():
        return {}
    content = json.loads((folder / "audit.json").read_bytes())
    return {"audit.csv": audit_csv(read_findings(content))}


class Plugin:
    """He, Sandu & Osorio (2019, Part II)."""

    def register(self) -> None:
        """Register data, methods, designs, printed results and sections; once."""
        from calib.he2019.designs import DESIGNS as OWN_DESIGNS
        from calib.he2019.published import HE2019 as PRINTED

        if _LABEL in REFERENCES:
            return
        some, said = (
            "Some of the data",
            "are reconstructed from published results [@He_2019]; they are not measurements.",
        )
        register(
            KnownData(_LABEL, "the embedded data", f"The data {said}", _later("embedded", "holds")),
            KnownData(f"partly {_LABEL}", "the embedded data and others", f"{some} {said}",
                      _later("embedded", "holds_some")),
            Method(
                "geometric", _later("estimators", "estimate_geometric"),
                "geometric (Eqs 6-9)", "Geom.",
                "the geometric method (Eqs 6\N{EN DASH}9 of the source)",
                ("magic_formula", "magic_formula_pressure"), place=0,
            ),
            Method(
                "published_regression", _later("estimators", "estimate_published_regression"),
                "regression as published (Eq 22)", "Regr.",
                "the regression as published (Eq 22 of the source)",
                ("bekker", "modified_bekker"), place=40,
            ),
            PRINTED,
            SectionKind("paper_gaps", _gaps_again),
            SectionKind("audit", _audit_again, _audit_csv),
            *(design for design in OWN_DESIGNS if design.model not in DESIGNS),
        )  # fmt: skip


HE2019 = Plugin()
