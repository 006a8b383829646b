"""What the paper hangs on the engine, through the registration that anyone has.

It is declared as an entry point. What it registers imports its work when it is asked for it.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from operator import attrgetter
from typing import Any

from calib.data.reader import KnownData
from calib.data.registry import register
from calib.inference.estimators import Method
from calib.report.reference import REFERENCES
from calib.report.sections import SectionKind
from calib.validation.replicate import DESIGNS


def _later(module: str, path: str) -> Callable[..., Any]:
    """Return a function that imports what it calls when it is called."""

    def call(*args: Any, **kwargs: Any) -> Any:
        return attrgetter(path)(import_module(f"calib.he2019.{module}"))(*args, **kwargs)

    return call


class Plugin:
    """He, Sandu & Osorio (2019, Part II)."""

    def register(self) -> None:
        """Register data, methods, designs, printed results and sections; once."""
        from calib.he2019.embedded import DESIGNS as OWN_DESIGNS
        from calib.he2019.published import HE2019 as PRINTED
        from calib.he2019.published import LABEL

        if LABEL in REFERENCES:
            return
        some, said = (
            "Some of the data",
            "are reconstructed from published results [@He_2019]; they are not measurements.",
        )
        register(
            KnownData(LABEL, "the embedded data", f"The data {said}", _later("embedded", "holds")),
            KnownData(f"partly {LABEL}", "the embedded data and others", f"{some} {said}",
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
            SectionKind("paper_gaps", _later("sections", "GapsSection.again")),
            SectionKind("audit", _later("sections", "AuditSection.again"),
                        _later("sections", "AuditSection.derived")),
            *(design for design in OWN_DESIGNS if design.model not in DESIGNS),
        )  # fmt: skip


HE2019 = Plugin()
