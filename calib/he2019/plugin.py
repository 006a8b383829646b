"""What the paper adds to the engine, through the registration that anyone has.

It is declared as an entry point.
"""

from __future__ import annotations

from typing import Any

from calib.data.reader import KnownData
from calib.data.registry import register
from calib.he2019 import embedded, estimators
from calib.he2019.published import HE2019 as PRINTED
from calib.he2019.published import LABEL
from calib.inference.estimators import Method
from calib.report.reference import REFERENCES
from calib.report.sections import SectionKind
from calib.validation.replicate import DESIGNS


def _sections() -> Any:
    """Import the sections when one is asked for: figures and pages come with them."""
    from calib.he2019 import sections

    return sections


class Plugin:
    """He, Sandu & Osorio (2019, Part II)."""

    def register(self) -> None:
        """Register data, methods, designs, printed results and sections; once."""
        if LABEL in REFERENCES:
            return
        some, said = (
            "Some of the data",
            "are reconstructed from published results [@He_2019], so that the published estimates "
            "fit them best. They are not measurements: that models fit them follows in part from "
            "how they were made.",
        )
        register(
            KnownData(LABEL, "the embedded data", f"The data {said}", embedded.holds),
            KnownData(f"partly {LABEL}", "the embedded data and others", f"{some} {said}",
                      embedded.holds_some),
            Method(
                "geometric", estimators.estimate_geometric,
                "geometric (Eqs 6-9)", "Geom.",
                "the geometric method (Eqs 6\N{EN DASH}9 of the source)",
                ("magic_formula", "magic_formula_pressure"), place=0,
            ),
            Method(
                "published_regression", estimators.estimate_published_regression,
                "regression as published (Eq 22)", "Regr.",
                "the regression as published (Eq 22 of the source)",
                ("bekker", "modified_bekker"), place=40,
            ),
            PRINTED,
            SectionKind("paper_gaps", lambda record: _sections().GapsSection.again(record)),
            SectionKind("audit", lambda record: _sections().AuditSection.again(record),
                        lambda *of: _sections().AuditSection.derived(*of)),
            *(design for design in embedded.DESIGNS if design.model not in DESIGNS),
        )  # fmt: skip


HE2019 = Plugin()
